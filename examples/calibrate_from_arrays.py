"""Calibrate a double pendulum from arrays: the model's text, a recording in memory, a table.

python examples/calibrate_from_arrays.py
"""

import tempfile
from pathlib import Path

import numpy as np

import deal_hw
from deal_hw.testing.plain_robots import make_robot, write

# A robot in plain MuJoCo, recorded for 6 s. The calibration does not know its parameters.
folder = Path(tempfile.mkdtemp())
model, (recording, *_), other = write(make_robot("double-pendulum", seed=0), folder, seconds=6.0)
columns = np.genfromtxt(recording, delimiter=",", names=True, deletechars="")
arrays = {name: columns[name] for name in columns.dtype.names or ()}

found = deal_hw.calibrate(model, arrays, holdout=other, say=print)
print(found.table())
print("written:", found.save_model(folder / "calibrated.xml"))
