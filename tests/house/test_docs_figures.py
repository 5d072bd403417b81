"""Figures that pages print are those of the row files in docs/measured."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT / "docs" / "measured"
PAPER = (ROOT / "docs" / "results" / "paper.md").read_text(encoding="utf-8")
BENCH = (ROOT / "docs" / "results" / "bench.md").read_text(encoding="utf-8")
FEET = "dae9d9a1"
"""The commit since which the humanoid's feet have friction."""


def rows(name: str, **wanted: Any) -> list[dict[str, Any]]:
    """Return the rows of a file whose fields have these values, without those that have an error."""
    found: list[dict[str, Any]] = json.loads((MEASURED / f"{name}.json").read_text(encoding="utf-8"))["rows"]
    return [
        row
        for row in found
        if not row.get("error") and all(row.get(key) == value for key, value in wanted.items())
    ]


def part(page: str, heading: str) -> str:
    """Return what stands under a heading, without the parts of equal rank behind it."""
    marks = heading.split(" ")[0]
    return page.partition(f"\n{heading}\n")[2].partition(f"\n{marks} ")[0]


def cells(text: str, begin: str) -> list[str]:
    """Return the cells of the one line of a table that begins so."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {begin}")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def numbers(text: str) -> list[float]:
    """Return the numbers of a text, in its order."""
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def error_by_ratio(name: str, **wanted: Any) -> list[list[float]]:
    """Return the errors [%] at ratios 10, 15 and 20, sorted, of all seeds each."""
    return [
        sorted(row["error_percent"] for row in rows(name, range_ratio=ratio, **wanted))
        for ratio in (10.0, 15.0, 20.0)
    ]


def test_errors_of_the_paper_are_those_that_the_tool_has() -> None:
    """The first line of the headline table is the paper's DEAL in Tables 12 to 14."""
    printed = cells(part(PAPER, "### What stands"), "DEAL, as the paper prints it")[1:]
    sources = ("Table 12, cart-pole", "Table 13, humanoid", "Table 14, hand")
    for cell, source in zip(printed, sources, strict=True):
        found = [row["error_percent"] for row in rows("paper_update", update="DEAL", source=source)]
        assert numbers(cell) == pytest.approx(found)


def test_the_headline_table_has_the_errors_of_its_rows() -> None:
    """Without data the worst of three seeds; with the recording the range of the seeds, or the one."""
    table = part(PAPER, "### What stands")
    flat = {"method": "deal-paper-literal-flat"}
    without = [
        error_by_ratio("paper_table1_no_data", **flat),
        *(
            error_by_ratio("paper_no_data_humanoid_allegro", task=task, **flat)
            for task in ("humanoid", "allegro")
        ),
    ]
    line = cells(table, "the update to the letter, **no data**")
    for cell, errors in zip(line[1:], without, strict=True):
        assert [len(seeds) for seeds in errors] == [3, 3, 3]
        assert numbers(cell) == [round(seeds[-1]) for seeds in errors]
    line = cells(table, "the update to the letter, with the recording")
    assert numbers(line[1]) == [
        round(end) for seeds in error_by_ratio("paper_table1_literal") for end in (seeds[0], seeds[-1])
    ]
    for cell, table_name in zip(line[2:], ("paper_table13_literal", "paper_table14_literal"), strict=True):
        both = zip(error_by_ratio(table_name), error_by_ratio(f"{table_name}_15_20"), strict=True)
        assert numbers(cell) == [round(error) for a, b in both for error in a + b]


def test_bo_critic_of_the_ant_has_the_errors_of_its_rows() -> None:
    """Figure 4's table of the ant, all methods."""
    table = part(PAPER, "## Figure 4: transfer").partition("\nAnt, ")[2].partition("\nGo2, ")[0]
    for method in ("udr", "nominal", "easi", "bo-critic", "deal-paper", "deal-paper-literal"):
        found = [rows("transfer_ant", method=method, seed=seed)[0] for seed in (1000, 1001, 1002)]
        printed = cells(table, f"`{method}`")
        assert numbers(printed[1]) == [round(row["error_percent"]) for row in found]
        assert numbers(printed[2]) == [round(row["return"]) for row in found]


@pytest.mark.parametrize(
    "name", sorted(set(re.findall(r"`(verdict_\w+)\.json`\)", BENCH)) - {"verdict_sign"})
)
def test_seconds_of_a_verdict_are_those_of_its_rows(name: str) -> None:
    """From the fastest robot to the slowest; where the page says so, of amber ones alone."""
    (line,) = [line for line in BENCH.splitlines() if line.startswith("| ") and f"`{name}.json`" in line]
    words = re.search(r"(?:, |in )(\d+) to (\d+) s", line) or re.search(r"\| (\d+) to (\d+) \|", line)
    assert words is not None
    found = rows(name, colour="amber") if re.search(r"amber, in \d+ to", line) else rows(name)
    seconds = [row["seconds"] for row in found if row["seconds"] is not None]
    assert [int(word) for word in words.groups()] == [round(min(seconds)), round(max(seconds))]


