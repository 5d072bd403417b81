"""The only module that names rerun. It is loaded on use; if it is missing, the error names the extra."""

from __future__ import annotations

from typing import TYPE_CHECKING

from deal_hw.on_use import OnUse

__all__ = ["rr", "rrb"]

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb
else:
    rr, rrb = OnUse("rerun", "rerun-sdk", "viz"), OnUse("rerun.blueprint", "rerun-sdk", "viz")
