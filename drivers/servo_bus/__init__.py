"""A bus of Dynamixel servos, for any robot: packets, registers, the host's side, and emulated servos."""
