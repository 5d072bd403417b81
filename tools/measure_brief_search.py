#!/usr/bin/env python3
"""Measure where the brief search of `default` may end: whole calibrations with other spreads.

    python tools/measure_brief_search.py --seeds 0-9 --range-ratio 20 --out brief_search_spread.json

The local fit comes first, so a spread matters only where that leaves more than noise: cart-poles of
profile `realistic`. A row has the held-out error over that of the nominal model, and physics steps of the
whole calibration. Seeds 0 to 99 are for tuning.
"""

from __future__ import annotations

import itertools
import sys
from typing import Any, get_args
from unittest import mock

from measuring import Rows, add_seeds, parser

from deal_hw.bench.calibration import make_cells, run_cell
from deal_hw.bench.settings import FixedRange, Profile
from deal_hw.calib.search import deal, eki

GENERATIONS = 50


def measure(spread: float, seed: int, ratio: float, profile: Profile) -> dict[str, Any]:
    """Calibrate one cart-pole by the default, its brief search ending at a spread [logits]."""
    asked = FixedRange(profile=profile, methods=("default",), range_ratio=(ratio,), seeds=(seed,))
    (cell,) = make_cells(asked)
    with mock.patch.object(deal, "NEAR_SPREAD", spread), mock.patch.object(eki, "NEAR_SPREAD", spread):
        row = run_cell(cell, population=None, generations=GENERATIONS, threads=1)
    kept = (
        "profile",
        "error",
        "search",
        "error_percent",
        "heldout_nrmse_nominal",
        "heldout_nrmse_calibrated",
    )
    return {
        "spread": spread,
        "seed": seed,
        "range_ratio": ratio,
        **{name: row.get(name) for name in (*kept, "steps", "seconds")},
    }


def main() -> int:
    """Calibrate each robot with each spread, and print the rows."""
    options = parser(__doc__)
    add_seeds(options, 0)
    options.add_argument("--spread", type=float, nargs="+", default=[0.4, 0.8, 1.6], help="spreads [logits]")
    options.add_argument("--range-ratio", type=float, default=20.0)
    options.add_argument("--profile", default="realistic", choices=get_args(Profile))
    given = options.parse_args()
    rows = Rows(__file__, given.out, names=("spread", "seed", "range_ratio", "profile"))
    for seed, spread in itertools.product(given.seeds, given.spread):
        if rows.done(spread, seed, given.range_ratio, given.profile):
            continue
        row = measure(spread, seed, given.range_ratio, given.profile)
        heldout = row["error"] or format(
            row["heldout_nrmse_calibrated"] / row["heldout_nrmse_nominal"], ".4g"
        )
        rows.add(
            row, f"spread {spread:g}, seed {seed}: {row['search']}, held out {heldout} of nominal", table=True
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
