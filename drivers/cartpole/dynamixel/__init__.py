"""The cart-pole on two Dynamixel X-series servos: one drives the belt, one with its torque off reads the pole."""
