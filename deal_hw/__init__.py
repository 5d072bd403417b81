"""deal-hw: record a robot for seconds, calibrate its simulator, retrain, deploy, compare.

Importing this package needs numpy only. The parts live in sub-packages: ``control``, ``data``, ``sim``,
``viz``, ``testing``, ``drivers``, ``calib``, ``policies`` and ``cli``.
"""

from __future__ import annotations

__version__ = "0.1.0"
