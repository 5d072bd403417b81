"""``deal_hw.train``: train a policy under a parameter distribution."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np

from deal_hw.documentation import page
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution, ParameterSpace
from deal_hw.policy import VERDICT
from deal_hw.ranges import Checked, Range
from deal_hw.reading import read_json, reading
from deal_hw.robots import robot_entry, trained_robots
from deal_hw.sim.engine.gpu import WantedEngine
from deal_hw.training import TrainingFiles, TrainingProgress, TrainingStatus
from deal_hw.workflows.kinds import Arguments, InputKind, Kinds
from deal_hw.workflows.options import FROM_PYTHON, File, Seed, Threads, from_settings
from deal_hw.workflows.robot import described, is_user_robot
from deal_hw.workflows.robot_kinds import FILE
from deal_hw.workflows.say import Say, html_table, silent, text_table

if TYPE_CHECKING:
    from deal_hw.policies.onnx_runtime import OnnxPolicy

POLICY_FILE = Path("policies") / "policy.onnx"


class Calibrated(Protocol):
    """What training uses of a calibration; :class:`~deal_hw.workflows.calibrate.Calibration`."""

    @property
    def distribution(self) -> ParameterDistribution:
        """The calibrated distribution."""
        ...

    @property
    def colour(self) -> str:
        """Colour of the verdict."""
        ...


def policy_path(out: File) -> Path:
    """Return the policy's file of an ``--out``."""
    return Path(out) if Path(out).suffix == ".onnx" else Path(out) / POLICY_FILE


def unseen(status: TrainingStatus) -> None:
    """Show no progress."""


@dataclass(frozen=True, kw_only=True)
class TrainSettings(Checked):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    robot: str = field(default="cartpole", kw_only=False)
    """The robot."""

    distribution: File | ParameterDistribution | Calibrated | None = None
    """distribution.json of a calibration: parameters, their uncertainty, latency. From Python also a
    distribution or the return value of :func:`deal_hw.calibrate`."""

    nominal: bool = False
    """Train under the model's nominal values instead; latency as with --udr."""

    trainer: str | None = None
    """ppo, sac or rma: PPO of a policy that knows the simulated robot's parameters, then of a network that
    feels them. By default that of the robot's shipped policy."""

    out: File = Path("runs") / "train"
    """The .onnx file to write, or a run folder, in which the file is policies/policy.onnx. Checkpoint
    (.safetensors), record (.json) and TensorBoard's files are written beside the policy."""

    start: File | None = None
    """A checkpoint (.safetensors) to fine-tune. SAC also takes a model of stable-baselines3 (.zip); only its
    tensors are read."""

    resume: bool = False
    """Continue the stopped training that wrote to this --out."""

    steps: Annotated[int | None, Range(1, 10**9)] = None
    """Environment steps; by default as many as for the shipped policy."""

    members: Annotated[int | None, Range(1, 100_000)] = None
    """Robots simulated at once; by default as many as for the shipped policy."""

    seed: Seed = 0
    """Seed of all random numbers."""

    progress: Annotated[TrainingProgress, FROM_PYTHON] = unseen
    """From Python: called with the progress after each update."""


@dataclass(frozen=True, kw_only=True)
class TrainRobotSettings(TrainSettings):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    udr: bool = False
    """Train under uniform domain randomisation (UDR) instead: every parameter within a factor 5 of its
    nominal value (Go2, humanoid and hand: 1.75)."""

    engine: WantedEngine = "mujoco"
    """What simulates the robots. mujoco: one CPU core. warp: MuJoCo Warp on an NVIDIA GPU, where PPO's
    networks are, too; give --members 4096 or so (extra gpu). auto: warp where there is a GPU, the model can
    run there and there are enough members, else mujoco. warp-cpu: MuJoCo Warp without a GPU, to try it
    (docs/how-to/gpu.md)."""

    threads: Threads = 1
    """Simulation threads of mujoco; a policy does not depend on them."""


@dataclass(frozen=True, kw_only=True)
class TrainTaskSettings(TrainRobotSettings):
    """Train a policy under the calibrated distribution, or under uniform domain randomisation."""

    task: str = ""
    """One of the robot's further tasks (go2: canter, climb or terrain); by default its usual one."""


@dataclass(frozen=True, kw_only=True)
class TrainOwnSettings(TrainSettings):
    """Train a policy for your own robot in an environment of your own, under the calibrated distribution."""

    robot: str = field(kw_only=False)
    """A robot.yaml, or a dataset with its own robot.yaml."""

    nominal: bool = False
    """Train under the model's nominal values instead."""

    env: str
    """A Gymnasium environment of your own, module:ENV_ID. Parameters are drawn into its MuJoCo model at every
    reset."""