def test_errors_of_the_real_cart_pole_are_those_of_its_rows() -> None:
    """Median over six recordings left out, predictions of 0.2 s, cart [mm] and pole [mrad]."""
    found = np.median([row["calibrated"]["0.2"] for row in rows("cartpole_real")], axis=0)
    printed = re.search(r"\[now\]\(\S+cartpole_real\.json\) with `deal`\s+([\d.]+) and ([\d.]+)\)", BENCH)
    assert printed is not None
    assert [float(word) for word in printed.groups()] == [round(found[0], 2), round(found[1], 1)]


def test_the_start_page_has_the_errors_of_the_table_of_real_robots() -> None:
    """SO-101 and Go2, two splits each, beside mujoco.sysid; and the processor seconds."""
    page = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    robots = ("so101", "so101-other", "go2", "go2-first")
    for column, method in ((1, "default"), (2, "mujoco-sysid")):
        found = [rows("real_robots", robot=robot, method=method)[0] for robot in robots]
        errors = [
            number
            for begin in ("SO-101, real", "Go2 on a stand")
            for number in numbers(cells(page, begin)[column])
        ]
        assert errors == [round(row["rmse"], 4) for row in found]
        seconds = numbers(cells(page, "the same, processor time")[column])
        assert seconds == [round(row["processor_seconds"]) for row in found]


def test_the_loop_has_both_ratios_of_table_2() -> None:
    """The median over ten robots of the ratio of the calibrated policy to uniform randomisation."""
    loop = rows("loop_sensor")
    angle, speed = (
        np.median([row[f"{name}_retrained"] / row[f"{name}_udr"] for row in loop])
        for name in ("angle_error", "cart_speed")
    )
    page = (ROOT / "docs" / "results" / "index.md").read_text(encoding="utf-8")
    assert f"is {angle:.2f} for the angle and {speed:.2f} for the cart's speed" in page
    assert f"ratios to UDR {angle:.2f} and {speed:.2f} " in PAPER


@pytest.mark.parametrize("page", ["README.md", "docs/results/bench.md"])
def test_how_often_a_search_ran_is_that_of_its_rows(page: str) -> None:
    """Whole calibrations of emulated cart-poles of profile `realistic` at ratio 5, forty reporting seeds."""
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    files = ("coverage_realistic_1000", "coverage_realistic", "coverage_realistic_1020")
    searched = [[row["search"] != "local fit" for row in rows(name)] for name in files]
    first, later = searched[0] + searched[1], searched[2]
    said = {
        "README.md": f"It did on {sum(first + later)} of {len(first + later)} emulated",
        "docs/results/bench.md": f"{sum(first)} of {len(first)} (seeds",
    }[page]
    assert said in text and (page == "README.md" or f"{sum(later)} of {len(later)} ([1020" in text)
    assert [row["search"] for row in rows("verdict_right")] == ["local fit"] * 10


def test_rows_of_a_humanoid_with_friction_are_named() -> None:
    """The page names each file whose rows are of a humanoid with friction at its feet, and no other."""
    words = BENCH.partition("all others are of the one without:")[2].partition("\n\n")[0]
    named = set(re.findall(r"`(\w+)`", words))
    files = {
        path.stem: json.loads(path.read_text(encoding="utf-8")).get("machine", {}).get("git_commit", "")
        for path in MEASURED.glob("*.json")
        if '"humanoid"' in path.read_text(encoding="utf-8")
    }
    assert named <= set(files)
    try:
        git = ["git", "-C", str(ROOT), "merge-base", "--is-ancestor", FEET]
        known = subprocess.run([*git, "HEAD"], capture_output=True).returncode == 0
    except FileNotFoundError:
        known = False
    if not known:
        pytest.skip("a checkout without this history")
    commits = {name: commit.removesuffix("-dirty") for name, commit in files.items()}
    after = {
        name
        for name, commit in commits.items()
        if not subprocess.run([*git, commit], capture_output=True).returncode
    }
    assert after == named


def test_errors_at_ratios_3_and_5_are_those_of_their_rows() -> None:
    """With the recording and without, seeds 1010 to 1012; without data the least of all readings."""
    with_data = {
        ratio: [
            round(row["error_percent"])
            for row in rows("paper_update_recording", range_ratio=ratio, demonstration="")
        ]
        for ratio in (3.0, 5.0)
    }
    flat = {
        ratio: [
            round(row["error_percent"])
            for row in rows("paper_no_data_3_5", range_ratio=ratio, method="deal-paper-literal-flat")
        ]
        for ratio in (3.0, 5.0)
    }
    a, b = ("{}, {} and {} %".format(*with_data[ratio]) for ratio in (3.0, 5.0))
    c, d = ("{}, {}, {}".format(*flat[ratio]) for ratio in (3.0, 5.0))
    assert f"ends at {a} and at {b}, without data at {c} and {d} %" in PAPER
    least = []
    for ratio in (3.0, 5.0):
        errors: dict[str, list[float]] = {}
        for row in rows("paper_update", range_ratio=ratio, parameters=11):
            errors.setdefault(row["update"], []).append(row["error_percent"])
        least.append(round(min(float(np.mean(values)) for values in errors.values())))
    assert f"comes below {least[0]} % at 3 and {least[1]} % at 5" in PAPER
