"""Compiles a user's MJCF: the result is a model that can be simulated, or a one-line error."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError, short
from deal_hw.reading import MIB, check_size, reading

MJCF_BYTES: Final = 64 * MIB
"""Largest main file of a model; included files count as memory."""
MEMORY_BYTES: Final = 4096 * MIB
"""Memory limit of compiling a model and its first steps."""
SECONDS: Final = 60.0
"""Processor time limit of the same [s]."""
STEPS: Final = 10
"""Number of test steps before a model is used."""
DIVERGED: Final = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
"""Warnings after which MuJoCo starts again from the reference pose."""
_ROOM: Final = "keep bodies apart (contype, exclude), or write a larger <size memory=.../>"
_OVERFULL: Final = ("mjWARN_CONTACTFULL", "mjWARN_CNSTRFULL")
_sound: set[bytes] = set()
"""Digests of models that consist of one file and were found sound: these are tried once in a process."""


def compile_mjcf(mjcf: Path) -> mujoco.MjModel:
    """Compile a user's MJCF.

    A separate process tries it first, with limited memory and time. A texture of a million pixels per side, a
    body replicated a billion times or an error in MuJoCo's own code would otherwise end this process. A text
    that was sound before is not tried again, unless it names other files: these may have changed.

    Raises:
        ConfigurationError: It does not exist, does not compile, takes too much, or fails in the test steps.
    """
    path = Path(mjcf)
    if not path.exists():
        raise ConfigurationError(f"model {path} does not exist")
    with reading(f"model {path}", "MJCF", error=ConfigurationError):
        check_size(path, MJCF_BYTES)
        text = path.read_bytes()
        digest, whole = hashlib.sha256(text).digest(), b"file" not in text.lower()
        if not (whole and digest in _sound):
            _try(path)
        model = load_mjcf(path)
        if whole:
            _sound.add(digest)
        return model


def load_mjcf(mjcf: Path) -> mujoco.MjModel:
    """Compile a trusted MJCF.

    Raises:
        ConfigurationError: It does not compile.
    """
    try:
        return mujoco.MjModel.from_xml_path(str(mjcf))
    except (ValueError, mujoco.FatalError) as err:
        raise ConfigurationError(f"model {mjcf} does not compile: {short(str(err))}") from err


def _try(path: Path) -> None:
    """Compile and step in a separate process.

    Raises:
        ConfigurationError: That failed.
    """
    words = [sys.executable, "-m", "deal_hw.sim.engine.compiling", os.path.abspath(path)]
    # MuJoCo writes its log into the working directory, which must not be the user's.
    with tempfile.TemporaryDirectory(prefix="deal-hw-") as folder:
        try:
            done = subprocess.run(
                words,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=4 * SECONDS,
                check=False,
                cwd=folder,
            )
        except subprocess.TimeoutExpired as err:
            raise ConfigurationError(f"model {path} takes longer than {4 * SECONDS:g} s to compile") from err
    answer = done.stdout.rpartition(b"\n")[2]
    if done.returncode == 0 and answer.startswith(b"{"):
        problem = json.loads(answer)["problem"]
        if problem:
            raise ConfigurationError(f"model {path} {problem}")
        return
    raise ConfigurationError(
        f"model {path} cannot be compiled in {MEMORY_BYTES / MIB:g} MiB and {SECONDS:g} s (status "
        f"{done.returncode}: {short(done.stderr.decode(errors='replace')[-80:]) or 'no message'}); look for "
        "a size or a count with too many digits"
    )


def problem_of(path: str) -> str:
    """Return what is wrong with a model, "" for nothing."""
    try:
        model = mujoco.MjModel.from_xml_path(path)
    except (ValueError, mujoco.FatalError) as err:
        return f"does not compile: {short(str(err))}"
    for name in ("qpos0", "body_mass", "body_inertia", "body_pos", "geom_pos", "jnt_axis", "dof_armature"):
        if not np.isfinite(getattr(model, name)).all():
            return f"holds a number that is not finite ({name}); MuJoCo's own warning names the line"
    if not 0 < model.opt.timestep < 1:
        return f"has a timestep of {model.opt.timestep:g} s; write one above 0 and below 1 s"
    try:
        data = mujoco.MjData(model)
        for _ in range(STEPS):
            mujoco.mj_step(model, data)
    except (MemoryError, mujoco.FatalError) as err:
        return f"compiles, but cannot be simulated: {short(str(err))}; {_ROOM}"
    warned = {
        name for name in (*DIVERGED, *_OVERFULL) if data.warning[getattr(mujoco.mjtWarning, name)].number
    }
    if warned & set(_OVERFULL):
        return f"has more contacts than its memory holds; {_ROOM}"
    if warned:
        return f"diverges in its first {STEPS} steps; reduce the timestep, or correct masses and gains"
    return ""


def _main() -> None:
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    _limit(resource.RLIMIT_AS, used + MEMORY_BYTES)
    _limit(resource.RLIMIT_CPU, int(SECONDS))
    _limit(resource.RLIMIT_CORE, 0)
    answer: dict[str, Any] = {"problem": problem_of(sys.argv[1])}
    print("\n" + json.dumps(answer), end="", flush=True)
    # Damaged memory must not be touched by the interpreter's exit.
    os._exit(0)


def _limit(what: int, most: int) -> None:
    with contextlib.suppress(OSError, ValueError):
        _, hard = resource.getrlimit(what)
        resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


if __name__ == "__main__":
    _main()
