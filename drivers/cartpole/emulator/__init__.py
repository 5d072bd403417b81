"""Emulated cart-poles behind a wire, and the balancer that chooses their hidden truth."""
