"""A process that was cut off reaches nothing, and still computes and reads."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from deal_hw.policies import process_limits

SCRIPT = """
import json, os, pathlib, socket, subprocess, sys, threading
from deal_hw.policies.process_limits import cut_off
folder, parent = pathlib.Path(sys.argv[1]), int(sys.argv[2])
kept = (folder / "kept").open()
reason = cut_off()
def tried(act):
    try:
        act()
    except OSError as err:
        return type(err).__name__
    return "done"
def thread():
    one = threading.Thread(target=lambda: None)
    one.start()
    one.join()
acts = {
    "socket": lambda: socket.socket(),
    "local socket": lambda: socket.socket(socket.AF_UNIX),
    "pair": lambda: socket.socketpair(),
    "program": lambda: subprocess.run(["true"]),
    "write": lambda: (folder / "new").open("w"),
    "append": lambda: (folder / "kept").open("a"),
    "change": lambda: (folder / "kept").open("r+"),
    "remove": lambda: (folder / "kept").unlink(),
    "rename": lambda: (folder / "kept").rename(folder / "other"),
    "folder": lambda: (folder / "sub").mkdir(),
    "mode": lambda: (folder / "kept").chmod(0),
    "link": lambda: (folder / "link").symlink_to("kept"),
    "signal": lambda: os.kill(parent, 0),
    "read": lambda: (folder / "kept").read_text(),
    "read an open file": lambda: kept.read(),
    "list": lambda: list(folder.iterdir()),
    "thread": thread,
}
print(json.dumps({"reason": reason, **{name: tried(act) for name, act in acts.items()}}))
"""


def test_what_is_left_of_a_process(tmp_path: Path) -> None:
    """Network, programs, changes of files and signals are refused as without rights; reading goes on."""
    (tmp_path / "kept").write_text("x", encoding="utf-8")
    words = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path), str(os.getpid())]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    found = json.loads(done.stdout)
    if found.pop("reason"):
        pytest.skip("this kernel has no filter of system calls")
    allowed = {"read", "read an open file", "list", "thread"}
    assert {name for name, result in found.items() if result == "done"} == allowed
    assert {result for name, result in found.items() if name not in allowed} == {"PermissionError"}
    assert [file.name for file in tmp_path.iterdir()] == ["kept"]


def test_the_tables_have_the_kernels_numbers() -> None:
    """By the headers of this computer; each refused call has a number where the machine has the call."""
    header = Path("/usr/include/asm-generic/unistd.h")
    if not header.is_file():
        pytest.skip("the kernel's headers are not installed")
    text = header.read_text(encoding="utf-8")
    numbers = {name: int(number) for name, number in re.findall(r"#define __NR_(\w+)\s+(\d+)$", text, re.M)}
    known = {name: n for name, n in process_limits._AARCH64.items() if name in numbers}
    assert len(known) > 40 and known == {name: numbers[name] for name in known}
    names = {name for words in process_limits._REFUSED.values() for name in words.split()}
    assert names == {*process_limits._X86_64, *process_limits._BOTH}
    assert {*process_limits._AARCH64, *process_limits._BOTH} <= names


def test_an_unknown_machine_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """It still may write no file; the reason is noted in the imported policy."""
    limits: list[tuple[int, int]] = []
    monkeypatch.setattr(process_limits, "_limit", lambda kind, most: limits.append((kind, most)))
    monkeypatch.setattr(platform, "machine", lambda: "pdp11")
    assert process_limits.cut_off() == "no filter of system calls is known for pdp11"
    assert len(limits) == 1 and limits[0][1] == 0
