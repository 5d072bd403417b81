"""The vendor's example programs against the emulator and the simulator's stand-in, as frames.

Read from unitree_sdk2_python @ 9b05080 (go2_stand_example.py) and unitree_mujoco @ 0304726 (stand_go2.py):
which messages, which numbers, how often. The programs themselves need the vendor's SDK on Cyclone DDS 0.10.2.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from fakes.unitree_mujoco import UnitreeMujoco

from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.go2.messages.wire import SLOT
from deal_hw.drivers.transports import topics
from deal_hw.types import FloatArray

PERIOD_MS = 2
LYING = (0.0, 1.36, -2.65, 0.0, 1.36, -2.65, -0.2, 1.36, -2.65, 0.2, 1.36, -2.65)
UP = (0.0, 0.67, -1.3) * 4
SPREAD = (-0.35, 1.36, -2.65, 0.35, 1.36, -2.65, -0.5, 1.36, -2.65, 0.5, 1.36, -2.65)
"""Poses of the SDK's example, in the order of the wire (legs FR, FL, RR, RL) [rad]."""
SIMULATOR_UP = (0.00571868, 0.608813, -1.21763, -0.00571868, 0.608813, -1.21763) * 2
SIMULATOR_DOWN = (0.0473455, 1.22187, -2.44375, -0.0473455, 1.22187, -2.44375) * 2
"""Those of the simulator's."""


def frame(pose: FloatArray, stiffness: float, damping: float) -> bytes:
    """Return the frame that holds a pose given in the order of the wire, (12,) [rad]."""
    zero = np.zeros(12)
    command = LowCommand(pose[SLOT], zero, np.full(12, stiffness), np.full(12, damping), zero)
    return LowCommandEncoder().encode(command)


def sdk_stand(start: FloatArray) -> Iterator[bytes]:
    """Yield the frames of the SDK's example: to lying, up, hold, to lying with the legs spread."""
    lying, up, spread = np.array(LYING), np.array(UP), np.array(SPREAD)
    for begin, end, count in ((start, lying, 500), (lying, up, 500), (up, up, 1000), (up, spread, 900)):
        for share in np.arange(1, count + 1) / count:
            yield frame((1.0 - share) * begin + share * end, 60.0, 5.0)


def simulator_stand(seconds: float) -> Iterator[bytes]:
    """Yield the frames of the simulator's example: up for 3 s, then down."""
    up, down = np.array(SIMULATOR_UP), np.array(SIMULATOR_DOWN)
    for now_s in np.arange(PERIOD_MS * 1e-3, seconds, PERIOD_MS * 1e-3):
        rises = now_s < 3.0
        phase = math.tanh((now_s if rises else now_s - 3.0) / 1.2)
        high = phase if rises else 1.0 - phase
        yield frame(high * up + (1.0 - high) * down, 20.0 + 30.0 * phase if rises else 50.0, 3.5)


def play(bench: Any, frames: Iterator[bytes]) -> tuple[FloatArray, FloatArray]:
    """Send a frame every 2 ms; return the base's heights [m] and the fastest joints [rad/s]."""
    seen = []
    for payload in frames:
        bench.device.receive(topics.LOW_COMMAND, payload)
        (state,) = bench.run(PERIOD_MS)
        seen.append((bench.device.base_height, np.abs(state.velocity).max()))
    heights, speeds = np.array(seen).T
    return heights, speeds


def test_the_sdks_stand_example(make_go2: Any) -> None:
    """It releases sport mode as the example does, stands, and lies down; no command is refused."""
    bench = make_go2(sport="ai")
    while bench.mode():
        assert bench.call("sport", 1005).code == 0
        assert bench.call("motion_switcher", 1003).code == 0
        bench.run(1000)
    start = bench.run(PERIOD_MS)[0].position
    heights, _ = play(bench, sdk_stand(start[np.argsort(SLOT)]))
    commands = bench.device.report()["commands"]
    assert (commands["accepted"], commands["refused"]) == (2900, 0)
    assert heights[1000:2000].max() > 0.3 and heights[1999] == pytest.approx(0.337, abs=0.02)
    assert heights[-1] < 0.15


def test_the_simulators_stand_example_on_the_emulator(make_go2: Any) -> None:
    """It releases nothing: without sport mode it stands; with it, the two fight."""
    heights, quiet = play(make_go2(sport=""), simulator_stand(3.0))
    assert heights[-1] == pytest.approx(0.333, abs=0.02)
    _, fought = play(make_go2(sport="normal", start="standing"), simulator_stand(3.0))
    shaking = [np.abs(np.diff(speeds[:250])).mean() for speeds in (fought, quiet)]
    assert shaking[0] > 10 * shaking[1]


def test_the_simulators_stand_example_on_its_stand_in() -> None:
    """It stands and lies down; torques are found once a frame, every two milliseconds."""
    device = UnitreeMujoco(np.array(DRIVER.rest_position))
    thigh = []
    for payload in simulator_stand(6.0):
        device.receive(topics.LOW_COMMAND, payload)
        device.tick()
        device.tick()
        thigh.append(float(device.position[1]))
    assert thigh[1490] == pytest.approx(0.66, abs=0.1)
    assert thigh[-1] > 1.1


def test_the_sport_clients_calls(make_go2: Any) -> None:
    """Version, StandUp, BalanceStand, Move and StopMove are answered with 0."""
    bench = make_go2(sport="normal")
    for api, parameter in ((1, {}), (1004, {}), (1002, {}), (1008, {"x": 0.3, "y": 0, "z": 0}), (1003, {})):
        answer = bench.call("sport", api, parameter)
        assert (answer.code, answer.api) == (0, api)
        bench.run(1600)
    assert bench.device.base_height > 0.31


def test_a_state_reader_gets_the_motors_in_the_order_of_the_wire(make_go2: Any) -> None:
    """Slot 0 is the hip of the right front leg; twenty motors are there, eight of them empty."""
    bench = make_go2(sport="normal", start="standing")
    bench.run(PERIOD_MS)
    payload = next(p for t, p in bench.out if t == topics.LOW_STATE)
    slots = [np.frombuffer(payload, "<f4", 1, 84 + 48 * slot)[0] for slot in range(20)]
    np.testing.assert_allclose(np.array(slots[:12])[SLOT], decode_low_state(payload).position)
    assert slots[12:] == [0.0] * 8


def test_the_examples_first_frame_is_that_of_the_sdk() -> None:
    """All twenty motors in servo mode; those that are not commanded have the vendor's stop values."""
    payload = frame(np.array(UP), 60.0, 5.0)
    assert payload[4:7] == b"\xfe\xef\xff"
    modes = [payload[26], *(payload[60 + 36 * slot] for slot in range(19))]
    assert modes == [1] * 20
    spare = np.frombuffer(payload, "<f4", 2, 28 + 36 * 12)
    np.testing.assert_allclose(spare, (2.146e9, 16000.0))
    np.testing.assert_allclose(decode_low_command(payload).position[3:6], UP[:3], rtol=1e-6)
