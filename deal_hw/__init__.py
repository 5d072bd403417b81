"""deal-hw: record a robot for seconds, calibrate its simulator, retrain, deploy, compare.

    import deal_hw

    found = deal_hw.calibrate("robot.xml", ["rec.csv"])
    print(found.table())

Importing this package loads nothing else; a workflow loads what it needs when it is called. The parts live
in sub-packages: ``workflows`` (the Python API), ``control``, ``data``, ``sim``, ``viz``, ``testing``,
``drivers``, ``calib``, ``policies`` and ``cli``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from deal_hw.version import __version__ as __version__

if TYPE_CHECKING:
    from deal_hw.workflows.calibrate import Calibration as Calibration
    from deal_hw.workflows.calibrate import calibrate as calibrate

_WORKFLOWS = {"calibrate": "deal_hw.workflows.calibrate", "Calibration": "deal_hw.workflows.calibrate"}
"""Name -> module, imported on use."""


def __getattr__(name: str) -> Any:
    if name not in _WORKFLOWS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_WORKFLOWS[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_WORKFLOWS})
