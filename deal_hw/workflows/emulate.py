"""``deal_hw.emulate``: a simulated robot that speaks the real robot's protocol."""

from __future__ import annotations

import json
from typing import Any

from deal_hw.workflows.emulation.process import EmulatorProcess, arguments
from deal_hw.workflows.emulation.settings import EMULATE, EmulateSettings
from deal_hw.workflows.options import from_settings, refuse


class EmulatedRobot(EmulatorProcess):
    """A robot that is emulated in its own process; a context manager.

    Attributes:
        robot: Its name.
        port: Its port, while it is emulated.
        truth: Its hidden parameters and the events, by name; empty until the end.
    """

    def __init__(self, settings: EmulateSettings) -> None:
        default = type(settings)(settings.robot)
        super().__init__(settings.robot, "--reveal", *arguments(settings, default))
        self.robot = settings.robot
        self.truth: dict[str, Any] = {}

    def stop(self, timeout_s: float = 10.0) -> tuple[str, str]:
        """Stop the emulator; return its output after the first line, and its messages."""
        out, errors = super().stop(timeout_s)
        revealed = [line for line in out.splitlines() if line.startswith("{")]
        if revealed:
            self.truth = json.loads(revealed[-1])
        return out, errors

    def __repr__(self) -> str:
        return f"<emulated {self.robot}{f' on {self.port}' if self.port else ', not started'}>"


@from_settings(EMULATE)
def emulate(settings: EmulateSettings) -> EmulatedRobot:
    """Emulate a robot in real time on its own port, with hidden physics, as ``deal-hw emulate``.

    ``deal-hw emulate ROBOT --help`` describes the arguments::

        with deal_hw.emulate("cartpole", seed=1) as robot:
            deal_hw.collect("cartpole", port=robot.port, out="runs/first")
        print(robot.truth["parameters"])

    Returns:
        The robot, which runs from the start to the end of the ``with`` block.

    Raises:
        UnknownNameError: There is no such robot or wire.
        ConfigurationError: A setting is unusable.
    """
    refuse(["--reveal"] if settings.reveal else [], "the robot's attribute truth has it at the end")
    refuse(["--parent"] if settings.parent is not None else [], "this process is the parent")
    return EmulatedRobot(settings)
