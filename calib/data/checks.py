"""Is there enough in a recording to calibrate from? Refuses before any long work and says what to record."""

from __future__ import annotations

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calibration import SHORTEST_S
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.sim.engine.batch import COMMAND_DELAY


def check_delays(problem: Problem) -> None:
    """Check that command delays can be told from the latency, which is searched beside the parameters.

    Raises:
        ConfigurationError: Every actuator's delay is searched, and the latency as well.
    """
    delays = [p for p in problem.space if p.kind == COMMAND_DELAY]
    moved = {element for p in delays for element in p.elements}
    if problem.fixed_latency_s is None and moved >= set(problem.robot.actuator_names):
        raise ConfigurationError(
            f"{', '.join(p.name for p in delays)}: every command is delayed by the latency, too, which is "
            "searched beside the parameters, so only their sum can be seen; leave the delay of one actuator "
            "out or `known`, or give the latency (--latency)"
        )


def check_excitation(problem: Problem) -> None:
    """Check that the recordings are long enough and move.

    Raises:
        InsufficientDataError: They do not; the message says what was found and what to record.
    """
    seconds = sum(float(np.sum(e.usable)) * e.period_s for e in problem.episodes)
    advice = "record again with `deal-hw collect --profile rich` (4 s are enough; --vigor 1 to 3 is livelier)"
    if seconds < SHORTEST_S:
        raise InsufficientDataError(
            f"{seconds:.2f} s of usable samples, at least {SHORTEST_S:g} s are needed; {advice}"
        )
    names = problem.robot.description.joint_names
    joints = problem.robot.joints
    spans = np.max([np.ptp(e.position[e.usable][:, joints], axis=0) for e in problem.episodes], axis=0)
    noises = problem.noise_std[: problem.coordinates][joints]
    if problem.known_std is None and not problem.exact:
        # What a recording happens to show may be less than its sensor's noise, down to none at all: a joint
        # that never left its friction is still no motion to calibrate from.
        noises = np.maximum(noises, problem.robot.description.sensor.position_std)
    settings = problem.settings
    least = settings.least_motion if problem.known_std is None else settings.least_chosen_motion
    still = [
        f"{name} moved {span:.2g} (noise {noise:.2g})"
        for name, span, noise in zip(names, spans, noises, strict=True)
        if span < least * noise
    ]
    if still:
        raise InsufficientDataError(f"the recording hardly moves: {'; '.join(still)}; {advice}")
    changes = sum(
        int(np.count_nonzero(np.any(np.diff(e.target, axis=0) != 0, axis=1))) for e in problem.episodes
    )
    if changes < settings.fewest_changes:
        raise InsufficientDataError(
            f"the position target changed {changes} times, at least {settings.fewest_changes} are needed; "
            f"{advice}"
        )
