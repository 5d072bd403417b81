#!/usr/bin/env python3
"""Measure what the update of the DEAL paper does without any recording.

    python tools/measure_paper_update.py --out paper_update.json

Every member has the same fitness, so p_i is 1 / N and delta is 1 (eq. 9 with a mean output of 0). What is
left of Algorithm 1 is its start, its schedules and its noise: no robot is simulated. In the paper's protocol
the range of each parameter is [p / r, r p] around its true value p, so the truth is at 1 / (r + 1) of each
range, and the error of eq. 11 follows from the final places in the ranges alone. A row has this error, and
the mean place of the estimate: 0 is the lower end of the range, 0.5 its middle.

Rows with a ``source`` are the paper's own errors (Tables 12 to 14). Their place is the one at which all
parameters together have this error, above the truth.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from measuring import Rows, add_seeds, parser

from deal_hw.bench.settings import parse_ratios
from deal_hw.calib.paper.algorithm1 import PaperSettings, literal
from deal_hw.calib.paper.diffusion_evolution import DiffusionEvolution, DiffusionSettings
from deal_hw.calib.pipeline.methods import PAPER_POPULATION


@dataclass(frozen=True, slots=True)
class Update:
    """A reading of the paper's update.

    Attributes:
        diffusion: Its choices.
        box: Low and high end of the normalised range.
    """

    diffusion: DiffusionSettings
    box: tuple[float, float]


def _literal(**changes: Any) -> Update:
    words = literal().settings
    return Update(dataclasses.replace(words.diffusion, **changes), words.box)


UPDATES = {
    "literal": _literal(),
    "literal, eta 0.5": _literal(eta=0.5),
    "literal, eta 0": _literal(eta=0.0),
    "literal, delta 1.5": _literal(influence=1.5),
    "literal, delta 1000": _literal(influence=1e3),
    "literal, linear alpha": _literal(schedule="linear"),
    "literal, distance / K": _literal(divide_distance=True),
    "deal-paper": Update(PaperSettings().diffusion, PaperSettings().box),
}
"""The paper's words, one open choice changed in each of the next, and our choice of all."""


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
    update, rng = UPDATES[name], np.random.default_rng(seed)
    low, high = update.box
    start = low + (high - low) * rng.random((PAPER_POPULATION, dimensions))
    rng.integers(2**62)
    search = DiffusionEvolution(start, update.diffusion, rng)
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


def main() -> int:
    """Measure each reading, and print the mean error over the seeds."""
    options = parser(__doc__)
    add_seeds(options, 0)
    options.add_argument("--updates", nargs="+", choices=UPDATES, default=list(UPDATES), metavar="UPDATE")
    options.add_argument("--parameters", type=int, nargs="+", default=[9, 11, 50, 92, 122], metavar="K")
    options.add_argument("--range-ratio", type=parse_ratios, default=(10.0, 15.0, 20.0))
    given = options.parse_args()
    rows: list[dict[str, Any]] = []
    for name, dimensions, ratio in itertools.product(given.updates, given.parameters, given.range_ratio):
        mine = [measure(name, dimensions, ratio, seed) for seed in given.seeds]
        rows += mine
        errors = [row["error_percent"] for row in mine]
        print(
            f"{name}, {dimensions} parameters, ratio {ratio:g}: error {np.mean(errors):.0f} % "
            f"({min(errors):.0f} to {max(errors):.0f}), place {np.mean([row['place'] for row in mine]):.3f}",
            file=sys.stderr,
            flush=True,
        )
    Rows(__file__, given.out).keep([*rows, *printed_rows()])
    return 0


if __name__ == "__main__":
    sys.exit(main())
