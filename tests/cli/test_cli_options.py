"""Options: numbers are inside their ranges, and what would be ignored is refused."""

from __future__ import annotations

import dataclasses
import importlib
import math
import re
import typing
from pathlib import Path
from typing import Any

import pytest
from verb_options import dataclasses_of

from deal_hw.calib.pipeline.methods import DEFAULT_SEARCH, METHODS, SEARCHES
from deal_hw.cli.main import main, parse, run
from deal_hw.cli.verbs import VERBS
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.ranges import Range

NO_USE: tuple[float, ...] = (math.nan, math.inf, -math.inf, 1e300)
"""No option takes one of these."""
DOUBTFUL: tuple[float, ...] = (-1, 0, 1e-300, 2**63)
"""Refused, or of use: zero is a seed, and a share."""
FINE_AT_ZERO = {
    "mode_machine",
    "error_after_s",
    "machine_after_s",
    "node",
    "seed",
    "seeds",
    "episodes",
    "holdout",
    "web_port",
    "at",
    "latency",
    "start_std",
    "drop",
    "duplicate",
    "corrupt",
    "reorder",
    "domain",
    "split",
    "rounds",
    "tick_start_ms",
    "holdout_part",
    "excitation_level",
    "balance_s",
    "leave_out",
    "known",
    "range",
    "push",
    "duration_s",
    "freeze_after_s",
    "vanish_after_s",
    "wire_after_s",
    "stale_after_s",
    "lost_after_s",
    "sport_after_s",
    "battery_after_s",
    "nan_after_s",
    "hot_after_s",
    "stop_after_s",
    "push_after_s",
    "cut_after_s",
    "cut_s",
    "return_after_s",
    "bus_off_after_s",
    "bus_off_s",
    "tx_full_after_s",
    "tx_full_s",
    "lost_node_after_s",
    "limp_after_s",
    "limp_s",
    "held_after_s",
    "held_s",
    "frozen_after_s",
    "exchanged_after_s",
    "turned_after_s",
    "out_of_range_after_s",
    "controller_off_after_s",
    "controller_off_s",
    "duplicate_id_after_s",
    "foreign_writer_after_s",
    "servo_reboot_after_s",
    "servo_overload_after_s",
    "servo_absent_after_s",
    "faulty_servo",
    "truth_seed",
    "truth_latency",
}
FINE_BELOW_ZERO = {"excitation_level", "known", "range", "push"}
REQUIRED: dict[str, Any] = {
    "robot": "cartpole",
    "port": "p",
    "out": Path("o"),
    "paths": (Path("p"),),
    "path": Path("p"),
    "episode": Path("e"),
    "dataset": Path("d"),
    "folder": Path("f"),
    "name": "n",
    "model": Path("m"),
    "env": "a:B-v0",
    "policy": Path("p.onnx"),
    "lerobot": Path("l.json"),
    "bus": "feetech",
    "episodes": (0,),
}


def numeric_fields() -> list[tuple[type[Any], str, Any]]:
    """Return every numeric field of every verb's settings with its type."""
    found = {}
    for verb in VERBS.values():
        module = importlib.import_module(verb.module)
        for settings in dataclasses_of(getattr(module, verb.config)):
            for name, hint in typing.get_type_hints(settings).items():
                if "float" in str(hint) or "int" in re.sub("print|[Jj]oint", "", str(hint)):
                    found[settings.__name__, name] = (settings, name, hint)
    return list(found.values())


FIELDS = numeric_fields()


def value_for(hint: Any, number: float) -> Any:
    """Return a value of a field's type whose number is the given one."""
    text = str(hint)
    if "tuple[tuple[str, float, float]" in text:
        return (("name", number, number),)
    if "tuple[tuple[str, float]" in text:
        return (("name", number),)
    if "tuple[float, float]" in text:
        return (number, number)
    return (number,) if text.startswith("tuple") else number


