"""A stand-in for the vendor's simulator unitree_mujoco: its bytes and its motors, in virtual time.

Facts, read from unitree_mujoco @ 0304726 (simulate_python/unitree_sdk2py_bridge.py and the C++ bridge of that
version): LowState carries q, dq and tau_est of twelve motors, quaternion, gyroscope and accelerometer, and
zeros elsewhere: no head, no tick, no checksum, no battery, no temperatures. A LowCmd becomes torques
once, at its reception, with the positions and velocities of that moment; they hold until the next LowCmd.
No service answers. A separate thread publishes states, even if the physics did not advance. Later
versions (@ 24b7a49) count a tick and compute the torques every millisecond; the rest is the same.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION, EFFORT_LIMIT_NM, JOINTS, LEGS, per_joint
from deal_hw.drivers.go2.descriptions.on_stand_recording import DESCRIPTION as RECORDED
from deal_hw.drivers.go2.messages.low_command import LowCommand, decode_low_command
from deal_hw.drivers.go2.messages.wire import SLOT
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.sim.legged.simulation import LeggedSimulation
from deal_hw.types import FloatArray

TICK_NS: Final = 1_000_000
PUBLISHED: Final = (topics.LOW_STATE,)
SUBSCRIBED: Final = (topics.LOW_COMMAND,)


class UnitreeMujoco:
    """The simulator without time and wire, as :class:`~deal_hw.drivers.go2.emulator.device.Go2Device`.

    Attributes:
        paused: Whether the physics stands still; states are still sent.
        talks: Whether states are sent.
        torque: Present motor torques, (12,) [N·m].
        command: The newest command; None before the first.
        commands: Number of received commands.

    Args:
        pose: Joint positions at the beginning, (12,) [rad].
        on_stand: Whether its body is held in the air.
        step_ms: Length of a physics step, and the time between two states [ms].
        settle_s: Time before time 0 in which it falls and comes to rest, without torques [s].
    """

    def __init__(
        self, pose: FloatArray, *, on_stand: bool = False, step_ms: int = 2, settle_s: float = 1.5
    ) -> None:
        mjcf = (RECORDED if on_stand else DESCRIPTION).mjcf
        self._step_ms = step_ms
        self._sim = LeggedSimulation(mjcf, JOINTS, [f"{leg}_foot" for leg in LEGS], step_ms * 1e-3)
        self._sim.set_pose(pose, 0.13)
        self._limit = np.array(per_joint(EFFORT_LIMIT_NM))
        self._tick = 0
        self.paused, self.talks = False, True
        self.command: LowCommand | None = None
        self.commands = 0
        self.torque = self._measured = np.zeros(12)
        for _ in range(round(settle_s * 1e3 / step_ms)):
            self._step()

    @property
    def device_ns(self) -> int:
        """Time at which the next tick runs [ns]."""
        return self._tick * TICK_NS

    @property
    def position(self) -> FloatArray:
        """The joints' true positions, (12,) [rad]."""
        return self._sim.position()

    @property
    def velocity(self) -> FloatArray:
        """The joints' true velocities, (12,) [rad/s]."""
        return self._sim.velocity()

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Compute the torques of a command, once."""
        if topic != topics.LOW_COMMAND:
            return
        self.command = c = decode_low_command(payload)
        self.commands += 1
        wish = (
            c.effort + c.stiffness * (c.position - self.position) + c.damping * (c.velocity - self.velocity)
        )
        self.torque = np.clip(wish, -self._limit, self._limit)

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one millisecond; return the states sent in it."""
        out = []
        if self._tick % self._step_ms == 0:
            if not self.paused:
                self._step()
            if self.talks:
                out = [(topics.LOW_STATE, self.state())]
        self._tick += 1
        return out

    def state(self) -> bytes:
        """Return the present LowState, 1180 bytes."""
        buffer = bytearray(layout.LOW_STATE_BYTES)
        buffer[:4] = CDR_HEADER
        record = np.frombuffer(buffer, layout.LOW_STATE)[0]
        values: dict[str, Any] = {"q": self.position, "dq": self.velocity, "tau_est": self._measured}
        for name, value in values.items():
            record["motor"][name][SLOT] = value
        record["quaternion"] = self._sim.orientation()
        record["gyroscope"] = self._sim.angular_velocity()
        record["accelerometer"] = self._sim.specific_force()
        return bytes(buffer)

    def _step(self) -> None:
        # A force sensor's value is that of the last step, so it stays constant in a pause.
        self._measured = self.torque
        self._sim.step(self.torque)
