"""Measure the timing of 500 commands and states a second over the Go2's wire.

    python tools/measure_go2_transport.py --transport zenoh --seconds 600 --freeze-at 300 --freeze-s 5

Two processes of this machine, controller and robot, send messages of the robot's size on its topics. With
--freeze-at the robot's process is stopped for a time, and no control cycle may wait for it. Exit code 1: a
cycle was late by more than 2 ms while the machine did not pause.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro
from go2_transport_sides import LATE_NS
from measuring import Rows
from side_process import SideProcess
from stall_monitor import Account, watch_stalls

from deal_hw.bench.rows import describe_machine
from deal_hw.cli.show import seconds_bar
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.ranges import Range, check_ranges
from deal_hw.transport import WireOptions
from deal_hw.workflows.emulation.topics import free_port

SIDES: Final = Path(__file__).with_name("go2_transport_sides.py")
_START_S: Final = 30.0
_END_S: Final = 20.0
_SETTLE_S: Final = 2.0
_PAUSE_NS: Final = 200_000
"""Shortest pause of the machine that differs from an ordinary wake-up [ns]."""
FREEZE_LIMIT_S: Final = 2e-3
"""Largest allowed delay of a control cycle while the peer is frozen [s]."""


@dataclass(frozen=True, kw_only=True)
class TransportBench:
    """Measure the timing of 500 commands and states a second over the Go2's wire."""

    transport: Literal["dds", "zenoh"] = "dds"
    """The transport."""

    port: str = ""
    """Network interface (dds) or end point (zenoh); by default on this machine's loopback."""

    seconds: Annotated[float, Range(0.1, 86_400, "s")] = 20.0
    """Duration of the measurement [s]."""

    rate: Annotated[float, Range(1, 10_000, "Hz")] = 500.0
    """Commands and states a second [1/s]."""

    freeze_at: Annotated[float | None, Range(1e-3, 86_400, "s")] = None
    """Stop the robot's process (SIGSTOP) this long after the start [s]."""

    freeze_s: Annotated[float, Range(1e-3, 3600, "s")] = 1.0
    """Length of the stop [s]."""

    wire: tyro.conf.OmitArgPrefixes[WireOptions] = field(default_factory=WireOptions)
    """Options of the network."""

    out: Path | None = None
    """File of the row (JSON)."""

    quiet: bool = False
    """Print errors only."""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.freeze_at is not None and not self.freeze_at + self.freeze_s < self.seconds:
            raise ConfigurationError(
                f"--freeze-at {self.freeze_at:g} --freeze-s {self.freeze_s:g}: begin and end lie inside the "
                f"{self.seconds:g} s of the run"
            )


def bench_transport(settings: TransportBench) -> int:
    """Measure, print and, where a file is named, write.

    Returns:
        0, or 1 where a frozen peer delayed a control cycle by more than :data:`FREEZE_LIMIT_S`.

    Raises:
        TransportError: A process failed; the message holds what it printed.
    """
    machine = describe_machine()
    row = summary(settings, *measure(settings))
    row["load_before"] = machine["load"]
    if not settings.quiet:
        print("\n".join(lines(row)))
    Rows(__file__, settings.out).add(row, "")
    if settings.out is not None and not settings.quiet:
        print(f"written: {settings.out}")
    return int(row["frozen"] is not None and _longest_s(row["frozen"]) > FREEZE_LIMIT_S)


def _longest_s(frozen: Mapping[str, Any]) -> float:
    """Return the longest delay, without pauses of the machine if the stall monitor ran [s]."""
    awake_s = frozen.get("awake_delay_s")
    return float(frozen["cycle_delay"]["max_s"] if awake_s is None else awake_s)


