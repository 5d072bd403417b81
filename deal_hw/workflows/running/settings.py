"""Options of collect, deploy and replay: how the robot is reached, and what a robot with legs needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from deal_hw.control.posture import PostureConfig
from deal_hw.description import RobotDescription
from deal_hw.drivers import default_transport, driver_description
from deal_hw.errors import ConfigurationError
from deal_hw.transport import WireOptions
from deal_hw.workflows.options import GO2, Checked, File, given, option, refuse
from deal_hw.workflows.robot import is_user_robot
from deal_hw.workflows.say import Say, silent


@dataclass(frozen=True, kw_only=True)
class LegOptions:
    """What a robot with legs needs to be told."""

    stand: bool | None = None
    """Stand up first and lie down at the end; by default where the robot has a rest pose."""

    velocity: str = "0,0,0"
    """Wanted velocity of a walking policy: ahead, left, turn as 0.3,0,0 [m/s, m/s, rad/s], or remote (the
    robot's own), keyboard, or a CSV file with the columns time_s,x,y,yaw."""

    hand_back: bool = False
    """Give the robot back to its own controller at the end (Go2: the sport service)."""

    stop_buttons: str = ""
    """Buttons of the robot's remote that make it passive while held together; by default the driver's (Go2:
    L2+B)."""

    support_check: bool = True
    """Refuse a go2 on a stand and a go2_on_stand on the floor; off only to try a policy in the air."""

    posture: PostureConfig = field(default_factory=PostureConfig)
    """How long standing up and lying down take."""


@dataclass(frozen=True, kw_only=True)
class LinkOptions(Checked):
    """How the robot is reached, beyond the port."""

    transport: str = ""
    """How the robot is reached. Cart-pole: serial (the default), can, odrive or dynamixel. Go2: dds (the
    default) or zenoh."""

    state_check: Annotated[Literal["strict", "length"], GO2] = "strict"
    """What the states of a Go2 must pass: strict, or length where its firmware or a simulator makes head or
    checksum by another rule; a state that was corrupted on the way is then taken for a true one."""

    simulator: Annotated[Literal["none", "unitree_mujoco"], GO2] = "none"
    """The simulator that runs in place of a Go2: unitree_mujoco, whose states lack head, clock, checksum and
    battery. A real robot is then refused."""

    record_wire: bool = True
    """Record the raw bytes, too."""

    wire: Annotated[WireOptions, GO2] = field(default_factory=WireOptions)
    """More about a network."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(Checked):
    """What every verb that runs a robot needs to be told."""

    port: str
    """Where the robot is: a serial port such as /dev/ttyUSB0, a CAN bus such as can0 or
    slcan:/dev/ttyACM0?bitrate=500000&node=1, a network interface (dds) or an endpoint such as
    tcp/127.0.0.1:7447 (zenoh)."""

    link: LinkOptions = field(default_factory=LinkOptions)
    """How the robot is reached, beyond the port."""

    legs: Annotated[LegOptions, GO2] = field(default_factory=LegOptions)
    """What a robot with legs needs to be told."""

    out: File | None = None
    """Run folder; the episodes go to OUT/dataset. Without OUT and DATASET deploy and replay record in
    runs/VERB_ROBOT; collect needs one of the two."""

    dataset: File | None = None
    """Dataset folder instead of OUT/dataset; new episodes are added to those that are there."""

    say: Say = silent
    """From Python: called with sentences on what happens; ``print`` shows them. By default warnings alone are
    told, on standard error."""


def refuse_unrecorded(options: RunOptions, record: bool) -> None:
    """Refuse options of a recording that is not to be made.

    Raises:
        ConfigurationError: There is one.
    """
    if not record:
        names = [name for name in ("out", "dataset") if getattr(options, name) is not None]
        wire = given(options.link, LinkOptions(), ["record_wire"])
        refuse([*map(option, names), *wire], "--no-record keeps nothing")


def plan_options(robot: str, link: LinkOptions, legs: LegOptions, *, walks: bool = True) -> dict[str, Any]:
    """Return the fields of a :class:`~deal_hw.workflows.running.plan.RunPlan` that follow from the options.

    Args:
        robot: The robot's name.
        link: How it is reached.
        legs: What a robot with legs is told.
        walks: Whether a policy runs that may be told a velocity.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver; or an option would be ignored.
    """
    if is_user_robot(robot):
        raise ConfigurationError(
            f"{robot}: deal-hw has no driver for this robot; page 'Add a robot or a method' of the "
            "documentation shows how to write one"
        )
    description = driver_description(robot)
    stands = _stands(description) if legs.stand is None else legs.stand
    if not description.rest_position:
        refuse(given(legs, LegOptions()), f"only robots with legs take that, and robot {robot!r} has none")
    if not walks:
        refuse(given(legs, LegOptions(), ["velocity"]), "no policy that walks runs here")
    if link.simulator != "none":
        refuse(
            [*given(link, LinkOptions(), ["state_check"]), *given(legs, LegOptions(), ["hand_back"])],
            f"{link.simulator} has neither checksums nor a controller of its own",
        )
    if not stands:
        refuse(given(legs, LegOptions(), ["posture"]), "the robot neither stands up nor lies down")
    return {
        "robot": robot,
        "transport": link.transport or default_transport(robot),
        "wire": link.wire,
        "record_wire": link.record_wire,
        "stand": stands,
        "velocity": legs.velocity,
        "hand_back": legs.hand_back,
        "posture": legs.posture,
        "robot_settings": _settings(link, legs),
    }


def _settings(link: LinkOptions, legs: LegOptions) -> dict[str, Any]:
    """Return the driver's own settings that were given; a driver without such a setting refuses it."""
    given: dict[str, Any] = {
        "stop_buttons": legs.stop_buttons,
        "support_check": legs.support_check,
        "state_check": link.state_check,
        "simulator": link.simulator,
    }
    default = {"stop_buttons": "", "support_check": True, "state_check": "strict", "simulator": "none"}
    return {name: value for name, value in given.items() if value != default[name]}


def _stands(description: RobotDescription) -> bool:
    return bool(description.rest_position) and description.floating_base is not None
