"""The table of trainers: name -> ``module:class``, imported on use."""

from __future__ import annotations

import importlib
from typing import Any

from deal_hw.errors import UnknownNameError

TRAINERS: dict[str, str] = {
    "amp": "deal_hw.policies.amp:AmpTrainer",
    "ppo": "deal_hw.policies.ppo:PpoTrainer",
    "rma": "deal_hw.policies.rma:RmaTrainer",
    "sac": "deal_hw.policies.sac:SacTrainer",
}


def make_trainer(name: str) -> Any:
    """Return a new trainer (see :class:`deal_hw.training.PolicyTrainer`).

    Raises:
        UnknownNameError: There is no such trainer; the message lists them.
    """
    if name not in TRAINERS:
        raise UnknownNameError("trainer", name, TRAINERS)
    module, _, attribute = TRAINERS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)()
