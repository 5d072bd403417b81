"""Compare your model and the calibrated one on a held-out recording.

python examples/compare_models.py
"""

import tempfile
from pathlib import Path

import deal_hw

folder = Path(tempfile.mkdtemp())
with deal_hw.emulate("cartpole", profile="sensor", seed=1) as robot:
    seen = deal_hw.collect("cartpole", port=robot.port, out=folder)
    unseen = deal_hw.collect("cartpole", port=robot.port, out=folder, excite="multisine", seed=5)
    print(*seen.paths, *unseen.paths, sep="\n")

found = deal_hw.calibrate(dataset=folder / "dataset", episodes=[0], holdout=[1])
print(found)

beside = deal_hw.inspect(unseen.paths[0], calibration=found)
print(beside.table())
print("look at it with rerun:", beside.save(folder / "compare.rrd"))
