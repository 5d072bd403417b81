"""Tables and lines of benches with a known truth, and of the bench on real recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from deal_hw.calib.pipeline.methods import is_default


def line(row: Mapping[str, Any]) -> str:
    """Return one row in words."""
    head = f"{' '.join(_group(row))} seed {row['seed']}"
    if row["error"]:
        return f"{head}: {row['error']}"
    if row["bench"] == "real":
        errors = (f"{name} {row[f'heldout_rmse_{name}']:.4g}" for name in ("nominal", "calibrated"))
        return f"{head}: held-out RMSE {', '.join(errors)}, {row['seconds']:.0f} s"
    text = f"{head}: error {row['error_percent']:.2f} %, log error x100 {row['log_error_x100']:.2f}"
    text += f", {row['seconds']:.0f} s"
    if "angle_error_retrained" in row:
        text += (
            f", angle error UDR {row['angle_error_udr']:.4f} retrained {row['angle_error_retrained']:.4f} "
            f"oracle {row['angle_error_oracle']:.4f} rad"
        )
    return text


def print_real(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print held-out errors, one line per row."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="held-out RMSE in rad or m: mean over joints, all samples pooled")
    words = ("robot", "held out", "method")
    for name in (*words, "seed", "mean", "pooled", "nominal", "at a bound", "flagged", "seconds"):
        table.add_column(name, justify="left" if name in words else "right")
    for row in rows:
        numbers = (
            row.get(f"heldout_{key}") for key in ("rmse_calibrated", "pooled_calibrated", "rmse_nominal")
        )
        table.add_row(
            row["task"],
            row.get("split", ""),
            _group(row)[-1],
            str(row["seed"]),
            *("diverged" if value is None else f"{value:.4f}" for value in numbers),
            str(len(row["at_bound"])),
            str(int(row["flagged"])),
            f"{row['seconds']:.0f}",
        )
    Console(width=120).print(table)


def print_summary(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print median and worst by profile and method."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table(title="median over seeds (worst)")
    for name in (
        "task",
        "profile",
        "range_ratio",
        "method",
        "seeds",
        "error %",
        "log error x100",
        "coverage90",
        "width90",
        "held-out / nominal",
        "latency error ms",
        "flagged",
        "seconds",
    ):
        table.add_column(name, justify="left" if name in ("task", "profile", "method") else "right")
    for group in dict.fromkeys(_group(row) for row in rows):
        part = [row for row in rows if _group(row) == group]

        def values(name: str, rows: Sequence[Mapping[str, Any]] = part) -> Any:
            return np.array([row[name] for row in rows], dtype=float)

        ratio = values("heldout_nrmse_calibrated") / values("heldout_nrmse_nominal")
        late = 1e3 * np.abs(values("latency_found") - values("latency_true"))
        table.add_row(
            *group,
            str(len(part)),
            *(
                f"{np.median(values(n)):.2f} ({values(n).max():.2f})"
                for n in ("error_percent", "log_error_x100")
            ),
            f"{values('coverage90').mean():.2f}",
            f"{np.median(values('width90')):.2f}",
            f"{np.median(ratio):.3f} ({ratio.max():.3f})",
            f"{np.median(late):.2f} ({late.max():.2f})",
            f"{int(values('flagged').sum())}",
            f"{np.median(values('seconds')):.0f} ({values('seconds').max():.0f})",
        )
    Console(width=150).print(table)


def method_name(row: Mapping[str, Any]) -> str:
    """Return a row's method, whether a refinement followed, if that is a choice, and another engine."""
    method = str(row["method"])
    refined = " + refinement" if row.get("refined") and not is_default(method) else ""
    engine = f" on {row['engine']}" if row.get("engine") else ""
    return f"{method}{refined}{engine}"


def _group(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the key of a line in the summary."""
    return row.get("task", "cartpole"), row["profile"], f"{row['range_ratio']:g}", method_name(row)
