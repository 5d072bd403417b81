"""A free swing: recordings without commands, of motors that are off or of no actuators at all."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.calib.data.noise import HELD_STD, white_noise_std
from deal_hw.calibration import read_result
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.motions.excitation.limits import room
from deal_hw.sim.robots.user_robot import read_robot
from deal_hw.types import FloatArray
from deal_hw.workflows.calibrate import Calibration
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings, OwnDatasetSettings
from deal_hw.workflows.import_export import (
    ExportSettings,
    ImportSettings,
    export_recordings,
    import_recordings,
)

PENDULUM = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hub" axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="1e-3"/>
      <inertial pos="0 0 -0.2" mass="0.2" diaginertia="1e-3 1e-3 1e-6"/>
    </body>
  </worldbody>
  {actuator}
</mujoco>"""
MOTOR = '<actuator><motor name="drive" joint="hub" gear="2"/></actuator>'
SERVO = '<actuator><position name="drive" joint="hub" kp="5" kv="0.1"/></actuator>'


NAMED = '<body name="pole">'


def write_model(folder: Path, actuator: str) -> Path:
    """Write the user's model: twice the true damping and friction."""
    path = folder / "pendulum.xml"
    path.write_text(PENDULUM.format(damping=0.008, friction=0.006, actuator=actuator))
    return path


def recording(drive: float, seed: int, seconds: float = 6.0) -> dict[str, FloatArray]:
    """Return 100 Hz of the real pendulum, dropped from 2 rad, with torques; noise and rounding of 1 mrad."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(damping=0.004, friction=0.003, actuator=MOTOR))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[0] = 2.0
    time = np.arange(0.0, seconds, 0.01)
    torque = drive * np.repeat(rng.uniform(-0.4, 0.4, time.size // 20), 20)
    seen = np.empty(time.size)
    for k, wanted in enumerate(torque):
        seen[k] = data.qpos[0]
        data.ctrl[0] = wanted / 2.0
        mujoco.mj_step(model, data, 5)
    seen = np.round((seen + 1e-3 * rng.standard_normal(time.size)) / 1e-3) * 1e-3
    return {"time": time, "hub_pos": seen, "hub_cmd": torque}


def write_csv(path: Path, arrays: dict[str, FloatArray]) -> Path:
    """Write columns of numbers."""
    np.savetxt(
        path, np.stack(list(arrays.values()), axis=1), delimiter=",", header=",".join(arrays), comments=""
    )
    return path


@pytest.fixture(scope="module")
def swing() -> dict[str, FloatArray]:
    """A free swing: time and positions alone."""
    free = recording(0.0, 0)
    del free["hub_cmd"]
    return free


def test_a_free_swing_shows_friction_damping_and_inertia(
    swing: dict[str, FloatArray], tmp_path: Path
) -> None:
    """All three within 5 % of the truth; the motor's gain keeps its value, and a sentence says why."""
    printed: list[str] = []
    model = write_model(tmp_path, MOTOR)
    found = deal_hw.calibrate(model=model, data=[swing], say=printed.append, threads=1)
    values = {row["parameter"]: row["estimate"] for row in found.rows()}
    assert values["hub.damping"] == pytest.approx(0.004, rel=0.05)
    assert values["hub.frictionloss"] == pytest.approx(0.003, rel=0.05)
    assert values["hub.armature"] == pytest.approx(0.001, rel=0.05)
    assert "drive.motor_gain" not in values and values["latency"] == 0.0
    assert any("no commands, and its motors (hub) were off" in text for text in printed)
    assert any("not identifiable without commands" in text and "drive.motor_gain" in text for text in printed)
    assert found.colour == "green"


@pytest.mark.parametrize("method", ["local", pytest.param(None, marks=pytest.mark.slow)])
def test_a_model_needs_no_actuator(swing: dict[str, FloatArray], tmp_path: Path, method: str | None) -> None:
    """By default and by the local fit alone: the same values, all files, and what they are relative to."""
    printed: list[str] = []
    model = write_model(tmp_path, "")
    found = deal_hw.calibrate(model=model, data=[swing], method=method, say=printed.append, threads=1)
    assert_true(found)
    assert any("no actuators" in text and "relative to the masses of the model" in text for text in printed)
    files = found.save(tmp_path / "out")
    assert {"result.json", "distribution.json", "calibrated.xml", "plain_mujoco.xml"} <= set(files)
    again = read_result(tmp_path / "out")
    np.testing.assert_allclose(again.estimate, found.result.estimate)


def assert_true(found: Calibration) -> None:
    """Check that the three values are within 5 % of the truth, and the verdict."""
    values = {row["parameter"]: row["estimate"] for row in found.rows()}
    assert values["hub.damping"] == pytest.approx(0.004, rel=0.05)
    assert values["hub.frictionloss"] == pytest.approx(0.003, rel=0.05)
    assert values["hub.armature"] == pytest.approx(0.001, rel=0.05)
    assert values["latency"] == 0.0
    assert found.colour == "green"


