"""MuJoCo models of robots, and their simulation: one robot or a batch of parameter sets."""
