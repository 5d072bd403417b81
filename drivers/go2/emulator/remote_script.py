"""Script of an operator's actions on an emulated Go2's remote."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deal_hw.drivers.unitree.remote import Remote, parse_combination
from deal_hw.errors import ConfigurationError, shown
from deal_hw.reading import number, read_json, reading

_KEYS = ("at_s", "buttons", "left_x", "left_y", "right_x", "right_y", "absent")


@dataclass(frozen=True, slots=True)
class RemoteMoment:
    """State of the remote from a moment on.

    Attributes:
        at_ms: The moment [device ms].
        remote: Buttons and sticks; None: the remote is out of reach.
    """

    at_ms: int
    remote: Remote | None


def read_remote_script(path: Path) -> tuple[RemoteMoment, ...]:
    """Return the moments in a JSON file, in order of time.

    The file holds a list of objects such as ``{"at_s": 2.0, "buttons": "L2+B", "left_y": 0.5}``: buttons and
    sticks that are not named are released and centred; ``"absent": true`` puts the remote out of reach.

    Raises:
        ConfigurationError: The file holds something else.
        UnknownNameError: There is no such button.
    """
    what, advice = "a remote's script", "it is a list of objects with at_s and buttons or sticks"
    entries = read_json(path, list[Any], what, advice, error=ConfigurationError)
    with reading(path, what, error=ConfigurationError):
        return tuple(sorted((_moment(path, entry) for entry in entries), key=lambda moment: moment.at_ms))


def _moment(path: Path, entry: Any) -> RemoteMoment:
    if not isinstance(entry, dict) or "at_s" not in entry or set(entry) - set(_KEYS):
        raise ConfigurationError(
            f"{path}: {shown(entry)} is no valid entry; allowed keys are {', '.join(_KEYS)}, and at_s is "
            "required"
        )
    at_ms = round(number(entry["at_s"], "at_s", 0.0, 1e6) * 1e3)
    sticks = {name: number(entry.get(name, 0.0), name, -1.0, 1.0) for name in _KEYS[2:6]}
    if entry.get("absent"):
        return RemoteMoment(at_ms, None)
    return RemoteMoment(at_ms, Remote(parse_combination(str(entry.get("buttons", ""))), **sticks))
