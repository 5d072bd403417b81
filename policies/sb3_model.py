"""The model of stable-baselines3 beside a checkpoint, to continue training with that library or with ours.

stable-baselines3 stores settings in it as pickles, which could run any code; our reader takes only the
tensors.
"""

from __future__ import annotations

import os
import re
import zipfile
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import load_from_zip_file

from deal_hw.errors import CheckpointError, short
from deal_hw.policies.checkpoint import Checkpoint, read_checkpoint
from deal_hw.policy import PolicySpec

OPTIMISERS = ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer")
_HIDDEN = re.compile(r"actor\.latent_pi\.\d+\.weight")
_UNREADABLE = (OSError, ValueError, KeyError, RuntimeError, UnpicklingError, zipfile.BadZipFile)


def model_path(checkpoint: Path) -> Path:
    """Return the model's path: ``policy_sb3.zip`` beside ``policy.safetensors``."""
    return checkpoint.with_name(f"{checkpoint.stem}_sb3.zip")


def write_model(path: Path, model: SAC) -> None:
    """Write a model; an existing file is replaced only by a complete one."""
    draft = path.with_name(f".{path.stem}.draft.zip")
    try:
        model.save(draft)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def read_start(path: Path, layout: PolicySpec) -> Checkpoint:
    """Read the start of a training: our checkpoint, or a model of stable-baselines3 (.zip).

    Raises:
        CheckpointError: It is neither, or of another task.
    """
    if path.suffix != ".zip":
        return read_checkpoint(path, layout)
    parameters, variables = _tensors(path)
    policy = parameters["policy"]
    hidden = [value.shape[0] for name, value in policy.items() if _HIDDEN.fullmatch(name)]
    tensors = {f"policy.{name}": value for name, value in policy.items()}
    tensors["entropy.log"] = variables["log_ent_coef"]
    return Checkpoint(tensors=tensors, notes={"trainer": "sac", "hidden": hidden, "steps": 0}, path=path)


def restore_optimisers(path: Path, model: SAC) -> bool:
    """Copy the optimisers' state from ``path`` to a model if the networks are equal; return whether.

    Raises:
        CheckpointError: The file cannot be read.
    """
    if not path.exists():
        return False
    parameters, _ = _tensors(path)
    mine = model.policy.state_dict()
    theirs = parameters["policy"]
    if mine.keys() != theirs.keys() or not all(torch.equal(mine[name], theirs[name]) for name in mine):
        return False
    model.set_parameters({name: parameters[name] for name in OPTIMISERS}, exact_match=False, device="cpu")
    return True


def _tensors(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    try:
        # Without its data, which are pickles; torch's own restricted reader reads the tensors.
        _, parameters, variables = load_from_zip_file(path, load_data=False, device="cpu")
        found, others = dict(parameters), dict(variables or {})
        if not {"policy", *OPTIMISERS} <= set(found) or "log_ent_coef" not in others:
            raise ValueError(f"it holds {', '.join(found) or 'nothing'}")
    except _UNREADABLE as err:
        raise CheckpointError(
            f"{path} cannot be read as a SAC model of stable-baselines3 "
            f"({short(str(err), 120) or type(err).__name__}); give one that `deal-hw train --trainer sac` or "
            "SAC.save wrote"
        ) from err
    return found, others
