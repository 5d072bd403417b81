"""Packages of extras that take long to load: loaded when they are first used."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from deal_hw.errors import MissingExtraError


class OnUse:
    """A module that is loaded when the first name of it is used, but for names like ``__doc__``.

    inspect, copy, pickle and pytest ask any object for such names, and would load the module.

    Args:
        module: The module's full name.
        package: The package that installs it.
        extra: The extra of deal-hw that installs the package.

    Raises:
        MissingExtraError: It is not installed. This is known at once, before any work is lost.
    """

    def __init__(self, module: str, package: str, extra: str) -> None:
        if importlib.util.find_spec(module.partition(".")[0]) is None:
            raise MissingExtraError(package, extra)
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"{name} of {self._module}: import it for this name")
        value = getattr(importlib.import_module(self._module), name)
        setattr(self, name, value)  # The next look-up of this name does not come here.
        return value
