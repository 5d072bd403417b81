"""The cart-pole's part of ``deal-hw demo``: balance the pole."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

import numpy as np

from deal_hw.cli.calibrate import CalibrateDataset, calibrate
from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.cli.demo import DemoCartpole, Demonstrated, Measure, Stages, read_truth, show_episode
from deal_hw.cli.demo_runs import deployed, numbers, recorded
from deal_hw.cli.deploy import KINDS as DEPLOY
from deal_hw.cli.deploy import deploy
from deal_hw.cli.piped import PipedProgress
from deal_hw.cli.train import KINDS as TRAIN
from deal_hw.cli.train import train
from deal_hw.data.run_folder import RunFolder
from deal_hw.motions.excitation.level import LOWEST_LEVEL
from deal_hw.types import FloatArray
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import LinkOptions
from deal_hw.workflows.shipped import required_policy

EPISODES: Final = 3
TRUTH_FILE: Final = "truth.json"


def check(config: DemoCartpole) -> None:
    """Check settings. See :class:`deal_hw.cli.demo.Part`."""
    required_policy("cartpole")


def run(config: DemoCartpole, folder: RunFolder, stages: Stages) -> Demonstrated:
    """Collect, calibrate, train, deploy, inspect. See :class:`deal_hw.cli.demo.Part`."""
    udr = required_policy("cartpole")
    out, episodes = config.folder, config.episodes or EPISODES
    # The emulator has real-time priority: it runs only while the robot is needed.
    with _emulated(config) as robot:
        with stages.stage("collect", "4 s of informative motion, and 4 s of other motion as held-out data"):
            rich, chirp = (recorded(partial(robot.collect, kind), kind) for kind in ("rich", "chirp"))
    calibration = CalibrateDataset(
        dataset=folder.dataset, out=out, episodes=numbers(rich), holdout=numbers(chirp), seed=config.seed
    )
    with stages.stage("calibrate", "search, refinement, latency, intervals"):
        found = calibrate(calibration)
    with (
        stages.stage("calibrate deal", "the adversarial search alone, for comparison"),
        PipedProgress("calibrate deal", sys.stderr.isatty()),
    ):
        beside = calibrate(
            dataclasses.replace(calibration, out=out / "deal", search="deal", refine=False, quiet=True)
        )
    policy = folder.policies / "calibrated.onnx"
    with stages.stage("train", "a policy under the calibrated distribution"):
        train(
            TRAIN.settings(
                robot="cartpole",
                distribution=found.files["distribution.json"],
                out=policy,
                steps=config.steps,
                seed=config.seed,
            )
        )
    runs: dict[str, RunReport] = {}
    with _emulated(config) as robot:
        for name, file in (("udr", udr), ("retrained", policy)):
            with stages.stage(f"deploy {name}", f"{episodes} times 10 s over the port"):
                runs[name] = deployed(partial(robot.deploy, name, file), episodes, "deployment")
    with stages.stage("inspect", "real, nominal and calibrated on one screen"):
        episode = rich.paths[0]
        rrd = show_episode(folder, episode)
    truth = read_truth(out / TRUTH_FILE)
    scores = {name: task_scores(run, episodes) for name, run in runs.items()}
    return Demonstrated(
        found=found,
        truth=truth["parameters"],
        latency_s=truth["latency_s"],
        measures=[
            Measure(name=name, unit=unit, values={p: score[:, i] for p, score in scores.items()})
            for i, (name, unit) in enumerate((("angle_error_rad", "rad"), ("cart_speed_m_s", "m_s")))
        ],
        sentence=f"The policy trained under the calibration held {held(runs['retrained'])}; the policy "
        f"trained without recordings of this robot held {held(runs['udr'])}.",
        episode=episode,
        run=runs["retrained"],
        paths={"rrd": str(rrd), "mjcf": str(found.files["calibrated.xml"]), "policy": str(policy)},
        beside=beside.result,
        beside_name="deal",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Emulated:
    """An emulated cart-pole on its wire."""

    config: DemoCartpole
    port: str

    @property
    def _link(self) -> LinkOptions:
        return LinkOptions(transport=self.config.transport)

    def collect(self, motion: Literal["rich", "chirp"], gentler: int) -> RunReport:
        """Record a motion, some steps gentler where there are levels."""
        asked = COLLECT.settings(
            robot="cartpole",
            port=self.port,
            link=self._link,
            out=self.config.folder,
            motion=motion,
            seed=self.config.seed,
        )
        level = max(-float(gentler), LOWEST_LEVEL)
        return collect(dataclasses.replace(asked, excitation_level=level) if motion == "rich" else asked)

    def deploy(self, name: str, policy: Path, episodes: int) -> RunReport:
        """Deploy a policy."""
        return deploy(
            DEPLOY.settings(
                robot="cartpole",
                port=self.port,
                link=self._link,
                policy=policy,
                dataset=self.config.folder / f"deploy_{name}",
                episodes=episodes,
                task="balance",
            )
        )


@contextmanager
def _emulated(config: DemoCartpole) -> Iterator[_Emulated]:
    """Yield the robot of the demo's seed, at rest; each time the same one."""
    hidden = ("--profile", config.profile, "--seed", str(config.seed))
    wire = ("--transport", config.transport, "--firmware", config.firmware)
    truth = ("--reveal-to", str(config.folder / TRUTH_FILE))
    with EmulatorProcess("cartpole", *wire, *truth, *hidden) as emulator:
        print(f"an emulated cart-pole ({config.profile}) with hidden physics is on {emulator.port}")
        yield _Emulated(config=config, port=emulator.port)


def held(run: RunReport) -> str:
    """Return how long a policy held the pole up, over all deployments."""
    judged = [episode.balance for episode in run.episodes if episode.balance is not None]
    planned_s = sum(episode.planned_s for episode in run.episodes)
    count = len(run.episodes)
    return (
        f"the pole up for {sum(one.upright_s for one in judged):.1f} of {planned_s:.0f} s in {count} "
        f"deployment{'s' * (count != 1)}"
    )


def task_scores(run: RunReport, episodes: int) -> FloatArray:
    """Return mean |pole angle| [rad] and mean |cart speed| [m/s] of each deployment, (E, 2).

    If the safety filter ended a run early, the missing part counts as fallen: pi rad, and a cart at rest.
    """
    from deal_hw.data.recording.reader import read_trajectory
    from deal_hw.motions.scores.balance import TASK_SECONDS, balance_result

    scores = []
    for path in run.paths:
        motion = read_trajectory(path)
        period_s = float(np.median(np.diff(motion.device_s)))
        result = balance_result(motion.position, motion.velocity, period_s, TASK_SECONDS)
        scores.append((result.angle_error_rad, result.cart_speed_m_s))
    # After a trip no more episodes run. These count like the worst episode before.
    scores += [(np.pi, 0.0)] * (episodes - len(scores))
    return np.array(scores)
