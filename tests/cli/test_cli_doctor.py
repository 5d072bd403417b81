"""`deal-hw doctor`: each finding with its remedy, and an exit code for scripts."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from deal_hw.cli import doctor as verb
from deal_hw.cli.doctor import KINDS as DOCTOR
from deal_hw.cli.doctor import doctor
from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.findings import Finding, Severity
from deal_hw.sim.engine import gpu, warp_check
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults
from deal_hw.workflows.doctor import machine
from deal_hw.workflows.doctor.examine import DoctorReport, examine_robot, judge_interfaces

pytestmark = pytest.mark.real_time


def levels(findings: Iterator[Finding] | tuple[Finding, ...], area: str) -> set[Severity]:
    """Return the levels of an area's findings."""
    return {f.severity for f in findings if f.code == area}


def test_this_computer_is_examined(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Every area is looked at, the file has the same findings, and what is wrong has a remedy."""
    out = tmp_path / "findings.json"
    report = doctor(DOCTOR.settings(json=out))
    areas = {f.code for f in report.findings}
    assert areas >= {"system", "packages", "scheduling", "memory", "clock", "network", "interfaces"}
    assert json.loads(out.read_text()) == [
        {"area": f.code, "level": f.severity.value, "message": f.seen, "remedy": f.do}
        for f in report.findings
    ]
    assert all(f.do for f in report.findings if f.severity in (Severity.WARN, Severity.FAIL))
    printed = capsys.readouterr()
    words = " ".join(printed.out.split())
    assert all(" ".join(f.seen.split()) in words for f in report.findings)
    assert "all is well" in printed.err or "worst:" in printed.err


def test_nothing_heavy_is_loaded() -> None:
    """It runs on the robot's own computer: neither torch nor mujoco, and no DDS where none is asked for."""
    code = (
        "import sys\n"
        "from deal_hw.cli.doctor import KINDS as DOCTOR, doctor\n"
        "doctor(DOCTOR.settings())\n"
        "heavy = ('torch', 'mujoco', 'scipy', 'rerun', 'cyclonedds', 'zenoh')\n"
        "print([m for m in heavy if m in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_what_is_refused_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without rights, scheduling and memory name the file to edit; without a package, its extra."""
    monkeypatch.setattr(os, "fork", lambda: 1)
    monkeypatch.setattr(os, "waitpid", lambda pid, options: (pid, 256))
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (8 << 20, 8 << 20))
    monkeypatch.setattr(
        machine, "_read", lambda path: {"rmem_max": "1000"}.get(path.rpartition("/")[2], "acpi_pm")
    )
    findings = tuple(machine.examine_machine([("no-such", "dds")]))
    assert levels(findings, "scheduling") == levels(findings, "memory") == {Severity.WARN}
    assert levels(findings, "packages") == {Severity.NOTE}
    assert levels(findings, "network") == {Severity.WARN}
    text = " ".join(f.do for f in findings)
    for word in ("limits.conf", "rtprio", "memlock", "[dds]", "rmem_max", "tsc"):
        assert word in text


@pytest.mark.parametrize(
    ("version", "problem", "found"),
    [("", "", []), ("4.0.0", "", [Severity.OK]), ("4.0.0", "no NVIDIA driver is installed", [Severity.NOTE])],
)
def test_a_gpu_is_looked_for_where_its_packages_are(
    monkeypatch: pytest.MonkeyPatch, version: str, problem: str, found: list[Severity]
) -> None:
    """Without MuJoCo Warp nothing is said; without a GPU, why --engine warp is refused."""
    monkeypatch.setattr(machine, "_version", lambda name: version)
    monkeypatch.setattr(gpu, "gpu_problem", lambda: problem)
    monkeypatch.setattr(warp_check, "difference_from_mujoco", lambda: 1e-7)
    findings = list(machine._gpu())
    assert [finding.severity for finding in findings] == found
    assert all(problem in finding.seen for finding in findings)


@pytest.mark.parametrize(
    ("difference", "severity", "words"),
    [
        (1.6e-7, Severity.OK, "to 2e-07 rad"),
        (0.01, Severity.WARN, "less than 1e-05 rad is expected"),
        (float("nan"), Severity.WARN, "less than 1e-05 rad is expected"),
        (RuntimeError("CUDA error 35"), Severity.WARN, "cannot simulate a pendulum: CUDA error 35"),
    ],
)
def test_a_gpu_is_compared_with_mujoco(
    monkeypatch: pytest.MonkeyPatch, difference: float | Exception, severity: Severity, words: str
) -> None:
    """An error and a difference have a remedy."""

    def compared() -> float:
        if isinstance(difference, Exception):
            raise difference
        return difference

    monkeypatch.setattr(machine, "_version", lambda name: "4.0.0")
    monkeypatch.setattr(gpu, "gpu_problem", lambda: "")
    monkeypatch.setattr(warp_check, "difference_from_mujoco", compared)
    (finding,) = machine._gpu()
    assert finding.severity is severity and words in f"{finding.seen}; {finding.do}"


def test_a_robot_that_is_not_there_is_a_finding(capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong endpoint or interface is reported like everything else, and the exit code says so."""
    for robot, transport, port in (
        ("go2", "zenoh", "tcp/127.0.0.1:1"),
        ("go2", "dds", "nope0"),
        ("cartpole", "serial", "/dev/ttyNONE7"),
    ):
        report = doctor(DOCTOR.settings(robot=robot, transport=transport, port=port))
        assert report.exit_code == 1
        assert levels(report.findings, "link") == {Severity.FAIL}
        assert port in capsys.readouterr().out


def test_settings_that_do_not_fit_are_refused() -> None:
    """A robot needs a port, an unknown one is named."""
    with pytest.raises(TypeError, match=r"missing a required (keyword-only )?argument: 'port'"):
        DOCTOR.settings(robot="go2")
    with pytest.raises(ConfigurationError, match=r"allowed are 0.5 to 600 s"):
        DOCTOR.settings("go2", port="lo", seconds=0.0)
    with pytest.raises(UnknownNameError, match="go2"):
        doctor(DOCTOR.settings(robot="gotwo", port="lo"))


def test_a_cable_that_is_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """The chosen interface without carrier fails; another one without multicast warns."""
    from deal_hw.drivers.transports import interfaces
    from deal_hw.drivers.transports.interfaces import Interface

    known = (
        Interface("enp2s0", ("192.168.123.99",), up=True, carrier=False, multicast=True, loopback=False),
        Interface("wlan0", ("10.0.0.2",), up=True, carrier=True, multicast=False, loopback=False),
        Interface("lo", ("127.0.0.1",), up=True, carrier=True, multicast=False, loopback=True),
    )
    monkeypatch.setattr(interfaces, "list_interfaces", lambda: known)
    found = list(judge_interfaces("192.168.123.99"))
    assert [f.severity for f in found] == [Severity.FAIL, Severity.WARN, Severity.OK]
    (lo,) = [f for f in judge_interfaces("127.0.0.1") if f.seen.startswith("lo ")]
    assert (lo.severity, "ip link set lo multicast on" in lo.do) == (Severity.NOTE, True)
    assert "cable" in found[0].do
    assert "multicast on" in found[1].do


def listened(
    drop: float = 0.0, corrupt: float = 0.0, local: bool = False, spoilt: bool = False
) -> list[Finding]:
    """Return what is found on an emulated cart-pole that loses or spoils a share of its frames."""
    clock = VirtualClock()
    faults = FrameFaults(FaultRates(drop=drop, corrupt=corrupt), np.random.default_rng(0))
    wire = FaultyTransport(
        VirtualTransport(CartpoleDevice(nominal_truth("ideal")), clock), faults, clock=clock
    )
    return list(examine_robot("cartpole", CartpoleRobot(wire, clock), clock, 2.0, local, spoilt))


def test_a_serial_robot_is_greeted_and_listened_to() -> None:
    """Who it is, its states, the link's errors and its clock; its motor stays off."""
    found = listened()
    assert {f.severity for f in found} == {Severity.OK}
    text = "; ".join(f.seen for f in found)
    for words in ("firmware (", "200 states a second of 200", "0 of 40", "+0.00 %"):
        assert words in text


def test_a_bad_serial_cable_is_a_warning() -> None:
    """A fifth of the frames lost: fewer states, and their share."""
    found = [f for f in listened(0.2) if f.code == "states"]
    assert [f.severity for f in found] == [Severity.WARN, Severity.WARN, Severity.OK]
    assert all("cable" in f.do for f in found[:2])


@pytest.mark.parametrize(("local", "spoilt"), [(False, False), (True, False), (True, True)])
def test_a_link_on_which_no_run_lasts_is_a_failure(local: bool, spoilt: bool) -> None:
    """Three frames of ten corrupt, 46 % of the states: the exit code says so; an emulator has no cable."""
    found = listened(corrupt=0.3, local=local, spoilt=spoilt)
    assert DoctorReport(findings=tuple(found)).exit_code == 1
    (worst,) = [finding for finding in found if finding.severity is Severity.FAIL]
    assert "a run trips at 30%" in worst.seen
    assert ("check cable" in worst.do) is not local and ("--corrupt" in worst.do) is spoilt


def test_what_is_printed_fits_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 columns, but for words that are longer; the second line of a remedy is below its first."""
    long = Finding("states", Severity.FAIL, "word " * 40, "remedy " * 30)
    monkeypatch.setattr(verb, "examine", lambda config: iter([long]))
    monkeypatch.setenv("COLUMNS", "80")
    assert doctor(DOCTOR.settings()).exit_code == 1
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) == 1 + 3 + 3
