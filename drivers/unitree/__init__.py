"""What Unitree's robots have in common: services, claim, takeover, sending and receiving over topics."""
