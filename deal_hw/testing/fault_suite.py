"""Every fault of a robot's table in every phase of a run, in virtual time."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, ClassVar

import pytest

from deal_hw.testing.fault_rows import FAULTS, PHASES, Expected, FaultRig, FaultTable, Lacks
from deal_hw.testing.fault_run import complaints, run_fault, run_sound


class FaultSuite:
    """What a robot does when something fails; inherit it, set ``table`` and override ``rig``.

    Attributes:
        table: The robot's faults.
    """

    table: ClassVar[FaultTable]

    @pytest.fixture
    def rig(self) -> FaultRig:
        """Return the emulated robot, just switched on."""
        raise NotImplementedError("a FaultSuite overrides the fixture `rig`")

    def marks(self, fault: str, phase: str) -> Collection[pytest.MarkDecorator]:
        """Return the marks of a cell's test; none by default."""
        return ()

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Make a test of each cell that the robot has."""
        if {"fault", "phase"} <= set(metafunc.fixturenames):
            cells = [
                pytest.param(fault, phase, marks=self.marks(fault, phase), id=f"{fault}, {phase}")
                for (fault, phase), cell in self.table.combinations().items()
                if isinstance(cell, Expected)
            ]
            metafunc.parametrize(("fault", "phase"), cells)

    def test_a_fault_ends_as_the_table_says(self, rig: FaultRig, fault: str, phase: str) -> None:
        """The drives are passive in time, confirmed, stay so, and the next run begins slowly."""
        cell: Any = self.table.combinations()[fault, phase]
        found = run_fault(rig, fault, phase)
        wrong = complaints(found, phase, cell, self.table)
        assert not wrong, "; ".join(wrong)

    def test_without_a_fault_the_run_comes_to_its_end(self, rig: FaultRig) -> None:
        """It goes through every phase that the robot has, and trips on nothing."""
        found = run_sound(rig)
        assert (found.outcome, found.flags, found.confirmed) == ("finished", (), True), found.reason
        had = [phase for phase in PHASES if not isinstance(self.table.phases.get(phase), Lacks)]
        assert [phase for phase in PHASES if phase in found.phases] == had

    def test_each_fault_has_a_row_or_a_reason(self) -> None:
        """No combination of fault and phase is forgotten; what the robot lacks says why."""
        cells = self.table.combinations()
        assert {(fault, phase) for fault in FAULTS for phase in PHASES} <= set(cells)
        assert [
            what for what, cell in cells.items() if isinstance(cell, Lacks) and not cell.why.strip()
        ] == []
