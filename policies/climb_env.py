"""The Go2's climb: walk ahead onto a platform, steps or a slope; what is ahead is told, or not."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, get_args

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterDistribution
from deal_hw.policies.go2_env import Go2Env, WalkTask, walk_spec
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import Extrinsics, check_task
from deal_hw.policy import CLIMBED, OBSTACLE_AXES, ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.legged.terrain import (
    EDGE_M,
    BatchTerrain,
    Kind,
    Scuffs,
    Terrain,
    terrain_geoms,
    with_terrain,
)
from deal_hw.types import FloatArray

AHEAD_M: Final = tuple(np.linspace(-0.4, 1.0, 15).tolist())
"""Places of the critic's height samples, from the base along the world's x axis [m]."""
FOOTPRINT_M: Final = (-0.2, 0.0, 0.2)
"""Places over whose ground the base's height is taken [m]."""
KEPT_TRIES: Final = 50
LEAST_TRIES: Final = 20
MOST: Final = 0.5
"""A platform counts as climbed if this share of the last tries succeeded, up to ``KEPT_TRIES`` of them and at
least ``LEAST_TRIES``."""
TRIED_M: Final = 0.5
"""A robot tried to climb if it was requested to walk so far beyond the edge [m]."""
FELT_AHEAD_M: Final = (0.0, 0.1)
"""Places of the ground that a leg may feel, from its foot along the world's x axis [m]."""
GROUND_M: Final = 0.1
"""Usual height of a platform [m]."""
FREE_M: Final = 0.3
"""Distance from the edge within which the wanted height of a foot is another one [m]."""
PRESS_M: Final = 0.3
"""A robot may press against a front if a foot is nearer to an edge than this [m]; a shin has 0.213 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClimbTask(WalkTask):
    """Settings of the climb, those of the walk with other values.

    Attributes:
        terrains: Kinds of terrain; each robot is given one of them with equal chance.
        rise_m: Height of the platform at the lowest and the highest level.
        step_m: The same of one step.
        slope_rad: The same of the angle of a slope.
        levels: Number of levels. A robot that climbed goes up one; one that fell, or was to walk ``TRIED_M``
            beyond the edge and did not climb, goes down one; after the highest one is drawn among all.
        distance_m: Lowest and highest distance of the terrain from the start.
        flat: Share of episodes without terrain.
        blind: Share of episodes in which nothing is told of the platform.
        top_weight: Reward of feet on the platform, mean over the feet.
        torque_weight: Cost of the squared torques, summed over the joints [1/(N·m)²]. Its ratio to
            ``tracking_weight`` is that of Unitree's unitree_rl_gym (``go2_config.py``: 2e-4 to 1).
        scuff_weight: Cost of a tick in which a leg or the trunk presses against a front. For each body that
            touches others have 0.05 (ZiwenZhuang/parkour, ``go2_field_config.py``) to 1 (legged_gym).
    """

    ticks: int = 300
    terrains: tuple[Kind, ...] = ("box",)
    rise_m: tuple[float, float] = (0.04, 0.22)
    step_m: tuple[float, float] = (0.03, 0.15)
    slope_rad: tuple[float, float] = (0.05, 0.4)
    levels: int = 10
    distance_m: tuple[float, float] = (0.6, 1.2)
    flat: float = 0.1
    blind: float = 0.5
    top_weight: float = 2.0
    torque_weight: float = 3e-4
    scuff_weight: float = 0.5
    command_range: tuple[tuple[float, float], ...] = ((0.4, 0.8), (0.0, 0.0), (-0.3, 0.3))
    standing: float = 0.1
    zeroed: float = 0.0

    def __post_init__(self) -> None:
        # A class with slots has no super() without arguments.
        WalkTask.__post_init__(self)
        check_task(self, "top_weight", not_negative=("torque_weight", "scuff_weight"))
        if self.levels < 2:
            raise ConfigurationError(f"levels must be at least 2, got {self.levels}")
        for name in ("flat", "blind"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} must lie in [0, 1], got {getattr(self, name)!r}")
        if not self.terrains or len(set(self.terrains)) < len(self.terrains):
            raise ConfigurationError(f"terrains must be different kinds, at least one, got {self.terrains}")
        for name in ("rise_m", "step_m", "slope_rad", "distance_m"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ConfigurationError(f"{name} must be (low, high) with 0 < low <= high, got {low, high}")

    def ends_of(self, kind: Kind) -> tuple[float, float]:
        """Return the rise of a kind at the lowest and the highest level [m or rad]."""
        return {"box": self.rise_m, "steps": self.step_m, "slope": self.slope_rad}[kind]


class ClimbEnv(Go2Env):
    """Follow a velocity ahead onto what lies there, behind the safety filter.

    The reward of a tick is that of the walk (:class:`~deal_hw.policies.go2_env.Go2Env`), where heights are
    over the ground below. Within ``FREE_M`` before an edge a foot is to be lifted higher by its height.
    Robots that are told nothing cannot know it: no height is wanted of their feet within ``FREE_M`` of an
    edge. And::

        top_weight share of the feet that are over the terrain and not below its surface
        - torque_weight sum over joints of their squared torque
        - scuff_weight where a leg or the trunk presses against a front

    The last two are newer than the shipped policies.
    The observation is the walk's, and what the operator says of the platform: its distance, less the
    commanded way since then, and its height (of steps that of one); both are zero where nothing is told, as
    of slopes. Height samples ahead are for the critic alone.

    Args:
        description: The robot's description of its driver: with feet, and with limits for legs.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.

    Attributes:
        level: Level of each member, (N,); 0 is the lowest.
        pressing: Whether each member pressed against a front in the last tick, (N,), before any restart.

    Raises:
        ConfigurationError: The description does not name four feet.
    """

    task: ClimbTask
    task_of: ClassVar[type[ClimbTask]] = ClimbTask

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: ClimbTask | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        task = task or self.task_of()
        at = max(task.distance_m[0], 0.5)
        self._nominal = [Terrain(kind=k, rise=task.ends_of(k)[0], distance_m=at) for k in task.terrains]
        self._terrain: BatchTerrain | None = None
        self.level = np.zeros(count, dtype=np.int64)
        self.pressing: BoolArray = np.zeros(count, dtype=bool)
        self._climbed: BoolArray = np.zeros(count, dtype=bool)
        self._told: BoolArray = np.zeros(count, dtype=bool)
        self._tries = [deque[bool](maxlen=KEPT_TRIES) for _ in range(task.levels)]
        self._way = np.zeros(count)
        self._outcome = np.full(count, np.nan)
        super().__init__(description, distribution, count, task=task, threads=threads, engine=engine)
        self._terrain = BatchTerrain(self.loop.batch, task.terrains)
        self._scuffs = Scuffs(self.loop.batch)
        self._torque = self.loop.batch.engine.bind("actuator_force")

    @staticmethod
    def spec_of(description: RobotDescription, trained_under: str, task: WalkTask) -> PolicySpec:
        """Return the walk's layout with the told platform."""
        walk = walk_spec(description, trained_under, task)
        told = tuple(ObservationTerm("obstacle", axis, 1.0) for axis in OBSTACLE_AXES)
        return dataclasses.replace(walk, observation=walk.observation + told)

    @property
    def terrain(self) -> BatchTerrain:
        """The members' terrains."""
        assert self._terrain is not None
        return self._terrain

    def scene(self, robot: RobotModel) -> RobotModel:
        """Return the robot with a terrain of each kind ahead."""
        return with_terrain(robot, *self._nominal)

    def surroundings(self) -> Sequence[Parameter]:
        """Return the walk's parameters; the floor's friction is the terrain's, too."""
        model = self.scene(load_model(self.description)).model
        names = tuple(str(model.geom(k).name) for k in terrain_geoms(model))
        return [
            dataclasses.replace(p, elements=p.elements + names) if p.elements == ("floor",) else p
            for p in super().surroundings()
        ]

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Set the levels and the terrain of the restarted members, and tell some of them."""
        super().begin_episodes(where, rng)
        task, members = self.task, np.flatnonzero(where)
        fell = (self._elapsed[members] > 0) & (self._elapsed[members] < task.ticks)
        tried = fell | (self._way[members] > self.terrain.top_begins()[members] + TRIED_M)
        tried &= self.terrain.rise[members] > 0.0
        platform = np.array([kind == "box" for kind in task.terrains])
        for k in np.flatnonzero(
            (tried | self._climbed[members]) & self._told[members] & platform[self.terrain.kind[members]]
        ):
            self._tries[self.level[members[k]]].append(bool(self._climbed[members[k]]))
        moved = self.level[members] + np.where(self._climbed[members], 1, np.where(tried, -1, 0))
        # One that is at the top begins anywhere: otherwise easy platforms would be forgotten.
        anywhere = rng.integers(task.levels, size=len(members))
        self.level[members] = np.where(moved >= task.levels, anywhere, np.maximum(moved, 0))
        self._climbed[members], self._way[members] = False, 0.0
        kind = rng.integers(len(task.terrains), size=len(members))
        low, high = np.array([task.ends_of(name) for name in task.terrains])[kind].T
        rise = low + (high - low) * self.level[members] / (task.levels - 1)
        rise[rng.random(len(members)) < task.flat] = 0.0
        distance = rng.uniform(*task.distance_m, len(members))
        self.terrain.place(members, rise, distance, kind)
        edges = np.array([name != "slope" for name in task.terrains])[kind]
        told = (rng.random(len(members)) >= task.blind) & (rise > 0.0) & edges
        self._told[members] = told
        self._builder.obstacle[members] = np.where(told[:, None], np.column_stack([distance, rise]), 0.0)

    def base_height(self, position: FloatArray) -> FloatArray:
        """Return the heights of bases over the mean of the ground below them, (N,) [m]."""
        if self._terrain is None:
            return super().base_height(position)
        ground = self.terrain.height(position[:, :1] + np.array(FOOTPRINT_M)).mean(axis=1)
        return np.asarray(position[:, 2] - ground)

    def privileged(self) -> FloatArray:
        """Return the walk's information, and samples of the ground ahead over that below the base, (N, P)."""
        x = self.loop.position[:, :1]
        ground = self.terrain.height(x + np.array(AHEAD_M)) - self.terrain.height(x)
        return np.hstack([super().privileged(), 4.0 * ground])

    def extrinsics(self) -> Extrinsics:
        """Return what is known of the robots, and the ground below each foot and just ahead of it."""
        feet, base = np.asarray(self._places[:, self._feet])[..., 0], self.loop.position[:, :1]
        here = self.terrain.height(base)
        ground = np.hstack([self.terrain.height(feet + ahead) - here for ahead in FELT_AHEAD_M])
        # Feet are known one step after a state is set, and a robot starts on the floor.
        ground[self._elapsed == 0] = 0.0
        names = [f"{foot}.ground+{ahead:g}m" for ahead in FELT_AHEAD_M for foot in self.description.feet]
        return super().extrinsics().and_more(names, GROUND_M, ground)

    def on_top(self) -> BoolArray:
        """Return which feet are over the terrain and not below its surface, (N, F)."""
        feet = np.asarray(self._places[:, self._feet])
        ground = self.terrain.height(feet[..., 0])
        return np.asarray((ground > 0.0) & (feet[..., 2] - self._radius > ground - EDGE_M))

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        reward = super().reward(position, velocity, action, before)
        self._way += self.command[:, 0] / self.description.control_rate_hz
        top = self.on_top()
        behind = np.asarray(self._places[:, self._feet, 0]) >= self.terrain.top_begins()[:, None]
        self._climbed |= (top & behind).all(axis=1)
        # Members that end are restarted before somebody asks.
        self._outcome = np.where(self.terrain.rise > 0.0, self._climbed, np.nan)
        self.pressing = self._pressing_now()
        effort = np.square(self._torque).sum(axis=1)
        self._note(
            level=self.level.mean(),
            on_top=top.mean(),
            pressing=self.pressing.mean(),
            torque_nm=np.sqrt(np.nanmean(effort) / self._torque.shape[1]),
        )
        task = self.task
        cost = task.torque_weight * effort + task.scuff_weight * self.pressing
        return np.asarray(reward + task.top_weight * top.mean(axis=1) - cost)

    def reached(self) -> dict[str, float]:
        """Return the highest platform that most told robots climbed of late [m], as ``climbed_m``."""
        low, high = self.task.rise_m
        sure = [
            k for k, tries in enumerate(self._tries) if len(tries) >= LEAST_TRIES and np.mean(tries) >= MOST
        ]
        highest = low + (high - low) * max(sure) / (self.task.levels - 1) if sure else 0.0
        return {CLIMBED: round(float(highest), 4)}

    def progress(self) -> dict[str, Any]:
        """Return the robots' levels, and the last tries at each level."""
        return {
            "level": self.level.tolist(),
            "tries": [[int(done) for done in tries] for tries in self._tries],
        }

    def go_on(self, progress: Mapping[str, Any]) -> None:
        """Take over levels and tries of a former training, whatever its number of robots."""
        if progress.get("level"):
            self.level[:] = np.clip(np.resize(progress["level"], self.num_envs), 0, self.task.levels - 1)
        for mine, found in zip(self._tries, progress.get("tries", ()), strict=False):
            mine.extend(bool(done) for done in found)

    def outcomes(self) -> Mapping[str, FloatArray]:
        """Return whether all feet were on the (last) platform at once; NaN without terrain."""
        return {"climbed": self._outcome}

    def _pressing_now(self) -> BoolArray:
        """Return which robots press against a front, (N,); contacts are only looked for near an edge."""
        feet = np.asarray(self._places[:, self._feet, 0])
        near = (self.terrain.from_edge(feet) < PRESS_M).any(axis=1) & (self.terrain.rise > 0.0)
        members = np.flatnonzero(near)
        near[members] = self._scuffs.now(members)
        return near

    def _feet_now(self) -> FloatArray:
        feet = super()._feet_now().copy()
        feet[..., 2] -= self.terrain.height(feet[..., 0])
        return feet

    def _lift(self) -> FloatArray:
        """Return how high each foot is to be lifted in the middle of a step, (N, F) [m].

        Before an edge it is the walk's height over what lies behind it.
        """
        before = self.terrain.to_edge(np.asarray(self._places[:, self._feet])[..., 0]) < FREE_M
        return np.where(before, self.terrain.rise[:, None], 0.0) + self.task.swing_m

    def _foot_errors(self, error: FloatArray) -> FloatArray:
        return np.asarray(np.abs(error) / self._lift())

    def _wanted_heights(self) -> FloatArray:
        feet = np.asarray(self._places[:, self._feet])
        blind = self._builder.obstacle[:, 1] == 0.0
        near = self.terrain.from_edge(feet[..., 0]) < FREE_M
        free = near & (blind & (self.terrain.rise > 0.0))[:, None]
        wanted = super()._wanted_heights() * self._lift() / self.task.swing_m
        return np.where(free, self._feet_now()[..., 2] - self._radius, wanted)


@dataclass(frozen=True, slots=True, kw_only=True)
class TerrainTask(ClimbTask):
    """Settings of a walk over all kinds of terrain: time enough for a slope."""

    ticks: int = 350
    terrains: tuple[Kind, ...] = get_args(Kind)


class TerrainEnv(ClimbEnv):
    """Follow a velocity ahead over platforms, steps and slopes; see :class:`ClimbEnv`."""

    task_of: ClassVar[type[ClimbTask]] = TerrainTask
