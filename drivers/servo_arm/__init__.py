"""Arms of servos on a bus, as a robot.yaml describes them: the driver, and their emulator."""
