"""The colours, from Okabe and Ito (2008): distinct for any colour vision, on white and black."""

from __future__ import annotations

from collections.abc import Sequence

Color = tuple[int, int, int]

REAL: Color = (0, 114, 178)
"""Blue: measured."""
NOMINAL: Color = (230, 159, 0)
"""Orange: predictions of the user's model."""
CALIBRATED: Color = (0, 158, 115)
"""Green: predictions of the calibrated model."""
REQUESTED: Color = (140, 140, 140)
SENT: Color = (204, 121, 167)
ALARM: Color = (213, 94, 0)
OTHERS: tuple[Color, ...] = ((204, 121, 167), (86, 180, 233), (140, 140, 140))
"""For parameter sets of other names."""
SKY: Color = (236, 239, 243)
"""Behind the robot."""


_KNOWN = {"real": REAL, "nominal": NOMINAL, "calibrated": CALIBRATED}


def color_of(name: str, names: Sequence[str] = ()) -> Color:
    """Return the colour of ``"real"``, ``"nominal"``, ``"calibrated"``, or another one of ``names``."""
    if name in _KNOWN:
        return _KNOWN[name]
    others = [other for other in names if other not in _KNOWN]
    return OTHERS[others.index(name) % len(OTHERS)] if name in others else OTHERS[0]
