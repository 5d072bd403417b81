"""What travels on the Go2's wire: topics, byte layouts, and messages as values in SI units."""
