"""The converter of the public recording of a suspended Go2: its parts, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import convert_go2_suspended
import numpy as np
import pytest


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A file with the keys of the source: 8 s at 200 Hz, joint j near 0.1 j rad."""
    import torch

    time = torch.arange(1600, dtype=torch.float32) / 200
    position = 0.1 * torch.arange(12) + 1e-3 * time[:, None]
    path = tmp_path / "traj_0.pt"
    torch.save({"time": time, "dof_pos": position, "des_dof_pos": position + 0.01}, path)
    return path


def test_parts_follow_each_other_without_a_gap(source: Path, tmp_path: Path) -> None:
    """Four parts of 2 s hold every sample once; columns.yaml names time, positions and targets."""
    out = tmp_path / "go2"
    assert convert_go2_suspended.main([str(source), "--out", str(out), "--parts", "4"]) == 0
    parts = [dict(np.load(out / f"traj_0_part{n}.npz")) for n in (1, 2, 3, 4)]
    assert [len(part["time"]) for part in parts] == [400] * 4
    time = np.concatenate([part["time"] for part in parts])
    np.testing.assert_allclose(time, np.arange(1600) / 200, atol=1e-6)
    assert parts[0]["joint_names"][3] == "FR_hip_joint"
    np.testing.assert_allclose(parts[3]["dof_pos"][-1, 3], 0.3 + 1e-3 * 1599 / 200, atol=1e-6)
    np.testing.assert_allclose(parts[0]["des_dof_pos"] - parts[0]["dof_pos"], 0.01, atol=1e-6)
    assert "target: des_dof_pos" in (out / "columns.yaml").read_text(encoding="utf-8")


def test_seconds_take_the_beginning_of_the_recording(source: Path, tmp_path: Path) -> None:
    """Up to 2 s, in two parts: 401 samples."""
    words = [str(source), "--out", str(tmp_path), "--parts", "2", "--seconds", "2"]
    convert_go2_suspended.main(words)
    lengths = [len(np.load(tmp_path / f"traj_0_part{n}.npz")["time"]) for n in (1, 2)]
    assert sum(lengths) == 401
    assert np.load(tmp_path / "traj_0_part2.npz")["time"][-1] == 2.0


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    """Keys and shapes that the source does not have are named."""
    import torch

    path = tmp_path / "other.pt"
    torch.save({"time": torch.zeros(3)}, path)
    with pytest.raises(SystemExit, match="dof_pos"):
        convert_go2_suspended.convert(path, tmp_path / "go2")
    short = {"time": torch.zeros(3), "dof_pos": torch.zeros(3, 11), "des_dof_pos": torch.zeros(3, 12)}
    torch.save(short, path)
    with pytest.raises(SystemExit, match="11"):
        convert_go2_suspended.convert(path, tmp_path / "go2")


def test_impossible_numbers_are_refused(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No parts and no time at all."""
    for option in ("--parts", "--seconds"):
        with pytest.raises(SystemExit):
            convert_go2_suspended.main([str(source), "--out", str(tmp_path), option, "0"])
        assert option in capsys.readouterr().err
