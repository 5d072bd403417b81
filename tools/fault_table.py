"""Fault tables: repetitions at random moments beside a stall monitor, and pages of them.

A repetition waits for a random moment of a phase of the run and causes one fault. It is judged by the
emulator's log of commands, the operator's terminal, the exit code and the recording. The log has the
machine's monotonic clock, which all processes share. deal-hw's own report on the robot is not used.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from fault_rig import ARMING, COMMANDING, CONNECTING, ENDING, TAKING_OVER, Case, Rig, SpoiledError, headline
from measuring import head, hear_signals, load, parser, write_document
from stall_monitor import watch_stalls

from deal_hw.control.process.realtime import priority
from deal_hw.data.recording.dataset import Dataset
from deal_hw.errors import DealHwError

FORMAT = "deal_hw.faults/2"
CYCLE_NS = 20_000_000
_BESIDE_NS = 10_000_000
_LONG_PAUSE_NS = 20_000_000
PAUSE_NS = 3_000_000
"""Shortest noted pause of the machine [ns]."""
_ATTEMPTS = 4
"""Attempts at a repetition if its run ends before the fault."""
_RIG_PRIORITY = 45
"""Real-time priority of the thread that causes the fault: it must act at the drawn moment."""


def repetition(
    rig_type: type[Rig], case: Case, wire: str, entropy: Sequence[int], slot: int, typical_s: dict[str, float]
) -> dict[str, Any]:
    """Run one repetition of a case and return its row.

    Args:
        rig_type: The robot.
        case: The case.
        wire: The transport.
        entropy: Decides the moment.
        slot: Number of the job.
        typical_s: Duration of connecting and taking over [s]; updated.

    Raises:
        SpoiledError: In all attempts the run ended before the fault.
    """
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([*entropy, attempt, *case.name.encode()])
        with tempfile.TemporaryDirectory() as text, priority(_RIG_PRIORITY):
            rig = rig_type(case, wire, Path(text), rng, slot, typical_s)
            try:
                return {**_repetition(rig, typical_s), "spoiled_before": attempt}
            except SpoiledError as error:
                if attempt == _ATTEMPTS - 1:
                    raise SpoiledError(f"{case.name}: {error}: {headline(rig.output)}") from error
    raise AssertionError("unreachable")


def _repetition(rig: Rig, typical_s: dict[str, float]) -> dict[str, Any]:
    case = rig.case
    with rig.emulator():
        rig.start()
        try:
            if case.act is not None:
                rig.await_moment()
                case.act(rig)
        except TimeoutError as error:
            rig.notes.append(str(error))
        finally:
            rig.finish()
        # Messages in transit must arrive.
        time.sleep(0.3)
        rig.pump()
        if case.again:
            rig.end_ns = time.monotonic_ns()
            rig.run_again()
    learn(typical_s, rig)
    if not (rig.folder / "emulator.json").exists():
        raise SpoiledError("the emulator died without a report")
    report = json.loads((rig.folder / "emulator.json").read_text())
    row = recording(rig.folder / "run" / "dataset")
    last_cycle_ns = row.pop("last_cycle_ns")
    if rig.fault_ns < 0:
        rig.fault_ns = last_cycle_ns if case.policy else rig.by_itself(report)
        if any(word == "{t}" for word in case.emulator) and rig.fault_ns < 0 and case.expect == "passive":
            raise SpoiledError("the run ended before the emulator's fault began")
    figures = rig.figures(report)
    return {
        "phase": rig.phase,
        "exit_code": rig.run.returncode,
        **row,
        **judge(rig, report),
        **({"figures": figures} if figures else {}),
        "operator": headline(rig.output).replace(f"{rig.folder}/", "PORT/"),
        "notes": rig.printed,
        "complaints": complaints(rig, report, row),
        "fault_ns": rig.fault_ns,
        "start_ns": rig.start_ns,
        "end_ns": time.monotonic_ns(),
    }


def recording(folder: Path) -> dict[str, Any]:
    """Return whether the recording is whole after the automatic repair of the next opening."""
    if not folder.exists():
        return {"dataset": "none", "states": 0, "last_cycle_ns": -1}
    try:
        opened = Dataset.open(folder, notify=lambda text: None)
        episodes = [opened.read(number) for number in opened.numbers]
    except (DealHwError, OSError) as error:
        # A run that ended before the first state has a sound file without one.
        word = "empty" if "no state sample" in str(error) else f"not readable: {error}"
        return {"dataset": word, "states": 0, "last_cycle_ns": -1}
    states = sum(len(episode.trajectory.device_s) for episode in episodes)
    last_ns = -1
    if episodes and len(starts := episodes[-1].cycles.start_s):
        # The faulty cycle is the first passive one, or, if it never ended, the one after the last record.
        printed = episodes[-1].cycles.safety_state
        good = [i for i in range(len(starts)) if printed[i] != "passive"]
        passive = [i for i in range(len(starts)) if printed[i] == "passive"]
        index = passive[0] if passive else good[-1]
        last_ns = episodes[-1].start_ns + round(starts[index] * 1e9) + (0 if passive else CYCLE_NS)
    return {"dataset": "whole" if states else "empty", "states": states, "last_cycle_ns": last_ns}


def judge(rig: Rig, report: Mapping[str, Any]) -> dict[str, Any]:
    """Return by the emulator's log the robot's final state, and the time from the fault to that state.

    If another program goes on commanding, the first time that the robot was made passive counts.
    """
    states = rig.states(report)
    ends = "never commanded"
    if any(active for _, active in states):
        ends = "active" if states[-1][1] else "passive"
    from_ns = rig.fault_ns + round(rig.case.from_ms * 1e6)
    obeys = any(active for _, active in [pair for pair in states if pair[0] < from_ns][-1:])
    after = [(ns, active) for ns, active in states if ns >= from_ns]
    if rig.case.expect == "contested":
        times = [ns for ns, active in after if not active][:1]
    elif obeys or any(active for _, active in after):
        last_active = max((i for i, (_, active) in enumerate(after) if active), default=-1)
        times = [ns for ns, _ in after[last_active + 1 :]][:1]
    else:
        times = [from_ns]
    known = rig.fault_ns > 0 and bool(times)
    return {
        "ends": ends,
        "obeyed": any(active for _, active in [pair for pair in states if pair[0] < rig.fault_ns][-1:]),
        "passive_ms": round(max(times[0] - from_ns, 0) * 1e-6, 1) if known else None,
    }


def complaints(rig: Rig, report: Mapping[str, Any], row: Mapping[str, Any]) -> list[str]:
    """Return the differences from the case's expectation."""
    case, found = rig.case, list(rig.notes)
    end = judge(rig, report)
    late = rig.fault_ns > 0 and (end["passive_ms"] is None or end["passive_ms"] > case.within_ms)
    went_on = rig.run.returncode == 0 and rig.phase != ENDING
    # The motors no longer obeyed when the fault came: the run was over, and the fault found nothing to end.
    over = rig.run.returncode == 0 and rig.phase == ENDING and not end["obeyed"] and end["ends"] == "passive"
    match case.expect:
        case "goes on":
            found += (
                [] if rig.run.returncode == 0 and end["ends"] == "passive" else [f"it ends {end['ends']}"]
            )
        case "passive":
            found += ["it ends active"] if end["ends"] == "active" else []
            found += [f"passive after {end['passive_ms']} ms"] if late and not went_on else []
        case "contested":
            found += [] if end["ends"] != "never commanded" else ["it was never commanded"]
        case "untouched":
            found += [touched] if (touched := rig.untouched(report)) else []
        case "unhomed":
            commanded = [what for _, what in rig.changes(report) if what in rig.active | rig.inactive]
            found += [f"the motors got {commanded}"] if commanded else []
        case "stiff":
            found += [f"it ends {end['ends']}"] if end["ends"] != "active" else []
    if rig.run.returncode not in case.codes and not over:
        found.append(f"exit code {rig.run.returncode}")
    if row["dataset"] not in ("whole", "empty", "none"):
        found.append(row["dataset"])
    if row["dataset"] != "whole" and rig.phase in COMMANDING[1:]:
        found.append(f"recording: {row['dataset']}")
    return found


