"""The Go2's part of ``deal-hw demo``: walk, canter or climb."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from deal_hw.calib.report.verdict import trust
from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.cli.demo import DemoGo2, Demonstrated, Measure, Stages, read_truth, show_episode
from deal_hw.cli.demo_runs import deployed, numbers, recorded
from deal_hw.cli.deploy import KINDS as DEPLOY
from deal_hw.cli.deploy import deploy
from deal_hw.cli.train import KINDS as TRAIN
from deal_hw.cli.train import train
from deal_hw.control.process.channel import Outcome
from deal_hw.data.files import write_json
from deal_hw.data.recording.reader import read_episode
from deal_hw.data.run_folder import RunFolder
from deal_hw.documentation import page
from deal_hw.drivers.go2.descriptions.on_stand import on_floor
from deal_hw.motions.scores.velocity_error import Track, VelocityError, velocity_error, wanted_velocity
from deal_hw.sim.legged.terrain import DISTANCE_M
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.run import CalibrateReport
from deal_hw.workflows.collect import CollectGo2Settings
from deal_hw.workflows.emulation.go2 import read_track
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.emulation.walk_script import WALKS, write_script
from deal_hw.workflows.running.report import EpisodeReport, RunReport
from deal_hw.workflows.running.settings import LegOptions, LinkOptions
from deal_hw.workflows.shipped import required_policy
from deal_hw.workflows.train import read_distribution

STEPS: Final = 300_000
"""Steps of the fine-tune: about a minute of one processor."""
CLIMBS: Final = 3
CLIMB_M_S: Final = 0.6
CLIMB_S: Final = 6.0
BEYOND_M: Final = 0.3
"""How far behind the edge a base is when all feet are on the platform [m]: the hind ones are 0.2 m behind."""
PORTS: Final = {"dds": "lo", "zenoh": "tcp/127.0.0.1:0"}


def check(config: DemoGo2) -> None:
    """Check settings. See :class:`deal_hw.cli.demo.Part`."""
    required_policy("go2", config.task)


def run(config: DemoGo2, folder: RunFolder, stages: Stages) -> Demonstrated:
    """Walk, calibrate, fine-tune, walk again, inspect. See :class:`deal_hw.cli.demo.Part`."""
    udr = required_policy("go2", config.task)
    out, scripts = config.folder, WALKS[config.task]
    profile, heldout = (
        _Script(write_script(out / f"{name}.csv", walk.parts), walk.seconds)
        for name, walk in zip(("profile", "heldout"), scripts, strict=True)
    )
    walks: dict[str, _Walked] = {}
    tries = _climbed(config, stages, {"udr": udr})
    # A robot that climbs walks once, for the calibration.
    times = 1 if tries else config.episodes or 1
    # The emulator takes a third of a processor, so it runs only while the robot is needed.
    with _emulated(config, "before") as robot:
        gait = "canter" if config.task == "canter" else "walk"
        words = f"stand up, {gait} {profile.seconds:g} s on a flat floor, lie down; {times} times"
        with stages.stage("walk udr", words):
            walks["udr"] = robot.whole_walk(udr, profile, folder.dataset, times)
        if not config.on_stand:
            with stages.stage("walk held-out", f"{heldout.seconds:g} s of other velocities as held-out data"):
                judge = robot.whole_walk(udr, heldout, folder.dataset, 1)
    if config.on_stand:
        found, distribution, episode = _on_stand(config, folder, stages)
    else:
        with stages.stage("calibrate", "gains and friction from joints, feet and IMU; payload from efforts"):
            found = calibrate(
                CalibrateDataset(
                    dataset=folder.dataset,
                    out=out,
                    space="walk",
                    episodes=numbers(walks["udr"].report),
                    holdout=numbers(judge.report),
                    seed=config.seed,
                )
            )
        distribution, episode = found.files["distribution.json"], walks["udr"].report.paths[0]
    policies = _fine_tuned(config, folder, stages, distribution, udr)
    tries |= _climbed(config, stages, policies)
    with _emulated(config, "after") as robot:
        for name, policy in policies.items():
            with stages.stage(f"walk {name}", "the same velocities again"):
                walks[name] = robot.walk(policy, profile, out / f"walk_{_in_paths(name)}", times)
    with stages.stage("inspect", "real, nominal and calibrated on one screen"):
        rrd = show_episode(folder, episode)
    truth = read_truth(out / "truth_after.json")
    true = truth["parameters_at_kp20_kd1.5" if config.on_stand else "walk_parameters"]
    return Demonstrated(
        found=found,
        truth=true,
        latency_s=1e-3 * truth["latency_ms"],
        measures=(measures := [*_measures(walks), *_climb_measures(tries)]),
        sentence=_climb_sentence(config.platform, tries) if tries else _sentence(measures),
        episode=episode,
        run=walks["calibrated"].report,
        paths={
            "rrd": str(rrd),
            "mjcf": str(found.files["calibrated.xml"]),
            "policy": str(policies["calibrated"]),
        },
    )


@dataclass(frozen=True, slots=True)
class _Script:
    """A file of requested velocities, and how long they are followed [s]."""

    file: Path
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Walked:
    """Walks of one policy: the report, and the file of the true base positions."""

    report: RunReport
    track: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class _Emulated:
    """An emulated Go2 on its wire."""

    port: str
    link: LinkOptions
    track: Path

    def walk(self, policy: Path, script: _Script, dataset: Path, times: int) -> _Walked:
        """Run a policy on the robot; a walk that only came late is walked again."""
        once = partial(self._walk, policy, script, dataset)
        return _Walked(report=deployed(once, times, "walk"), track=self.track)

    def whole_walk(self, policy: Path, script: _Script, dataset: Path, times: int) -> _Walked:
        """Run a policy; repeat if a walk ended early or its recording cannot be used for calibration.

        Raises:
            SafetyError: No walk could be used.
        """
        once = partial(self._walk, policy, script, dataset)
        report = recorded(lambda _: once(times), "walk", times)
        return _Walked(report=report, track=self.track)

    def climb(self, policy: Path, height: float, dataset: Path) -> bool:
        """Run a policy towards the platform, once; return whether the robot came onto it and stayed up.

        The platform is as wide as it is long, so a robot whose base is beyond the edge stands on it.
        """
        legs = LegOptions(
            velocity=f"{CLIMB_M_S:g},0,0", hold_heading=True, obstacle=f"{DISTANCE_M:g},{height:g}"
        )
        once = partial(self._deploy, policy, legs, CLIMB_S, dataset, "climb")
        report = deployed(once, 1, "climb")
        x = read_track(self.track).place[:, 0]
        beyond = bool(np.any(x > DISTANCE_M + BEYOND_M))
        return beyond and report.episodes[-1].outcome is Outcome.FINISHED

    def _walk(self, policy: Path, script: _Script, dataset: Path, times: int) -> RunReport:
        return self._deploy(
            policy, LegOptions(velocity=str(script.file)), script.seconds, dataset, "walk", times
        )

    def _deploy(
        self, policy: Path, legs: LegOptions, seconds: float, dataset: Path, task: str, times: int
    ) -> RunReport:
        return deploy(
            DEPLOY.settings(
                robot="go2",
                port=self.port,
                link=self.link,
                legs=legs,
                policy=policy,
                seconds=seconds,
                dataset=dataset,
                episodes=times,
                task=task,
            )
        )


@contextmanager
def _emulated(config: DemoGo2, name: str, *options: str) -> Iterator[_Emulated]:
    """Yield the robot of the demo's seed. Its truth and its track go to files of this name."""
    out, transport = config.folder, config.transport
    track = out / f"truth_track_{name}.csv"
    wire = ("--transport", transport, "--port", PORTS[transport])
    hidden = ("--profile", config.profile, "--seed", str(config.seed))
    files = ("--reveal-to", str(out / f"truth_{name}.json"), "--track-to", str(track))
    with EmulatorProcess("go2", *wire, *hidden, *files, *options) as emulator:
        print(f"an emulated Go2 ({config.profile}) with hidden physics is on {emulator.port}")
        # The demo needs no raw bytes, and they are half of the recorder's work.
        link = LinkOptions(transport=transport, record_wire=False)
        yield _Emulated(port=emulator.port, link=link, track=track)


