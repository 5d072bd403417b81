"""Run other people's programs against the emulators, and keep what they print.

    python tools/check_clients.py FOLDER
    python tools/check_clients.py FOLDER --only can_simple.py read_write.py --transcript clients.md

FOLDER holds your own checkouts: ODriveResources (odriverobotics), DynamixelSDK (ROBOTIS-GIT),
FTServo_Python (ftservo), physical-cartpole (SensorsINI), lerobot (huggingface, v0.4.4: later versions need
Python 3.12) and unitree_sdk2_python (unitreerobotics). What is not there is left out. Programs run unchanged,
but for the port or bus that they open by name, and packages that they import and do not use, which are empty
(tools/clients/sitecustomize.py), in a terminal where this tool presses the keys. Each has its own emulator. A
program that fails is run again, up to three times in all, because its time limits are short for a busy
machine; table and transcript show at which try it passed, what was wrong before, and the load at each try.
Programs with packages of their own get an environment below --environments. The exit code is 1 if one fails.

Unitree's SDK needs cyclonedds 0.10.2: name a Python that has it with --unitree-python. On `lo` it needs
multicast, which a network of its own allows:

    unshare -rn sh -c 'ip link set lo up multicast on; python tools/check_clients.py FOLDER ...'
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import can
from clients.programs import CLIENTS, Client
from dynamixel_sdk import PacketHandler, PortHandler
from measuring import parser
from plug_in import installed
from ros2_rig import ros2_file

from deal_hw.drivers.cartpole.emulator.odrive_endpoints import flat_endpoints
from deal_hw.drivers.cartpole.wire.odrive_frames import (
    LAYOUT,
    PASSTHROUGH,
    POSITION_CONTROL,
    VELOCITY_CONTROL,
    Command,
)
from deal_hw.drivers.servo_bus.emulated_servo import BOOT_NS, KEEP_ID_AND_BAUD
from deal_hw.drivers.so101.emulator import homed, limits_of
from deal_hw.errors import TransportError
from deal_hw.robots import recorded_description
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.own_robot.new import new_robot

TOOLS = Path(__file__).resolve().parent / "clients"
_TRIES = 3
_BITRATE = 500_000
_HEAD, _TAIL = 14, 8
"""Lines of a program's output that the transcript keeps."""
_CONFIG = {
    "axis0.controller.config.control_mode": POSITION_CONTROL,
    "axis0.controller.config.pos_gain": 10.0,
    "axis0.controller.config.vel_limit": 50.0,
    "axis0.config.enable_watchdog": False,
}
"""Settings that can_restore_config.py writes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a program did.

    Attributes:
        client: The program.
        output: What it printed in the last try.
        faults: What was wrong in the last try; empty: it passed.
        failed: What was wrong in each try before.
        load: The machine's load before each try.
    """

    client: Client
    output: str
    faults: tuple[str, ...]
    failed: tuple[tuple[str, ...], ...] = ()
    load: tuple[float, ...] = ()

    @property
    def tries(self) -> int:
        """How often it was run."""
        return len(self.load)

    @property
    def verdict(self) -> str:
        """The result in words, with what was wrong in the tries before it."""
        before = "; ".join(
            f"try {number}: {'; '.join(faults)}" for number, faults in enumerate(self.failed, start=1)
        )
        text = f"FAIL: {'; '.join(self.faults)}" if self.faults else f"pass at try {self.tries}"
        return f"{text} ({before})" if before else text


