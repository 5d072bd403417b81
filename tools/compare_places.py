#!/usr/bin/env python3
"""Compare the places of estimates and truths in the search ranges, from rows of `bench fixed-range`.

    python tools/compare_places.py docs/measured/paper_cartpole_ideal.json

In `fixed-range` and `mismatch` a truth lies anywhere in the inner 80 % of each range. A search that reads
the recording ends high in the range where the truth is high, and low where it is low: over all parameters of
all robots both places are correlated. A search that does not read it has a correlation near 0, whatever its
error. By chance, n places have up to 2 / sqrt(n). Places are in each parameter's own scale, mostly
logarithmic: 0 is the lower end, 1 the upper one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import parser

from deal_hw.bench.rows import load_rows
from deal_hw.errors import ConfigurationError
from deal_hw.robots import parameter_spaces
from deal_hw.types import FloatArray

BENCHES = ("fixed-range", "mismatch")


def places(row: dict[str, Any]) -> FloatArray:
    """Return the places of truth and estimate in the ranges, (2, K), of one row."""
    if row["bench"] not in BENCHES:
        raise ConfigurationError(
            f"a row of bench {row['bench']} has its truth at one place of every range, so places cannot be "
            f"compared; give rows of {' or '.join(BENCHES)}"
        )
    spaces = parameter_spaces(row["task"])
    space = spaces[row.get("space") or next(iter(spaces))]().with_ratio(row["range_ratio"])
    values = row["per_parameter"]
    return np.array(
        [space.normalize(np.array([values[n][k] for n in space.names])) for k in ("truth", "estimate")]
    )


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return for each task, ratio and method the correlation of places, and the median errors."""
    groups: dict[tuple[str, float, str], list[dict[str, Any]]] = {}
    for row in rows:
        if not row["error"]:
            groups.setdefault((row["task"], row["range_ratio"], row["method"]), []).append(row)
    found = []
    for (task, ratio, method), mine in groups.items():
        truth, estimate = np.concatenate([places(row) for row in mine], axis=1)
        moved = estimate.std() > 1e-9
        heldout = [row["heldout_nrmse_calibrated"] / row["heldout_nrmse_nominal"] for row in mine]
        found.append(
            {
                "task": task,
                "range_ratio": ratio,
                "method": method,
                "robots": len(mine),
                "places": len(truth),
                "correlation": float(np.corrcoef(truth, estimate)[0, 1]) if moved else None,
                "error_percent": float(np.median([row["error_percent"] for row in mine])),
                "heldout_over_nominal": float(np.median(heldout)),
            }
        )
    return found


def main() -> int:
    """Print the summary of the files' rows."""
    options = parser(__doc__, out=False)
    options.add_argument(
        "files", nargs="+", type=Path, help="rows of `deal-hw bench`; later files add to earlier ones"
    )
    options.add_argument("--json", action="store_true", help="print JSON")
    given = options.parse_args()
    rows = [row for file in given.files for row in load_rows(file)]
    found = summary(rows)
    if given.json:
        print(json.dumps(found, indent=1))
        return 0
    for group in found:
        correlation = "none" if group["correlation"] is None else f"{group['correlation']:.2f}"
        print(
            f"{group['task']}, ratio {group['range_ratio']:g}, {group['method']}: correlation {correlation} "
            f"over {group['places']} places of {group['robots']} robots, error "
            f"{group['error_percent']:.3g} %, held-out {group['heldout_over_nominal']:.2g} of nominal "
            "(medians)"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
