"""Other people's programs: the ports that they open by name, the keys they wait for, what is kept of them."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import threading
import tty
from pathlib import Path

import check_clients
import pytest
from check_clients import TOOLS, Run, check, main, run_in_terminal, transcript
from clients.programs import CLIENTS, Client

pytestmark = pytest.mark.real_time

PLAIN = Client(name="plain", source="plain.py", command=("{source}",), emulator=("cartpole",))


def run_with(shim: str, code: str, unused: str = "") -> str:
    """Return what a program prints whose ports are replaced, and whose unused packages are empty."""
    environment = os.environ | {
        "PYTHONPATH": str(TOOLS),
        "DEAL_HW_CLIENT_PORTS": shim,
        "DEAL_HW_CLIENT_UNUSED": unused,
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    return done.stdout + done.stderr


def test_a_serial_port_is_replaced_by_its_name() -> None:
    """`/dev/ttyUSB0` of ROBOTIS' examples opens the emulator's port; other names stay."""
    master, slave = pty.openpty()
    code = "import serial; print(serial.Serial('/dev/ttyUSB0').port)\ntry: serial.Serial('/dev/none')\n"
    port = os.ttyname(slave)
    out = run_with(f"/dev/ttyUSB0={port}", code + "except serial.SerialException as e: print(e)")
    os.close(master)
    os.close(slave)
    assert out.splitlines()[0] == port
    assert "/dev/none" in out


def test_a_can_interface_becomes_an_adapter() -> None:
    """`can0` of ODrive's examples: bus.send is a line to the adapter, and its lines are what is received."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    received = bytearray()

    def adapter() -> None:
        # Until the frame came, then one of our own.
        while b"t0078" not in received:
            received.extend(os.read(master, 100))
        os.write(master, b"t0018AABBCCDD00000000\r")

    thread = threading.Thread(target=adapter)
    thread.start()
    code = (
        "import can\nbus = can.interface.Bus('can0', interface='socketcan')\n"
        "while bus.recv(timeout=0) is not None: pass\n"
        "bus.send(can.Message(arbitration_id=7, data=bytes(8), is_extended_id=False))\n"
        "m = bus.recv(10.0)\nprint(hex(m.arbitration_id), m.data.hex(), m.is_rx)\nbus.shutdown()"
    )
    out = run_with(f"can0={os.ttyname(slave)}", code)
    thread.join()
    os.close(master)
    os.close(slave)
    assert out.startswith("0x1 aabbccdd00000000 True")
    assert b"S6\r" in received


def test_an_unused_package_is_empty() -> None:
    """It need not be installed; a program may import its parts and derive from their names; others stay."""
    code = (
        "import json, no_such.deep.part as part\nfrom no_such import Base\n"
        "class Own(Base): size = 3\nprint(Own().size, part.__name__, json.dumps([1]))"
    )
    assert run_with("", code, "no_such").split() == ["3", "no_such.deep.part", "[1]"]
    assert "No module named 'no_such'" in run_with("", code, "no_other")


def test_keys_are_pressed_when_they_are_asked_for(tmp_path: Path) -> None:
    """In a terminal, in order, each once; the output and the exit code come back."""
    keys = (("Key?", "a\n"), ("Key?", "b\n"))
    client = Client(name="asks", source="", command=(), emulator=(), keys=keys, hesitation_s=0.0)
    code = "import sys; print(sys.stdin.isatty(), input('Key?'), input('Key?')); sys.exit(3)"
    output, exit_code = run_in_terminal([sys.executable, "-c", code], client, tmp_path, os.environ)
    assert exit_code == 3
    assert "True a b" in output


def test_a_program_that_never_ends_is_stopped(tmp_path: Path) -> None:
    """By Ctrl-C, where it is endless on purpose, or by force at its limit."""
    code = (
        "import time\ntry: print('begun', flush=True); time.sleep(600)\n"
        "except KeyboardInterrupt: print('stopped by hand')"
    )
    endless = Client(name="x", source="", command=(), emulator=(), stop_after_s=0.1, limit_s=120.0)
    assert (
        "stopped by hand" in run_in_terminal([sys.executable, "-c", code], endless, tmp_path, os.environ)[0]
    )
    limited = Client(name="x", source="", command=(), emulator=(), limit_s=0.3)
    output, exit_code = run_in_terminal([sys.executable, "-c", code], limited, tmp_path, os.environ)
    assert "stopped after 0.3 s" in output
    assert exit_code < 0


def test_a_program_is_run_again_and_what_was_wrong_is_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A missing text, a forbidden one and the exit code each have their words; a second try may pass."""
    client = Client(
        name="x", source="", command=(), emulator=(), must=("pos: \\d", "Done"), must_not=("Traceback",)
    )
    answers = iter([("Traceback pos: 1", 1), ("pos: 2 Done", 0)])
    monkeypatch.setattr(check_clients, "_once", lambda *_: next(answers))
    run = check(client, tmp_path, Path(sys.executable))
    assert (run.tries, run.faults) == (2, ())
    assert run.failed == (("no 'Done' in its output", "'Traceback' in its output", "exit code 1"),)
    assert run.verdict == (
        "pass at try 2 (try 1: no 'Done' in its output; 'Traceback' in its output; exit code 1)"
    )
    monkeypatch.setattr(check_clients, "_once", lambda *_: ("Traceback pos: 1", 1))
    run = check(client, tmp_path, Path(sys.executable))
    assert run.faults == ("no 'Done' in its output", "'Traceback' in its output", "exit code 1")
    assert run.tries == 3
    assert run.verdict.startswith("FAIL: no 'Done' in its output; ")


def test_an_empty_folder_skips_every_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is fetched; the table names what is missing. A package of its own needs no checkout."""
    checkouts = [client.name for client in CLIENTS if client.source]
    assert main([str(tmp_path), "--only", *checkouts]) == 0
    out = capsys.readouterr().out
    assert out.count("skipped: no ") == len(checkouts) >= len(CLIENTS) - 1


def test_a_transcript_is_short_and_has_no_paths() -> None:
    """The beginning and the end of the output, without folders of this machine."""
    lines = [f"line {k}" for k in range(100)]
    out = "\n".join(["at /some/folder/x.py", *lines])
    run = Run(client=PLAIN, failed=(("exit code 1",),), output=out, faults=(), load=(2.04, 7.56))
    text = transcript([run])
    assert "pass at try 2 (try 1: exit code 1), load 2.0, 7.6" in text
    assert "at x.py" in text
    assert "... 79 lines ..." in text
    assert "line 99" in text
    assert "line 50" not in text


def test_the_table_of_programs_is_sound() -> None:
    """Every pattern compiles, and each program says what it must print."""
    for client in CLIENTS:
        assert client.must, client.name
        for pattern in client.must:
            re.compile(pattern)
