"""The SO-101's part of ``deal-hw demo``: reach poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np

from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.cli.demo import Demonstrated, DemoSo101, Measure, Stages, read_truth, show_episode
from deal_hw.cli.demo_runs import deployed, numbers, recorded
from deal_hw.cli.deploy import KINDS as DEPLOY
from deal_hw.cli.deploy import deploy
from deal_hw.cli.train import KINDS as TRAIN
from deal_hw.cli.train import train
from deal_hw.data.run_folder import RunFolder
from deal_hw.drivers.so101.description import DRIVEN, WEIGHTED
from deal_hw.motions.joint_targets import JointTargets, make_targets
from deal_hw.types import FloatArray
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.shipped import required_policy

POSES: Final = 8
POSE_S: Final = 2.0
SHARE: Final = 0.6
"""Poses are drawn in this share of each joint's range of targets."""
STEPS: Final = 600_000
"""Steps of the training: some three minutes of one processor."""
EXCITE_S, HELDOUT_S = 6.0, 4.0
TIP_M: Final = (0.0, 0.0, -0.09)
"""The finger's tip in the frame of the body `gripper`, as the model draws it [m]."""
TRUTH_FILE: Final = "truth.json"


def check(config: DemoSo101) -> None:
    """Check settings. See :class:`deal_hw.cli.demo.Part`."""
    required_policy("so101")


def run(config: DemoSo101, folder: RunFolder, stages: Stages) -> Demonstrated:
    """Collect, calibrate, train, deploy, inspect. See :class:`deal_hw.cli.demo.Part`."""
    udr = required_policy("so101")
    out, times = config.folder, config.episodes or 1
    poses = write_poses(out / "poses.csv", config.seed)
    # The emulator has real-time priority: it runs only while the robot is needed.
    with _emulated(config) as robot:
        with stages.stage("collect", f"{EXCITE_S:g} s of a multisine; {HELDOUT_S:g} s of steps, held out"):
            multisine = recorded(partial(robot.collect, "multisine", EXCITE_S), "multisine")
            steps = recorded(partial(robot.collect, "", HELDOUT_S), "motion rich")
    with stages.stage("calibrate", "servo stiffness, friction, armature, encoder bias, latency"):
        found = calibrate(
            CalibrateDataset(
                dataset=folder.dataset,
                out=out,
                episodes=numbers(multisine),
                holdout=numbers(steps),
                seed=config.seed,
            )
        )
    policy = folder.policies / "calibrated.onnx"
    with stages.stage("train", "a policy under the calibrated distribution"):
        train(
            TRAIN.settings(
                robot="so101",
                distribution=found.files["distribution.json"],
                out=policy,
                steps=config.steps or STEPS,
                seed=config.seed,
            )
        )
    runs: dict[str, RunReport] = {}
    with _emulated(config) as robot:
        for name, file in (("udr", udr), ("retrained", policy)):
            with stages.stage(f"deploy {name}", f"{POSES} poses, {POSE_S:g} s each, over the port"):
                runs[name] = deployed(partial(robot.reach, name, file, poses), times, "deployment")
    with stages.stage("inspect", "real, nominal and calibrated on one screen"):
        episode = multisine.paths[0]
        rrd = show_episode(folder, episode)
    truth = read_truth(out / TRUTH_FILE)
    measures = reach_measures(runs, make_targets(str(poses), DRIVEN), truth["parameters"])
    return Demonstrated(
        found=found,
        truth=truth["parameters"],
        latency_s=truth["latency_s"],
        measures=measures,
        sentence=_sentence(measures),
        episode=episode,
        run=runs["retrained"],
        paths={"rrd": str(rrd), "mjcf": str(found.files["calibrated.xml"]), "policy": str(policy)},
    )


def write_poses(path: Path, seed: int) -> Path:
    """Write a script of random poses within the joints' ranges; return its path."""
    low, high = np.array(DRIVEN.limits.target).T
    rng = np.random.default_rng([seed, POSES])
    drawn = 0.5 * (low + high) + rng.uniform(-0.5, 0.5, (POSES, len(low))) * SHARE * (high - low)
    rows = np.column_stack([POSE_S * np.arange(POSES), drawn])
    head = ",".join(("time_s", *DRIVEN.actuated))
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.4f")
    return path


