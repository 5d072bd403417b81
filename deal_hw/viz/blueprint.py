"""Layout of an inspected episode: verdict, robot and details at the left, plots at the right.

Rerun starts a plot where its y labels end and has no setting for it. So time axes are aligned only where
labels are equally wide, as in most plots of one quantity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from deal_hw.data.recording.reader import CycleTable
from deal_hw.description import EFFORT_UNITS, RobotDescription
from deal_hw.sim.recordings.overlay import Overlay
from deal_hw.types import BodyTrajectory, FloatArray, Trajectory
from deal_hw.viz import palette
from deal_hw.viz.backend import rr, rrb
from deal_hw.viz.body_log import LEG_COLORS, SUPPLY, supply, tilt
from deal_hw.viz.columns import DEVICE_TIMELINE, command_device_times
from deal_hw.viz.scales import Curve, clear_corner, time_columns, visible_range

FROM_CAMERA = np.array([0.1, -1.7, 0.37])
"""From the robot's middle to the camera, in multiples of its reach. Rerun shows 0.6 of the distance up and
down, so the whole reach, and more to the sides."""
BESIDE = 0.25
"""Part of the measured range that predictions may take to either side of it."""
SMALLEST_M = 0.1
"""Least reach of a robot in the view [m]: a single joint has no extent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plot:
    """A plot of signals of one unit.

    Attributes:
        name: Title, with the unit.
        origin: Entity at the root of the contents.
        contents: Entities in it.
        curves: The drawn curves.
        within: Largest range of the y axis.
    """

    name: str
    origin: str
    contents: tuple[str, ...] = ("$origin/**",)
    curves: tuple[Curve, ...]
    within: tuple[float, float] = (-np.inf, np.inf)

    def view(self, rows: int) -> Any:
        """Return the view of one of some rows of plots; all of them share one time axis."""
        limits = visible_range(self.curves, self.within, rows)
        return rrb.TimeSeriesView(
            origin=self.origin,
            contents=list(self.contents),
            name=self.name,
            axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
            axis_y=rrb.ScalarAxis(range=limits, zoom_lock=False),
            plot_legend=rrb.PlotLegend(rrb.Corner2D[clear_corner(self.curves, limits)]),
        )


def inspect_blueprint(
    trajectory: Trajectory,
    description: RobotDescription,
    overlay: Overlay | None = None,
    cycles: CycleTable | None = None,
    bodies: FloatArray | None = None,
    alarms: bool = False,
) -> Any:
    """Return the layout.

    Args:
        trajectory: The recording.
        description: The robot.
        overlay: Predictions to show beside it.
        cycles: The control cycles.
        bodies: Positions of the robot's bodies at the start, for the camera, (B, 3) [m]; None: the origin.
        alarms: Whether there are alarms.
    """
    tabs = [
        _joints("position", trajectory, description, overlay),
        _joints("velocity", trajectory, description, overlay),
        _commands(trajectory, description),
    ]
    if trajectory.body is not None:
        tabs.append(_body(trajectory, trajectory.body))
    tabs.append(_loop_timing(trajectory, cycles))
    # In one place, so that each text has the height of many alarms, and the robot is large.
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin="/verdict", name="Verdict and alarms"),
        rrb.TextDocumentView(origin="/summary", name="Parameters and errors"),
        rrb.TextLogView(
            origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
        ),
        rrb.StateTimelineView(origin="/status", name="Status"),
        active_tab=0,
    )
    left = rrb.Vertical(texts, _robot(description, bodies), row_shares=[4 if alarms else 3, 3])
    right = rrb.Tabs(*tabs, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIMELINE, play_state="paused", loop_mode="all"),
        auto_layout=False,
        auto_views=False,
    )


