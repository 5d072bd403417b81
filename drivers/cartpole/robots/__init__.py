"""The drivers of the cart-pole: serial line, CAN, ODrive."""
