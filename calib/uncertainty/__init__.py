"""What the data say of the parameters."""
