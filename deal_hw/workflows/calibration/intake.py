"""The one way from recordings to a calibration: read, align, divide, and check what they can show.

    settings -> reader -> Source -> align -> divide -> what the recordings know -> CalibrationInput

Readers (`dataset.py`, `files.py`) differ in where recordings, model and parameters come from, and check what
only they can see. All that follows is here, once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.pipeline.methods import UNALIGNED_METHODS
from deal_hw.calibration import LATENCY, LATENCY_RANGE_S
from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.ranges import Range
from deal_hw.types import BaseTrajectory, FloatArray, Trajectory
from deal_hw.workflows.calibration.checks import require_base, sensitive_parameters, warn_of_gravity
from deal_hw.workflows.calibration.settings import (
    HELDOUT_WINDOW_S,
    CalibrateSettings,
    DriverDatasetSettings,
    FilesSettings,
    OwnDatasetSettings,
    UserRobotSettings,
)
from deal_hw.workflows.calibration.setups import given_setups, in_setups
from deal_hw.workflows.calibration.source import Division, Named, Source
from deal_hw.workflows.calibration.space import without_idle_limits
from deal_hw.workflows.say import Say, silent

if TYPE_CHECKING:
    from deal_hw.calib.data.population_policy import PopulationPolicy
    from deal_hw.motions.behaviours import Behaviour
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

STRETCH_S = 2.5
"""Fitted recordings are cut into parts of about this length, so that some lie in every motion [s]."""
HELDOUT_STRETCH_S = 20.0
SHORT_S = 1.6
"""Of shorter recordings, many at a time, some are held out as a whole [s]: a quarter of one would hold a
prediction or two, both in the smoother's reach of its ends."""
HELDOUT_LEAST_S = 1.25 * HELDOUT_WINDOW_S
"""Least length of a part that is held out [s]: a prediction fits in with a sample or two to spare."""
GAIT_SMOOTHING_S = 0.04
"""Landing feet change joint velocities within about 10 ms; longer smoothing biases the states there [s]."""
WALK_TELLS = (
    "a walk shows the joints' gains and the floor's friction, but hardly their dry friction, not their "
    "armature, and masses only if the motors' efforts weigh the robot"
)
WEIGHING_S = 0.35
"""Time that a robot stands still before it walks [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationInput:
    """The input of a calibration, read and checked.

    Attributes:
        robot: The nominal model.
        space: The parameters to search.
        episodes: Recordings to fit.
        holdout: Held-out recordings, which only test the result; the search never uses them.
        shown: The recording that ``--watch`` shows; None where nothing is watched.
        telemetry: Verdicts on the recordings, for the report.
        provenance: Sources of the input: plain JSON values.
        advice: How to get a held-out recording if there is none.
        balance: Makes the policy that balances the robot in advised motions; None: it stands by itself.
        name: Name under which `deal-hw collect` records this robot; "" if it cannot.
        walks: Whether all recordings are of a policy that walks.
        policy: The policy that moved the robot all the time, if the method needs it.
        known_std: Expected standard deviation of the prediction error, positions then velocities, (2 C,);
            None: the sensor noise, estimated from the recordings.
        guessed: Names of the parameters whose range nobody chose; "latency" is the latency. See
            :mod:`deal_hw.calib.pipeline.wider_ranges`.
    """

    robot: RobotModel
    space: ParameterSpace
    episodes: Sequence[SampledEpisode]
    holdout: Sequence[SampledEpisode] = ()
    shown: Trajectory | None = None
    telemetry: Sequence[str] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    advice: str = ""
    balance: Callable[[], Behaviour] | None = None
    name: str = ""
    walks: bool = False
    policy: PopulationPolicy | None = None
    known_std: FloatArray | None = None
    guessed: tuple[str, ...] = ()

    @property
    def smoothing_s(self) -> float | None:
        """Time over which start states are smoothed [s]; None for the default."""
        return GAIT_SMOOTHING_S if self.walks else None


def calibration_input(settings: CalibrateSettings, *, say: Say = silent) -> CalibrationInput:
    """Read and check the input of a calibration, in a short time.

    Args:
        settings: The settings of one kind of recordings.
        say: Called with sentences on guesses and doubts.

    Raises:
        ConfigurationError: A setting, the model or a parameter cannot be used.
        DatasetError: A recording cannot be read, understood or trusted.
        InsufficientDataError: The recordings are too short, do not move, or do not depend on a parameter.
    """
    settings.check()
    with extra("calib"):
        return _input_of(_read(settings, say), settings, say)


def _read(settings: CalibrateSettings, say: Say) -> Source:
    if isinstance(settings, FilesSettings):
        from deal_hw.workflows.calibration.files import read_files

        return read_files(settings, say)
    from deal_hw.workflows.calibration.dataset import read_driver_dataset, read_own_dataset

    if isinstance(settings, OwnDatasetSettings):
        return read_own_dataset(settings, say)
    if isinstance(settings, DriverDatasetSettings):
        return read_driver_dataset(settings, say)
    raise TypeError(f"settings of no kind of recordings: {type(settings).__name__}")


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Say which extra installs a package that is missing."""
    try:
        yield
    except MissingExtraError:
        raise
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), name) from err


