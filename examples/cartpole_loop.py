"""The whole loop on an emulated cart-pole: record, calibrate, train, deploy.

python examples/cartpole_loop.py            # a policy that balances needs --steps 48000, two minutes
"""

import argparse
import tempfile
from pathlib import Path

import deal_hw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=20_000, help="training steps")
steps = parser.parse_args().steps
folder = Path(tempfile.mkdtemp())

# An emulated robot with hidden parameters. For a real one, leave the block out and name its port.
with deal_hw.emulate("cartpole", profile="sensor", seed=1) as robot:
    for motion in ("rich", "chirp"):  # 4 s to fit, and 4 s of another motion to judge
        deal_hw.collect("cartpole", port=robot.port, motion=motion, out=folder, say=print)

    found = deal_hw.calibrate(dataset=folder / "dataset", say=print)
    print(found.table())

    training = deal_hw.train("cartpole", distribution=found, steps=steps, out=folder)
    run = deal_hw.deploy(
        "cartpole", port=robot.port, policy=training.path, seconds=2, out=folder / "deployed"
    )
    print("deployed:", run.outcome.value, "-", run.episodes[-1].reason)

truth = robot.truth["parameters"]
for row in found.rows():
    if row["parameter"] in truth:
        print(f"{row['parameter']}: {row['estimate']:.4g}, truth {truth[row['parameter']]:.4g}")
