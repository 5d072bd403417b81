"""The cart-pole: its description, its protocol, the robot that speaks it and an emulator that answers it."""