def reach_measures(
    runs: Mapping[str, RunReport], poses: JointTargets, truth: Mapping[str, float]
) -> list[Measure]:
    """Return the true errors of each policy's deployments at the ends of the poses' times.

    True positions are the reported ones less the hidden encoder biases.

    Args:
        runs: The deployments by policy.
        poses: The poses.
        truth: The hidden parameters.

    Returns:
        The joints' mean absolute error [rad], the same of the joints that carry weight, whose biases a
        recording shows, and the distance of the finger's tip [m].
    """
    bias = np.array([truth[f"{name}.encoder_bias"] for name in DRIVEN.actuated])
    weighted = [DRIVEN.actuated.index(name) for name in WEIGHTED]
    joints: dict[str, list[float]] = {}
    heavy: dict[str, list[float]] = {}
    tips: dict[str, list[float]] = {}
    for name, report in runs.items():
        for path in report.paths:
            off, tip = _errors(path, poses, bias)
            joints.setdefault(name, []).append(float(off.mean()))
            heavy.setdefault(name, []).append(float(off[:, weighted].mean()))
            tips.setdefault(name, []).append(tip)
    return [
        Measure(name=measure, unit=unit, values={policy: np.array(v) for policy, v in values.items()})
        for measure, unit, values in (
            ("joint_error_rad", "rad", joints),
            ("weighted_joint_error_rad", "rad", heavy),
            ("tip_error_m", "m", tips),
        )
    ]


def _errors(path: Path, poses: JointTargets, bias: FloatArray) -> tuple[FloatArray, float]:
    """Return the joints' mean absolute errors at each pose, (P, A) [rad], and the tip's mean error [m]."""
    from deal_hw.data.recording.reader import read_trajectory
    from deal_hw.motions.scores.reach import settled
    from deal_hw.sim.engine.kinematics import point_positions
    from deal_hw.sim.engine.model import load_model

    held = [positions - bias for positions in settled(read_trajectory(path), poses.time_s)]
    off = np.array([np.abs(true - pose).mean(axis=0) for true, pose in zip(held, poses.poses, strict=True)])
    tip = partial(point_positions, load_model(DRIVEN), "gripper", TIP_M)
    wanted = tip(poses.poses)
    tips = [
        np.linalg.norm(tip(true) - point, axis=1).mean() for true, point in zip(held, wanted, strict=True)
    ]
    return off, float(np.mean(tips))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Emulated:
    """An emulated SO-101 on its port."""

    config: DemoSo101
    port: str

    def collect(self, excite: Literal["multisine", ""], seconds: float, gentler: int) -> RunReport:
        """Record a motion; without a name of an excitation the motion `rich`."""
        return collect(
            COLLECT.settings(
                robot="so101",
                port=self.port,
                out=self.config.folder,
                excite=excite,
                seconds=seconds,
                seed=self.config.seed,
            )
        )

    def reach(self, name: str, policy: Path, poses: Path, episodes: int) -> RunReport:
        """Deploy a policy."""
        return deploy(
            DEPLOY.settings(
                robot="so101",
                port=self.port,
                policy=policy,
                target=str(poses),
                seconds=POSES * POSE_S,
                dataset=self.config.folder / f"deploy_{name}",
                episodes=episodes,
                task="reach",
            )
        )


@contextmanager
def _emulated(config: DemoSo101) -> Iterator[_Emulated]:
    """Yield the robot of the demo's seed; each time the same one."""
    hidden = ("--profile", config.profile, "--seed", str(config.seed))
    truth = ("--reveal-to", str(config.folder / TRUTH_FILE))
    with EmulatorProcess("so101", *hidden, *truth) as emulator:
        print(f"an emulated SO-101 ({config.profile}) with hidden physics is on {emulator.port}")
        yield _Emulated(config=config, port=emulator.port)


def _sentence(measures: list[Measure]) -> str:
    by_name = {measure.name: measure.values for measure in measures}

    def reached(policy: str) -> str:
        joint, tip = (by_name[name][policy].mean() for name in ("weighted_joint_error_rad", "tip_error_m"))
        return f"{1e3 * joint:.0f} mrad at the joints that carry weight, {1e3 * tip:.1f} mm at the tip"

    return (
        f"The policy trained under the calibration missed {POSES} poses by {reached('retrained')}; the "
        f"policy trained without recordings of this arm by {reached('udr')}. The zeros of shoulder_pan, "
        "wrist_roll and gripper leave no trace in a recording; their errors stay."
    )
