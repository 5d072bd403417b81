"""The engine on MuJoCo Warp: members and windows are worlds, which a GPU simulates at once in float32.

Parameters, the constants derived from them and states are those of a `MujocoEngine`: its float64 arrays are
copied to the device before a rollout. A rollout copies controls there once, and records back once. On a GPU a
step, with the laws around it, is one captured graph, which shorter rollouts take, too. World ``g N + n`` is
member n of N in window g, so model fields have N rows: MuJoCo Warp takes the row ``world % N``. Fields that
laws write have one row a world.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.errors import CalibrationError, ConfigurationError, short
from deal_hw.sim.engine.engines import Mask, MujocoEngine, State
from deal_hw.sim.engine.step_laws import LEAST_FRICTION, StepLaws
from deal_hw.sim.engine.warp_support import check_gpu, check_installed, check_model
from deal_hw.sim.laws.servo import MARGIN
from deal_hw.sim.parameters.fields import Array, Fields
from deal_hw.types import FloatArray

DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "geom_rbound",
    "geom_aabb",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_acc0",
)
"""Fields that mj_setConst derives, and a step of MuJoCo Warp reads."""

STATES = ("qpos", "qvel", "qacc_warmstart", "act")
"""Fields of MjData that a rollout goes on from."""

INPUTS = frozenset({*STATES, "ctrl", "qfrc_applied", "xfrc_applied"})
"""Fields of MjData that are set before a step."""

UNREAD = frozenset({"body_sameframe", "bvh_aabb"})
"""Fields that speed up MuJoCo's kinematics and collisions, and MuJoCo Warp has not."""

MOST_WORLDS = 16384
"""Most worlds at once. A choice: no rows of a GPU are kept (docs/how-to/gpu.md)."""

MEMORY_SHARE = 0.7
"""Share of the device's free memory that worlds take at most."""

DIVERGED = mujoco.mjMAXVAL
"""Largest position or velocity that MuJoCo takes for sound."""

MOST_GROWTH = 6
"""How often the room for contacts and constraints is doubled before a model counts as not simulable."""


