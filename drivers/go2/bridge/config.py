"""Settings of the bridge."""

from __future__ import annotations

from dataclasses import dataclass

from deal_hw.drivers.go2.descriptions.driver import DRIVER, LEG_LIMITS, WIRE_HZ
from deal_hw.errors import ConfigurationError

_LOOKS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeConfig:
    """What the bridge admits, and when it damps."""

    command_age_s: float = LEG_LIMITS.command_age_s
    """A command is refused where the state that its sender acted on is older than this, and the robot is
    damped after so long without an admitted command [s]. Both ways over the network are part of the age."""
    margin_s: float = 0.008
    """Silence counts so long before the limit, so that the robot is damped within it: looks are 2 ms apart
    and may be late, and the way takes time [s]. With 6 ms, 1 of 100 cut links was damped 1.2 ms after it."""
    effort_margin: float = 2.0
    """Largest torque that a command may ask for now, kp (q* - q) + kd (dq* - dq) + tau, in multiples of what
    the driver's own filter allows at 50 Hz (23.5 N·m): joints move on between two of its cycles."""
    release_s: float = 1.0
    """A controller that went passive and is silent for so long has left, and another one may follow [s]."""
    rate_hz: float = WIRE_HZ
    """Rate of the damping commands, and of looking for silence [Hz]."""
    status_s: float = 0.2
    """How often clients are told who commands the robot; a change is told at once [s]."""
    listen_s: float = 0.1
    """How long nobody on the robot's side may have commanded the motors before the bridge damps at its start
    [s]."""
    leave_s: float = 0.1
    """How long damping goes on when the bridge is told to end [s]."""

    def __post_init__(self) -> None:
        allowed = {
            "command_age_s": (0.01, 0.5),
            "margin_s": (1e-4, 0.1),
            "effort_margin": (1.0, 10.0),
            "release_s": (0.1, 60.0),
            "rate_hz": (50.0, 1000.0),
            "status_s": (0.02, 5.0),
            "listen_s": (0.001, 5.0),
            "leave_s": (0.001, 5.0),
        }
        for name, (low, high) in allowed.items():
            if not low <= (value := getattr(self, name)) <= high:
                raise ConfigurationError(f"BridgeConfig.{name} is {value!r}; allowed: {low:g} to {high:g}")
        if (self.command_age_s - self.margin_s) * self.rate_hz < _LOOKS:
            raise ConfigurationError(
                f"--command-age-s {self.command_age_s:g} less --margin-s {self.margin_s:g}, with --rate-hz "
                f"{self.rate_hz:g}: silence is looked for less than {_LOOKS} times within it; choose a "
                "longer limit or a higher rate"
            )


DESCRIPTION = DRIVER
"""The robot whose limits hold."""
