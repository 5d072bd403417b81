"""Joints of any MJCF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf.joint_facts import joint_facts


def test_joints_of_the_cartpole() -> None:
    """Names and units are those of its description."""
    facts = joint_facts(DESCRIPTION.mjcf)
    assert facts.names == DESCRIPTION.joint_names and facts.units == DESCRIPTION.position_units
    assert facts.limits.shape == (2, 2) and facts.left_out == ()


def test_degrees_free_joints_and_limits(tmp_path: Path) -> None:
    """Ranges come in rad whatever the file's unit; free joints stay out; no range is a free joint."""
    path = tmp_path / "a.xml"
    path.write_text(
        """<mujoco><worldbody><body><freejoint name="base"/><geom size="1"/>
        <body><joint name="a" range="-90 180"/><geom size="1"/></body>
        <body><joint name="b"/><geom size="1"/></body></body></worldbody></mujoco>"""
    )
    facts = joint_facts(path)
    assert facts.names == ("a", "b") and facts.left_out == ("base",)
    np.testing.assert_allclose(facts.limits, [[-np.pi / 2, np.pi], [-np.inf, np.inf]])


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("<body><joint/><geom size='1'/></body>", "joint 0 has no name"),
        ("<geom size='1'/>", "no hinge or slide"),
        ("<body><joint name='a'/></body>", "does not compile"),
    ],
)
def test_models_of_no_use(tmp_path: Path, body: str, words: str) -> None:
    """Each says what is missing."""
    path = tmp_path / "a.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ConfigurationError, match=words):
        joint_facts(path)
