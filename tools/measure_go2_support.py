"""Measure the signals that distinguish floor and stand, for ``deal_hw.drivers.unitree.support``.

    python tools/measure_go2_support.py --out docs/measured/go2_support.json

prints a table with their range over seeds and profiles, for each situation.
"""

from __future__ import annotations

import itertools

import numpy as np
from measuring import Rows, line, markdown, parser

from deal_hw.drivers.go2.descriptions.leg_geometry import GEOMETRY, SUPPORT
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import draw_truth
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.support import read_support

SITUATIONS = {
    "lying, limp": {"sport": ""},
    "lying, sport mode": {"sport": "normal"},
    "standing, sport mode": {"start": "standing"},
    "on a stand, limp": {"on_stand": True, "sport": ""},
    "on a stand, sport mode damps": {"on_stand": True},
    "on a stand, sport mode stands": {"on_stand": True, "start": "standing"},
}
WINDOW_MS = 300
COLUMNS = ("reach_m", "third_foot_m", "load_n", "foot_sensors", "fastest_joint_rad_s")


def window(device: Go2Device, after_ms: int) -> list[LowStateFrame]:
    """Return the states of 0.3 s, at a time after the start."""
    sent = device.advance_to((after_ms + WINDOW_MS) * 1_000_000)
    states = [decode_low_state(payload) for topic, payload in sent if topic == topics.LOW_STATE]
    return states[-WINDOW_MS // 2 :]


def main() -> None:
    """Print the table."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, default=5)
    options = made.parse_args()
    found = Rows(__file__, options.out)
    heads = ("reach [m]", "third foot [m]", "load [N]", "foot sensors", "fastest joint")
    print(markdown(("situation", "answers", *heads), ()))
    for name, settings in SITUATIONS.items():
        rows, answers = [], set()
        for profile, seed in itertools.product(("sensor", "realistic"), range(options.seeds)):
            states = window(Go2Device(draw_truth(profile, seed), **settings), 500)  # type: ignore[arg-type]
            answer = read_support(states, SUPPORT).support.value
            answers.add(answer)
            position = np.median([state.position for state in states], axis=0)
            effort = np.median([state.effort for state in states], axis=0)
            reach = -GEOMETRY.foot_positions(position)[:, 2]
            speed = np.abs(np.median([state.velocity for state in states], axis=0)).max()
            feet = np.median([state.foot_force for state in states], axis=0)
            rows.append(
                (
                    reach.mean(),
                    np.sort(reach)[1],
                    GEOMETRY.foot_loads(position, effort)[:, 2].sum(),
                    feet.max(),
                    speed,
                )
            )
            values = dict(zip(COLUMNS, map(float, rows[-1]), strict=True))
            found.add({"situation": name, "profile": profile, "seed": seed, "answer": answer, **values}, "")
        low, high = np.min(rows, axis=0), np.max(rows, axis=0)
        cells = [f"{a:.{n}f} to {b:.{n}f}" for a, b, n in zip(low, high, (3, 3, 1, 0, 2), strict=True)]
        print(line(name, ", ".join(sorted(answers)), *cells))


if __name__ == "__main__":
    main()
