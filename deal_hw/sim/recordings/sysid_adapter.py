"""DeepMind's ``mujoco.sysid`` on our models and recordings: the only module that imports it.

Its inputs: parameters in physical units with their ranges as bounds, joint positions as measured signals,
set-points as controls, and each window of a recording as one of its sequences, with a given start state.
Finite differences, optimiser and confidence intervals are its own.

It has no limit on a set-point's speed. Its delays are those of sensors, which windows from measured states
cannot use: a late sensor would show values from before the start. So a latency is given by delayed controls,
or is one more parameter of its least squares. Then, and with speed limits, its rollout hook gives each
candidate its own controls, linear between commands. Its residual hook is needed for two properties of MuJoCo
3.17. A rollout returns sensors from before the step whose time they carry, so positions come from the state.
And the residual is normalised window by window, which divides by zero if a joint rests at zero, so it is
normalised over the whole recording.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch, default_threads
from deal_hw.sim.engine.model import RobotModel, drop_command_laws, model_with
from deal_hw.sim.parameters import KINDS
from deal_hw.sim.parameters.fields import BatchFields
from deal_hw.sim.parameters.one_drive import gather
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.windows import Windows, setpoints
from deal_hw.types import FloatArray

SPEED_LIMIT = "servo_speed_limit"
SENT_FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")


@dataclass(frozen=True, slots=True)
class SysidRecording:
    """Windows of one episode, with their start states.

    Attributes:
        episode: The episode.
        windows: W windows.
        position: Tangent coordinates at the starts, (W, C).
        velocity: (W, C).
    """

    episode: SampledEpisode
    windows: Windows
    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class Identified:
    """Result of ``mujoco.sysid``.

    Attributes:
        theta: Physical values, (K,).
        latency_s: The latency, given or found [s].
        half_width: Of its confidence intervals, (K,); infinite without information in its Jacobian.
        jacobian: Of its residual by the physical values, (R, K), without the part that a found latency
            explains.
        residual: Its normalised residual, (R,).
        iterations: Iterations of its optimiser.
        message: Why that stopped, in its own words.
        steps: Physics steps simulated.
    """

    theta: FloatArray
    latency_s: float
    half_width: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    iterations: int
    message: str
    steps: int


def require_sysid() -> Any:
    """Return the ``mujoco.sysid`` package.

    Raises:
        MissingExtraError: Its dependencies are not installed.
    """
    try:
        # By name, or type checkers mistake the typed subpackage for the whole of mujoco.
        sysid = importlib.import_module("mujoco.sysid")
    except ImportError as err:
        raise MissingExtraError("mujoco[sysid]", "bench") from err
    # Without its dependencies the package imports, but is empty.
    if not hasattr(sysid, "optimize"):
        raise MissingExtraError("mujoco[sysid]", "bench")
    return sysid


def check_space(space: ParameterSpace) -> None:
    """Check that ``mujoco.sysid`` can express every parameter.

    Raises:
        ConfigurationError: It cannot.
    """
    foreign = [p for p in space.parameters if p.kind not in KINDS and p.kind != SPEED_LIMIT]
    if foreign:
        named = ", ".join(f"{p.name} ({p.kind})" for p in foreign)
        raise ConfigurationError(
            f"mujoco.sysid has no counterpart for {named}; it takes {', '.join((*KINDS, SPEED_LIMIT))}: "
            "leave the others out of the space or choose another method"
        )


def identify(
    robot: RobotModel,
    space: ParameterSpace,
    recordings: Sequence[SysidRecording],
    *,
    latency_s: float = 0.0,
    latency_range_s: tuple[float, float] | None = None,
    iterations: int = 50,
    alpha: float = 0.1,
    threads: int | None = None,
) -> Identified:
    """Run ``mujoco.sysid`` from the nominal values.

    Args:
        robot: The nominal model.
        space: The parameters.
        recordings: The recordings.
        latency_s: Latency of the set-points, or the start of its search [s].
        latency_range_s: Range of the latency's search [s]; None for no search.
        iterations: Most iterations of its optimiser.
        alpha: The level of its intervals is 1 - alpha.
        threads: Threads of its rollouts; None for all CPUs.

    Raises:
        ConfigurationError: A parameter has no counterpart.
        MissingExtraError: ``mujoco.sysid`` is not installed.
    """
    sysid = require_sysid()
    check_space(space)
    bridge = _Bridge(sysid, robot, space, recordings, latency_s, latency_range_s)
    own_controls = bridge.slewed or latency_range_s is not None
    hooks: dict[str, Any] = {"custom_rollout": bridge.rollout} if own_controls else {}
    residual = sysid.build_residual_fn(
        models_sequences=bridge.sequences(),
        build_model=bridge.build_model,
        modify_residual=bridge.residual,
        n_threads=threads or default_threads(),
        resample_true=False,
        **hooks,
    )
    output = io.StringIO()
    found, result = sysid.optimize(
        bridge.parameters().move_off_bounds(),
        residual,
        optimizer="mujoco",
        verbose=False,
        max_iters=max(iterations, 1),
        # Its guide advises this if parameters differ by orders of magnitude.
        x_scale="jac",
        output=output,
    )
    vector = np.asarray(found.as_vector(), dtype=float)
    left = residual(vector, found)[0]
    jacobian = np.asarray(result.jac, dtype=float)
    with np.errstate(all="ignore"):
        half_width = sysid.calculate_intervals(left, jacobian, alpha=alpha)[1]
    reasons = [line for line in output.getvalue().splitlines() if line.startswith("Terminated")]
    return Identified(
        theta=np.clip(vector[: len(space)], space.low, space.high),
        latency_s=bridge.latency(vector),
        half_width=np.nan_to_num(
            np.asarray(half_width, dtype=float)[: len(space)], nan=np.inf, posinf=np.inf
        ),
        jacobian=_without(jacobian[:, : len(space)], jacobian[:, len(space) :]),
        residual=np.concatenate(left),
        iterations=len(result.extras["objective"]) - 1,
        message=reasons[-1] if reasons else "no message",
        steps=bridge.steps,
    )


def _without(jacobian: FloatArray, nuisance: FloatArray) -> FloatArray:
    """Return derivatives, (R, K), without the part that those by other parameters, (R, n), explain."""
    if not np.any(nuisance):
        return jacobian
    return np.asarray(jacobian - nuisance @ np.linalg.lstsq(nuisance, jacobian, rcond=None)[0])


@dataclass(slots=True)
class _Bridge:
    """Translates our model, space and recordings to those of ``mujoco.sysid``; see :func:`identify`."""

    sysid: Any
    robot: RobotModel
    space: ParameterSpace
    recordings: Sequence[SysidRecording]
    latency_s: float
    latency_range_s: tuple[float, float] | None
    steps: int = field(init=False, default=0)
    slewed: bool = field(init=False)
    _spec: mujoco.MjSpec = field(init=False)
    _nominal: mujoco.MjModel = field(init=False)
    _batch: ServoBatch = field(init=False)
    _scale: FloatArray = field(init=False)
    _every: list[int] = field(init=False)
    _origin: dict[int, tuple[int, int]] = field(init=False, default_factory=dict)
    _sent: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = field(init=False, default_factory=dict)
    _models: dict[tuple[bytes, int], mujoco.MjModel] = field(init=False, default_factory=dict)
    _paths: dict[tuple[int, bytes, float], FloatArray] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.slewed = any(p.kind == SPEED_LIMIT for p in self.space.free)
        self._spec = self._with_sensors()
        self._nominal = self._spec.compile()
        gather(self._nominal)
        self._batch = ServoBatch(self.robot, self.space, 1, threads=1)
        measured = np.concatenate([self._measured(r).reshape(-1, len(self._joints)) for r in self.recordings])
        size = np.sqrt(np.nanmean(measured**2, axis=0))
        self._scale = np.where(size > 0, size, 1.0)

    @property
    def _joints(self) -> tuple[str, ...]:
        return self.robot.description.joint_names

    def _with_sensors(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(self.robot.description.mjcf))
        spec.option.timestep = self.robot.step_s
        for sensor in spec.sensors:
            spec.delete(sensor)
        for joint in self._joints:
            spec.add_sensor(
                name=f"{joint}.position",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=joint,
            )
        return spec

    def _measured(self, recording: SysidRecording) -> FloatArray:
        """Return each window's joint positions, start included, (W, 1 + H, J); NaN where not reported."""
        episode, start = recording.episode, recording.windows.start
        rows = start[:, None] + np.arange(recording.windows.length + 1)
        values = episode.position[:, self.robot.joints]
        if episode.reported is not None:
            values = np.where(episode.reported[:, None], values, np.nan)
        return np.asarray(values[rows])

    def parameters(self) -> Any:
        """Return the free parameters in physical units, at their nominal values."""
        made = self.sysid.ParameterDict()
        for p in self.space.free:
            made.add(self.sysid.Parameter(p.name, p.nominal, p.low, p.high))
        if self.latency_range_s is not None:
            made.add(self.sysid.Parameter("latency", self.latency_s, *self.latency_range_s))
        return made

    def _values(self, parameters: Any) -> FloatArray:
        return np.asarray(parameters.as_vector(), dtype=float)[: len(self.space)]

    def latency(self, vector: FloatArray) -> float:
        """Return the latency in a vector, (K,) or (K + 1,), or the given one [s]."""
        return float(vector[-1]) if self.latency_range_s is not None else self.latency_s

    def sequences(self) -> list[Any]:
        """Return the windows as sequences, grouped by sent gains and limits."""
        groups: dict[tuple[bytes, ...], list[tuple[int, int]]] = {}
        for r, recording in enumerate(self.recordings):
            for w in range(len(recording.windows)):
                sent = self._sent_at(r, w)
                groups.setdefault(tuple(values.tobytes() for values in sent), []).append((r, w))
        return [self._group(i, members) for i, members in enumerate(groups.values())]

    def _sent_at(self, r: int, w: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        episode = self.recordings[r].episode
        at = int(episode.sample[self.recordings[r].windows.start[w]])
        return episode.stiffness[at], episode.damping[at], episode.effort_limit[at]

    def _group(self, index: int, members: list[tuple[int, int]]) -> Any:
        spec = self._spec.copy()
        self._sent[id(spec)] = self._sent_at(*members[0])
        names = [f"recording {r} window {w}" for r, w in members]
        states = [self._initial_state(r, w) for r, w in members]
        controls = [self._control(r, w) for r, w in members]
        measured = [self._sensors(r, w) for r, w in members]
        return self.sysid.ModelSequences(f"sent {index}", spec, names, states, controls, measured)

    def _initial_state(self, r: int, w: int) -> FloatArray:
        recording, batch = self.recordings[r], self._batch
        reference = recording.episode.reference
        start = recording.windows.start[w]
        batch.set_state(
            recording.position[w],
            recording.velocity[w],
            reference=None if reference is None else reference[start],
        )
        qpos, qvel = batch.batch.bind("qpos")[0], batch.batch.bind("qvel")[0]
        return np.asarray(self.sysid.create_initial_state(self._nominal, qpos.copy(), qvel.copy()))

    def _times(self, r: int) -> tuple[int, int]:
        """Return physics steps from sample to sample, and of a whole window."""
        episode, windows = self.recordings[r].episode, self.recordings[r].windows
        every = windows.stride * round(episode.step_s / self.robot.step_s)
        return every, every * windows.length

    def _control(self, r: int, w: int) -> Any:
        _, steps = self._times(r)
        times = np.arange(steps + 1) * self.robot.step_s
        made = self.sysid.TimeSeries.from_control_names(
            times, self._cut(self._path(r, self.space.nominal, self.latency_s), r, w), self._nominal
        )
        self._origin[id(made)] = r, w
        return made

    def _sensors(self, r: int, w: int) -> Any:
        every, steps = self._times(r)
        times = np.arange(0, steps + 1, every) * self.robot.step_s
        return self.sysid.TimeSeries.from_names(times, self._measured(self.recordings[r])[w], self._nominal)

    def _path(self, r: int, theta: FloatArray, latency_s: float) -> FloatArray:
        """Return the set-points of an episode, (S, A), cached by latency and speed limits."""
        limits = np.array([theta[k] for k, p in enumerate(self.space.free) if p.kind == SPEED_LIMIT])
        key = r, limits.tobytes(), latency_s
        if key not in self._paths:
            if len(self._paths) > 4 * (len(self.space) + 1) * len(self.recordings):
                self._paths.clear()
            self._batch.set_parameters(theta[None])
            self._paths[key] = setpoints(self._batch, self.recordings[r].episode, np.array([latency_s]))[0]
        return self._paths[key]

    def _cut(self, path: FloatArray, r: int, w: int) -> FloatArray:
        """Return the controls of one window, one per physics step and one that is never applied."""
        episode, windows = self.recordings[r].episode, self.recordings[r].windows
        at = int(episode.sample[windows.start[w]])
        repeat = round(episode.step_s / self.robot.step_s)
        held = np.repeat(path[at : at + windows.length * windows.stride], repeat, axis=0)
        control = np.zeros((len(held) + 1, self.robot.model.nu))
        control[:-1, list(self.robot.actuator)] = held / self.robot.command_scale
        control[-1] = control[-2]
        return control

    def build_model(self, parameters: Any, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Return the model with parameters and sent gains set: the hook instead of recompiling a spec."""
        theta = self._values(parameters)
        key = theta.tobytes(), id(spec)
        if key not in self._models:
            # One iteration needs the same few models window after window.
            if len(self._models) > 4 * (len(self.space) + 1) * len(self._sent):
                self._models.clear()
            model = model_with(dataclasses.replace(self.robot, model=self._nominal), self.space, theta)
            drop_command_laws(model)
            if self.robot.description.actuation == "position":
                self._batch.set_parameters(theta[None])
                self._batch.set_sent(*self._sent[id(spec)])
                fields = BatchFields(self._batch.batch, self.robot.model)
                for name in SENT_FIELDS:
                    getattr(model, name)[:] = fields.get(name)[0]
            self._models[key] = model
        return self._models[key]

    def rollout(self, *, control_signal: Sequence[Any], param_dicts: Sequence[Any], **given: Any) -> Any:
        """Roll out with set-points at each candidate's own latency and speed limit: the hook."""
        slewed = []
        for signal, parameters in zip(control_signal, param_dicts, strict=True):
            r, w = self._origin[id(signal)]
            vector = np.asarray(parameters.as_vector(), dtype=float)
            data = self._cut(self._path(r, vector[: len(self.space)], self.latency(vector)), r, w)
            slewed.append(self.sysid.TimeSeries(signal.times, data, signal.signal_mapping))
        return self.sysid.sysid_rollout(control_signal=slewed, **given)

    def residual(
        self,
        parameters: Any,
        predicted: Any,
        measured: Any,
        model: Any,
        return_all: bool,
        *,
        state: FloatArray,
    ) -> tuple[FloatArray, Any, Any]:
        """Return measured minus predicted joint positions, normalised: the hook.

        Args:
            parameters: Not used.
            predicted: Sensors of each physics step.
            measured: Samples of the window, its start included.
            model: Not used.
            return_all: Not used.
            state: Time, positions, velocities after each physics step.
        """
        self.steps += len(predicted.times)
        every = len(predicted.times) // (len(measured.times) - 1)
        # A state begins with the time.
        ahead = state[every - 1 :: every, [1 + q for q in self.robot.qpos]]
        return np.nan_to_num((measured.data[1:] - ahead) / self._scale), predicted, measured
