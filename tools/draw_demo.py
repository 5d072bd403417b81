"""Draw the animation of the start page, from a run folder of the cart-pole's demo.

    deal-hw demo --out runs/demo
    python tools/draw_demo.py runs/demo --out docs/images/demo.gif

Left: the first recording and the predictions of the nominal and the calibrated model, which restart from the
measured state. Right: the policy on the robot, before and after it was trained again, first episodes.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from deal_hw.calibration import read_result
from deal_hw.data.recording.reader import read_episode
from deal_hw.robots import recorded_description
from deal_hw.sim.recordings.overlay import compute_overlay
from deal_hw.types import FloatArray

BLUE, ORANGE, GREEN = "#2a6fbb", "#e69f00", "#009e73"
"""Colours that differ with any kind of colour vision."""
POLE_M = 0.3
RAIL_M = 0.46
NOTHING = np.full(2, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A cart-pole's motion to draw.

    Attributes:
        name: Text in the legend.
        colour: Colour of cart, pole and trace.
        width: Width of pole and trace: wide below, narrow above, so that equal motions show both colours.
        time_s: (T,) [s].
        position: Cart [m] and pole [rad], (T, 2); NaN where unknown.
    """

    name: str
    colour: str
    width: float = 1.0
    time_s: FloatArray
    position: FloatArray

    def at(self, time_s: float) -> FloatArray:
        """Return cart and pole at a time, (2,); NaN where unknown."""
        n = int(np.searchsorted(self.time_s, time_s, side="right")) - 1
        return self.position[n] if n >= 0 else NOTHING


class Rail:
    """Axes with a rail and a cart-pole for each motion."""

    def __init__(self, axes: Axes, motions: list[Motion]) -> None:
        axes.set(xlim=(-0.7, 0.7), ylim=(-0.34, 0.34), aspect="equal")
        axes.axis("off")
        axes.plot([-RAIL_M, RAIL_M], [0, 0], color="0.6", lw=2, zorder=0)
        self._motions = motions
        self._parts = [
            (
                axes.plot([], [], marker="s", ms=9 + 3 * one.width, color=one.colour)[0],
                axes.plot([], [], lw=3 * one.width, color=one.colour, solid_capstyle="round")[0],
            )
            for one in motions
        ]

    def show(self, time_s: float) -> None:
        """Place every cart and pole."""
        for motion, (cart, pole) in zip(self._motions, self._parts, strict=True):
            x, angle = motion.at(time_s)
            cart.set_data([x], [0])
            pole.set_data([x, x + POLE_M * np.sin(angle)], [0, POLE_M * np.cos(angle)])


class Traces:
    """Axes with one coordinate of each motion, drawn up to a moving time."""

    def __init__(self, axes: Axes, motions: list[Motion], column: int, label: str, seconds: float) -> None:
        self._motions, self._column = motions, column
        self._lines = [
            axes.plot([], [], lw=1.5 * one.width, color=one.colour, label=one.name)[0] for one in motions
        ]
        shown = np.concatenate([one.position[one.time_s <= seconds, column] for one in motions])
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        margin = 0.08 * (high - low)
        axes.set(xlim=(0, seconds), ylim=(low - margin, high + margin), xlabel="time [s]", ylabel=label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="upper left", bbox_to_anchor=(0, 1.32), ncols=3, frameon=False, borderpad=0)

    def show(self, time_s: float) -> None:
        """Draw up to a time."""
        for motion, line in zip(self._motions, self._lines, strict=True):
            past = motion.time_s <= time_s
            line.set_data(motion.time_s[past], motion.position[past, self._column])


def recorded(episode: Path, name: str, colour: str, width: float = 1.0) -> Motion:
    """Return the robot's motion in an episode."""
    trajectory = read_episode(episode).trajectory
    time_s = trajectory.device_s - trajectory.device_s[0]
    return Motion(name=name, colour=colour, width=width, time_s=time_s, position=trajectory.position)


def predicted(run: Path, window_s: float) -> list[Motion]:
    """Return the predictions of the first recording by the nominal and the calibrated model."""
    episode = read_episode(run / "dataset" / "episodes" / "000000.mcap")
    result = read_result(run / "calibration")
    overlay = compute_overlay(
        episode.trajectory,
        recorded_description("cartpole"),
        result.space,
        {"model before calibration": result.space.nominal, "after": result.estimate},
        latency_s=result.latency_s,
        window_s=window_s,
    )
    time_s = overlay.broken_time(overlay.device_s) - episode.trajectory.device_s[0]
    return [
        Motion(name=name, colour=colour, time_s=time_s, position=overlay.broken(found.position))
        for (name, found), colour in zip(overlay.predictions.items(), (ORANGE, GREEN), strict=True)
    ]


def draw(run: Path, window_s: float, seconds: float) -> tuple[Figure, list[Rail | Traces]]:
    """Return the figure and its moving parts."""
    real = recorded(run / "dataset" / "episodes" / "000000.mcap", "robot", BLUE, 2.2)
    left = [real, *predicted(run, window_s)]
    right = [
        recorded(run / f"deploy_{folder}" / "episodes" / "000000.mcap", name, colour)
        for folder, name, colour in (("udr", "before", ORANGE), ("retrained", "after", GREEN))
    ]
    figure, axes = plt.subplots(2, 2, figsize=(9.6, 4.4), height_ratios=(3, 2), layout="constrained", dpi=80)
    axes[0, 0].set_title(f"Predictions of {window_s:g} s from the robot's state", loc="left")
    axes[0, 1].set_title("Policy on the robot, before and after", loc="left")
    return figure, [
        Rail(axes[0, 0], left),
        Rail(axes[0, 1], right),
        Traces(axes[1, 0], left, 0, "cart [m]", seconds),
        Traces(axes[1, 1], right, 1, "pole [rad]", seconds),
    ]


def frame(figure: Figure) -> Image.Image:
    """Return the figure as a picture."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="run folder of `deal-hw demo`")
    parser.add_argument("--out", type=Path, required=True, help="animation to write (.gif)")
    parser.add_argument("--seconds", type=float, default=4.0, help="length [s]")
    parser.add_argument("--hz", type=float, default=12.5, help="pictures a second")
    parser.add_argument("--window", type=float, default=0.4, help="length of a prediction [s]")
    config = parser.parse_args()
    mpl.use("agg")
    mpl.rcParams.update({"font.size": 9, "axes.titlesize": 10})
    figure, parts = draw(config.run, config.window, config.seconds)
    frames = []
    for n in range(round(config.seconds * config.hz) + 1):
        for part in parts:
            part.show(n / config.hz)
        frames.append(frame(figure))
    palette = frames[-1].quantize(48, method=Image.Quantize.MAXCOVERAGE)
    small = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames]
    pause_ms = [round(1000 / config.hz)] * (len(small) - 1) + [2500]
    small[0].save(
        config.out, save_all=True, append_images=small[1:], duration=pause_ms, loop=0, optimize=True
    )


if __name__ == "__main__":
    main()
