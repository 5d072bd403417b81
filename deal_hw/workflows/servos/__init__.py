"""How the section ``hardware`` of a robot.yaml comes into being, and how it is compared with the servos."""
