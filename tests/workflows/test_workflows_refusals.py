"""Python and the command line refuse the same with the same words: one table for both."""

from __future__ import annotations

import dataclasses
import inspect
import math
from pathlib import Path
from typing import Any

import pytest

import deal_hw
from deal_hw.cli.main import EXIT_ERROR, main
from deal_hw.errors import ConfigurationError, DealHwError, UnknownNameError
from deal_hw.ranges import option
from deal_hw.workflows.emulation.process import arguments

POSITIONAL = ("robot", "episode", "model")
LINES = {
    "new_robot": ["robot", "new"],
    "check_robot": ["robot", "check"],
    "lock_joints": ["robot", "lock"],
    "import_policy": ["policy", "import"],
    "check_policy": ["policy", "check"],
}
"""Functions that are part of a verb."""
CARTPOLE: dict[str, Any] = {"robot": "cartpole", "port": "no-port"}
COLLECT = {**CARTPOLE, "out": "out"}
IMPORT: dict[str, Any] = {"policy": "p.onnx", "robot": "go2", "out": "w.onnx"}
SWEEP = {"robot": "cartpole", "out": "e.json"}

TABLE: list[tuple[str, dict[str, Any], str]] = [
    ("collect", {**COLLECT, "robot": "go3"}, "unknown robot 'go3'; known: "),
    ("collect", {**COLLECT, "seconds": 0.0}, "--seconds 0.0 s: allowed are 0.02 to 3600 s"),
    ("collect", {**COLLECT, "seconds": math.nan}, "--seconds nan s: allowed are"),
    ("collect", {**COLLECT, "seed": -1}, "--seed -1: allowed are 0 to"),
    ("collect", {**COLLECT, "motion": "jump"}, "unknown motion 'jump'; known: rich, chirp, balance, hold"),
    ("collect", {**COLLECT, "excite": "sine"}, "sine"),
    ("collect", {**COLLECT, "excite": "chirp", "motion": "hold"}, "--motion would have no effect"),
    (
        "collect",
        {**COLLECT, "motion": "chirp", "excitation_level": 1.0},
        "--excitation-level would have no effect",
    ),
    ("collect", {**COLLECT, "link": deal_hw.LinkOptions(transport="dds")}, "dds"),
    ("collect", CARTPOLE, "give --out RUN (the episodes go to RUN/dataset) or --dataset DIR"),
    ("collect", {**COLLECT, "dataset": "d"}, "give --out RUN or --dataset DIR, not both"),
    ("collect", COLLECT, "no-port"),
    ("collect", {"robot": "r.yaml", "port": "p", "out": "out"}, "r.yaml cannot be read: there is no such"),
    ("new_robot", {"model": "m.xml"}, "model m.xml does not exist"),
    ("new_robot", {"model": "m.xml", "control_rate": 0.0}, "--control-rate 0.0 Hz: allowed are 0.001 to"),
    ("lock_joints", {"model": "m.xml", "joints": ["a"]}, "model m.xml does not exist"),
    ("check_robot", {"robot": "r.yaml"}, "r.yaml cannot be read: there is no such file"),
    ("check_policy", {"policy": "none.onnx"}, "no such policy file: none.onnx"),
    ("import_policy", {**IMPORT, "policy": "none.onnx"}, "no such file: none.onnx"),
    ("import_policy", {**IMPORT, "robot": "go3"}, "unknown robot 'go3'; known: "),
    ("import_policy", {**IMPORT, "control_rate": 0.0}, "--control-rate 0.0 Hz: allowed are 1 to 1000 Hz"),
    ("deploy", {**CARTPOLE, "robot": "go2_suspended"}, "go2_suspended"),
    ("deploy", {**CARTPOLE, "policy": "none.onnx"}, "none.onnx"),
    ("deploy", {**CARTPOLE, "episodes": 0}, "--episodes 0: allowed are 1 to 10000"),
    ("deploy", CARTPOLE, "no-port"),
    ("replay", {"episode": "none.mcap", "port": "no-port"}, "none.mcap"),
    ("train", {}, "no distribution is named: give --distribution FILE"),
    ("train", {"udr": True, "nominal": True}, "--udr and --nominal exclude each other"),
    (
        "train",
        {"robot": "go3", "udr": True},
        "unknown robot with a training environment 'go3'; known: allegro, ant",
    ),
    ("train", {"udr": True, "trainer": "dqn"}, "dqn"),
    (
        "train",
        {"robot": "r.yaml", "env": "a:B-v0"},
        "give --distribution FILE (`deal-hw calibrate` writes it), or",
    ),
    ("train", {"robot": "r.yaml", "nominal": True}, "name your own by --env module:ENV_ID"),
    ("train", {"udr": True, "steps": 0}, "--steps 0: allowed are 1 to"),
    ("train", {"distribution": "none.json"}, "none.json cannot be read"),
    (
        "train",
        {"udr": True, "resume": True, "out": "out"},
        "nothing to resume: out/policies/policy.safetensors",
    ),
    ("design_excitation", {**SWEEP, "family": "noise"}, "unknown family 'noise'; known: optimal, multisine"),
    (
        "design_excitation",
        {**SWEEP, "family": "chirp", "low_hz": 5.0, "high_hz": 1.0},
        "--low-hz 5 must be below",
    ),
    ("design_excitation", {**SWEEP, "space": "k99"}, "unknown parameter set 'k99'; known: "),
    ("inspect", {"episode": "none.mcap"}, "none.mcap cannot be read"),
    ("inspect", {"episode": "none.mcap", "window": 0.0}, "--window 0.0 s: allowed are 0.001 to 600 s"),
    ("doctor", {"robot": "go2", "port": "lo", "seconds": 0.0}, "--seconds 0.0 s: allowed are 0.5 to 600 s"),
    ("emulate", {"robot": "ant"}, "unknown robot to emulate 'ant'; known: cartpole, go2"),
    (
        "emulate",
        {"robot": "go2", "transport": "can"},
        "unknown transport 'can'; known: dds, zenoh",
    ),
    (
        "emulate",
        {"robot": "cartpole", "profile": "perfect"},
        "unknown profile 'perfect'; known: ideal, sensor",
    ),
    ("emulate", {"robot": "cartpole", "range_ratio": 0.5}, "--range-ratio 0.5: allowed are 1.001 to 1000"),
    ("emulate", {"robot": "cartpole", "nominal": True, "truth_from": "t.json"}, "--nominal and --truth-from"),
]
"""Verb, arguments, and words of the refusal."""