def learn(typical_s: dict[str, float], rig: Rig) -> None:
    """Update the durations of connecting and taking over on this machine [s]; random moments need them."""
    begun_ns = rig.start_ns
    for phase, event in ((CONNECTING, rig.phase_at(TAKING_OVER)[0]), (TAKING_OVER, rig.phase_at(ARMING)[0])):
        if not (end_ns := rig.event_ns(event)):
            return
        typical_s[phase] += 0.3 * ((end_ns - begun_ns) * 1e-9 - typical_s[phase])
        begun_ns = end_ns


def run_cases(
    rig_type: type[Rig], cases: Sequence[Case], wire: str, given: argparse.Namespace, have: Mapping[str, Any]
) -> Iterator[dict[str, Any]]:
    """Run all repetitions of every case, several at a time, and yield its row.

    Args:
        rig_type: The robot.
        cases: The rows.
        wire: The transport.
        given: Repetitions, jobs and seed.
        have: Rows of earlier calls by fault; their repetitions count.
    """
    typical_s = {CONNECTING: 3.0, TAKING_OVER: 0.5}
    slots = threading.local()
    free = list(range(given.jobs))

    def one(case: Case, number: int) -> dict[str, Any]:
        if not hasattr(slots, "number"):
            slots.number = free.pop()
        return repetition(rig_type, case, wire, [given.seed, number], slots.number, typical_s)

    with ThreadPoolExecutor(given.jobs) as pool:
        for case in cases:
            row = have.get(case.name, {"load": [], "repetitions": []})
            numbers = range(len(row["repetitions"]), given.repetitions)
            if not numbers:
                continue
            loads = [load()]
            with watch_stalls(PAUSE_NS) as account:
                try:
                    done = list(pool.map(lambda number, case=case: one(case, number), numbers))
                except SpoiledError as error:
                    print(f"not measured: {error}", flush=True)
                    continue
            for found in done:
                from_ns = found.pop("fault_ns") + round(1e6 * case.from_ms)
                to_ns = from_ns + round(1e6 * (found["passive_ms"] or 0.0))
                pause_ns = account.longest_between_ns(from_ns - _BESIDE_NS, to_ns + _BESIDE_NS)
                found["pause_ms"] = round(pause_ns * 1e-6, 1)
                longest_ns = account.longest_between_ns(found.pop("start_ns"), found.pop("end_ns"))
                if found["complaints"] and longest_ns > _LONG_PAUSE_NS:
                    ms = round(longest_ns * 1e-6)
                    found["complaints"].append(f"the whole machine stood still for {ms} ms in that run")
            loads.append(load())
            yield summary(
                {
                    "fault": case.name,
                    "wire": wire,
                    "expected": case.expect,
                    "from_return": case.from_ms > 0,
                    "load": [*row["load"], *loads],
                    "repetitions": [*row["repetitions"], *done],
                }
            )


