"""Measure the cost of an episode's standard messages: bytes a second, the recorder's time for a cycle.

    python tools/measure_recording_size.py --out FILE.json

The cart-pole has 4 state samples in a cycle of 20 ms. The Go2 has 10, and its body's sensors. Numbers are
noisy, as on a robot: repeated ones would compress to nothing.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from measuring import Rows, parser

from deal_hw.clock import VirtualClock
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.recording.schemas import STANDARD
from deal_hw.robots import recorded_description
from deal_hw.transport import Message
from deal_hw.types import BodyState, JointCommand, RobotState, Status

CYCLE_NS = 20_000_000
START_NS = 1_000_000_000_000


def body(rng: np.random.Generator, joints: int) -> BodyState:
    """Return the sensor values of a robot with legs."""
    return BodyState(
        orientation=np.array([1.0, 0.0, 0.0, 0.0]) + rng.normal(0, 1e-3, 4),
        angular_velocity=rng.normal(size=3),
        acceleration=rng.normal(size=3),
        foot_force=rng.integers(0, 100, 4).astype(float),
        temperature=np.full(joints, 40.0),
        lost=np.zeros(joints, dtype=np.int64),
        battery=0.8,
        voltage=28.0,
        current=1.0,
        sticks=np.zeros(4),
        buttons=0,
    )


def cycles(robot: str, count: int, rng: np.random.Generator) -> list[CycleRecord]:
    """Return cycles of a robot; the Go2 counts in float32, as its messages do."""
    description = recorded_description(robot)
    J, A = len(description.joint_names), len(description.actuated)
    legs, samples = robot == "go2", 10 if robot == "go2" else 4
    wire = (400, 780) if legs else (30, 0)

    def number(values: Any) -> Any:
        return values.astype(np.float32).astype(float) if legs else values

    def state(sample: int) -> RobotState:
        time_s, stamp_ns = sample / (50 * samples), START_NS + sample * CYCLE_NS // samples
        return RobotState(
            position=number(np.sin(np.arange(1, J + 1) * time_s) + rng.normal(0, 1e-3, J)),
            velocity=number(np.cos(np.arange(1, J + 1) * time_s) + rng.normal(0, 0.02, J)),
            effort=number(rng.normal(size=J)),
            receive_ns=stamp_ns + int(rng.integers(0, 300_000)),
            device_ns=stamp_ns,
            sequence=sample,
            command_sequence=sample // samples,
            command_age_ns=1000,
            status=Status.ARMED,
            body=body(rng, J) if legs else None,
        )

    def command(target: Any) -> JointCommand:
        gains = (np.zeros(A), np.full(A, 40.0), np.full(A, 1.0), np.zeros(A), np.full(A, 23.0))
        return JointCommand(target, *gains, np.full(A, np.inf))

    made = []
    for cycle in range(count):
        start_ns = START_NS + cycle * CYCLE_NS
        target = np.sin(np.arange(1, A + 1) * cycle / 50) + rng.normal(0, 0.01, A)
        received = [Message("rx", rng.bytes(wire[0]) + bytes(wire[1]), start_ns) for _ in range(samples)]
        made.append(
            CycleRecord(
                cycle=cycle,
                deadline_ns=start_ns,
                start_ns=start_ns,
                states=tuple(state(cycle * samples + k) for k in range(samples)),
                action=target,
                requested=command(target),
                sent=command(np.clip(target, -0.9, 0.9)),
                sent_sequence=cycle,
                sent_ns=start_ns + 10_000,
                safety_state="ACTIVE",
                wire=(*received, Message("tx", rng.bytes(wire[0] // 4) + bytes(wire[1]), start_ns)),
            )
        )
    return made


def record(robot: str, made: list[CycleRecord], left_out: frozenset[str]) -> tuple[float, float]:
    """Write cycles without some topics; return bytes a second, and processor time a cycle [ms]."""
    add = EpisodeRecorder._add

    def filtered(self: EpisodeRecorder, topic: str, *rest: Any) -> None:
        if topic not in left_out:
            add(self, topic, *rest)

    with tempfile.TemporaryDirectory() as folder, mock.patch.object(EpisodeRecorder, "_add", filtered):
        path, clock = Path(folder) / "episode.mcap", VirtualClock(START_NS)
        with EpisodeRecorder(path, recorded_description(robot).to_json(), {}, clock) as recorder:
            began = time.process_time()
            for cycle in made:
                clock.sleep_until_ns(cycle.start_ns + CYCLE_NS)
                recorder.write(cycle)
            spent_s = time.process_time() - began
        return path.stat().st_size / (len(made) * CYCLE_NS * 1e-9), 1e3 * spent_s / len(made)


def main() -> None:
    """Print a line for each robot."""
    known = parser(__doc__)
    known.add_argument("--seconds", type=float, default=10.0, help="length of each recording")
    options = known.parse_args()
    rows = Rows(__file__, options.out)
    for robot in ("cartpole", "go2"):
        made = cycles(robot, round(options.seconds * 50), np.random.default_rng(0))
        without, with_ = record(robot, made, frozenset(STANDARD)), record(robot, made, frozenset())
        printed = (
            f"{robot}: {without[0] / 1e3:.1f} kB/s without, {with_[0] / 1e3:.1f} with standard messages: "
            f"{with_[0] / without[0]:.2f} times; {without[1]:.3f} and {with_[1]:.3f} ms a cycle"
        )
        sizes = {"bytes_per_second": without[0], "with_standard_messages": with_[0]}
        times = {"ms_per_cycle": without[1], "ms_with_standard_messages": with_[1]}
        rows.add({"robot": robot, **sizes, **times}, printed)


if __name__ == "__main__":
    main()
