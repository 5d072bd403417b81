"""An emulated Go2: mechanics, motors, firmware and services, with faults on request and a hidden truth."""
