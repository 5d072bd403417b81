"""``deal-hw bench verdict``: tests whether calibrations accept right models and name the fault of wrong ones.

Robots in plain MuJoCo, each with its own truth, are calibrated as a user would: from CSV files and an MJCF,
with default settings. Without a fault the model can explain everything; each fault is an effect that the
model lacks. Faults of the recordings, which commands and measurements share, are chosen by name: their
calibration ends once the fault is named.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import Cells, RowTable, printed
from deal_hw.bench.scores import outside_range
from deal_hw.bench.settings import Verdict
from deal_hw.calib.hypotheses.thresholds import MOST_ALARMS
from deal_hw.calib.report.verdict import trust
from deal_hw.calibration import BEFORE_SEARCH, Budget, CalibrationResult, Progress
from deal_hw.errors import DealHwError, UnknownNameError
from deal_hw.testing.plain_faults import (
    BLIND,
    CAUSES,
    FAULTS,
    LAWS,
    RIGHT_MODELS,
    SHARED,
    SIGN_WORDS,
    Fault,
    RightModel,
    SharedFault,
)
from deal_hw.testing.plain_robots import KINDS, PlainRobot, can_have, make_robot, shared_words, write
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import FilesSettings

KEY = ("task", "fault", "seed")
RIGHT = ""
"""The fault of a right model with white noise on its positions."""
NONE = "none"
"""The name of that among chosen faults."""


def robots(
    seeds: Sequence[int], kinds: Sequence[str] = (), faults: Sequence[str] = ()
) -> list[tuple[str, str, int]]:
    """Return the robots by (kind, fault, seed), first without a fault.

    Args:
        seeds: Seeds of the truths.
        kinds: Names in `KINDS`; all by default. A robot is left out where a fault makes no sense for it.
        faults: "none", names in `FAULTS` (all of these by default), in `RIGHT_MODELS` and in `SHARED`.

    Raises:
        UnknownNameError: There is no such robot or fault.
    """
    usual = {NONE: RIGHT} | {fault: fault for fault in FAULTS}
    known = usual | {fault: fault for fault in (*RIGHT_MODELS, *SHARED)}
    for what, given, names in (("robot", kinds, KINDS), ("fault", faults, known)):
        for name in given:
            if name not in names:
                raise UnknownNameError(what, name, names)
    return [
        (kind, known[fault], seed)
        for fault in faults or usual
        for seed in seeds
        for kind in kinds or KINDS
        if can_have(kind, known[fault])
    ]


def table(settings: Verdict) -> RowTable:
    """Return the bench: its cells by :func:`run_cell`.

    Raises:
        UnknownNameError: There is no such robot or fault.
    """
    run = partial(run_cell, budget=settings.budget, threads=settings.cell_threads)
    chosen = robots(settings.seeds, settings.problems, settings.faults)
    args = [(cell, cell) for cell in chosen]
    cells = Cells(names=KEY, run=run, args=args, tasks=settings.tasks(), bench=settings.name)
    return RowTable(cells=cells, line=line, summary=printed(summary))


def run_cell(kind: str, fault: str, seed: int, *, budget: Budget, threads: int | None) -> dict[str, Any]:
    """Calibrate one robot; an error goes into the row.

    Args:
        kind: A name in `KINDS`.
        fault: A name in `FAULTS`, `SHARED` or `RIGHT_MODELS`, or "".
        seed: Seed of the truth, and of everything random in the calibration.
        budget: Limits of a search.
        threads: Simulation threads.
    """
    robot = make_robot(kind, seed, _fault(fault) or _shared(fault) or _right(fault))
    messages: list[str] = []
    row: dict[str, Any] = {"bench": "verdict", "task": kind, "fault": fault, "seed": seed, "error": ""}
    with tempfile.TemporaryDirectory() as name:
        model, fit, held_out = write(robot, Path(name))
        config = FilesSettings(
            model=model,
            data=fit,
            holdout=held_out,
            seed=seed,
            threads=threads,
            population=budget.population,
            generations=budget.generations,
        )
        try:
            work = calibration_input(config, say=messages.append)
            if why := outside_range(work.space, robot.truth):
                return row | {"error": f"ConfigurationError: {why}"}
            ends = _ends_when_named if _shared(fault) else None
            result = calibrate_or_raise(config, work, usual_method(config, work), progress=ends)
        except _NamedError as end:
            messages.append(str(end))
            row |= {"colour": "said", "named": names(kind, fault, [], messages), "said": messages}
            return row
        except DealHwError as err:
            # Refused before any work: counts as red, and as named if the message names the fault.
            named = names(kind, fault, [], [str(err)])
            return row | {"colour": "refused", "named": named, "refusal": str(err)}
    causes = [str(one["cause"]) for one in result.provenance.get("diagnosis", ())[:MOST_ALARMS]]
    laws = named_laws(result)
    said = [*map(str, result.alarms), *work.telemetry, *messages]
    return row | {
        "causes": causes,
        "laws": laws,
        "colour": trust(result).colour,
        "named": names(kind, fault, causes, said, laws),
        "said": messages,
        "alarms": [str(alarm) for alarm in result.alarms],
        "search": result.provenance.get("search", ""),
        "chi2": result.chi2,
        "seconds": result.seconds,
        "steps": result.steps,
        "physics_steps": result.provenance.get("physics_steps", {}),
        "left_out": result.provenance.get("checks_left_out", {}),
        **{f"heldout_nrmse_{name}": value for name, value in result.heldout_nrmse.items()},
        **against_truth(robot, result),
    }


def _fault(name: str) -> Fault | None:
    return next((fault for fault in FAULTS if fault == name), None)


def _right(name: str) -> RightModel | None:
    return next((right for right in RIGHT_MODELS if right == name), None)


def _shared(name: str) -> SharedFault | None:
    return next((fault for fault in SHARED if fault == name), None)


class _NamedError(Exception):
    """A calibration has named the fault of the recordings; its further results are not needed."""


def _ends_when_named(progress: Progress) -> None:
    if progress.stage == BEFORE_SEARCH and "alike" in progress.message:
        raise _NamedError(progress.message)


def named_laws(result: CalibrationResult) -> list[str]:
    """Return the explanations that a result has, or that an alarm names."""
    rows = result.provenance.get("candidates", ())
    return [str(one["explanation"]) for one in rows if one["outcome"] in ("taken", "named")]


def names(
    kind: str, fault: str, causes: Sequence[str], sentences: Sequence[str], laws: Sequence[str] = ()
) -> bool:
    """Return whether the fault was named; True if there is none.

    Args:
        kind: A name in `KINDS`.
        fault: A name in `FAULTS` or `SHARED`, or "".
        causes: The causes named by alarms, the likeliest first.
        sentences: Refusals, warnings and alarms.
        laws: Explanations that the result has, or that an alarm names.
    """
    if (shared := _shared(fault)) is not None:
        return any(words in text for words in shared_words(kind, shared) for text in sentences)
    known = _fault(fault)
    if known is None:
        return True
    if known == "sign":
        return any(word in text for text in sentences for word in SIGN_WORDS)
    if known == "blind-encoder":
        return any(_at_blind_place(kind, text) for text in sentences)
    by_law = any(law in LAWS.get(known, ()) for law in laws)
    return by_law or any(cause in CAUSES.get(known, ()) for cause in causes)


def _at_blind_place(kind: str, text: str) -> bool:
    """Return whether a sentence says that samples lack, or the residual lies, where the encoder is blind."""
    joint = re.escape(KINDS[kind].joints[-1].name)
    found = re.search(rf"lies where {joint} is between (-?[\d.]+) and (-?[\d.]+) rad", text)
    return found is not None and float(found[1]) < BLIND[1] and float(found[2]) > BLIND[0]


def against_truth(robot: PlainRobot, result: CalibrationResult) -> dict[str, Any]:
    """Return the errors of identified parameters, and the share of intervals that hold the truth."""
    valued = [
        k
        for k, name in enumerate(result.space.names)
        if name in robot.truth and not (result.verdicts and result.verdicts[k] == "not identifiable")
    ]
    truth = np.array([robot.truth[result.space.names[k]] for k in valued])
    estimate, interval = result.estimate[valued], result.interval[valued]
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return {
        "parameters": len(result.space),
        "told": len(valued),
        "error_percent": float(100 * np.mean(np.abs(estimate - truth) / truth)) if valued else None,
        "coverage90": float(np.mean(inside)) if valued else None,
        "latency_true": robot.delay_s,
        "latency_found": result.latency_s,
    }


def line(row: Mapping[str, Any]) -> str:
    """Return one row in words."""
    what = row["fault"] or "right model"
    if row["error"]:
        return f"{row['task']} seed {row['seed']}, {what}: {row['error']}"
    named = "" if not row["fault"] or _right(row["fault"]) else ", named" if row["named"] else ", NOT named"
    text = f"{row['task']} seed {row['seed']}, {what}: {row['colour']}{named}"
    if "seconds" in row:
        text += f", chi2 {row['chi2']:.3g}, search {row['search']}, {row['seconds']:.0f} s"
    return text


def summary(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line for each fault: colours, and how often it was named."""
    found = []
    for fault in (RIGHT, *RIGHT_MODELS, *FAULTS, *SHARED):
        mine = [r for r in rows if r["fault"] == fault and not r["error"]]
        if not mine:
            continue
        colours = [str(r["colour"]) for r in mine]
        counts = ", ".join(
            f"{colours.count(c)} {c}" for c in ("green", "amber", "red", "said", "refused") if c in colours
        )
        shared, right = _shared(fault), _right(fault)
        known = SHARED[shared][0] if shared else FAULTS[own] if (own := _fault(fault)) else ""
        words = f"{fault}: {known}" if known else RIGHT_MODELS[right] if right else "the model is right"
        text = f"{words}: {len(mine)} robots, {counts}"
        if known:
            text += f"; named {sum(bool(r['named']) for r in mine)} times"
        else:
            held = [r["coverage90"] for r in mine if r.get("coverage90") is not None]
            text += f"; 90 % intervals hold {100 * float(np.mean(held)):.0f} % of the truths" if held else ""
        found.append(text)
    return found
