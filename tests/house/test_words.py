"""Words that are no longer used: one thing has one name, that of the field (CONTRIBUTING.md)."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

GONE = {
    r"polish(?!ed|ing)": "refinement, --refine",
    r"weki": "eki",
    r"open_loop|openloop": "output_error",
    r"horizons?_s\b": "windows_s",
    r"widened_by_halves|compare_halves": "split_half",
    r"sandwich": "cluster-robust covariance",
    r"hangs? together": "autocorrelated",
    r"tells much|most telling": "informative",
    r"vigou?r": "excitation level",
    r"livel(y|ier|iest)": "strong, stronger, strongest",
    r"\bxis?\b|[A-Z]_XI\b": "range ratio",
    r"null rows?\b": "no-data baselines",
    r"\bexcite (verb|cartpole|go2)|cli[./]excite\b": "design-excitation",
    r"witness": "stall monitor",
    r"greeting": "connect, hello",
    r"go2_hung|--hung\b|--suspended\b": "go2_on_stand, --on-stand",
    r"scripted": "fake",
    r"\bdroop": "gravity gain, sag",
    r"hand_?over\.py|control\.handover": "process_channel",
    r"\bcadence|Cadence": "loop timing",
    r"narrowing": "searched",
    r"\bchart coordinates|chart_base": "tangent coordinates",
    r"\bhonest(y|_|:)|bench honest": "fixed-range, realism",
    r"\bP-D\b": "PD",
    r"link[_ ]errors?\b": "transport errors",
    r"asked_position|/command/asked": "requested",
    r"\bheed(ed|s)?\b": "use, wait for",
    r"\bexact: bool|\bexact=(True|False|self)|\b(e|episode|problem|profile|self)\.exact\b": "noise_free",
}
"""Pattern of an old word -> its replacement."""

KEPT = (
    # Old names that files of old versions have, mapped to the new ones.
    ("tools/compare_rows.py", r"polish|weki|xi\b|open.loop"),
    ("tests/tools/test_tools_compare_rows.py", r"polish|weki|xi\b|open.loop"),
    ("deal_hw/bench/rows.py", r"xi|honest"),
    ("deal_hw/data/recording/schemas.py", r"/command/asked"),
    ("tests/data/test_data_recorder.py", r"/command/asked"),
    # xi is what DEAL calls the ratio, and a standard normal draw.
    ("calib/search/eki.py", r"xi"),
    ("calib/baselines/easi.py", r"xi"),
    ("deal_hw/bench/calibration.py", r"xi"),
    ("docs/", r"\bxi\b"),
    ("tests/house/test_words.py", r".*"),
)
"""Beginning of a path, and the old words that are allowed there."""


def sources() -> list[str]:
    """Return the files that people read or write: code, texts and settings, without measured rows."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    kinds = (".py", ".md", ".toml", ".j2", ".yaml", ".yml", ".ipynb", ".c", ".h", ".sh", "Makefile")
    found = [name for name in listed.splitlines() if name.endswith(kinds)]
    return [name for name in found if not name.startswith(("docs/measured/", "CHANGELOG.md"))]


@pytest.mark.parametrize(("pattern", "instead"), GONE.items())
def test_a_word_that_is_gone_stays_gone(pattern: str, instead: str) -> None:
    """No old word is in names, sentences or file names."""
    files = sources()
    if not files:
        pytest.skip("the files are listed by git, and this is no checkout")
    found = []
    for name in files:
        kept = "|".join(words for path, words in KEPT if name.startswith(path))
        if not (ROOT / name).is_file():
            continue
        lines = [name, *(ROOT / name).read_text(encoding="utf-8").splitlines()]
        for number, line in enumerate(lines):
            if (match := re.search(pattern, line)) and not (kept and re.search(kept, match[0])):
                found.append(f"{name}:{number}: {line.strip()[:100]}")
    assert not found, f"say {instead!r}:\n" + "\n".join(found)


def test_one_name_is_one_type() -> None:
    """No two public classes of the product share a name."""
    where: dict[str, list[str]] = {}
    for folder in ("deal_hw", "calib", "drivers", "policies"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for name in re.findall(r"^class ([A-Za-z]\w*)", path.read_text(encoding="utf-8"), flags=re.M):
                where.setdefault(name, []).append(str(path.relative_to(ROOT)))
    assert {name: paths for name, paths in where.items() if len(paths) > 1} == {}
