"""Messages of the Go2's wire: topics, byte layouts, and values in SI units."""
