"""SAC on the toy cart-pole: nominal physics, a perfect sensor, no latency."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.cartpole_env import BalanceTask, CartPoleEnv, balance_spec
from deal_hw.policies.evaluate import evaluate_batch
from deal_hw.policies.onnx_export import export_network
from deal_hw.policies.sac import NetworkPolicy, SacConfig, SacTrainer
from deal_hw.policies.servo_loop import EXACT_SENSOR
from deal_hw.policy import Policy
from deal_hw.testing.trainer_suite import TrainerCase, TrainerSuite

SPACE = k9_space()
TOY = ParameterDistribution.point(SPACE, SPACE.nominal, 0.0)
TASK = BalanceTask(ticks=100, host_delay_s=(0.0, 0.0))


def upright_seconds(policy: Policy) -> float:
    """Return how long a policy holds the pole of the toy upright, of 5 s, in the mean over six starts."""
    assert isinstance(policy, NetworkPolicy)
    start = np.zeros((6, 2))
    start[:, 1] = np.linspace(-0.05, 0.05, 6)
    theta = np.repeat(SPACE.nominal[None], 6, axis=0)
    results = evaluate_batch(
        policy, DESCRIPTION, SPACE, theta, np.zeros(6), np.random.default_rng(0), seconds=5.0,
        start_position=start, sensor=EXACT_SENSOR,
    )  # fmt: skip
    return float(np.mean([r.upright_s for r in results]))


def export(policy: Policy, path: Path) -> Policy:
    assert isinstance(policy, NetworkPolicy)
    return export_network(policy.network, policy.spec, path)


class TestSac(TrainerSuite):
    """SAC keeps the contract of trainers."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> TrainerCase:
        """Return SAC and the toy."""
        return TrainerCase(
            trainer=SacTrainer(),
            make_env=lambda: CartPoleEnv(DESCRIPTION, TOY, 16, task=TASK, sensor=EXACT_SENSOR),
            layout=balance_spec(DESCRIPTION, TASK),
            distribution=TOY,
            config=SacConfig(steps=8_000, hidden=(32, 32), warmup=500),
            short_config=SacConfig(steps=800, hidden=(32, 32), warmup=500),
            score=upright_seconds,
            learned=3.5,
            export=export,
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "steps must be positive, got 0"),
        ({"gamma": 1.5}, r"gamma must lie in \(0, 1\], got 1.5"),
        ({"hidden": ()}, "hidden must name at least one layer"),
        ({"steps": 100, "warmup": 100}, r"100 steps: give more than the 100 steps of warmup"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, object], message: str) -> None:
    """The message names the setting, what was given and what is allowed."""
    with pytest.raises(ConfigurationError, match=message):
        SacConfig(**settings)  # type: ignore[arg-type]
