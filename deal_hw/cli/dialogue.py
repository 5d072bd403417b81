"""The dialogue with a person at the arm, on the terminal."""

from __future__ import annotations

import select
import sys
from collections.abc import Sequence

from deal_hw.errors import ConfigurationError


class TerminalDialogue:
    """The dialogue on standard input and output.

    Args:
        verb: What needs it, for the message.

    Raises:
        ConfigurationError: Standard input is no terminal.
    """

    def __init__(self, verb: str) -> None:
        if not sys.stdin.isatty():
            raise ConfigurationError(
                f"{verb} asks a person who turns the joints: run it in a terminal, at the arm"
            )

    def say(self, text: str) -> None:
        """Show a text."""
        print(text, flush=True)

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """Return one of the answers; the last is the one of nothing but Enter."""
        while True:
            print(f"{question} [{'/'.join(answers)}, Enter: {answers[-1]}] ", end="", flush=True)
            answer = self._line().strip().lower() or answers[-1]
            if answer in answers:
                return answer

    def begin(self, text: str) -> None:
        """Ask for something to be done, after which the person presses Enter."""
        # Keys that were pressed before the text was there do not count.
        while select.select([sys.stdin], [], [], 0)[0]:
            self._line()
        print(f"{text} Then press Enter. ", end="", flush=True)

    def done(self) -> bool:
        """Return at once whether Enter was pressed."""
        if not select.select([sys.stdin], [], [], 0)[0]:
            return False
        self._line()
        return True

    @staticmethod
    def _line() -> str:
        line = sys.stdin.readline()
        if not line:
            raise ConfigurationError("the terminal was closed; nothing was written")
        return line
