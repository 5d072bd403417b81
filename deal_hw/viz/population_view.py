"""A search while it runs: spread of the population in each parameter, trace, real against predicted motion.

Entities, over the timeline ``generation`` (refinement and latency scan count on)::

    /parameters/<name>/{p95,median,p05}        in the parameter's own unit
    /spread/<name>                             standard deviation over that of the whole range: 1 at the start
    /trace/<stage>/<key>                       misfit, chi2 and what else the method notes
    /log10/<stage>/<key>                       decimal logarithm of those that are positive
    /log                                       messages of the method
    /motion/<joint>/{real,population}          a joint's curves in a lane of its own, 2D

The view may skip generations: it gets copies, and the search never waits for it.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calibration import Progress
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.overlay import Overlay
from deal_hw.types import FloatArray
from deal_hw.viz import palette
from deal_hw.viz.backend import rr, rrb

APPLICATION = "deal-hw calibrate"
TIMELINE = "generation"
MEAN = "population"
WAITING = 64
"""Generations that may wait to be shown; later ones are left out."""

OVERLAY_EVERY_S = 2.0
CLOSE_S = 5.0
LANE_WIDTH, LANE_STEP = 3.0, 1.5
"""Width of the picture of the motion and distance from lane to lane, in heights of a lane."""

Predict = Callable[[FloatArray, float], Overlay]
"""Parameters (K,) and latency [s] -> predictions of one recording, of a set named `MEAN`."""


class PopulationView:
    """Shows the progress of a search from a thread of its own.

    Args:
        space: The searched parameters.
        stream: The rerun recording, already connected.
        predict: Predicts the recording for the overlay; None for no overlay.
    """

    def __init__(self, space: ParameterSpace, stream: Any, predict: Predict | None = None) -> None:
        self._space, self._stream, self._predict = space, stream, predict
        uniform = np.stack([space.low, space.high])
        # A uniform draw over the range has 1 / sqrt(12) of its width as standard deviation.
        self._whole = np.ptp(space.to_scale(uniform), axis=0) / np.sqrt(12.0)
        self._waiting: queue.Queue[Progress | None] = queue.Queue(WAITING)
        self._count = 0
        self._next_overlay = 0.0
        self.left_out = 0
        """Generations that were not shown because the viewer was behind."""
        self._thread = threading.Thread(target=self._work, name="population-view", daemon=True)
        self._thread.start()

    def show(self, progress: Progress) -> None:
        """Take one generation to be shown and return at once; a progress callback."""
        try:
            self._waiting.put_nowait(progress)
        except queue.Full:
            self.left_out += 1

    def close(self) -> None:
        """Show the waiting generations, for a few seconds at most."""
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=CLOSE_S)
        self._thread.join(CLOSE_S)
        # A viewer that the user closed must not end the calibration.
        with contextlib.suppress(Exception):
            self._stream.flush(timeout_sec=CLOSE_S)

    def _work(self) -> None:
        try:
            self._describe()
            while (progress := self._waiting.get()) is not None:
                self._log(progress)
        except Exception as err:
            # An error of the view must not end the search; the recording holds the reason.
            with contextlib.suppress(Exception):
                self._stream.log("/log", rr.TextLog(f"the live view stopped: {err}", level="ERROR"))

    def _describe(self) -> None:
        self._stream.send_blueprint(_blueprint(self._space, self._predict is not None))
        for p in self._space:
            for name, color in (
                ("p95", palette.REQUESTED),
                ("median", palette.CALIBRATED),
                ("p05", palette.REQUESTED),
            ):
                style = rr.SeriesLines(colors=[color], names=[name])
                self._stream.log(f"/parameters/{p.name}/{name}", style, static=True)

    def _log(self, progress: Progress) -> None:
        self._count += 1
        self._stream.set_time(TIMELINE, sequence=self._count)
        self._stream.log("/log", rr.TextLog(f"{progress.stage} {progress.done}: {progress.message}"))
        for key, value in progress.values.items():
            if np.isfinite(value):
                self._stream.log(f"/trace/{progress.stage}/{key}", rr.Scalars(float(value)))
            if np.isfinite(value) and value > 0:
                self._stream.log(f"/log10/{progress.stage}/{key}", rr.Scalars(float(np.log10(value))))
        population = progress.population
        if population is None or not len(population):
            return
        spread = self._space.to_scale(population).std(axis=0) / self._whole
        levels = np.percentile(population, (95.0, 50.0, 5.0), axis=0)
        for k, p in enumerate(self._space):
            self._stream.log(f"/spread/{p.name}", rr.Scalars(float(spread[k])))
            for name, level in zip(("p95", "median", "p05"), levels, strict=True):
                self._stream.log(f"/parameters/{p.name}/{name}", rr.Scalars(float(level[k])))
        self._overlay(population, progress.latency_s)

    def _overlay(self, population: FloatArray, latency_s: float | None) -> None:
        # A prediction takes a part of a second of one processor, so only some generations get one.
        if self._predict is None or time.monotonic() < self._next_overlay:
            return
        mean = self._space.from_scale(self._space.to_scale(population).mean(axis=0))
        overlay = self._predict(mean, max(latency_s or 0.0, 0.0))
        self._lanes(overlay)
        self._next_overlay = time.monotonic() + OVERLAY_EVERY_S

    def _lanes(self, overlay: Overlay) -> None:
        # Plots over a timeline keep all data; curves in a picture are replaced by the next ones.
        t = overlay.device_s - overlay.device_s.min()
        x = LANE_WIDTH * t / max(float(t.max()), 1e-9)
        for j, joint in enumerate(overlay.joint_names):
            real, mean = overlay.position[..., j], overlay.predictions[MEAN].position[..., j]
            low, width = float(real.min()), max(float(np.ptp(real)), 1e-9)
            text = f"{joint}: {low:.3g} to {low + width:.3g}, {t.max():.1f} s"
            self._stream.log(
                f"/motion/{joint}",
                rr.Points2D([[LANE_WIDTH / 2, LANE_STEP * j - 0.2]], labels=[text], radii=0.0),
            )
            for name, values, color in (("real", real, palette.REAL), (MEAN, mean, palette.CALIBRATED)):
                # A picture's y axis points down. A prediction that ran away ends at its lane's border.
                y = LANE_STEP * j + 1.0 - np.clip((values - low) / width, -0.1, 1.1)
                good = np.isfinite(y).all(axis=1)
                strips = np.stack([x, y], axis=2)[good]
                self._stream.log(f"/motion/{joint}/{name}", rr.LineStrips2D(list(strips), colors=[color]))


@contextlib.contextmanager
def population_view(
    space: ParameterSpace, *, address: str = "", save: Path | None = None, predict: Predict | None = None
) -> Iterator[PopulationView]:
    """Show a search until the block ends.

    Args:
        space: The searched parameters.
        address: Address of a viewer that waits for data; "" for none.
        save: File to write as well or instead.
        predict: Predicts the recording for the overlay; None for no overlay.
    """
    with rr.RecordingStream(APPLICATION, send_properties=False) as stream:
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        sinks: list[Any] = [rr.GrpcSink(address)] if address else []
        if save is not None:
            save.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rr.FileSink(save))
        stream.set_sinks(*sinks)
        view = PopulationView(space, stream, predict)
        try:
            yield view
        finally:
            view.close()
            stream.disconnect()


def _blueprint(space: ParameterSpace, overlay: bool) -> Any:
    plots = [
        rrb.TimeSeriesView(
            origin=f"/parameters/{p.name}",
            name=f"{p.name} [{p.unit}]",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for p in space
    ]
    views: list[Any] = [
        rrb.Grid(*plots, name="Parameters"),
        rrb.TimeSeriesView(origin="/spread", name="Spread over the range's"),
    ]
    if overlay:
        views.append(rrb.Spatial2DView(origin="/motion", name="Real and the population's mean"))
    trace = rrb.Tabs(
        # Misfits fall over many decades.
        rrb.TimeSeriesView(origin="/log10", name="Trace, log10"),
        rrb.TimeSeriesView(origin="/trace", name="Trace"),
        active_tab=0,
    )
    right = rrb.Vertical(trace, rrb.TextLogView(origin="/log", name="Log"))
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*views, active_tab=0), right, column_shares=[3, 2]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_layout=False,
        auto_views=False,
    )