def _climbed(config: DemoGo2, stages: Stages, policies: Mapping[str, Path]) -> dict[str, list[bool]]:
    """Let policies climb, each time with the same robot at its start; return which tries succeeded.

    Nothing for another task.
    """
    if config.task != "climb":
        return {}
    height, times = config.platform, config.episodes or CLIMBS
    tries: dict[str, list[bool]] = {}
    for name, policy in policies.items():
        part = f"climb_{_in_paths(name)}"
        with stages.stage(f"climb {name}", f"a platform of {height:g} m, {times} times"):
            for number in range(times):
                terrain = ("--terrain", f"box:{height:g},{DISTANCE_M:g}")
                with _emulated(config, f"{part}_{number}", *terrain) as robot:
                    done = robot.climb(policy, height, config.folder / part)
                tries.setdefault(name, []).append(done)
                print(f"try {number + 1} of {times}: {'on the platform' if done else 'not climbed'}")
    return tries


def _on_stand(config: DemoGo2, folder: RunFolder, stages: Stages) -> tuple[CalibrateReport, Path, Path]:
    """Record the same robot on a stand and calibrate from that.

    Returns:
        The calibration, the file of its distribution for the robot on the floor, and the fitted recording.
    """
    out, dataset = config.folder, config.folder / "dataset_on_stand"
    runs: list[RunReport] = []
    with _emulated(config, "on_stand", "--on-stand") as robot:
        with stages.stage("collect on a stand", "10 s of a multisine, and 8 s of a sweep as held-out data"):
            for excite, seconds in (("multisine", 10.0), ("chirp", 8.0)):
                motion = COLLECT.settings(
                    robot="go2_on_stand",
                    port=robot.port,
                    link=robot.link,
                    dataset=dataset,
                    excite=excite,
                    seconds=seconds,
                    seed=config.seed,
                )
                runs.append(recorded(partial(_collected, motion), excite))
    with stages.stage("calibrate", "gains, friction and armature of each joint"):
        found = calibrate(
            CalibrateDataset(
                dataset=dataset,
                out=out,
                episodes=numbers(runs[0]),
                holdout=numbers(runs[1]),
                method="local",
                sample_hz=100.0,
                seed=config.seed,
            )
        )
    file = out / "distribution_floor.json"
    values = on_floor(read_distribution(found.files["distribution.json"])).to_json()
    write_json(file, values | {"verdict": trust(found.result).colour})
    return found, file, runs[0].paths[0]


