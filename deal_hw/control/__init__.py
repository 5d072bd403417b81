"""What moves a robot in real time: the control loop, the safety filter, the supervisor and the hand-over to the recorder.

Nothing here loads torch or MuJoCo, writes to disk in the control process, or knows one robot from another.
"""
