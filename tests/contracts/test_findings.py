"""Findings: their parts in one line, and the worst of several."""

from __future__ import annotations

import pytest

from deal_hw.findings import Finding, Severity, worst


@pytest.mark.parametrize(
    ("finding", "line"),
    [
        (Finding("gaps", Severity.OK, "no gap"), "no gap"),
        (Finding("gaps", Severity.WARN, "2 gaps", "check the cable"), "2 gaps; check the cable"),
        (
            Finding.alarm("2 mm of play.", "The gear is worn.", "Mend it."),
            "2 mm of play. The gear is worn. Mend it.",
        ),
        (Finding("x", Severity.FAIL, "a", "c", "b"), "a; b; c"),
    ],
)
def test_all_parts_in_one_line(finding: Finding, line: str) -> None:
    """Sentences follow each other, and parts of a sentence are divided; what is empty is left out."""
    assert finding.message == str(finding) == line


def test_a_check_has_a_remedy_only_where_something_is_wrong() -> None:
    """The sentence is the same."""
    wrong, right = (Finding.judged("robot", hot, "71 °C", "let it cool down") for hot in (True, False))
    assert (wrong.severity, wrong.do) == (Severity.WARN, "let it cool down")
    assert (right.severity, right.do) == (Severity.OK, "") and right.seen == wrong.seen


def test_the_worst_decides() -> None:
    """Their order is that of the enumeration; no finding is no harm."""
    found = [Finding("x", severity, "a") for severity in (Severity.NOTE, Severity.FAIL, Severity.WARN)]
    assert worst(found) is Severity.FAIL and worst(found[:1]) is Severity.NOTE
    assert worst([]) is Severity.OK
