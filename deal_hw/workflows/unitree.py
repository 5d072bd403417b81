"""Options that the verbs share for the robots of Unitree: the network, and how a driver checks states."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from deal_hw.transport import WireOptions


@dataclass(frozen=True, kw_only=True)
class UnitreeLink:
    """The connection to a robot of Unitree."""

    transport: Literal["dds", "zenoh"] = "dds"
    """The transport."""

    wire: WireOptions = field(default_factory=WireOptions)
    """Network options."""

    def driver_settings(self) -> dict[str, str]:
        """Return the given settings of the driver."""
        return {}


@dataclass(frozen=True, kw_only=True)
class UnitreeGoLink(UnitreeLink):
    """The connection to a robot with the messages unitree_go: a Go2, a B2 or an H1."""

    state_check: Literal["strict", "length"] = "strict"
    """How to check the state messages: strict (length, head and checksum), or length alone, for firmware or
    simulators with another head or checksum. With length alone corrupted states are not detected."""

    def driver_settings(self) -> dict[str, str]:
        """Return the given settings of the driver."""
        return {} if self.state_check == "strict" else {"state_check": self.state_check}


@dataclass(frozen=True, kw_only=True)
class Go2Link(UnitreeGoLink):
    """The connection to a Go2."""

    wire: WireOptions = field(default_factory=WireOptions)
    """Network options. A bridge admits commands under a controller's certificate only."""

    simulator: Literal["none", "unitree_mujoco"] = "none"
    """The simulator that runs in place of a Go2: unitree_mujoco, whose states lack head, clock, checksum and
    battery. A real robot is then refused."""

    def driver_settings(self) -> dict[str, str]:
        """Return the given settings of the driver."""
        own = {} if self.simulator == "none" else {"simulator": self.simulator}
        return {**super().driver_settings(), **own}
