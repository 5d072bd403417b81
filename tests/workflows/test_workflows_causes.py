"""Messages on late and corrupt states name this computer's load, and no cable where there is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from deal_hw.control.loop.timing import LoopTimingReport, Spread
from deal_hw.control.process.channel import Outcome
from deal_hw.control.process.supervisor import ChildEnd
from deal_hw.load import Load
from deal_hw.robots.connect import on_this_computer, spoilt_on_purpose
from deal_hw.workflows.causes import corrupt_advice, late_advice
from deal_hw.workflows.emulation.common import announced_faults
from deal_hw.workflows.emulation.settings import EmulateSettings
from deal_hw.workflows.running.episode import account

pytestmark = pytest.mark.real_time

BUSY, IDLE = Load(12.34, 2), Load(0.2, 4)


def test_the_load_is_counted_in_processors_that_may_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a container, not of the machine."""
    monkeypatch.setattr(os, "getloadavg", lambda: (12.34, 5.0, 1.0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 3})
    assert Load.now() == BUSY and str(BUSY) == "load 12.3 on 2 processors"
    assert BUSY.high and not IDLE.high and str(Load(1.0, 1)) == "load 1.0 on 1 processor"


def test_each_cause_fits_the_wire() -> None:
    """The cable is named for a real robot only; a busy computer comes before it."""
    assert "no cable is at fault" in late_advice(True, BUSY) and "end other programs" in late_advice(
        True, BUSY
    )
    assert late_advice(False, BUSY).startswith("load 12.3 on 2 processors: this computer is busy")
    assert "check cable" in late_advice(False, IDLE) and "busy" not in late_advice(False, IDLE)
    assert "no cable is at fault" in corrupt_advice(True, BUSY) and str(BUSY) in corrupt_advice(True, BUSY)
    assert "another program uses its port" in corrupt_advice(True, BUSY)
    assert "check cable" in corrupt_advice(False, BUSY)


def test_only_an_emulator_that_says_so_spoils_frames() -> None:
    """Else another program, or a busy computer, would be taken for it."""
    for local in (True, False):
        assert "on purpose" not in corrupt_advice(local, BUSY)
        assert "--corrupt" in corrupt_advice(local, BUSY, spoilt=True)


@pytest.mark.parametrize(
    ("rates", "loses", "spoils"),
    [
        ({}, False, False),
        ({"corrupt": 0.1}, False, True),
        ({"drop": 0.1}, False, True),
        ({"duplicate": 0.1}, False, True),
        ({}, True, True),
    ],
)
def test_an_emulator_says_whether_it_spoils_frames(
    rates: dict[str, float], loses: bool, spoils: bool, tmp_path: Path
) -> None:
    """While it runs, by any spelling of its port; two emulators at one place both may."""
    link = tmp_path / "robot"
    link.symlink_to("/dev/pts/7777")
    config = EmulateSettings("cartpole", **rates)  # type: ignore[arg-type]
    for _ in range(2):
        with (
            announced_faults(config, "serial", "/dev/pts/7777", loses=loses),
            announced_faults(config, "serial", "/dev/pts/7777", loses=loses),
        ):
            assert spoilt_on_purpose("serial", str(link)).held is spoils
            assert not spoilt_on_purpose("serial", "/dev/pts/7778").held
        assert not spoilt_on_purpose("serial", str(link)).held


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_run_with_lost_states_says_whether_the_emulator_lost_them(spoilt: bool) -> None:
    """In its warning on transport errors."""
    none = Spread(0.0, 0.0, 0.0)
    timing = LoopTimingReport(
        rate_hz=50.0,
        cycles=50,
        period=none,
        lateness=none,
        overruns=0,
        overruns_beyond_period=0,
        skipped_periods=0,
        state_age=none,
        states=100,
        transport_errors=30,
    )
    result = {
        "outcome": "finished",
        "reason": "",
        "passive_confirmed": True,
        "loop_timing": timing.to_json(),
        "clipped": {},
        "cycles_sent": 7,
        "error": "",
        "flags": [],
    }
    end = ChildEnd(
        result=result,
        exit_code=0,
        killed="",
        stop_cause="",
        passive_confirmed=True,
        recorder=None,
        signal="",
    )
    (warning,) = account(end, None, "", True, spoilt).warnings
    assert "30 transport errors" in warning and ("on purpose" in warning) is spoilt


@pytest.mark.parametrize(
    ("transport", "port", "local"),
    [
        ("serial", "/dev/ttyUSB0", False),
        ("serial", "/dev/pts/7", True),
        ("dynamixel", "/dev/pts/7?baud=1000000", True),
        ("can", "slcan:/dev/pts/3?bitrate=500000&node=1", True),
        ("can", "slcan:/dev/ttyACM0?bitrate=500000&node=1", False),
        ("odrive", "can0?node=1", False),
        ("odrive", "vcan0?node=1", True),
        ("dds", "lo", True),
        ("dds", "nope0", False),
        ("zenoh", "tcp/127.0.0.1:7447", True),
        ("zenoh", "tcp/192.168.1.20:7447", False),
    ],
)
def test_a_port_says_whether_there_is_a_cable(transport: str, port: str, local: bool) -> None:
    """A pseudo-terminal, a virtual bus and the loopback have none."""
    assert on_this_computer(transport, port) is local


def test_a_link_to_an_emulator_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`emulate --link` makes one."""
    (tmp_path / "robot").symlink_to("/dev/pts/7")
    assert on_this_computer("serial", str(tmp_path / "robot"))
    monkeypatch.chdir(tmp_path)
    assert on_this_computer("serial", "robot")


@pytest.mark.parametrize(("flag", "reported"), [("state_stale", True), ("velocity", False)])
def test_a_run_that_tripped_on_late_states_names_the_load(
    flag: str, reported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motion's own limits have nothing to do with it."""
    monkeypatch.setattr(Load, "now", classmethod(lambda cls: BUSY))
    result = {
        "outcome": "tripped",
        "reason": "the newest state is 76 ms old, at most 50 ms are allowed",
        "passive_confirmed": True,
        "loop_timing": None,
        "clipped": {},
        "cycles_sent": 7,
        "error": "",
        "flags": [flag],
    }
    end = ChildEnd(
        result=result,
        exit_code=0,
        killed="",
        stop_cause="",
        passive_confirmed=True,
        recorder=None,
        signal="",
    )
    report = account(end, None, "", True)
    assert report.outcome is Outcome.TRIPPED and report.flags == (flag,)
    assert any(str(BUSY) in warning for warning in report.warnings) is reported
