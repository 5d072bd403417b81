"""Simple terrain ahead of a robot with legs: a platform, three steps, or a slope. No meshes.

The world's x axis is ahead; terrain reaches over the whole width of the robot's way. Feet and trunk touch it
as they touch the floor, and so do hips, thighs and calves, which pass through the floor itself: a leg that
hits a platform's edge must not pass through. Edges are round.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
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

Kind = Literal["box", "steps", "slope"]

LENGTH_M: Final = 4.0
"""Length of a platform, of steps in all, and of the platform behind a slope."""
STEPS: Final = 3
"""Number of steps; the last one is the platform."""
TREAD_M: Final = 0.3
"""Depth of a step, as of usual stairs."""
RAMP_M: Final = 1.5
"""Length of a slope along its surface."""
WIDTH_M: Final = 10.0
"""Width of all terrain: a robot whose heading nobody holds drifts 2 m in 8 s."""
EDGE_M: Final = 0.015
"""Radius of a platform's edge: a foot slides over it instead of catching on a corner."""
DEPTH_M: Final = 0.5
"""Height of the boxes, most of which is below the floor."""
DISTANCE_M: Final = 1.0
"""Default distance of the terrain from the robot's start."""
LEAST_RISE: Final = 0.01
"""Rise of terrain that lies below the floor [m or rad]."""
PREFIX: Final = "terrain"
_LEG: Final = 2
"""Collision bit of legs on terrain; the floor does not have it."""
_RANGE: Final = {"box": (0.0, 0.5, "m"), "steps": (0.0, 0.25, "m"), "slope": (0.0, 0.6, "rad")}
_DISTANCE: Final = (0.5, 10.0)
_EDGES: Final[Mapping[Kind, Sequence[float]]] = {
    "box": (0.0,),
    "steps": tuple(number * TREAD_M for number in range(STEPS)),
    "slope": (),
}
"""Where terrain rises at once, from its beginning along x [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Terrain:
    """Terrain ahead of a robot that starts at the origin.

    Attributes:
        kind: ``box``, a platform; ``steps``, three steps; or ``slope``, a ramp with a platform behind it.
        rise: Height of the platform or of one step [m], or angle of the slope [rad].
        distance_m: Where it begins, along x.
    """

    kind: Kind
    rise: float
    distance_m: float = DISTANCE_M

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ConfigurationError(
                f"terrain {shown(self.kind)}: there are {', '.join(get_args(Kind))}; give such as box:0.2"
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
                f"terrain {shown(text)}: give box:HEIGHT [m], steps:HEIGHT of one step [m] or slope:ANGLE "
                f"[rad], with its distance after a comma [m] ({DISTANCE_M:g} by default), such as box:0.2,1.5"
            )
        return cls(kind=kind, rise=values[0], distance_m=[*values, DISTANCE_M][1])  # type: ignore[arg-type]

    @property
    def top_m(self) -> float:
        """Height of its platform [m]."""
        return float(_top(self.kind, np.array(self.rise)))

    @property
    def top_begins_m(self) -> float:
        """Where its platform begins, from its own beginning along x [m]."""
        return float(_top_begins(self.kind, np.array(self.rise)))

    def height(self, x: FloatArray) -> FloatArray:
        """Return the height of the ground at places along x, (...,) [m]."""
        return _height(self.kind, np.array(self.rise), np.asarray(x) - self.distance_m)


def _top(kind: Kind, rise: FloatArray) -> FloatArray:
    """Return the heights of the last platform, (...,) [m]."""
    if kind == "slope":
        return np.asarray(RAMP_M * np.sin(rise))
    return rise * len(_EDGES[kind])


def _top_begins(kind: Kind, rise: FloatArray) -> FloatArray:
    """Return where the last platform begins, from the terrain's beginning along x, (...,) [m]."""
    if kind == "slope":
        return np.asarray(RAMP_M * np.cos(rise))
    return np.full(np.shape(rise), _EDGES[kind][-1])


def _height(kind: Kind, rise: FloatArray, ahead: FloatArray) -> FloatArray:
    """Return the height of the ground [m] at places from the terrain's beginning along x; both (...,)."""
    if kind == "slope":
        ground = np.clip(ahead * np.tan(rise), 0.0, _top(kind, rise))
        return np.where(ahead <= _top_begins(kind, rise) + LENGTH_M, ground, 0.0)
    risen = sum((np.asarray(ahead) >= edge).astype(int) for edge in _EDGES[kind])
    return np.where(ahead <= LENGTH_M, risen * rise, 0.0)


