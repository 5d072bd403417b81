"""The one set of colours, from Okabe and Ito (2008): told apart with any kind of colour vision."""

from __future__ import annotations

from collections.abc import Sequence

Color = tuple[int, int, int]

REAL: Color = (86, 180, 233)
"""Blue: what the robot reported."""
NOMINAL: Color = (230, 159, 0)
"""Orange: what the user's model predicts."""
CALIBRATED: Color = (0, 178, 130)
"""Green: what the calibrated model predicts; a little lighter than the original for thin lines on black."""
REQUESTED: Color = (150, 150, 150)
SENT: Color = (240, 228, 66)
ALARM: Color = (213, 94, 0)
OTHERS: tuple[Color, ...] = ((204, 121, 167), (148, 103, 189), (230, 230, 230))
"""For parameter sets of other names."""


_KNOWN = {"real": REAL, "nominal": NOMINAL, "calibrated": CALIBRATED}


def color_of(name: str, names: Sequence[str] = ()) -> Color:
    """Return the colour of ``"real"``, ``"nominal"``, ``"calibrated"``, or another one of ``names``."""
    if name in _KNOWN:
        return _KNOWN[name]
    others = [other for other in names if other not in _KNOWN]
    return OTHERS[others.index(name) % len(OTHERS)] if name in others else OTHERS[0]
