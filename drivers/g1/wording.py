"""What messages of the shared driver say of a G1."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.crane import wording
from deal_hw.drivers.unitree.wording import Wording

WORDING: Final[Wording] = wording("g1")
