"""The PC class of SensorsINI's physical-cartpole at a port: the cart is calibrated, read and pushed.

    bench_cartpole.py PORT

The calls are those of its driver: ping, calibrate, states, a motor command and its end.
"""

from __future__ import annotations

import sys
import time

from interface import Interface

_BAUD_RATE = 230_400
_PUSH, _PUSH_S = 1500, 0.4
"""A motor command [PWM counts of 7200] and how long it is sent [s]: the cart moves a quarter of the track."""
_POSITION, _MOTOR = 2, 4
"""Places in what read_state returns."""


def main() -> int:
    """Return 0 if the cart is pushed as commanded."""
    link = Interface()
    link.open(sys.argv[1], _BAUD_RATE)
    print("ping answered:", link.ping())
    print("calibrated:", link.calibrate(), "encoder direction:", link.encoderDirection)
    link.stream_output(True)
    link.set_config_control(20, False, 0.0, 10, False)
    at = link.read_state()[_POSITION]
    begin_s, seen = time.monotonic(), []
    while time.monotonic() - begin_s < _PUSH_S:
        link.set_motor(_PUSH)
        seen.append(link.read_state())
    link.set_motor(0)
    moved = seen[-1][_POSITION] - at
    print(f"{len(seen)} states, motor commands {sorted({state[_MOTOR] for state in seen[2:]})}")
    print(f"moved by {moved} counts")
    link.close()
    return 0 if moved > 0 else 1


if __name__ == "__main__":
    sys.exit(main())
