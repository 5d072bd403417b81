"""Which motion to record next."""
