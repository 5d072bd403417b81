"""The emulated mechanics with their sensors, and the hidden truth behind them."""
