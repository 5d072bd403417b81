#!/usr/bin/env python3
"""How long `train`, `calibrate` and `demo` live after a signal, and what they leave behind.

python tools/measure_interrupts.py runs/demo/dataset --runs 20 --out interrupts.json

Each run starts a verb in a process of its own and sends it SIGINT or SIGTERM, in turn, after a drawn time.
Noted are the seconds until the process has ended, its exit code, processes that outlive it, and files that
are not whole. The load stands beside each row: on a busy computer a verb hears late. The exit code is 1 if a
run took longer than five seconds, was killed, or left something behind.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Rows, load, parser
from safetensors import safe_open

from deal_hw.policies.onnx_runtime import OnnxPolicy

MOST_S = 5.0
"""A signal must have ended the verb after this time [s]."""
PATIENCE_S = 60.0
"""Then it is killed [s]."""
MARK = "DEAL_HW_MEASURED_RUN"
"""Environment variable by which the processes of a run are found."""
INTERRUPTED = 130


def command(verb: str, dataset: Path, out: Path) -> list[str]:
    """Return the command line of a verb that runs for minutes."""
    arguments = {
        "train": ["train", "cartpole", "--udr", "--steps", "1000000", "--out", str(out)],
        "train-go2": ["train", "go2", "--udr", "--steps", "10000000", "--out", str(out)],
        "calibrate": ["calibrate", str(dataset), "--out", str(out)],
        "demo": ["demo", "cartpole", "--out", str(out)],
        "calibrate-deal": ["calibrate", str(dataset), "--search", "deal", "--no-refine", "--out", str(out)],
    }
    return [sys.executable, "-m", "deal_hw", *arguments[verb]]


VERBS = ("train", "train-go2", "calibrate", "calibrate-deal", "demo")


def left_over(mark: str) -> list[int]:
    """Return the ids of processes with a mark in their environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


def broken(folder: Path) -> Iterator[str]:
    """Yield the files of a folder that are not whole, with what is wrong."""
    for path in sorted(folder.rglob("*")):
        if ".draft" in path.name:
            yield f"{path.name}: a draft"
            continue
        try:
            if path.suffix == ".json":
                json.loads(path.read_text(encoding="utf-8"))
            elif path.suffix == ".npz":
                with np.load(path, allow_pickle=False) as arrays:
                    list(arrays.values())
            elif path.suffix == ".safetensors":
                with safe_open(path, framework="np") as tensors:
                    [tensors.get_tensor(name) for name in tensors.keys()]
            elif path.suffix == ".onnx":
                OnnxPolicy(path)
        except Exception as error:
            yield f"{path.name}: {type(error).__name__}: {error}"


def measure(verb: str, dataset: Path, number: signal.Signals, after_s: float) -> dict[str, Any]:
    """Start a verb, send it a signal, and return what became of it."""
    mark = uuid.uuid4().hex
    with tempfile.TemporaryDirectory() as out, tempfile.TemporaryFile() as printed:
        process = subprocess.Popen(
            command(verb, dataset, Path(out)),
            stdout=printed,
            stderr=subprocess.STDOUT,
            env={**os.environ, MARK: mark},
            # A shell lets programs in the background ignore SIGINT, and this one may be such a program.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        time.sleep(after_s)
        now_load, early = load(), process.poll()
        process.send_signal(number)
        sent = time.monotonic()
        try:
            code = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        took_s = time.monotonic() - sent
        printed.seek(0)
        words = printed.read().decode(errors="replace").strip().splitlines()
        return {
            "verb": verb,
            "signal": number.name,
            "after_s": round(after_s, 2),
            "took_s": round(took_s, 2),
            "exit_code": code,
            "ended_before": early is not None,
            "processes_left": len(left_over(mark)),
            "broken_files": list(broken(Path(out))),
            "files": sorted(path.name for path in Path(out).rglob("*") if path.is_file()),
            "last_words": words[-1][-200:] if words else "",
            "load": now_load,
        }


def sound(row: Mapping[str, Any]) -> bool:
    """Return whether a run ended in time and as it should."""
    # Python ends itself by SIGINT after any interrupt that came while it ran text, as dataclasses do; and a
    # signal ends it before the verb has taken signals. A shell sees 130 or 143.
    codes = (INTERRUPTED, -signal.Signals[row["signal"]])
    in_time = row["took_s"] <= MOST_S and row["exit_code"] in codes
    # A verb that was refused has met no signal.
    ended = row["exit_code"] == 0 if row["ended_before"] else in_time
    return ended and not row["processes_left"] and not row["broken_files"]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line for each verb and signal."""
    lines = ["verb            signal   runs  sound  longest [s]  load"]
    for verb in dict.fromkeys(row["verb"] for row in rows):
        for name in dict.fromkeys(row["signal"] for row in rows):
            own = [row for row in rows if (row["verb"], row["signal"]) == (verb, name)]
            if own:
                longest, loads = max(row["took_s"] for row in own), [row["load"] for row in own]
                lines.append(
                    f"{verb:<15} {name:<8} {len(own):4d}  {sum(map(sound, own)):5d}  {longest:11.1f}  "
                    f"{min(loads):.0f} to {max(loads):.0f}"
                )
    return "\n".join(lines)


def main(words: Sequence[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("dataset", type=Path, help="of a cart-pole, such as the demo's")
    options.add_argument("--runs", type=int, default=20, help="signals in all, the verbs in turn")
    options.add_argument("--verbs", nargs="+", choices=VERBS, default=VERBS)
    options.add_argument("--longest", type=float, default=40.0, help="latest signal [s]")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args(words)
    rng, rows = np.random.default_rng(given.seed), Rows(__file__, given.out)
    for run in range(given.runs):
        verb = given.verbs[run % len(given.verbs)]
        number = (signal.SIGINT, signal.SIGTERM)[run // len(given.verbs) % 2]
        row = measure(verb, given.dataset, number, float(rng.uniform(0.5, given.longest)))
        rows.add(row, json.dumps({name: value for name, value in row.items() if name != "files"}))
    print(table(rows.rows))
    return int(not all(map(sound, rows.rows)))


if __name__ == "__main__":
    # A reader such as `head` that has read enough ends it, as it ends other programs. No verb runs then.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    sys.exit(main())