def _table() -> dict[str, InputKind]:
    drawn = "--distribution runs/first/calibration/distribution.json --out runs/first"
    robots = {
        name: InputKind(
            TrainTaskSettings if robot_entry(name).tasks else TrainRobotSettings, example=f"{name} {drawn}"
        )
        for name in trained_robots()
    }
    return {**robots, FILE: InputKind(TrainOwnSettings, example=f"{FILE} --env my_tasks:MyRobot-v0 {drawn}")}


def _find(arguments: Arguments) -> str:
    name = "cartpole" if arguments.first is None else str(arguments.first)
    if not is_user_robot(name):
        return name
    if "env" not in arguments.options:
        raise ConfigurationError(
            f"{name}: deal-hw has no training environment for this robot; name your own by --env "
            f"module:ENV_ID ({page('how-to/training.md')})"
        )
    return FILE


TRAIN = Kinds(noun="robot with a training environment", argument="robot", table=_table, find=_find)
"""The kinds of :func:`train`; without a robot it trains for the cart-pole."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """What a training made.

    Attributes:
        policy: The policy, read back from its file.
        path: The .onnx file.
        status: Progress at the end; None if it ended before the first update.
        first_return: Mean return of the first episodes; None if none ended. A new policy is then hardly
            trained. A resumed training has the return at its checkpoint.
    """

    policy: OnnxPolicy
    path: Path
    status: TrainingStatus | None
    first_return: float | None = None

    @property
    def record(self) -> Path:
        """The .json file with the settings of the training."""
        return self.path.with_suffix(".json")

    @property
    def checkpoint(self) -> Path:
        """The .safetensors file from which a training can continue."""
        return self.path.with_suffix(".safetensors")

    def table(self) -> str:
        """Return the training's progress and files, as text."""
        return text_table(("training", ""), self._cells())

    def _repr_html_(self) -> str:
        return html_table(("training", ""), self._cells())

    def _cells(self) -> list[tuple[str, Any]]:
        status = self.status
        reached: dict[str, Any] = {} if status is None else {"steps": status.steps}
        if status is not None and status.mean_return is not None:
            reached["mean return"] = f"{status.mean_return:.4g}"
        if self.first_return is not None:
            reached["mean return at first"] = f"{self.first_return:.4g}"
        measures = {} if status is None else {n: f"{v:.4g}" for n, v in status.measures.items()}
        files = {"policy": self.path, "record": self.record, "checkpoint": self.checkpoint}
        return list({**reached, **measures, **files}.items())


class InterruptedTrainingError(KeyboardInterrupt):
    """Ctrl-C, or a request to end; the policy so far was written.

    A ``KeyboardInterrupt``, so that a script does not go on and deploy a half-trained policy.

    Attributes:
        training: The files so far.
    """

    def __init__(self, training: Training) -> None:
        super().__init__("stopped before the end")
        self.training = training


@from_settings(TRAIN)
def train(settings: TrainSettings) -> Training:
    """Train a policy under a calibrated distribution, as ``deal-hw train``.

    ``deal-hw train ROBOT --help-all`` describes the arguments: ``train("cartpole",
    distribution=deal_hw.calibrate(...), out="runs/first")``.

    Returns:
        The policy and its files.

    Raises:
        InterruptedTrainingError: Ctrl-C, or a request to end; the policy so far was written.
        ConfigurationError: Not exactly one distribution was named, it cannot be read, or there is no training
        to continue.
        UnknownNameError: There is no such robot or trainer.
        TrainingError: The training diverged, or a checkpoint does not fit.
    """
    return run(settings, settings.progress)


def run(config: TrainSettings, progress: TrainingProgress, say: Say = silent) -> Training:
    """Train a policy, as :func:`train`, show the progress, and say what simulates."""
    path = policy_path(config.out)
    distribution, verdict = distribution_of(config)
    checkpoint = path.with_suffix(".safetensors")
    if config.resume and config.start is not None:
        raise ConfigurationError("--start and --resume exclude each other: leave one of them out")
    if config.resume and not checkpoint.exists():
        raise ConfigurationError(
            f"nothing to resume: {checkpoint} does not exist; leave out --resume, or give the --out of the "
            "training that was stopped"
        )
    reached: list[TrainingStatus] = []
    first: list[float] = []

    def follow(status: TrainingStatus) -> None:
        reached[:] = [status]
        if not first and status.mean_return is not None:
            first.append(status.mean_return)
        progress(status)

    with _stopped_by_signal() as stop:
        files = TrainingFiles(
            checkpoint=checkpoint,
            start=None if config.start is None else Path(config.start),
            resume=config.resume,
            log=path.with_name(path.stem + "_tensorboard"),
            stop=stop,
        )
        policy = train_policy(
            config.robot,
            distribution,
            path,
            trainer=config.trainer,
            seed=config.seed,
            steps=config.steps,
            members=config.members,
            progress=follow,
            files=files,
            verdict=verdict,
            env=config.env if isinstance(config, TrainOwnSettings) else "",
            task=config.task if isinstance(config, TrainTaskSettings) else "",
            engine=config.engine if isinstance(config, TrainRobotSettings) else "mujoco",
            threads=config.threads if isinstance(config, TrainRobotSettings) else 1,
            say=say,
        )
    training = Training(
        policy=policy,
        path=path,
        status=reached[0] if reached else None,
        first_return=first[0] if first else None,
    )
    if stop.requested:
        raise InterruptedTrainingError(training)
    return training


