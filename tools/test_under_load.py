#!/usr/bin/env python3
"""Run tests beside processes that keep the processors busy, several times, and list the failures.

python tools/test_under_load.py
python tools/test_under_load.py --loops 10 --repetitions 3 tests/control -m "not slow"

What is not an option of this program goes to pytest. Without it the tests of `make test` run.
The exit code is 1 where a test failed in one of the runs.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

DEFAULT = ("-m", "not slow")
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
"""A loop that ends with this program, however that ends."""
LONGEST = 1000
"""Most characters of a reason."""


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Keep as many processes computing as long as the context lasts."""
    loops = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
        for loop in loops:
            loop.wait()


def run_tests(arguments: Sequence[str], workers: int) -> tuple[int, str, Mapping[str, str]]:
    """Run pytest; return its exit code, what it printed, and the reason of each failure by the test."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        # The summary on the terminal cuts reasons at its width.
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-n",
            f"{workers}",
            f"--junitxml={report}",
            *arguments,
        ]
        done = subprocess.run(
            command,
            # Tests that compute give way to those in real time, and to every loop: they would take hours.
            env={**os.environ, "OMP_NUM_THREADS": "1", "DEAL_HW_TESTS_NICE": "0"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        found = failures(report.read_text(encoding="utf-8")) if report.exists() else {}
    return done.returncode, done.stdout, found


def failures(report: str) -> dict[str, str]:
    """Return the reason of each failure or error by the test's name, from a report in JUnit's XML."""
    found: dict[str, str] = {}
    for test in ET.fromstring(report).iter("testcase"):
        for wrong in (*test.iter("failure"), *test.iter("error")):
            found[f"{test.get('classname')}::{test.get('name')}"] = " ".join(
                (wrong.get("message") or "").split()
            )
    return found


def main() -> int:
    """Run the tests under load."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--loops", type=int, default=10, help="processes that keep the processors busy")
    parser.add_argument("--repetitions", type=int, default=3, help="runs, one after the other")
    parser.add_argument("--workers", type=int, default=3, help="processes of pytest")
    given, arguments = parser.parse_known_args()
    failed: Counter[str] = Counter()
    bad = 0
    for number in range(given.repetitions):
        with busy_loops(given.loops):
            code, output, reasons = run_tests(arguments or DEFAULT, given.workers)
        failed.update(list(reasons))
        bad += code != 0
        last = output.strip().splitlines()[-1:]
        print(f"run {number + 1}: exit code {code}: {''.join(last)}", flush=True)
        for name, reason in reasons.items():
            print(f"  {name}: {reason[:LONGEST]}", flush=True)
        if code and not reasons:
            print(output[-3000:], flush=True)
    for name, count in failed.most_common():
        print(f"failed in {count} of {given.repetitions}: {name}")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
