"""How an inspected episode opens: 3D and summary at the left, traces stacked at the right, events below."""

from __future__ import annotations

from typing import Any

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import FloatArray, Trajectory
from deal_hw.viz.backend import rrb
from deal_hw.viz.columns import DEVICE_TIMELINE

_STACKED_JOINTS = 3
"""Robots with more joints get a grid of small plots instead of a stack."""


def inspect_blueprint(
    trajectory: Trajectory,
    description: RobotDescription,
    sets: tuple[str, ...],
    bodies: FloatArray | None = None,
) -> Any:
    """Return the layout.

    Args:
        trajectory: The recording.
        description: The robot.
        sets: Names of the parameter sets that are shown beside it.
        bodies: Where the robot's bodies are at the beginning, to look at, (B, 3) [m]; None: at the origin.
    """
    tabs = [
        _motion(trajectory, description, sets),
        _velocities(trajectory, description, sets),
        _commands(trajectory, description),
        _plot("/loop_timing", "loop timing [ms]"),
    ]
    if trajectory.body is not None:
        tabs.insert(0, _body(trajectory))
    right = rrb.Tabs(*tabs, active_tab=0)
    left = rrb.Vertical(
        _robot(description, bodies),
        rrb.TextDocumentView(origin="/summary", name="Summary"),
        row_shares=[4, 7],
    )
    bottom = rrb.Horizontal(
        rrb.TextLogView(origin="/events", name="Events"),
        rrb.StateTimelineView(origin="/status", name="Status"),
    )
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(left, right, column_shares=[2, 3]), bottom, row_shares=[9, 2]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIMELINE, play_state="paused", loop_mode="all"),
        auto_layout=False,
        auto_views=False,
    )


def _plot(origin: str, name: str, contents: list[str] | None = None) -> Any:
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents or ["$origin/**"],
        name=name,
        # Plots that move together are read together.
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def _stack(name: str, plots: list[Any], joints: int) -> Any:
    return rrb.Vertical(*plots, name=name) if joints <= _STACKED_JOINTS else rrb.Grid(*plots, name=name)


def _motion(trajectory: Trajectory, description: RobotDescription, sets: tuple[str, ...]) -> Any:
    plots = []
    for joint, unit in zip(trajectory.joint_names, description.position_units, strict=True):
        plots.append(_plot(f"/joints/{joint}/position", f"{joint} position [{unit}]"))
        if sets:
            plots.append(_plot(f"/joints/{joint}/error", f"{joint}: predicted minus real [{unit}]"))
    return _stack("Motion", plots, len(trajectory.joint_names))


def _velocities(trajectory: Trajectory, description: RobotDescription, sets: tuple[str, ...]) -> Any:
    plots = []
    for joint, unit in zip(trajectory.joint_names, description.position_units, strict=True):
        plots.append(_plot(f"/joints/{joint}/velocity", f"{joint} velocity [{unit}/s]"))
        if sets:
            plots.append(
                _plot(f"/joints/{joint}/velocity_error", f"{joint}: predicted minus real [{unit}/s]")
            )
    return _stack("Velocity", plots, len(trajectory.joint_names))


def _commands(trajectory: Trajectory, description: RobotDescription) -> Any:
    plots = []
    for joint in trajectory.actuated:
        unit = description.position_units[description.joint_names.index(joint)]
        shown = [f"/commands/{joint}/**", f"/joints/{joint}/position/measured"]
        plots.append(_plot("/", f"{joint}: target requested, target sent, position [{unit}]", shown))
        plots.append(_plot(f"/joints/{joint}/effort", f"{joint} effort [{'N' if unit == 'm' else 'N·m'}]"))
    return _stack("Commands", plots, len(trajectory.actuated))


def _body(trajectory: Trajectory) -> Any:
    legs = [
        _plot("/", f"{leg}: joint positions [rad]", [f"/joints/{joint}/position/**" for joint in joints])
        for leg, joints in _legs(trajectory.joint_names).items()
    ]
    plots = [
        _plot("/body/tilt", "Roll, pitch [deg]"),
        _plot("/body/gyro", "Angular velocity [rad/s]"),
        _plot("/body/acceleration", "Specific force [m/s²]"),
        _plot("/body/feet", "Foot force [robot's units]"),
        _plot("/body/battery", "Battery"),
        _plot("/body/temperature", "Motor temperature [°C]"),
    ]
    return rrb.Grid(*legs, *plots, grid_columns=2, name="Body")


def _legs(joints: tuple[str, ...]) -> dict[str, list[str]]:
    """Return joints by what their names begin with."""
    found: dict[str, list[str]] = {}
    for joint in joints:
        found.setdefault(joint.split("_")[0], []).append(joint)
    return found


def _robot(description: RobotDescription, bodies: FloatArray | None) -> Any:
    """Return the 3D view, looking along +y from far enough to see the robot and what sliding joints cover."""
    slides = [
        high
        for (_, high), unit in zip(description.limits.trip_position, description.position_units, strict=True)
        if unit == "m" and np.isfinite(high)
    ]
    reach = max([0.4, *slides])
    center = np.array([0.0, 0.0, 0.04 * reach])
    if bodies is not None and not slides:
        # Halfway between the outermost bodies; links reach somewhat beyond their frames.
        center = 0.5 * (bodies.min(axis=0) + bodies.max(axis=0))
        reach = max(reach, 1.3 * float(np.linalg.norm(bodies - center, axis=1).max()))
    eye = rrb.EyeControls3D(
        kind=rrb.components.Eye3DKind.Orbital,
        position=tuple(center + reach * np.array([0.12, -2.1, 0.46])),
        look_target=tuple(center),
        eye_up=(0.0, 0.0, 1.0),
    )
    return rrb.Spatial3DView(
        origin="/world",
        name="Robot: real solid, predictions as ghosts",
        eye_controls=eye,
        # A robot on the floor needs one to stand on.
        line_grid=rrb.LineGrid3D(visible=description.floating_base is not None, spacing=0.25),
        background=rrb.Background(kind=rrb.components.BackgroundKind.SolidColor, color=(24, 26, 30)),
    )
