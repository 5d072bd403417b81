"""Checkpoints of trainings: tensors in a safetensors file, which runs no code when read."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from deal_hw.errors import CheckpointError, PolicyError
from deal_hw.policy import PolicySpec

FORMAT: Final = "deal_hw.checkpoint/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """The saved state of a training.

    Attributes:
        tensors: Weights and the optimiser's state, by ``<part>.<name>``.
        notes: Plain JSON values, such as the trainer's name and the steps done.
        path: The file, for messages.
    """

    tensors: Mapping[str, torch.Tensor]
    notes: Mapping[str, Any]
    path: Path = Path()

    def check(self, **wanted: Any) -> None:
        """Check the values of notes.

        Raises:
            CheckpointError: One differs; the message names it.
        """
        for name, value in wanted.items():
            if self.notes.get(name) != value:
                raise CheckpointError(
                    f"{self.path}: {name} is {self.notes.get(name)!r}, this training has {value!r}; give a "
                    "checkpoint of the same kind, or train with its settings"
                )

    def check_resumed(self, layout: PolicySpec, steps: int) -> None:
        """Check that a training of so many steps in all can go on from here.

        Raises:
            CheckpointError: It is complete, or was done under another distribution.
        """
        if self.notes["trained_under"] != layout.trained_under:
            raise CheckpointError(
                f"{self.path} was trained under another distribution ({self.notes['trained_under']}, this "
                f"training's is {layout.trained_under}); resume with the same one, or fine-tune from it "
                "with --start"
            )
        if self.notes["steps"] >= steps:
            raise CheckpointError(
                f"{self.path} has done {self.notes['steps']} of {steps} steps: nothing is left to resume; "
                "give more --steps, or deploy its policy"
            )

    def part(
        self, part: str, like: Mapping[str, torch.Tensor], added: tuple[int, int] | None = None
    ) -> dict[str, torch.Tensor]:
        """Return the tensors of a part, which must have the names and shapes of ``like``.

        Args:
            part: Name of the part, as ``actor``.
            like: The tensors of this training's part.
            added: Where this training observes more than the checkpoint's: the first new input of the
                network and the number of new terms there. Further new inputs come last. New inputs have
                weight zero at first, so the network does what it did. None: nothing may be new.

        Raises:
            CheckpointError: They do not, or a number is not finite.
        """
        found = {
            name.removeprefix(part + "."): value
            for name, value in self.tensors.items()
            if name.startswith(part + ".")
        }
        if added is not None:
            found = {
                name: _widened(value, like[name], *added) if name in like else value
                for name, value in found.items()
            }
        wanted = {name: tuple(value.shape) for name, value in like.items()}
        have = {name: tuple(value.shape) for name, value in found.items()}
        if have != wanted:
            raise CheckpointError(
                f"{self.path}: the {part} has tensors {have}, this training's has {wanted}; give a "
                "checkpoint of the same task and settings"
            )
        if not all(bool(torch.isfinite(value).all()) for value in found.values()):
            raise CheckpointError(
                f"{self.path}: the {part} holds a number that is not finite; give another checkpoint"
            )
        return found


def _widened(weight: torch.Tensor, like: torch.Tensor, first: int, count: int) -> torch.Tensor:
    """Return a first layer's weight, (H, I), with zeros for new inputs; another tensor unchanged.

    Args:
        weight: The weight.
        like: One of the wanted shape.
        first: The first new input.
        count: Number of new inputs there; the others come last.
    """
    wider = weight.dim() == like.dim() == 2 and len(weight) == len(like)
    if not wider or like.shape[1] < weight.shape[1] + count:
        return weight
    found = torch.zeros_like(like)
    found[:, :first] = weight[:, :first]
    found[:, first + count : weight.shape[1] + count] = weight[:, first:]
    return found


def write_checkpoint(path: Path, checkpoint: Checkpoint, layout: PolicySpec) -> None:
    """Write a checkpoint; an existing file is replaced only by a complete one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    notes = {**checkpoint.notes, "format": FORMAT, "layout": layout.to_json()}
    draft = path.with_name(f".{path.name}.draft")
    try:
        tensors = {name: value.detach().contiguous() for name, value in checkpoint.tensors.items()}
        save_file(tensors, draft, metadata={"deal_hw": json.dumps(notes, sort_keys=True)})
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def read_checkpoint(path: Path, layout: PolicySpec, *, own: int | None = None) -> Checkpoint:
    """Read a checkpoint of a policy with this layout.

    The layout may observe more: further terms after those of the checkpoint. ``notes["observed"]`` is the
    number of terms that the checkpoint's policy observes, and ``notes["same_task"]`` whether it observes all
    of them, in the same range of requested velocities.

    Args:
        path: The file.
        layout: The layout of this training.
        own: Number of the task's own terms, where the trainer added others. A checkpoint that observes just
            these is of the same task, too.

    Raises:
        CheckpointError: The file is missing, is no checkpoint, or has another layout.
    """
    try:
        with safe_open(path, framework="pt") as file:
            notes = json.loads((file.metadata() or {}).get("deal_hw", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError, ValueError) as err:
        raise CheckpointError(
            f"the checkpoint {path} cannot be read ({err}); `deal-hw train` writes checkpoint.safetensors"
        ) from err
    if not isinstance(notes, dict) or notes.get("format") != FORMAT:
        raise CheckpointError(f"{path} is no checkpoint of deal-hw; `deal-hw train` writes one")
    try:
        found = PolicySpec.from_json(str(notes.get("layout")))
    except PolicyError as err:
        raise CheckpointError(f"{path} is damaged: its layout is {err}; give another checkpoint") from err
    wrong = [
        name
        for name in ("robot", "joint_names", "action_scale", "control_rate_hz", "clock_hz")
        if getattr(found, name) != getattr(layout, name)
    ]
    observed = len(found.observation)
    if found.observation != layout.observation[:observed]:
        wrong.append("observation")
    if wrong:
        raise CheckpointError(
            f"{path} is of a policy with another {', '.join(wrong)}; give a checkpoint of the same task"
        )
    same = observed in (len(layout.observation), own) and found.command_range == layout.command_range
    notes |= {"trained_under": found.trained_under, "observed": observed, "same_task": same}
    return Checkpoint(tensors=tensors, notes=notes, path=path)
