"""The transfer bench: one base policy, equal fine-tunes, returns in a hidden target."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from deal_hw.bench import transfer, transfer_target
from deal_hw.bench.figures import draw_transfer
from deal_hw.bench.rows import load_rows
from deal_hw.bench.settings import Transfer
from deal_hw.cli.bench import bench
from deal_hw.drivers.cartpole.description import SPACES
from deal_hw.errors import CalibrationError, ConfigurationError, UnknownNameError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.training import TrainingFiles
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import nominal_distribution, train_policy, udr_distribution

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED = Path(__file__).resolve().parents[2] / "docs" / "measured"
SAVE = "matplotlib.figure.Figure.savefig"
STEPS = 1_500
FIELDS = {
    "task",
    "seed",
    "method",
    "error_percent",
    "return",
    "return_worst",
    "return_base",
    "return_oracle",
    "share_of_oracle",
    "train_steps",
    "seconds",
    "seconds_train",
    "seconds_demonstrate",
    "commit",
    "command",
}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hardly trained base policy of the cart-pole, with its checkpoint."""
    path = tmp_path_factory.mktemp("base") / "cartpole_udr.onnx"
    files = TrainingFiles(checkpoint=path.with_suffix(".safetensors"))
    train_policy("cartpole", udr_distribution("cartpole"), path, steps=STEPS, members=8, files=files)
    return path


def settings(base: Path, out: Path, **more: Any) -> Transfer:
    """Return a bench of one small target."""
    values: dict[str, Any] = {
        "seeds": (0,),
        "methods": ("udr", "midpoint", "oracle"),
        "steps": STEPS,
        "demonstration_seconds": 1.0,
        "checkpoint": (base,),
        "threads": 1,
        "out": out,
    }
    return Transfer(**{**values, **more})


