"""What runs the firmware of an emulated cart-pole: C core, chip simulators, or Python."""
