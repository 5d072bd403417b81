"""`deal-hw doctor`: each finding with its remedy, and an exit code for scripts."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deal_hw.cli import doctor as verb
from deal_hw.cli import doctor_machine as machine
from deal_hw.cli.doctor import Doctor, doctor
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.findings import Finding, Level


def levels(findings: Iterator[Finding] | tuple[Finding, ...], area: str) -> set[Level]:
    """Return the levels of an area's findings."""
    return {f.level for f in findings if f.area == area}


def test_this_computer_is_examined(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Every area is looked at, the file has the same findings, and what is wrong has a remedy."""
    out = tmp_path / "findings.json"
    report = doctor(Doctor(json=out))
    areas = {f.area for f in report.findings}
    assert areas >= {"system", "packages", "scheduling", "memory", "clock", "network", "interfaces"}
    assert json.loads(out.read_text()) == [f.to_json() for f in report.findings]
    assert all(f.remedy for f in report.findings if f.level in (Level.WARN, Level.FAIL))
    said = capsys.readouterr()
    assert all(f.message in said.out for f in report.findings)
    assert "all is well" in said.err or "worst:" in said.err


def test_nothing_heavy_is_loaded() -> None:
    """It runs on the robot's own computer: neither torch nor mujoco, and no DDS where none is asked for."""
    code = (
        "import sys\n"
        "from deal_hw.cli.doctor import Doctor, doctor\n"
        "doctor(Doctor())\n"
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
    monkeypatch.setattr(machine, "PACKAGES", (("no-such", "dds"), ("none", "")))
    monkeypatch.setattr(
        machine, "_read", lambda path: {"rmem_max": "1000"}.get(path.rpartition("/")[2], "acpi_pm")
    )
    findings = tuple(machine.examine_machine())
    assert levels(findings, "scheduling") == levels(findings, "memory") == {Level.WARN}
    assert levels(findings, "packages") == {Level.NOTE, Level.FAIL}
    assert levels(findings, "network") == {Level.WARN}
    text = " ".join(f.remedy for f in findings)
    for word in ("limits.conf", "rtprio", "memlock", "deal-hw[dds]", "rmem_max", "tsc"):
        assert word in text


def test_a_robot_that_is_not_there_is_a_finding(capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong endpoint or interface is told like everything else, and the exit code says so."""
    for transport, port in (("zenoh", "tcp/127.0.0.1:1"), ("dds", "nope0")):
        report = doctor(Doctor(robot="go2", transport=transport, port=port))
        assert report.exit_code == 1
        assert levels(report.findings, "link") == {Level.FAIL}
        assert port in capsys.readouterr().out


def test_settings_that_do_not_fit_are_refused() -> None:
    """A robot needs a port, a serial robot has no checks here, an unknown one is named."""
    with pytest.raises(ConfigurationError, match="or neither"):
        Doctor(robot="go2")
    with pytest.raises(ConfigurationError, match=r"allowed are 0.5 to 600 s"):
        Doctor(seconds=0.0)
    with pytest.raises(ConfigurationError, match="dry-run"):
        doctor(Doctor(robot="cartpole", port="/dev/null"))
    with pytest.raises(UnknownNameError, match="go2"):
        doctor(Doctor(robot="gotwo", port="lo"))


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
    found = list(verb._interfaces("192.168.123.99"))
    assert [f.level for f in found] == [Level.FAIL, Level.WARN, Level.OK]
    assert "cable" in found[0].remedy
    assert "multicast on" in found[1].remedy
