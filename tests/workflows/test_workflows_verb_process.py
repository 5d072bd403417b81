"""A verb in a process of its own: what is reported when it ends before its host does."""

from __future__ import annotations

import sys

import pytest

from deal_hw.errors import ConfigurationError, TransportError
from deal_hw.workflows.emulation.process import VerbProcess

pytestmark = pytest.mark.real_time

DYING = (
    "import sys; print('port /dev/gone', flush=True); print('out of memory', file=sys.stderr); sys.exit(3)"
)


@pytest.fixture
def dying() -> VerbProcess:
    """An emulator that ends with status 3 as soon as it has named its port."""
    process = VerbProcess("emulate", "cartpole", what="the emulator")
    process._command = [sys.executable, "-c", DYING]
    return process


def wait(process: VerbProcess) -> None:
    """Wait until it has ended."""
    assert process._process is not None
    assert process._process.wait(timeout=60) == 3


def test_a_robot_that_is_gone_is_said_to_have_ended(dying: VerbProcess) -> None:
    """The port's error is the consequence; status and last words are the cause."""
    words = r"the emulator ended by itself with status 3.*out of memory"
    with pytest.raises(TransportError, match=words) as raised:
        with dying:
            wait(dying)
            raise TransportError("there is no serial port /dev/gone")
    assert "no serial port" in str(raised.value.__cause__)


def test_other_errors_stay_what_they_are(dying: VerbProcess) -> None:
    """A mistake of the caller has nothing to do with the emulator's end."""
    with pytest.raises(ConfigurationError, match="--seconds"), dying:
        wait(dying)
        raise ConfigurationError("--seconds 0")
