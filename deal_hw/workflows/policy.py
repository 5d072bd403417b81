"""``deal_hw.import_policy`` and ``check_policy``: policies that other trainers exported."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from deal_hw.data.files import write_bytes
from deal_hw.errors import ConfigurationError, MissingExtraError, short
from deal_hw.policy import IMPORTED, VERDICT, PolicySpec
from deal_hw.ranges import Checked, Range
from deal_hw.robots.entry import RobotEntry
from deal_hw.workflows.options import FROM_PYTHON, File, OneWord, from_settings
from deal_hw.workflows.policy_tables import joint_rows, policy_text, walk_text
from deal_hw.workflows.robot import entry_of
from deal_hw.workflows.say import Say, html_table, silent

if TYPE_CHECKING:
    from deal_hw.policies.importing.manifest import ForeignPolicy
    from deal_hw.policies.importing.network import ForeignNetwork
    from deal_hw.policies.importing.sources import PolicyFiles
    from deal_hw.policies.importing.supplement import Supplement
    from deal_hw.policies.walking_trial import WalkingReport

EXIT_OK, EXIT_RED = 0, 1
PROCESSOR_S = 120
TIME_LIMIT_S = 300.0
"""Limits of the network's process during a walk in the simulator [s]."""


def parse_names(text: str, option: str) -> tuple[str, ...]:
    """Return the names of a text with commas.

    Raises:
        ConfigurationError: There is none; the message begins with the option.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise ConfigurationError(
            f"{option} {short(repr(text), 40)} has no name; give names with commas between"
        )
    return names


Joints = Annotated[tuple[str, ...], OneWord(partial(parse_names, option="--joints"), "NAMES")]
Motors = Annotated[tuple[str, ...], OneWord(partial(parse_names, option="--motors"), "NAMES")]
Terms = Annotated[tuple[str, ...], OneWord(partial(parse_names, option="--observations"), "TERMS")]


@dataclass(frozen=True, kw_only=True)
class ImportPolicySettings(Checked):
    """Settings of :func:`import_policy`."""

    policy: File = field(kw_only=False)
    """What was exported: the network (.onnx, or .pt of TorchScript), or its folder."""

    robot: str
    """The robot that it was trained for, such as go2."""

    out: File
    """The file to write (.onnx), for `deal-hw deploy --policy`."""

    config: File | None = None
    """The side file: deploy.yaml of unitree_rl_lab or unitree_rl_mjlab, or the yaml of unitree_rl_gym. By
    default a deploy.yaml beside the network or in params/; without one, the metadata that mjlab writes into
    the network."""

    joints: Joints = ()
    """The policy's joints in its own order, by the robot's names with commas between, where the file has
    none, or other names."""

    motors: Motors = ()
    """The robot's joints in the order of the vendor's motor numbers, where deal-hw does not know it."""

    observations: Terms = ()
    """The terms of the observation in order, with commas between, where the file does not name them."""

    control_rate: Annotated[float | None, Range(1.0, 1000.0, "Hz")] = None
    """Control rate of the training [Hz], where the file does not say it."""

    observation_scales: str = ""
    """Factors of the observation's terms, where the file does not say them: one number for all, or
    base_ang_vel=0.2,joint_vel=0.05 (1 for the rest)."""

    history: str = ""
    """Values of each term, the present one included, where the file does not say it: one number for all, or
    joint_pos=5 (1 for the rest). The oldest comes first, term by term."""

    command_range: str = ""
    """Velocity commands of the training, where the file does not say them: low:high for x, y [m/s] and yaw
    [rad/s], such as -1:1,-0.5:0.5,-1:1."""

    clock: Annotated[float | None, Range(0.01, 100.0, "Hz")] = None
    """Turns per second of an observed gait clock, where the file does not say it [Hz]."""

    clock_at_rest: Literal["runs", "zero"] | None = None
    """Whether a gait clock runs on while the command is to stand, or reads zero; the file does not say it."""

    observation_clip: Annotated[float | None, Range(1e-3, 1e6)] = None
    """Largest absolute value of an observation before its factor, where the file does not say it; by default
    there is none."""

    force: bool = False
    """Write the file although the policy fails in the simulator; `deal-hw deploy` then asks before it runs
    it."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """From Python: called with each message."""


@dataclass(frozen=True, kw_only=True)
class CheckPolicySettings:
    """Settings of :func:`check_policy`."""

    policy: File = field(kw_only=False)
    """The policy (.onnx), as `deal-hw deploy` takes it."""

    robot: str = ""
    """The robot; by default that of the policy's name. A robot of yours by its robot.yaml."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """From Python: called with each message."""