def measure(settings: TransportBench) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run both processes and return what the controller and the robot measured."""
    orders = {
        "parent_pid": os.getpid(),
        "transport": settings.transport,
        "port": settings.port or ("lo" if settings.transport == "dds" else free_port("tcp/127.0.0.1:0")),
        "rate_hz": settings.rate,
        "cycles": round(settings.seconds * settings.rate),
    }
    wire = {**settings.wire.to_json(), "listen": False}
    # Zenoh needs one side that listens, and a client cannot; DDS has no sides.
    robot_wire = {**wire, "listen": True, "mode": "peer"} if settings.transport == "zenoh" else wire
    with _monitored() as seen, SideProcess(SIDES, "robot", {**orders, "wire": robot_wire}) as robot:
        robot.expect("ready", _START_S)
        freeze = {"pid": robot.pid, **_freeze_cycles(settings)}
        with SideProcess(SIDES, "controller", {**orders, "wire": wire, "freeze": freeze}) as controller:
            controller.expect("ready", _START_S)
            controller.expect("running", _START_S)
            with seconds_bar(f"go2-transport {settings.transport}", settings.seconds, settings.quiet) as bar:
                measured = controller.result(settings.seconds + _END_S, bar.passed)
        robot.stop()
        other = robot.result(_END_S)
    return {**measured, "account": seen}, other


@contextlib.contextmanager
def _monitored() -> Iterator[Account | None]:
    """Run the stall monitor, if permitted."""
    with contextlib.ExitStack() as stack:
        try:
            seen: Account | None = stack.enter_context(watch_stalls(_PAUSE_NS))
        except ConfigurationError:
            seen = None
        yield seen


def _freeze_cycles(settings: TransportBench) -> dict[str, int]:
    if settings.freeze_at is None:
        return {"first": 0, "last": 0, "settled": 0}
    first = max(1, round(settings.freeze_at * settings.rate))
    last = first + max(1, round(settings.freeze_s * settings.rate))
    cycles = round(settings.seconds * settings.rate)
    return {"first": first, "last": last, "settled": min(cycles, last + round(_SETTLE_S * settings.rate))}


def summary(
    settings: TransportBench, controller: Mapping[str, Any], robot: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the row of the result from the measurements of both sides.

    Losses in the freeze and the 2 s after it are counted apart, because no transport could avoid them.
    """
    freeze = _freeze_cycles(settings)
    commands, states = robot["commands"], controller["states"]
    touched = (freeze["first"], freeze["settled"]) if freeze["first"] else (1, 0)
    states_touched = (controller["states_touched"][0] + 1, controller["states_touched"][1])
    return {
        "bench": "go2-transport",
        "transport": settings.transport,
        "port": settings.port or "(loopback)",
        "rate_hz": settings.rate,
        "seconds": settings.seconds,
        "error": "",
        "period": controller["loop_timing"]["period"],
        "period_error": controller["period_error"],
        "lateness": controller["loop_timing"]["lateness"],
        "skipped_periods": controller["loop_timing"]["skipped_periods"],
        "cycle_delay": controller["quiet"]["cycle_delay"],
        "work": controller["quiet"]["work"],
        "send": controller["quiet"]["send"],
        "cycles_without_link": controller["quiet"]["cycles_without_link"],
        "state_age": controller["quiet"]["state_age"],
        "commands": _stream(controller["sent"], commands, touched),
        "states": _stream(robot["sent"], states, states_touched),
        "controller_cpu_share": controller["cpu_share"],
        "robot_cpu_share": robot["cpu_share"],
        "controller_scheduling": controller["scheduling"],
        "robot_scheduling": robot["scheduling"],
        "warnings": [*controller["warnings"], *robot["warnings"]],
        "freeze_at_s": settings.freeze_at,
        "freeze_s": settings.freeze_s if settings.freeze_at is not None else None,
        "frozen": _awake_delay(controller["frozen"], controller.get("account")),
        "quiet_awake_delay_s": _awake_s(controller["quiet"], controller.get("account")),
    }


def _awake_delay(frozen: Mapping[str, Any] | None, seen: Account | None) -> dict[str, Any] | None:
    if frozen is None:
        return None
    kept = {name: value for name, value in frozen.items() if name != "late"}
    return {**kept, "awake_delay_s": _awake_s(frozen, seen)}


