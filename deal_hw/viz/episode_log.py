"""One recorded episode, with predictions beside it, as a rerun recording.

Entities, J joints and any number of parameter sets (``nominal``, ``calibrated``)::

    /joints/<joint>/position/{real,<set>}      m or rad; also /velocity
    /joints/<joint>/error/{<set>}              predicted minus measured position; also /velocity_error
    /joints/<joint>/effort                     N or N·m, the device's own estimate
    /commands/<joint>/{asked,sent}             position targets, when the device received them
    /status/<bit>                              what the robot says of itself
    /cadence/{command_period,state_period,state_age}    ms
    /events                                    text log
    /summary                                   markdown
    /world/{surroundings,real,<set>}/...       3D
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deal_hw.calibration import CalibrationResult
from deal_hw.description import RobotDescription
from deal_hw.sim.model import load_model
from deal_hw.sim.overlay import Overlay
from deal_hw.sim.scene import body_poses, read_scene
from deal_hw.types import FloatArray, Status, Trajectory
from deal_hw.viz import palette
from deal_hw.viz.backend import rr
from deal_hw.viz.blueprint import inspect_blueprint
from deal_hw.viz.columns import Log, command_device_times, host_to_device
from deal_hw.viz.robot_view import log_robot, log_surroundings
from deal_hw.viz.summary import summary_markdown

APPLICATION = "deal-hw inspect"
_BREAK_S = 1e-6
"""Offset of a break from the end of its window; a window's first point stands one further on than the last one's end."""
_ALARMING = ("passive", "trip", "fault", "watchdog", "overrun", "stop", "lost", "error")


def write_episode(
    path: Path,
    trajectory: Trajectory,
    description: RobotDescription,
    *,
    overlay: Overlay | None = None,
    result: CalibrationResult | None = None,
    name: str = "",
    note: str = "",
) -> None:
    """Write an episode as an .rrd file that opens with its own layout.

    Args:
        path: File to write.
        trajectory: The recording.
        description: The robot.
        overlay: Predictions to show beside it.
        result: The calibration whose parameters are listed.
        name: Name of the recording in the viewer.
        note: One more sentence for the summary.
    """
    sets = () if overlay is None else tuple(overlay.predictions)
    with rr.RecordingStream(APPLICATION, send_properties=False) as stream:
        stream.save(path)
        stream.send_blueprint(inspect_blueprint(trajectory, description, sets), make_active=True, make_default=True)
        stream.send_recording_name(name or str(trajectory.metadata.get("purpose", "episode")))
        log = Log(stream)
        log_samples(log, trajectory, description)
        log_commands(log, trajectory)
        log_status(log, trajectory)
        log_events(log, trajectory)
        if overlay is not None:
            log_overlay(log, overlay)
        log_scene(log, trajectory, description, overlay)
        text = summary_markdown(trajectory, description, overlay, result, note)
        stream.log("/summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
        stream.disconnect()


def log_samples(log: Log, trajectory: Trajectory, description: RobotDescription) -> None:
    """Write what the robot reported."""
    clocks = trajectory.device_s, trajectory.receive_s
    for j, joint in enumerate(trajectory.joint_names):
        for quantity, values in (("position", trajectory.position), ("velocity", trajectory.velocity)):
            path = f"/joints/{joint}/{quantity}/real"
            log.line(path, "real", palette.REAL, width=3.0)
            log.scalars(path, *clocks, values[:, j])
        if joint in trajectory.actuated:
            log.line(f"/joints/{joint}/effort", f"{joint} effort", palette.REAL)
            log.scalars(f"/joints/{joint}/effort", *clocks, trajectory.effort[:, j])
    log.line("/cadence/state_period", "between samples [ms]", palette.REAL, step=True)
    log.scalars("/cadence/state_period", clocks[0][1:], clocks[1][1:], 1e3 * np.diff(trajectory.receive_s))


def log_commands(log: Log, trajectory: Trajectory) -> None:
    """Write what was asked and sent, and how regularly."""
    device_s, sent_s = command_device_times(trajectory), trajectory.sent_s
    for a, joint in enumerate(trajectory.actuated):
        for what, values, color, width in (
            ("asked", trajectory.asked_position, palette.ASKED, 3.0),
            ("sent", trajectory.position_target, palette.SENT, 1.5),
        ):
            log.line(f"/commands/{joint}/{what}", what, color, width=width, step=True)
            log.scalars(f"/commands/{joint}/{what}", device_s, sent_s, values[:, a])
    log.line("/cadence/command_period", "between commands [ms]", palette.NOMINAL, step=True)
    log.scalars("/cadence/command_period", device_s[1:], sent_s[1:], 1e3 * np.diff(sent_s))
    newest = np.searchsorted(trajectory.receive_s, sent_s, side="right") - 1
    known = newest >= 0
    age_ms = 1e3 * (sent_s[known] - trajectory.receive_s[newest[known]])
    log.line("/cadence/state_age", "age of the state that a command answers [ms]", palette.CALIBRATED, step=True)
    log.scalars("/cadence/state_age", device_s[known], sent_s[known], age_ms)


def log_status(log: Log, trajectory: Trajectory) -> None:
    """Write each status bit that was ever set, at the samples where it changes."""
    for bit in Status:
        values = (trajectory.status & int(bit)) != 0
        if not values.any():
            continue
        change = np.flatnonzero(np.diff(values, prepend=~values[:1]))
        label = str(bit.name).lower().replace("_", " ")
        color = palette.REAL if bit in Status.ARMED | Status.HOMED | Status.HOMING else palette.ALARM
        path = f"/status/{label.replace(' ', '_')}"
        log.stream.log(path, rr.StateConfiguration(
            values=["on", "off"], labels=[label, ""], colors=[color, (45, 45, 45)]
        ), static=True)
        states = ["on" if values[i] else "off" for i in change]
        log.states(path, trajectory.device_s[change], trajectory.receive_s[change], states)


def log_events(log: Log, trajectory: Trajectory) -> None:
    """Write the events as a text log."""
    if not trajectory.events:
        return
    origin_ns = int(trajectory.metadata.get("first_receive_ns", 0))
    host_s = np.array([(event.stamp_ns - origin_ns) * 1e-9 for event in trajectory.events])
    texts = [f"{event.kind}: {event.message}" for event in trajectory.events]
    levels = ["WARN" if any(word in event.kind for word in _ALARMING) else "INFO" for event in trajectory.events]
    log.texts("/events", host_to_device(trajectory, host_s), host_s, texts, levels)


def log_overlay(log: Log, overlay: Overlay) -> None:
    """Write the predictions and their errors, broken between windows."""
    times = []
    for time_s in (overlay.device_s, overlay.receive_s):
        points = time_s.copy()
        points[:, 0] += 2 * _BREAK_S
        flat = overlay.broken_time(points).reshape(len(points), -1)
        flat[:, -1] += _BREAK_S
        times.append(flat.ravel())
    others = 0
    for name, prediction in overlay.predictions.items():
        color = palette.color_of(name, others)
        others += name not in {"nominal", "calibrated"}
        for quantity, values in (
            ("position", prediction.position),
            ("velocity", prediction.velocity),
            ("error", overlay.position_error(name)),
            ("velocity_error", overlay.velocity_error(name)),
        ):
            traces = overlay.broken(values)
            for j, joint in enumerate(overlay.joint_names):
                path = f"/joints/{joint}/{quantity}/{name}"
                log.line(path, name, color)
                log.scalars(path, times[0], times[1], traces[:, j])


def log_scene(
    log: Log, trajectory: Trajectory, description: RobotDescription, overlay: Overlay | None
) -> None:
    """Write the robot in 3D: the real one, and a ghost for each parameter set."""
    robot = load_model(description)
    scene = read_scene(robot)
    clocks = trajectory.device_s, trajectory.receive_s
    log_surroundings(log, scene)
    log_robot(log, scene, "real", palette.REAL, body_poses(robot, trajectory.position), clocks, ghost=False)
    others = 0
    for name in () if overlay is None else overlay.predictions:
        poses = body_poses(robot, _at_samples(overlay, name, trajectory.position.shape))
        log_robot(log, scene, name, palette.color_of(name, others), poses, clocks, ghost=True)
        others += name not in {"nominal", "calibrated"}


def _at_samples(overlay: Overlay | None, name: str, shape: tuple[int, ...]) -> FloatArray:
    """Return a prediction at the recording's samples, (T, J): at a seam the end of a window; NaN outside windows."""
    out = np.full(shape, np.nan)
    if overlay is not None:
        position = overlay.predictions[name].position
        out[overlay.sample[:, 0]] = position[:, 0]
        out[overlay.sample[:, 1:]] = position[:, 1:]
    return out
