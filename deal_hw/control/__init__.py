"""Real-time control of a robot: control loop, safety module, processes; nothing else.

Nothing here loads torch or MuJoCo, writes to disk in the control process, or contains code for a single
robot.
"""
