"""Every error that deal-hw raises on purpose: one tree below :class:`DealHwError`.

A class has the built-in error that says the same as another base, such as ``ValueError``.
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from deal_hw.install import install_line

QUOTED = 200
"""Most characters of a file's content that a message repeats."""
SHORT = 60
"""Most characters of one value, where a message may show several."""
LISTED = 600
"""Most characters of the names that a message lists."""
LONGEST = 800
"""Most characters of our own message about a file."""
NEAREST = 10
"""Names that a message gives where all of them would be too long."""


def short(value: object, most: int = QUOTED) -> str:
    """Return text, or the `repr` of another value, in one printable line of a bounded length.

    Args:
        value: The value to show; it may come from a hostile file. A long list gives its beginning and its
            number of entries.
        most: Longest text to return.
    """
    size = ""
    if isinstance(value, _CONTAINERS):
        size = f" ({len(value)} entries)" if len(value) > _REPR.maxlist else ""
        # A plain repr of nested lists with shared parts may be a million times as long as the file.
        value = _REPR.repr(value)
    text = " ".join(str(value)[: 4 * most].split())
    # A file's control characters could change the terminal.
    text = "".join(c if c.isprintable() else "?" for c in text)
    most -= len(size)
    return (text if len(text) <= most else f"{text[: most - 4]} ...") + size


def shown(value: object) -> str:
    """Return a file's value for a message: as :func:`short`, with text in quotes."""
    return short(repr(value[: 4 * SHORT]) if isinstance(value, str) else value, SHORT)


_CONTAINERS = (Mapping, list, tuple, set, frozenset)
_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxstring, _REPR.maxother = 3, 60, 60


class DealHwError(Exception):
    """Base of all errors raised on purpose by deal-hw."""


class ConfigurationError(DealHwError, ValueError):
    """A setting that cannot be used."""


class UnknownNameError(ConfigurationError):
    """A name that is not in a table: the message lists the names, or the nearest ones where there are many.

    Args:
        what: The kind of name, such as ``"parameter"``.
        given: The given name.
        allowed: The existing names.
    """

    def __init__(self, what: str, given: str, allowed: Iterable[str]) -> None:
        self.given = given
        self.allowed = tuple(allowed)
        known = f"known: {', '.join(self.allowed) or '(none)'}"
        if len(known) > LISTED:
            near = difflib.get_close_matches(given[:QUOTED], self.allowed, n=NEAREST, cutoff=0.0)
            known = f"the nearest of {len(self.allowed)}: {short(', '.join(near), LISTED)}"
        super().__init__(f"unknown {what} {short(given)!r}; {known}")


class MissingExtraError(DealHwError, ImportError):
    """An optional dependency is absent.

    Args:
        package: The package that could not be imported.
        extra: The extra of deal-hw that installs it.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; install it with: {install_line(extra)}")


class TransportError(DealHwError, ConnectionError):
    """The byte path to the robot failed."""


class PortNotFoundError(TransportError):
    """The port does not exist or cannot be opened."""


class PortBusyError(TransportError):
    """Another process holds the port."""


class TransportLostError(TransportError):
    """The peer vanished while the transport was open."""


class TransportTimeoutError(TransportError, TimeoutError):
    """Nothing arrived in time."""


class ProtocolError(DealHwError):
    """Invalid bytes."""


class FrameError(ProtocolError):
    """One frame is corrupt; the stream continues with the next."""


class VersionMismatchError(ProtocolError):
    """The peer speaks another version of the protocol."""


class WrongDeviceError(ProtocolError):
    """The peer is not the requested robot."""


class SafetyError(DealHwError):
    """A command that must not be sent."""


class PolicyError(DealHwError):
    """A policy that cannot run."""


class PolicyMismatchError(PolicyError):
    """A policy made for another robot, observation or action."""


class DatasetError(DealHwError):
    """A recording that cannot be used."""


class EmptyRecordingError(DatasetError):
    """The recording contains no state sample."""


class TornRecordingError(DatasetError):
    """The recording has no footer, as after a kill; ``deal-hw data repair`` repairs it."""


class TrainingError(DealHwError):
    """A training cannot continue."""


class CheckpointError(TrainingError):
    """A checkpoint cannot be read, or is of another training."""


class TrainingDivergedError(TrainingError):
    """The weights are not finite."""


class CalibrationError(DealHwError):
    """The calibration cannot be done."""


class ModelNotWrittenError(ConfigurationError):
    """A calibrated value cannot be written into the user's model; all other files of the result are there.

    Args:
        message: Why.
        files: These files by name.
    """

    def __init__(self, message: str, files: Mapping[str, Path]) -> None:
        super().__init__(message)
        self.files = dict(files)


class InsufficientDataError(CalibrationError):
    """The recording is too short or without excitation."""


class ClusterError(DealHwError):
    """The workers of a cluster cannot be used."""


class TaskLostError(ClusterError):
    """The worker of a task ended before the task, each time that it was begun."""
