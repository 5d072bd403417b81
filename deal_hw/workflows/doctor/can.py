"""Checks of `deal-hw doctor` on CAN: adapters, bit rate, and other nodes on the bus."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from typing import Any

from deal_hw.clock import Clock
from deal_hw.drivers.transports.can_bus import CanTransport
from deal_hw.drivers.transports.can_transport import can_links
from deal_hw.drivers.transports.slcan_transport import serial_adapters
from deal_hw.errors import TransportTimeoutError
from deal_hw.findings import Finding, Severity

_BUSY = 0.7
"""Bus load above which frames are expected to be late."""


def list_adapters() -> Iterator[Finding]:
    """Yield the CAN adapters of this computer."""
    details = _ip_details()
    for name in can_links():
        yield _judge_link(name, details.get(name, {}))
    for device, kind in serial_adapters():
        yield Finding("can", Severity.OK, f"slcan:{device}: {kind}")


def listen_to_bus(transport: CanTransport, clock: Clock, seconds: float, *nodes: int) -> Iterator[Finding]:
    """Yield findings from listening to a bus; nothing is sent.

    Args:
        transport: The bus without a filter, not opened.
        clock: Clock for waiting.
        seconds: How long to listen [s].
        nodes: Expected node numbers of the robot.

    Raises:
        TransportError: The adapter cannot be opened, or is lost.
    """
    address = transport.address
    frames: Counter[int] = Counter()
    bits = 0
    with transport:
        end_ns = clock.now_ns() + round(seconds * 1e9)
        while (left_ns := end_ns - clock.now_ns()) > 0:
            try:
                message = transport.receive(left_ns / 1e9)
            except TransportTimeoutError:
                break
            frames[int(message.channel, 16) >> 5] += 1
            bits += 47 + 8 * len(message.payload)
    rate = "" if address.interface == "socketcan" else f" at {address.bitrate} bit/s"
    if not frames:
        trouble = f" ({transport.trouble})" if transport.trouble else ""
        yield Finding(
            "can",
            Severity.WARN,
            f"{transport.port}: no frame within {seconds:g} s{rate}{trouble}",
            "check the device's power, this bit rate, CAN-H and CAN-L (not swapped), and the 120 ohm "
            "resistors at both ends",
        )
        return
    share = bits / seconds / address.bitrate
    yield Finding.judged(
        "can",
        share > _BUSY,
        f"{transport.port}: {sum(frames.values()) / seconds:.0f} frames a second{rate}, "
        f"at least {share:.0%} of {address.bitrate} bit/s",
        "use a higher bit rate, or take other devices off the bus",
    )
    if foreign := sorted(set(frames) - set(nodes)):
        others = ", ".join(f"{node} ({frames[node] / seconds:.0f} frames a second)" for node in foreign[:8])
        yield Finding("can", Severity.NOTE, f"other nodes on the bus: {others}", "they are filtered out")
    if missing := sorted(set(nodes) - set(frames)):
        received = ", ".join(map(str, sorted(frames)))
        yield Finding(
            "can",
            Severity.WARN,
            f"no frame from node {', '.join(map(str, missing))}; received: {received}",
            f"give the number in the port: {transport.port.partition('?')[0]}?node=NUMBER",
        )
    if transport.error_frames:
        yield Finding(
            "can",
            Severity.WARN,
            f"{transport.error_frames} errors on the bus; the last: {transport.trouble}",
            "check wiring, termination and bit rate",
        )


def _ip_details() -> dict[str, dict[str, Any]]:
    """Return the output of ``ip`` on CAN interfaces; empty if ``ip`` is missing."""
    if shutil.which("ip") is None:
        return {}
    done = subprocess.run(
        ["ip", "-details", "-json", "link", "show", "type", "can"],
        capture_output=True,
        text=True,
        check=False,
    )
    try:
        links = json.loads(done.stdout or "[]")
        return {link["ifname"]: link.get("linkinfo", {}).get("info_data", {}) for link in links}
    except (ValueError, KeyError, AttributeError, TypeError):
        return {}


def _judge_link(name: str, details: dict[str, Any]) -> Finding:
    state = str(details.get("state", "")) or "state unknown"
    bitrate = details.get("bittiming", {}).get("bitrate")
    text = f"socketcan:{name}: {state.lower()}" + (f", {bitrate} bit/s" if bitrate else "")
    if state == "STOPPED":
        remedy = f"ip link set {name} up type can bitrate 500000 restart-ms 100"
        return Finding("can", Severity.WARN, text, remedy)
    if state in ("BUS-OFF", "ERROR-PASSIVE", "ERROR-WARNING"):
        remedy = f"check wiring, termination and bit rate; ip link set {name} type can restart-ms 100"
        return Finding("can", Severity.WARN, text, remedy)
    if details and not details.get("restart_ms"):
        remedy = f"to restart it after a bus-off: ip link set {name} type can restart-ms 100"
        return Finding("can", Severity.NOTE, text, remedy)
    return Finding("can", Severity.OK, text)
