"""The tables of robots and transports: every entry loads and agrees with itself, and loading stays light."""

import subprocess
import sys

import pytest

from deal_hw.clock import MonotonicClock
from deal_hw.errors import ConfigurationError, PortNotFoundError, UnknownNameError
from deal_hw.robot import Robot
from deal_hw.robots import default_transport, driver_description, robot_description, robots, transports
from deal_hw.robots.connect import adopt_robot, carries_topics, make_robot

pytestmark = pytest.mark.real_time

DRIVEN = {entry.name: [wire.name for wire in entry.wires] for entry in robots().entries() if entry.driven}


@pytest.mark.parametrize("name", DRIVEN)
def test_every_robot_is_described_under_its_name(name: str) -> None:
    """The description's name is the table's, its model is there, its digest is stable."""
    description = driver_description(name)
    assert description.name == name
    assert description.mjcf.is_file()
    assert description.digest() == driver_description(name).digest()


NOWHERE = {
    "serial": "/dev/ttyNOPE",
    "can": "slcan:/dev/ttyNOPE",
    "odrive": "slcan:/dev/ttyNOPE",
    "dds": "nope0",
    "zenoh": "tcp/127.0.0.1:1",
    "dynamixel": "/dev/does_not_exist?pole_id=3",
}
PAIRS = [(name, wire) for name, wires in DRIVEN.items() for wire in wires]


@pytest.mark.parametrize(("name", "transport"), PAIRS)
def test_every_pair_can_be_made_without_touching_the_port(name: str, transport: str) -> None:
    """Constructors do no I/O: a port that does not exist is noticed at connect."""
    robot = make_robot(name, transport, NOWHERE[transport], MonotonicClock())
    assert isinstance(robot, Robot)
    with pytest.raises(PortNotFoundError):
        robot.connect()


@pytest.mark.parametrize(("name", "transport"), PAIRS)
def test_descriptors_are_inherited_where_there_are_any(name: str, transport: str) -> None:
    """A serial port is adopted; a transport of topics says that each process opens its own."""
    if carries_topics(transport):
        with pytest.raises(ConfigurationError, match="make_robot"):
            adopt_robot(name, transport, 999, MonotonicClock())
    else:
        made = adopt_robot(name, transport, 999, MonotonicClock(), port=NOWHERE[transport])
        assert isinstance(made, Robot)


@pytest.mark.parametrize("name", DRIVEN)
def test_a_robot_says_how_it_is_reached(name: str) -> None:
    """The first of its transports is the default, and others are refused with the choice."""
    assert default_transport(name) == DRIVEN[name][0]
    for transport in set(transports().names()) - set(DRIVEN[name]):
        with pytest.raises(ConfigurationError, match=DRIVEN[name][0]):
            make_robot(name, transport, NOWHERE[transport], MonotonicClock())


def test_unknown_names_list_the_tables() -> None:
    """A typing error is answered with what exists."""
    with pytest.raises(UnknownNameError, match="known: cartpole"):
        make_robot("catpole", "serial", "x", MonotonicClock())
    with pytest.raises(UnknownNameError, match="known: serial"):
        make_robot("cartpole", "cereal", "x", MonotonicClock())
    with pytest.raises(UnknownNameError, match="known: cartpole"):
        robot_description("catpole")


def test_a_driver_loads_neither_torch_nor_mujoco_nor_scipy() -> None:
    """The robot's own computer has none of them."""
    code = (
        "import sys\n"
        "from deal_hw.clock import MonotonicClock\n"
        "from deal_hw.robots.connect import make_robot\n"
        "make_robot('cartpole', 'serial', 'x', MonotonicClock())\n"
        "print([m for m in ('torch', 'mujoco', 'scipy', 'pytest', 'rerun') if m in sys.modules])\n"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )
