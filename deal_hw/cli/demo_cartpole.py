"""The cart-pole's part of ``deal-hw demo``: balance the pole."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from deal_hw.cli.calibrate import Calibrate, calibrate
from deal_hw.cli.collect import Collect, collect
from deal_hw.cli.demo import Demo, Demonstrated, Measure, Stages, first_episode, read_truth, show_episode
from deal_hw.cli.deploy import Deploy, deploy
from deal_hw.cli.piped import PipedProgress
from deal_hw.cli.train import Train, train
from deal_hw.data.run_folder import RunFolder
from deal_hw.types import FloatArray
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.running.settings import LinkOptions
from deal_hw.workflows.shipped import required_policy

EPISODES = 3


def check(config: Demo) -> None:
    """Check settings. See :class:`deal_hw.cli.demo.Part`."""
    required_policy("cartpole")


def run(config: Demo, folder: RunFolder, stages: Stages) -> Demonstrated:
    """Collect, calibrate, train, deploy, inspect. See :class:`deal_hw.cli.demo.Part`."""
    udr = required_policy("cartpole")
    out, transport, episodes = config.folder, config.transport or "serial", config.episodes or EPISODES
    truth_file = out / "truth.json"
    options = ("--transport", transport, "--firmware", config.firmware, "--reveal-to", str(truth_file))
    hidden = ("--profile", config.profile, "--seed", str(config.seed))
    link = LinkOptions(transport=transport)
    with EmulatorProcess("cartpole", *options, *hidden) as emulator:
        port = emulator.port
        print(f"an emulated cart-pole ({config.profile}) with hidden physics is on {port}")
        with stages.stage("collect", "4 s of informative motion, and 4 s of other motion as held-out data"):
            for kind in ("rich", "chirp"):
                collect(
                    Collect(robot="cartpole", port=port, link=link, out=out, motion=kind, seed=config.seed)
                )
        with stages.stage("calibrate", "search, refinement, latency, intervals"):
            found = calibrate(Calibrate(dataset=folder.dataset, out=out, seed=config.seed))
        with (
            stages.stage("calibrate deal", "the adversarial search alone, for comparison"),
            PipedProgress("calibrate deal", sys.stderr.isatty()),
        ):
            beside = calibrate(
                Calibrate(
                    dataset=folder.dataset,
                    out=out / "deal",
                    method="deal",
                    refine=False,
                    seed=config.seed,
                    quiet=True,
                )
            )
        policy = folder.policies / "calibrated.onnx"
        with stages.stage("train", "a policy under the calibrated distribution"):
            train(
                Train(
                    robot="cartpole",
                    distribution=found.files["distribution.json"],
                    out=policy,
                    steps=config.steps,
                    seed=config.seed,
                )
            )
        runs: dict[str, RunReport] = {}
        for name, file in (("udr", udr), ("retrained", policy)):
            with stages.stage(f"deploy {name}", f"{episodes} times 10 s over the port"):
                runs[name] = deploy(
                    Deploy(
                        robot="cartpole",
                        port=port,
                        link=link,
                        policy=file,
                        dataset=out / f"deploy_{name}",
                        episodes=episodes,
                        task="balance",
                    )
                )
    with stages.stage("inspect", "real, nominal and calibrated on one screen"):
        episode = first_episode(folder.dataset)
        rrd = show_episode(folder, episode)
    truth = read_truth(truth_file)
    scores = {name: task_scores(out / f"deploy_{name}", episodes) for name in runs}
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


def held(run: RunReport) -> str:
    """Return how long a policy held the pole up, over all deployments."""
    judged = [episode.balance for episode in run.episodes if episode.balance is not None]
    planned_s = sum(episode.planned_s for episode in run.episodes)
    count = len(run.episodes)
    return (
        f"the pole up for {sum(one.upright_s for one in judged):.1f} of {planned_s:.0f} s in {count} "
        f"deployment{'s' * (count != 1)}"
    )


def task_scores(dataset: Path, episodes: int) -> FloatArray:
    """Return mean |pole angle| [rad] and mean |cart speed| [m/s] of each deployment, (E, 2).

    If the safety filter ended a run early, the missing part counts as fallen: pi rad, and a cart at rest.
    """
    from deal_hw.control.balance import TASK_SECONDS, balance_result
    from deal_hw.data.recording.dataset import Dataset

    store = Dataset.open(dataset)
    scores = []
    for index in range(len(store.episodes)):
        recorded = store.read(index).trajectory
        period_s = float(np.median(np.diff(recorded.device_s)))
        result = balance_result(recorded.position, recorded.velocity, period_s, TASK_SECONDS)
        scores.append((result.angle_error_rad, result.cart_speed_m_s))
    # After a trip no more episodes run. These count like the worst episode before.
    scores += [(np.pi, 0.0)] * (episodes - len(scores))
    return np.array(scores)
