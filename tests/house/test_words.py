"""One thing has one name, that of the field: a second one would look like a second thing."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

SECOND_NAMES = {
    r"link[_ ]errors?\b": "transport errors",
    r"go2_hung|--hung\b(?!-on-crane)|--suspended\b": "go2_on_stand, --on-stand",
    r"\bP-D\b": "PD",
}
"""Pattern of a word that readers took for another thing -> the one name."""


def sources() -> list[str]:
    """Return the files that people read or write: code, texts and settings, without measured rows."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    kinds = (".py", ".md", ".toml", ".j2", ".yaml", ".yml", ".ipynb", ".c", ".h", ".sh", "Makefile")
    found = [name for name in listed.splitlines() if name.endswith(kinds)]
    return [name for name in found if not name.startswith(("docs/measured/", "CHANGELOG.md"))]


@pytest.mark.parametrize(("pattern", "name"), SECOND_NAMES.items())
def test_one_thing_has_one_name(pattern: str, name: str) -> None:
    """In code, messages and documents."""
    files = [file for file in sources() if file != "tests/house/test_words.py" and (ROOT / file).is_file()]
    if not files:
        pytest.skip("the files are listed by git, and this is no checkout")
    found = [
        f"{file}:{number}: {line.strip()[:100]}"
        for file in files
        for number, line in enumerate((ROOT / file).read_text(encoding="utf-8").splitlines(), start=1)
        if re.search(pattern, line)
    ]
    assert not found, f"say {name!r}:\n" + "\n".join(found)


def test_one_name_is_one_type() -> None:
    """No two public classes of the product share a name."""
    where: dict[str, list[str]] = {}
    for folder in ("deal_hw", "calib", "drivers", "policies"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for name in re.findall(r"^class ([A-Za-z]\w*)", path.read_text(encoding="utf-8"), flags=re.M):
                where.setdefault(name, []).append(str(path.relative_to(ROOT)))
    assert {name: paths for name, paths in where.items() if len(paths) > 1} == {}
