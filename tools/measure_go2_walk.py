"""Lets a policy walk the emulated Go2 behind the safety filter, in virtual time: how well does it follow?

    python tools/measure_go2_walk.py --profile realistic --seeds 0 1 2
    python tools/measure_go2_walk.py --policy runs/train/policies/policy.onnx --rounds 35

Driver, wire format, filter, safety checks and control loop are those of `deal-hw deploy go2`; only time is
virtual, so that a busy machine changes nothing. A round asks for 1 m/s ahead, 0.5 m/s to the left and a turn
of 1 rad/s, 5 s each, and stands for 2 s before. Errors are those of the emulator's own truth: of the velocity
in the base's heading over one step of the gait, from 1 s after each change of the command on.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.cli.run_plan import shipped_policy
from deal_hw.clock import VirtualClock
from deal_hw.control.behaviours import PolicyBehaviour
from deal_hw.control.loop import ControlLoop, LoopConfig
from deal_hw.control.posture import PostureBehaviour, PostureConfig
from deal_hw.control.safety import Safety
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.profiles import PROFILES
from deal_hw.drivers.go2.emulator.truth import draw_truth, nominal_truth
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.types import FloatArray, RobotState

ROUND: Final = (
    ("stand", 2.0, (0.0, 0.0, 0.0)),
    ("ahead", 5.0, (1.0, 0.0, 0.0)),
    ("left", 5.0, (0.0, 0.5, 0.0)),
    ("turn", 5.0, (0.0, 0.0, 1.0)),
)
"""What is asked for: name, time [s], velocity ahead and to the left [m/s], turn [rad/s]."""
SETTLE_S: Final = 1.0
STEP_S: Final = 0.4
"""One step of the gait [s]."""
TICK_S: Final = 1e-3


class Rounds:
    """The wanted velocity at a time since the policy began; it notes when that was."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._ends = np.cumsum([seconds for _, seconds, _ in ROUND])
        self.began_ns = -1

    def part(self, time_s: float) -> int:
        """Return which part of a round it is."""
        return int(np.searchsorted(self._ends, time_s % self._ends[-1], side="right"))

    def velocity(self, state: RobotState, time_s: float) -> FloatArray:
        """Return the velocity of that part."""
        if self.began_ns < 0:
            self.began_ns = self._clock.now_ns() - round(time_s * 1e9)
        return np.array(ROUND[self.part(time_s)][2])


class Watched:
    """The emulated robot, with a note of where its base is at each tick."""

    def __init__(self, device: Go2Device, clock: VirtualClock) -> None:
        self._device, self._clock = device, clock
        self.places: list[tuple[float, float, float]] = []
        self.first_ns = -1

    @property
    def device_ns(self) -> int:
        """Device time [ns]."""
        return self._device.device_ns

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Pass a message on."""
        self._device.receive(topic, payload, stamp_ns)

    def tick(self) -> list[tuple[str, bytes]]:
        """Let the robot live."""
        out = self._device.tick()
        if self.first_ns < 0:
            self.first_ns = self._clock.now_ns()
        x, y, _ = self._device.base_position
        self.places.append((float(x), float(y), self._device.heading))
        return out


def walk(policy: OnnxPolicy, profile: str, seed: int | None, rounds: int) -> dict[str, Any]:
    """Walk some rounds with one robot.

    Args:
        policy: The policy.
        profile: The emulator's profile.
        seed: Of its hidden parameters; None: the nominal ones.
        rounds: How many.

    Returns:
        Plain JSON values: how the run ended, what was clipped, and mean errors by part [m/s, rad/s].
    """
    clock = VirtualClock(10**9)
    truth = nominal_truth(profile) if seed is None else draw_truth(profile, seed)
    watched = Watched(Go2Device(truth), clock)
    source = Rounds(clock)
    seconds = rounds * sum(part[1] for part in ROUND)
    whole = PostureBehaviour(PolicyBehaviour(policy, DRIVER, source), DRIVER, seconds, PostureConfig())
    robot = Go2Robot(VirtualTopics(watched, clock), clock)
    config = LoopConfig(duration_s=whole.duration_s)
    report = ControlLoop(robot, whole, Safety(DRIVER), clock, lambda record: True, config).run()
    return {
        "profile": profile, "seed": seed, "seconds": seconds, "outcome": report.outcome.value,
        "reason": report.reason, "clipped": report.clipped, "cycles": report.cycles_sent,
        **_errors(watched, source, seconds),
    }  # fmt: skip


def _errors(watched: Watched, source: Rounds, seconds: float) -> dict[str, Any]:
    step = round(STEP_S / TICK_S)
    places = np.array(watched.places)
    first = round((source.began_ns - watched.first_ns) * 1e-9 / TICK_S)
    places = places[first : first + round(seconds / TICK_S)]
    heading = np.unwrap(places[:, 2])
    moved = (places[step:, :2] - places[:-step, :2]) / STEP_S
    middle = heading[step // 2 :][: len(moved)]
    ahead = np.cos(middle) * moved[:, 0] + np.sin(middle) * moved[:, 1]
    left = np.cos(middle) * moved[:, 1] - np.sin(middle) * moved[:, 0]
    turn = (heading[step:] - heading[:-step]) / STEP_S
    found: dict[str, list[tuple[float, float, float, float, float]]] = {}
    begins = np.cumsum([0.0] + [part[1] for part in ROUND])
    for i in range(0, len(moved), 10):
        time_s = i * TICK_S
        part = source.part(time_s)
        since = time_s % begins[-1] - begins[part]
        if since < SETTLE_S or since + STEP_S > ROUND[part][1]:
            continue
        wanted = ROUND[part][2]
        off = np.hypot(ahead[i] - wanted[0], left[i] - wanted[1]), abs(turn[i] - wanted[2])
        found.setdefault(ROUND[part][0], []).append((*off, ahead[i], left[i], turn[i]))
    rows = {name: np.mean(values, axis=0).round(4).tolist() for name, values in found.items()}
    every = [value for name, values in found.items() if name != "stand" for value in values]
    over = np.mean(every, axis=0) if every else np.full(5, np.nan)
    return {
        "velocity_error_m_s": round(float(over[0]), 4),
        "yaw_error_rad_s": round(float(over[1]), 4),
        "parts": {
            name: dict(zip(("velocity_error", "yaw_error", "ahead", "left", "turn"), row, strict=True))
            for name, row in rows.items()
        },
    }


def main() -> None:
    """Walk as the command line says; print a row for each robot."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=shipped_policy("go2"))
    parser.add_argument("--profile", choices=sorted(PROFILES), default="realistic")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="none: the nominal robot")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write the rows to this JSON file, too")
    args = parser.parse_args()
    policy = OnnxPolicy(args.policy)
    rows = []
    for seed in args.seeds or [None]:
        rows.append(walk(policy, args.profile, seed, args.rounds))
        print(json.dumps(rows[-1]), flush=True)
    if args.out is not None:
        document = {"policy": policy.digest, "rows": rows}
        args.out.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
