"""Truth comes back: the ten inertial parameters of a link, and a payload that two recordings weigh."""

from __future__ import annotations

import copy
import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.sine_arm import MJCF, record

import deal_hw
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.sim.parameters import apply_parameters
from deal_hw.sim.parameters.fields import ModelFields
from deal_hw.sim.parameters.yaml_space import parse_space
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings, OwnDatasetSettings
from deal_hw.workflows.import_export import ImportSettings, import_recordings

WEIGHT_KG = 0.23
SETUPS = """setups:
  loaded:
    recordings: "loaded*"
    payload: {body: lower, name: weight, at: [0, 0, 0.22], range: [0.02, 1.0]}
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(MJCF, encoding="utf-8")
    return path


def _write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.slow
def test_ten_inertial_parameters_come_back(arm: Path, tmp_path: Path) -> None:
    """A last link off by what CAD data are usually off: every value, the written model, and what stays open.

    Of the first link, which turns about a vertical axis, the motion shows one number of ten: its moment about
    that axis. How high its mass lies has no trace; the others act only in that one number.
    """
    nominal = mujoco.MjModel.from_xml_path(str(arm))
    space = parse_space("parameters:\n  - {kind: inertial, elements: lower}", nominal)
    mean, std = space.prior
    draw = std * np.random.default_rng(1).standard_normal(len(space))
    theta = space.from_scale(space.to_scale(mean) + draw)
    truth = copy.copy(nominal)
    apply_parameters(ModelFields(truth, nominal), space, theta[None])
    mujoco.mj_setConst(truth, mujoco.MjData(truth))
    both = _write(tmp_path / "p.yaml", "parameters:\n  - {kind: inertial, elements: [shoulder, lower]}\n")
    said: list[str] = []
    found = deal_hw.calibrate(
        arm,
        record(truth, tmp_path / "fit.csv", 1),
        holdout=record(truth, tmp_path / "judge.csv", 2),
        parameters=both,
        method="default",
        latency=0.0,
        threads=1,
        say=said.append,
    )
    result = found.result
    row = {p.name: k for k, p in enumerate(result.space)}
    values = dict(zip(space.names, theta, strict=True))
    inside = [result.interval[row[n], 0] <= v <= result.interval[row[n], 1] for n, v in values.items()]
    assert sum(inside) >= 9
    assert result.estimate[row["lower.mass"]] == pytest.approx(values["lower.mass"], rel=0.01)
    for n in ("lower.ipos_x", "lower.ipos_z"):
        assert result.estimate[row[n]] == pytest.approx(values[n], abs=0.001)
    errors = result.heldout_nrmse
    assert errors["calibrated"] < 0.6 * errors["nominal"]
    # What the motion does not show keeps its prior, and the result says so.
    hidden = next(line for line in said if line.startswith("no trace in these recordings"))
    assert hidden.endswith("their prior expects: shoulder.ipos_z, shoulder.stretch_3")
    words = " ".join(result.prior_directions)
    assert "shoulder.stretch" in words and "the prior says more than the recordings" in words
    assert "lower.mass" not in words
    verdicts = dict(zip(result.space.names, result.verdicts, strict=True))
    assert verdicts["lower.mass"] == "identifiable"
    assert {v for n, v in verdicts.items() if n.startswith("shoulder")} == {"weak"}
    written = mujoco.MjModel.from_xml_path(str(found.save_model(tmp_path / "calibrated.xml")))
    mass, inertia, _ = _tensor(written)
    np.testing.assert_allclose(mass, truth.body("lower").mass[0], rtol=0.01)
    np.testing.assert_allclose(inertia, _tensor(truth)[1], atol=0.1 * np.trace(_tensor(truth)[1]))
    assert not np.allclose(written.body("lower").iquat, nominal.body("lower").iquat, atol=1e-3)


def _tensor(model: mujoco.MjModel) -> tuple[float, np.ndarray, np.ndarray]:
    body, rotation = model.body("lower"), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    axes = rotation.reshape(3, 3)
    return float(body.mass[0]), axes @ np.diag(body.inertia) @ axes.T, np.array(body.ipos)


def _arm(payload_kg: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(MJCF)
    for joint, damping in (("yaw", 0.3), ("pitch", 0.15), ("elbow", 0.13)):
        spec.joint(joint).damping = [damping, 0, 0]
    if payload_kg:
        ball = spec.body("lower").add_body(name="weight", pos=[0, 0, 0.22])
        ball.mass, ball.explicitinertial, ball.ipos = payload_kg, True, [0, 0, 0]
        ball.inertia = [0.4 * payload_kg * 0.02**2] * 3
    return spec.compile()


@pytest.mark.slow
def test_two_recordings_weigh_a_payload(arm: Path, tmp_path: Path) -> None:
    """As docs/reference/setups.md has it; link and payload are told apart, and training has no payload."""
    files = {
        name: record(_arm(kg), tmp_path / f"{name}.csv", seed)
        for name, kg, seed in (
            ("empty1", 0.0, 1),
            ("loaded1", WEIGHT_KG, 2),
            ("empty2", 0.0, 3),
            ("loaded2", WEIGHT_KG, 4),
        )
    }
    text = "parameters:\n  - {kind: dof_damping, elements: '*'}\n  - {kind: body_mass, elements: lower}\n"
    said: list[str] = []
    found = deal_hw.calibrate(
        arm,
        [files["empty1"], files["loaded1"]],
        holdout=[files["empty2"], files["loaded2"]],
        parameters=_write(tmp_path / "p.yaml", text),
        setups=_write(tmp_path / "setups.yaml", SETUPS),
        method="default",
        latency=0.0,
        threads=1,
        say=said.append,
    )
    values = {row["parameter"]: row for row in found.rows()}
    for name, true in (("elbow.damping", 0.13), ("lower.mass", 0.5), ("weight.mass", WEIGHT_KG)):
        assert values[name]["estimate"] == pytest.approx(true, rel=5e-3), name
        assert values[name]["verdict"] == "identifiable"
    assert found.result.heldout_nrmse["calibrated"] < 0.2 * found.result.heldout_nrmse["nominal"]
    assert "set-up loaded: loaded1.csv, loaded2.csv" in said
    assert "set-up model: empty1.csv, empty2.csv" in said
    folder = tmp_path / "out"
    written = found.save(folder)
    noted = json.loads(written["result.json"].read_text(encoding="utf-8"))["provenance"]["setups"]
    assert noted == {"model": ["empty1.csv", "empty2.csv"], "loaded": ["loaded1.csv", "loaded2.csv"]}
    trained = json.loads(written["distribution.json"].read_text(encoding="utf-8"))
    space = ParameterDistribution.from_json(trained).space
    assert "weight.mass" not in space.names and "lower.mass" in space.names
    alone = mujoco.MjModel.from_xml_path(str(written["calibrated.xml"]))
    assert [alone.body(b).name for b in range(1, alone.nbody)] == ["shoulder", "upper", "lower"]
    assert "loaded2.csv, set-up loaded" in found.report(tmp_path).read_text(encoding="utf-8")


def test_a_dataset_has_its_own_setups(arm: Path, tmp_path: Path) -> None:
    """The file in its folder is used, and names episodes by their numbers; the space gains the payload."""
    files = [record(_arm(kg), tmp_path / f"{n}.csv", n, seconds=3.0) for n, kg in ((1, 0.0), (2, 0.2))]
    folder = tmp_path / "dataset"
    import_recordings(ImportSettings(paths=tuple(files), out=folder, model=arm))
    text = "parameters: [{kind: body_mass, elements: lower}]"
    settings = OwnDatasetSettings(dataset=folder, parameters=_write(tmp_path / "p.yaml", text))
    assert not calibration_input(settings).robot.setups
    loaded = _write(tmp_path / "dataset" / "setups.yaml", SETUPS.replace('"loaded*"', "1"))
    for given in (settings, dataclasses.replace(settings, setups=loaded)):
        work = calibration_input(given)
        assert list(work.robot.setups) == ["loaded"]
        assert work.space.names == ("lower.mass", "weight.mass")
        assert {e.name: e.setup for e in (*work.episodes, *work.holdout)} == {
            "000000.mcap": "",
            "000001.mcap": "loaded",
        }


def test_a_distribution_without_the_payload_reads_back() -> None:
    """Where only the payload was unknown, nothing is left to draw but the latency."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    space = parse_space("parameters: [{kind: body_mass, elements: lower}]", model)
    one = ParameterDistribution.point(space, np.array([0.5]), 0.01)
    none = one.without(["lower.mass"])
    again = ParameterDistribution.from_json(json.loads(json.dumps(none.to_json())))
    assert again.digest() == none.digest() != one.digest()
    assert again.sample(np.random.default_rng(0), 3).shape == (3, 0)


