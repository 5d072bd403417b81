"""The SO-101 converter: its column map fits the model that it is for."""

from __future__ import annotations

import convert_so101
import mujoco
import numpy as np
import pytest
import yaml

from deal_hw.data.importing.columns import parse_column_map
from deal_hw.drivers.so101.description import DESCRIPTION, RANGE_RAD


def test_travel_of_the_jaw_lies_in_the_models_range() -> None:
    """0 to 1 of the jaw is 1524 ticks of 4096 a turn, 2.338 rad, and the model lets it go all the way."""
    jaw = parse_column_map(yaml.safe_load(convert_so101.column_map())).joints[-1]
    slope, constant = jaw.scale()
    assert slope == pytest.approx(1524 * 2 * np.pi / 4096)
    assert DESCRIPTION.mjcf is not None
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    low, high = model.jnt_range[model.joint("gripper").id]
    assert low <= constant and constant + slope <= high
    np.testing.assert_allclose(model.jnt_range, RANGE_RAD, atol=1e-6)
