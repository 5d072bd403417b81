"""Simulators by size: the last used are kept, steps of all are counted, and a new one does the same."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.engine.batch import BatchPool, ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.types import FloatArray


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """The cart-pole."""
    return load_model(DESCRIPTION)


@pytest.fixture
def pool(robot: RobotModel) -> BatchPool:
    """Two simulators are kept."""
    return BatchPool(robot, k9_space(), threads=1, most=2)


def moved(batch: ServoBatch) -> FloatArray:
    """Return where ten steps towards 5 cm lead, (N, 1, J), from parameters that differ between members."""
    spread = np.linspace(0.8, 1.2, batch.count)[:, None]
    batch.set_parameters(batch.space.nominal * spread)
    batch.set_state(np.array([0.0, 0.1]), np.zeros(2))
    return batch.advance(np.full((batch.count, 10, 1), 0.05))[0]


def test_the_last_used_sizes_are_kept(pool: BatchPool) -> None:
    """Of sizes 1, 2, 1, 3 the second is the one not used for longest: it is made anew."""
    one, two = pool.get(1), pool.get(2)
    assert pool.get(1) is one
    three = pool.get(3)
    assert len(pool) == 2
    assert pool.get(1) is one and pool.get(3) is three
    assert pool.get(2) is not two
    assert pool.get(2).count == 2


def test_steps_of_those_given_up_count(pool: BatchPool) -> None:
    """Ten steps with each of four, three, two members and one: a hundred."""
    for count in (4, 3, 2, 1):
        moved(pool.get(count))
    assert len(pool) == 2
    assert pool.steps == 100


@pytest.mark.parametrize(("threads", "count", "sizes"), [(1, 5, [5]), (3, 7, [3, 2, 2]), (4, 2, [1, 1])])
def test_parts_are_one_for_each_thread(robot: RobotModel, threads: int, count: int, sizes: list[int]) -> None:
    """Their members add up, their steps count, and they are not the whole simulator of as many members."""
    pool = BatchPool(robot, k9_space(), threads=threads)
    parts = pool.parts(count)
    assert [part.count for part in parts] == sizes
    assert all(a is b for a, b in zip(parts, pool.parts(count), strict=True))
    for part in parts:
        moved(part)
    assert pool.steps == 10 * count
    assert pool.get(count).count == count


def test_a_simulator_made_anew_gives_the_same(pool: BatchPool) -> None:
    """To the last bit, whatever the first one had simulated before."""
    first = moved(pool.get(3))
    for count in (1, 2):
        pool.get(count)
    again = pool.get(3)
    np.testing.assert_array_equal(moved(again), first)
    np.testing.assert_array_equal(moved(again), first)


def test_forces_act_in_proportion_and_are_forgotten(robot: RobotModel) -> None:
    """0, 1 and 2 N on the cart for 5 ms: twice the force, twice the change; the next windows have none."""
    batch = ServoBatch(robot, k9_space(), 3, threads=1)
    C = len(robot.coordinates)
    path = np.zeros((3, 5, 1))
    force = np.zeros((3, 5, C))
    force[:, :, 0] = np.arange(3)[:, None]
    batch.set_state(np.zeros(C), np.full(C, 0.5))
    moved = batch.advance(path, force=force)[1][:, 0, 0]
    assert moved[1] - moved[0] > 1e-4
    assert moved[2] - moved[0] == pytest.approx(2 * (moved[1] - moved[0]), rel=0.02)
    batch.set_state(np.zeros(C), np.full(C, 0.5))
    np.testing.assert_allclose(batch.advance(path)[1][:, 0, 0], moved[0], rtol=1e-12)


def test_members_that_diverge_are_nan_and_leave_no_trace(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """MuJoCo's own line for each, on the terminal and in a file where the user stands, goes to the log."""
    monkeypatch.chdir(tmp_path)
    batch = ServoBatch(load_model(DESCRIPTION), k9_space().with_ratio(5.0), 64, threads=2)
    batch.set_parameters(np.tile(batch.space.nominal, (64, 1)))
    speed = np.zeros((64, 2))
    speed[::2] = 1e12
    batch.set_state(np.zeros((64, 2)), speed)
    with caplog.at_level(logging.DEBUG, logger="deal_hw.sim.engine.batch"):
        position, _ = batch.advance(np.zeros((64, 20, 1)))
    assert np.isnan(position[::2]).all() and np.isfinite(position[1::2]).all()
    assert "unstable" in caplog.text
    assert capfd.readouterr() == ("", "") and list(tmp_path.iterdir()) == []
