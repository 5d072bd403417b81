"""What a person at the arm is asked and told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from deal_hw.errors import ConfigurationError


class Dialogue(Protocol):
    """Asks a person who turns joints by hand."""

    def say(self, text: str) -> None:
        """Show a text."""
        ...

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """Return one of the answers; the last is the one of nothing but Enter."""
        ...

    def begin(self, text: str) -> None:
        """Ask for something to be done, after which the person presses Enter."""
        ...

    def done(self) -> bool:
        """Return at once whether Enter was pressed after the last :meth:`begin`."""
        ...


def required(dialogue: Dialogue | None, verb: str) -> Dialogue:
    """Return the dialogue that a verb needs.

    Raises:
        ConfigurationError: There is none.
    """
    if dialogue is None:
        raise ConfigurationError(f"{verb} asks a person who turns the joints; from Python give dialogue=...")
    return dialogue
