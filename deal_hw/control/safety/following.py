"""Does each joint follow its commands? Judged from the drive's own law, without a model of the robot.

A position drive pushes with stiffness x (set-point - position), up to its effort limit. So a reading that is
away from its set-point says how hard the drive pushes, if it is on and reads the same. A joint that is pushed
harder than its usual load asks for must move that way, or gain speed that way. One that does not is blocked,
or its drive is off, or the reading is not that of this joint.

A joint that stands while it is pushed to one side and then to the other is found at once. Else what counts is
the push over time. At the drive's limit it is noticed after 0.36 s, at a third of the limit after 1 s, at the
least push after 2 s, and sooner where several joints stand and none follows. A leg that never reaches its
set-point under load follows: its load is usual. A joint that moves at its limit follows, too. Two kinds of
wrong readings are found in another way: a reading that jumps faster than the joint can move, and readings
that fit the set-point of another joint, or the own one with the other sign.

Pure: no I/O, and time is an argument.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription
from deal_hw.types import FloatArray, IntArray, JointCommand

BoolArray = npt.NDArray[np.bool_]

PUSH_S: Final = 0.3
"""A push at the drive's limit without motion for this long, or a smaller one for longer, is no following [s].
tools/measure_following.py has what shipped motions reach. On eight recordings of a real SO-101 (from
isaac-sim2real/sage) it is at most 0.12, and 0.29 where its fingertip presses on a table. With a stiffness
that is 1.6 times too high it is above 0.3 there, and at most 0.22 elsewhere."""
TOGETHER_S: Final = 0.45
"""The same of all joints together, while none of them follows [s]: with limp drives all stand. On those
recordings it is at most 0.12, and 0.39 at the table."""
LEAST_PUSH: Final = 0.15
"""A smaller share of the drive's limit beyond the usual load does not count: friction, or a new load."""
LOAD_S: Final = 1.0
"""The usual load follows the push with this time constant [s]."""
DEAD_S: Final = 0.06
"""A push counts after this time in one direction [s]: a command takes some 10 to 40 ms to act."""
FORGET: Final = 0.02
"""Without a push, the counted one falls by this much a second."""
SWING: Final = 0.3
"""A push that rises by this share of the limit, and falls by it, moves every joint, whatever its load. While
a joint stands, it is at most 0.09 on the recordings of a real SO-101 above, and 0.12 with that stiffness."""
STUCK: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.005, "m": 0.001})
"""A joint that moves by less stands [rad or m]; a reading's noise is 1 to 2 mrad."""
LEAST_REACH: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.2, "m": 0.04})
"""No drive reaches its limit at a smaller error: a model's stiffness is often far above the real one."""
MOST_REACH: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.6, "m": 0.12})
"""A soft drive that stays so far behind its set-point counts as one at its limit, which is further away. A B2
on a stand whose drives are limp is 0.4 to 0.8 rad behind, with a third of its limit."""
UNKNOWN_REACH: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.5, "m": 0.1})
"""The same of a drive whose effort limit is unknown."""
MOVED: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.02, "m": 0.004})
FASTER: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.2, "m": 0.04})
"""Motion, or gain of speed, in the direction of the push by which a joint follows [rad, m; rad/s, m/s]."""
JUMP: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.04, "m": 0.008})
JUMP_SPEEDS: Final = 1.25
"""A reading that changes by more than this, plus this many times the trip speed, has jumped [rad or m]."""
ELSEWHERE: Final[Mapping[str, float]] = MappingProxyType({"rad": 0.08, "m": 0.016})
FAR: Final = 5.0
"""A reading that is at another joint's set-point is called exchanged where its own is this many times
``ELSEWHERE`` away: only the cause that is named depends on it."""
FITS: Final = 0.45
"""A reading that is so far from its own set-point, and at most this share of it from another one, is not the
joint's own [rad or m]. Both are means over ``MEAN_S`` of the motion around a mean over ``CENTRE_S``: joints
that are bent by loads must not look so. The share is at least 0.6 with shipped motions, and 0.21 to 0.44 with
exchanged readings (tools/measure_following.py)."""
BEHIND_S: Final = tuple(0.02 * k for k in range(16))
"""How far a joint may be behind its set-point [s]; the nearest of these counts."""
TURNED_FITS: Final = 0.35
"""The same share for a reading of the other sign: with shipped motions at least 0.78, else 0.13 to 0.31."""
MEAN_S: Final = 0.7
CENTRE_S: Final = 1.5
_SMOOTH_S: Final = 0.1
_LONGEST_STEP_S: Final = 0.1
"""Time that a step counts at most [s]: after a pause of this computer nobody knows what was in force."""


