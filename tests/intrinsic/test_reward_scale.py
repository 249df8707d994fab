"""How an intrinsic reward is scaled: minus the batch's mean, divided by a debiased running deviation, times beta."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from updates_for_tests import filled_model, train_once

from sb3_cure.intrinsic import RewardScale

ERRORS = st.lists(st.lists(st.floats(0, 1e9, width=32), min_size=1, max_size=6), min_size=1, max_size=20)


def error_batches(n: int, size: int = 16, seed: int = 0) -> list[np.ndarray]:
    """Errors as an autoencoder's: falling from 1e-1 towards 1e-3 while it learns."""
    rng = np.random.default_rng(seed)
    return [((1e-3 + 1e-1 * 0.95**i) * rng.gamma(2.0, size=size)).astype(np.float32) for i in range(n)]


def scaled(
    scale: RewardScale, batch: np.ndarray, beta: float = 1.0, normalize: bool = True, center: bool = True
) -> np.ndarray:
    reward = scale(th.as_tensor(batch), beta, normalize, center)
    assert reward.shape == (len(batch), 1)
    return reward[:, 0].numpy()


def running(numbers: Sequence[float], decay: float) -> float:
    """Mean under exponentially falling weights that add up to 1."""
    weights = decay ** np.arange(len(numbers) - 1, -1, -1.0)
    return float(np.average(numbers, weights=weights))


@pytest.mark.parametrize("center", [True, False])
@pytest.mark.parametrize("n_batches", [1, 2, 30, 400])
@pytest.mark.parametrize("beta, clip, decay", [(1.0, 5.0, 0.99), (0.3, 0.5, 0.4)])
def test_standardised_reward_against_float64(
    n_batches: int, beta: float, clip: float, decay: float, center: bool
) -> None:
    """From the very first batch on, i.e. without the bias of averages that start at zero."""
    scale, batches = RewardScale(decay, clip), error_batches(n_batches)
    for batch in batches:
        actual = scaled(scale, batch, beta, center=center)
    exact = [batch.astype(np.float64) for batch in batches]
    deviation = np.sqrt(running([np.var(b) if center else np.mean(b**2) for b in exact], decay))
    mean = exact[-1].mean() if center else 0
    np.testing.assert_allclose(
        actual, beta * np.clip((exact[-1] - mean) / deviation, -clip, clip), rtol=1e-3, atol=1e-4
    )


@pytest.mark.parametrize("center", [True, False])
@pytest.mark.parametrize("beta", [0.0, 1.0, 0.37])
def test_without_normalisation_the_reward_is_the_papers(beta: float, center: bool) -> None:
    """Exactly beta times the error, whatever was seen before, and large errors are not clipped."""
    scale = RewardScale()
    for batch in error_batches(3):
        scaled(scale, batch)
    errors = np.float32([0.0, 1e-3, 7.0, 4e4])
    before = {name: value.clone() for name, value in scale.state_dict().items()}
    np.testing.assert_array_equal(
        scaled(scale, errors, beta, normalize=False, center=center), np.float32(beta) * errors
    )
    assert all(th.equal(value, before[name]) for name, value in scale.state_dict().items())


@pytest.mark.parametrize("error", [0.0, 1e-9, 1.7e-3, np.log(128), 7.3e4])
@pytest.mark.parametrize("n_batches", [1, 300])
@pytest.mark.parametrize("size", [1, 100, 128])
def test_constant_errors_are_worth_nothing(error: float, n_batches: int, size: int) -> None:
    """Where all errors are equal nothing is novel: the reward is 0, not NaN, nor rounding errors blown up to +-5."""
    scale, errors = RewardScale(), np.full(size, error, np.float32)
    for _ in range(n_batches):
        rewards = scaled(scale, errors)
    assert np.isfinite(rewards).all()
    assert np.abs(rewards).max() < 0.01


@given(ERRORS, st.floats(0, 10), st.booleans())
@settings(deadline=None)
def test_rewards_are_always_finite_and_bounded(batches: list[list[float]], beta: float, center: bool) -> None:
    """Whatever finite errors came, and in the order of the errors of a batch."""
    scale = RewardScale()
    for batch in batches:
        errors = np.float32(batch)
        rewards = scaled(scale, errors, beta, center=center)
        assert np.isfinite(rewards).all()
        assert np.abs(rewards).max() <= 5 * beta * (1 + 1e-6)
        assert (np.diff(rewards[errors.argsort()]) >= 0).all()


def test_broken_errors_leave_the_statistics_alone() -> None:
    """On a GPU what is not finite is noticed later; the average must not remember it."""
    scale = RewardScale()
    scaled(scale, error_batches(1)[0])
    before = {name: value.clone() for name, value in scale.state_dict().items()}
    scaled(scale, np.float32([1.0, np.nan, np.inf]))
    assert all(th.equal(value, before[name]) for name, value in scale.state_dict().items())


@pytest.mark.parametrize("curiosity, centred", [("separate", True), ("bonus", False)])
def test_the_agents_reward_is_centred_the_bonus_is_not(curiosity: str, centred: bool) -> None:
    logged = train_once(filled_model(pixels=True, curiosity=curiosity, curiosity_beta=0.5))
    mean, spread = logged["curious_reward_mean"], logged["curious_reward_std"]
    assert spread > 0
    assert abs(mean) < 1e-3 if centred else 0.25 < mean < 1


@pytest.mark.parametrize("center", [True, False])
@pytest.mark.parametrize("batches_before", [0, 1])
def test_rewards_that_are_not_finite_stay_so(batches_before: int, center: bool) -> None:
    """Clipped they would pass for rewards, and the look at the critics' loss would see nothing."""
    scale = RewardScale()
    for _ in range(batches_before):
        scaled(scale, np.float32([1.0, 2.0]), center=center)
    assert not np.isfinite(scaled(scale, np.float32([1.0, np.inf]), center=center)[1])