def _input_of(source: Source, settings: CalibrateSettings, say: Say) -> CalibrationInput:
    """Align the recordings, divide them, and set what they do not show or already tell."""
    setups = given_setups(settings)
    if setups is not None:
        source = in_setups(source, setups, settings.named(), say)
    robot, space, division = source.robot, source.space, source.division
    trajectories = [one.trajectory for one in (*source.fitted, *source.held)]
    if division is not None:
        require_base(robot, source.feet, trajectories)
    known_std = expected_std(settings.residual_std, robot, trajectories[0].base)
    provenance = dict(source.provenance)
    if robot.latency_s:
        provenance["model_latency_s"] = robot.latency_s
    fit, judge = ([aligned(source, one) for one in some] for some in (source.fitted, source.held))
    if settings.named() in UNALIGNED_METHODS:
        say(
            f"{settings.named()} compares distributions of motion. In these recordings commands and states "
            "have one clock, so predictions can be compared, too, and every robot that was measured was "
            f"predicted better by that ({page('results/paper.md')}): leave --method out, unless the motion "
            "diverges from any prediction"
        )
    if isinstance(settings, UserRobotSettings):
        space = without_idle_limits(space, settings, robot, fit)
    # `--watch` has one rate, that of the robot's description.
    of_robot = [one.trajectory for one in source.fitted if one.rates in (None, source.rates)]
    shown = (of_robot or trajectories)[0]
    walks = division is None and all_walk(robot, trajectories)
    if walks:
        space = weighed(space, robot, shown, say)
    if division is not None:
        fit, judge = divided(fit, judge, division, say)
        warn_of_gravity(robot, space, fit, say)
        space = sensitive_parameters(robot, space, fit, known_std, division.window_s, settings.threads, say)
        for name, parts in (("fitted_s", fit), ("heldout_s", judge)):
            provenance[name] = round(sum(map(seconds_of, parts)), 3)
    from deal_hw.sim.parameters import with_usual_range

    # The ranges of our own robots are chosen, and a ratio is for all parameters.
    usual = isinstance(settings, UserRobotSettings) and settings.range_ratio is None
    # A policy has its own distribution of the latency.
    chosen = source.policy is not None or settings.latency is not None
    guessed_latency = () if chosen or settings.latency_range != LATENCY_RANGE_S else (LATENCY,)
    return CalibrationInput(
        robot=robot,
        space=space,
        episodes=fit,
        holdout=judge,
        shown=shown,
        telemetry=source.telemetry,
        provenance=provenance,
        advice=source.advice,
        balance=source.balance,
        name=source.name,
        walks=walks,
        policy=source.policy,
        known_std=known_std,
        guessed=(*(with_usual_range(space) if usual else ()), *guessed_latency),
    )


def aligned(source: Source, one: Named) -> SampledEpisode:
    """Return a recording on its physics grid; a floating robot's one includes the base."""
    from deal_hw.sim.mjcf.describe import at_rates
    from deal_hw.sim.recordings.episode import align, fill_gaps, thin

    robot, trajectory, description = source.robot, one.trajectory, source.robot.description
    if one.rates is not None:
        description = at_rates(description, one.rates)
    episode = align(trajectory, description, one.name)
    if robot.base is not None and trajectory.base is not None:
        from deal_hw.sim.recordings.measured_base import with_measured_base

        episode = with_measured_base(episode, robot, trajectory)
    elif robot.base is not None and trajectory.body is not None:
        from deal_hw.sim.recordings.standing import with_sensed_base

        episode = with_sensed_base(episode, robot, trajectory, source.feet)
        if source.division is None:
            episode = while_walking(episode, trajectory)
    if source.division is not None:
        episode = fill_gaps(episode)
    if source.setups is not None:
        episode = source.setups.with_gains(episode, robot)
    return episode if source.sample_hz is None else thin(episode, source.sample_hz)