def train_policy(
    robot: str,
    distribution: ParameterDistribution,
    path: Path,
    *,
    trainer: str | None = None,
    seed: int = 0,
    steps: int | None = None,
    members: int | None = None,
    progress: TrainingProgress | None = None,
    files: TrainingFiles | None = None,
    verdict: str = "",
    env: str = "",
    task: str = "",
    engine: WantedEngine = "mujoco",
    threads: int | None = 1,
    say: Say = silent,
) -> OnnxPolicy:
    """Train a policy and write it with its training record.

    Args:
        robot: The robot's name.
        distribution: Distribution of parameters and latency.
        path: The .onnx file; the record is written beside it.
        trainer: The trainer's name; None for the robot's usual one.
        seed: Seed of all random numbers.
        steps: Environment steps; None for the default.
        members: Robots simulated at once; None for the default.
        progress: Called during the training.
        files: Checkpoint, TensorBoard files, and the request to stop.
        verdict: Colour of the distribution's calibration; "" if it is of none.
        env: Environment of a user, module:ENV_ID; "" for the robot's own task.
        task: Name of one of the robot's further tasks; "" for its usual one.
        engine: What simulates the robots of a task of ours.
        threads: Threads of that; None for all CPUs.
        say: Called with a sentence on that.

    Returns:
        The policy, read back from its file.
    """
    import dataclasses
    import inspect

    from deal_hw.policies.onnx_export import export_network
    from deal_hw.policies.tasks import OWN_TASK
    from deal_hw.robots import training_task

    chosen = OWN_TASK if env else training_task(robot, task)
    teacher, config = chosen.trainer_and_config(trainer, steps)
    count, description = members or chosen.usual_members(teacher.name), described(robot)
    if env:
        world = chosen.make(env, description, distribution, count)
    else:
        simulator = _simulator(robot, engine, threads, count, say)
        world = chosen.make(description, distribution, count, **simulator)
    # An unwritable path is reported now and not after the training.
    path.parent.mkdir(parents=True, exist_ok=True)
    started, cpu = time.monotonic(), time.process_time()
    reached: list[TrainingStatus] = []

    def follow(status: TrainingStatus) -> None:
        reached[:] = [status]
        if progress is not None:
            progress(status)

    spent = _spent(path.with_suffix(".json")) if files is not None and files.resume else {}
    policy = teacher.train(world, config, np.random.default_rng(seed), follow, files)
    record = {
        "format": "deal_hw.training/1",
        "robot": policy.spec.robot,
        "seed": seed,
        "training": dict(policy.spec.training),
        "task": dataclasses.asdict(world.task),
        "reward": inspect.cleandoc(type(world).__doc__ or "").partition("\n\nArgs:")[0],
        "distribution": distribution.to_json(),
        "distribution_digest": distribution.digest(),
        "spec_digest": policy.spec.digest(),
        "reached": dataclasses.asdict(reached[0]) if reached else {},
        "started_from": str(files.start or "") if files is not None else "",
        "seconds": spent.get("seconds", 0.0) + time.monotonic() - started,
        "engine": world.engine,
        "cpu_seconds": spent.get("cpu_seconds", 0.0) + time.process_time() - cpu,
        "resumed": files is not None and files.resume,
    }
    # `deploy` reads the calibration's verdict from the policy.
    training = {**policy.spec.training, **({VERDICT: verdict} if verdict else {})}
    return export_network(policy.network, dataclasses.replace(policy.spec, training=training), path, record)


def _simulator(
    robot: str, wanted: WantedEngine, threads: int | None, members: int, say: Say
) -> dict[str, Any]:
    """Return an environment's arguments of what simulates it, and say it; none where it is the usual."""
    if wanted != "mujoco":
        from deal_hw.sim.engine.model import load_model
        from deal_hw.sim.engine.warp_support import choose_engine

        engine = choose_engine(wanted, load_model(described(robot)), members, "the training", say)
        if engine != "mujoco":
            # Beside a GPU all processors derive the constants of restarted robots.
            return {"engine": engine, "threads": None}
    return {} if threads == 1 else {"threads": threads}


