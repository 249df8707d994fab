"""The curious reward: beta times the SRL error, centred by its batch and scaled by a debiased running size."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch as th
from envs_for_tests import VectorBox, tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_cure.curiosity import CuriousReward

ERRORS = st.lists(
    st.lists(st.floats(0, 1e9, width=32), min_size=1, max_size=6),
    min_size=1,
    max_size=20,
)


def error_batches(n: int, size: int = 16, seed: int = 0) -> list[np.ndarray]:
    """Errors as an autoencoder's: falling from 1e-1 towards 1e-3 while it learns."""
    rng = np.random.default_rng(seed)
    return [((1e-3 + 1e-1 * 0.95**i) * rng.gamma(2.0, size=size)).astype(np.float32) for i in range(n)]


def running_mean(values: Sequence[float], decay: float) -> float:
    """Mean under exponentially falling weights that add up to 1, in float64."""
    weights = decay ** np.arange(len(values) - 1, -1, -1.0)
    return float(np.average(values, weights=weights))


@pytest.mark.parametrize("n_batches", [1, 2, 30, 400])
@pytest.mark.parametrize("beta, clip, decay", [(1.0, 5.0, 0.99), (0.3, 0.5, 0.9)])
@pytest.mark.parametrize("center", [True, False])
def test_scaled_reward_against_float64(n_batches: int, beta: float, clip: float, decay: float, center: bool) -> None:
    """From the very first batch on, i.e. without the bias of averages that start at zero."""
    reward = CuriousReward(beta, center=center, clip=clip, decay=decay)
    batches = error_batches(n_batches)
    for batch in batches:
        reward.update(th.as_tensor(batch))
    errors = np.concatenate([batches[-1], batches[0]])
    exact = [batch.astype(np.float64) for batch in batches]
    size = running_mean([batch.var() if center else np.mean(batch**2) for batch in exact], decay) ** 0.5
    expected = beta * np.clip((errors - errors.mean() * center) / size, -clip, clip)
    actual = reward(th.as_tensor(errors))
    assert actual.shape == (len(errors), 1)
    np.testing.assert_allclose(actual[:, 0].numpy(), expected, rtol=1e-3, atol=1e-4)


def test_rewards_are_standard_within_their_batch() -> None:
    """After one batch its own rewards have mean 0 and standard deviation 1, so that beta alone sets the scale."""
    reward = CuriousReward(beta=2.0, clip=100.0)
    errors = th.as_tensor(error_batches(1, size=500)[0])
    reward.update(errors)
    rewards = reward(errors)
    assert float(rewards.mean()) == pytest.approx(0, abs=1e-3)
    assert float(rewards.std(unbiased=False)) == pytest.approx(2, rel=1e-3)


@pytest.mark.parametrize("beta", [0.0, 1.0, 2.5])
def test_outliers_are_clipped_at_five_deviations(beta: float) -> None:
    """By default to +-5, before beta scales."""
    reward = CuriousReward(beta)
    reward.update(th.as_tensor(error_batches(1)[0]) + 1)
    low, high = reward(th.tensor([0.0, 1e6]))[:, 0].tolist()
    assert (low, high) == (-5 * beta, 5 * beta)
    bonus = CuriousReward(beta, center=False)
    bonus.update(th.as_tensor(error_batches(1)[0]))
    low, high = bonus(th.tensor([0.0, 1e6]))[:, 0].tolist()
    assert (low, high) == (0, 5 * beta)


@pytest.mark.parametrize("beta", [0.0, 1.0, 0.37])
def test_without_normalisation_the_reward_is_the_papers(beta: float) -> None:
    """Exactly beta times the error, whatever was seen before, and large errors are not clipped."""
    reward = CuriousReward(beta, normalize=False)
    for batch in error_batches(3):
        reward.update(th.as_tensor(batch))
    errors = th.tensor([0.0, 1e-3, 7.0, 4e4])
    assert th.equal(reward(errors), (beta * errors).unsqueeze(1))


@pytest.mark.parametrize("error", [0.0, 1e-9, 1.7e-3, np.log(128), 903.376, 7.3e4])
@pytest.mark.parametrize("n_batches", [1, 70, 1500])
@pytest.mark.parametrize("size", [1, 128])
def test_constant_errors_are_worth_nothing(error: float, n_batches: int, size: int) -> None:
    """Where all errors are equal nothing is novel: the reward is 0, not NaN, nor rounding errors blown up to +-5."""
    reward = CuriousReward()
    errors = th.full((size,), error)
    for _ in range(n_batches):
        reward.update(errors)
    rewards = reward(errors)
    assert th.isfinite(rewards).all()
    assert float(rewards.abs().max()) < 0.01


@given(ERRORS, st.floats(0, 10))
@settings(deadline=None)
def test_rewards_are_always_finite_and_bounded(batches: list[list[float]], beta: float) -> None:
    """Whatever finite errors came, and in the order of the errors of a batch."""
    reward = CuriousReward(beta)
    for batch in batches:
        errors = th.tensor(batch)
        reward.update(errors)
        rewards = reward(errors)[:, 0]
        assert th.isfinite(rewards).all()
        assert float(rewards.abs().max()) <= 5 * beta * (1 + 1e-6)
        assert (rewards[errors.argsort()].diff() >= 0).all()


def test_errors_are_only_read() -> None:
    """Statistics and reward carry no gradient and change neither the errors nor each other's inputs."""
    reward = CuriousReward()
    errors = th.tensor([1.0, 2.0, 4.0], requires_grad=True)
    reward.update(errors)
    before = {name: value.clone() for name, value in reward.state_dict().items()}
    assert not reward(errors).requires_grad
    assert all(th.equal(value, before[name]) for name, value in reward.state_dict().items())
    assert errors.tolist() == [1.0, 2.0, 4.0]


def test_statistics_travel_in_the_state_dict() -> None:
    """A restored module pays the same reward, and goes on with the same averages."""
    first, second = CuriousReward(), CuriousReward()
    for batch in error_batches(20):
        first.update(th.as_tensor(batch))
    second.load_state_dict(first.state_dict())
    later = th.as_tensor(error_batches(1, seed=1)[0])
    assert not th.equal(first(later), CuriousReward()(later))
    assert th.equal(first(later), second(later))
    first.update(later)
    second.update(later)
    assert th.equal(first(later), second(later))


def test_statistics_belong_to_the_policy() -> None:
    """They are part of the policy's state, hence of SB3's archives, and a training update moves them."""
    model = tiny_model("MlpPolicy", VectorBox())
    model.learn(15)
    state = model.policy.state_dict()
    assert float(state["curiosity.weight"]) == pytest.approx(1 - 0.99**model._n_updates, rel=1e-4)
    assert float(state["curiosity.mean_square"]) > 0
    fresh = tiny_model("MlpPolicy", VectorBox())
    fresh.policy.load_state_dict(state)
    errors = th.linspace(0, 1, 9)
    assert th.equal(fresh.policy.curiosity(errors), model.policy.curiosity(errors))
