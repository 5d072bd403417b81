"""Contents that the repository must not have, and those that it must have."""

from __future__ import annotations

import hashlib
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GENERATED = {"build", "dist", "runs", "htmlcov", "__pycache__", "deal_hw.egg-info"}
DOTTED = {".ci", ".gitignore"}

# Written with a hole in each word, so that this file does not hold what it looks for.
MACHINE_PATHS = re.compile(r"(?<![\w.])/(?:h~ome|U~sers|r~oot|w~ork)/\w".replace("~", ""))
REGISTRY_HOSTS = re.compile(
    r"\b(?:py~pi\.org|python~hosted\.org|download\.py~torch\.org|anaconda~\.org)"
    r"|https?://[\w.:@-]+/(?:[\w/-]*/)?simple\b".replace("~", "")
)
SECRETS = re.compile(
    r"-----BEGIN [A-Z ]*PRIVATE~ KEY-----|\bgh[pousr]_\w{30,}|https?://[^\s/@:]+:[^\s/@]+@".replace("~", "")
)


def files() -> list[Path]:
    """Return the files that are, or would be, under version control."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode == 0 and listed.stdout:
        paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    else:  # An unpacked archive has no version control.
        names = [(path, path.relative_to(ROOT).parts) for path in ROOT.rglob("*")]
        hidden = [path for path, parts in names if parts[0][0] == "." and parts[0] not in DOTTED]
        paths = sorted({path for path, parts in names if not GENERATED & set(parts)} - set(hidden))
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def matches(pattern: re.Pattern[str]) -> list[str]:
    """Return where a pattern occurs in the repository's text files, as `path:line: match`."""
    found = []
    for path in files():
        text = path.read_bytes().decode("utf-8", errors="ignore")
        for number, line in enumerate(text.splitlines(), start=1):
            if hit := pattern.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {hit.group()}")
    return found


@pytest.mark.parametrize(
    "pattern", [MACHINE_PATHS, REGISTRY_HOSTS, SECRETS], ids=["paths", "hosts", "secrets"]
)
def test_repository_names_no_machine(pattern: re.Pattern[str]) -> None:
    """No file names a path of somebody's machine, the host of a package registry, or a secret."""
    assert len(files()) > 30
    assert matches(pattern) == []


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        (MACHINE_PATHS, "see /h~ome/jo/x"),
        (MACHINE_PATHS, "at '/w~ork/main'"),
        (REGISTRY_HOSTS, "--index-url https://py~pi.org/"),
        (REGISTRY_HOSTS, "https://mirror.example:8080/py/s~imple/"),
        (SECRETS, "https:/~/jo:word@example.org"),
    ],
    ids=["home", "checkout", "registry", "mirror", "password"],
)
def test_seeded_slip_is_caught(pattern: re.Pattern[str], text: str) -> None:
    """Each pattern finds its target."""
    assert pattern.search(text) is None
    assert pattern.search(text.replace("~", ""))


def test_licence_is_apache() -> None:
    """The licence file is the Apache License 2.0, word for word."""
    text = (ROOT / "LICENSE").read_bytes()
    assert (
        hashlib.sha256(text).hexdigest() == "cfc7749b96f63bd31c3c42b5c471bf756814053e847c10f3eb003417bc523d30"
    )


@pytest.mark.parametrize("name", ["torch", "mujoco"])
def test_constraints_pin_what_results_depend_on(name: str) -> None:
    """The versions whose change would change results are pinned."""
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").split())
    assert pins[name] == {"torch": "2.13.0", "mujoco": "3.17.0"}[name]
