"""One recorded episode, with predictions beside it, as a rerun recording.

Entities, J joints and any number of parameter sets (``nominal``, ``calibrated``)::

    /joints/<joint>/position/measured          m or rad; also /velocity
    /joints/<joint>/position/predicted/<set>   also /velocity
    /joints/<joint>/error/<set>                predicted minus measured position; also /velocity_error
    /joints/<joint>/effort                     N or N·m, the device's own estimate
    /commands/<joint>/{requested,sent}             position targets, when the device received them
    /status/<bit>                              status bits that the robot reports
    /status/safety                             state of the safety filter
    /loop_timing/{command_period,state_period,state_age,lateness}    ms
    /events                                    text log
    /body/{tilt,gyro,acceleration}/...         IMU, for robots with legs; also
    /body/{feet,temperature,battery}/...
    /{verdict,summary}                         markdown
    /world/{surroundings,real,<set>}/...       3D

Rerun draws traces in the order of their paths: "measured" comes before "predicted", so that it stays below.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deal_hw.calibration import CalibrationResult
from deal_hw.data.recording.reader import CycleTable
from deal_hw.description import RobotDescription
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.scene import body_poses, read_scene
from deal_hw.sim.recordings.overlay import Overlay
from deal_hw.sim.recordings.standing import sensed_base
from deal_hw.types import FloatArray, Status, Trajectory
from deal_hw.viz import palette
from deal_hw.viz.backend import rr
from deal_hw.viz.blueprint import inspect_blueprint
from deal_hw.viz.body_log import log_body
from deal_hw.viz.columns import Log, command_device_times, host_to_device
from deal_hw.viz.robot_view import log_robot, log_surroundings
from deal_hw.viz.summary import summary_markdown, verdict_markdown

APPLICATION = "deal-hw inspect"
_BREAK_S = 1e-6
"""Offset of a break from its window's end, and of the next window's first point from the break."""
_ALARMING = ("passive", "trip", "fault", "watchdog", "overrun", "stop", "lost", "error", "not following")


def write_episode(
    path: Path,
    trajectory: Trajectory,
    description: RobotDescription,
    *,
    cycles: CycleTable | None = None,
    overlay: Overlay | None = None,
    result: CalibrationResult | None = None,
    verdict: str = "",
    name: str = "",
    note: str = "",
) -> None:
    """Write an episode as an .rrd file that opens with its own layout.

    Args:
        path: File to write.
        trajectory: The recording.
        description: The robot.
        cycles: The control cycles, for loop timing and safety states.
        overlay: Predictions to show beside it.
        result: The calibration whose parameters are listed.
        verdict: Whether it can be used, in markdown.
        name: Name of the recording in the viewer.
        note: One more sentence for the verdict, such as why there are no predictions or where they end.
    """
    alarms = () if result is None else result.alarms
    with rr.RecordingStream(APPLICATION, send_properties=False) as stream:
        stream.save(path)
        robot = load_model(description)
        base = sensed_base(robot, trajectory)
        poses = body_poses(robot, trajectory.position, base)
        bodies = _first_known(poses[0])
        layout = inspect_blueprint(trajectory, description, overlay, cycles, bodies, alarms=bool(alarms))
        stream.send_blueprint(layout, make_active=True, make_default=True)
        stream.send_recording_name(name or str(trajectory.metadata.get("purpose", "episode")))
        log = Log(stream)
        log_samples(log, trajectory, description)
        log_commands(log, trajectory)
        if cycles is not None:
            log_cycles(log, trajectory, cycles)
        log_status(log, trajectory)
        if trajectory.body is not None:
            log_body(log, trajectory, trajectory.body, description)
        log_events(log, trajectory)
        if overlay is not None:
            log_overlay(log, trajectory, overlay)
        log_scene(log, trajectory, robot, base, poses, overlay)
        for entity, text in (
            ("/verdict", verdict_markdown(overlay, verdict, alarms, note)),
            ("/summary", summary_markdown(trajectory, description, overlay, result)),
        ):
            stream.log(entity, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
        stream.disconnect()


def log_samples(log: Log, trajectory: Trajectory, description: RobotDescription) -> None:
    """Write the states of the robot."""
    clocks = trajectory.device_s, trajectory.receive_s
    for j, joint in enumerate(trajectory.joint_names):
        for quantity, values in (("position", trajectory.position), ("velocity", trajectory.velocity)):
            path = f"/joints/{joint}/{quantity}/measured"
            log.line(path, "measured", palette.REAL, width=3.5)
            log.scalars(path, *clocks, values[:, j])
        if joint in trajectory.actuated:
            log.line(f"/joints/{joint}/effort", f"{joint} effort", palette.REAL)
            log.scalars(f"/joints/{joint}/effort", *clocks, trajectory.effort[:, j])
    log.line("/loop_timing/state_period", "between samples", palette.REAL, step=True)
    log.scalars(
        "/loop_timing/state_period", clocks[0][1:], clocks[1][1:], 1e3 * np.diff(trajectory.receive_s)
    )


def log_commands(log: Log, trajectory: Trajectory) -> None:
    """Write the commands requested and sent, and their timing."""
    device_s, sent_s = command_device_times(trajectory), trajectory.sent_s
    for a, joint in enumerate(trajectory.actuated):
        for what, values, color, width in (
            ("requested", trajectory.requested_position, palette.REQUESTED, 3.0),
            ("sent", trajectory.position_target, palette.SENT, 1.5),
        ):
            log.line(f"/commands/{joint}/{what}", what, color, width=width, step=True)
            log.scalars(f"/commands/{joint}/{what}", device_s, sent_s, values[:, a])
    log.line("/loop_timing/command_period", "between commands", palette.NOMINAL, step=True)
    log.scalars("/loop_timing/command_period", device_s[1:], sent_s[1:], 1e3 * np.diff(sent_s))


def log_cycles(log: Log, trajectory: Trajectory, cycles: CycleTable) -> None:
    """Write the timing of the control loop and the states of its safety filter."""
    host_s = cycles.start_s
    device_s = host_to_device(trajectory, host_s)
    for name, label, values, color in (
        ("lateness", "lateness of a cycle", host_s - cycles.deadline_s, palette.SENT),
        ("state_age", "age of the state", cycles.state_age_s, palette.CALIBRATED),
    ):
        log.line(f"/loop_timing/{name}", label, color, step=True)
        log.scalars(f"/loop_timing/{name}", device_s, host_s, 1e3 * values)
    change = [
        i for i, state in enumerate(cycles.safety_state) if i == 0 or state != cycles.safety_state[i - 1]
    ]
    names = sorted({cycles.safety_state[i] for i in change})
    if names:
        colors = [palette.ALARM if name.lower() == "passive" else palette.REAL for name in names]
        log.stream.log(
            "/status/safety", rr.StateConfiguration(values=names, labels=names, colors=colors), static=True
        )
        log.states(
            "/status/safety", device_s[change], host_s[change], [cycles.safety_state[i] for i in change]
        )


def log_status(log: Log, trajectory: Trajectory) -> None:
    """Write each status bit that changes or is set, at the samples where it changes."""
    for bit in Status:
        values = (trajectory.status & int(bit)) != 0
        usual = bit in Status.ARMED | Status.HOMED
        if not values.any() or (usual and values.all()):
            continue
        change = np.flatnonzero(np.diff(values, prepend=~values[:1]))
        label = str(bit.name).lower().replace("_", " ")
        path = f"/status/{label.replace(' ', '_')}"
        style = rr.StateConfiguration(
            values=["on", "off"],
            labels=[label, "off"],
            colors=[palette.REAL if usual else palette.ALARM, palette.REQUESTED],
            visible=[True, False],
        )
        log.stream.log(path, style, static=True)
        states = ["on" if values[i] else "off" for i in change]
        log.states(path, trajectory.device_s[change], trajectory.receive_s[change], states)


def log_events(log: Log, trajectory: Trajectory) -> None:
    """Write the events as a text log."""
    if not trajectory.events:
        return
    origin_ns = int(trajectory.metadata.get("start_ns", 0))
    host_s = np.array([(event.stamp_ns - origin_ns) * 1e-9 for event in trajectory.events])
    texts = [f"{event.kind}: {event.message}" for event in trajectory.events]
    levels = [
        "WARN" if any(word in event.kind for word in _ALARMING) else "INFO" for event in trajectory.events
    ]
    log.texts("/events", host_to_device(trajectory, host_s), host_s, texts, levels)


def log_overlay(log: Log, trajectory: Trajectory, overlay: Overlay) -> None:
    """Write the predictions and their errors, broken between windows."""
    device_s = _broken_times(overlay.device_s, trajectory.device_s)
    receive_s = _broken_times(overlay.receive_s, trajectory.receive_s)
    for name, prediction in overlay.predictions.items():
        color = palette.color_of(name, list(overlay.predictions))
        for quantity, legend, values in (
            ("position/predicted", name, prediction.position),
            ("velocity/predicted", name, prediction.velocity),
            ("error", f"{name} - measured", overlay.position_error(name)),
            ("velocity_error", f"{name} - measured", overlay.velocity_error(name)),
        ):
            traces = np.pad(overlay.broken(values), ((1, 1), (0, 0)), constant_values=np.nan)
            for j, joint in enumerate(overlay.joint_names):
                path = f"/joints/{joint}/{quantity}/{name}"
                log.line(path, legend, color)
                log.scalars(path, device_s, receive_s, traces[:, j])


def _broken_times(window_s: FloatArray, recording_s: FloatArray) -> FloatArray:
    """Return the times of windows joined to one trace, from the recording's first sample to its last.

    Linked plots open with the same span only where their traces have it.
    """
    points = window_s.copy()
    points[:, 0] += 2 * _BREAK_S
    flat = Overlay.broken_time(points).reshape(len(points), -1)
    flat[:, -1] += _BREAK_S
    return np.concatenate([recording_s[:1], flat.ravel(), recording_s[-1:] + 3 * _BREAK_S])


def _first_known(positions: FloatArray) -> FloatArray | None:
    """Return the positions of the bodies without the world, (B - 1, 3), at the first sample that has them."""
    known = np.flatnonzero(np.isfinite(positions).all(axis=(1, 2)))
    return positions[known[0], 1:] if known.size else None


def log_scene(
    log: Log,
    trajectory: Trajectory,
    robot: RobotModel,
    base: FloatArray | None,
    poses: tuple[FloatArray, FloatArray],
    overlay: Overlay | None,
) -> None:
    """Write the robot in 3D: the real one, and a transparent one for each parameter set.

    Args:
        log: The log to write to.
        trajectory: The recording.
        robot: The robot's model.
        base: Sensed poses of a floating base, (T, 7); None for a fixed one.
        poses: Of the real robot's bodies, as :func:`~deal_hw.sim.engine.scene.body_poses` returns them.
        overlay: Predictions to show beside it.
    """
    scene = read_scene(robot)
    clocks = trajectory.device_s, trajectory.receive_s
    log_surroundings(log, scene)
    log_robot(log, scene, "real", palette.REAL, poses, clocks, ghost=False)
    if overlay is None:
        return
    for name, prediction in overlay.predictions.items():
        color = palette.color_of(name, list(overlay.predictions))
        position = _at_samples(overlay, prediction.position, trajectory.position)
        at = None
        if base is not None and prediction.base is not None:
            at = _at_samples(overlay, _beside(prediction.base, base[overlay.sample]), base)
        poses = body_poses(robot, position, at)
        log_robot(log, scene, name, color, poses, clocks, ghost=True)


def _beside(predicted: FloatArray, real: FloatArray) -> FloatArray:
    """Return predicted base poses, (W, H + 1, 7), beside the real ones as they are drawn, (W, H + 1, 7).

    Each window starts at the real height. The real robot's motion along the floor is not measured, so it is
    drawn in one place. The prediction is, too, or every step ahead would look like an error.
    """
    moved = predicted.copy()
    moved[..., :2] = real[..., :2]
    moved[..., 2] += (real[:, 0, 2] - predicted[:, 0, 2])[:, None]
    return moved


def _at_samples(overlay: Overlay, position: FloatArray, measured: FloatArray) -> FloatArray:
    """Return a prediction at the samples, (T, ...): at a seam a window's end; measured outside windows."""
    out = measured.copy()
    out[overlay.sample[:, 0]] = position[:, 0]
    out[overlay.sample[:, 1:]] = position[:, 1:]
    return out
