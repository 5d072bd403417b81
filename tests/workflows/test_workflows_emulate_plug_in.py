"""Settings of the emulator of a plug-in: its port where it listens, a link where it has a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.emulation.plug_in import request_of
from deal_hw.workflows.emulation.settings import EmulatePlugInSettings


def test_the_emulator_is_asked_for_its_port_or_link() -> None:
    """Both reach it, with the times at which its port vanishes and returns."""
    # The entries of built-in robots stand in for a plug-in's: one listens, one has a pseudo-terminal.
    listening = EmulatePlugInSettings("go2", transport="zenoh", port="tcp/127.0.0.1:0")
    assert request_of(listening, "zenoh").port == "tcp/127.0.0.1:0"
    linked = EmulatePlugInSettings("cartpole", link=Path("p"), vanish_after_s=1.0, return_after_s=2.0)
    request = request_of(linked, "serial")
    assert (request.port, request.link) == ("", Path("p"))
    assert (request.vanish_after_s, request.return_after_s) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("robot", "values", "message"),
    [
        (
            "cartpole",
            {"port": "x"},
            "--port would have no effect: the emulator of 'cartpole' on serial makes a",
        ),
        ("go2", {"link": Path("p")}, "--link would have no effect: the emulator of 'go2' on dds listens at"),
        ("cartpole", {"return_after_s": 1.0}, "--return-after-s needs --vanish-after-s and --link"),
    ],
)
def test_an_option_without_effect_is_refused(robot: str, values: dict[str, Any], message: str) -> None:
    """By what the wire's entry says of its emulator."""
    with pytest.raises(ConfigurationError, match=message):
        EmulatePlugInSettings(robot, **values)
