"""Zeros of encoders that differ between recordings: named if they were not searched, found if they were."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.sine_arm import MJCF, record

import deal_hw

BIASES = {"first": {"pitch": 0.03, "elbow": -0.05}, "second": {"pitch": -0.04, "elbow": 0.02}}
HELD_OUT = {"pitch": 0.05, "elbow": 0.03}
SETUPS = """setups:
  first: {recordings: first.csv, encoder_bias: {pitch: 0.2, elbow: 0.2}}
  second: {recordings: second.csv, encoder_bias: {pitch: 0.2, elbow: 0.2}}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the arm and two recordings that have other zeros, in commands and positions."""
    folder = tmp_path_factory.mktemp("zeros")
    (folder / "arm.xml").write_text(MJCF, encoding="utf-8")
    (folder / "p.yaml").write_text("parameters:\n  - {kind: dof_damping, elements: '*'}\n", encoding="utf-8")
    (folder / "setups.yaml").write_text(SETUPS, encoding="utf-8")
    for seed, (name, biases) in enumerate((*BIASES.items(), ("third", HELD_OUT))):
        _recording(folder / f"{name}.csv", seed, biases)
    return folder


def _recording(path: Path, seed: int, biases: Mapping[str, float]) -> Path:
    record(mujoco.MjModel.from_xml_string(MJCF), path, seed)
    columns = path.read_text(encoding="utf-8").partition("\n")[0].split(",")
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    for joint, bias in biases.items():
        table[:, [columns.index(f"{joint}_{what}") for what in ("pos", "cmd")]] += bias
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def _calibrate(folder: Path, **more: object) -> deal_hw.Calibration:
    files = [folder / f"{name}.csv" for name in BIASES]
    return deal_hw.calibrate(
        folder / "arm.xml", files, parameters=folder / "p.yaml", latency=0.0, threads=1, **more
    )


def test_the_zero_of_each_recording_comes_back(recorded: Path) -> None:
    """Within 1 mrad, beside damping that all recordings share."""
    found = _calibrate(recorded, setups=recorded / "setups.yaml").result
    values = dict(zip(found.space.names, found.estimate, strict=True))
    for setup, biases in BIASES.items():
        for joint, bias in biases.items():
            assert values[f"{joint}.encoder_bias@{setup}"] == pytest.approx(bias, abs=0.001)
    assert values["elbow.damping"] == pytest.approx(0.1, rel=0.5)


@pytest.fixture(scope="module")
def found(recorded: Path) -> deal_hw.Calibration:
    """Return a calibration that nobody told of zeros, with a third recording held out."""
    return _calibrate(recorded, holdout=[recorded / "third.csv"])


@pytest.mark.slow
def test_zeros_that_differ_are_found_and_named(found: deal_hw.Calibration) -> None:
    """With their true values, of two joints in two recordings; the damping is right, and nothing is left."""
    result = found.result
    values = dict(zip(result.space.names, result.estimate, strict=True))
    for name, biases in BIASES.items():
        for joint in ("pitch", "elbow"):
            value = values[f"{joint}.encoder_bias@{name}.csv"]
            assert value == pytest.approx(biases[joint], abs=0.001)
    # Nothing depends on where that joint's zero is: it turns about the vertical.
    assert not any(name.startswith("yaw.encoder_bias") for name in values)
    assert values["elbow.damping"] == pytest.approx(0.1, rel=0.02)
    assert result.chi2 < 1.2
    first = result.alarms[0]
    assert "zero of its own" in first.seen and "+0.03 rad in first.csv, -0.04 rad in second.csv" in first.seen
    assert result.provenance["diagnosis"][0]["cause"] == "zero"


@pytest.mark.slow
def test_a_held_out_recording_gets_its_own_zero(found: deal_hw.Calibration) -> None:
    """Fitted to it alone."""
    zeros = found.result.provenance["heldout_rmse"]["zeros"]["calibrated"]
    for joint, bias in HELD_OUT.items():
        assert zeros[joint]["third.csv"] == pytest.approx(bias, abs=0.001)


@pytest.mark.slow
def test_policies_meet_other_zeros(found: deal_hw.Calibration) -> None:
    """The distribution for training has one zero of each joint, spread as those of the recordings."""
    distribution = found.distribution
    assert not any("@" in name for name in distribution.space.names)
    k = distribution.space.names.index("pitch.encoder_bias")
    # Mean and std of +0.03 and -0.04, and of the next one beside their mean: sqrt(1 + 1 / 2).
    assert distribution.mean[k] == pytest.approx(-0.005, abs=0.001)
    assert distribution.covariance is not None
    assert np.sqrt(distribution.covariance[k, k]) == pytest.approx(0.0495 * np.sqrt(1.5), abs=0.001)


@pytest.mark.slow
def test_without_laws_zeros_that_differ_are_named_only(recorded: Path) -> None:
    """The alarm says that zeros differ, with their values, and where to write it."""
    found = _calibrate(recorded, laws=False).result
    first = found.alarms[0]
    assert "whose zero is another one in each recording" in str(first) and "--setups" in str(first)
    assert not any("encoder_bias" in name for name in found.space.names)


@pytest.mark.slow
def test_one_zero_of_all_recordings_is_one_value(recorded: Path, tmp_path: Path) -> None:
    """Both have the first one's offsets, which are found within 1 mrad; only noise is left."""
    files = [_recording(tmp_path / f"{name}.csv", seed, BIASES["first"]) for seed, name in enumerate("ab")]
    found = deal_hw.calibrate(
        recorded / "arm.xml", files, parameters=recorded / "p.yaml", latency=0.0, threads=1
    ).result
    values = dict(zip(found.space.names, found.estimate, strict=True))
    zeros = {name: value for name, value in values.items() if "encoder_bias" in name}
    assert zeros == {
        f"{joint}.encoder_bias": pytest.approx(bias, abs=0.001) for joint, bias in BIASES["first"].items()
    }
    assert found.chi2 < 1.2 and values["elbow.damping"] == pytest.approx(0.1, rel=0.02)
    assert "With another zero of its encoders (pitch +0.03 rad, elbow -0.05 rad)" in found.alarms[0].seen
    assert found.provenance["candidates"][0]["explanation"] == "another zero of the encoders"


@pytest.mark.slow
def test_an_unmodelled_mass_is_no_zero(recorded: Path, tmp_path: Path) -> None:
    """The forearm is heavier than its model: no zero is taken for it."""
    text = (recorded / "arm.xml").read_text(encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(text)
    model.body_mass[-1] *= 1.5
    model.body_inertia[-1] *= 1.5
    for seed, name in enumerate("ab"):
        record(model, tmp_path / f"{name}.csv", seed)
    files = [tmp_path / f"{name}.csv" for name in "ab"]
    found = deal_hw.calibrate(
        recorded / "arm.xml", files, parameters=recorded / "p.yaml", latency=0.0, threads=1
    ).result
    assert not any("encoder_bias" in name for name in found.space.names)
