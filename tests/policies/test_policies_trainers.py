"""The table of trainers."""

from __future__ import annotations

import pytest

from deal_hw.errors import UnknownNameError
from deal_hw.policies.trainers import TRAINERS, make_trainer


@pytest.mark.parametrize("name", list(TRAINERS))
def test_every_trainer_loads_under_its_name(name: str) -> None:
    """A trainer says the name that the table has it under."""
    assert make_trainer(name).name == name


def test_unknown_trainer_lists_the_trainers() -> None:
    """A wrong name is answered with the right ones."""
    with pytest.raises(UnknownNameError, match=r"ppo.*sac"):
        make_trainer("ppo")
