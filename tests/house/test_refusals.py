"""Every refusal of the sources is found by the tool, and says something."""

from __future__ import annotations

from pathlib import Path

import pytest
import refusals

from deal_hw import errors

ROOT = Path(__file__).resolve().parents[2]
SOURCE = """
class OwnError(ConfigurationError):
    pass

def refuse(value):
    if value:
        raise OwnError(f"{value} is "
                       "too large")
    found = UnknownNameError("verb", value, VERBS)
    raise found

class Reader:
    def read(self):
        raise (ValueError("a\\n  b") if self else self._lost(1, why="x"))
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Return a checkout of two sources: the repository's errors, and one with a refusal of each kind."""
    for folder in refusals.FOLDERS:
        (tmp_path / folder).mkdir()
    (tmp_path / refusals.ERRORS).write_text((ROOT / refusals.ERRORS).read_text(encoding="utf-8"))
    (tmp_path / "calib" / "module.py").write_text(SOURCE)
    (tmp_path / "calib" / "__init__.py").write_text("")
    return tmp_path


@pytest.mark.slow
def test_a_refusal_says_something() -> None:
    """No error of deal-hw is raised without a text; helpers behind `raise` make theirs themselves."""
    known = refusals.error_classes()
    found = refusals.refusals()
    silent = [f"{one.path}:{one.line}: {one.kind}" for one in found if one.kind in known and not one.words]
    assert not silent, "\n".join(silent)


def test_all_kinds_of_refusal_are_found(small: Path) -> None:
    """Raised, kept in a variable, of a class below ours, chosen by an `if`, made by a helper."""
    found = [one.text().strip() for one in refusals.refusals(small) if one.path == "calib/module.py"]
    assert found == [
        "Reader.read  ValueError -  a b",
        "Reader.read  _lost 2  {1} | why=x",
        "refuse  OwnError 2  {value} is too large",
        "refuse  UnknownNameError 2  verb | {value} | {VERBS}",
    ]


def test_every_class_of_the_error_tree_is_known(small: Path) -> None:
    """The tool reads the tree from the sources; it must be the tree that Python has."""
    defined = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.DealHwError)
    }
    assert refusals.error_classes(small) == defined | {"OwnError"}


def test_a_line_that_no_test_ran_is_listed(small: Path) -> None:
    """The report of coverage says which lines ran; of a call any of its lines counts."""
    first, second, *_ = (one for one in refusals.refusals(small) if one.function == "refuse")
    report = small / "coverage.json"
    report.write_text(f'{{"files": {{"{first.path}": {{"executed_lines": [{first.last_line}]}}}}}}')
    assert refusals.unreached([first, second], report) == [second]
