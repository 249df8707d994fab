"""Which actor acts: Bernoulli draws per environment and step, constant or scheduled, reproducible and counted."""

from typing import Any

import numpy as np
import pytest
from envs_for_tests import VectorBox, tiny_model
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure.mixers import CuriousMixer


def assert_binomial(successes: float, draws: int, probability: float) -> None:
    """Within 5 standard deviations of the mean, hence exact for probabilities of 0 and 1."""
    deviation = np.sqrt(draws * probability * (1 - probability))
    assert abs(successes - draws * probability) <= 5 * deviation


@pytest.mark.parametrize("probability", [0, 0.2, 0.7, 1])
def test_frequency_is_binomial_in_each_environment(probability: float) -> None:
    """Each environment's share of curious steps is p_c; none at 0, all at 1."""
    mixer = CuriousMixer(probability, seed=0)
    choices = np.array([mixer.choose(4, 1.0) for _ in range(5000)])
    assert choices.shape == (5000, 4)
    assert choices.dtype == bool
    for environment in choices.T:
        assert_binomial(environment.sum(), 5000, probability)


def test_environments_and_steps_are_independent() -> None:
    """Two environments, or one at two successive steps, are both curious with probability p_c squared."""
    mixer = CuriousMixer(0.3, seed=0)
    choices = np.array([mixer.choose(3, 1.0) for _ in range(20_000)])
    for first, second in [(0, 1), (0, 2), (1, 2)]:
        assert_binomial((choices[:, first] & choices[:, second]).sum(), 20_000, 0.09)
    # Overlapping pairs are correlated, disjoint ones are not.
    assert_binomial((choices[::2, 0] & choices[1::2, 0]).sum(), 10_000, 0.09)


def test_schedule_is_a_function_of_the_remaining_progress() -> None:
    """A schedule is asked for p_c at every step, with SB3's remaining progress."""
    mixer = CuriousMixer(lambda remaining: 0.8 * remaining, seed=0)
    for remaining in (1.0, 0.5, 0.0):
        curious = sum(int(mixer.choose(2, remaining).sum()) for _ in range(3000))
        assert_binomial(curious, 6000, 0.8 * remaining)


def test_a_schedule_that_leaves_its_range_is_refused_when_it_does() -> None:
    """What begins within [0, 1] may leave it later."""
    mixer = CuriousMixer(lambda remaining: 2 - 1.5 * remaining, seed=0)
    mixer.choose(1, 1.0)
    with pytest.raises(ValueError, match=r"curiosity_prob is 1\.25 \(progress remaining 0\.50\).*\[0, 1\]"):
        mixer.choose(1, 0.5)


@pytest.mark.parametrize("probability", [-0.1, 1.1, float("nan"), lambda remaining: 1 + remaining])
def test_a_probability_outside_its_range_is_refused_at_once(probability: Any) -> None:
    with pytest.raises(ValueError, match=r"curiosity_prob is .*within \[0, 1\]"):
        CuriousMixer(probability)


def test_seeds_reproduce() -> None:
    """Equal seeds give equal choices whatever happens to numpy's global generator; other seeds give others."""

    def draw(seed: int) -> np.ndarray:
        mixer = CuriousMixer(0.5, seed)
        np.random.seed(seed + 1)
        before = np.random.get_state()[1].copy()
        choices = np.array([mixer.choose(3, 1.0) for _ in range(50)])
        assert np.array_equal(np.random.get_state()[1], before)
        return choices

    assert np.array_equal(draw(3), draw(3))
    assert not np.array_equal(draw(3), draw(4))


def test_share_counts_since_the_last_call() -> None:
    """``pop_share`` is the share of curious environment steps since it was last asked; NaN without any."""
    mixer = CuriousMixer(0.4, seed=0)
    assert np.isnan(mixer.pop_share())
    for n_envs in (1, 5):
        choices = [mixer.choose(n_envs, 1.0) for _ in range(30)]
        assert mixer.pop_share() == np.mean(choices)
    assert np.isnan(mixer.pop_share())


@pytest.mark.parametrize("probability", [0, 0.2, 1])
def test_frequency_in_a_rollout(probability: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Executed and stored actions are the curious actor's with frequency p_c, and at p_c = 0 it is never asked.

    Each environment has its own stream, the random warm-up has no curious actions, and the share is logged.
    """
    n_envs, warmup, steps = 3, 30, 900
    env = DummyVecEnv([lambda: VectorBox(low=-2.0, high=4.0)] * n_envs)
    model = tiny_model(
        "MlpPolicy",
        env,
        curiosity_prob=probability,
        learning_starts=warmup,
        buffer_size=n_envs * (warmup + steps),
        gradient_steps=0,
    )
    asked: list[int] = []

    def curious_actions(observations: np.ndarray, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        asked.append(len(observations))
        return np.full((len(observations), 2), 2.5, np.float32), None

    monkeypatch.setattr(model, "predict_curious", curious_actions)
    executed: list[np.ndarray] = []
    step = env.step_async
    monkeypatch.setattr(env, "step_async", lambda actions: (executed.append(actions.copy()), step(actions))[1])
    shares: list[float] = []
    model.learn(n_envs * (warmup // n_envs + steps), log_interval=10**9)
    shares.append(model._mixer.pop_share())

    # 2.5 in [-2, 4] is 0.5 in [-1, 1], which is what the buffer stores.
    stored = np.isclose(model.replay_buffer.actions[: len(executed)], 0.5).all(axis=2)
    done = np.isclose(np.array(executed), 2.5).all(axis=2)
    assert np.array_equal(stored, done)
    assert not done[: warmup // n_envs].any()
    curious = done[warmup // n_envs :]
    assert len(curious) == steps
    for environment in curious.T:
        assert_binomial(environment.sum(), steps, probability)
    assert sum(asked) == curious.sum()
    assert (0 in asked) is False
    assert shares == [pytest.approx(curious.mean())]
