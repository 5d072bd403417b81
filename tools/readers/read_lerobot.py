"""Opens an exported dataset with LeRobotDataset and takes a batch with a history of actions from it."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def main(folder: Path) -> None:
    """Read every frame, and a batch as a policy's training does."""
    dataset = LeRobotDataset(f"deal-hw/{folder.name}", root=folder)
    joints = dataset.features["observation.state"]["shape"][0]
    for index in range(len(dataset)):
        if dataset[index]["observation.state"].numel() != joints:
            raise AssertionError(f"frame {index} has another shape")
    steps = {"action": [n / dataset.fps for n in range(4)]}
    history = LeRobotDataset(f"deal-hw/{folder.name}", root=folder, delta_timestamps=steps)
    batch = next(iter(torch.utils.data.DataLoader(history, batch_size=8)))
    if tuple(batch["action"].shape)[:2] != (8, 4):
        raise AssertionError(f"a batch of actions is {tuple(batch['action'].shape)}")
    filled = sum(bool(dataset[index]["filled"]) for index in range(len(dataset)))
    print(
        f"{dataset.num_episodes} episodes, {len(dataset)} frames ({filled} filled), {joints} joints, "
        f"units {dataset.features['observation.state']['units']}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