class WarpEngine:
    """The engine on MuJoCo Warp.

    Args:
        model: The model that is simulated.
        nominal: The model of names and nominal values.
        count: Members N.
        threads: Threads that derive constants.
        device: "cuda", or "cpu" for a processor: far slower than MuJoCo, for tests.

    Raises:
        ConfigurationError: The model has what MuJoCo Warp lacks, there is no GPU, or members are too many.
        MissingExtraError: MuJoCo Warp is not installed.
    """

    def __init__(
        self, model: mujoco.MjModel, nominal: mujoco.MjModel, count: int, threads: int, device: str = "cuda"
    ) -> None:
        check_model(model)
        check_installed()
        if device == "cuda":
            check_gpu()
        self._device = _device(device)
        self._members = MujocoEngine(model, nominal, count, threads)
        self.batch = self._members.batch
        self._outputs: dict[str, FloatArray] = {}
        # Sensors are not read; their kernels would take a third of the time to compile. MuJoCo Warp has no
        # mid-phase to be disabled.
        self._model = copy.copy(model)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        self._count = count
        self._worlds: _Worlds | None = None
        self._growth = 1
        self._told = False
        self.fields = _SeenFields(self._members.fields)
        self._fitting = self._measure()
        self.windows = max(min(MOST_WORLDS, self._fitting) // count, 1)
        if count > self._fitting:
            raise ConfigurationError(
                f"{count} members do not fit into the free memory of {self._device}: of this model at most "
                f"{self._fitting} worlds do; give --population or --members {self._fitting}, or use --engine "
                "mujoco"
            )

    def bind(self, name: str) -> FloatArray:
        """Return the live values of an MjData field; what is no state is copied after rollouts that go on."""
        if name in INPUTS:
            return self._members.bind(name)
        if name not in self._outputs:
            self._outputs[name] = self._members.bind(name).copy()
        return self._outputs[name]

    def set_const(self, ids: npt.NDArray[np.intp] | None = None) -> None:
        """Derive constants by MuJoCo, on this machine."""
        self._members.set_const(ids)
        self.fields.changed.update(DERIVED)

    def rollout(
        self,
        control: FloatArray,
        spec: int,
        recorded: Mapping[str, int],
        laws: StepLaws | None = None,
        start: State | None = None,
    ) -> tuple[Mapping[str, FloatArray], Mask]:
        """Simulate all windows at once; a member diverged where its states are no numbers, or too large.

        Where contacts or constraints do not fit into the room for them, it is repeated with more.
        """
        goes_on = start is None
        if start is None:
            start = self.bind("qpos")[:, None], self.bind("qvel")[:, None]
        count, windows = control.shape[:2]
        for _ in range(MOST_GROWTH):
            worlds = self._room(count * windows)
            worlds.put_fields(self.fields, laws)
            self.fields.changed.clear()
            worlds.begin(start, self.bind("qacc_warmstart") if goes_on else None, self.bind("act"))
            records = worlds.run(control, spec, recorded, laws)
            if not worlds.overflow():
                break
            self._growth *= 2
            self._worlds = None
        else:
            raise CalibrationError(
                "the model cannot be simulated: its contacts and constraints do not fit into MuJoCo Warp's "
                "memory; use --engine mujoco"
            )
        bad = np.zeros(windows * count, dtype=bool)
        for name in {"qpos", "qvel"} & records.keys():
            # The largest is NaN where any is.
            bad |= ~(np.abs(records[name]).max(axis=(0, 2), initial=0.0) <= DIVERGED)
        bad = bad.reshape(windows, count).T
        shaped = {
            name: np.moveaxis(values.reshape(len(values), windows, count, -1), 2, 0).swapaxes(1, 2)
            for name, values in records.items()
        }
        if bad.any() and not self._told:
            self._told = True
            logging.getLogger(__name__).warning(
                "%d of %d worlds diverged: their states are no numbers, or beyond %.0e. These members count "
                "as failed, and the others go on (this is said once). If many fail, narrow the ranges or "
                "take a smaller physics step; --engine mujoco computes in float64",
                *(np.count_nonzero(bad), bad.size, DIVERGED),
            )
        if goes_on:
            self._keep(worlds, bad[:, 0])
        return shaped, bad

    def _keep(self, worlds: _Worlds, bad: Mask) -> None:
        """Copy the members' states and outputs back; diverged members begin anew, as in MuJoCo."""
        for name in STATES:
            self.bind(name)[:] = worlds.state(name)
        for name, values in self._outputs.items():
            values[:] = worlds.state(name).reshape(values.shape)
        self.bind("qpos")[bad] = self._model.qpos0
        for name in STATES[1:]:
            self.bind(name)[bad] = 0.0

    def bare(self, count: int, steps: int) -> tuple[Callable[[], None], str]:
        """Return what does bare steps in so many worlds, to measure beside rollouts, and the device."""
        import warp as wp

        worlds = self._room(count)
        return lambda: worlds.bare(steps), str(wp.get_device(self._device).name)

    def _room(self, count: int) -> _Worlds:
        if self._worlds is None or self._worlds.count != count:
            self._worlds = None  # its memory is free before the next is taken
            self._worlds = _Worlds(self._model, self._count, count, self._growth, self._device)
        return self._worlds

    def _measure(self) -> int:
        """Return how many worlds fit into the free memory."""
        import warp as wp

        few = 4
        used = _Worlds(self._model, few, few, self._growth, self._device).bytes / few
        device = wp.get_device(self._device)
        if device.is_cuda:
            free = float(device.free_memory)
        else:
            import psutil

            free = float(psutil.virtual_memory().available)
        return int(MEMORY_SHARE * free / used)


class _SeenFields:
    """The members' fields, and the names of those that were asked for: these differ between members.

    Attributes:
        seen: These names.
        changed: Names of those that may have changed since the last copy to a device.
    """

    def __init__(self, fields: Fields) -> None:
        self._fields = fields
        self.model = fields.model
        self.seen: set[str] = set()
        self.changed: set[str] = set()

    def get(self, name: str) -> Array:
        """Return a field, which the caller may write."""
        if name not in UNREAD:
            self.seen.add(name)
            self.changed.add(name)
        return self._fields.get(name)

    def read(self, name: str) -> Array:
        """Return a field without noting its name."""
        return self._fields.get(name)


class _Worlds:
    """Worlds on a device: model, state, and the buffers of rollouts.

    Args:
        model: The model.
        members: Members N.
        count: Worlds, a multiple of N.
        growth: Factor on the room for contacts and constraints.
        device: Warp's name of the device.
    """

    def __init__(self, model: mujoco.MjModel, members: int, count: int, growth: int, device: str) -> None:
        import mujoco_warp as mjw
        import warp as wp

        self._wp, self._mjw, self._device, self._members, self.count = wp, mjw, device, members, count
        try:
            with wp.ScopedDevice(device):
                self._model = mjw.put_model(model)
                self._model.opt.warn_overflow = False
                if wp.get_device().is_cuda and not wp.is_conditional_graph_supported():
                    self._model.opt.graph_conditional = False
                # Whether any tendon has them is asked of the nominal model; members may differ.
                self._model.has_tendon_stiffness = self._model.has_tendon_damping = model.ntendon > 0
                self._data = mjw.make_data(model, nworld=count, **_limits(model, growth))
        except (NotImplementedError, ValueError) as err:
            raise ConfigurationError(
                f"MuJoCo Warp cannot simulate the model: {short(str(err))}; use --engine mujoco"
            ) from err
        except (RuntimeError, MemoryError) as err:
            raise CalibrationError(
                f"{count} worlds do not fit into the memory of {device} ({short(str(err))}); give a smaller "
                "--population or --members, or use --engine mujoco"
            ) from err
        self._nu, self._nv = model.nu, model.nv
        # The step, and the steps of this rollout: on the device, so that a graph holds for any number.
        self._step = wp.zeros(2, dtype=int, device=device)
        self._control: Any = None
        self._records: dict[str, tuple[int, Any]] = {}
        self._laws: dict[str, list[Any]] = {}
        self._law_shape: dict[str, list[tuple[int, ...]]] = {}
        self._loaded = 0
        self._graph: Any = None
        self._bare: Any = None
        self._fresh = True

    @property
    def bytes(self) -> int:
        """Memory of the state [bytes]."""
        return _bytes(self._data)

    def put_fields(self, fields: Any, laws: StepLaws | None) -> None:
        """Copy the members' fields that may have changed; those that laws write get one row a world."""
        written = laws.written if laws is not None else set()
        names = fields.changed | (written & fields.seen)
        if self._fresh:
            self._fresh, names = False, fields.seen | set(DERIVED)
        for name in sorted(names):
            target = getattr(self._model, name, None)
            if target is None:
                raise ConfigurationError(
                    f"MuJoCo Warp cannot simulate parameters of {name}; use --engine mujoco"
                )
            if not target.shape[1]:
                continue
            values = fields.read(name)
            if name in written:
                values = np.tile(values, (self.count // self._members, *(1,) * (values.ndim - 1)))
            shape = (len(values), *target.shape[1:], -1)
            part = np.ascontiguousarray(values, dtype=np.float32).reshape(shape)
            if part.shape[-1] == 1:
                part = part[..., 0]
            if target.shape[0] == len(part):
                target.assign(part)
            else:
                setattr(self._model, name, self._wp.array(part, dtype=target.dtype, device=self._device))
                self._graph = None
        self._put_laws(laws)

    def _put_laws(self, laws: StepLaws | None) -> None:
        """Copy the coefficients of laws; into the same arrays where laws are of the same joints."""
        values = {} if laws is None else _law_values(laws)
        shape = {name: [part.shape for part in parts] for name, parts in values.items()}
        loaded = int(laws is not None and laws.loaded)
        if (shape, loaded) != (self._law_shape, self._loaded):
            self._laws = {
                name: [self._wp.array(part, device=self._device) for part in parts]
                for name, parts in values.items()
            }
            self._law_shape, self._loaded, self._graph = shape, loaded, None
            return
        for name, parts in values.items():
            for target, part in zip(self._laws[name], parts, strict=True):
                target.assign(part)

    def begin(self, start: State, warmstart: FloatArray | None, act: FloatArray) -> None:
        """Set the worlds' states, and clear what else a step reads from the one before.

        Args:
            start: Start states, (N, G, ...) each.
            warmstart: The solver's, (N, nv); zeros by default.
            act: Activations, (N, na).
        """
        data = self._data
        for target, values in zip((data.qpos, data.qvel), start, strict=True):
            flat = np.swapaxes(values, 0, 1).astype(np.float32)
            target.assign(np.ascontiguousarray(flat.reshape(self.count, -1)))
        # The package's reset compiles its kernels' sources anew in each call, for 15 ms.
        data.qfrc_applied.zero_()
        data.overflow.zero_()
        if warmstart is None:
            data.qacc_warmstart.zero_()
        else:
            data.qacc_warmstart.assign(np.ascontiguousarray(warmstart, dtype=np.float32))
        if act.shape[1]:
            flat = np.tile(act, (self.count // self._members, 1))
            data.act.assign(np.ascontiguousarray(flat, dtype=np.float32))

    def run(
        self, control: FloatArray, spec: int, recorded: Mapping[str, int], laws: StepLaws | None
    ) -> dict[str, FloatArray]:
        """Simulate; return the records, (S // every, worlds, F) each."""
        steps = control.shape[2]
        self._put_control(np.ascontiguousarray(control))
        self._put_records(recorded, steps)
        self._step.assign(np.array([0, steps], dtype=np.int32))
        wp = self._wp
        with wp.ScopedDevice(self._device):
            if laws is not None and laws.loaded:
                # No step came before: torques are those of this state.
                self._set_control()
                self._write_efforts()
                self._mjw.forward(self._model, self._data)
            if wp.get_device(self._device).is_cuda and steps > 1:
                self._run_graph(steps)
            else:
                for _ in range(steps):
                    self._launch()
        return {name: out[: steps // every].numpy() for name, (every, out) in self._records.items()}

    def _run_graph(self, steps: int) -> None:
        if self._graph is None:
            # The first step loads kernels, which a capture must not.
            self._launch()
            with self._wp.ScopedCapture() as capture:
                self._launch()
            self._graph = capture.graph
            steps -= 1
        for _ in range(steps):
            self._wp.capture_launch(self._graph)

    def _put_control(self, control: FloatArray) -> None:
        # In double precision: to copy twice the bytes takes less than to convert them here.
        rows = control.reshape(-1, control.shape[3])
        held = self._control
        if held is None or held.shape[1] != rows.shape[1] or held.shape[0] < len(rows):
            self._control = self._wp.array(rows, dtype=self._wp.float64, device=self._device)
            self._graph = None
        else:
            # A shorter rollout takes the first rows: its graph is that of the longest.
            held[: len(rows)].assign(rows)

    def _put_records(self, recorded: Mapping[str, int], steps: int) -> None:
        for name in [*self._records]:
            if name not in recorded:
                del self._records[name]
                self._graph = None
        for name, every in recorded.items():
            held = self._records.get(name)
            rows = steps // every
            if held is None or held[0] != every or held[1].shape[0] < rows:
                shape = (rows, self.count, getattr(self._data, name).shape[1])
                out = self._wp.zeros(shape, dtype=float, device=self._device)
                self._records[name], self._graph = (every, out), None

    def _set_control(self) -> None:
        from deal_hw.sim.engine import warp_kernels as kernels

        shape = [self._members, self.count // self._members, self._nu]
        inputs = [self._step, self._control, *shape, self._data.ctrl, self._data.qfrc_applied]
        self._wp.launch(kernels.set_control, dim=(self.count, self._control.shape[1]), inputs=inputs)

    def _write_efforts(self) -> None:
        from deal_hw.sim.engine import warp_kernels as kernels

        if parts := self._laws.get("firmware"):
            state = [self._data.ctrl, self._data.qpos, self._model.actuator_biasprm]
            inputs = [self._members, *parts, MARGIN, *state]
            self._wp.launch(kernels.servo_efforts, dim=(self.count, parts[0].shape[0]), inputs=inputs)

    def _launch(self) -> None:
        """Launch the kernels of one step, with what is around it."""
        from deal_hw.sim.engine import warp_kernels as kernels

        model, data, launch = self._model, self._data, self._wp.launch
        self._set_control()
        if parts := self._laws.get("friction"):
            state = [data.qvel, data.qfrc_actuator, data.qfrc_bias, model.dof_frictionloss]
            inputs = [self._members, *parts, self._loaded, LEAST_FRICTION, *state]
            launch(kernels.friction, dim=(self.count, parts[0].shape[0]), inputs=inputs)
        if parts := self._laws.get("limits"):
            inputs = [self._members, *parts, data.qvel, model.actuator_forcerange]
            launch(kernels.effort_limits, dim=(self.count, parts[0].shape[0]), inputs=inputs)
        self._write_efforts()
        self._mjw.step(model, data)
        for name, (every, out) in self._records.items():
            shape = out.shape[1:]
            launch(kernels.record, dim=shape, inputs=[self._step, every, getattr(data, name), out])
        launch(kernels.count, dim=1, inputs=[self._step])

    def bare(self, steps: int) -> None:
        """Do steps of the package alone, from the present states."""
        wp = self._wp
        with wp.ScopedDevice(self._device):
            if wp.get_device(self._device).is_cuda:
                if self._bare is None:
                    with wp.ScopedCapture() as capture:
                        self._mjw.step(self._model, self._data)
                    self._bare = capture.graph
                for _ in range(steps):
                    wp.capture_launch(self._bare)
            else:
                for _ in range(steps):
                    self._mjw.step(self._model, self._data)
            wp.synchronize_device(self._device)

    def overflow(self) -> bool:
        """Return whether contacts or constraints of any world were left out."""
        kinds = self._mjw.OverflowType
        # Others are limits of one collision, which more room does not lift.
        room = kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE | kinds.CCD
        return bool(np.any(self._data.overflow.numpy() & int(room)))

    def state(self, name: str) -> FloatArray:
        """Return a part of the worlds' states, (worlds, ...)."""
        return np.asarray(getattr(self._data, name).numpy(), dtype=float)


def _law_values(laws: StepLaws) -> dict[str, list[npt.NDArray[Any]]]:
    """Return what the kernels of laws take of them, by kernel."""
    found: dict[str, list[npt.NDArray[Any]]] = {}
    if (law := laws.friction) is not None:
        speed = law.coulomb, law.stribeck, law.stribeck_speed
        load = law.motor, law.external, law.motor_stribeck, law.external_stribeck
        found["friction"] = [laws.dof.astype(np.int32), np.stack([*speed, *load]).astype(np.float32)]
    if (limits := laws.limits) is not None:
        actuator, dof, *values = limits
        numbers = [np.ascontiguousarray(part, dtype=np.float32) for part in values]
        found["limits"] = [actuator.astype(np.int32), dof.astype(np.int32), *numbers]
    if (servos := laws.firmware) is not None:
        part = servos.law
        each = [servos.gear, servos.per_ctrl, servos.offset, *servos.control_range]
        every = [part.resolution, part.dead_zone, part.punch, part.scale, part.bias]
        places = [servos.actuator.astype(np.int32), servos.place.astype(np.int32)]
        found["firmware"] = [*places, *(np.stack(group).astype(np.float32) for group in (each, every))]
    return found


def _device(name: str) -> str:
    """Start Warp quietly, and return its name of a device.

    Raises:
        ConfigurationError: Warp cannot use the device.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    try:
        wp.init()
        return str(wp.get_device("cuda:0" if name == "cuda" else name).alias)
    except (RuntimeError, ValueError, OSError) as err:
        raise ConfigurationError(
            f"MuJoCo Warp cannot use the device {name} ({short(str(err))}); compare `nvidia-smi` with the "
            "CUDA that warp-lang asks for, or use --engine mujoco"
        ) from err


def _limits(model: mujoco.MjModel, growth: int) -> dict[str, int]:
    """Return the room for contacts and constraints of a world; none of its own for the package's guess."""
    if growth == 1:
        return {}
    import mujoco_warp as mjw

    guess = mjw.make_data(model, nworld=1)
    return {"nconmax": int(guess.naconmax) * growth, "njmax": int(guess.njmax) * growth}


def _bytes(part: Any) -> int:
    """Return the memory of arrays in a dataclass [bytes]."""
    total = 0
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if dataclasses.is_dataclass(value):
            total += _bytes(value)
        elif hasattr(value, "capacity"):
            total += int(value.capacity)
    return total
