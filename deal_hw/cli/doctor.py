"""``deal-hw doctor``: check this computer, the connection and the robot, and advise what to do."""

from __future__ import annotations

import json
import shutil
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

from deal_hw.findings import Finding, Severity
from deal_hw.workflows.doctor.examine import DOCTOR, DoctorReport, DoctorSettings, examine

_MARKS = {Severity.OK: "ok  ", Severity.NOTE: "note", Severity.WARN: "WARN", Severity.FAIL: "FAIL"}


@dataclass(frozen=True, kw_only=True)
class JsonFile:
    """What only the command line has."""

    json: Path | None = None
    """Write the findings to this file."""


KINDS = DOCTOR.with_options(JsonFile)


def doctor(config: DoctorSettings) -> DoctorReport:
    """Run the checks and print each finding at once.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: The robot is not reached that way.
    """
    found: list[Finding] = []
    area = ""
    for finding in examine(config):
        if finding.code != area:
            area = finding.code
            print(area)
        print(_wrapped(f"  {_MARKS[finding.severity]}  ", finding.seen), flush=True)
        if finding.do:
            print(_wrapped("        -> ", finding.do))
        found.append(finding)
    report = DoctorReport(findings=tuple(found))
    if isinstance(config, JsonFile) and config.json is not None:
        rows = [{"area": f.code, "level": f.severity.value, "message": f.seen, "remedy": f.do} for f in found]
        config.json.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    worst = [level for level in (Severity.FAIL, Severity.WARN) if any(f.severity is level for f in found)]
    print("all is well" if not worst else f"worst: {worst[0].value}", file=sys.stderr)
    return report


def _wrapped(lead: str, text: str) -> str:
    """Return a text after its lead, wrapped to the terminal's width."""
    width = shutil.get_terminal_size().columns
    return textwrap.fill(
        text,
        max(width, 60),
        initial_indent=lead,
        subsequent_indent=" " * len(lead),
        break_long_words=False,
        break_on_hyphens=False,
    )