def test_only_a_payload_may_be_unknown(arm: Path, tmp_path: Path) -> None:
    """With a model that one trusts, its mass alone is searched; with a known one nothing is left."""
    files = [
        record(_arm(kg), tmp_path / f"{n}.csv", 1, seconds=3.0) for n, kg in (("empty", 0), ("loaded", 0.2))
    ]
    text = "parameters: [{kind: body_mass, elements: lower, known: true}]"
    parameters = _write(tmp_path / "p.yaml", text)
    setups = _write(tmp_path / "setups.yaml", SETUPS)
    settings = FilesSettings(model=arm, data=tuple(files), parameters=parameters, setups=setups)
    assert calibration_input(settings).space.names == ("weight.mass",)
    _write(setups, SETUPS.replace("range: [0.02, 1.0]", "mass: 0.2"))
    with pytest.raises(ConfigurationError, match="every parameter is known, and so is every payload"):
        calibration_input(settings)


def test_a_method_with_one_model_is_refused(arm: Path, tmp_path: Path) -> None:
    """mujoco-sysid would fit all recordings without their payload."""
    data = record(_arm(0.0), tmp_path / "loaded1.csv", 1, seconds=3.0)
    setups = _write(tmp_path / "setups.yaml", SETUPS)
    with pytest.raises(ConfigurationError, match="mujoco-sysid simulates all recordings with one model"):
        deal_hw.calibrate(arm, data, setups=setups, method="mujoco-sysid", threads=1)
