"""An emulated G1 on a crane: mechanics, motors, firmware and services, with a hidden truth."""
