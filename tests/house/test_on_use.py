"""Packages that take long are loaded at their first use, and missed at once."""

from __future__ import annotations

import inspect
import re
import sys

import pytest

from deal_hw.errors import MissingExtraError
from deal_hw.install import install_line
from deal_hw.on_use import OnUse


def test_a_module_is_loaded_with_its_first_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Making the object loads nothing, looking at it neither; the first name of it loads the module."""
    monkeypatch.delitem(sys.modules, "wave", raising=False)
    wave = OnUse("wave", "wave", "viz")
    assert not inspect.isroutine(wave) and inspect.getdoc(wave) and not hasattr(wave, "__wrapped__")
    assert "wave" not in sys.modules
    assert wave.Error is sys.modules["wave"].Error


def test_a_missing_package_is_named_before_its_use() -> None:
    """The message has the command that installs the extra."""
    with pytest.raises(MissingExtraError, match=re.escape(install_line("calib"))):
        OnUse("no_such_package.part", "no-such-package", "calib")
