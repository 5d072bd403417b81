"""Compiles a user's MJCF: the result is a model that can be simulated, or a one-line error."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.child_process import signal_at_end_of_parent
from deal_hw.errors import ConfigurationError, short
from deal_hw.reading import MIB, check_size, reading
from deal_hw.sim.parameters.one_drive import gather

MJCF_BYTES: Final = 64 * MIB
"""Largest main file of a model; included files count as memory."""
MEMORY_BYTES: Final = 4096 * MIB
"""Memory limit of compiling a model and its first steps."""
SECONDS: Final = 30
"""Processor time limit of the same [s]. Sixty meshes of 40,000 faces each took 7.5 s."""
STEPS: Final = 10
"""Number of test steps before a model is used."""
DIVERGED: Final = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
"""Warnings after which MuJoCo starts again from the reference pose."""
_ROOM: Final = "keep bodies apart (contype, exclude), or write a larger <size memory=.../>"
_TOO_LARGE: Final = "look for a size or a count with too many digits, as of a replicate or a texture"
_OVERFULL: Final = ("mjWARN_CONTACTFULL", "mjWARN_CNSTRFULL")


@dataclass(frozen=True, slots=True)
class _Stamp:
    """What changes with the content of a file."""

    size: int
    changed_ns: int

    @classmethod
    def of(cls, path: str) -> _Stamp | None:
        """Return that of a file; None without such a file."""
        try:
            found = os.stat(path)
        except OSError:
            return None
        return cls(found.st_size, found.st_mtime_ns)


_sound: dict[tuple[str, bytes], dict[str, _Stamp | None]] = {}
"""The other files of each model that was found sound, by its path and the digest of its text. A model of one
file has no path here, so that copies of it are known, too."""


def compile_mjcf(mjcf: Path) -> mujoco.MjModel:
    """Compile an MJCF: the one way from a file to a model.

    A separate process tries it first, with limited memory and time. A texture of a million pixels per side, a
    body replicated a billion times or an error in MuJoCo's own code would otherwise end this process, or
    never end. A model that is shipped with the program is not tried, nor one that was sound before, unless
    one of its files has changed.

    Raises:
        ConfigurationError: It does not exist, does not compile, takes too much, or fails in the test steps.
    """
    path = Path(mjcf)
    if _shipped(path):
        return _compiled(path)
    if not path.exists():
        raise ConfigurationError(f"model {path} does not exist")
    with reading(f"model {path}", "MJCF", error=ConfigurationError):
        check_size(path, MJCF_BYTES)
        text = path.read_bytes()
        whole = b"file" not in text.lower()
        key = ("" if whole else os.path.abspath(path), hashlib.sha256(text).digest())
        known = _sound.get(key)
        if known is None or any(_Stamp.of(name) != stamp for name, stamp in known.items()):
            files = _try(path)
            known = {} if whole else {name: _Stamp.of(name) for name in files if name != key[0]}
        model = _compiled(path)
        _sound[key] = known
        return model


def _shipped(path: Path) -> bool:
    """Return whether a file lies in the program's own folders, and is trusted as its code is.

    In a checkout some parts of the package lie beside it; a robot's part is loaded before its model.
    """
    own = __name__.partition(".")[0]
    parts = [module for name, module in list(sys.modules.items()) if name.partition(".")[0] == own]
    folders = {_real(root) for part in parts for root in getattr(part, "__path__", ())}
    return not folders.isdisjoint(map(str, path.resolve().parents))


@functools.cache
def _real(folder: str) -> str:
    """Return the path of a package's folder without links; it costs as much as compiling a small model."""
    return os.path.realpath(folder)


def _compiled(path: Path) -> mujoco.MjModel:
    """Compile in this process, with one drive a joint (:mod:`deal_hw.sim.parameters.one_drive`).

    Raises:
        ConfigurationError: It does not compile.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as err:
        raise ConfigurationError(f"model {path} does not compile: {short(str(err))}") from err
    gather(model)
    return model


def _try(path: Path) -> list[str]:
    """Compile and step in a separate process, which ends with this one; return the model's files.

    Raises:
        ConfigurationError: That failed.
    """
    words = [sys.executable, "-m", "deal_hw.sim.engine.compiling"]
    words += [str(os.getpid()), str(SECONDS), os.path.abspath(path)]
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
                # Without its library for windows, MuJoCo loads in two thirds of the time.
                env={**os.environ, "MUJOCO_GL": "disable"},
            )
        except subprocess.TimeoutExpired as err:
            raise ConfigurationError(
                f"model {path} was not compiled after {4 * SECONDS:g} s; {_TOO_LARGE}, or end other programs"
            ) from err
    if done.returncode == -signal.SIGXCPU:
        raise ConfigurationError(
            f"model {path} was not compiled after {SECONDS:g} s of processor time; {_TOO_LARGE}"
        )
    answer = done.stdout.rpartition(b"\n")[2]
    if done.returncode == 0 and answer.startswith(b"{"):
        found = json.loads(answer)
        if found["problem"]:
            raise ConfigurationError(f"model {path} {found['problem']}")
        return list(map(str, found["files"]))
    raise ConfigurationError(
        f"model {path} cannot be compiled in {MEMORY_BYTES / MIB:g} MiB (status {done.returncode}: "
        f"{short(done.stderr.decode(errors='replace')[-80:]) or 'no message'}); {_TOO_LARGE}"
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
    parent, seconds, path = sys.argv[1:]
    signal_at_end_of_parent(int(parent))
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    _limit(resource.RLIMIT_AS, used + MEMORY_BYTES)
    _limit(resource.RLIMIT_CPU, int(seconds))
    _limit(resource.RLIMIT_CORE, 0)
    problem = problem_of(path)
    files = [] if problem else mujoco.mju_getXMLDependencies(path)
    answer: dict[str, Any] = {"problem": problem, "files": [os.path.normpath(name) for name in files]}
    print("\n" + json.dumps(answer), end="", flush=True)
    # Damaged memory must not be touched by the interpreter's exit.
    os._exit(0)


def _limit(what: int, most: int) -> None:
    with contextlib.suppress(OSError, ValueError):
        _, hard = resource.getrlimit(what)
        resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


if __name__ == "__main__":
    _main()