MODEL = {"model": "m.xml", "data": ["r.csv"]}
ON_MODEL = "--model m.xml --data r.csv"
CALIBRATE: list[tuple[dict[str, Any], str, str]] = [
    ({}, "", "(deal-hw calibrate --model robot.xml --data rec.csv), one of the two"),
    ({"data": ["r.csv"]}, "--data r.csv", "--data needs the robot's model: add --model robot.xml"),
    (
        {"dataset": "m.xml"},
        "m.xml",
        "m.xml is a model, not a dataset; name it by --model m.xml --data rec.csv",
    ),
    ({"dataset": "m.xml", "data": ["r.csv"]}, "m.xml --data r.csv", "name it by --model m.xml"),
    ({**MODEL, "dataset": "d"}, f"d {ON_MODEL}", "not both"),
    ({"dataset": "d", "method": "gradient"}, "d --method gradient", "gradient"),
    (
        {"dataset": "d", "search": "eki", "policy": "p.onnx"},
        "d --search eki --policy p.onnx",
        "runs no policy",
    ),
    ({"dataset": "d", "latency": 2.0}, "d --latency 2", "--latency 2.0 s: allowed are 0 to"),
    (
        {"dataset": "d", "latency": 0.01, "latency_range": (0.0, 0.01)},
        "d --latency 0.01 --latency-range 0 0.01",
        "--latency-range would have no effect: --latency gives the latency",
    ),
    (
        {"dataset": "d", "latency_range": (0.02, 0.01)},
        "d --latency-range 0.02 0.01",
        "give the lower one first",
    ),
    (
        {"dataset": "d", "range_ratio": 0.5},
        "d --range-ratio 0.5",
        "--range-ratio 0.5: allowed are 1.001 to 1000",
    ),
    ({"dataset": "d", "population": 1}, "d --population 1", "--population 1: allowed are 2 to"),
    ({"dataset": "d", "seed": -1}, "d --seed -1", "--seed -1: allowed are 0 to"),
    ({"dataset": "d"}, "d", "d "),
    ({**MODEL, "window": 0.0}, f"{ON_MODEL} --window 0", "--window 0.0 s: allowed are 0.001 to 60 s"),
    ({**MODEL, "physics_step": 1.0}, f"{ON_MODEL} --physics-step 1", "--physics-step 1.0 s: allowed are"),
    (
        {**MODEL, "search": "deal-paper"},
        f"{ON_MODEL} --search deal-paper",
        "which is unknown for --model",
    ),
    ({"model": "m.xml"}, "--model m.xml", "--model needs recordings to fit: --data rec.csv"),
    (
        {**MODEL, "holdout": ["o.csv"], "holdout_part": 0.5},
        f"{ON_MODEL} --holdout o.csv --holdout-part 0.5",
        "give --holdout or --holdout-part, not both",
    ),
    (
        {**MODEL, "holdout_part": 1.0},
        f"{ON_MODEL} --holdout-part 1",
        "--holdout-part 1.0: allowed are 0 to 0.95",
    ),
    ({**MODEL, "holdout": ["r.csv"]}, f"{ON_MODEL} --holdout r.csv", "is both fitted and held out"),
    (MODEL, ON_MODEL, "m.xml"),
]
"""Arguments in Python, on the command line, and words of the refusal."""