def all_walk(robot: RobotModel, recordings: Iterable[Trajectory]) -> bool:
    """Return whether all recordings are of a policy that walks."""
    if robot.base is None:
        return False
    from deal_hw.motions.scores.velocity_error import wanted_velocity

    return all(wanted_velocity(r) is not None for r in recordings)


def while_walking(episode: SampledEpisode, trajectory: Trajectory) -> SampledEpisode:
    """Return the episode; of a walk, without standing up and lying down."""
    from deal_hw.motions.scores.velocity_error import wanted_velocity

    wanted = wanted_velocity(trajectory)
    if wanted is None:
        return episode
    rows = slice(episode.first_row, episode.first_row + len(episode.sample))
    host_s = trajectory.device_s[rows] + np.median(trajectory.receive_s - trajectory.device_s)
    walks = (host_s >= wanted.time_s[0]) & (host_s <= wanted.end_s)
    return dataclasses.replace(episode, usable=episode.usable & walks)


def weighed(space: ParameterSpace, robot: RobotModel, trajectory: Trajectory, say: Say) -> ParameterSpace:
    """Return the space with the trunk's mass, if it is searched, as weighed by the motors' efforts.

    No motion on feet can separate masses from gains, since all forces scale together. The motors' efforts
    can, in the last moments before the robot walks.
    """
    from deal_hw.motions.scores.velocity_error import wanted_velocity
    from deal_hw.sim.legged.weighing import standing_mass

    trunk, wanted, body = robot.description.floating_base, wanted_velocity(trajectory), trajectory.body
    names = [p.name for p in space if p.kind == "body_mass" and p.elements == (trunk,)]
    if not names or wanted is None or body is None:
        return space
    since_s = trajectory.receive_s - wanted.time_s[0]
    rows = (since_s > -WEIGHING_S) & (since_s < 0) & np.isfinite(trajectory.effort).all(axis=1)
    if not rows.any() or not trajectory.effort[rows].any():
        return space
    whole = standing_mass(robot, body.orientation[rows], trajectory.position[rows], trajectory.effort[rows])
    mass = whole - float(robot.model.body_mass.sum() - robot.model.body(trunk).mass[0])
    say(
        f"{names[0]}: {mass:.2f} kg, weighed by the motors' efforts while the robot stands (whole robot "
        f"{whole:.2f} kg); it is not fitted; to set another mass: --known {names[0]} KG"
    )
    return space.with_known({names[0]: mass})


def divided(
    episodes: Sequence[SampledEpisode], judge: Sequence[SampledEpisode], division: Division, say: Say
) -> tuple[list[SampledEpisode], list[SampledEpisode]]:
    """Return the parts to fit and the held-out parts.

    Args:
        episodes: Recordings to fit.
        judge: Held-out recordings.
        division: How parts are chosen.
        say: Called with a sentence if not all is fitted.
    """
    from deal_hw.sim.recordings.parts import spread, stretches

    fit, held = list(episodes), list(judge)
    if division.share > 0:
        fit, held = held_out(episodes, division.share, say)
    parts = [p for e in fit for p in stretches(e, max(STRETCH_S, 3 * division.window_s))]
    chosen = spread(parts, division.fit_seconds)
    if len(chosen) < len(parts):
        say(
            f"fitting {sum(map(seconds_of, chosen)):.0f} s of {sum(map(seconds_of, parts)):.0f} s, in "
            f"{len(chosen)} evenly spread parts (--fit-seconds)"
        )
    held = [p for e in held for p in stretches(e, HELDOUT_STRETCH_S)]
    return _without_scraps(chosen, say), _without_scraps(held, say)


def held_out(
    episodes: Sequence[SampledEpisode], share: float, say: Say
) -> tuple[list[SampledEpisode], list[SampledEpisode]]:
    """Return what is fitted of recordings, and the share of them that is held out.

    It is the last part of each recording. The last part of a short one would hold hardly a prediction, so of
    many short ones every few are held out as a whole.

    Args:
        episodes: The recordings, or the parts between their pauses.
        share: The share that is held out.
        say: Called with a sentence on short ones.
    """
    from deal_hw.sim.recordings.parts import split_last

    every = max(round(1 / share), 2)
    fit: list[SampledEpisode] = []
    held: list[SampledEpisode] = []
    short = [e for e in episodes if seconds_of(e) < SHORT_S]
    whole = short[every - 1 :: every]
    for episode in episodes:
        if any(episode is one for one in whole):
            held.append(episode)
        elif seconds_of(episode) * share < HELDOUT_LEAST_S or (whole and seconds_of(episode) < SHORT_S):
            fit.append(episode)
        else:
            first, last = split_last(episode, share)
            fit.append(first)
            held.append(last)
    if whole:
        say(
            f"{len(short)} recordings or parts are shorter than {SHORT_S:g} s: {len(whole)} of them are held "
            "out as a whole, the others are fitted"
        )
    if not held:
        say(
            f"no recording is long enough to hold a part out ({share:.0%} of it must last "
            f"{HELDOUT_LEAST_S:g} s), so all is fitted, and no held-out error is known"
        )
    return fit, held


