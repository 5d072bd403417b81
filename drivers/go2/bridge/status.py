"""The bridge's status for clients on ``rt/deal_hw/bridge``: who controls the robot, and why."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from deal_hw.drivers.go2.messages.rpc import Request, decode_request, encode_request
from deal_hw.errors import FrameError


def encode_status(values: Mapping[str, Any]) -> bytes:
    """Return the message, a request's CDR with JSON."""
    return encode_request(Request(identity=0, api=0, parameter=json.dumps(dict(values)), no_reply=True))


def read_status(payload: bytes) -> dict[str, str] | None:
    """Return ``control`` and ``reason`` as text; None if the message is not from a bridge."""
    try:
        values = json.loads(decode_request(payload).parameter)
    except (FrameError, ValueError, RecursionError):
        return None
    if not isinstance(values, dict) or not all(isinstance(values.get(k), str) for k in ("control", "reason")):
        return None
    return {"control": values["control"][:40], "reason": values["reason"][:400]}
