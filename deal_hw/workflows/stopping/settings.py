"""The settings of ``deal-hw stop``, and the robots that they are for."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Literal

from deal_hw.ranges import Checked, Range
from deal_hw.robots import is_file
from deal_hw.transport import WireOptions
from deal_hw.workflows.kinds import Arguments
from deal_hw.workflows.options import FROM_PYTHON, given, refuse
from deal_hw.workflows.robot_kinds import FILE, robot_kind, robot_kinds
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.unitree import Go2Link, UnitreeGoLink, UnitreeLink


@dataclass(frozen=True, kw_only=True)
class StopSettings(Checked):
    """Make a robot passive at once, from any terminal: motor off, or damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """

    robot: str = field(kw_only=False)
    """The robot, such as go2."""

    port: str = ""
    """The robot's port, as for deploy. Without it, every run of this robot on this computer is stopped. With
    it, that robot alone, and also one that no run commands any more."""

    transport: str = ""
    """Transport to the robot; by default the robot's usual one."""

    seconds: Annotated[float, Range(0.5, 600, "s")] = 10.0
    """How long to repeat the passive command until the robot confirms it [s]."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """From Python: called with messages; ``print`` shows them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.port:
            kind = type(self)
            names = [
                name for name in ("transport", "seconds", "state_check", "simulator") if hasattr(kind, name)
            ]
            wire = given(wire_of(self), WireOptions())
            refuse(
                [*given(self, kind, names), *wire], "without --port only runs on this computer are stopped"
            )


@dataclass(frozen=True, kw_only=True)
class StopCartpoleSettings(StopSettings):
    """Make a cart-pole passive at once, from any terminal: motor off. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program has the robot. The exit code is 0 only if the
    robot confirmed that it is passive.
    """

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """Transport to the cart-pole."""


@dataclass(frozen=True, kw_only=True)
class StopGo2Settings(Go2Link, StopSettings):
    """Make a Go2 passive at once, from any terminal: damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopB2Settings(UnitreeGoLink, StopSettings):
    """Make a B2 passive at once, from any terminal: damping. Nothing is asked.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopG1Settings(UnitreeLink, StopSettings):
    """Make a G1 passive at once, from any terminal: damping. Nothing is asked. On the floor it falls.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


@dataclass(frozen=True, kw_only=True)
class StopH1Settings(UnitreeGoLink, StopSettings):
    """Make an H1 passive at once, from any terminal: damping. Nothing is asked. On the floor it falls.

    A run on this computer is told to end and makes its robot passive itself. Without a run, give --port: this
    program then does it. It sends nothing while another program or the robot's own controller has the robot.
    The exit code is 0 only if the robot confirmed that it is passive.
    """


def _kind(arguments: Arguments) -> str:
    name = str(arguments.first or "")
    # A robot.yaml is read only where this program reaches the robot: a run of it is found by its path.
    return FILE if is_file(name) else robot_kind(name, arguments.options, simulates=False)


def wire_of(settings: StopSettings) -> WireOptions:
    """Return the network options; the usual ones of a robot that has none."""
    return settings.wire if isinstance(settings, UnitreeLink) else WireOptions()


STOP = dataclasses.replace(
    robot_kinds(
        {
            "cartpole": StopCartpoleSettings,
            "go2": StopGo2Settings,
            "b2": StopB2Settings,
            "g1": StopG1Settings,
            "h1": StopH1Settings,
        },
        plain=StopSettings,
        legged=StopSettings,
        example="--port {port}",
    ),
    find=_kind,
)
"""The kinds of :func:`stop`."""
