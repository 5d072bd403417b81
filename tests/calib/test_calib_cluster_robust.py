"""Clustered variances: by hand, against a textbook's formula, and by coverage over small linear problems."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.calib.fit.cluster_robust import clustered
from deal_hw.calib.fit.intervals import uncertainty
from deal_hw.calib.fit.residual import Normal, WindowRows
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.types import FloatArray


def _rows(residual: FloatArray, design: FloatArray, start: FloatArray | None = None) -> WindowRows:
    """Windows (W, H) of one channel, a design (W, H, P), start states (W, H, S) of which nothing is known."""
    if start is None:
        return WindowRows(residual, design, np.zeros((*residual.shape, 0)))
    W, _, S = start.shape
    return WindowRows(
        np.concatenate([residual, np.zeros((W, S))], axis=1),
        np.concatenate([design, np.zeros((W, S, design.shape[2]))], axis=1),
        np.concatenate([start, np.broadcast_to(1e-6 * np.eye(S), (W, S, S))], axis=1),
    )


def test_ratio_of_a_mean_by_hand() -> None:
    """Eight windows of one sample around a mean: the ratio is the sample variance, sum of squares over 7."""
    values = np.array([1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 0.5, -0.5])
    found = clustered([_rows(values[:, None], np.ones((8, 1, 1)))], np.array([[1 / 8]]), [1])
    assert found is not None and found.blocks == 8
    assert found.ratio[0] == pytest.approx(np.sum(values**2) / 7)
    assert found.degrees[0] == pytest.approx(8.0)


def test_ratio_with_errors_shared_inside_windows_by_hand() -> None:
    """Errors that are equal inside windows of four samples: variance of the mean is 4 times the naive one."""
    shared = np.array([1.0, -1.0] * 12)
    residual = np.repeat(shared[:, None], 4, axis=1)
    found = clustered([_rows(residual, np.ones((24, 4, 1)))], np.array([[1 / 96]]), [4])
    # A score is 4 times the error, 16 each; white noise gives 4 (1 - 4 / 96) each.
    assert found is not None
    assert found.block_windows == 1
    assert found.ratio[0] == pytest.approx(16 / (4 * (1 - 4 / 96)))


def test_cluster_robust_covariance_equals_the_textbook_up_to_its_small_sample_factor() -> None:
    """H^-1 (sum g g') H^-1 over H^-1 by the formula, over what white noise would give by the same formula."""
    rng = np.random.default_rng(0)
    design = rng.normal(size=(30, 10, 3))
    errors = rng.normal(size=(30, 10)) + rng.normal(size=(30, 1))
    flat, y = design.reshape(-1, 3), errors.ravel()
    bread = np.asarray(np.linalg.inv(flat.T @ flat), dtype=np.float64)
    left = np.asarray((y - flat @ (bread @ flat.T @ y)).reshape(30, 10), dtype=np.float64)
    score = np.einsum("whp,wh->wp", design, left)
    textbook = bread @ (score.T @ score) @ bread
    # White noise leaves residuals with covariance I - P; block by block, with full matrices.
    noise = np.eye(300) - flat @ bread @ flat.T
    white = np.zeros((3, 3))
    for w in range(30):
        mine = slice(10 * w, 10 * w + 10)
        white += flat[mine].T @ noise[mine, mine] @ flat[mine]
    found = clustered([_rows(left, design)], bread, [10])
    assert found is not None and found.block_windows == 1
    assert found.ratio == pytest.approx(np.diag(textbook) / np.diag(bread @ white @ bread))


def test_too_few_blocks_say_nothing() -> None:
    """Seven windows of one sample are not clustered; nor are none."""
    assert clustered([_rows(np.ones((7, 1)), np.ones((7, 1, 1)))], np.array([[1 / 7]]), [1]) is None
    assert clustered([], np.eye(1), []) is None


def test_blocks_grow_while_neighbours_hang_together() -> None:
    """Errors shared by four neighbouring windows of 64 end in blocks of at least four windows."""
    rng = np.random.default_rng(1)
    residual = np.repeat(rng.normal(size=(64, 1)), 4, axis=0) * np.ones((256, 5))
    found = clustered([_rows(residual - residual.mean(), np.ones((256, 5, 1)))], np.array([[1 / 1280]]), [5])
    assert found is not None and found.block_windows >= 4


def test_start_states_are_eliminated() -> None:
    """What a window's own offset explains leaves no derivative: columns are centred inside each window."""
    design = np.random.default_rng(2).normal(size=(3, 6, 2))
    rows = _rows(np.zeros((3, 6)), design, np.ones((3, 6, 1)))
    assert rows.following[:, :6] == pytest.approx(design - design.mean(axis=1, keepdims=True), abs=1e-6)
    assert rows.start_normal == pytest.approx(np.full((3, 1, 1), 6.0))


def test_offsets_of_windows_do_not_bias_the_ratio_of_parts_of_windows() -> None:
    """White noise, an unknown offset a window, blocks of a part of a window: the ratio is 1 on average."""
    rng = np.random.default_rng(3)
    design = rng.normal(size=(4, 40, 2))
    start = np.ones((4, 40, 1))
    effective = _rows(np.zeros((4, 40)), design, start).following[:, :40]
    bread = np.linalg.inv(np.einsum("whp,whq->pq", effective, effective))
    ratios, blocks = [], 0
    for _ in range(400):
        y = rng.normal(size=(4, 40))
        left = y - y.mean(axis=1, keepdims=True)
        left = left - effective @ (bread @ np.einsum("whp,wh->p", effective, left))
        found = clustered([_rows(left, design, start)], bread, [40])
        assert found is not None
        ratios.append(found.ratio)
        blocks = found.blocks
    assert blocks > 4
    assert np.mean(ratios, axis=0) == pytest.approx(np.ones(2), abs=0.08)


def _space(K: int) -> ParameterSpace:
    return ParameterSpace(
        Parameter(
            name=f"p{k}",
            kind="body_mass",
            elements=("b",),
            unit="rad",
            nominal=0.0,
            low=-50.0,
            high=50.0,
            scale="linear",
        )
        for k in range(K)
    )


def _coverage(wild: float, windows: int, draws: int) -> tuple[float, float, float]:
    """Return how often 90 % intervals of the first parameter hold the truth, and what clustering widens.

    Only every fifth window tells the first parameter; there the errors are ``wild`` times as large.

    Returns:
        Without clustering, with it, and the median ratio of the widths of all parameters.
    """
    rng = np.random.default_rng(4)
    K, H, space = 3, 8, _space(3)
    size = np.where(np.arange(windows) % 5 == 0, wild, 1.0)[:, None]
    held, widths = [], []
    for _ in range(draws):
        design = rng.normal(size=(windows, H, K + 1))
        design[np.arange(windows) % 5 != 0, :, 0] = 0.0
        design[..., K] = 0.0
        y = size * rng.normal(size=(windows, H))
        hessian = np.einsum("whp,whq->pq", design, design)
        theta = np.linalg.solve(hessian[:K, :K], np.einsum("whp,wh->p", design[..., :K], y))
        left = design[..., :K] @ theta - y
        chi2 = float(np.sum(left**2) / (left.size - K))
        nothing = np.zeros(K + 1)
        reported = [
            uncertainty(
                space,
                theta,
                0.0,
                Normal(1.0, 1, hessian, nothing, (left[..., None],), nothing, rows=rows),
                chi2,
                (0.0, 0.04),
                kinks=1.2,
                fixed_latency=True,
            ).interval
            for rows in ((), (_rows(left, design),))
        ]
        held.append([bool(interval[0, 0] <= 0 <= interval[0, 1]) for interval in reported])
        widths.append(np.ptp(reported[1], axis=1) / np.ptp(reported[0], axis=1))
    plain, with_clusters = np.mean(held, axis=0)
    return float(plain), float(with_clusters), float(np.median(widths))


def test_coverage_where_the_model_is_right_and_intervals_stay_what_they_were() -> None:
    """Equal white residuals, 300 draws: 90 % of the intervals hold, the median width is unchanged."""
    plain, with_clusters, width = _coverage(wild=1.0, windows=60, draws=300)
    assert with_clusters >= plain >= 0.9
    assert width == pytest.approx(1.0)


def test_coverage_where_the_model_fails_in_the_windows_that_tell_a_parameter() -> None:
    """Errors four times as large there, 300 draws: a uniform inflation holds too rarely, blocks do not."""
    plain, with_clusters, _ = _coverage(wild=4.0, windows=60, draws=300)
    assert plain < 0.8
    assert with_clusters >= 0.88
