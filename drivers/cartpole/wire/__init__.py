"""Bytes of the cart-pole's wires: frames of serial line, CAN and ODrive, without I/O."""
