"""``deal-hw policy``: import a policy that another trainer exported, show and check policies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.workflows.kinds import InputKind, sub_verbs
from deal_hw.workflows.policy import (
    CheckPolicySettings,
    ImportPolicySettings,
    PolicyReport,
    check_policy,
    import_policy,
    read_policy,
)
from deal_hw.workflows.policy_tables import policy_text
from deal_hw.workflows.say import Say


@dataclass(frozen=True, kw_only=True)
class PolicyImport(ImportPolicySettings):
    """Make a policy of mjlab, unitree_rl_lab or unitree_rl_gym one that `deal-hw deploy` runs.

    The file says joint order, poses, scales, gains, history and command ranges; what it does not say is asked
    for by the option that gives it. All is printed, then tried on states of the robot and by walking in the
    simulator. Two exchanged legs or a wrong sign fall there, and not on the robot: exit code 1, no file.
    See docs/how-to/policies-from-elsewhere.md.
    """

    policy: tyro.conf.Positional[Path]


@dataclass(frozen=True, kw_only=True)
class PolicyCheck(CheckPolicySettings):
    """Try a policy on states of its robot and, if it walks, in the simulator; exit code 1 if it fails."""

    policy: tyro.conf.Positional[Path]


@dataclass(frozen=True, kw_only=True)
class PolicyShow:
    """Show a policy's joints, gains, observation, rate and commands."""

    policy: tyro.conf.Positional[Path]
    """The policy (.onnx)."""


KINDS = sub_verbs(
    **{
        "import": InputKind(
            PolicyImport,
            example="import exported/policy.onnx --config params/deploy.yaml --robot go2 --out walk.onnx",
        ),
        "check": InputKind(PolicyCheck, example="check walk.onnx"),
        "show": InputKind(PolicyShow, example="show walk.onnx"),
    }
)


def policy(config: PolicyImport | PolicyCheck | PolicyShow) -> int | PolicyReport:
    """Run the verb.

    Returns:
        0, or the report, whose exit code is 1 if the policy failed in the simulator.

    Raises:
        PolicyError: The policy cannot be used.
        ConfigurationError: A side file or an option is wrong.
    """
    if isinstance(config, PolicyShow):
        print(policy_text(read_policy(config.policy)))
        return 0
    say: Say = print
    if isinstance(config, PolicyCheck):
        report = check_policy(**{**vars(config), "say": say})
        _print_faults(report)
        return report
    report = import_policy(**{**vars(config), "say": say})
    _print_faults(report)
    if report.path is not None:
        print(f"written: {report.path}")
        print(f"next: deal-hw deploy {config.robot} --port PORT --policy {report.path}")
    return report


def _print_faults(report: PolicyReport) -> None:
    for fault in report.faults:
        print(f"fault: {fault}")
    if report.faults:
        print(
            "A joint order, a sign, a scale or a history may be wrong, or the policy is not trained enough. "
            "Compare the tables with its training."
        )
        if report.path is None:
            print("not written; --force writes the file all the same, and deploy then asks before it runs it")