@pytest.mark.slow
def test_of_masses_a_swing_shows_only_ratios(swing: dict[str, FloatArray], tmp_path: Path) -> None:
    """With a free mass all hang on what is expected of them, and the message says so; a known one ends that.

    Twice all masses, friction, damping and armature move alike, since gravity is the only force from outside.
    """
    parameters = tmp_path / "params.yaml"
    entries = ["{kind: body_mass, elements: pole%s}"] + [
        f"{{kind: {kind}, elements: hub}}" for kind in ("dof_damping", "dof_frictionloss", "dof_armature")
    ]
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM.format(damping=0.008, friction=0.006, actuator="").replace("<body>", NAMED))
    results = []
    for known in ("", ", known: true"):
        text = "parameters:\n - " + "\n - ".join(entries)
        parameters.write_text(text % known, encoding="utf-8")
        results.append(
            deal_hw.calibrate(
                model=model, data=[swing], parameters=parameters, method="local", threads=1
            ).result
        )
    free, given = results
    assert set(free.verdicts) == {"weak"}
    assert any("pole.mass" in text and "the common scale of" in text for text in free.prior_directions)
    of_free = dict(zip(free.space.names, free.estimate, strict=True))
    ratio = of_free["pole.mass"] / 0.2
    assert of_free["hub.damping"] / ratio == pytest.approx(0.004, rel=0.05)
    assert of_free["hub.frictionloss"] / ratio == pytest.approx(0.003, rel=0.05)
    assert given.estimate == pytest.approx([0.004, 0.003, 0.001], rel=0.05)


@pytest.mark.parametrize("command", [None, 0.0, np.nan])
def test_a_free_swing_beside_a_driven_recording(
    command: float | None, swing: dict[str, FloatArray], tmp_path: Path
) -> None:
    """No column, zeros or empty cells: the motor is off, and the other recording shows its gain."""
    free = dict(swing)
    if command is not None:
        free["hub_cmd"] = np.full(free["time"].size, command)
    columns = tmp_path / "columns.yaml"
    columns.write_text(
        "time: time\njoints: [{name: hub, position: hub_pos, target: hub_cmd, target_unit: Nm}]\n"
    )
    model, named = write_model(tmp_path, MOTOR), None if command is None else columns
    # Torques up to 1.6 N·m, so that none is taken for a share of full power.
    data = [free, recording(4.0, 1)]
    inputs = calibration_input(FilesSettings(model=model, data=data, columns=named, threads=1))
    assert "drive.motor_gain" in [p.name for p in inputs.space]
    still = [e for e in inputs.episodes if not np.any(e.target)]
    assert still and len(still) < len(inputs.episodes)


def test_servos_without_commands_are_refused(swing: dict[str, FloatArray], tmp_path: Path) -> None:
    """A servo holds its joint: the message says what to do if it was off."""
    settings = FilesSettings(model=write_model(tmp_path, SERVO), data=[swing])
    with pytest.raises(DatasetError, match="remove the actuators from a copy of the MJCF"):
        calibration_input(settings)


@pytest.mark.parametrize(("actuator", "driven"), [(MOTOR, ("hub",)), ("", ())])
def test_a_free_swing_is_imported(
    swing: dict[str, FloatArray], tmp_path: Path, actuator: str, driven: tuple[str, ...]
) -> None:
    """The dataset holds one command of 0, or of nothing, and is calibrated as the file is."""
    path = write_csv(tmp_path / "swing.csv", swing)
    config = ImportSettings(paths=(path,), out=tmp_path / "data", model=write_model(tmp_path, actuator))
    dataset = import_recordings(config)
    assert dataset is not None
    trajectory = dataset.read(0).trajectory
    assert trajectory.actuated == driven and not trajectory.position_target.any()
    inputs = calibration_input(OwnDatasetSettings(dataset=tmp_path / "data", threads=1))
    quantities = ("armature", "damping", "encoder_bias", "frictionloss")
    assert sorted(p.name for p in inputs.space) == [f"hub.{quantity}" for quantity in quantities]


def test_nothing_commands_a_robot_without_actuators(swing: dict[str, FloatArray], tmp_path: Path) -> None:
    """Its recordings are examined, calibrated and inspected; what would move it is refused in one line."""
    path = write_csv(tmp_path / "swing.csv", swing)
    folder = tmp_path / "data"
    import_recordings(ImportSettings(paths=(path,), out=folder, model=write_model(tmp_path, "")))
    robot = str(folder / "robot" / "robot.yaml")
    assert deal_hw.check_robot(robot).exit_code == 0
    assert deal_hw.inspect(folder / "episodes" / "000000.mcap").rows()
    with pytest.raises(ConfigurationError, match="has an actuator, so nothing can be commanded"):
        deal_hw.collect(
            robot,
            motion="chirp",
            dataset=tmp_path / "more",
            simulation=deal_hw.SimulationOptions(simulated=True),
        )
    with pytest.raises(ConfigurationError, match="has an actuator, so nothing can be commanded"):
        room(read_robot(Path(robot)).description())
    pytest.importorskip("pyarrow")
    with pytest.raises(DatasetError, match="LeRobot's format has an action; use --format foxglove"):
        export_recordings(ExportSettings(path=folder, out=tmp_path / "lerobot"))


def test_a_joint_that_never_moves_does_not_outweigh_the_others() -> None:
    """Of a position of one value, the noise is unknown, not 0.3 micrometres."""
    moving = recording(0.0, 0)["hub_pos"]
    parts = [np.stack([moving, np.full(moving.size, 0.25)], axis=1)] * 2
    assert white_noise_std(parts)[1] == HELD_STD
    parts[1] = parts[1] + 1e-4
    assert white_noise_std(parts)[1] == pytest.approx(1e-4 / np.sqrt(12))
