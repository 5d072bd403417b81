"""Real-time control of a robot: control loop, safety filter, supervisor, channel to the recorder.

Nothing here loads torch or MuJoCo, writes to disk in the control process, or contains code for a single
robot.
"""