@dataclass(frozen=True, slots=True)
class _Geoms:
    """Boxes and rounded edges of one kind of terrain, for M rises and distances.

    Attributes:
        names: Their names, G.
        sizes: Half lengths of a box, or radius and half length of an edge, (G, 3) [m].
        position: (M, G, 3) [m].
        quaternion: (M, G, 4).
    """

    names: tuple[str, ...]
    sizes: FloatArray
    position: FloatArray
    quaternion: FloatArray


def _geoms(kind: Kind, rise: FloatArray, distance: FloatArray) -> _Geoms:
    """Return where the geoms of M terrains of one kind lie; rise and distance are (M,).

    The face of a step ends below its edge, and its top begins behind it: the capsule is the corner between
    them.
    """
    half, zero = 0.5 * DEPTH_M, np.zeros(len(rise))
    names, sizes, position, quaternion = [], [], [], []

    def add(
        name: str, size: tuple[float, ...], place: tuple[FloatArray, ...], turn: FloatArray, axis: int
    ) -> None:
        names.append(f"{PREFIX}_{kind}_{name}")
        sizes.append(size)
        position.append(np.stack(place, axis=1))
        turned = np.zeros((len(rise), 4))
        turned[:, 0], turned[:, axis] = np.cos(0.5 * turn), np.sin(0.5 * turn)
        quaternion.append(turned)

    def box(name: str, begin: FloatArray, length: float, top: FloatArray) -> None:
        place = (distance + begin + 0.5 * length, zero, top - half)
        add(name, (0.5 * length, 0.5 * WIDTH_M, half), place, zero, 2)

    top = _top(kind, rise)
    if kind == "slope":
        run = _top_begins(kind, rise)
        middle = (distance + 0.5 * run + half * np.sin(rise), zero, 0.5 * top - half * np.cos(rise))
        add("ramp", (0.5 * RAMP_M, 0.5 * WIDTH_M, half), middle, -rise, 2)
        box("top", run, LENGTH_M, top)
    for number, edge in enumerate(_EDGES[kind], 1):
        step, length = number * rise, LENGTH_M - edge
        box(f"face_{number}", zero + edge, length, step - EDGE_M)
        box(f"top_{number}", zero + edge + EDGE_M, length - EDGE_M, step)
        corner = (distance + edge + EDGE_M, zero, step - EDGE_M)
        add(f"edge_{number}", (EDGE_M, 0.5 * WIDTH_M, 0.0), corner, zero + 0.5 * np.pi, 1)
    return _Geoms(tuple(names), np.array(sizes), np.stack(position, axis=1), np.stack(quaternion, axis=1))


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
    geoms = _geoms(terrain.kind, np.array([terrain.rise]), np.array([terrain.distance_m]))
    for name, size, place, turn in zip(
        geoms.names, geoms.sizes, geoms.position[0], geoms.quaternion[0], strict=True
    ):
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX if size[2] > 0.0 else mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=size,
            pos=place,
            quat=turn,
            contype=0,
            conaffinity=ground.conaffinity | _LEG,
            condim=ground.condim,
            priority=ground.priority,
            friction=ground.friction,
            solref=ground.solref,
            solimp=ground.solimp,
            rgba=[0.55, 0.5, 0.42, 1.0],
        )


def terrain_geoms(model: Any) -> list[int]:
    """Return the ids of a compiled model's terrain geoms."""
    return [k for k in range(model.ngeom) if model.geom(k).name.startswith(f"{PREFIX}_")]


def with_terrain(robot: RobotModel, *terrains: Terrain) -> RobotModel:
    """Return a robot's model with terrains of different kinds; joints, actuators and step are the same.

    Broad-phase bounds of the terrain are computed once, by the compiler, so they are not used: the members of
    a batch may have platforms of other heights.
    """
    spec: Any = mujoco.MjSpec.from_file(str(robot.description.mjcf))
    for terrain in terrains:
        add_terrain(spec, terrain)
    spec.option.timestep = robot.step_s
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return dataclasses.replace(robot, model=spec.compile())