def make(settings: type[Any], **values: Any) -> Any:
    """Return settings with only what they require, and some values."""
    needed = {
        f.name: REQUIRED[f.name]
        for f in dataclasses.fields(settings)
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    }
    return settings(**{**needed, **values})


def test_the_sweep_sees_the_options() -> None:
    """The list of numeric options is not empty by a mistake of the test."""
    names = {(settings.__name__, name) for settings, name, _ in FIELDS}
    assert len(names) > 80
    assert names >= {
        ("CollectGo2Settings", "seconds"),
        ("CalibrateDataset", "known"),
        ("WireOptions", "domain"),
    }


@pytest.mark.parametrize(("settings", "name", "hint"), FIELDS, ids=lambda v: getattr(v, "__name__", str(v)))
def test_every_number_has_a_range(settings: type[Any], name: str, hint: Any) -> None:
    """What is no number, endless or absurd is refused; negative and zero where they mean nothing."""
    for number in NO_USE:
        with pytest.raises(ConfigurationError) as caught:
            make(settings, **{name: value_for(hint, number)})
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 300
    for number in DOUBTFUL:
        fine = (number == -1 and name in FINE_BELOW_ZERO) or (0 <= number < 1 and name in FINE_AT_ZERO)
        try:
            make(settings, **{name: value_for(hint, number)})
        except ConfigurationError as error:
            assert "\n" not in str(error)
        else:
            assert fine, f"{settings.__name__}.{name} takes {number}"


def choices() -> list[tuple[type[Any], str]]:
    """Return every field of every verb's settings that takes one of a few names."""
    return list(
        {
            (settings, name)
            for verb in VERBS.values()
            for settings in dataclasses_of(getattr(importlib.import_module(verb.module), verb.config))
            for name, hint in typing.get_type_hints(settings).items()
            if "Literal['" in str(hint)
        }
    )


def test_every_choice_is_checked() -> None:
    """The parser leaves choices to the settings: each refuses another name and lists those that it takes."""
    found = choices()
    assert len(found) >= 10
    for settings, name in found:
        with pytest.raises(UnknownNameError, match=f"unknown {name.replace('_', ' ')} 'nosuch'; known: "):
            make(settings, **{name: "nosuch"})