def joint_groups(names: Sequence[str], most: int) -> dict[str, list[int]]:
    """Return which joints share a tab, by the tab's name: legs, or some in their order.

    Args:
        names: The joints.
        most: Joints of a tab at most.
    """
    if len(names) <= most:
        return {"": list(range(len(names)))}
    legs: dict[str, list[int]] = {}
    for j, name in enumerate(names):
        legs.setdefault(name.split("_")[0], []).append(j)
    if all(2 <= len(leg) <= most for leg in legs.values()):
        return legs
    parts = np.array_split(np.arange(len(names)), -(-len(names) // most))
    return {" to ".join(dict.fromkeys((names[p[0]], names[p[-1]]))): p.tolist() for p in parts}


def _grids(name: str, plots: Sequence[Sequence[Plot]], trajectory: Trajectory, joints: Sequence[str]) -> Any:
    """Return the plots of each joint, on tabs if there are many."""
    columns = time_columns(trajectory.duration_s)
    # At most two wide plots are below each other; with more, the plots were too low for labels.
    most = max(columns * (1 + columns) // len(plots[0]), 1) if plots else 1
    tabs = []
    for group, members in joint_groups(joints, most).items():
        shown = [plot for j in members for plot in plots[j]]
        views = [plot.view(-(-len(shown) // columns)) for plot in shown]
        tabs.append(rrb.Grid(*views, grid_columns=columns, name=group or name))
    return tabs[0] if len(tabs) == 1 else rrb.Tabs(*tabs, name=name, active_tab=0)


def _joints(
    quantity: Literal["position", "velocity"],
    trajectory: Trajectory,
    description: RobotDescription,
    overlay: Overlay | None,
) -> Any:
    """Return a quantity of each joint, followed by the errors of predictions."""
    error, per_second = ("error", "") if quantity == "position" else ("velocity_error", "/s")
    rows: list[list[Plot]] = []
    for j, (joint, unit) in enumerate(zip(trajectory.joint_names, description.position_units, strict=True)):
        measured = getattr(trajectory, quantity)[:, j]
        low, high = _span(measured)
        # A prediction that diverges must not make the measured curve small.
        reach = high - low or np.inf
        shown, errors = [(trajectory.device_s, measured)], []
        if overlay is not None:
            real = getattr(overlay, quantity)[..., j]
            predicted = [getattr(p, quantity)[..., j] for p in overlay.predictions.values()]
            shown += [(overlay.device_s, values) for values in predicted]
            errors += [(overlay.device_s, values - real) for values in predicted]
        row = [
            Plot(
                name=f"{joint} {quantity} [{unit}{per_second}]",
                origin=f"/joints/{joint}/{quantity}",
                curves=tuple(shown),
                within=(low - BESIDE * reach, high + BESIDE * reach),
            )
        ]
        if errors:
            row.append(
                Plot(
                    name=f"{joint}: predicted - measured [{unit}{per_second}]",
                    origin=f"/joints/{joint}/{error}",
                    curves=tuple(errors),
                    within=(-reach, reach),
                )
            )
        rows.append(row)
    return _grids(quantity.capitalize(), rows, trajectory, trajectory.joint_names)


def _commands(trajectory: Trajectory, description: RobotDescription) -> Any:
    rows = []
    targets = command_device_times(trajectory)
    for a, joint in enumerate(trajectory.actuated):
        j = trajectory.joint_names.index(joint)
        unit = description.position_units[description.joint_names.index(joint)]
        target = Plot(
            name=f"{joint}: target and position [{unit}]",
            origin="/",
            contents=(f"/commands/{joint}/**", f"/joints/{joint}/position/measured"),
            curves=(
                (targets, trajectory.requested_position[:, a]),
                (targets, trajectory.position_target[:, a]),
                (trajectory.device_s, trajectory.position[:, j]),
            ),
        )
        effort = Plot(
            name=f"{joint} effort [{EFFORT_UNITS[unit]}]",
            origin=f"/joints/{joint}/effort",
            curves=((trajectory.device_s, trajectory.effort[:, a]),),
        )
        # Few imported recordings have efforts.
        rows.append([target, effort] if np.isfinite(trajectory.effort).any() else [target])
    return _grids("Commands", rows, trajectory, trajectory.actuated)


def _loop_timing(trajectory: Trajectory, cycles: CycleTable | None) -> Any:
    def plot(name: str, entities: dict[str, FloatArray]) -> Plot:
        curves = tuple((np.arange(len(v), dtype=float), 1e3 * v) for v in entities.values())
        contents = tuple(f"/loop_timing/{entity}" for entity in entities)
        return Plot(name=name, origin="/loop_timing", contents=contents, curves=curves)

    periods = {"state_period": np.diff(trajectory.receive_s), "command_period": np.diff(trajectory.sent_s)}
    plots = [plot("Time between samples and between commands [ms]", periods)]
    if cycles is not None:
        delays = {"lateness": cycles.start_s - cycles.deadline_s, "state_age": cycles.state_age_s}
        plots.append(plot("Lateness of cycles, age of the state [ms]", delays))
    return rrb.Vertical(*(one.view(len(plots)) for one in plots), name="Loop timing")


def _body(trajectory: Trajectory, body: BodyTrajectory) -> Any:
    """Return the plots of the body's sensors; an imported recording has the IMU alone."""
    tabs: dict[str, list[Plot]] = {}

    def add(tab: str, name: str, group: str, values: FloatArray, *names: str) -> None:
        if not np.isfinite(values).any():
            return
        parts = [rr.escape_entity_path_part(one) for one in names]
        contents = tuple(f"/body/{group}/{part}" for part in parts) or ("$origin/**",)
        curves = tuple((trajectory.device_s, column) for column in values.T)
        plot = Plot(name=name, origin=f"/body/{group}", contents=contents, curves=curves)
        tabs.setdefault(tab, []).append(plot)

    add("IMU and feet", "Roll, pitch [deg]", "tilt", tilt(body))
    add("IMU and feet", "Angular velocity [rad/s]", "gyro", body.angular_velocity)
    add("IMU and feet", "Specific force [m/s²]", "acceleration", body.acceleration)
    add("IMU and feet", "Foot force [robot's units]", "feet", body.foot_force)
    warm = trajectory.joint_names[: body.temperature.shape[1]]
    for leg, members in joint_groups(warm, len(LEG_COLORS)).items():
        joints = [warm[j] for j in members]
        name = f"{leg} motor temperature [°C]".strip()
        add("Temperature", name, "temperature", body.temperature[:, members], *joints)
    for (word, unit), values in zip(SUPPLY, supply(body).T, strict=True):
        add("Battery", f"{word} [{unit}]", "battery", values[:, None], f"{word.lower()}_{unit}")
    grids = []
    for tab, plots in tabs.items():
        columns = 1 if len(plots) < 4 else 2
        views = [plot.view(-(-len(plots) // columns)) for plot in plots]
        grids.append(rrb.Grid(*views, grid_columns=columns, name=tab))
    return rrb.Tabs(*grids, name="Body", active_tab=0)


def _span(values: FloatArray) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)


def _robot(description: RobotDescription, bodies: FloatArray | None) -> Any:
    """Return the 3D view along +y, from far enough to see the robot and the range of sliding joints."""
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
        reach = max(SMALLEST_M, 1.3 * float(np.linalg.norm(bodies - center, axis=1).max()))
    eye = rrb.EyeControls3D(
        kind=rrb.components.Eye3DKind.Orbital,
        position=tuple(center + reach * FROM_CAMERA),
        look_target=tuple(center),
        eye_up=(0.0, 0.0, 1.0),
    )
    return rrb.Spatial3DView(
        origin="/world",
        name="Robot: measured solid, predictions as ghosts",
        eye_controls=eye,
        # A robot on the floor is drawn with a floor.
        line_grid=rrb.LineGrid3D(visible=description.floating_base is not None, spacing=0.25),
        background=rrb.Background(kind=rrb.components.BackgroundKind.SolidColor, color=palette.SKY),
    )
