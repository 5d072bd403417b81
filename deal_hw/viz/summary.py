"""Texts beside the traces: the recording, the errors of each parameter set, the parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.calibration import CalibrationResult, percent
from deal_hw.description import RobotDescription
from deal_hw.findings import Finding
from deal_hw.sim.recordings.overlay import Overlay, Prediction
from deal_hw.types import Trajectory

_WIDE = 3
"""Robots with more joints get a row for each instead of a column."""


def verdict_markdown(
    overlay: Overlay | None, verdict: str, alarms: Sequence[Finding] = (), note: str = ""
) -> str:
    """Return the text at the top, as markdown: the verdict on the calibration, and its alarms.

    Args:
        overlay: Predictions, if there are any.
        verdict: Whether the calibration can be used; empty where none is shown.
        alarms: Its alarms; a line each.
        note: One more sentence, such as why there is no overlay.
    """
    parts = [
        verdict or "No calibration is shown: `--calibration` takes the folder of one.",
        f"**{note}**" if note else "",
        "" if overlay is None else _mean_errors(overlay),
        "\n".join(f"{number}. {alarm.seen}" for number, alarm in enumerate(alarms, start=1)),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def summary_markdown(
    trajectory: Trajectory,
    description: RobotDescription,
    overlay: Overlay | None,
    result: CalibrationResult | None,
) -> str:
    """Return the details as markdown: errors of each joint, parameters, and the alarms in full.

    Args:
        trajectory: The recording.
        description: The robot.
        overlay: Predictions, if there are any.
        result: The calibration, if there is one.
    """
    parts = [_recording(trajectory, description)]
    if overlay is not None:
        parts.append(_errors(overlay, description))
    if result is not None:
        parts += [_parameters(result), _verdict(result)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _mean_errors(overlay: Overlay) -> str:
    shares = ", ".join(
        f"{name} {percent(float(np.nanmean(prediction.position_nrmse)))}"
        for name, prediction in overlay.predictions.items()
    )
    return (
        f"**Error of predictions over {overlay.window_s:.2f} s:** {shares} of the position's range "
        "(mean over the joints)."
    )


def _recording(trajectory: Trajectory, description: RobotDescription) -> str:
    purpose = trajectory.metadata.get("purpose", "recording")
    return (
        f"**{description.name}, {purpose}:** {trajectory.duration_s:.2f} s, "
        f"{len(trajectory.device_s)} samples, {len(trajectory.sent_s)} commands, "
        f"{len(trajectory.events)} events"
    )


def _errors(overlay: Overlay, description: RobotDescription) -> str:
    title = f"**Open-loop prediction, restarted every {overlay.window_s:.2f} s.** RMSE (share of the range):"
    if len(overlay.joint_names) > _WIDE:
        return "\n".join([title, "", *_by_joint(overlay, description)])
    lines = [
        title,
        "",
        "| set | " + " | ".join(overlay.joint_names) + " | latency |",
        "|---" * (len(overlay.joint_names) + 2) + "|",
    ]
    for name, prediction in overlay.predictions.items():
        cells = _cells(prediction, description)
        lines.append(f"| {name} | " + " | ".join(cells) + f" | {1e3 * prediction.latency_s:.1f} ms |")
    return "\n".join(lines)


def _by_joint(overlay: Overlay, description: RobotDescription) -> list[str]:
    """Return the table's lines with a row for each joint."""
    sets = {name: _cells(prediction, description) for name, prediction in overlay.predictions.items()}
    latencies = [f"{1e3 * p.latency_s:.1f} ms" for p in overlay.predictions.values()]
    return [
        "| joint | " + " | ".join(sets) + " |",
        "|---" * (len(sets) + 1) + "|",
        *(
            f"| {joint} | " + " | ".join(cells) + " |"
            for joint, *cells in zip(overlay.joint_names, *sets.values(), strict=True)
        ),
        "| latency | " + " | ".join(latencies) + " |",
    ]


def _cells(prediction: Prediction, description: RobotDescription) -> list[str]:
    rmse = (prediction.window_rmse**2).mean(axis=0) ** 0.5
    return [
        f"{1e3 * value:.3g} m{unit} ({percent(share)})"
        for value, unit, share in zip(
            rmse, description.position_units, prediction.position_nrmse, strict=True
        )
    ]


def _parameters(result: CalibrationResult) -> str:
    low_ms, high_ms = (1e3 * value for value in result.latency_interval_s)
    known = [f"{name} {value:.4g} {result.space[name].unit}" for name, value in result.space.known.items()]
    facts = [f"latency {1e3 * result.latency_s:.1f} ms ({low_ms:.1f} to {high_ms:.1f})"]
    facts += [f"known: {', '.join(known)}"] if known else []
    lines = [
        f"**Parameters by {result.method}.** {'; '.join(facts)}",
        "",
        "| parameter | nominal | estimate | 90 % interval | |",
        "|---|---|---|---|---|",
    ]
    for k, p in enumerate(result.space):
        verdict = result.verdicts[k] if result.verdicts else ""
        low, high = result.interval[k]
        lines.append(
            f"| {p.name} [{p.unit}] | {p.nominal:.3g} | {result.estimate_text(p.name)} | "
            f"{low:.3g} to {high:.3g} | "
            f"{'' if verdict == 'identifiable' else verdict} |"
        )
    return "\n".join(lines)


def _verdict(result: CalibrationResult) -> str:
    lines = [
        f"{number}. {alarm.seen} {alarm.means} **{alarm.do}**"
        for number, alarm in enumerate(result.alarms, start=1)
    ]
    lines = ["**Alarms.**", "", *lines, ""] if lines else []
    lines += [f"- not determined by the data: {direction}" for direction in result.null_directions]
    lines += [f"- {direction}" for direction in result.prior_directions]
    return "\n".join(lines)