@dataclass(frozen=True, slots=True)
class Unfollowed:
    """Joints that do not follow.

    Attributes:
        joints: Their names.
        since_ns: Time of the last state by which they followed, on the clock of the steps [ns].
        reason: What was seen, what it means and what to do, for the operator.
    """

    joints: tuple[str, ...]
    since_ns: int
    reason: str


class FollowingWatch:
    """Watches the actuated joints of one robot, state by state; arrays are (A,) in the order of commands.

    Joints with commands of effort (``actuation`` "motor") are not watched: no set-point says where they are
    to be. A joint of ``limits.may_be_blocked`` is not watched for pushes.

    Attributes:
        worst: Largest push without motion so far, as a time at the drive's limit [s]; ``PUSH_S`` trips.

    Args:
        description: The robot.
    """

    def __init__(self, description: RobotDescription) -> None:
        d, index = description, list(description.actuated_index)
        units = [d.position_units[j] for j in index]

        def by_unit(table: Mapping[str, float]) -> FloatArray:
            return np.array([table[unit] for unit in units])

        self._names, self._units = d.actuated, units
        # Beside motors, which follow no position, nothing is watched; no bus drives such a robot.
        self._watched = all(d.servos)
        limit = np.array(d.effort_limit, dtype=float)
        self._limited = np.isfinite(limit)
        self._limit = np.where(self._limited, limit, 0.0)
        self._most = np.where(self._limited, limit, 1.0)
        self._reach = np.where(self._limited, by_unit(LEAST_REACH), by_unit(UNKNOWN_REACH))
        self._softest = by_unit(MOST_REACH)
        self._stands = by_unit(STUCK)
        self._moved, self._faster = by_unit(MOVED), by_unit(FASTER)
        self._jump, self._elsewhere = by_unit(JUMP), by_unit(ELSEWHERE)
        self._speed = np.array(d.limits.trip_velocity, dtype=float)[index]
        self._may_be_blocked = np.isin(d.actuated, d.limits.may_be_blocked)
        steps = [round(behind_s * d.control_rate_hz) for behind_s in BEHIND_S]
        self._behind = -1 - np.array(steps)
        self._like = np.equal.outer(units, units) & ~np.eye(len(units), dtype=bool)
        self.reset()

    def reset(self) -> None:
        """Forget the past, as on arming."""
        self._now_ns: int | None = None
        self.worst = 0.0

    def step(
        self, now_ns: int, position: FloatArray, velocity: FloatArray, command: JointCommand
    ) -> Unfollowed | None:
        """Judge a new state.

        Args:
            now_ns: Its time, by a clock that does not go back [ns].
            position: Measured positions, (A,) [rad or m].
            velocity: Measured velocities, (A,) [rad/s or m/s].
            command: The command in force when it was measured.

        Returns:
            The joints that do not follow; None where all follow, or nothing can be said.
        """
        if not self._watched:
            return None
        if self._now_ns is None:
            self._begin(now_ns, position, velocity, command)
            return None
        passed_s = min((now_ns - self._now_ns) * 1e-9, _LONGEST_STEP_S)
        if passed_s <= 0.0:
            return None
        self._now_ns = now_ns
        # A drive with a set-point generator moves its set-point at most this fast.
        travel = command.speed_limit * passed_s
        self._setpoint += np.clip(command.position_target - self._setpoint, -travel, travel)
        return (
            self._jumped(position, passed_s)
            or self._pushed(now_ns, position, velocity, command, passed_s)
            or self._misread(now_ns, position, command, passed_s)
        )

    def _begin(self, now_ns: int, position: FloatArray, velocity: FloatArray, command: JointCommand) -> None:
        self._now_ns = now_ns
        self._setpoint: FloatArray = command.position_target.copy()
        count = len(position)
        self._load = self._share(position, command)
        self._at = position.copy()
        self._smooth, self._rest = self._load.copy(), self._load.copy()
        self._least, self._greatest = self._load.copy(), self._load.copy()
        self._way = np.zeros(count)
        self._way_s, self._counted, self._together = np.zeros(count), np.zeros(count), 0.0
        self._from, self._from_velocity = position.copy(), velocity.copy()
        self._followed_ns, self._near_ns = np.full(count, now_ns), np.full(count, now_ns)
        self._before, self._odd = position.copy(), np.zeros(count, dtype=bool)
        self._judged_s = 0.0
        self._centre, self._target_centre = position.copy(), self._setpoint.copy()
        self._setpoints = np.zeros((-int(self._behind.min()), count))
        self._off = np.zeros((len(BEHIND_S), count, count))
        self._off_turned = np.zeros((len(BEHIND_S), count))

    def _share(self, position: FloatArray, command: JointCommand) -> FloatArray:
        """Return the drives' pushes as shares of their limits, with sign, (A,)."""
        stiffness = command.stiffness
        most = np.maximum(np.minimum(self._limit, stiffness * self._softest), stiffness * self._reach)
        push = stiffness * (self._setpoint - position) + command.effort
        share = np.divide(push, most, out=np.zeros(len(most)), where=most > 0)
        # A command may allow less than the drive's limit.
        allowed = np.where(self._limited, np.minimum(command.effort_limit / self._most, 1.0), 1.0)
        return np.clip(share, -allowed, allowed)

    def _pushed(
        self, now_ns: int, position: FloatArray, velocity: FloatArray, command: JointCommand, passed_s: float
    ) -> Unfollowed | None:
        """Count pushes beyond the usual load that move nothing."""
        share = self._share(position, command)
        way = np.sign(share)
        beyond = np.minimum(np.abs(share), way * (share - self._load))
        # At its limit a drive has nothing left, whatever its load is.
        beyond = np.where(np.abs(share) > 0.999, 1.0, beyond)
        pushes = beyond > LEAST_PUSH
        turned = ~pushes | (way != self._way)
        self._way_s = np.where(turned, 0.0, self._way_s + passed_s)
        self._way = np.where(pushes, way, 0.0)
        moved = way * (position - self._from) >= self._moved
        faster = way * (velocity - self._from_velocity) >= self._faster
        follows = pushes & ~turned & (moved | faster)
        anew = turned | follows
        self._from = np.where(anew, position, self._from)
        self._from_velocity = np.where(anew, velocity, self._from_velocity)
        counts = pushes & (self._way_s >= DEAD_S) & ~self._may_be_blocked
        more = np.where(counts, beyond * passed_s, -FORGET * passed_s)
        self._counted = np.where(follows, 0.0, np.maximum(self._counted + more, 0.0))
        together = self._together + (more[counts].sum() if counts.any() else more.max())
        self._together = 0.0 if follows.any() else max(together, 0.0)
        doubtful = self._odd | (self._counted > 0.0) | (pushes & ~follows)
        self._followed_ns = np.where(doubtful, self._followed_ns, now_ns)
        self._load = self._load + (share - self._load) * min(passed_s / LOAD_S, 1.0)
        self.worst = max(self.worst, float(self._counted.max()))
        late = (self._counted >= PUSH_S) | (self._swung(position, share, passed_s) & ~self._may_be_blocked)
        late |= (self._together >= TOGETHER_S) & (self._counted > 0.0)
        if not late.any():
            return None
        worst = int(np.argmax(np.where(late, np.abs(share), -1.0)))
        off = self._setpoint[worst] - position[worst]
        return self._unfollowed(
            late,
            self._followed_ns,
            f"joint {self._names[worst]!r} does not follow: its set-point is {abs(off):.2f} "
            f"{self._units[worst]} away, so its drive should push with {abs(share[worst]):.0%} of its limit, "
            f"but the joint does not move that way. {self._cause(worst, position)}",
        )

    def _cause(self, joint: int, position: FloatArray) -> str:
        """Return what may be the cause of a push without motion, and what to do."""
        off = np.abs(position[:, None] - self._setpoint)
        # Of a small motion readings are near many set-points.
        there = (off < self._elsewhere) & (np.diag(off) > FAR * self._elsewhere)[:, None]
        for other in np.flatnonzero(there[joint] & there[:, joint] & self._like[joint]):
            return (
                f"Its reading is at the set-point of {self._names[other]!r}, and that one's at its own: the "
                "two are exchanged, in the order of joints, in cables or in ids"
            )
        return "It is blocked, its drive is off or limp, or its reading stands still; look at it before a run"

    def _swung(self, position: FloatArray, share: FloatArray, passed_s: float) -> BoolArray:
        """Return which joints stand although they were pushed to both sides, (A,)."""
        self._smooth = self._smooth + (share - self._smooth) * (1.0 - np.exp(-passed_s / _SMOOTH_S))
        moved = np.abs(position - self._at) >= self._stands
        self._at = np.where(moved, position, self._at)
        self._rest = np.where(moved, self._smooth, self._rest)
        self._least = np.where(moved, self._smooth, np.minimum(self._least, self._smooth))
        self._greatest = np.where(moved, self._smooth, np.maximum(self._greatest, self._smooth))
        rise, fall = self._greatest - self._rest, self._rest - self._least
        swung: BoolArray = np.minimum(rise, fall) >= SWING
        return swung

    def _jumped(self, position: FloatArray, passed_s: float) -> Unfollowed | None:
        """Find readings that changed faster than a joint can move, and stayed so for a second state."""
        far = np.abs(position - self._before) > self._jump + JUMP_SPEEDS * self._speed * passed_s
        jumped = far & self._odd
        # After one odd reading the next one is compared with that before it.
        self._before = np.where(far & ~self._odd, self._before, position)
        self._odd = far
        if not jumped.any():
            return None
        names = ", ".join(repr(name) for name, hit in zip(self._names, jumped, strict=True) if hit)
        return self._unfollowed(
            jumped,
            self._followed_ns,
            f"the reading of joint {names} jumped, faster than the joint can move: an encoder slipped, "
            "readings were exchanged, or something moved it by force; look at it before the next run",
        )

    def _misread(
        self, now_ns: int, position: FloatArray, command: JointCommand, passed_s: float
    ) -> Unfollowed | None:
        """Find readings that fit another joint's set-point, or the own one with the other sign."""
        centre, mean = 1.0 - np.exp(-passed_s / CENTRE_S), 1.0 - np.exp(-passed_s / MEAN_S)
        self._centre = self._centre + centre * (position - self._centre)
        self._target_centre = self._target_centre + centre * (self._setpoint - self._target_centre)
        moved = position - self._centre
        self._setpoints = np.concatenate((self._setpoints[1:], self._setpoint[None] - self._target_centre))
        before = self._setpoints[self._behind]
        self._off += mean * ((moved[None, :, None] - before[:, None, :]) ** 2 - self._off)
        self._off_turned += mean * ((moved + before) ** 2 - self._off_turned)
        near = np.abs(position - self._setpoint) < self._elsewhere
        self._near_ns = np.where(near, now_ns, self._near_ns)
        # A drive that is set to be weak may stay behind.
        weak = self._limited & (command.effort_limit < 0.5 * self._limit)
        self._off[:, weak] = 0.0
        self._off_turned[:, weak] = 0.0
        off = np.sqrt(self._off.min(axis=0))
        own = np.diag(off)
        self._judged_s += passed_s
        far = (own >= self._elsewhere) & (self._judged_s >= MEAN_S)
        if not far.any():
            return None
        # As shares of the distance from the own set-point; the better explanation is named.
        scale = np.where(far, own, np.nan)
        turned = np.nan_to_num(np.sqrt(self._off_turned.min(axis=0)) / scale, nan=np.inf)
        fits = np.where(self._like, np.nan_to_num(off / scale[:, None], nan=np.inf), np.inf)
        exchanged = np.maximum(fits, fits.T)
        if exchanged.min() <= FITS and exchanged.min() <= turned.min():
            first, second = (int(k) for k in np.unravel_index(exchanged.argmin(), exchanged.shape))
            return self._unfollowed(
                np.isin(np.arange(len(own)), (first, second)),
                self._near_ns,
                f"joint {self._names[first]!r} does not follow: its reading fits the set-point of "
                f"{self._names[second]!r}, and that one's fits its own. The two are exchanged: in the order "
                "of joints, in cables or in ids",
            )
        if turned.min() <= TURNED_FITS:
            return self._unfollowed(
                turned <= TURNED_FITS,
                self._near_ns,
                f"joint {self._names[int(turned.argmin())]!r} does not follow: its reading is its set-point "
                "with the other sign. Its encoder or its direction is turned; correct it before the next run",
            )
        return None

    def _unfollowed(self, which: BoolArray, last_ns: IntArray, reason: str) -> Unfollowed:
        """Return what was found about some joints.

        Args:
            which: The joints, as a mask, (A,).
            last_ns: When each followed last, (A,) [ns].
            reason: As in the result.
        """
        names = tuple(name for name, hit in zip(self._names, which, strict=True) if hit)
        return Unfollowed(names, int(last_ns[which].min()), reason)