@dataclass(frozen=True, kw_only=True)
class PolicyReport:
    """What was found out about a policy.

    Attributes:
        path: Its file; None if it was not written.
        spec: Its spec.
        walk: How it walked in the simulator; None if it could not be tried.
        untried: Why it could not be tried; "" if it was.
        faults: What is wrong, as sentences.
    """

    path: Path | None
    spec: PolicySpec
    walk: WalkingReport | None
    untried: str
    faults: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """For the shell: 0, or 1 if it failed and was not written."""
        return EXIT_RED if self.faults and self.path is None else EXIT_OK

    def table(self) -> str:
        """Return its tables as text: joints, observation, and how it walked."""
        walked = f"\n\n{walk_text(self.walk)}" if self.walk is not None else ""
        return policy_text(self.spec) + walked

    def _repr_html_(self) -> str:
        record = self.spec.training.get(IMPORTED)
        imported: Mapping[str, Any] = record if isinstance(record, Mapping) else {}
        head = ("", "joint", "default", "offset", "scale", "kp", "kd")
        return html_table(head, joint_rows(self.spec, imported))


@from_settings(ImportPolicySettings)
def import_policy(settings: ImportPolicySettings) -> PolicyReport:
    """Make a policy of another trainer one that deploys, as ``deal-hw policy import``.

    :class:`ImportPolicySettings` describes the arguments: ``import_policy("exported/policy.onnx",
    robot="go2", out="walk.onnx")``. The network is opened by a process without network and robot. Then the
    policy is tried on states of the robot, and on simulated robots if it walks.

    Returns:
        What was found. ``path`` is None if it failed in the simulator; ``force`` writes the file then, too.

    Raises:
        PolicyMismatchError: The policy is for other joints, or observes what is not measured.
        PolicyError: The network cannot be used.
        ConfigurationError: The side file or an option is wrong, or an answer is missing.
    """
    from deal_hw.policies.importing.manifest import adapter_of, spec_of
    from deal_hw.policies.importing.network import ForeignNetwork
    from deal_hw.policies.importing.sources import describe, find_source

    out = Path(settings.out)
    if out.suffix != ".onnx":
        raise ConfigurationError(f"--out {out}: the file to write is an .onnx file")
    entry = entry_of(settings.robot)
    description = entry.recorded_description()
    source = find_source(Path(settings.policy), None if settings.config is None else Path(settings.config))
    answers = _answers(settings, settings.motors or entry.motor_joints())
    with ForeignNetwork(source.network) as network, _draft(out) as draft:
        policy = describe(source, network.metadata, answers, settings.robot)
        network.open(policy.observations)
        record = _record(policy, source, network, answers)
        spec = spec_of(policy, description, recurrent=bool(network.memory), training={IMPORTED: record})
        adapter = adapter_of(policy, description)
        settings.say(policy_text(spec))
        write_bytes(draft, network.file(spec, adapter))
        tried = _tried(draft, entry, settings.say)
        verdict = "red" if tried.faults else "amber" if tried.untried else "green"
        others = f", and at {len(tried.faults) - 1} other commands" if len(tried.faults) > 1 else ""
        found = {
            "walk": _walk_record(tried.walk),
            "fault": tried.faults[0] + others if tried.faults else "",
            "untried": tried.untried,
        }
        final = dataclasses.replace(spec, training={IMPORTED: {**record, **found}, VERDICT: verdict})
        written = not tried.faults or settings.force
        if written:
            write_bytes(draft, network.file(final, adapter))
            os.replace(draft, out)
    return dataclasses.replace(tried, path=out if written else None, spec=final)


