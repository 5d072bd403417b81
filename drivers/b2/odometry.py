"""Path of a walking B2 by its own sensors."""

from __future__ import annotations

import functools
from typing import Final

from deal_hw.drivers.b2.description import GEOMETRY
from deal_hw.drivers.unitree import odometry

walked: Final = functools.partial(odometry.walked, GEOMETRY)
"""Returns the path of a recording; see :func:`deal_hw.drivers.unitree.odometry.walked`."""
