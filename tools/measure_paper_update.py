#!/usr/bin/env python3
"""Measure readings of the DEAL paper's update, without any recording and with one.

    python tools/measure_paper_update.py --seeds 1000-1004 --out paper_update.json
    python tools/measure_paper_update.py --recording --readings "literal, box [-1, 1]" --seeds 1010-1012

Without a recording every member has the same fitness, so p_i is 1 / N and delta is 1 (eq. 9 with a mean
output of 0). What is left of Algorithm 1 is its start, its schedules and its noise: no robot is simulated. In
the paper's protocol the range of each parameter is [p / r, r p] around its true value p, so the truth is at
1 / (r + 1) of each range, and the error of eq. 11 follows from the final places in the ranges alone. A row
has this error, and the mean place of the estimate: 0 is the lower end of the range, 0.5 its middle.

With ``--recording`` the cart-pole of `bench paper` (profile `ideal`) is calibrated by the same reading and
its critic. A row also has the error on another motion over the signal's range, and how far the demonstration
moves cart and pole. `literal` is `deal-paper-literal` there.

Rows with a ``source`` are the paper's own errors (Tables 12 to 14). Their place is the one at which all
parameters together have this error, above the truth.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from measuring import Rows, add_seeds, parser

from deal_hw.bench.loop import calibration_row
from deal_hw.bench.settings import parse_ratios
from deal_hw.bench.tasks import make_case
from deal_hw.calib.paper import algorithm1
from deal_hw.calib.paper.algorithm1 import DealPaper, PaperSettings, literal
from deal_hw.calib.paper.diffusion_evolution import DiffusionEvolution
from deal_hw.calib.pipeline.methods import PAPER_POPULATION, usual_budget

LITERAL = "deal-paper-literal"


def _literal(
    diffusion: Mapping[str, Any] | None = None, critic: Mapping[str, Any] | None = None, **changes: Any
) -> PaperSettings:
    """Return the settings of the paper's words, with other choices of its update, its critic or the rest."""
    words = literal().settings
    return dataclasses.replace(
        words,
        diffusion=dataclasses.replace(words.diffusion, **(diffusion or {})),
        critic=dataclasses.replace(words.critic, **(critic or {})),
        **changes,
    )


READINGS = {
    "literal": _literal(),
    "literal, eta 0.9": _literal({"eta": 0.9}),
    "literal, eta 0.8": _literal({"eta": 0.8}),
    "literal, eta 0.7": _literal({"eta": 0.7}),
    "literal, eta 0.5": _literal({"eta": 0.5}),
    "literal, eta 0.1": _literal({"eta": 0.1}),
    "literal, eta 0": _literal({"eta": 0.0}),
    "literal, delta 1.5": _literal({"influence": 1.5}),
    "literal, delta 1000": _literal({"influence": 1e3}),
    "literal, linear alpha": _literal({"schedule": "linear"}),
    "literal, linear alpha, eta 0.9": _literal({"schedule": "linear", "eta": 0.9}),
    "literal, linear alpha, eta 0.8": _literal({"schedule": "linear", "eta": 0.8}),
    "literal, distance / K": _literal({"divide_distance": True}),
    "literal, distance / K, eta 0.9": _literal({"divide_distance": True, "eta": 0.9}),
    "literal, distance / K, eta 0.8": _literal({"divide_distance": True, "eta": 0.8}),
    "literal, box [-1, 1]": _literal(box=(-1.0, 1.0)),
    "literal, box [-1, 1], eta 0.1": _literal({"eta": 0.1}, box=(-1.0, 1.0)),
    "literal, unit variance": _literal(box=PaperSettings().box),
    "deal-paper": PaperSettings(),
}
"""The paper's words, one or two open choices changed in each of the next, and our choice of all. "Unit
variance" is the box of `deal-paper`. The reference program of diffusion evolution has a centred start and
noise of 0.1."""

CRITICS = {
    "literal, clip 0.1": _literal(critic={"clip": 0.1}),
    "literal, clip 1": _literal(critic={"clip": 1.0}),
    "literal, 100 updates": _literal(critic={"updates": 100}),
    "literal, learning rate 1e-3": _literal(critic={"learning_rate": 1e-3}),
    "literal, temperature 0.3": _literal({"temperature": 0.3}),
    "literal, lambda 0.5": _literal({"influence": 0.5}),
    "literal, scaled differences": _literal(difference=True, standardise=True),
}
"""Readings that differ from the paper's words in what is done with the recording alone."""


METHODS = ("DEAL", "DEAL\\FN", "DEAL\\PN", "EASI", "BO")
PRINTED = {
    "Table 12, cart-pole": (
        (0.85, 1.74, 2.63),
        (1.67, 2.96, 4.28),
        (1.90, 2.85, 3.76),
        (4.03, 6.12, 8.40),
        (5.20, 8.52, 11.78),
    ),
    "Table 13, humanoid": (
        (0.81, 1.65, 2.50),
        (1.57, 2.79, 4.03),
        (2.40, 3.53, 4.58),
        (2.94, 4.64, 6.03),
        (4.67, 7.29, 10.06),
    ),
    "Table 14, hand": (
        (0.83, 1.69, 2.57),
        (1.59, 2.80, 4.06),
        (2.60, 3.80, 4.92),
        (4.25, 6.82, 9.32),
        (3.75, 6.32, 9.16),
    ),
}
"""The paper's errors at range ratio 10, 15 and 20, by table and in the order of `METHODS`; 1 is 100 %."""


