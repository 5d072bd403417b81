"""Options of collect, deploy and replay: the connection, robots with legs, and simulated robots."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.motions.posture import PostureConfig
from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.ranges import Checked, Range, option
from deal_hw.robots import default_transport, driver_description, no_driver
from deal_hw.workflows.options import FROM_PYTHON, File, Ratio, Seed, given, refuse
from deal_hw.workflows.robot import named
from deal_hw.workflows.say import Say, silent
from deal_hw.workflows.unitree import Go2Link, UnitreeGoLink, UnitreeLink


@dataclass(frozen=True, kw_only=True)
class StandOptions:
    """Options of a robot with legs."""

    stand: bool | None = None
    """Whether to stand up first and lie down at the end; by default True if the robot has a rest pose. A
    recording that did both is replayed without."""

    hand_back: bool = False
    """Return the robot to its own controller at the end (Go2 and B2: the sport service)."""

    stop_buttons: str = ""
    """Buttons of the robot's remote that, held together, make the robot passive; by default the driver's
    (Go2 and B2: L2+B)."""

    support_check: bool = True
    """Refuse a go2 or b2 on a stand, and a go2_on_stand or b2_on_stand on the floor. Switch off only to try a
    policy in the air."""

    posture: PostureConfig = field(default_factory=PostureConfig)
    """Durations of standing up and lying down."""


@dataclass(frozen=True, kw_only=True)
class LegOptions(StandOptions):
    """Options of a robot with legs that may walk."""

    velocity: str = "0,0,0"
    """Requested velocity of a walking policy: ahead, left, turn, such as 0.3,0,0 [m/s, m/s, rad/s]; or remote
    (the robot's own), keyboard, or a CSV file with the columns time_s,x,y,yaw."""

    hold_heading: bool = False
    """Correct the requested turn by the robot's inertial sensor, so that the robot keeps its heading."""

    obstacle: str = "0,0"
    """A platform ahead, for a policy that observes one: its distance from the base and its height when the
    policy begins, such as 1,0.15 [m, m]; 0,0 says nothing."""


@dataclass(frozen=True, kw_only=True)
class LinkOptions(Checked):
    """The connection to the robot, beyond the port."""

    transport: str = ""
    """The transport; by default the robot's usual one."""

    record_wire: bool = True
    """Also record the raw bytes."""


@dataclass(frozen=True, kw_only=True)
class CartpoleLinkOptions(LinkOptions):
    """The connection to a cart-pole, beyond the port."""

    transport: Literal["serial", "can", "odrive", "dynamixel"] = "serial"
    """The transport."""


@dataclass(frozen=True, kw_only=True)
class UnitreeLinkOptions(UnitreeLink, LinkOptions):
    """The connection to a robot of Unitree, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class B2LinkOptions(UnitreeGoLink, UnitreeLinkOptions):
    """The connection to a B2, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class Go2LinkOptions(Go2Link, UnitreeLinkOptions):
    """The connection to a Go2, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class G1LinkOptions(UnitreeLinkOptions):
    """The connection to a G1, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class H1LinkOptions(UnitreeGoLink, UnitreeLinkOptions):
    """The connection to an H1, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class CraneOptions:
    """Options of a robot that must hang on a crane."""

    hung_on_crane: bool = False
    """Confirm that the robot hangs on a crane, feet free, nobody in reach. Without it the question is asked
    on a terminal, and elsewhere the run is refused. No sensor tells it. Every end of a run is damping, in
    which a robot on the floor falls."""

    stop_buttons: str = ""
    """Buttons of the robot's remote that, held together, make the robot passive; by default L2+B."""


@dataclass(frozen=True, kw_only=True)
class RecordOptions(Checked):
    """Where a run is recorded."""

    out: File | None = None
    """Run folder; the episodes go to OUT/dataset. `collect` needs it, or --dataset. By default `deploy`
    records in runs/deploy_ROBOT, `replay` in runs/replay_ROBOT."""

    dataset: File | None = None
    """Dataset folder instead of OUT/dataset; new episodes are added to it."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """From Python: called with messages; ``print`` shows them. By default only warnings are printed, on
    standard error."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(RecordOptions):
    """Options of every verb that runs a robot."""

    port: str
    """The robot's port, such as a serial port or an end point of a network."""

    link: LinkOptions = field(default_factory=LinkOptions)
    """The connection to the robot, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class CartpoleRunOptions(RunOptions):
    """Options of every verb that runs a cart-pole."""

    port: str
    """The robot's port: a serial port such as /dev/ttyUSB0, or a CAN bus such as can0 or
    slcan:/dev/ttyACM0?bitrate=500000&node=1."""

    link: CartpoleLinkOptions = field(default_factory=CartpoleLinkOptions)
    """The connection to the robot, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class UnitreeRunOptions(RunOptions):
    """Options of every verb that runs a robot of Unitree."""

    port: str
    """The robot's port: a network interface such as enp2s0 (dds), or an end point such as
    tcp/127.0.0.1:7447 (zenoh)."""

    link: UnitreeLinkOptions = field(default_factory=UnitreeLinkOptions)
    """The connection to the robot, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class Go2RunOptions(UnitreeRunOptions):
    """Options of every verb that runs a Go2."""

    link: Go2LinkOptions = field(default_factory=Go2LinkOptions)
    """The connection to the robot, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class B2RunOptions(UnitreeRunOptions):
    """Options of every verb that runs a B2."""

    link: B2LinkOptions = field(default_factory=B2LinkOptions)
    """The connection to the robot, beyond the port."""


@dataclass(frozen=True, kw_only=True)
class G1RunOptions(UnitreeRunOptions):
    """Options of every verb that runs a G1."""

    link: G1LinkOptions = field(default_factory=G1LinkOptions)
    """The connection to the robot, beyond the port."""

    crane: CraneOptions = field(default_factory=CraneOptions)
    """Options of a robot that must hang on a crane."""


@dataclass(frozen=True, kw_only=True)
class H1RunOptions(UnitreeRunOptions):
    """Options of every verb that runs an H1."""

    link: H1LinkOptions = field(default_factory=H1LinkOptions)
    """The connection to the robot, beyond the port."""

    crane: CraneOptions = field(default_factory=CraneOptions)
    """Options of a robot that must hang on a crane."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(Checked):
    """Hidden truth of a simulated robot; noise and step of its sensors are those of robot.yaml."""

    simulated: bool = False
    """Record a simulation of the robot of a robot.yaml, with hidden parameters, faster than real time. Needs
    no robot and no --port."""

    truth_seed: Seed = 0
    """Simulated: seed of the hidden parameters and the noise."""

    truth_ratio: Annotated[float, Ratio] = 1.5
    """Simulated: hidden parameters lie within this factor of the MJCF's."""

    truth_latency: Annotated[float, Range(0, LONGEST_LATENCY_S, "s")] = 0.005
    """Simulated: delay from a command to its effect [s]."""

    reveal_to: File | None = None
    """Simulated: write the hidden truth to this JSON file."""


def legs_of(options: RunOptions) -> StandOptions | None:
    """Return the options of a robot with legs; None for a robot without."""
    legs: StandOptions | None = getattr(options, "legs", None)
    return legs


def crane_of(options: RunOptions) -> CraneOptions | None:
    """Return the options of a robot that must hang on a crane; None for another robot."""
    crane: CraneOptions | None = getattr(options, "crane", None)
    return crane


def require_simulation(robot: str, options: SimulationOptions) -> None:
    """Check that the simulation of a user's robot is asked for: the robot itself has no driver.

    Raises:
        ConfigurationError: It is not.
    """
    if not options.simulated:
        raise ConfigurationError(no_driver(robot))


def refuse_unrecorded(options: RunOptions, record: bool) -> None:
    """Refuse recording options if nothing is recorded.

    Raises:
        ConfigurationError: At least one was given.
    """
    if not record:
        names = [name for name in ("out", "dataset") if getattr(options, name) is not None]
        wire = given(options.link, LinkOptions, ["record_wire"])
        refuse([*map(option, names), *wire], "--no-record writes no file")


def plan_options(
    robot: str,
    link: LinkOptions,
    legs: StandOptions | None = None,
    *,
    crane: CraneOptions | None = None,
    walks: bool = True,
) -> dict[str, Any]:
    """Return the fields of a :class:`~deal_hw.workflows.running.plan.RunPlan` that follow from the options.

    Args:
        robot: The robot's name.
        link: The connection.
        legs: Options of a robot with legs; None for a robot without.
        crane: Options of a robot that must hang on a crane; None for another.
        walks: Whether a policy runs that takes a requested velocity.

    Raises:
        UnknownNameError: There is no such robot.
        ConfigurationError: It has a description, but no driver; or an option would have no effect.
    """
    description = driver_description(robot)
    options = {
        "robot": named(robot),
        "transport": link.transport or default_transport(robot),
        "record_wire": link.record_wire,
        "robot_settings": _settings(link, legs, crane),
    }
    if isinstance(link, UnitreeLink):
        options["wire"] = link.wire
    if legs is None:
        return {**options, "stand": False}
    stands = _stands(description) if legs.stand is None else legs.stand
    if isinstance(legs, LegOptions):
        if not walks:
            names = ["velocity", "hold_heading", "obstacle"]
            refuse(given(legs, LegOptions(), names), "no walking policy runs here")
        options["velocity"], options["obstacle"] = legs.velocity, legs.obstacle
        options["hold_heading"] = legs.hold_heading
    if isinstance(link, Go2LinkOptions) and link.simulator != "none":
        refuse(
            [*given(link, Go2LinkOptions(), ["state_check"]), *given(legs, StandOptions(), ["hand_back"])],
            f"{link.simulator} has neither checksums nor a controller of its own",
        )
    if not stands:
        refuse(given(legs, StandOptions(), ["posture"]), "the robot neither stands up nor lies down")
    return {**options, "stand": stands, "hand_back": legs.hand_back, "posture": legs.posture}


def _settings(link: LinkOptions, legs: StandOptions | None, crane: CraneOptions | None) -> dict[str, Any]:
    """Return the given settings of the driver; a driver without such a setting refuses it."""
    own: tuple[tuple[Any, Any, tuple[str, ...]], ...] = (
        (legs, StandOptions, ("stop_buttons", "support_check")),
        (crane, CraneOptions, ("stop_buttons", "hung_on_crane")),
    )
    given_here = {
        name: getattr(options, name)
        for options, settings, names in own
        if isinstance(options, settings)
        for name in names
        if getattr(options, name) != getattr(settings, name)
    }
    return {**given_here, **(link.driver_settings() if isinstance(link, UnitreeLink) else {})}


def _stands(description: RobotDescription) -> bool:
    return bool(description.rest_position) and description.floating_base is not None
