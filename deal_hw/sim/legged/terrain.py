"""Simple terrain ahead of a robot with legs: a platform with a rounded edge, or a slope. No meshes.

The world's x axis is ahead; terrain reaches over the whole width of the robot's way. Feet and trunk touch it
as they touch the floor, and so do hips, thighs and calves, which pass through the floor itself: a leg that
hits a platform's edge must not pass through.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import mujoco
import numpy as np
import numpy.typing as npt

from deal_hw.errors import ConfigurationError, shown
from deal_hw.sim.engine.model import RobotModel
from deal_hw.types import FloatArray, IntArray

if TYPE_CHECKING:
    # An emulated robot has terrain too, and no batch: loading that takes 0.3 s.
    from deal_hw.sim.engine.batch import ServoBatch

Kind = Literal["box", "slope"]

LENGTH_M: Final = 4.0
"""Length of a platform, and of the platform behind a slope."""
RAMP_M: Final = 2.0
"""Length of a slope along its surface."""
WIDTH_M: Final = 4.0
EDGE_M: Final = 0.015
"""Radius of a platform's edge: a foot slides over it instead of catching on a corner."""
DEPTH_M: Final = 0.5
"""Height of the boxes, most of which is below the floor."""
DISTANCE_M: Final = 1.0
"""Default distance of the terrain from the robot's start."""
PREFIX: Final = "terrain"
_LEG: Final = 2
"""Collision bit of legs on terrain; the floor does not have it."""
_RANGE: Final = {"box": (0.0, 0.5, "m"), "slope": (0.0, 0.6, "rad")}
_DISTANCE: Final = (0.5, 10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Terrain:
    """Terrain ahead of a robot that starts at the origin.

    Attributes:
        kind: ``box``, a platform, or ``slope``, a ramp with a platform behind it.
        rise: Height of the platform [m], or angle of the slope [rad].
        distance_m: Where it begins, along x.
    """

    kind: Kind
    rise: float
    distance_m: float = DISTANCE_M

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(
                f"terrain {shown(self.kind)}: there is {' and '.join(get_args(Kind))}; give such as box:0.2"
            )
        low, high, unit = _RANGE[self.kind]
        if not low < self.rise <= high:
            raise ConfigurationError(
                f"terrain {self.kind}:{self.rise:g}: allowed is more than {low:g} up to {high:g} {unit}"
            )
        if not _DISTANCE[0] <= self.distance_m <= _DISTANCE[1]:
            raise ConfigurationError(
                f"terrain {self.kind}: its distance is {self.distance_m:g} m; allowed is {_DISTANCE[0]:g} to "
                f"{_DISTANCE[1]:g} m, so that the robot can lie and stand before it"
            )

    @classmethod
    def parse(cls, text: str) -> Terrain | None:
        """Return the terrain that an option names, such as ``box:0.2`` or ``slope:0.15,1.5``; None for "".

        Raises:
            ConfigurationError: The text names none.
        """
        if not text:
            return None
        kind, _, rest = text.partition(":")
        try:
            values = [float(part) for part in rest.split(",")]
        except ValueError:
            values = []
        if not 1 <= len(values) <= 2 or not all(map(math.isfinite, values)):
            raise ConfigurationError(
                f"terrain {shown(text)}: give box:HEIGHT [m] or slope:ANGLE [rad], with its distance after a "
                f"comma [m] ({DISTANCE_M:g} by default), such as box:0.2,1.5"
            )
        return cls(kind=kind, rise=values[0], distance_m=[*values, DISTANCE_M][1])  # type: ignore[arg-type]

    @property
    def top_m(self) -> float:
        """Height of its platform [m]."""
        return self.rise if self.kind == "box" else RAMP_M * math.sin(self.rise)

    def height(self, x: FloatArray) -> FloatArray:
        """Return the height of the ground at places along x, (...,) [m]."""
        ahead = np.asarray(x) - self.distance_m
        run = 0.0 if self.kind == "box" else RAMP_M * math.cos(self.rise)
        if self.kind == "box":
            return np.where((ahead >= 0.0) & (ahead <= LENGTH_M), self.rise, 0.0)
        ramp = np.clip(ahead * math.tan(self.rise), 0.0, self.top_m)
        return np.where(ahead <= run + LENGTH_M, ramp, 0.0)


def add_terrain(spec: Any, terrain: Terrain, floor: str = "floor") -> None:
    """Add a terrain to a model's MjSpec; its surface is that of the floor.

    Args:
        spec: The model before it is compiled.
        terrain: The terrain.
        floor: Name of the floor's geom.
    """
    ground = spec.geom(floor)
    for geom in spec.geoms:
        if geom.name != floor and geom.contype == 0 and geom.parent is not spec.worldbody:
            geom.contype = _LEG
    surface: dict[str, Any] = {
        "contype": 0,
        "conaffinity": ground.conaffinity | _LEG,
        "condim": ground.condim,
        "priority": ground.priority,
        "friction": ground.friction,
        "solref": ground.solref,
        "solimp": ground.solimp,
        "rgba": [0.55, 0.5, 0.42, 1.0],
    }
    begin, half = terrain.distance_m, 0.5 * DEPTH_M

    def box(name: str, start: float, length: float, top: float) -> None:
        spec.worldbody.add_geom(
            name=f"{PREFIX}_{name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.5 * length, 0.5 * WIDTH_M, half],
            pos=[start + 0.5 * length, 0.0, top - half],
            **surface,
        )

    if terrain.kind == "slope":
        lean, run = terrain.rise, RAMP_M * math.cos(terrain.rise)
        middle = begin + 0.5 * run + half * math.sin(lean)
        spec.worldbody.add_geom(
            name=f"{PREFIX}_ramp",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.5 * RAMP_M, 0.5 * WIDTH_M, half],
            pos=[middle, 0.0, 0.5 * terrain.top_m - half * math.cos(lean)],
            quat=[math.cos(0.5 * lean), 0.0, -math.sin(0.5 * lean), 0.0],
            **surface,
        )
        box("top", begin + run, LENGTH_M, terrain.top_m)
        return
    # The face ends below the edge, and the top begins behind it: the capsule is the corner between them.
    box("face", begin, LENGTH_M, terrain.rise - EDGE_M)
    box("top", begin + EDGE_M, LENGTH_M - EDGE_M, terrain.rise)
    spec.worldbody.add_geom(
        name=f"{PREFIX}_edge",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[EDGE_M, 0.0, 0.0],
        fromto=[
            *(begin + EDGE_M, -0.5 * WIDTH_M, terrain.rise - EDGE_M),
            *(begin + EDGE_M, 0.5 * WIDTH_M, terrain.rise - EDGE_M),
        ],
        **surface,
    )