def printed_rows() -> list[dict[str, Any]]:
    """Return a row for each error that the paper prints."""
    return [
        {
            "source": table,
            "update": method,
            "range_ratio": ratio,
            "error_percent": 100 * error,
            "place": (1 + error - 1 / ratio) / (ratio - 1 / ratio),
        }
        for table, errors in PRINTED.items()
        for method, line in zip(METHODS, errors, strict=True)
        for ratio, error in zip((10.0, 15.0, 20.0), line, strict=True)
    ]


def measure(name: str, dimensions: int, ratio: float, seed: int) -> dict[str, Any]:
    """Run the update without data; return a row.

    Random numbers are those of `bench` with the same seed, so "literal" is `deal-paper-literal-flat` there.
    """
    reading, rng = READINGS[name], np.random.default_rng(seed)
    low, high = reading.box
    start = low + (high - low) * rng.random((PAPER_POPULATION, dimensions))
    rng.integers(2**62)
    search = DiffusionEvolution(start, reading.diffusion, rng)
    while not search.finished:
        search.tell(np.zeros(PAPER_POPULATION))
    place = np.clip((search.ask().mean(axis=0) - low) / (high - low), 0.0, 1.0)
    factor = 1 / ratio + place * (ratio - 1 / ratio)
    return {
        "update": name,
        "parameters": dimensions,
        "range_ratio": ratio,
        "seed": seed,
        "error_percent": float(100 * np.mean(np.abs(factor - 1))),
        "place": float(place.mean()),
    }


def measure_with_recording(
    name: str, ratio: float, seed: int, checkpoint: Path | None = None, *, generations: int | None = None
) -> dict[str, Any]:
    """Calibrate the cart-pole of `bench paper` by one reading; return a row.

    Args:
        name: A name in `READINGS` or `CRITICS`.
        ratio: Ratio of the search range.
        seed: Seed of everything.
        checkpoint: The policy that demonstrates; the shipped one by default.
        generations: Steps of the search; the method's own number by default.
    """
    settings = (READINGS | CRITICS)[name]
    case = make_case("cartpole", "ideal", seed, ratio, centred=True, by_policy=True, checkpoint=checkpoint)
    cart, pole = np.ptp(case.fit_truth[0], axis=0)
    with mock.patch.object(algorithm1, "literal", lambda: DealPaper(settings, name=LITERAL)):
        row, result = calibration_row(
            case, LITERAL, usual_budget(LITERAL, None, generations, refine=False), 1
        )
    kept = ("error_percent", "heldout_nrmse_calibrated", "heldout_nrmse_null", "steps", "seconds")
    return {
        "update": name,
        "parameters": len(case.space),
        "range_ratio": ratio,
        "seed": seed,
        "demonstration": "" if checkpoint is None else checkpoint.stem,
        "cart_moved_m": float(cart),
        "pole_moved_rad": float(pole),
        "error": "",
        **{key: row[key] for key in kept},
        "place": float(case.space.normalize(result.estimate).mean()),
    }


def main() -> int:
    """Measure each reading, and print the mean error over the seeds."""
    options = parser(__doc__)
    add_seeds(options, 0)
    known = READINGS | CRITICS
    options.add_argument("--readings", nargs="+", choices=known, default=list(READINGS), metavar="READING")
    options.add_argument(
        "--parameters",
        type=int,
        nargs="+",
        default=[9, 11, 50, 92, 122],
        metavar="K",
        help="without recording",
    )
    options.add_argument("--range-ratio", type=parse_ratios, default=(10.0, 15.0, 20.0))
    options.add_argument("--recording", action="store_true", help="calibrate the cart-pole of bench paper")
    options.add_argument("--checkpoint", type=Path, help="policy (.onnx) that demonstrates")
    given = options.parse_args()
    if given.recording:
        rows = Rows(__file__, given.out, names=("update", "range_ratio", "seed", "demonstration"))
        policy = "" if given.checkpoint is None else given.checkpoint.stem
        for name, ratio, seed in itertools.product(given.readings, given.range_ratio, given.seeds):
            if not rows.done(name, ratio, seed, policy):
                rows.add(measure_with_recording(name, ratio, seed, given.checkpoint))
        return 0
    found: list[dict[str, Any]] = []
    for name, dimensions, ratio in itertools.product(given.readings, given.parameters, given.range_ratio):
        mine = [measure(name, dimensions, ratio, seed) for seed in given.seeds]
        found += mine
        errors = [row["error_percent"] for row in mine]
        print(
            f"{name}, {dimensions} parameters, ratio {ratio:g}: error {np.mean(errors):.0f} % "
            f"({min(errors):.0f} to {max(errors):.0f}), place {np.mean([row['place'] for row in mine]):.3f}",
            file=sys.stderr,
            flush=True,
        )
    Rows(__file__, given.out).keep([*found, *printed_rows()])
    return 0


if __name__ == "__main__":
    sys.exit(main())
