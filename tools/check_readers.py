"""Read files of deal-hw with other programs, and print a table.

    python tools/check_readers.py --environments build/readers
    python tools/check_readers.py --environments build/readers --only rerun lerobot --out readers.json

Each program gets an environment of its own, which the first call makes (some gigabytes, because lerobot and
mjlab install torch). LeRobot 0.4.4 needs an older torch and rerun than deal-hw, so no CI runs this.
`--pip-args` is passed on to pip. The exit code is 1 if a reader fails.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from measure_recording_size import CYCLE_NS, START_NS, cycles
from measuring import Rows, markdown, parser

from deal_hw.calib.report.page import write_result
from deal_hw.calibration import CalibrationResult, Identifiability
from deal_hw.clock import VirtualClock
from deal_hw.data.export.lerobot import export_lerobot
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.record import CycleRecord
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.robots import recorded_description
from deal_hw.sim.engine.model import load_model
from deal_hw.training import TrainingFiles
from deal_hw.types import Event, Trajectory
from deal_hw.workflows.import_export import ExportSettings, export_recordings
from deal_hw.workflows.train import nominal_distribution, train_policy

SCRIPTS = Path(__file__).resolve().parent / "readers"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """A program that reads files of deal-hw.

    Attributes:
        name: Its name in the table.
        packages: Packages for pip; none: the environment of deal-hw itself.
        script: A file of tools/readers.
        inputs: The samples that it reads, one run for each.
    """

    name: str
    packages: tuple[str, ...]
    script: str
    inputs: tuple[str, ...]


_MCAP = ("mcap", "mcap-ros2-support")
READERS = (
    Reader(
        name="mcap",
        packages=_MCAP,
        script="read_mcap.py",
        inputs=("episode_cartpole.mcap", "episode_go2.mcap"),
    ),
    Reader(
        name="foxglove",
        packages=("foxglove-sdk", "protobuf", *_MCAP),
        script="read_foxglove.py",
        inputs=("episode_go2.mcap", "scene/episode_cartpole.mcap"),
    ),
    Reader(name="rerun", packages=("rerun-sdk",), script="read_rerun.py", inputs=("episode_go2.mcap",)),
    Reader(
        name="lerobot",
        packages=("lerobot==0.4.4",),
        script="read_lerobot.py",
        inputs=("lerobot_one_motor", "lerobot_two_motors"),
    ),
    Reader(name="environments", packages=(), script="read_environments.py", inputs=("policy_sb3.zip",)),
    Reader(name="onnx", packages=("onnx", "onnxruntime"), script="read_onnx.py", inputs=("policy.onnx",)),
    Reader(name="mujoco", packages=("mujoco",), script="read_mujoco.py", inputs=("calibrated.xml",)),
    Reader(name="mjlab", packages=("mjlab",), script="read_mjlab.py", inputs=("actuators.yaml",)),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of a reader for an input."""

    reader: str
    versions: str
    input: str
    passed: bool
    words: str


def make_samples(folder: Path) -> None:
    """Write an episode of two robots, LeRobot exports with lost frames, a policy and a calibration."""
    for robot in ("cartpole", "go2"):
        made = cycles(robot, 100, np.random.default_rng(0))
        _record(folder / f"episode_{robot}.mcap", robot, made)
    export_recordings(
        ExportSettings(path=folder / "episode_cartpole.mcap", out=folder / "scene", format="foxglove")
    )
    # A cycle that never reached the recorder loses its samples, too.
    made = cycles("cartpole", 100, np.random.default_rng(1))
    _record(folder / "holes.mcap", "cartpole", [*made[:40], *made[41:]])
    both = [read_trajectory(folder / name) for name in ("episode_cartpole.mcap", "holes.mcap")]
    export_lerobot(both, folder / "lerobot_two_motors", "cartpole")
    export_lerobot([_cart_alone(t) for t in both], folder / "lerobot_one_motor", "cart")
    train_policy(
        "cartpole",
        nominal_distribution("cartpole"),
        folder / "policy.onnx",
        steps=1_200,
        members=8,
        files=TrainingFiles(checkpoint=folder / "policy.safetensors"),
    )
    space = k9_space()
    estimate = space.nominal * 1.1
    reported: list[Identifiability] = ["identifiable"] * (len(space) - 1)
    result = CalibrationResult(
        method="sample",
        space=space,
        estimate=estimate,
        interval=np.stack([0.9 * estimate, 1.1 * estimate], axis=1),
        verdicts=("not identifiable", *reported),
        latency_s=0.012,
        latency_interval_s=(0.011, 0.013),
    )
    write_result(folder, load_model(DESCRIPTION), result)