@from_settings(CheckPolicySettings)
def check_policy(settings: CheckPolicySettings) -> PolicyReport:
    """Try a policy on states of its robot, and on simulated robots if it walks, as ``deal-hw policy check``.

    The argument is the file: ``check_policy("walk.onnx")``.

    Raises:
        PolicyError: It must not run on the robot; the message says why.
        UnknownNameError: Its robot is not known.
    """
    path = Path(settings.policy)
    spec = read_policy(path)
    settings.say(policy_text(spec))
    tried = _tried(path, entry_of(settings.robot or spec.robot), settings.say)
    return dataclasses.replace(tried, path=None if tried.faults else path)


def read_policy(path: Path) -> PolicySpec:
    """Return the spec of a policy file, which another process opens.

    Raises:
        PolicyError: It cannot be read.
    """
    from deal_hw.policies.trial import TrialPolicy

    with TrialPolicy(path) as policy:
        return policy.spec


def _tried(path: Path, entry: RobotEntry, say: Say) -> PolicyReport:
    """Return how a policy does on states of a robot, and on simulated robots that walk."""
    from deal_hw.policies.trial import TrialPolicy, TrialSettings, try_policy

    description = entry.recorded_description()
    settings = TrialSettings(processor_s=PROCESSOR_S, time_limit_s=TIME_LIMIT_S)
    with TrialPolicy(path, settings) as policy:
        report = try_policy(policy, description)
        slowest = 1e3 * max(report.median_s.values())
        say(
            f"tried on {report.observations} states of {description.name}: the answers are finite and take "
            f"{slowest:.1f} ms"
        )
        try:
            from deal_hw.policies.walking_trial import can_try, try_walking
        except ModuleNotFoundError as err:
            raise MissingExtraError(str(err.name), "sim") from err
        untried = can_try(policy.spec, description, entry.feet)
        if not untried and policy.spec.recurrent and not policy.takes_batches:
            untried = "its recurrent network takes one observation at a time"
        if untried:
            say(f"not tried in the simulator: {untried}")
            return PolicyReport(path=path, spec=policy.spec, walk=None, untried=untried, faults=())
        floor = " on a floor, though it is driven on a crane only" if entry.feet else ""
        say(f"walking on simulated robots {description.name}{floor} ...")
        walk = try_walking(policy, description, feet=entry.feet)
    say(walk_text(walk))
    return PolicyReport(path=path, spec=report.spec, walk=walk, untried="", faults=walk.faults())


def _answers(settings: ImportPolicySettings, motors: tuple[str, ...]) -> Supplement:
    from deal_hw.policies.importing.supplement import Supplement

    own = {entry.name for entry in dataclasses.fields(Supplement)}
    given = {
        entry.name: getattr(settings, entry.name)
        for entry in dataclasses.fields(settings)
        if entry.name in own
    }
    # The robot's own order of motors is no answer of the operator's.
    known = set() if settings.motors else {"motors"}
    return Supplement(**{**given, "motors": motors, "used": known})


def _record(
    policy: ForeignPolicy, source: PolicyFiles, network: ForeignNetwork, answers: Supplement
) -> dict[str, Any]:
    """Return what the file notes about its import: names and digests, no places."""
    given = {
        name: value
        for name in sorted(answers.used - {"motors"})
        if (value := getattr(answers, name)) not in (None, "", ())
    }
    notes = list(policy.notes)
    if network.uncut:
        notes.append(f"the process that opened the network could not be cut off: {network.uncut}")
    return {
        "format": policy.format,
        "network": source.network.name,
        "network_sha256": network.digest,
        "config": source.config.name if source.config is not None else "",
        "actions": [action.joint for action in policy.actions],
        "terms": [term.name for term in policy.terms],
        "options": {name: list(v) if isinstance(v, tuple) else v for name, v in given.items()},
        "notes": notes,
    }


def _walk_record(walk: WalkingReport | None) -> list[dict[str, Any]]:
    if walk is None:
        return []
    return [
        {
            "command": list(one.command),
            "up": round(one.up, 3),
            "followed": round(one.followed, 3),
            "standing_up": round(still.up, 3),
        }
        for one, still in zip(walk.walks, walk.standing, strict=True)
    ]


@contextlib.contextmanager
def _draft(out: Path) -> Iterator[Path]:
    """Give the name of a file that is written first, so that an interrupted import leaves nothing."""
    draft = out.with_name(f".{out.stem}.draft.onnx")
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield draft
    finally:
        draft.unlink(missing_ok=True)
