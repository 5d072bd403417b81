"""A bench cart-pole of others as a robot of deal-hw."""
