"""The fault table of each robot with a driver holds in front of its emulator, in virtual time."""

from __future__ import annotations

from collections.abc import Collection
from typing import ClassVar

import pytest
from virtual_fleet import fleet

from deal_hw.drivers.b2.fault_rows import B2, B2_ON_STAND
from deal_hw.drivers.cartpole import fault_rows as cartpole
from deal_hw.drivers.g1.fault_rows import G1
from deal_hw.drivers.go2.fault_rows import GO2, GO2_ON_STAND
from deal_hw.drivers.h1.fault_rows import H1
from deal_hw.drivers.ros2 import fault_rows as ros2
from deal_hw.drivers.servo_arm import fault_rows as arm
from deal_hw.drivers.so101.fault_rows import SO101
from deal_hw.testing.fault_rows import (
    BOTH_KILLED,
    CLOCK_AHEAD,
    CLOCK_BACK,
    CONTROL_KILLED,
    CONTROLLER_OFF,
    CUT,
    DUPLICATE,
    EXCHANGED,
    FAULTS,
    FOREIGN,
    FROZEN,
    LIMP,
    OUT_OF_RANGE,
    PHASES,
    RUNNING,
    SUPERVISOR_KILLED,
    FaultRig,
)
from deal_hw.testing.fault_suite import FaultSuite


class FleetFaults(FaultSuite):
    """A robot of the virtual fleet.

    Attributes:
        quick: Faults in the middle of a run that `make test` has; the other cells are slow.
        part: Which part of the other cells `make test-slow` has, and of how many. Robots that share a driver
            have different parts, of Unitree's robots half of all. `tools/fault_matrix.py` runs all cells.
    """

    quick: ClassVar[Collection[str]] = ()
    part: ClassVar[tuple[int, int]] = (0, 1)

    @pytest.fixture
    def rig(self) -> FaultRig:
        """Return the emulated robot, just switched on."""
        return fleet()[self.table.name].fault_rig()

    def marks(self, fault: str, phase: str) -> Collection[pytest.MarkDecorator]:
        """Return that a cell is slow, if it is."""
        if phase == RUNNING and fault in self.quick:
            return ()
        mine, parts = self.part
        # Along diagonals, so that each part has each fault and each phase.
        if (FAULTS.index(fault) + PHASES.index(phase)) % parts == mine:
            return (pytest.mark.slow,)
        return (pytest.mark.slow, pytest.mark.skip(reason="a run of tools/fault_matrix.py has this cell"))

    @pytest.mark.slow
    def test_without_a_fault_the_run_comes_to_its_end(self, rig: FaultRig) -> None:
        """It goes through every phase that the robot has, and trips on nothing."""
        super().test_without_a_fault_the_run_comes_to_its_end(rig)


class TestCartpoleSerial(FleetFaults):
    table = cartpole.SERIAL
    quick = (FOREIGN, BOTH_KILLED)


class TestCartpoleCan(FleetFaults):
    table = cartpole.CAN
    quick = (CLOCK_AHEAD,)


class TestCartpoleOdrive(FleetFaults):
    table = cartpole.ODRIVE
    quick = (CUT,)


class TestCartpoleDynamixel(FleetFaults):
    table = cartpole.DYNAMIXEL
    quick = (DUPLICATE,)


class TestSO101(FleetFaults):
    table = SO101
    quick = (CONTROL_KILLED,)
    part = (0, 3)


class TestArmFeetech(FleetFaults):
    table = arm.FEETECH
    quick = (EXCHANGED,)
    part = (1, 3)


class TestArmDynamixel(FleetFaults):
    table = arm.DYNAMIXEL
    quick = (LIMP,)
    part = (2, 3)


class TestRos2Position(FleetFaults):
    table = ros2.POSITION
    quick = (CONTROLLER_OFF,)
    part = (0, 2)


class TestRos2Trajectory(FleetFaults):
    table = ros2.TRAJECTORY
    quick = (LIMP,)
    part = (1, 2)


class TestGo2(FleetFaults):
    table = GO2
    quick = (SUPERVISOR_KILLED,)
    part = (0, 12)


class TestGo2OnStand(FleetFaults):
    table = GO2_ON_STAND
    quick = (CONTROLLER_OFF,)
    part = (1, 12)


class TestB2(FleetFaults):
    table = B2
    quick = (CUT,)
    part = (2, 12)


class TestB2OnStand(FleetFaults):
    table = B2_ON_STAND
    quick = (FROZEN,)
    part = (3, 12)


class TestG1(FleetFaults):
    table = G1
    quick = (OUT_OF_RANGE,)
    part = (4, 12)


class TestH1(FleetFaults):
    table = H1
    quick = (CLOCK_BACK,)
    part = (5, 12)


def test_each_robot_of_the_fleet_inherits_the_suite() -> None:
    """And with the table that the fleet's robot has."""
    tested = {one.table.name: one for one in FleetFaults.__subclasses__()}
    assert {name: one.table for name, one in tested.items()} == {
        name: one.faults for name, one in fleet().items()
    }


def test_each_fault_is_in_the_quick_tests_of_a_robot() -> None:
    """So `make test` has every kind of fault, if not in every phase."""
    assert set(FAULTS) == {fault for one in FleetFaults.__subclasses__() for fault in one.quick}


def test_robots_with_the_same_driver_have_different_cells() -> None:
    """So that the parts of a driver's robots have as many cells as they can."""
    parts = [one.part for one in FleetFaults.__subclasses__() if one.part[1] > 1]
    assert len(set(parts)) == len(parts)