def _collected(motion: CollectGo2Settings, gentler: int) -> RunReport:
    return collect(motion)


def _fine_tuned(
    config: DemoGo2, folder: RunFolder, stages: Stages, found: Path, udr: Path
) -> Mapping[str, Path]:
    """Fine-tune the shipped policy under the calibration, and as long under UDR for comparison."""
    policies = {name: folder.policies / f"{_in_paths(name)}.onnx" for name in ("udr more", "calibrated")}
    for name, policy in policies.items():
        distribution = found if name == "calibrated" else None
        with stages.stage(f"train {name}", "some more training steps of the shipped policy"):
            train(
                TRAIN.settings(
                    robot="go2",
                    task="" if config.task == "walk" else config.task,
                    distribution=distribution,
                    udr=distribution is None,
                    start=udr.with_suffix(".safetensors"),
                    out=policy,
                    steps=config.steps or STEPS,
                    seed=config.seed,
                )
            )
    return policies


def _in_paths(name: str) -> str:
    """Return a stage's name without spaces: users paste the paths."""
    return name.replace(" ", "_")


def _errors(report: EpisodeReport, track: Track) -> tuple[VelocityError | None, bool]:
    """Return the true errors of a walk, and whether the robot fell or was stopped."""
    fell = report.outcome is not Outcome.FINISHED
    if report.path is None:
        return None, fell
    episode = read_episode(report.path)
    wanted = wanted_velocity(episode.trajectory)
    if wanted is None:
        return None, fell
    # The track is on the robot's clock, the requested velocities on the host's.
    late = float(np.median(episode.trajectory.receive_s - episode.trajectory.device_s))
    shifted = Track(track.time_s - episode.device_start_ns * 1e-9 + late, track.place, track.heading)
    return velocity_error(shifted, wanted), fell


