"""The only module that imports rerun; if rerun is missing, its error names the extra to install."""

from __future__ import annotations

from deal_hw.errors import MissingExtraError

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as err:
    raise MissingExtraError("rerun-sdk", "viz") from err

__all__ = ["rr", "rrb"]
