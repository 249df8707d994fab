"""Who acts, and for how long: draws per environment and step, constant or scheduled, reproducible and counted."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import VectorBox, tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cure import CuReSAC
from sb3_cure.cure.mixers import CuriousMixer
from sb3_cure.persistence import ExactCheckpoint

BOUTS = st.one_of(st.just("episode"), st.floats(1, 50))
SEEDS = st.integers(0, 2**31)


def assert_binomial(successes: float, draws: float, probability: float) -> None:
    """Within 5 standard deviations of the mean, hence exact for probabilities of 0 and 1."""
    deviation = np.sqrt(draws * probability * (1 - probability))
    assert abs(successes - draws * probability) <= 5 * deviation + 1e-9


def starts(step: int, n_envs: int, length: int) -> np.ndarray:
    """Whether episodes of this length (0: one that never ends) begin with a step."""
    return np.full(n_envs, step % length == 0 if length else step == 0)


def choices(mixer: CuriousMixer, steps: int, n_envs: int, p: Any, bout: Any = 1, length: int = 0) -> np.ndarray:
    """Who acted, [steps, n_envs]."""
    return np.array([mixer.choose(starts(step, n_envs, length), p, bout, 1.0) for step in range(steps)])


# ---------------------------------------------------------------- draws


@given(SEEDS, st.integers(1, 5), st.floats(0, 1), st.integers(0, 7))
@settings(deadline=None, max_examples=30)
def test_bouts_of_one_step_are_the_papers_coin(seed: int, n_envs: int, p: float, length: int) -> None:
    """One uniform number per environment and step of a generator with the seed, wherever episodes end."""
    rng = np.random.default_rng(seed)
    expected = [rng.random(n_envs) < p for _ in range(20)]
    assert np.array_equal(choices(CuriousMixer(seed), 20, n_envs, p, 1, length), expected)


def test_probability_may_be_a_schedule_of_the_progress() -> None:
    mixer = CuriousMixer(seed=0)
    for remaining in (1.0, 0.5, 0.0):
        chosen = [mixer.choose(np.zeros(2, bool), lambda r: 0.8 * r, 1, remaining).sum() for _ in range(3000)]
        assert_binomial(sum(chosen), 6000, 0.8 * remaining)


@pytest.mark.parametrize("schedule", [lambda remaining: 2 - 1.5 * remaining, lambda _: -0.1, lambda _: float("nan")])
def test_schedule_that_leaves_its_range_is_refused(schedule: Any) -> None:
    with pytest.raises(ValueError, match=r"curiosity_prob must be in \[0, 1\]"):
        CuriousMixer(seed=0).choose(np.ones(1, bool), schedule, 1, 0.5)


@pytest.mark.parametrize("bout, p", [(1, 0.6), (5, 0.2), (2.5, 0.4), (20, 0.5)])
def test_curious_stretches_average_their_bout(bout: float, p: float) -> None:
    """L / (1 - p) steps: a redraw may choose the curious actor once more."""
    lengths: list[int] = []
    for environment in choices(CuriousMixer(seed=1), 6000, 8, p, bout).T:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], environment, [0]])))
        lengths += [end - start for start, end in zip(edges[::2], edges[1::2], strict=True) if end < 6000]
    expected = bout / (1 - p)
    # Lengths are geometric: their deviation is at most their mean.
    assert abs(np.mean(lengths) - expected) < 5 * expected / np.sqrt(len(lengths))


@pytest.mark.parametrize("bout", [1, 10, 60, "episode"])
@pytest.mark.parametrize("p", [0, 0.2, 0.5, 1])
def test_share_of_steps_is_the_probability(p: float, bout: Any) -> None:
    """In each environment, also in episodes that cut long bouts off, and in their first steps."""
    episodes, length = 400, 50
    chosen = choices(CuriousMixer(seed=4), length * episodes, 2, p, bout, length)
    # Neighbouring steps are alike with probability 1 - 1/L: 2 L - 1 of them count as one, but no more than an episode.
    alike = length if bout == "episode" else min(2 * bout - 1, length)
    for environment in chosen.T:
        assert_binomial(environment.mean() * length * episodes / alike, length * episodes / alike, p)
    assert_binomial(chosen[::length].sum(), 2 * episodes, p)
    if bout == "episode":
        assert (chosen.reshape(episodes, length, 2) == chosen[::length][:, None]).all()


@pytest.mark.parametrize("bout", ["episode", 1e9])
def test_reset_redraws_in_its_own_environment(bout: Any) -> None:
    mixer = CuriousMixer(seed=0)
    mixer.choose(np.ones(2, bool), 0.0, bout, 1.0)
    assert mixer.choose(np.array([True, False]), 1.0, bout, 1.0).tolist() == [True, False]
    assert mixer.choose(np.array([False, False]), 0.0, bout, 1.0).tolist() == [True, False]


@given(SEEDS, BOUTS, st.floats(0, 1), st.integers(0, 12))
@settings(deadline=None, max_examples=30)
def test_state_dict_gives_the_same_next_choices(seed: int, bout: Any, p: float, steps: int) -> None:
    """And the same counts, in the middle of a stretch; numpy's global generator has no part in it."""
    mixer, restored = CuriousMixer(seed), CuriousMixer(seed + 1)
    choices(mixer, steps, 3, p, bout, length=5)
    restored.load_state_dict(copy.deepcopy(mixer.state_dict()))
    np.random.seed(0)
    first = choices(mixer, 15, 3, p, bout, 4)
    np.random.seed(1)
    assert np.array_equal(first, choices(restored, 15, 3, p, bout, 4))
    assert mixer.pop_metrics() == restored.pop_metrics()


