"""The cart-pole: description, protocol, driver and emulator."""