def test_a_range_says_milliseconds_where_seconds_are_small() -> None:
    """Option, value and range are in the message, and a latency's range is in ms."""
    with pytest.raises(ConfigurationError, match=r"^--latency 12 s: allowed are 0 to 40 ms$"):
        Range(0, 0.04, "s").check("--latency", 12)
    Range(0, 0.04, "s").check("--latency", None)
    with pytest.raises(ConfigurationError, match="--seed 1000000"):
        Range(0, 5).check("--seed", 10**4000)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("calibrate d --latency 12", "--latency 12.0 s: allowed are 0 to 1 s"),
        ("calibrate d --seed -1", "--seed -1: allowed are 0 to"),
        ("emulate cartpole --drop nan", "--drop nan: allowed are 0 to 1"),
        ("deploy go2 --port lo --domain 233", "DDS domain 233: allowed are 0 to 232"),
        ("bench loop --seeds 0-99999999999", "--seeds 99999999999: allowed are"),
    ],
)
def test_a_refused_number_gets_one_line(line: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """No box, no traceback: one line like other errors, exit code 2."""
    assert main(line.split()) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"deal-hw: error: {words}") and printed.err.count("\n") == 1
    assert not printed.out


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "collect",
            "`deal-hw collect`: name the robot: cartpole, go2, go2_on_stand, b2, b2_on_stand, g1, "
            "g1_23dof, h1, so101, robot.yaml, robot.yaml --simulated; example:",
        ),
        ("collect cartpole", "`deal-hw collect cartpole` needs --port; --port is: The robot's port"),
        (
            "collect cartpole --prot p",
            "--prot: `deal-hw collect cartpole` has no such option; did you mean --port? --port is: The",
        ),
        (
            "collect cartpole --port",
            "--port needs a value; --port is: The robot's port",
        ),
        (
            "collect cartpole --seconds 4s",
            "--seconds: '4s' is no number; --seconds is: Length",
        ),
        (
            "calibrate d --nosuch",
            "d does not exist; --nosuch: `deal-hw calibrate dataset` has no such option; all",
        ),
        ("data info", "`deal-hw data info` needs PATH; PATH is: A dataset (DIR) or an episode"),
        ("data info d e", "`deal-hw data info` takes no 'e' there; options begin with --"),
        (
            "train cartpole --steps 1.5",
            "--steps: '1.5' is no whole number; --steps is: Environment steps",
        ),
        ("inspect e.mcap --at soon", "--at: 'soon' is no number; --at is: Device time"),
        (
            "calibrate d --range cart.mass 1",
            "d does not exist; --range takes 3 values each, and 'cart.mass 1' is 2; --range is: ",
        ),
        (
            "calibrate d --known cart.mass heavy",
            "d does not exist; --known: 'heavy' is no number; --known is: ",
        ),
    ],
)
def test_words_that_do_not_parse_get_one_line(
    line: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is wrong, what the option means, and the page that lists the options of this verb or sub-verb."""
    assert main(line.split()) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"deal-hw: error: {words}") and printed.err.count("\n") == 1
    verb, *others = line.split()
    kind = [f" {word}" for word in others[:1] if word in ("cartpole", "info")]
    kind += [" dataset"] * (verb == "calibrate")
    page = f"deal-hw {verb}{''.join(kind)} --help{'-all' if VERBS[verb].common and others else ''}"
    assert printed.err.endswith(f"; all options: {page}\n") and not printed.out


def test_an_option_of_several_values_may_come_several_times() -> None:
    """Values of all of them count, as many people write it; of one value the last counts, as everywhere."""
    line = "--model m.xml --data a.csv --seed 1 --range pole.mass 1 2 --data=b.csv --start-std a 0.1"
    settings, _ = parse("calibrate", [*line.split(), *"--seed 2 --range cart.mass 3 4 --no-laws".split()])
    assert settings.data == (Path("a.csv"), Path("b.csv")) and settings.seed == 2 and not settings.laws
    assert settings.range == (("pole.mass", 1.0, 2.0), ("cart.mass", 3.0, 4.0))
    settings, _ = parse("calibrate", "d --episodes 0 --latency-range 0.01 0.1 --episodes 2 3".split())
    assert settings.episodes == (0, 2, 3) and settings.latency_range == (0.01, 0.1)


def test_two_values_of_one_parameter_are_refused() -> None:
    """Nobody knows which is meant."""
    with pytest.raises(ConfigurationError, match=r"^--range names cart.mass twice; give one of them$"):
        parse("calibrate", "d --range cart.mass 1 2 --range cart.mass 2 3".split())
    with pytest.raises(ConfigurationError, match=r"^--known names pole.mass, cart.mass twice"):
        parse("calibrate", ["d", "--known", *"pole.mass 1 cart.mass 1 pole.mass 1 cart.mass 2".split()])


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("collect go2 --port p --out o --velocity 0.3,0,0", "--velocity"),
        ("deploy go2 --port lo --simulator unitree_mujoco --hand-back", "--hand-back"),
        ("deploy go2 --port lo --simulator unitree_mujoco --state-check length", "--state-check"),
        ("deploy cartpole --port p --out o --no-record", "--out"),
        ("replay e --port p --dataset d --no-record", "--dataset"),
        ("deploy cartpole --port p --no-record --no-record-wire", "--record-wire"),
        ("doctor go2 --port lo --simulator unitree_mujoco --state-check length", "--state-check"),
        ("collect cartpole --port p --out o --motion chirp --excite multisine", "--motion"),
        ("collect cartpole --port p --out o --motion chirp --excitation-level 1", "--excitation-level"),
        ("collect cartpole --port p --out o --motion hold --policy a.onnx", "--policy"),
        ("inspect e --web-port 1234", "--web-port"),
    ],
)
def test_an_option_without_effect_is_refused(line: str, option: str) -> None:
    """Nobody is to believe that an option worked which was ignored."""
    verb, *arguments = line.split()
    with pytest.raises(ConfigurationError, match=rf"^{option} would have no effect: .{{9}}") as caught:
        run(verb, arguments)
    assert not isinstance(caught.value, UnknownNameError)


def test_a_missing_recording_is_told_before_the_missing_desktop(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a desktop, `inspect nothere.mcap` says that the file is not there."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["inspect", "nothere.mcap"]) == 2
    assert "nothere.mcap cannot be read" in capsys.readouterr().err


def help_page(line: str, capsys: pytest.CaptureFixture[str], option: str = "--help-all") -> str:
    """Return what a line prints with --help-all or --help."""
    with pytest.raises(SystemExit) as stop:
        main([*line.split(), option])
    assert not stop.value.code
    return capsys.readouterr().out


@pytest.mark.parametrize("verb", ["collect", "calibrate", "train", "deploy"])
@pytest.mark.parametrize("robot", ["cartpole", "go2"])
def test_help_explains_common_options_and_names_rare_ones(
    verb: str, robot: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Together these are the options that --help-all explains, and each common one exists."""
    line = "calibrate --model robot.xml" if verb == "calibrate" else f"{verb} {robot}".strip()
    common, _, end = help_page(line, capsys, "--help").partition("Rarely needed ")
    all_options = options_of(help_page(line, capsys))
    rare = set(re.findall(r"--[\w-]+", end.partition("):")[2]))
    assert options_of(common) | rare == all_options and not options_of(common) & rare
    assert 0 < len(options_of(common)) <= 15 and rare
    assert " ".join(end.split()).startswith(f"(explained by deal-hw {line} --help-all): --")
    if robot == "go2" or verb == "calibrate":
        # A user's robot has no sets of parameters, and files are no episodes.
        named = {name.replace("_", "-") for name in VERBS[verb].common} - {
            "env",
            "space",
            "episodes",
            "hung-on-crane",
        }
        assert named <= {option.removeprefix("--") for option in options_of(common)}


def test_the_help_of_calibrate_lists_each_method(capsys: pytest.CaptureFixture[str]) -> None:
    """A user need not mistype a name to see the names; searches stand at their own option."""
    page = " ".join(help_page("calibrate d", capsys, "--help").replace("│", " ").split())
    named, _, rest = page.partition("--method STR")[2].partition("--search {deal,eki,deal-paper}")
    assert set(METHODS) - set(SEARCHES) <= set(re.findall(r"[a-z][\w-]*", named))
    assert f"{DEFAULT_SEARCH}" in rest


@pytest.mark.parametrize(
    ("line", "flags"),
    [
        ("calibrate d", ("refine", "report", "advise")),
        ("replay e --robot go2", ("record-wire", "support-check")),
    ],
)
def test_what_is_on_by_default_has_two_flags(
    line: str, flags: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """A flag that only leaves something out would have a text that reads as if it did it."""
    page = help_page(line, capsys)
    for flag in flags:
        assert f"--{flag}, --no-{flag}" in page
    assert "--no-quiet" not in page and "None" not in page and "(default: )" not in page


def options_of(page: str) -> set[str]:
    """Return the options that a help page lists."""
    return set(re.findall(r"^\W{1,2}(--[a-z][\w-]*)", page, flags=re.M))


@pytest.mark.parametrize("name", VERBS)
def test_every_help_page_has_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A line that runs, above the options."""
    assert f"deal-hw {VERBS[name].example}" in " ".join(
        help_page(name, capsys).partition("options")[0].split()
    )
