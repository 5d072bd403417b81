"""Kill real recorder processes with SIGKILL at random moments, and print the loss of each.

The loss is the time from the last sample in the repaired file to the last sample given to the recorder. Both
times are the samples' own stamps, so the time at which the kill is noticed has no effect.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

from deal_hw.clock import MonotonicClock
from deal_hw.data.recording.reader import read_episode
from deal_hw.data.recording.record import CycleRecord, encode
from deal_hw.data.recording.recorder_launch import start_recorder
from deal_hw.data.recording.repair import repair
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.transport import Message
from deal_hw.types import JointCommand, RobotState, Status

CYCLE_NS = 20_000_000
SAMPLE_NS = 5_000_000


def cycle(number: int, start_ns: int, rng: np.random.Generator) -> CycleRecord:
    """Return a 50 Hz cycle with four samples at 200 Hz, the newest one stamped with the cycle's start."""

    def noise(size: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return rng.normal(size=size)

    states = tuple(
        RobotState(
            noise(2),
            noise(2),
            noise(2),
            start_ns - (3 - i) * SAMPLE_NS,
            (4 * number + i) * SAMPLE_NS,
            4 * number + i,
            number - 1,
            1000,
            Status.ARMED,
        )
        for i in range(4)
    )
    command = JointCommand(*(noise(1) for _ in range(7)))
    wire = tuple(Message("rx", rng.bytes(45), state.receive_ns) for state in states)
    wire += (Message("tx", rng.bytes(30), start_ns),)
    return CycleRecord(
        number,
        start_ns,
        start_ns,
        states,
        noise(1),
        command,
        command,
        number,
        start_ns,
        100,
        "ACTIVE",
        wire=wire,
    )


def loss_of_one_kill(folder: Path, rng: np.random.Generator) -> tuple[float, int]:
    """Record, kill at a random moment, repair; return the loss [s] and the samples that remain."""
    clock = MonotonicClock()
    path = folder / "episode.mcap"
    handle = start_recorder(path, DESCRIPTION.to_json(), {"purpose": "measurement"})
    handle.wait_ready()
    begin_ns = clock.now_ns()
    kill_ns = begin_ns + round(rng.uniform(0.5, 2.0) * 1e9)
    last_ns = number = 0
    while (start_ns := begin_ns + number * CYCLE_NS) < kill_ns:
        clock.sleep_until_ns(start_ns)
        handle.control_socket.send(encode(cycle(number, start_ns, rng)))
        last_ns = start_ns
        number += 1
    clock.sleep_until_ns(kill_ns)
    handle.process.kill()
    handle.finish()
    repair(path)
    episode = read_episode(path)
    kept_ns = episode.start_ns + round(float(episode.trajectory.receive_s[-1]) * 1e9)
    path.unlink()
    return (last_ns - kept_ns) * 1e-9, episode.trajectory.receive_s.size


def main() -> None:
    """Print one line for each kill, then the worst."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    folder = Path(tempfile.mkdtemp(prefix="recorder-loss-"))
    losses = []
    try:
        for number in range(options.kills):
            loss_s, samples = loss_of_one_kill(folder, rng)
            losses.append(loss_s)
            print(f"kill {number + 1:3d}: lost {loss_s * 1e3:6.1f} ms, kept {samples} samples")
    finally:
        shutil.rmtree(folder)
    print(f"worst of {len(losses)}: {max(losses) * 1e3:.1f} ms (median {np.median(losses) * 1e3:.1f} ms)")


if __name__ == "__main__":
    main()
