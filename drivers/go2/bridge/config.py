"""Settings of the bridge."""

from __future__ import annotations

from dataclasses import dataclass

from deal_hw.drivers.go2.descriptions.driver import DRIVER, LEG_LIMITS, WIRE_HZ
from deal_hw.errors import ConfigurationError

_LOOKS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeConfig:
    """Which commands the bridge admits, and when it damps the robot."""

    command_age_s: float = LEG_LIMITS.command_age_s
    """A command is refused if it is based on a state older than this. The robot is damped after this time
    without an admitted command [s]. The age includes both ways over the network."""
    margin_s: float = 0.008
    """The robot is damped this long before the limit, so that damping acts within it: checks are 2 ms apart
    and may be late, and the way to the robot takes time [s]. With 6 ms, 1 of 100 cuts was damped 1.2 ms after
    the limit."""
    effort_margin: float = 2.0
    """Largest torque that a command may request, kp (q* - q) + kd (dq* - dq) + tau, in multiples of the limit
    of the driver's own filter (23.5 N·m). It exceeds 1 since joints move between two cycles of that filter at
    50 Hz."""
    release_s: float = 1.0
    """After this time of silence, a passive controller counts as gone, and another one may take over [s]."""
    rate_hz: float = WIRE_HZ
    """Rate of the damping commands, and of the checks for silence [Hz]."""
    status_s: float = 0.2
    """Time between two messages to clients on who commands the robot; a change is sent at once [s]."""
    listen_s: float = 0.1
    """At its start the bridge damps only after this time without motor commands on the robot's side [s]."""
    leave_s: float = 0.1
    """How long damping continues at the end of the bridge [s]."""

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
                f"--command-age-s {self.command_age_s:g} minus --margin-s {self.margin_s:g}, with "
                f"--rate-hz {self.rate_hz:g}: silence would be checked less than {_LOOKS} times in it; "
                "choose a longer limit or a higher rate"
            )


DESCRIPTION = DRIVER
"""The robot whose limits hold."""
