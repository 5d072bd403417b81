"""Finds the files of an exported policy, and reads the one that describes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from deal_hw.errors import ConfigurationError, PolicyError
from deal_hw.policies.importing import mjlab, unitree_rl_gym, unitree_rl_lab
from deal_hw.policies.importing.manifest import ForeignPolicy
from deal_hw.policies.importing.supplement import Supplement

FORMATS: Final = (mjlab.FORMAT, unitree_rl_lab.FORMAT, unitree_rl_gym.FORMAT)
_NETWORKS: Final = (".onnx", ".pt")
_FOLDERS: Final = ("", "exported")
_SIDE_FILES: Final = ("params/deploy.yaml", "deploy.yaml")


@dataclass(frozen=True, slots=True)
class PolicyFiles:
    """The files of an exported policy.

    Attributes:
        network: The network, .onnx or .pt.
        config: The side file; None if the network's own metadata describe it.
    """

    network: Path
    config: Path | None


def find_source(path: Path, config: Path | None = None) -> PolicyFiles:
    """Return the files of an exported policy.

    Args:
        path: Its network, or its folder.
        config: The side file; by default a deploy.yaml beside the network, or in ``params`` as the exporters
            write it.

    Raises:
        PolicyError: There is no network, or there are several.
        ConfigurationError: The side file is not there.
    """
    if config is not None and not config.is_file():
        raise ConfigurationError(f"--config {config}: there is no such file")
    if path.is_dir():
        found = [
            file
            for folder in _FOLDERS
            for file in sorted((path / folder).glob("*"))
            if file.suffix in _NETWORKS and file.is_file()
        ]
        if len(found) != 1:
            listed = ", ".join(str(file.relative_to(path)) for file in found[:8]) or "none"
            raise PolicyError(
                f"{path} has {len(found)} networks (.onnx or .pt): {listed}; name the one to import"
            )
        network = found[0]
    else:
        network = path
        if network.suffix not in _NETWORKS:
            raise PolicyError(
                f"{path} is no network: .onnx and .pt (TorchScript) are known, or a policy's folder"
            )
        if not network.is_file():
            raise PolicyError(f"no such file: {path}")
    places = (
        (network.parent, network.parent.parent) if network.parent.name == "exported" else (network.parent,)
    )
    sides = [place / name for place in places for name in _SIDE_FILES]
    return PolicyFiles(network, config or next((file for file in sides if file.is_file()), None))


def describe(
    source: PolicyFiles, metadata: Mapping[str, str], answers: Supplement, robot: str
) -> ForeignPolicy:
    """Return the policy that a side file or the network's own metadata describe.

    Args:
        source: Its files.
        metadata: The network's own metadata.
        answers: What the operator says.
        robot: The robot's name.

    Raises:
        ConfigurationError: The format is not known, or a value is wrong or missing.
        PolicyMismatchError: A term is not measured.
    """
    if source.config is None:
        if not mjlab.is_metadata(metadata):
            raise ConfigurationError(
                f"{source.network} does not say what it observes: it has no metadata of mjlab, and there is "
                "no deploy.yaml beside it; name its side file: --config FILE (deploy.yaml of unitree_rl_lab, "
                "or the yaml of unitree_rl_gym's deploy_real)"
            )
        described, name = mjlab.parse(metadata, answers, robot), str(source.network)
    else:
        name = str(source.config)
        values = unitree_rl_lab.read_deploy_yaml(source.config)
        try:
            described = _described(values, metadata, answers, robot)
            if mjlab.is_metadata(metadata):
                mjlab.check_agrees(metadata, described)
        except (ConfigurationError, PolicyError) as err:
            err.args = (f"{name}: {err}",)
            raise
    answers.refuse_unused(name)
    return described


def _described(values: Any, metadata: Mapping[str, str], answers: Supplement, robot: str) -> ForeignPolicy:
    if unitree_rl_lab.is_deploy_yaml(values):
        return unitree_rl_lab.parse(values, answers, robot, mjlab.term_names(metadata))
    if unitree_rl_gym.is_deploy_yaml(values):
        return unitree_rl_gym.parse(values, answers, robot)
    other = _other(values)
    raise ConfigurationError(
        f"{other or 'this is no side file of a known format'}; imported are {_listed(FORMATS)}"
    )


def _other(values: Any) -> str:
    """Return the sentence on a format that is known but not imported; "" for none."""
    if not isinstance(values, Mapping):
        return ""
    inside = [values, *(value for value in values.values() if isinstance(value, Mapping))]
    if any("observations_history" in part or "rl_kp" in part or "num_of_dofs" in part for part in inside):
        return (
            "this is a config.yaml or base.yaml of rl_sar, which is not imported: its history is newest "
            "first, and its values are in two files; write a deploy.yaml with the same values"
        )
    if "articulations" in values and "observations" in values:
        return "this is an IO_descriptors.yaml of Isaac Lab, which is not imported; export a deploy.yaml"
    return ""


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
