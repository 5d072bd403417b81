"""Checks of ``deal-hw doctor`` on a Dynamixel bus: rates, ids, models, and the servos' settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from deal_hw.clock import Clock
from deal_hw.documentation import page
from deal_hw.drivers.cartpole.dynamixel.connect import parse_port
from deal_hw.drivers.cartpole.dynamixel.examine import model_name
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.interface import Answer
from deal_hw.drivers.servo_bus.registers import (
    BAUD_RATES,
    HARDWARE_ERROR,
    OPERATING_MODE,
    PRESENT_INPUT_VOLTAGE,
    PRESENT_POSITION,
    PRESENT_TEMPERATURE,
    RETURN_DELAY_TIME,
    RETURN_DELAY_UNIT_S,
    Register,
    explain_hardware_error,
)
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import DealHwError, FrameError, TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.transport import Transport

AREA: Final = "servos"
_LISTEN_S: Final = 0.1
"""Time for all servos to answer a broadcast ping, beyond the allowance for an answer [s]."""
_SYSFS: Final = Path("/sys/class/tty")
_LONG_DELAY_US = 250
_FAST_BAUD = 1_000_000


def examine_servos(
    port: str,
    clock: Clock,
    sysfs: Path = _SYSFS,
    transport_at: Callable[[str, int, Clock], Transport] = SerialTransport,
    rates: Sequence[int] = BAUD_RATES,
) -> Iterator[Finding]:
    """Yield findings at every baud rate; nothing is written to a servo.

    Args:
        port: The port, with settings as for ``--port``.
        clock: For the waiting.
        sysfs: Folder of the kernel's information on serial ports.
        transport_at: Makes a transport of a path, a baud rate and a clock.
        rates: Baud rates to try.

    Raises:
        DealHwError: The port cannot be opened.
    """
    path, settings = parse_port(port)
    yield from _latency_timer(path, sysfs)
    found = 0
    for rate in (settings.baud_rate, *(rate for rate in rates if rate != settings.baud_rate)):
        try:
            transport = transport_at(path, rate, clock)
            transport.open()
        except DealHwError as error:
            if rate == settings.baud_rate:
                raise
            yield Finding(AREA, Severity.NOTE, f"{rate} baud: the port does not support this rate ({error})")
            continue
        with transport:
            bus = Bus(transport, clock, rate, settings.answer_s)
            answers = bus.broadcast_ping(_LISTEN_S + settings.answer_s)
            for servo, answer in sorted(answers.items()):
                found += 1
                yield from _servo(bus, servo, answer, rate, settings)
            for servo in (settings.cart_id, settings.pole_id):
                if servo not in answers and bus.ping_protocol_1(servo):
                    found += 1
                    yield _old(servo, rate)
    if not found:
        yield Finding(
            AREA,
            Severity.FAIL,
            f"no servo answers on {path} at any of {len(rates)} baud rates",
            "switch their supply on (USB does not power them), check the 3-pin cables, and that this is the "
            "adapter's port",
        )


def _servo(bus: Bus, servo: int, answer: Answer, rate: int, settings: DynamixelSettings) -> Iterator[Finding]:
    values = {}
    for register in (
        OPERATING_MODE,
        RETURN_DELAY_TIME,
        HARDWARE_ERROR,
        PRESENT_POSITION,
        PRESENT_INPUT_VOLTAGE,
        PRESENT_TEMPERATURE,
    ):
        try:
            values[register] = _read(bus, servo, register)
        except (TransportTimeoutError, FrameError):
            yield Finding(
                AREA,
                Severity.FAIL,
                f"id {servo} at {rate} baud answers pings, but its other answers are corrupt",
                "two servos may have the same id: connect one alone and give it another",
            )
            return
    role = {settings.cart_id: "belt", settings.pole_id: "pole"}.get(servo, "not used")
    yield Finding(
        AREA,
        Severity.OK,
        f"id {servo} ({role}): {model_name(answer.model)}, firmware {answer.firmware}, {rate} baud, "
        f"operating mode {values[OPERATING_MODE]}, position {values[PRESENT_POSITION] % 4096} of 4096, "
        f"{values[PRESENT_INPUT_VOLTAGE] / 10:.1f} V, {values[PRESENT_TEMPERATURE]} °C",
    )
    if rate != settings.baud_rate:
        yield Finding(
            AREA,
            Severity.FAIL,
            f"id {servo} is set to {rate} baud, but deal-hw expects {settings.baud_rate}",
            "set its register Baud Rate (8) with Dynamixel Wizard"
            + (f", or give --port 'PORT?baud_rate={rate}' if both have it" if rate >= _FAST_BAUD else ""),
        )
    delay_us = round(values[RETURN_DELAY_TIME] * RETURN_DELAY_UNIT_S * 1e6)
    if delay_us > _LONG_DELAY_US:
        yield Finding(
            AREA,
            Severity.WARN,
            f"id {servo} waits {delay_us} us before each answer",
            "set its register Return Delay Time (9) to 0",
        )
    if values[HARDWARE_ERROR]:
        yield Finding(
            AREA,
            Severity.FAIL,
            f"id {servo} reports: {explain_hardware_error(values[HARDWARE_ERROR])}",
            "then switch it off and on",
        )


def _read(bus: Bus, servo: int, register: Register) -> int:
    try:
        return bus.read(servo, register)
    except (TransportTimeoutError, FrameError):
        return bus.read(servo, register)


def _old(servo: int, rate: int) -> Finding:
    return Finding(
        AREA,
        Severity.FAIL,
        f"id {servo} at {rate} baud speaks Dynamixel protocol 1.0",
        "set its register Protocol Type (13) to 2 with Dynamixel Wizard, or update its firmware",
    )


def _latency_timer(path: str, sysfs: Path) -> Iterator[Finding]:
    """Check how long an FTDI adapter collects bytes before it passes them on."""
    try:
        timer_ms = int((sysfs / Path(path).resolve().name / "device" / "latency_timer").read_text())
    except (OSError, ValueError):
        return
    slow = timer_ms > 1
    # The driver sets 1 ms when it opens the port; without permission for that the answers are late.
    yield Finding(
        AREA,
        Severity.NOTE if slow else Severity.OK,
        f"the adapter's latency timer is {timer_ms} ms",
        f"deal-hw sets it to 1 ms while it runs; for other programs: echo 1 > /sys/class/tty/"
        f"{Path(path).resolve().name}/device/latency_timer, or the udev rule "
        f"in {page('how-to/dynamixel.md')}"
        if slow
        else "",
    )
