"""``deal-hw emulate``: a simulated robot that speaks the real robot's protocol."""

from __future__ import annotations

from functools import partial

from deal_hw.workflows.emulation.cartpole import emulate_cartpole
from deal_hw.workflows.emulation.common import signalled, with_parent
from deal_hw.workflows.emulation.go2 import emulate_go2
from deal_hw.workflows.emulation.hung import emulate_hung
from deal_hw.workflows.emulation.plug_in import emulate_plug_in
from deal_hw.workflows.emulation.settings import (
    EMULATE,
    EmulateCartpoleSettings,
    EmulateGo2Settings,
    EmulateHungSettings,
    EmulatePlugInSettings,
    EmulateSettings,
)
from deal_hw.workflows.say import to_stderr

KINDS = EMULATE


def emulate(config: EmulateSettings) -> int:
    """Run the emulator until a signal, the given time or the port's end; return the exit status.

    The first line on standard output is ``port PATH``.
    """
    config = with_parent(config)
    announce = partial(print, flush=True)
    with signalled() as (stop, cut):
        if isinstance(config, EmulateGo2Settings):
            emulate_go2(config, stop, cut, announce=announce, say=to_stderr)
        elif isinstance(config, EmulateHungSettings):
            emulate_hung(config, stop, cut, announce=announce, say=to_stderr)
        elif isinstance(config, EmulateCartpoleSettings):
            emulate_cartpole(config, stop, cut, announce=announce, say=to_stderr)
        elif isinstance(config, EmulatePlugInSettings):
            emulate_plug_in(config, stop, cut, announce=announce)
    return 0