def summary(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with the statistics of its repetitions."""
    done = row["repetitions"]
    # There is no time if the robot followed no commands at the fault, or if the fault did not end the run.
    went_on = [r for r in done if r["exit_code"] == 0 and r["phase"] != ENDING]
    counted = [r for r in done if r["obeyed"] and r["passive_ms"] is not None and r not in went_on]
    times = [r["passive_ms"] for r in counted] if row["expected"] in ("passive", "contested") else []
    worst = max(counted, key=lambda r: r["passive_ms"]) if times else None
    return {
        **row,
        "median_ms": round(statistics.median(times), 1) if times else None,
        "worst_ms": worst["passive_ms"] if worst else None,
        "pause_beside_worst_ms": worst["pause_ms"] if worst else None,
        "count": len(done),
        "timed": len(times),
        "went_on": len(went_on),
        "as_expected": sum(not r["complaints"] for r in done),
    }


# Pages and programs.


def page(title: str, words: Sequence[str], results: Sequence[Mapping[str, Any]]) -> str:
    """Return the tables of several wires as one page; files of the same wire share a column."""
    results = [{**result, "rows": [summary(row) for row in result["rows"]]} for result in results]
    wires = list(dict.fromkeys(row["wire"] for result in results for row in result["rows"]))
    names = dict.fromkeys(row["fault"] for result in results for row in result["rows"])
    loads = [one for result in results for row in result["rows"] for one in row["load"]]
    first = results[0]["calls"][-1]["machine"]
    lines = [
        f"# {title}",
        "",
        *words,
        f"Machine: {first['platform']}, {first['processors']} processors, shared with other work, load "
        f"{min(loads):.1f} to {max(loads):.1f}.",
        "",
        "*20/20*: all twenty repetitions were as expected. Times are median / worst, from the fault (after a",
        "lost link: from its return) until the robot stayed passive, by the emulator's own log. *of 13*:",
        "only 13 repetitions count, in which the robot followed commands when the fault came.",
        "In brackets: the longest pause of the whole machine near the worst time, by a stall monitor.",
        "",
        f"| fault | expected | {' | '.join(f'{wire} [ms]' for wire in wires)} | exit codes | recordings | "
        "the operator reads |",
        "|---|---|" + "---:|" * len(wires) + "---|---|---|",
    ]
    for name in names:
        found = {row["wire"]: row for result in results for row in result["rows"] if row["fault"] == name}
        rows = [found.get(wire) for wire in wires]
        known = [row for row in rows if row is not None]
        each = [r for row in known for r in row["repetitions"]]
        codes = ", ".join(str(code) for code in sorted({r["exit_code"] for r in each}))
        data = ", ".join(sorted({r["dataset"].partition(":")[0] for r in each}))
        printed = next((r["operator"] for r in each if r["operator"]), "(nothing)").replace("|", "/")
        cells = " | ".join(cell(row) for row in rows)
        lines.append(
            f"| {name} | {known[0]['expected']} | {cells} | {codes} | {data} | {shortened(printed)} |"
        )
    lines += figure_table(results)
    bad = []
    for row in (row for result in results for row in result["rows"]):
        if row["as_expected"] < row["count"]:
            why = sorted({text for r in row["repetitions"] for text in r["complaints"]})
            bad.append(f"- {row['wire']}, {row['fault']}: {'; '.join(why)}")
    lines += ["", "Not as expected: none." if not bad else "Not as expected:", *(["", *bad] if bad else [])]
    return "\n".join(lines).rstrip() + "\n"


def figure_table(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of a table of further figures, median and worst of each; none where there are none."""
    found: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for row in (row for result in results for row in result["rows"]):
        for one in row["repetitions"]:
            for name, value in one.get("figures", {}).items():
                found[name, row["fault"], row["wire"]].append(value)
    if not found:
        return []
    lines = [
        f"| {name} | {fault} | {wire} | {statistics.median(values):.3g} / {max(values):.3g} | {len(values)} |"
        for (name, fault, wire), values in sorted(found.items())
    ]
    heads = "| figure | fault | wire | median / worst | repetitions |"
    return ["", heads, "|---|---|---|---:|---:|", *lines]


def shortened(printed: str) -> str:
    """Return the operator's message without addresses of this machine."""
    printed = re.sub(r"/tmp/\S+|tcp/\S+", "PORT:", printed)
    return printed if len(printed) <= 110 else printed[:107] + "..."


def cell(row: Mapping[str, Any] | None) -> str:
    """Return a row's times for a cell of the page."""
    if row is None:
        return ""
    text = ""
    if row["median_ms"] is not None:
        text = f"{row['median_ms']:.0f} / {row['worst_ms']:.0f}"
        text += f" of {row['timed']}" if row["timed"] < row["count"] else ""
        text += f" ({row['pause_beside_worst_ms']:.0f})" if row["pause_beside_worst_ms"] else ""
    text += f", {row['went_on']} went on" if row["went_on"] and row["expected"] == "passive" else ""
    return f"{text}; {row['as_expected']}/{row['count']}".removeprefix("; ")


def main(
    rig_type: type[Rig],
    cases: Sequence[Case],
    title: str,
    words: Sequence[str],
    doc: str | None,
    arguments: Sequence[str] | None = None,
) -> int:
    """Run a table, or write a page; return 1 if a repetition was not as expected.

    Args:
        rig_type: The robot.
        cases: The rows.
        title: Title of the page.
        words: What comes before the page's table.
        doc: Description of the tool.
        arguments: Its arguments; None: the program's.
    """
    options = parser(doc, out=False)
    if len(rig_type.wires) > 1:
        options.add_argument("--transport", choices=rig_type.wires, default=rig_type.wires[0])
    options.add_argument("--repetitions", type=int, default=20)
    options.add_argument("--only", default="", help="only rows whose name matches this regular expression")
    options.add_argument("--skip", default="^$", help="leave out rows whose name matches this one")
    options.add_argument("--seed", type=int, default=0, help="draws phases and moments")
    options.add_argument(
        "--jobs", type=int, default=1, help="repetitions at the same time, each on a wire of its own"
    )
    options.add_argument("--list", action="store_true", help="list the rows")
    options.add_argument("--out", type=Path, default=None, help="results; repetitions in it count")
    options.add_argument(
        "--table",
        type=Path,
        nargs="+",
        default=None,
        metavar="FILE",
        help="write a page (first) from results (others), and measure nothing",
    )
    given = options.parse_args(arguments)
    if given.table is not None:
        results = [json.loads(path.read_text(encoding="utf-8")) for path in given.table[1:]]
        given.table[0].write_text(page(title, words, results), encoding="utf-8")
        return 0
    wire = getattr(given, "transport", rig_type.wires[0])
    chosen = [
        case
        for case in cases
        if wire in (case.wires or rig_type.wires)
        and re.search(given.only, case.name)
        and not re.search(given.skip, case.name)
    ]
    if given.list:
        print("\n".join(f"{case.expect:10} {case.name}" for case in chosen))
        return 0
    hear_signals()
    calls, rows = earlier(given.out)
    calls.append(head(sys.argv[0]))
    bad = 0
    for row in run_cases(rig_type, chosen, wire, given, rows):
        rows[row["fault"]] = row
        bad += row["as_expected"] < row["count"]
        print(line(row), flush=True)
        if given.out is not None:
            order = [case.name for case in cases]
            known = sorted(rows.values(), key=lambda one: order.index(one["fault"]))
            write_document(given.out, {"format": FORMAT, "calls": calls, "rows": known})
    return int(bad > 0)


def earlier(path: Path | None) -> tuple[list[Any], dict[str, Any]]:
    """Return the calls of a results file, and its rows by fault."""
    if path is None or not path.exists():
        return [], {}
    known = json.loads(path.read_text(encoding="utf-8"))
    if known.get("format") != FORMAT:
        return [], {}
    return known["calls"], {row["fault"]: row for row in known["rows"]}


def line(row: Mapping[str, Any]) -> str:
    """Return a row for the terminal."""
    good = row["as_expected"] == row["count"]
    times = "" if row["median_ms"] is None else f"{row['median_ms']:.0f} / {row['worst_ms']:.0f} ms"
    codes = sorted({r["exit_code"] for r in row["repetitions"]})
    data = Counter(r["dataset"].partition(":")[0] for r in row["repetitions"])
    kept = ", ".join(f"{count} {word}" for word, count in data.items())
    text = (
        f"{'ok ' if good else 'BAD'} {row['fault']:62} {times:>16} {row['as_expected']}/{row['count']} "
        f"exit {codes} dataset: {kept} load {row['load'][0]:.1f}"
    )
    for r in row["repetitions"]:
        if r["complaints"]:
            text += f"\n      {r['phase']}: {'; '.join(r['complaints'])} [{r['operator'][:150]}]"
    return text