def test_metrics_count_since_the_last_call() -> None:
    """Share of curious steps and mean length of curious stretches; a reset ends a stretch; nothing without steps."""
    mixer = CuriousMixer(seed=0)
    assert mixer.pop_metrics() == {}
    chosen = choices(mixer, 60, 5, 0.4, 3)
    bouts = (np.diff(np.vstack([np.zeros(5), chosen]), axis=0) == 1).sum()
    expected = {"rollout/curious_share": chosen.mean(), "rollout/curious_bout": chosen.sum() / bouts}
    assert mixer.pop_metrics() == pytest.approx(expected)
    assert mixer.pop_metrics() == {}
    choices(mixer, 12, 1, 1.0, "episode", length=4)
    assert mixer.pop_metrics() == {"rollout/curious_share": 1, "rollout/curious_bout": 4}
    choices(mixer, 3, 1, 0.0, 1)
    assert mixer.pop_metrics() == {"rollout/curious_share": 0}


# ---------------------------------------------------------------- in a rollout


def rollout(steps: int, monkeypatch: pytest.MonkeyPatch, **kwargs: Any) -> tuple[Any, np.ndarray, list[int]]:
    """Make steps of three environments after ten random ones.

    :return: The model, where the curious actor's action was executed, and how many it was asked for in each step
    """
    n_envs, warmup = 3, 30
    env = DummyVecEnv([lambda: VectorBox(low=-2.0, high=4.0)] * n_envs)
    size = n_envs * (warmup + steps)
    model = tiny_model("MlpPolicy", env, learning_starts=warmup, buffer_size=size, gradient_steps=0, **kwargs)
    asked: list[int] = []

    def curious_actions(observations: np.ndarray, deterministic: bool = False) -> tuple[np.ndarray, None]:
        assert not deterministic, "it explores with noise"
        asked.append(len(observations))
        return 1 + observations, None

    monkeypatch.setattr(model, "predict_curious", curious_actions)
    executed: list[np.ndarray] = []
    step = env.step_async
    monkeypatch.setattr(env, "step_async", lambda actions: (executed.append(actions.copy()), step(actions))[1])
    model.learn(n_envs * (warmup // n_envs + steps), log_interval=10**9)
    # 1 + o in [-2, 4] is o / 3 in [-1, 1], which is what the buffer stores: o is of the same environment.
    seen = model.replay_buffer.observations[: len(executed)]
    stored = np.isclose(model.replay_buffer.actions[: len(executed)], seen / 3, atol=1e-6).all(axis=2)
    done = np.isclose(np.array(executed), 1 + seen, atol=1e-5).all(axis=2)
    assert np.array_equal(stored, done)
    assert not done[: warmup // n_envs].any()
    return model, done[warmup // n_envs :], asked


@pytest.mark.parametrize("probability", [0, 0.2, 1])
def test_curious_actions_are_executed_with_their_probability(
    probability: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And stored; the curious actor is asked for no others; the random warm-up has none."""
    model, curious, asked = rollout(200, monkeypatch, curiosity_prob=probability)
    rng = np.random.default_rng(0)
    assert np.array_equal(curious, [rng.random(3) < probability for _ in range(200)])
    assert sum(asked) == curious.sum() and 0 not in asked
    assert model._mixer.pop_metrics()["rollout/curious_share"] == pytest.approx(curious.mean())


def test_another_call_of_learn_continues_no_bout() -> None:
    """Each call begins with a reset, in its warm-up, when nobody asks who acts: after it the curious actor would act
    on, as it did at the end of the call before."""
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=3, curiosity_bout="episode", curiosity_prob=1.0)
    model.learn(6)
    assert model._mixer.curious.all()
    model.curiosity_prob = 0.0
    model.learn(6)
    assert not model._mixer.curious.any()


@pytest.mark.parametrize("bout", [6, "episode"])
def test_logged_bout_is_the_mean_as_it_happened(bout: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the stretches of each environment, which resets cut: after 10 steps, then every 20."""
    model, curious, _ = rollout(210, monkeypatch, curiosity_prob=0.4, curiosity_bout=bout)
    episodes = np.split(curious, range(10, 210, 20))
    if bout == "episode":
        assert all((each == each[0]).all() for each in episodes)
    runs = [len(run) for each in episodes for env in each.T for run in "".join(map(str, env.astype(int))).split("0")]
    written: dict[str, float] = {}
    monkeypatch.setattr(model.logger, "record", lambda key, value, *rest, **kwargs: written.update({key: value}))
    model.dump_logs()
    assert written["rollout/curious_bout"] == pytest.approx(np.mean([length for length in runs if length > 0]))
    assert written["rollout/curious_share"] == pytest.approx(curious.mean())


# ---------------------------------------------------------------- a random second actor


@given(SEEDS, st.integers(1, 4), st.floats(0.1, 1), BOUTS, st.integers(1, 7))
@settings(deadline=None, max_examples=40)
def test_random_actions_are_held_for_a_bout(seed: int, n_envs: int, p: float, bout: Any, length: int) -> None:
    """A new one in each step with L = 1, else at resets and where a bout begins; environments hold their own."""
    mixer, drawn = CuriousMixer(seed), [0]

    def sample() -> np.ndarray:
        drawn[0] += 1
        return np.array([drawn[0], -drawn[0]])

    held, was = np.zeros(n_envs, dtype=int), np.zeros(n_envs, dtype=bool)
    for step in range(30):
        began, before = starts(step, n_envs, length), drawn[0]
        curious = mixer.choose(began, p, bout, 1.0)
        if curious.any():
            actions = mixer.hold(sample)
            now = held.copy()
            now[curious] = actions[:, 0]
            new = curious & (now > before)
            assert len(actions) == curious.sum() and drawn[0] - before == new.sum()
            assert new[curious & (began | ~was)].all()
            if bout == 1 or bout == "episode":
                assert np.array_equal(new, curious & (began | (bout == 1)))
            assert np.array_equal(now[curious & ~new], held[curious & ~new])
            held = now
        was = curious.copy()


def test_held_action_survives_a_resume(tmp_path: Path) -> None:
    """Inside a bout, to the end of the episode."""
    arguments: dict[str, Any] = dict(curiosity="random", curiosity_bout="episode", curiosity_prob=1.0)
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=0, **arguments)
    model.learn(5, callback=ExactCheckpoint(5, tmp_path / "at"))
    resumed = CuReSAC.resume(tmp_path / "at", VectorBox())
    resumed.learn(10, reset_num_timesteps=False)
    actions = resumed.replay_buffer.actions[:15, 0]  # type: ignore[union-attr]
    assert (actions == actions[0]).all()