def _without_scraps(episodes: Sequence[SampledEpisode], say: Say) -> list[SampledEpisode]:
    """Return recordings without those too short to be smoothed, as a few samples between two gaps are.

    If all are, all stay: whoever uses them says how long a recording must be.
    """
    from deal_hw.calib.data.noise import smoothed_samples

    kept = [e for e in episodes if len(e.sample) > 1 and len(e.sample) >= smoothed_samples(e.period_s)]
    short = len(episodes) - len(kept)
    if not kept or not short:
        return list(episodes)
    samples = sum(len(e.sample) for e in episodes) - sum(len(e.sample) for e in kept)
    say(f"left out: {short} parts between gaps, of {samples} samples in all, which are too short to be used")
    return kept


def seconds_of(episode: SampledEpisode) -> float:
    """Return the length of an episode [s]."""
    return (len(episode.sample) - 1) * episode.period_s


def usual_method(settings: CalibrateSettings, work: CalibrationInput, say: Say = silent) -> str:
    """Return the named method, or the one that suits the recordings."""
    if settings.method:
        return settings.named()
    facts = work.robot.description
    own = isinstance(settings, UserRobotSettings)
    held = set(facts.actuated) == set(facts.joint_names) and all(kp > 0 for kp in facts.stiffness)
    if settings.residual_std not in ((), None) or not settings.refine:
        method = "default"
    elif work.walks and settings.search is None:
        say(WALK_TELLS)
        method = "gait"
    else:
        # Output-error compares predictions over seconds, which are useless for a robot that falls.
        method = "output-error" if own and work.robot.base is None and held else "default"
    if method != "default":
        say(f"method: {method} (alternative: --method default, which refines to the sensor noise)")
    return settings.named(method)


def expected_std(
    given: float | Mapping[str, float] | tuple[str, ...] | None,
    robot: RobotModel,
    base: BaseTrajectory | None = None,
) -> FloatArray | None:
    """Return the expected prediction error (std), positions then velocities, (2 C,), or None.

    Args:
        given: One number for all joints of a fixed robot, or one for each name [rad or m]; from the command
            line as words; None or no words: none is expected.
        robot: The robot.
        base: Recorded place of its base; None: none.

    Raises:
        ConfigurationError: A number is missing, or is not above 0.
        UnknownNameError: A joint is not known.
    """
    if given is None or given == ():
        return None
    if isinstance(given, tuple) and len(given) == 1:
        given = _number(given[0])
    elif isinstance(given, tuple):
        # A last word without a number is a joint without a value.
        found = [*map(_number, given[1::2]), *([math.nan] * (len(given) % 2))]
        given = dict(zip(given[::2], found, strict=True))
    names = robot.description.joint_names + (("orientation", "gyro") if robot.base is not None else ())
    moves = base is not None and bool(np.isfinite(base.velocity).all())
    names += (("base_position",) if base is not None else ()) + (("base_velocity",) if moves else ())
    one = not isinstance(given, Mapping)
    values = dict.fromkeys(names, given) if isinstance(given, float | int) else dict(given)
    for name in values:
        if name not in names:
            raise UnknownNameError("joint", name, names)
    if (
        set(values) != set(names)
        or any(math.isnan(v) for v in values.values())
        or (one and robot.base is not None)
    ):
        whole = "" if robot.base is not None else "one number, or "
        raise ConfigurationError(
            f"--residual-std: give {whole}a name and a number above 0 for each of {', '.join(names)}"
        )
    for value in values.values():
        Range(1e-9, 1e3, "rad or m").check("--residual-std", float(value))
    C = len(robot.coordinates)
    std = np.ones(2 * C)
    std[:C][robot.joints] = [values[name] for name in robot.description.joint_names]
    if robot.base is not None:
        std[:C][robot.rotation], std[C:][robot.rotation] = values["orientation"], values["gyro"]
        std[:3], std[C : C + 3] = values.get("base_position", 1.0), values.get("base_velocity", 1.0)
    return std


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError as err:
        raise ConfigurationError(f"--residual-std: {word!r} is no number [rad or m]") from err
