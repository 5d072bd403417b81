"""The table of candidate explanations: one figure for all, and what became of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from fakes.knee_evidence import knee_evidence, knee_motion, moved_by

from deal_hw.calib.data.folds import Choice
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.hypotheses.candidates import Candidate, effect_candidates, law_candidates, ranked
from deal_hw.calib.hypotheses.diagnosis import name_causes
from deal_hw.calib.hypotheses.judge import UnseenGain
from deal_hw.calib.hypotheses.laws import HYPOTHESES
from deal_hw.calib.hypotheses.laws import PLAY as PLAY_LAW
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.calib.hypotheses.trials import Tried
from deal_hw.calib.pipeline.law_choice import LawCandidate, LawfulChoice, ScreenedLaws

LOAD_LAW = next(law for law in HYPOTHESES if law.name == "friction that grows with load")


def _gains(count: float, shares: Mapping[str, float]) -> dict[str, UnseenGain]:
    return {name: UnseenGain(1.0, 1 - share, count) for name, share in shares.items()}


def test_signatures_stand_by_what_each_gains_alone() -> None:
    """A residual of damping: it is named with the gain of its cause, and the others have their own gains."""
    v, _ = knee_motion()
    known = knee_evidence(moved_by(-0.3 * v))
    causes = name_causes(known)
    assert [one.code for one in causes] == ["damping"]
    rows = ranked(effect_candidates(known, causes))
    best = rows[0]
    assert (best.explanation, best.outcome) == ("a force that grows with speed", "named")
    assert best.deviance == pytest.approx(causes[0].deviance)
    assert best.share == pytest.approx(causes[0].share)
    assert len(rows) == 5 and all(row.judged == "effect" for row in rows)
    others = rows[1:]
    assert all(row.outcome in ("chance", "not named") for row in others)
    assert all((row.deviance or 0.0) <= (best.deviance or 0.0) for row in others)
    assert {row.outcome for row in others if (row.deviance or 0.0) < EVIDENCE} <= {"chance"}


def test_noise_gives_candidates_that_are_chance() -> None:
    """Nothing is named, and the table says by how much nothing was gained."""
    known = knee_evidence(np.zeros_like(knee_motion()[0]))
    assert {row.outcome for row in effect_candidates(known, name_causes(known))} == {"chance"}


def test_a_cause_without_a_signature_stands_by_its_likelihood() -> None:
    """Bursts are no regression."""
    v, _ = knee_motion()
    wrong = moved_by(-0.3 * v)
    wrong[3, 5:9] += 0.2
    known = knee_evidence(wrong)
    causes = [one for one in name_causes(known) if one.code == "contact"]
    rows = [row for row in effect_candidates(known, causes) if row.judged == "likelihood"]
    assert [(row.explanation, row.outcome) for row in rows] == [("bursts", "named")] * len(causes)
    assert causes


def test_laws_that_were_not_fitted_stand_by_their_effect(small_problem: Callable[..., Problem]) -> None:
    """Above chance a law is not named, below it is chance."""
    problem = small_problem()
    tried = [Tried(PLAY_LAW, problem, 2 * EVIDENCE, None), Tried(LOAD_LAW, problem, -3.0, None)]
    assert [(row.outcome, row.judged, row.deviance) for row in law_candidates(tried, [])] == [
        ("not named", "effect", 2 * EVIDENCE),
        ("chance", "effect", -3.0),
    ]


def test_a_law_in_the_result_stands_by_its_folds() -> None:
    """Errors half and 0.8 of those without it: 1 - 0.5 * 0.8 = 0.6 of the squared residual is explained."""
    law = LawCandidate(LOAD_LAW, (), (0.4, 2.0), (np.zeros(0), 0.0))
    short, long = law.names
    plain = Choice("long", {"short": (3.0, 1.9), "long": (2.0, 2.0)}, 2.0)
    laws = ScreenedLaws([law], _gains(100, {LOAD_LAW.name: 0.5, PLAY_LAW.name: -0.1}))
    won = LawfulChoice.of(plain, [law], {short: [2.5], long: [1.0, 1.52]})
    taken, other = won.candidates(laws)
    assert (taken.explanation, taken.judged, taken.outcome) == (LOAD_LAW.name, "folds", "taken")
    assert taken.share == pytest.approx(0.6) and taken.deviance == pytest.approx(100 * np.log(2))
    assert (other.judged, other.outcome) == ("fit", "chance") and other.share == pytest.approx(-0.1)
    lost = LawfulChoice.of(plain, [law], {short: [2.5], long: [1.0, 1.95]})
    assert [(row.judged, row.outcome) for row in lost.candidates(laws)] == [
        ("folds", "chance"),
        ("fit", "chance"),
    ]


def test_laws_go_to_the_folds_beyond_chance_and_near_the_best() -> None:
    """A third of the best one's gain is too little, and 2 % of the residual is noticed by nobody."""

    def promising(count: float, shares: Mapping[str, float], asked: int = 0) -> list[str]:
        return ScreenedLaws((), _gains(count, shares), asked).promising()

    assert promising(1000, {"a": 0.5, "b": 0.45, "c": 0.4}) == ["a", "b"]
    assert promising(1000, {"a": 0.5, "b": 0.2}) == ["a"]
    assert promising(10**6, {"a": 0.02}) == []
    # A deviance of 19.4 is enough for one of 10 that were asked, but not of 20.
    assert promising(28, {"a": 0.5}, 10) == ["a"] and promising(28, {"a": 0.5}, 20) == []
    assert ScreenedLaws().promising() == []


def test_taken_and_named_candidates_come_first() -> None:
    """Then by gain; one without a figure is last of its kind."""
    rows = [
        Candidate(explanation="a", judged="fit", outcome="chance"),
        Candidate(explanation="b", judged="effect", outcome="not named", deviance=90.0),
        Candidate(explanation="c", judged="effect", outcome="named", deviance=30.0),
        Candidate(explanation="d", judged="folds", outcome="taken", deviance=25.0),
        Candidate(explanation="e", judged="effect", outcome="named", deviance=40.0),
    ]
    assert "".join(row.explanation for row in ranked(rows)) == "decba"
