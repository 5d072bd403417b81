"""What simulates the members of a search: one interface, and the engine on mujoco.batch.

Searches ask little of a simulator: N members with parameters of their own start from given states, follow
given controls, and are read at sample times. :class:`Engine` says that. `MujocoEngine` does it in float64 on
this machine's CPUs, `deal_hw.sim.engine.warp_engine` in float32 on a GPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from deal_hw.errors import CalibrationError, short
from deal_hw.sim.engine.step_laws import StepLaws, rollout
from deal_hw.sim.parameters.fields import BatchFields, Fields
from deal_hw.types import FloatArray

Mask = npt.NDArray[np.bool_]

State = tuple[FloatArray, FloatArray]
"""Start states of N members in G windows: qpos, (N, G, nq), and qvel, (N, G, nv)."""


class Engine(Protocol):
    """N members of one model, with parameters, states and rollouts.

    Parameters and states are live arrays in float64 on this machine, whatever device simulates.
    """

    @property
    def batch(self) -> Any:
        """The ``mujoco.batch.Batch`` of parameters and states, for those who read more of it."""
        ...

    @property
    def fields(self) -> Fields:
        """The members' model fields; :meth:`set_const` follows a write."""
        ...

    @property
    def windows(self) -> int:
        """How many windows of all members are best simulated at once."""
        ...

    def bind(self, name: str) -> FloatArray:
        """Return the live values of an MjData field, (N, ...)."""
        ...

    def set_const(self, ids: npt.NDArray[np.intp] | None = None) -> None:
        """Derive constants from the members' fields; of all members by default."""
        ...

    def rollout(
        self,
        control: FloatArray,
        spec: int,
        recorded: Mapping[str, int],
        laws: StepLaws | None = None,
        start: State | None = None,
    ) -> tuple[Mapping[str, FloatArray], Mask]:
        """Simulate G windows of S steps with all members.

        Args:
            control: What acts at each step, (N, G, S, size of ``spec``).
            spec: The components of the state that it sets, bits of mjtState.
            recorded: Fields of MjData to return, and the steps from one record to the next.
            laws: Laws that act between the steps, if any.
            start: The start states; None to go on from the members' states, with G = 1.

        Returns:
            The fields after steps every, 2 every, ..., (N, G, S // every, ...) each, and which members
            diverged in which windows, (N, G).

        Raises:
            CalibrationError: The model cannot be simulated.
        """
        ...


class MujocoEngine:
    """The engine on a ``mujoco.batch.Batch``.

    Args:
        model: The model that is simulated.
        nominal: The model of names and nominal values.
        count: Members N.
        threads: Threads.
    """

    windows = 1

    def __init__(self, model: mujoco.MjModel, nominal: mujoco.MjModel, count: int, threads: int) -> None:
        self.batch = Batch(model, nsim=count, nthread=threads)
        self.fields: Fields = BatchFields(self.batch, nominal)

    def bind(self, name: str) -> FloatArray:
        """Return the live values of an MjData field, (N, ...); what is no state is copied after each call."""
        values: FloatArray = self.batch.bind(name)
        return values

    def set_const(self, ids: npt.NDArray[np.intp] | None = None) -> None:
        """Derive constants by mj_setConst."""
        self.batch.set_const(ids=ids)

    def rollout(
        self,
        control: FloatArray,
        spec: int,
        recorded: Mapping[str, int],
        laws: StepLaws | None = None,
        start: State | None = None,
    ) -> tuple[Mapping[str, FloatArray], Mask]:
        """Simulate the windows one after the other; a member diverged where MuJoCo warned."""
        if start is None:
            record, bad = self._roll(control[:, 0], spec, recorded, laws)
            return {name: values[:, None] for name, values in record.items()}, bad[:, None]
        qpos, qvel, warm = self.bind("qpos"), self.bind("qvel"), self.bind("qacc_warmstart")
        found = []
        for g in range(control.shape[1]):
            qpos[:], qvel[:], warm[:] = start[0][:, g], start[1][:, g], 0.0
            if laws is not None:
                laws.restart()
            found.append(self._roll(control[:, g], spec, recorded, laws))
        records = {name: np.stack([record[name] for record, _ in found], axis=1) for name in recorded}
        return records, np.stack([bad for _, bad in found], axis=1)

    def _roll(
        self, control: FloatArray, spec: int, recorded: Mapping[str, int], laws: StepLaws | None
    ) -> tuple[dict[str, FloatArray], Mask]:
        before = self._warnings()
        try:
            if laws is None:
                # Stepping by rollout with a record of one field costs no more than bare stepping.
                record = self.batch.rollout(
                    control.shape[1], control=control, control_spec=spec, record=tuple(recorded)
                )
                record = {name: record[name][:, every - 1 :: every] for name, every in recorded.items()}
            else:
                record = rollout(self.batch, laws, control, spec, recorded)
        except mujoco.FatalError as err:
            raise CalibrationError(f"the model cannot be simulated: {short(str(err))}") from err
        return record, self._warnings() > before

    def _warnings(self) -> npt.NDArray[np.int64]:
        # Counters of (bad qpos, bad qvel, bad qacc, bad ctrl): an increase is a divergence, after which
        # MuJoCo resets the state.
        return np.asarray(self.batch.warning[..., 1].sum(axis=-1), dtype=np.int64)