class BatchTerrain:
    """Terrains of N simulated robots, each with a kind, a rise and a distance of its own.

    Args:
        batch: The robots; their model has a terrain of each of these kinds (:func:`with_terrain`).
        kinds: The kinds.

    Attributes:
        kind: Index of each member's kind, (N,).
        rise: Height of each member's platform or step [m], or angle of its slope [rad], (N,); 0 for a flat
            floor.
        distance: Where it begins, along x, (N,) [m].
    """

    def __init__(self, batch: ServoBatch, kinds: Sequence[Kind]) -> None:
        model = batch.robot.model
        self.kinds = tuple(kinds)
        self._ids = [
            [k for k in terrain_geoms(model) if model.geom(k).name.startswith(f"{PREFIX}_{kind}_")]
            for kind in kinds
        ]
        self._fields = batch.engine.fields
        self.kind = np.zeros(batch.count, dtype=np.int64)
        self.rise = np.zeros(batch.count)
        self.distance = np.full(batch.count, DISTANCE_M)
        self.place(np.arange(batch.count), self.rise.copy(), self.distance.copy())

    def place(
        self, members: IntArray, rise: FloatArray, distance: FloatArray, kind: IntArray | None = None
    ) -> None:
        """Set the terrains of M members.

        Args:
            members: Their indices, (M,).
            rise: Heights [m] or angles [rad], (M,); 0 for a flat floor.
            distance: Where they begin, along x, (M,) [m].
            kind: Indices of their kinds, (M,); None: the first one.
        """
        self.rise[members], self.distance[members] = rise, distance
        self.kind[members] = 0 if kind is None else kind
        position, quaternion = self._fields.get("geom_pos"), self._fields.get("geom_quat")
        for number, (name, ids) in enumerate(zip(self.kinds, self._ids, strict=True)):
            # mj_setConst notes which geoms are not turned, and then never looks at their quaternion again.
            risen = np.maximum(rise, LEAST_RISE)
            geoms = _geoms(name, risen, distance)
            # What is not there lies below the floor: two surfaces at one height would share each contact.
            away = (self.kind[members] != number) | (rise <= 0.0)
            down = np.where(away, _top(name, risen) + EDGE_M, 0.0)
            for column, geom in enumerate(ids):
                position[members, geom] = geoms.position[:, column]
                position[members, geom, 2] -= down
                quaternion[members, geom] = geoms.quaternion[:, column]

    def height(self, x: FloatArray) -> FloatArray:
        """Return the height of each member's ground at places along x, (N, ...) [m]."""
        rise, distance = self._like(self.rise, x), self._like(self.distance, x)
        found = [_height(kind, rise, x - distance) for kind in self.kinds]
        return np.choose(self._like(self.kind, x), found)

    def top(self) -> FloatArray:
        """Return the height of each member's last platform, (N,) [m]."""
        return np.choose(self.kind, [_top(kind, self.rise) for kind in self.kinds])

    def top_begins(self) -> FloatArray:
        """Return where each member's last platform begins along x, (N,) [m]."""
        found = [_top_begins(kind, self.rise) for kind in self.kinds]
        return self.distance + np.choose(self.kind, found)

    def to_edge(self, x: FloatArray) -> FloatArray:
        """Return the way to each next edge ahead of places along x, (N, ...) [m]; inf where there is none."""
        return self._nearest(x, lambda way: np.where(way > 0.0, way, np.inf))

    def from_edge(self, x: FloatArray) -> FloatArray:
        """Return the distance of places along x from the nearest edge, (N, ...) [m]; inf without an edge."""
        return self._nearest(x, np.abs)

    def _nearest(self, x: FloatArray, measure: Callable[[FloatArray], FloatArray]) -> FloatArray:
        distance, found = self._like(self.distance, x), []
        for kind in self.kinds:
            ways = [measure(distance + edge - x) for edge in _EDGES[kind]]
            found.append(np.min([np.full(np.shape(x), np.inf), *ways], axis=0))
        return np.choose(self._like(self.kind, x), found)

    @staticmethod
    def _like(values: npt.NDArray[Any], x: FloatArray) -> npt.NDArray[Any]:
        """Return one value per member in the shape in which it meets places (N, ...)."""
        return values.reshape(-1, *(1,) * (np.ndim(x) - 1))


class Scuffs:
    """Which of N simulated robots press a leg against the front of their platform or step.

    A contact of the platform with a leg or the trunk counts if its normal is less than 45 degrees from level.
    Contacts are computed again from the coordinates, one robot after the other, in 0.04 ms each: ask for the
    robots that may touch.

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
