"""``deal-hw emulate``: a simulated robot that speaks the real robot's protocol."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import tyro

from deal_hw.robots import robot_entry
from deal_hw.workflows.emulation.cartpole import emulate_cartpole
from deal_hw.workflows.emulation.common import signalled
from deal_hw.workflows.emulation.go2 import emulate_go2
from deal_hw.workflows.emulation.plug_in import emulate_plug_in
from deal_hw.workflows.emulation.settings import EmulateSettings
from deal_hw.workflows.say import to_stderr


@dataclass(frozen=True, kw_only=True)
class Emulate(EmulateSettings):
    """Emulate a robot in real time on its own port, with hidden physics."""

    robot: tyro.conf.Positional[str] = "cartpole"


def emulate(config: Emulate) -> int:
    """Run the emulator until a signal, the given time or the port's end; return the exit status.

    The first line on standard output is ``port PATH``.
    """
    run = emulate_go2 if config.robot == "go2" else emulate_cartpole
    with signalled() as (stop, cut):
        if robot_entry(config.robot).origin:
            emulate_plug_in(config, stop, cut, announce=partial(print, flush=True))
            return 0
        run(config, stop, cut, announce=partial(print, flush=True), say=to_stderr)
    return 0
