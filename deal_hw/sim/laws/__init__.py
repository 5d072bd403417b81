"""Laws of actuators: pure functions of state, command and parameters, for N members at once.

They say what MuJoCo's model fields cannot: friction that depends on speed and load, an effort limit that
falls with speed, and what a drive makes of its commands. Joint laws act between the engine's steps, command
laws before the engine.
"""
