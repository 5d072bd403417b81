"""``--json``: one JSON document on the standard output, all else on the error output."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any


@contextlib.contextmanager
def only_document(wanted: bool) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yield a function that prints the document; what else is printed inside goes to the error output.

    Args:
        wanted: Whether --json was given. Otherwise the function prints nothing and nothing is redirected.
    """
    if not wanted:
        yield lambda values: None
        return
    output = sys.stdout

    def write(values: Mapping[str, Any]) -> None:
        print(json.dumps(values, indent=2, default=str), file=output)

    with contextlib.redirect_stdout(sys.stderr):
        yield write