def _record(path: Path, robot: str, made: list[CycleRecord]) -> None:
    clock = VirtualClock(START_NS)
    with EpisodeRecorder(path, recorded_description(robot).to_json(), {}, clock) as recorder:
        for number, cycle in enumerate(made):
            clock.sleep_until_ns(cycle.start_ns + CYCLE_NS)
            events = (Event(cycle.start_ns, "clipped", "too far", {}),) if number == 3 else ()
            recorder.write(replace(cycle, events=events))


def _cart_alone(trajectory: Trajectory) -> Trajectory:
    """Return the recording of the driven joint alone."""
    description = {**trajectory.metadata["description"], "joint_names": ["cart"], "position_units": ["m"]}
    return replace(
        trajectory,
        joint_names=("cart",),
        position=trajectory.position[:, :1],
        velocity=trajectory.velocity[:, :1],
        effort=trajectory.effort[:, :1],
        metadata={**trajectory.metadata, "description": description},
    )


def python_of(reader: Reader, folder: Path, pip_args: list[str]) -> Path:
    """Return the reader's Python, after making its environment if necessary."""
    if not reader.packages:
        return Path(sys.executable)
    home, ready = folder / reader.name, folder / reader.name / ".ready"
    python = home / "bin" / "python"
    if not ready.exists():
        print(f"{reader.name}: installing {' '.join(reader.packages)}", file=sys.stderr, flush=True)
        subprocess.run([sys.executable, "-m", "venv", "--clear", str(home)], check=True)
        call = [str(python), "-m", "pip", "install", "--quiet", *pip_args, *reader.packages]
        subprocess.run(call, check=True, capture_output=True, text=True)
        ready.touch()
    return python


def check(reader: Reader, samples: Path, folder: Path, pip_args: list[str]) -> list[Finding]:
    """Return a reader's results for its inputs."""
    try:
        python = python_of(reader, folder, pip_args)
    except subprocess.CalledProcessError as error:
        words = f"not installed: {str(error.stderr or error).strip().splitlines()[-1]}"
        return [Finding(reader=reader.name, versions="", input="", passed=False, words=words)]
    names = [name.partition("==")[0] for name in reader.packages] or ["gymnasium", "stable-baselines3"]
    code = (
        "import sys, importlib.metadata as m; print(', '.join(f'{n} {m.version(n)}' for n in sys.argv[1:]))"
    )
    reported = subprocess.run([python, "-c", code, *names], capture_output=True, text=True, check=False)
    findings = []
    for name in reader.inputs:
        call = [str(python), str(SCRIPTS / reader.script), str(samples / name)]
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines() or ["no word"]
        findings.append(
            Finding(
                reader=reader.name,
                versions=reported.stdout.strip(),
                input=name,
                passed=done.returncode == 0,
                words=lines[-1],
            )
        )
    return findings


def main() -> int:
    """Print a row for each reader and input; return 1 if one fails."""
    made = parser(__doc__)
    made.add_argument("--environments", type=Path, required=True, help="folder for the environments; kept")
    made.add_argument("--only", nargs="*", choices=[r.name for r in READERS], help="these readers")
    made.add_argument("--pip-args", default="", help="passed on to every `pip install`")
    options = made.parse_args()
    chosen = [reader for reader in READERS if not options.only or reader.name in options.only]
    with tempfile.TemporaryDirectory() as folder:
        samples = Path(folder)
        make_samples(samples)
        findings = [
            finding
            for reader in chosen
            for finding in check(
                reader, samples, options.environments.resolve(), shlex.split(options.pip_args)
            )
        ]
    heads = ("reader", "versions", "input", "result", "output")
    words = {True: "pass", False: "FAIL"}
    lines = [(f.reader, f.versions, f"`{f.input}`", words[f.passed], f.words) for f in findings]
    print(markdown(heads, lines))
    Rows(__file__, options.out).keep([asdict(found) for found in findings])
    return 0 if all(found.passed for found in findings) else 1


if __name__ == "__main__":
    sys.exit(main())