def as_words(verb: str, given: dict[str, Any]) -> list[str]:
    """Return the command line that says the same as arguments in Python."""
    words = list(LINES.get(verb, [verb.replace("_", "-")]))
    for name, value in given.items():
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            words += arguments(value, type(value)())
        elif name in (("policy",) if verb.endswith("_policy") else POSITIONAL):
            words.append(value)
        else:
            words += [option(name)] if value is True else [option(name), str(value)]
    return words


ROWS = [
    *((verb, given, as_words(verb, given), words) for verb, given, words in TABLE),
    *(("calibrate", given, ["calibrate", *line.split()], words) for given, line, words in CALIBRATE),
]


@pytest.mark.parametrize(
    ("verb", "given", "line", "words"), ROWS, ids=[f"{verb} {words[:40]}" for verb, *_, words in ROWS]
)
def test_both_refuse_with_the_same_words(
    verb: str,
    given: dict[str, Any],
    line: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One line on standard error is what Python raises, word by word; nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DealHwError) as raised:
        getattr(deal_hw, verb)(**given)
    assert words in str(raised.value)
    assert main(line) == EXIT_ERROR
    reported = capsys.readouterr()
    assert reported.err == f"deal-hw: error: {raised.value}\n"
    assert not reported.out and not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", sorted({verb for verb, _, _ in TABLE}))
def test_a_function_takes_the_options_of_its_verb(verb: str) -> None:
    """Its signature is that of the settings; an unknown name is answered with the known ones."""
    function = getattr(deal_hw, verb)
    names = set(inspect.signature(function).parameters)
    assert names >= {name for row, given, _ in TABLE if row == verb for name in given}
    assert f"deal-hw {' '.join(as_words(verb, {}))}" in function.__doc__
    first = next(iter(inspect.signature(function).parameters))
    named = {"robot": "cartpole"}.get(first, "m.xml")
    with pytest.raises(UnknownNameError, match=f"unknown argument of {verb}.* 'nosuch'; known: "):
        function(named, nosuch=1)


def test_an_option_of_a_group_names_the_group() -> None:
    """On the command line it is --transport; in Python one must know where it is."""
    with pytest.raises(
        UnknownNameError, match=r"did you mean link=CartpoleLinkOptions\(transport=\.\.\.\)\?"
    ):
        deal_hw.collect("cartpole", port="p", transport="can")
    with pytest.raises(TypeError, match=r"deploy\(\): missing a required (keyword-only )?argument: 'port'"):
        deal_hw.deploy("cartpole")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"seconds": "long"}, "--seconds 'long' is no number: allowed are 0.02 to 3600 s"),
        ({"seconds": None}, "--seconds None is no number: allowed are"),
        ({"episodes": 1.5}, "--episodes 1.5 is no whole number: allowed are 1 to 10000"),
    ],
)
def test_what_only_python_can_say_is_refused(given: dict[str, Any], words: str) -> None:
    """Text, nothing and halves where a number is asked for."""
    with pytest.raises(ConfigurationError, match=words):
        deal_hw.collect(**COLLECT, **given)
