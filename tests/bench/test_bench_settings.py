"""Settings of the benches: what is typed, what each bench has, and that files of rows go on."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

from deal_hw.bench.rows import Cells, load_rows
from deal_hw.bench.settings import (
    BENCHES,
    FirstAnswer,
    Paper,
    Real,
    Verdict,
    parse_names,
    parse_ratios,
)
from deal_hw.calib.pipeline.methods import check_method
from deal_hw.cli.main import parse
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.options import parse_seeds

MEASURED = Path(__file__).parents[2] / "docs" / "measured"


def test_seeds() -> None:
    """Numbers and ranges, and an error that shows how."""
    assert parse_seeds("0,3, 1000-1002") == (0, 3, 1000, 1001, 1002)
    for text in ("", "a", "3-", "5-2", "-1"):
        with pytest.raises(ConfigurationError, match="--seeds"):
            parse_seeds(text)


def test_ratios() -> None:
    """Numbers above one, and an error that shows how."""
    assert parse_ratios("3, 5,20") == (3.0, 5.0, 20.0)
    for text in ("", "a", "1", "5,0.5", "5,nan"):
        with pytest.raises(ConfigurationError, match="--range-ratio"):
            parse_ratios(text)


def test_names() -> None:
    """Separated by commas, with spaces or without; none at all is an error."""
    assert parse_names("eki, deal,", "--methods") == ("eki", "deal")
    with pytest.raises(ConfigurationError, match=r"^--methods ' , ' has no name; give names"):
        parse_names(" , ", "--methods")


def typed(line: str) -> Any:
    """Return the settings that a line gives."""
    return parse("bench", line.split())[0]


def test_lists_are_typed_as_one_word_and_are_lists_in_the_settings() -> None:
    """So no bench reads text again."""
    line = "paper --task ant,go2 --methods eki,deal --range-ratio 10,15.5 --seeds 0,1000-1001"
    assert typed(line) == Paper(
        task=("ant", "go2"), methods=("eki", "deal"), range_ratio=(10.0, 15.5), seeds=(0, 1000, 1001)
    )
    assert typed("verdict --problems arm,leg --faults none,sign") == Verdict(
        problems=("arm", "leg"), faults=("none", "sign")
    )
    assert typed("first-answer --problems so101") == FirstAnswer(problems=("so101",))


@pytest.mark.parametrize("name", ["loop", "speed", "real"])
def test_some_benches_take_one_ratio(name: str) -> None:
    """Two are no number."""
    assert typed(f"{name} --range-ratio 3").range_ratio == 3.0
    with pytest.raises(ConfigurationError, match=r"--range-ratio.*'3,5'.* no number"):
        typed(f"{name} --range-ratio 3,5")


@pytest.mark.parametrize(
    ("line", "owners"),
    [
        ("loop --model m.xml", "`bench real` has it"),
        ("fixed-range --steps 10", "`bench go2-loop` and `bench transfer` have it"),
        (
            "speed --refine-all",
            "`bench fixed-range`, `bench mismatch`, `bench paper` and `bench real` have it",
        ),
        ("verdict --real recordings", "`bench first-answer` has it"),
        ("transfer --no-train", "`bench loop` and `bench go2-loop` have it"),
        ("go2-codec --faults sign", "`bench verdict` has it"),
        # The mismatch's profile is no choice, and what describes a bench is no option.
        (
            "mismatch --profile ideal",
            "`bench loop`, `bench go2-loop`, `bench fixed-range`, `bench paper` and `bench speed` have it",
        ),
        ("loop --work a:b", ""),
    ],
)
def test_an_option_of_another_bench_names_the_benches_that_have_it(line: str, owners: str) -> None:
    """One line: what was given, who has it."""
    name, flag, *_ = line.split()
    with pytest.raises(ConfigurationError) as caught:
        typed(line)
    said = f"{flag}: `deal-hw bench {name}` has no such option; {owners}; all options: "
    assert str(caught.value).startswith(said.replace("; ;", ";"))


@pytest.mark.parametrize("name", sorted({*BENCHES} - {"real", "go2-codec"}))
def test_the_defaults_of_a_bench_are_known_names(name: str) -> None:
    """Its cells can be made from them, and a file that is not named is BENCH.json."""
    settings = typed(name)
    assert type(settings) is BENCHES[name] and settings.file == Path(f"{name}.json")
    assert settings.beside("runs") == Path(f"{name}_runs")
    module, _, function = settings.work.partition(":")
    cells: Cells = getattr(importlib.import_module(module), function)(settings).cells
    assert cells.args and all(len(cell) == len(cells.names) for cell, _ in cells.args)


def test_the_methods_of_real_are_known() -> None:
    """Its cells need recordings, so the names are looked up here."""
    for method in Real().methods:
        check_method(method)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("loop_sensor", "loop --profile sensor --methods default --seeds 1000-1009"),
        ("go2_loop", "go2-loop --profile realistic --seeds 1000-1004"),
        ("speed", "speed --task cartpole,ant,go2,humanoid,allegro --profile ideal --seeds 1000"),
        (
            "fixed_range_ant_go2_ideal",
            "fixed-range --task ant,go2 --profile ideal --methods default --range-ratio 5,20 "
            "--seeds 1000-1004",
        ),
        (
            "paper_table5",
            "paper --task cartpole --profile ideal --demonstration policy --checkpoint c20000.onnx "
            "c60000.onnx c200000.onnx --range-ratio 3 --seeds 1010 --methods midpoint-linear,deal-paper,deal,"
            "default",
        ),
        ("paper_mismatch_deal", "mismatch --demonstration policy --seeds 1010-1012 --methods deal"),
        (
            "transfer_humanoid",
            "transfer --task humanoid --seeds 1000 --methods udr,oracle,default,deal-paper-literal "
            "--steps 300000 --demonstration-seconds 1",
        ),
        ("verdict_right", "verdict --faults none --seeds 2000-2001"),
        ("first_answer", "first-answer --real DIR --seeds 2000-2002"),
    ],
)
def test_rows_of_an_earlier_version_are_not_run_again(name: str, line: str) -> None:
    """The commands of docs/measured go on from the files there: every cell has its row."""
    out = MEASURED / f"{name}.json"
    settings = typed(f"{line} --out {out}")
    module, _, function = settings.work.partition(":")
    cells: Cells = getattr(importlib.import_module(module), function)(settings).cells
    done = {tuple(row.get(field, "") for field in cells.names) for row in load_rows(out) if not row["error"]}
    assert {cell for cell, _ in cells.args} <= done