@pytest.mark.slow
def test_every_row_is_a_fine_tune_of_one_policy_and_none_is_run_twice(
    base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same steps, seed and start; the oracle trains once; a second call adds only what is missing."""
    out = tmp_path / "transfer.json"
    assert bench(settings(base, out, methods=("udr", "midpoint"))) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [row["method"] for row in rows] == ["udr", "midpoint"]
    for row in rows:
        assert set(row) >= FIELDS and row["error"] == ""
        assert row["return_worst"] <= row["return"] <= 250.0
        assert row["share_of_oracle"] == pytest.approx(row["return"] / row["return_oracle"])
    assert len({(row["return_base"], row["return_oracle"]) for row in rows}) == 1
    records = [
        json.loads(path.read_text()) for path in sorted((tmp_path / "transfer_policies").glob("*.json"))
    ]
    assert [record["started_from"] for record in records] == [str(base.with_suffix(".safetensors"))] * 3
    assert {(record["seed"], record["training"]["config"]["steps"]) for record in records} == {(0, STEPS)}
    assert len({record["distribution_digest"] for record in records}) == 3
    assert out.with_suffix(".png").stat().st_size > 1000
    printed = capsys.readouterr().out
    assert "cartpole seed 0 midpoint: estimating" in printed and "share of oracle" in printed
    kept = {path: path.read_bytes() for path in (tmp_path / "transfer_policies").glob("*oracle*.onnx")}

    trained: list[Path] = []

    def noted(*args: Any, **more: Any) -> OnnxPolicy:
        trained.append(args[2])
        return train_policy(*args, **more)

    monkeypatch.setattr(transfer, "train_policy", noted)
    assert bench(settings(base, out)) == 0
    assert [path.stem.rpartition("_")[2] for path in trained] == ["oracle"]
    (oracle,) = [row for row in json.loads(out.read_text())["rows"] if row["method"] == "oracle"]
    assert oracle["error_percent"] == pytest.approx(0.0)
    assert oracle["share_of_oracle"] == pytest.approx(1.0)
    # The same generator state gives the same policy.
    assert [OnnxPolicy(path).spec for path in kept] == [OnnxPolicy(path).spec for path in trained]
    assert bench(settings(base, out)) == 0 and len(trained) == 1


@pytest.mark.slow
def test_a_base_policy_is_trained_once_and_a_stopped_training_goes_on(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a policy the bench trains one; from the checkpoint of a stopped one; then it is kept."""
    made: list[TrainingFiles] = []

    def short(*args: Any, **more: Any) -> OnnxPolicy:
        made.append(more["files"])
        return train_policy(*args, **more, steps=STEPS, members=8)

    monkeypatch.setattr(transfer, "train_policy", short)
    one = transfer.Setting(task="cartpole", steps=STEPS, seconds=1.0, base=None, folder=tmp_path)
    printed: list[str] = []
    path = transfer.base_policy(one, printed.append)
    assert path == tmp_path / "cartpole_udr.onnx" and path.with_suffix(".safetensors").exists()
    assert not made[0].resume and "once" in printed[0]
    assert transfer.base_policy(one, printed.append) == path and len(made) == 1

    def resumed(*args: Any, **more: Any) -> OnnxPolicy:
        made.append(more["files"])
        shutil.copy(base, path)
        return OnnxPolicy(path)

    monkeypatch.setattr(transfer, "train_policy", resumed)
    path.unlink()
    assert transfer.base_policy(one) == path and made[1].resume


def test_the_shipped_walk_is_the_base_of_the_go2(tmp_path: Path) -> None:
    """It has its checkpoint beside it."""
    one = transfer.Setting(task="go2", steps=1, seconds=1.0, base=None, folder=tmp_path)
    assert transfer.base_policy(one) == required_policy("go2")
    assert one.range_ratio == pytest.approx(1.75)


@pytest.mark.parametrize(
    ("more", "error", "words"),
    [
        ({"task": ("cartpol",)}, UnknownNameError, "cartpole"),
        ({"methods": ("udr", "esi")}, UnknownNameError, "easi"),
        ({"steps": 500}, ConfigurationError, "more than the 1000 steps of warmup"),
        ({"task": ("ant",)}, ConfigurationError, "a policy of cartpole; this bench runs ant"),
        ({"checkpoint": "twice"}, ConfigurationError, "a second policy of cartpole"),
        ({"checkpoint": "alone"}, ConfigurationError, "alone.safetensors is missing"),
        pytest.param(
            {"checkpoint": "nominal"},
            ConfigurationError,
            "another distribution .* within a factor 5",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_cannot_work_is_refused_before_long_work(
    base: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: dict[str, Any],
    error: type[Exception],
    words: str,
) -> None:
    """Names, steps, and policies of another task, of another range, or without a checkpoint."""
    monkeypatch.setattr(transfer, "make_case", lambda *a, **k: pytest.fail("long work has begun"))
    if kind := more.get("checkpoint"):
        alone = tmp_path / f"{kind}.onnx"
        if kind == "nominal":
            train_policy("cartpole", nominal_distribution("cartpole"), alone, steps=STEPS, members=8)
        else:
            shutil.copy(base, alone)
        more = {"checkpoint": (base, base) if kind == "twice" else (alone,)}
    with pytest.raises(error, match=words):
        bench(settings(base, tmp_path / "t.json", **more))
    assert not (tmp_path / "t.json").exists()


def test_a_target_without_a_demonstration_is_said_before_searches_and_trainings(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pole falls at once: the row names the time, and nothing is estimated or trained."""
    monkeypatch.setattr(transfer, "SHORTEST_S", 30.0)
    monkeypatch.setattr(transfer, "calibration_row", lambda *a, **k: pytest.fail("a search has begun"))
    monkeypatch.setattr(transfer, "train_policy", lambda *a, **k: pytest.fail("a training has begun"))
    transfer.draw_target.cache_clear()
    out = tmp_path / "transfer.json"
    assert bench(settings(base, out, methods=("udr", "midpoint"), quiet=True)) == 1
    for row in json.loads(out.read_text())["rows"]:
        assert "CalibrationError: cartpole, seed 0: the base policy fails after" in row["error"]
    transfer.draw_target.cache_clear()


def test_a_return_is_the_time_upright_near_the_middle(base: Path) -> None:
    """Between none and each of 250 ticks; the worst episode is no better than the mean; the same twice."""
    space = SPACES["k9"]()
    truth = ParameterDistribution.point(space, space.nominal, 0.0)
    policy = OnnxPolicy(base)
    row = transfer_target.judged("cartpole", truth, policy, 0)
    assert 0.0 < row["return_worst"] <= row["return"] < 250.0
    assert 0.0 < row["time_up"] <= 1.0
    assert transfer_target.judged("cartpole", truth, policy, 0) == row
    shipped = transfer_target.judged("cartpole", truth, OnnxPolicy(required_policy("cartpole")), 0)
    assert shipped["return"] > row["return"]


def test_the_walk_follows_growing_speeds() -> None:
    """The shipped policy on the nominal Go2: ahead while it shall go ahead, aside while aside; no push."""
    distribution = nominal_distribution("go2")
    truth = ParameterDistribution.point(distribution.space, distribution.mean, 0.0)
    profile = transfer_target.commands(ahead_m_s=(0.5,), aside_m_s=(0.3,))
    policy = OnnxPolicy(required_policy("go2"))
    row = transfer_target.speed_profile("go2", truth, policy, 0, count=2, profile=profile)
    speed = row["speed"]
    assert row["falls"] == 0
    assert speed["wanted_x_m_s"] == [0.5] * 5 + [0.0] * 5
    assert speed["wanted_y_m_s"] == [0.0] * 5 + [0.3] * 5
    assert np.mean(speed["x_m_s"][2:5]) == pytest.approx(0.5, abs=0.15)
    assert np.mean(speed["y_m_s"][7:]) == pytest.approx(0.3, abs=0.15)
    assert row["speed_error_x_m_s"] < 0.3 and row["speed_error_y_m_s"] < 0.2
    env = transfer_target.target_env("go2", truth, 1)
    assert env.task.push_m_s == 0.0 and env.task.payload_kg == (0.0, 0.0)


def drawn_row(task: str, seed: int, method: str, value: float, **more: Any) -> dict[str, Any]:
    """Return a row of a figure."""
    return {
        "task": task,
        "seed": seed,
        "method": method,
        "return": value,
        "return_base": 5.0,
        "train_steps": 10,
        **more,
    }


def test_the_figure_has_a_panel_for_each_task_and_the_speeds_of_the_go2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Methods from top to bottom, the base policy as a line, speeds in x and y of the first seed."""
    figures: list[Figure] = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig", lambda figure, path, **more: figures.append(figure)
    )
    speed = {name: [0.1, 0.2] for name in ("time_s", "wanted_x_m_s", "wanted_y_m_s", "x_m_s", "y_m_s")}
    rows = [drawn_row("ant", seed, method, 9.0 + seed) for seed in (0, 1) for method in ("udr", "oracle")]
    rows += [drawn_row("go2", seed, "udr", 7.0, speed=speed) for seed in (0, 1)]
    draw_transfer(tmp_path / "a.png", rows)
    titles = [axes.get_title() for axes in figures[0].axes]
    assert [title.partition(":")[0] for title in titles] == ["ant", "go2", "go2, seed 0", "go2, seed 0"]
    assert "mean, worst and best of 2 seeds" in titles[0]
    assert [text.get_text() for text in figures[0].axes[0].get_yticklabels()] == ["udr", "oracle"]
    legend = figures[0].axes[2].get_legend()
    assert legend is not None
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["commanded", "udr"]


@pytest.mark.parametrize("path", sorted(MEASURED.glob("transfer_*.png")), ids=lambda path: str(path.stem))
def test_published_figures_name_every_method(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the rows beside each: every axis has a name and a title, every method of its rows is at one."""
    figures: list[Figure] = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig", lambda figure, path, **more: figures.append(figure)
    )
    rows = [one for one in load_rows(path.with_suffix(".json")) if not one["error"]]
    draw_transfer(path, rows)
    for axes in figures[0].axes:
        assert axes.get_xlabel() and axes.get_title()
    named = {text.get_text() for text in figures[0].axes[0].get_yticklabels()}
    assert {row["method"] for row in rows} == named


def test_a_row_in_words() -> None:
    """What failed, or the return beside the base policy's and the oracle's."""
    row = drawn_row("ant", 3, "easi", 90.0, error="", error_percent=12.3, base_works=False)
    row |= {"share_of_oracle": 0.9, "seconds": 7.0, "seconds_train": 8.0}
    assert transfer.line(row) == (
        "transfer ant seed 3 easi: parameter error 12.3 %, return 90.0 (base 5.0, which falls here), 90 % of "
        "the oracle's; 7 s to estimate, 8 s to train"
    )
    assert "base 5.0), - of" in transfer.line({**row, "base_works": True, "share_of_oracle": None})
    assert transfer.line({**row, "error": "CalibrationError: no"}).endswith("CalibrationError: no")


def test_targets_of_a_seed_are_shared_and_a_robot_that_no_policy_moves_is_an_error(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of one seed have one target; an error of the draw goes into the row."""
    transfer.draw_target.cache_clear()
    one = transfer.Setting(task="cartpole", steps=STEPS, seconds=1.0, base=base, folder=tmp_path)
    assert transfer.draw_target(one, 0, base) is transfer.draw_target(one, 0, base)
    other = dataclasses.replace(one, seconds=2.0)

    def falls(*args: Any, **more: Any) -> Any:
        raise CalibrationError("all drawn robots fall")

    monkeypatch.setattr(transfer, "make_case", falls)
    row = transfer.transfer_row(other, 0, "udr", population=None, generations=1, threads=1)
    assert row["error"] == "CalibrationError: all drawn robots fall"