def terrain_geoms(model: Any) -> list[int]:
    """Return the ids of a compiled model's terrain geoms."""
    return [k for k in range(model.ngeom) if model.geom(k).name.startswith(f"{PREFIX}_")]


def with_terrain(robot: RobotModel, terrain: Terrain) -> RobotModel:
    """Return a robot's model with a terrain; joints, actuators and step are the same.

    Broad-phase bounds of the terrain are computed once, by the compiler, so they are not used: the members of
    a batch may have platforms of other heights.
    """
    spec: Any = mujoco.MjSpec.from_file(str(robot.description.mjcf))
    add_terrain(spec, terrain)
    spec.option.timestep = robot.step_s
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return dataclasses.replace(robot, model=spec.compile())


class BatchPlatforms:
    """Platforms of N simulated robots, each with a height and a distance of its own.

    Args:
        batch: The robots; their model has a platform (:func:`with_terrain`).
        terrain: That platform.

    Attributes:
        rise: Height of each member's platform, (N,) [m]; 0 for a flat floor.
        distance: Where it begins, along x, (N,) [m].
    """

    def __init__(self, batch: ServoBatch, terrain: Terrain) -> None:
        model = batch.robot.model
        self._geoms = terrain_geoms(model)
        self._fields = batch.engine.fields
        self._nominal = np.array(model.geom_pos[self._geoms])
        self._terrain = terrain
        self.rise = np.full(batch.count, terrain.rise)
        self.distance = np.full(batch.count, terrain.distance_m)

    def place(self, members: IntArray, rise: FloatArray, distance: FloatArray) -> None:
        """Set the platforms of M members.

        Args:
            members: Their indices, (M,).
            rise: Heights, (M,) [m]; 0 for a flat floor.
            distance: Where they begin, along x, (M,) [m].
        """
        self.rise[members], self.distance[members] = rise, distance
        # A platform of height 0 lies below the floor: two surfaces at one height would share each contact.
        up = np.where(rise > 0.0, rise, -EDGE_M) - self._terrain.rise
        position = self._fields.get("geom_pos")
        for number, geom in enumerate(self._geoms):
            position[members, geom, 0] = self._nominal[number, 0] + distance - self._terrain.distance_m
            position[members, geom, 2] = self._nominal[number, 2] + up

    def height(self, x: FloatArray) -> FloatArray:
        """Return the height of each member's ground at places along x, (N, ...) [m]."""
        shape = (-1, *(1,) * (np.ndim(x) - 1))
        ahead = x - self.distance.reshape(shape)
        return np.where((ahead >= 0.0) & (ahead <= LENGTH_M), self.rise.reshape(shape), 0.0)


class Scuffs:
    """Which of N simulated robots press a leg against the front of their platform.

    A contact of the platform with a leg or the trunk counts if its normal is less than 45 degrees from level.
    Contacts are computed again from the coordinates, one robot after the other: this is for scores of some
    hundred episodes, not for training.

    Args:
        batch: The robots; their model has a platform (:func:`with_terrain`).
    """

    def __init__(self, batch: ServoBatch) -> None:
        self._model: Any = copy.copy(batch.robot.model)
        self._data: Any = mujoco.MjData(self._model)
        self._geoms = terrain_geoms(self._model)
        self._position = batch.engine.bind("qpos")
        self._fields = batch.engine.fields

    def now(self, members: IntArray) -> npt.NDArray[np.bool_]:
        """Return which of M members do, (M,)."""
        model, data = self._model, self._data
        places, found = self._fields.get("geom_pos"), np.zeros(len(members), dtype=bool)
        for number, member in enumerate(members):
            model.geom_pos[self._geoms] = places[member, self._geoms]
            data.qpos[:] = self._position[member]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            contact = data.contact
            ours = np.isin(contact.geom, self._geoms).any(axis=1)
            found[number] = bool((np.abs(contact.frame[ours, 2]) < math.sqrt(0.5)).any())
        return found
