"""The cart-pole on two Dynamixel X-series servos: one drives the belt, one without torque reads the pole."""