def run_in_terminal(
    command: Sequence[str], client: Client, folder: Path, environment: Mapping[str, str]
) -> tuple[str, int]:
    """Run a program in a pseudo-terminal and press its keys; return what it printed, and its exit code."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    )
    os.close(slave)
    output, seen, keys = "", 0, list(client.keys)
    begin_s = time.monotonic()
    due_s: float | None = None
    stop_at_s: float | None = None
    try:
        while True:
            passed_s = time.monotonic() - begin_s
            if passed_s > client.limit_s:
                process.kill()
                output += f"\nstopped after {client.limit_s:g} s\n"
                break
            # Counted from its first output: a start on a busy machine takes longer than this time.
            if output and stop_at_s is None:
                stop_at_s = passed_s + (client.stop_after_s or math.inf)
            if stop_at_s is not None and passed_s > stop_at_s:
                process.send_signal(signal.SIGINT)
                stop_at_s = math.inf
            if select.select([master], [], [], 0.1)[0]:
                try:
                    data = os.read(master, 4096)
                except OSError:  # The program closed its side.
                    break
                output += data.decode(errors="replace")
            elif process.poll() is not None:
                break
            if keys and due_s is None and (at := output.find(keys[0][0], seen)) >= 0:
                seen, due_s = at + len(keys[0][0]), passed_s + client.hesitation_s
            if due_s is not None and passed_s >= due_s:
                os.write(master, keys.pop(0)[1].encode())
                due_s = None
    finally:
        code = process.wait()
        os.close(master)
    return output.replace("\r\n", "\n").replace("\r", "\n"), code


def write_files(client: Client, folder: Path) -> None:
    """Write what a program, or its emulator, reads."""
    if "endpoints" in client.files:
        (folder / "flat_endpoints.json").write_text(json.dumps(flat_endpoints()))
    if "config" in client.files:
        (folder / "config.json").write_text(json.dumps(_CONFIG))
    if "so101" in client.files:
        motor = {"drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
        names = recorded_description("so101").joint_names
        motors = {name: {"id": number, **motor} for number, name in enumerate(names, start=1)}
        calibration = folder / "so101.json"
        calibration.write_text(json.dumps(motors))
        mjcf = recorded_description("so101").mjcf
        new_robot(mjcf, lerobot=calibration, out=folder / "robot.yaml", name="my so101")
    if "homed" in client.files:
        motors = {
            servo.joint: {
                "id": servo.id,
                "drive_mode": 0,
                "homing_offset": 0,
                **dict(zip(("range_min", "range_max"), limits_of(servo), strict=True)),
            }
            for servo in homed().servos
        }
        (folder / "so101.json").write_text(json.dumps(motors))
    if "ros2" in client.files:
        ros2_file(folder)


def prepare(client: Client, port: str) -> None:
    """Do what a user does before the program: set the device up."""
    if client.prepare == "velocity":
        with can.interface.Bus(port, interface="slcan", bitrate=_BITRATE, sleep_after_open=0.1) as bus:
            for command, values in (
                (Command.SET_CONTROLLER_MODE, (VELOCITY_CONTROL, PASSTHROUGH)),
                (Command.SET_VEL_GAINS, (0.02, 0.1)),
            ):
                data = LAYOUT[command].pack(*values)
                bus.send(can.Message(arbitration_id=int(command), data=data, is_extended_id=False))
            time.sleep(0.2)
    elif client.prepare == "factory":
        handler = PortHandler(port)
        handler.setBaudRate(client.servo_rate)
        for servo in (1, 2):
            PacketHandler(2.0).factoryReset(handler, servo, KEEP_ID_AND_BAUD)
        time.sleep(1.5 * BOOT_NS / 1e9)
        handler.closePort()


def check(client: Client, folder: Path, python: Path) -> Run:
    """Run a program until it passes, three times at most."""
    failed: list[tuple[str, ...]] = []
    load: list[float] = []
    while True:
        load.append(os.getloadavg()[0])
        try:
            output, code = _once(client, folder, python)
        except TransportError as error:
            output, code = f"the emulator: {error}", -1
        faults = [
            f"no {pattern!r} in its output" for pattern in client.must if not re.search(pattern, output)
        ]
        faults += [f"{text!r} in its output" for text in client.must_not if text in output]
        faults += [] if code in client.exit_codes else [f"exit code {code}"]
        if not faults or len(load) == _TRIES:
            return Run(
                client=client, output=output, faults=tuple(faults), failed=tuple(failed), load=tuple(load)
            )
        failed.append(tuple(faults))


def _once(client: Client, folder: Path, python: Path) -> tuple[str, int]:
    with contextlib.ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        write_files(client, work)
        if client.plugin:
            stack.enter_context(installed(TOOLS.parents[1] / client.plugin, work / "plug-in"))
        words = [word.format(folder=work) for word in client.emulator]
        emulator = stack.enter_context(EmulatorProcess(*words))
        port = emulator.port.partition("?")[0].removeprefix("slcan:")
        prepare(client, port)
        places = {
            "source": folder / client.source,
            "port": port,
            "tools": TOOLS,
            "folder": work,
            "python": sys.executable,
        }
        command = [str(python), "-u", *(part.format(**places) for part in client.command)]
        paths = [TOOLS, *(folder / path for path in client.paths)]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(map(str, paths)),
            "DEAL_HW_CLIENT_PORTS": f"{client.opens}={port}" if client.opens else "",
            "DEAL_HW_CLIENT_UNUSED": ",".join(client.unused),
        }
        return run_in_terminal(command, client, work, environment)


def python_of(client: Client, folder: Path, pip_args: list[str]) -> Path:
    """Return the Python of a program, after making its environment if necessary.

    The environment sees the packages of deal-hw's own, so that torch is not installed twice.
    """
    if not client.packages:
        return Path(sys.executable)
    home = folder / client.name
    python, ready = home / "bin" / "python", home / ".ready"
    if not ready.exists():
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(home)], check=True)
        (packages,) = home.glob("lib/python3*/site-packages")
        own = [path for path in sys.path if path.endswith("site-packages")]
        (packages / "deal_hw_packages.pth").write_text("\n".join(own) + "\n")
        call = [str(python), "-m", "pip", "install", "--quiet", *pip_args, *client.packages]
        subprocess.run(call, check=True, capture_output=True, text=True)
        ready.touch()
    return python


def transcript(runs: Sequence[Run]) -> str:
    """Return the beginning and the end of what each program printed, as Markdown."""
    out = ["# What other people's programs printed\n\nWritten by `tools/check_clients.py`.\n"]
    for run in runs:
        lines = [line.rstrip() for line in run.output.splitlines() if line.strip()]
        if len(lines) > _HEAD + _TAIL:
            left = len(lines) - _HEAD - _TAIL
            lines = [*lines[:_HEAD], f"... {left} lines ...", *lines[-_TAIL:]]
        load = ", ".join(f"{value:.1f}" for value in run.load)
        text = "\n".join("    " + re.sub(r"/\S*/", "", line)[:110] for line in lines)
        arguments = " ".join(run.client.command[1:]).replace("{port}", "PORT")
        out.append(
            f"## {run.client.name} {arguments}".rstrip() + f"\n\n{run.verdict}, load {load}\n\n{text}\n"
        )
    return "\n".join(out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a row for each program; return 1 if one fails."""
    made = parser(__doc__, out=False)
    made.add_argument("folder", type=Path, help="folder of your checkouts")
    made.add_argument("--only", nargs="*", help="these programs")
    made.add_argument("--environments", type=Path, default=Path("build/clients"), help="kept")
    made.add_argument("--pip-args", default="", help="passed on to every `pip install`")
    made.add_argument("--unitree-python", type=Path, help="a Python with cyclonedds 0.10.2 and numpy")
    made.add_argument("--transcript", type=Path, help="a Markdown file for what they print")
    options = made.parse_args(arguments)
    folder = options.folder.resolve()
    chosen = [c for c in CLIENTS if not options.only or c.name in options.only]
    runs = []
    print("| program | result | load |\n|---|---|---|", flush=True)
    for client in chosen:
        if not (folder / client.source).exists():
            print(f"| {client.name} | skipped: no {client.source} | |", flush=True)
            continue
        if client.own_python and options.unitree_python is None:
            print(f"| {client.name} | skipped: no --unitree-python | |", flush=True)
            continue
        try:
            python = (
                options.unitree_python
                if client.own_python
                else python_of(client, options.environments.resolve(), shlex.split(options.pip_args))
            )
        except subprocess.CalledProcessError as error:
            runs.append(Run(client=client, output=str(error.stderr), faults=("not installed",)))
        else:
            runs.append(check(client, folder, python))
        load = ", ".join(f"{value:.1f}" for value in runs[-1].load)
        print(f"| {client.name} | {runs[-1].verdict} | {load} |", flush=True)
    if options.transcript is not None:
        options.transcript.write_text(transcript(runs))
    return int(any(run.faults for run in runs))


if __name__ == "__main__":
    sys.exit(main())