def _measures(walks: Mapping[str, _Walked]) -> list[Measure]:
    """Return true errors, errors by the robot's own sensors, and falls."""
    tracks = {name: read_track(walk.track) for name, walk in walks.items()}
    true = {
        name: [_errors(report, tracks[name]) for report in walk.report.episodes]
        for name, walk in walks.items()
    }
    own = {name: [report.walk for report in walk.report.episodes] for name, walk in walks.items()}

    def each(errors: Mapping[str, Sequence[VelocityError | None]], name: str) -> dict[str, FloatArray]:
        return {
            policy: np.array([np.nan if one is None else getattr(one, name) for one in found])
            for policy, found in errors.items()
        }

    judged = {name: [error for error, _ in found] for name, found in true.items()}
    falls = {name: np.array([float(fell) for _, fell in found]) for name, found in true.items()}
    return [
        Measure(name="velocity_error_m_s", unit="m_s", values=each(judged, "velocity_m_s")),
        Measure(name="yaw_error_rad_s", unit="rad_s", values=each(judged, "yaw_rad_s")),
        Measure(name="estimated_velocity_error_m_s", unit="m_s", values=each(own, "velocity_m_s")),
        Measure(name="falls", values=falls),
    ]


def _climb_measures(tries: Mapping[str, Sequence[bool]]) -> list[Measure]:
    """Return the share of tries that climbed; nothing if no robot climbed."""
    if not tries:
        return []
    return [
        Measure(name="climbed", values={name: np.array(done, dtype=float) for name, done in tries.items()})
    ]


def _climb_sentence(height: float, tries: Mapping[str, Sequence[bool]]) -> str:
    """Return a sentence on how often the policies climbed, as measured."""
    done = {name: f"{sum(found)} of {len(found)}" for name, found in tries.items()}
    return (
        f"Onto a platform of {height:g} m: the policy fine-tuned under the calibration {done['calibrated']} "
        f"times, the policy fine-tuned as long without it {done['udr more']}, the shipped policy "
        f"{done['udr']}. With so few tries only large differences mean something: "
        f"{page('how-to/go2-gaits.md')} has five robots."
    )


def _sentence(measures: Sequence[Measure]) -> str:
    """Return a sentence on how well the policies followed the requested velocities, as measured."""
    by_name = {measure.name: measure.values for measure in measures}

    def walked(policy: str) -> str:
        errors, falls = by_name["velocity_error_m_s"][policy], by_name["falls"][policy]
        seen = errors[np.isfinite(errors)]
        missed = f"missed the velocity by {seen.mean():.3f} m/s" if seen.size else "was not judged"
        return f"{missed} in {seen.size} of {errors.size} walks, {falls.sum():.0f} of which ended early"

    return (
        f"The policy fine-tuned under the calibration {walked('calibrated')}; the policy fine-tuned as "
        f"long without it {walked('udr more')}; the shipped policy {walked('udr')}. Differences below "
        f"0.02 m/s are chance: two trainings with one setting differ as much (five robots: "
        f"{page('results/bench.md')})."
    )
