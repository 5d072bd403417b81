"""The live view of a search: what it logs, and that it never holds the search up."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.calibration import Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.recordings.overlay import Overlay, compute_overlay
from deal_hw.types import FloatArray, Trajectory
from deal_hw.viz.population_view import MEAN, WAITING, PopulationView, population_view


class Stream:
    """Counts what is logged by entity and keeps the scalars; holds everything up while ``gate`` is shut."""

    def __init__(self) -> None:
        self.logged: Counter[str] = Counter()
        self.gate = threading.Event()
        self.gate.set()

    def log(self, path: str, *_: Any, static: bool = False) -> None:
        """Count a log call that is not static."""
        self.gate.wait(30.0)
        self.logged[path] += not static

    def set_time(self, timeline: str, *, sequence: int) -> None:
        """Do nothing."""

    def send_blueprint(self, *_: Any) -> None:
        """Do nothing."""

    def flush(self, *, timeout_sec: float) -> None:
        """Do nothing."""


def generation(number: int) -> Progress:
    """Return the progress of a generation with a population of five."""
    space = k9_space()
    population = space.unnormalize(np.random.default_rng(number).random((5, len(space))))
    return Progress("search", number, 10, "going", population, 0.004, {"misfit": 1.0 / number})


def test_each_generation_is_shown_once() -> None:
    """Three generations: three values of each level, of the spread and of the misfit; three words."""
    space, stream = k9_space(), Stream()
    view = PopulationView(space, stream)
    for number in (1, 2, 3):
        view.show(generation(number))
    view.show(Progress("refinement", 1, 1, "chi2 1", values={"chi2": float("nan")}))
    view.close()
    for name in space.names:
        for path in (
            f"/spread/{name}",
            *(f"/parameters/{name}/{level}" for level in ("p05", "median", "p95")),
        ):
            assert stream.logged[path] == 3
    assert stream.logged["/trace/search/misfit"] == 3
    assert stream.logged["/trace/refinement/chi2"] == 0
    assert stream.logged["/log"] == 4
    assert view.left_out == 0


def test_slow_viewer_loses_generations_and_holds_nothing_up() -> None:
    """While the viewer takes nothing, generations beyond the queue are counted as left out."""
    stream = Stream()
    stream.gate.clear()
    view = PopulationView(k9_space(), stream)
    for number in range(1, WAITING + 12):
        view.show(generation(number))
    # The thread may have taken one out of the queue before it was held.
    assert 10 <= view.left_out <= 11
    stream.gate.set()
    view.close()
    assert stream.logged["/log"] == WAITING + 11 - view.left_out


def test_view_that_breaks_does_not_break_the_search() -> None:
    """An error of the overlay ends the view with a word; the callback goes on taking generations."""

    def predict(mean: FloatArray, latency_s: float) -> Overlay:
        raise RuntimeError("no such thing")

    stream = Stream()
    view = PopulationView(k9_space(), stream, predict)
    view.show(generation(1))
    view._thread.join(10.0)
    view.show(generation(2))
    view.close()
    assert stream.logged["/log"] == 2


def test_overlay_is_of_the_mean(trajectory: Trajectory, tmp_path: Path) -> None:
    """The motion is predicted with the population's mean in the parameters' own scale, and its latency."""
    space = k9_space()
    asked: list[tuple[FloatArray, float]] = []

    def predict(mean: FloatArray, latency_s: float) -> Overlay:
        asked.append((mean, latency_s))
        return compute_overlay(trajectory, DESCRIPTION, space, {MEAN: mean}, latency_s=latency_s)

    file = tmp_path / "search.rrd"
    progress = generation(1)
    with population_view(space, save=file, predict=predict) as view:
        view.show(progress)
    assert progress.population is not None
    wanted = space.from_scale(space.to_scale(progress.population).mean(axis=0))
    np.testing.assert_allclose(asked[0][0], wanted)
    assert asked[0][1] == pytest.approx(0.004)
    data = file.read_bytes()
    for joint in DESCRIPTION.joint_names:
        assert f"/motion/{joint}/{MEAN}".encode() in data