def _awake_s(cycles: Mapping[str, Any], seen: Account | None) -> float | None:
    """Return the longest delay of a cycle, without the machine's pauses [s]; None if no monitor ran."""
    if seen is None:
        return None
    late = cycles.get("late", ())
    longest_s = (
        max((seen.awake_ns(*pair) for pair in zip(late[::2], late[1::2], strict=True)), default=0) * 1e-9
    )
    # Cycles below the threshold are not listed one by one.
    return max(longest_s, min(float(cycles["cycle_delay"]["max_s"] or 0.0), LATE_NS * 1e-9))


def _stream(sent: int, arrived: Mapping[str, Any], touched: tuple[int, int]) -> dict[str, Any]:
    gaps = arrived["gaps"]
    missing = sum(gaps[1::2])
    frozen = sum(
        max(0, min(first + count - 1, touched[1]) - max(first, touched[0]) + 1)
        for first, count in zip(gaps[::2], gaps[1::2], strict=True)
    )
    return {
        "sent": sent,
        "arrived": arrived["count"],
        "lost": missing - frozen,
        "lost_percent": 100 * (missing - frozen) / max(1, sent),
        "lost_around_freeze": frozen,
        "disordered": arrived["disordered"],
        "older_than_100_ms": arrived["stale"],
        "age_at_arrival": arrived["age"],
    }


def lines(row: Mapping[str, Any]) -> list[str]:
    """Return the result as text."""
    text = [
        f"{row['transport']}, {row['rate_hz']:g} Hz both ways, {row['seconds']:g} s; p50 / p99 / max",
        f"period error     {_ms(row['period_error'])}",
        f"cycle delay      {_ms(row['cycle_delay'])} (from the deadline until the command is on its way)",
        f"  of it work     {_ms(row['work'])} (reading, writing; the rest is waking up late)",
        f"send             {_ms(row['send'])}",
        f"state age        {_ms(row['state_age'])} (when a command is sent)",
    ]
    for name in ("commands", "states"):
        part = row[name]
        text.append(
            f"{name:<16} {part['lost']} of {part['sent']} lost ({part['lost_percent']:.3f} %), "
            f"{part['disordered']} out of order; age at arrival {_ms(part['age_at_arrival'])}"
        )
    text.append(
        f"CPU share        controller {100 * row['controller_cpu_share']:.1f} % "
        f"({row['controller_scheduling']}), robot {100 * row['robot_cpu_share']:.1f} % "
        f"({row['robot_scheduling']})"
    )
    if row["cycles_without_link"] or row["skipped_periods"]:
        text.append(
            f"attention        {row['cycles_without_link']} cycles without a link, "
            f"{row['skipped_periods']} periods skipped"
        )
    if frozen := row["frozen"]:
        longest_s = _longest_s(frozen)
        monitored = "" if frozen.get("awake_delay_s") is None else " while the machine ran"
        text += [
            f"frozen {row['freeze_s']:g} s, then {_SETTLE_S:g} s: cycle delay {_ms(frozen['cycle_delay'])}",
            f"  of it work     {_ms(frozen['work'])}, {frozen['cycles_without_link']} cycles without a link",
            f"                 {row['commands']['lost_around_freeze']} commands dropped, "
            f"{row['commands']['older_than_100_ms']} delivered late",
            f"                 longest delay{monitored} {longest_s * 1e3:.2f} ms: "
            + ("kept" if longest_s <= FREEZE_LIMIT_S else "NOT kept")
            + f" the limit of {FREEZE_LIMIT_S * 1e3:g} ms",
        ]
    return [*text, *(f"warning: {warning}" for warning in dict.fromkeys(row["warnings"]))]


def _ms(spread: Mapping[str, float | None]) -> str:
    values = (spread[name] for name in ("p50_s", "p99_s", "max_s"))
    return " / ".join("-" if v is None else f"{v * 1e3:.3f}" for v in values) + " ms"


def main(arguments: list[str] | None = None) -> int:
    try:
        return bench_transport(tyro.cli(TransportBench, description=__doc__, args=arguments))
    except DealHwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
