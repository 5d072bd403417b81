"""Mutation run over the safety module and the exit path: `make mutation`.

mutmut changes the sources in one place after another and runs their tests against each change. A change
that no test notices survives. docs/results/safety-mutation.md must list each survivor with a reason; any
other survivor fails the run.

mutmut needs a directory of its own, so the sources and the tests are copied into build/mutation; the
rest of deal_hw (drivers) comes from the installed package.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
WORK = ROOT / "build" / "mutation"
PAGE = ROOT / "docs" / "results" / "safety-mutation.md"
SETS = {
    "safety": (
        tuple(f"deal_hw/control/safety/{name}.py" for name in ("safety", "filter", "machine", "leg_checks")),
        ("tests/control/test_control_safety*.py",),
    ),
    # Without the tests through the whole loop, which take most of the time.
    "passive": (
        ("deal_hw/control/safety/passive.py",),
        ("tests/control/test_control_exit_passive.py",),
        ("-k", "not go2"),
    ),
    "processes": (
        tuple(f"deal_hw/control/process/{name}.py" for name in ("supervisor", "watchdog", "claim")),
        ("tests/control/test_control_exit_[sv]*.py", "tests/control/test_control_words.py"),
    ),
}
"""Sources to change, tests that must notice, further arguments of pytest; each set is a separate run."""
SURVIVED = ("survived", "no tests", "suspicious", "skipped")
CONFIGURATION = """
[tool.mutmut]
source_paths = ["deal_hw/"]
only_mutate = {mutated!r}
pytest_add_cli_args_test_selection = ["tests"]
pytest_add_cli_args = {arguments!r}
use_git_change_detection = false
# Fifteen times what the tests take without a change, and 30 s: a busy machine must not make a test look as if
# it had noticed one.
timeout_multiplier = 15.0
timeout_constant = 2.0

[tool.pytest.ini_options]
addopts = "--import-mode=importlib -p no:cacheprovider"
filterwarnings = ["error"]
"""


def prepare(mutated: tuple[str, ...], tests: tuple[str, ...], arguments: tuple[str, ...]) -> None:
    """Copy the files that mutmut needs."""
    shutil.rmtree(WORK, ignore_errors=True)
    (WORK / "tests").mkdir(parents=True)
    shutil.copytree(ROOT / "deal_hw", WORK / "deal_hw", ignore=shutil.ignore_patterns("__pycache__"))
    for pattern in tests:
        for test in ROOT.glob(pattern):
            shutil.copy(test, WORK / "tests")
    (WORK / "pyproject.toml").write_text(
        CONFIGURATION.format(mutated=list(mutated), arguments=list(arguments))
    )


def mutmut(*arguments: str) -> str:
    """Run mutmut and return its output."""
    program = Path(sys.executable).parent / "mutmut"
    done = subprocess.run([program, *arguments], cwd=WORK, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"mutmut {' '.join(arguments)} failed:\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
        )
    return done.stdout


def verdicts() -> dict[str, str]:
    """Return the verdict of each mutant."""
    rows = (line.strip().rsplit(": ", 1) for line in mutmut("results", "--all", "true").splitlines())
    return {row[0]: row[1] for row in rows if len(row) == 2}


def change(mutant: str) -> tuple[str, str]:
    """Return the changed line before and after."""
    lines = mutmut("show", mutant).splitlines()
    before = [line[1:].strip() for line in lines if line.startswith("-") and not line.startswith("---")]
    after = [line[1:].strip() for line in lines if line.startswith("+") and not line.startswith("+++")]
    return " ".join(before), " ".join(after)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"of {', '.join(SETS)}; all by default")
    chosen = parser.parse_args().sets or list(SETS)
    os.nice(10)
    # A changed supervisor may spin at a real-time priority: the kernel ends it after 2 s without a wait.
    resource.setrlimit(resource.RLIMIT_RTTIME, (2_000_000, 3_000_000))
    return max([run(*SETS[name]) for name in chosen])


def run(mutated: tuple[str, ...], tests: tuple[str, ...], arguments: tuple[str, ...] = ()) -> int:
    """Run one set; return 1 if a survivor has no reason in the page."""
    prepare(mutated, tests, arguments)
    children = str(max((os.cpu_count() or 2) - 1, 1))
    mutmut("run", "--max-children", children)
    found = verdicts()
    counts = Counter(found.values())
    print(f"{len(found)} mutants: " + ", ".join(f"{n} {name}" for name, n in counts.most_common()))
    page = PAGE.read_text() if PAGE.exists() else ""
    unexplained = 0
    for mutant in sorted(name for name, verdict in found.items() if verdict in SURVIVED):
        before, after = change(mutant)
        known = f"| `{before}` | `{after}` |" in page
        unexplained += not known
        print(f"\n{'argued' if known else 'NEW'}: {mutant} ({found[mutant]})\n  - {before}\n  + {after}")
    for mutant in sorted(name for name, verdict in found.items() if verdict == "timeout"):
        print("\ntimed out, so noticed: {}\n  - {}\n  + {}".format(mutant, *change(mutant)))
    if unexplained:
        print(
            f"\n{unexplained} survivors are not argued in {PAGE.relative_to(ROOT)}: test them or argue them"
        )
    return int(unexplained > 0)


if __name__ == "__main__":
    sys.exit(main())