def _spent(record: Path) -> dict[str, float]:
    """Return wall-clock and CPU seconds of the resumed training from its record; empty without one."""
    if not record.exists():
        return {}
    values = read_json(
        record, dict[str, Any], "a training record", "`deal-hw train` writes it", error=ConfigurationError
    )
    return {name: float(values[name]) for name in ("seconds", "cpu_seconds")}


def distribution_of(config: TrainSettings) -> tuple[ParameterDistribution, str]:
    """Return the distribution of a training, and the colour of its calibration; "" if it is of none.

    Raises:
        ConfigurationError: Not exactly one was named, or it cannot be read.
    """
    udr, own = isinstance(config, TrainRobotSettings) and config.udr, isinstance(config, TrainOwnSettings)
    wanted = {
        "--distribution": config.distribution is not None,
        "--udr": udr,
        "--nominal": config.nominal,
    }
    given = [name for name, is_given in wanted.items() if is_given]
    if len(given) > 1:
        raise ConfigurationError(f"{' and '.join(given)} exclude each other: keep one of them")
    if not given:
        # Uniform domain randomisation needs ranges, and the parameters of a user's robot have none.
        others = "or --nominal" if own else "--udr or --nominal"
        raise ConfigurationError(
            f"no distribution is named: give --distribution FILE (`deal-hw calibrate` writes it), {others}"
        )
    source = config.distribution
    if source is None and own:
        return ParameterDistribution.point(ParameterSpace([]), np.empty(0), 0.0), ""
    if source is None:
        task = config.task if isinstance(config, TrainTaskSettings) else ""
        drawn = udr_distribution if udr else nominal_distribution
        return drawn(config.robot, task), ""
    if isinstance(source, ParameterDistribution):
        return source, ""
    if isinstance(source, str | Path):
        return _with_verdict(Path(source))
    return source.distribution, source.colour


def udr_distribution(robot: str, task: str = "") -> ParameterDistribution:
    """Return the distribution of uniform domain randomisation.

    Args:
        robot: The robot.
        task: Name of one of its further tasks; "" for its usual one.

    Raises:
        UnknownNameError: There is no such robot, or no such task.
    """
    from deal_hw.robots import default_space, training_task

    found = training_task(robot, task)
    return ParameterDistribution.uniform(
        default_space(robot).with_ratio(found.udr_ratio), found.udr_latency_s
    )


def nominal_distribution(robot: str, task: str = "") -> ParameterDistribution:
    """Return the distribution of the model's nominal values; only the latency is drawn.

    Args:
        robot: The robot.
        task: Name of one of its further tasks; "" for its usual one.

    Raises:
        UnknownNameError: There is no such robot, or no such task.
    """
    from deal_hw.robots import default_space, training_task

    found, space = training_task(robot, task), default_space(robot)
    K = len(space)
    return ParameterDistribution(
        space=space, mean=space.nominal, covariance=np.zeros((K, K)), latency_s=found.udr_latency_s
    )


def read_distribution(path: Path) -> ParameterDistribution:
    """Read a calibration's distribution.

    Raises:
        ConfigurationError: There is no such file, or it holds no distribution.
    """
    return _with_verdict(path)[0]


def _with_verdict(path: Path) -> tuple[ParameterDistribution, str]:
    """Return the distribution in a file and the colour of its verdict; "" if there is none."""
    what, advice = "a parameter distribution", "`deal-hw calibrate` writes calibration/distribution.json"
    values = read_json(path, dict[str, Any], what, advice, error=ConfigurationError)
    with reading(path, what, advice, error=ConfigurationError):
        return ParameterDistribution.from_json(values), str(values.get("verdict", ""))


class _Stop:
    """Whether a signal asked the training to stop.

    Attributes:
        requested: Whether one came.
    """

    def __init__(self) -> None:
        self.requested = self._asked = False

    def __call__(self) -> bool:
        """Return whether to stop, for the trainer, which asks from its first step on."""
        self._asked = True
        return self.requested

    def note(self) -> bool:
        """Note a signal, and return whether the trainer will stop by it.

        One that has not begun will not: there is nothing to keep, and the libraries that are being loaded
        would take many seconds on a busy computer.
        """
        self.requested = self._asked
        return self.requested


@contextlib.contextmanager
def _stopped_by_signal() -> Iterator[_Stop]:
    """Yield what notes the first SIGINT or SIGTERM in a training; others act as usual."""
    stop = _Stop()
    try:
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

        def note(number: int, frame: Any) -> None:
            usual = before[signal.Signals(number)]
            signal.signal(number, usual)
            if stop.note():
                return
            if callable(usual):
                # The command line must know of it: a library that is being loaded may swallow the exception.
                usual(number, frame)
            raise KeyboardInterrupt

        for number in before:
            signal.signal(number, note)
    except ValueError:
        # Only the main thread may set signal handlers.
        before = {}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
