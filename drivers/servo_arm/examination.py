"""Checks an arm's servos before any motion: which ones answer, their models and settings. Changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

from deal_hw.description import RobotDescription
from deal_hw.drivers.servo_arm.families import Family
from deal_hw.drivers.servo_bus.interface import Answer, ServoBus
from deal_hw.errors import (
    ConfigurationError,
    DealHwError,
    FrameError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.sim.robots.hardware_section import HardwareSection, ServoEntry

T = TypeVar("T")

_TRIES: Final = 5
"""Attempts of a request with corrupt answers; with 5 % corrupt answers all fail once in 10**6."""
_LISTEN_S: Final = 0.1
_MOST_SHARE: Final = 0.5
"""Share of a state's period that one sample and one command may take on the wire; the rest is for delays."""


@dataclass(frozen=True, slots=True)
class ArmInfo:
    """What the servos report about themselves.

    Attributes:
        servos: One phrase a servo.
    """

    servos: str


class ArmExamination:
    """The checks.

    Args:
        bus: The bus, open.
        family: The servos' kind.
        hardware: The servos.
        description: The robot.
        where: The port, for messages.
        source: Where ids and models stand, for messages.
    """

    def __init__(
        self,
        bus: ServoBus,
        family: Family,
        hardware: HardwareSection,
        description: RobotDescription,
        where: str,
        source: str = "robot.yaml",
    ) -> None:
        self._bus, self._family, self._hardware = bus, family, hardware
        self._description, self._where, self._source = description, where, source

    def run(self) -> ArmInfo:
        """Return what was found; raises as :meth:`presence` and :meth:`settings`."""
        return self.settings(self.presence())

    def presence(self) -> dict[int, Answer]:
        """Return the servos' answers to a ping, by id.

        Raises:
            TransportTimeoutError: A servo is silent.
            WrongDeviceError: A servo is of another model.
            VersionMismatchError: A servo's protocol or firmware is too old.
            ConfigurationError: The bus is too slow.
        """
        self._check_speed()
        found: dict[int, Answer] = {}
        for servo in self._hardware.servos:
            answer = self._try(partial(self._bus.ping, servo.id))
            if answer is not None:
                found[servo.id] = answer
            if problem := self._family.version_problem(self._bus, servo.id, answer):
                raise VersionMismatchError(f"{self._where}: servo {servo.id} ({servo.joint}) {problem}")
        missing = [servo for servo in self._hardware.servos if servo.id not in found]
        if missing:
            raise self._absent(missing, found)
        for servo in self._hardware.servos:
            self._check_model(servo, found[servo.id])
        return found

    def settings(
        self, found: Mapping[int, Answer], limits: Mapping[int, tuple[int, int]] | None = None
    ) -> ArmInfo:
        """Check the servos' settings.

        Args:
            found: Their answers.
            limits: Lowest and highest goal of a servo, by id [ticks], where it is narrower than the
                description's.

        Raises:
            TransportTimeoutError: A servo fell silent.
            ConfigurationError: A servo has other settings; the message says which.
        """
        phrases = []
        for servo in self._hardware.servos:
            low, high = sorted(servo.ticks(angle) for angle in self._range(servo))
            least, most = (limits or {}).get(servo.id, (low, high))
            checked = partial(self._checked, servo.id, max(low, least), min(high, most))
            self.surely(servo, checked)
            model = self._family.model_name(found[servo.id].model)
            phrases.append(f"{servo.joint}: servo {servo.id}, {model}, firmware {found[servo.id].firmware}")
        if self._bus.echoes:
            phrases.append("the adapter returns this computer's own packets, which are left out")
        return ArmInfo("; ".join(phrases))

    def _check_speed(self) -> None:
        count = len(self._hardware.servos)
        need_s = self._family.cycle_s(self._bus, count, self._hardware.baud_rate)
        period_s = 1 / self._description.state_rate_hz
        if need_s > _MOST_SHARE * period_s:
            raise ConfigurationError(
                f"at {self._hardware.baud_rate} baud one state of {count} servos and a command take "
                f"{1e3 * need_s:.1f} ms, more than half of the {1e3 * period_s:g} ms between two states; "
                f"raise baud_rate (on the servos, too), or lower state_rate_hz ({self._source})"
            )

    def _checked(self, servo: int, low: int, high: int) -> bool:
        self._family.check(self._bus, servo, low, high)
        return True

    def _range(self, servo: ServoEntry) -> tuple[float, float]:
        return self._description.limits.target[self._description.actuated.index(servo.joint)]

    def _absent(self, missing: list[ServoEntry], found: Mapping[int, Answer]) -> DealHwError:
        there = {**self._bus.broadcast_ping(_LISTEN_S), **found}
        absent = ", ".join(f"{servo.id} ({servo.joint})" for servo in missing)
        if not there:
            return TransportTimeoutError(
                f"{self._where}: no servo answers at {self._hardware.baud_rate} baud; check the servos' "
                f"supply, the adapter's cable, the port, and the baud rate ({self._source})"
            )
        listed = ", ".join(f"{i} ({self._family.model_name(one.model)})" for i, one in sorted(there.items()))
        return TransportTimeoutError(
            f"{self._where}: servo {absent} does not answer; these do: {listed}. Check the cable between the "
            f"servos, and the ids ({self._source}); of two servos with one id neither can be read"
        )

    def _check_model(self, servo: ServoEntry, answer: Answer) -> None:
        model = self._family.model_name(answer.model)
        known = servo.model.lower()
        if problem := self._family.unknown_model(answer.model):
            raise WrongDeviceError(f"{self._where}: servo {servo.id} ({servo.joint}) {problem}")
        if known and known != model:
            raise WrongDeviceError(
                f"{self._where}: servo {servo.id} ({servo.joint}) is a {model}, {self._source} says "
                f"{known}; check id and model there"
            )

    def _try(self, request: Callable[[], T]) -> T | None:
        for _ in range(_TRIES):
            try:
                return request()
            except (TransportTimeoutError, FrameError):
                self._bus.settle()
        return None

    def surely(self, servo: ServoEntry, request: Callable[[], T]) -> T:
        """Return an answer of a servo that is known to be there.

        Raises:
            TransportTimeoutError: Each attempt failed.
            ConfigurationError: What the request raises, with port and joint.
        """
        try:
            found = self._try(request)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self._where}: {servo.joint}: {error}") from error
        if found is None:
            raise TransportTimeoutError(
                f"{self._where}: servo {servo.id} ({servo.joint}) answered a ping, but none of {_TRIES} "
                "reads; two servos have this id, the line is noisy, or another program uses the port"
            )
        return found
