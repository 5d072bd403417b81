"""What moves a robot in real time: control loop, safety filter, supervisor, hand-over to the recorder.

Nothing here loads torch or MuJoCo, writes to disk in the control process, or knows one robot from another.
"""
