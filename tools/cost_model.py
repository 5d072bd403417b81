"""What a search costs on other machines: a model of the measured rows, checked on others.

A generation costs the physics of all members, which cores share, and the rest: critic, policy and arithmetic
of one process, which they do not. The rest is linear in the members; its two numbers are fitted to the
cart-pole's rows of `bench speed` with fewer than 400 members, and scaled to each task's own row. Rows that
took no part in that are predicted, and the error is printed.

.venv/bin/python tools/cost_model.py
.venv/bin/python tools/cost_model.py --members 200,4096 --cores 2,16,64
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.bench.rows import load_rows
from deal_hw.workflows.say import text_table

MEASURED = Path(__file__).resolve().parents[1] / "docs" / "measured"

RAY_SHARE: Final = 0.03
"""Share of a core that Ray's own processes take while workers run (docs/how-to/cluster.md)."""


@dataclass(frozen=True)
class Cost:
    """The cost of a task's generation.

    Attributes:
        step_s: Processor time of a physics step of one member [s].
        steps: Physics steps of a member in a generation.
        fixed_s: The rest that does not depend on the members [s].
        member_s: The rest for each member [s].
    """

    step_s: float
    steps: float
    fixed_s: float
    member_s: float

    def rest(self, members: int) -> float:
        """Return the seconds of a generation that no further core shares."""
        return self.fixed_s + self.member_s * members

    def on_cores(self, members: int, cores: int) -> float:
        """Return a generation's seconds on so many cores; a member is simulated on one."""
        busy = min(cores, members)
        return members * self.steps * self.step_s / busy + self.rest(members)


def rest_of(row: dict[str, Any]) -> float:
    """Return a measured generation's seconds beside physics."""
    return float((row["seconds"] - row["seconds_physics"]) / row["generations"])


def fit(rows: Iterable[dict[str, Any]]) -> tuple[float, float]:
    """Return the rest's seconds a generation, and for each member, of one task's rows."""
    found = list(rows)
    columns = np.array([[1.0, row["population"]] for row in found])
    fixed, member = np.linalg.lstsq(columns, np.array([rest_of(row) for row in found]), rcond=None)[0]
    return float(fixed), float(member)


def costs(speed: Sequence[dict[str, Any]], members: Sequence[dict[str, Any]]) -> dict[str, Cost]:
    """Return each task's cost.

    Args:
        speed: Rows of one population, one a task.
        members: Rows of the cart-pole with several populations.
    """
    fixed, member = fit(members)
    found = {}
    for row in speed:
        scale = rest_of(row) / (fixed + member * row["population"])
        found[row["task"]] = Cost(
            step_s=1e-6 * row["bare_step_us"] * row["threads"],
            steps=row["steps"] / row["population"] / row["generations"],
            fixed_s=scale * fixed,
            member_s=scale * member,
        )
    return found


def predicted(cost: Cost, row: dict[str, Any]) -> float:
    """Return the seconds of a measured row by the model."""
    return float(row["generations"] * cost.on_cores(row["population"], row["threads"]))


def main() -> None:
    """Fit, check on rows that took no part, and print what other machines would take."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--members", default="200,4096", help="members of the search")
    options.add_argument("--cores", default="2,16,64", help="cores of one machine")
    options.add_argument("--generations", type=int, default=50)
    args = options.parse_args()
    cores, members = ([int(word) for word in text.split(",")] for text in (args.cores, args.members))
    speed, varied = load_rows(MEASURED / "speed.json"), load_rows(MEASURED / "speed_cost.json")
    known = checked("deal-paper", speed, varied)
    for count in members:
        show(known, count, args.generations, cores)
    print("\nSearches an hour of 200 members on 1,000 cores, by Ray with two cores each:")
    many = [
        (task, f"{500 * (1 - RAY_SHARE) * 3600 / (args.generations * cost.on_cores(200, 2)):,.0f}")
        for task, cost in known.items()
    ]
    print(text_table(("task", "searches an hour"), many))
    windows = load_rows(MEASURED / "speed_windows.json")
    for method in ("deal", "eki"):
        rows = [row for row in windows if row["method"] == method]
        usual = [row for row in rows if row["population"] == 100]
        known = checked(method, usual, [row for row in rows if row not in usual or row["task"] == "cartpole"])
        for count in (100, 1000):
            show(known, count, args.generations, cores)


def checked(
    method: str, speed: Sequence[dict[str, Any]], varied: Sequence[dict[str, Any]]
) -> dict[str, Cost]:
    """Fit a method's rows, and print how rows that took no part in the fit are predicted."""
    fitted = [row for row in varied if row["task"] == "cartpole" and row["population"] < 400]
    known = costs(speed, fitted)
    print(f"\n{method}: rows that took no part in the fit:")
    check = [
        (row["task"], row["parameters"], row["population"], row["generations"], f"{row['seconds']:.1f}",
         f"{predicted(known[row['task']], row):.1f}")
        for row in varied
        if row not in fitted
    ]  # fmt: skip
    print(text_table(("task", "parameters", "members", "generations", "measured [s]", "model [s]"), check))
    return known


def show(known: dict[str, Cost], members: int, generations: int, cores: Sequence[int]) -> None:
    """Print what generations take on machines with so many cores."""
    print(f"\n{generations} generations of {members} members [s]; in brackets the share of the rest:")
    rows = []
    for task, cost in known.items():
        taken = [cost.on_cores(members, n) for n in cores]
        cells = [f"{generations * t:.0f} ({cost.rest(members) / t:.0%})" for t in taken]
        balance = members * cost.steps * cost.step_s / cost.rest(members)
        rows.append((task, *cells, f"{balance:.0f}"))
    print(text_table(("task", *(f"{n} cores" for n in cores), "cores at which the rest is half"), rows))


if __name__ == "__main__":
    main()
