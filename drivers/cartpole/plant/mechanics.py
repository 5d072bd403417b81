"""The mechanics and sensors of an emulated cart-pole, without its firmware, computed tick by tick."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.cartpole.plant.profiles import profile as find_profile
from deal_hw.drivers.cartpole.plant.sensor import Motor, Reading, Sample, Sensor
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.sim.engine.single import SingleSimulation
from deal_hw.testing.joint_faults import FaultyJoints, JointFaults

HOMING_TICKS: Final = 500
START_ANGLE_RAD: Final = 0.03
_END_STOP_M = 0.399
_CART = 0


def build_simulation(parameters: Mapping[str, float]) -> SingleSimulation:
    """Return the mechanics with these parameters, named as in ``parameter_space()``."""
    sim = SingleSimulation(DESCRIPTION.mjcf)
    sim.set_body_mass("cart", parameters["cart.mass"])
    sim.set_body_mass("pole", parameters["pole.mass"])
    sim.set_dof("cart", frictionloss=parameters["cart.frictionloss"])
    sim.set_dof(
        "pole",
        damping=parameters["pole.damping"],
        frictionloss=parameters["pole.frictionloss"],
        armature=parameters["pole.armature"],
    )
    return sim


class Mechanics:
    """Cart, pole, their sensors, and a simulated hand that sets them.

    One tick of a device is: :meth:`motor`, :meth:`observe`, :meth:`read` where a report is due, :meth:`step`.
    At first the pole hangs. After :meth:`begin_homing` the hand moves cart and pole to the start pose, and
    holds them there until :meth:`release`.

    Attributes:
        homing: Whether the hand is moving them to the start pose.
        held: Whether it holds them there.
        joint_faults: Faults of the joints; their times count from the first :meth:`release`.

    Args:
        truth: Hidden parameters, latency, profile and seed.
        start_angle_rad: Start angle of the pole [rad]; None: within +-0.03 rad, by the seed.
        read_rate_hz: Rate at which :meth:`read` is called.
    """

    def __init__(
        self,
        truth: CartpoleTruth,
        *,
        start_angle_rad: float | None = None,
        read_rate_hz: float = DESCRIPTION.state_rate_hz,
    ) -> None:
        self.homing = self.held = False
        self.joint_faults = FaultyJoints(JointFaults(), DESCRIPTION.joint_names, (_CART,))
        self._ticks = 0
        self._profile = find_profile(truth.profile)
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([truth.seed, 0xCA47]).spawn(4)]
        self._hand_rng, sensor_rng, self._jitter_rng, self._drop_rng = streams
        self._sim = build_simulation(truth.parameters)
        self._sensor = Sensor(self._profile, truth.sensing_ticks, round(read_rate_hz), sensor_rng)
        self._actuation_ticks = truth.actuation_ticks
        own = truth.parameters
        self._friction_n = own["cart.frictionloss"]
        # Friction that falls with speed: a truth's own, or the profile's.
        self._stribeck_ratio = self._profile.stribeck_ratio
        if "cart.friction_stribeck" in own:
            self._stribeck_ratio = own["cart.friction_stribeck"] / self._friction_n
        self._stribeck_m_s = own.get("cart.stribeck_speed", self._profile.stribeck_speed_m_s)
        self._start_angle_rad = start_angle_rad
        self._motor_m = 0.0
        self._homing_from = (0.0, 0.0)
        self._homing_to = 0.0
        self._homing_ticks = 0
        self._sim.set_state((self._hand_rng.uniform(-0.1, 0.1), math.pi), (0.0, 0.0))
        self._now: tuple[list[float], list[float]] = self._sim.position(), self._sim.velocity()

    @property
    def timestep_s(self) -> float:
        """Length of a tick [s]."""
        return self._sim.timestep_s

    @property
    def position(self) -> tuple[float, float]:
        """True cart position and pole angle now [m, rad]; not reported."""
        cart, pole = self._sim.position()
        return cart, pole

    def motor(self) -> Motor:
        """Return the reading of the motor's own encoder, without delay; the play lies behind it."""
        self._now = self._sim.position(), self._sim.velocity()
        cart, play = self._now[0][_CART], self._profile.backlash_m / 2
        self._motor_m = min(max(self._motor_m, cart - play), cart + play)
        return Motor(self._motor_m, self._now[1][_CART])

    def truth_row(self) -> tuple[float, float, float, float]:
        """Return the state at the last :meth:`motor`: cart, pole [m, rad], and velocities [m/s, rad/s]."""
        (cart, pole), (cart_velocity, pole_velocity) = self._now
        return cart, pole, cart_velocity, pole_velocity

    def command_delay(self) -> int:
        """Return the delay of a command from reception to effect [ticks], drawn for each command."""
        jitter = self._profile.actuation_jitter_ticks
        return self._actuation_ticks + (int(self._jitter_rng.integers(0, jitter + 1)) if jitter else 0)

    def observe(self, setpoint: float) -> None:
        """Let the sensors sample the state at the last :meth:`motor`, and its set-point [m]."""
        _, pole, cart_velocity, pole_velocity = self.truth_row()
        self._sensor.observe(Sample(self._motor_m, cart_velocity, pole, pole_velocity, setpoint))

    def read(self) -> Reading:
        """Return the sensors' readings: delayed, noisy and quantised as in the profile."""
        seen = self._sensor.read()._replace(at_end_stop=abs(self._now[0][_CART]) >= _END_STOP_M)
        position, velocity = self.joint_faults.read(
            1e-6 * np.array((seen.cart_um, seen.pole_urad)),
            1e-6 * np.array((seen.cart_um_s, seen.pole_urad_s)),
        )
        cart, pole, cart_s, pole_s = (round(1e6 * value) for value in (*position, *velocity))
        return seen._replace(cart_um=cart, pole_urad=pole, cart_um_s=cart_s, pole_urad_s=pole_s)

    def loses_frame(self) -> bool:
        """Draw whether a state frame is lost."""
        share = self._profile.drop_probability
        return bool(share) and bool(self._drop_rng.random() < share)

    def begin_homing(self) -> None:
        """Begin to move cart and pole to the start pose by hand, in 500 ticks."""
        cart, pole = self._sim.position()
        self._homing_from = (cart, math.remainder(pole, math.tau))
        drawn = float(self._hand_rng.uniform(-START_ANGLE_RAD, START_ANGLE_RAD))
        self._homing_to = drawn if self._start_angle_rad is None else self._start_angle_rad
        self._homing_ticks = 0
        self._sim.set_state(self._homing_from, (0.0, 0.0))
        self._sensor.restart()
        self.homing, self.held = True, False

    def release(self) -> None:
        """Let go of cart and pole."""
        self.homing = self.held = False
        self.joint_faults.begin(self._now_ns)

    @property
    def _now_ns(self) -> int:
        return round(self._ticks * self.timestep_s * 1e9)

    def step(self, force: float) -> bool:
        """Hold a force on the cart for one tick [N]; return whether the hand reached the start pose."""
        self._ticks += 1
        self.joint_faults.advance(self._now_ns)
        if self.held or self.joint_faults.held:
            return False
        if self.joint_faults.limp:
            force = 0.0
        if self.homing:
            return self._move_home()
        if self._stribeck_ratio:
            speed = self._now[1][_CART] / self._stribeck_m_s
            excess = self._stribeck_ratio * math.exp(-(speed**2))
            self._sim.set_frictionloss(_CART, self._friction_n * (1.0 + excess))
        self._sim.step((force, 0.0))
        return False

    def _move_home(self) -> bool:
        self._homing_ticks += 1
        s = min(1.0, self._homing_ticks / HOMING_TICKS)
        blend = s * s * (3.0 - 2.0 * s)
        cart, pole = self._homing_from
        self._sim.set_state((cart * (1.0 - blend), pole + (self._homing_to - pole) * blend), (0.0, 0.0))
        self.held = s >= 1.0
        self.homing = not self.held
        return self.held
