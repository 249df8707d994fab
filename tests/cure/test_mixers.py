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


def assert_binomial(successes: float, draws: int, probability: float) -> None:
    """Within 5 standard deviations of the mean, hence exact for probabilities of 0 and 1."""
    deviation = np.sqrt(draws * probability * (1 - probability))
    assert abs(successes - draws * probability) <= 5 * deviation


def choices(mixer: CuriousMixer, steps: int, n_envs: int, p: Any, bout: Any = 1, length: int = 0) -> np.ndarray:
    """Who acted, [steps, n_envs]; episodes of this length (0: one that never ends), the first step begins one."""
    chosen = []
    for step in range(steps):
        if length and step and step % length == 0:
            mixer.starts = np.ones(n_envs, dtype=bool)
        chosen.append(mixer.choose(n_envs, p, bout, 1.0))
    return np.array(chosen)


def stretches(chosen: np.ndarray) -> list[int]:
    """Lengths of the curious stretches of one environment that are over, [steps] to numbers."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(int), [0]])))
    return [int(end - start) for start, end in zip(edges[::2], edges[1::2], strict=True) if end < len(chosen)]


# ---------------------------------------------------------------- the paper's coin


@pytest.mark.parametrize("probability", [0, 0.2, 0.7, 1])
def test_frequency_is_binomial_in_each_environment(probability: float) -> None:
    """Each environment's share of curious steps is p_c; none at 0, all at 1."""
    chosen = choices(CuriousMixer(0), 5000, 4, probability)
    assert chosen.shape == (5000, 4)
    assert chosen.dtype == bool
    for environment in chosen.T:
        assert_binomial(environment.sum(), 5000, probability)


@given(st.integers(0, 2**31), st.integers(1, 5), st.floats(0, 1), st.integers(0, 7))
@settings(deadline=None, max_examples=30)
def test_bouts_of_one_step_are_the_coin_draw_for_draw(seed: int, n_envs: int, p: float, length: int) -> None:
    """One uniform number per environment and step of a generator with the seed, wherever episodes end."""
    chosen = choices(CuriousMixer(seed), 20, n_envs, p, 1, length)
    rng = np.random.default_rng(seed)
    assert np.array_equal(chosen, [rng.random(n_envs) < p for _ in range(20)])


def test_environments_and_steps_are_independent() -> None:
    """Two environments, or one at two successive steps, are both curious with probability p_c squared."""
    chosen = choices(CuriousMixer(0), 20_000, 3, 0.3)
    for first, second in [(0, 1), (0, 2), (1, 2)]:
        assert_binomial((chosen[:, first] & chosen[:, second]).sum(), 20_000, 0.09)
    # Overlapping pairs are correlated, disjoint ones are not.
    assert_binomial((chosen[::2, 0] & chosen[1::2, 0]).sum(), 10_000, 0.09)


def test_schedule_is_a_function_of_the_remaining_progress() -> None:
    """A schedule is asked for p_c at every step, with SB3's remaining progress."""
    mixer = CuriousMixer(seed=0)
    for remaining in (1.0, 0.5, 0.0):
        curious = sum(int(mixer.choose(2, lambda r: 0.8 * r, 1, remaining).sum()) for _ in range(3000))
        assert_binomial(curious, 6000, 0.8 * remaining)


@pytest.mark.parametrize("schedule", [lambda remaining: 2 - 1.5 * remaining, lambda _: -0.1, lambda _: float("nan")])
def test_schedule_that_leaves_its_range_is_refused(schedule: Any) -> None:
    with pytest.raises(ValueError, match=r"curiosity_prob is .* at a remaining progress of 0\.50.*\[0, 1\]"):
        CuriousMixer(seed=0).choose(1, schedule, 1, 0.5)


# ---------------------------------------------------------------- longer bouts


@pytest.mark.parametrize("bout, p", [(1, 0.2), (1, 0.6), (5, 0.2), (5, 0.6), (2.5, 0.4), (20, 0.5)])
def test_curious_stretches_average_their_bout(bout: float, p: float) -> None:
    """L / (1 - p) steps: a redraw may choose the curious actor once more. The share of steps stays p_c."""
    n_envs, steps = 8, 6000
    chosen = choices(CuriousMixer(seed=1), steps, n_envs, p, bout)
    lengths = [length for environment in chosen.T for length in stretches(environment)]
    expected = bout / (1 - p)
    # Lengths are geometric: their deviation is at most their mean.
    assert abs(np.mean(lengths) - expected) < 5 * expected / np.sqrt(len(lengths))
    assert chosen.mean() == pytest.approx(p, abs=5 * np.sqrt(p * (1 - p) * 2 * bout / chosen.size))


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("bout", [1, 10, 60, "episode"])
@pytest.mark.parametrize("p", [0.2, 0.5])
def test_share_of_steps_is_the_probability_in_short_episodes(p: float, bout: Any, n_envs: int) -> None:
    """Of 125 steps, in which long bouts are cut off: within binomial bounds for as many draws as are independent."""
    episodes = 400
    chosen = choices(CuriousMixer(seed=4), 125 * episodes, n_envs, p, bout, length=125)
    # Neighbouring steps are alike with probability 1 - 1/L: 2 L - 1 of them count as one, but no more than an episode.
    alike = 125 if bout == "episode" else min(2 * bout - 1, 125)
    for environment in chosen.T:
        draws = 125 * episodes / alike
        assert_binomial(environment.mean() * draws, draws, p)
    first = chosen[::125]  # the share does not depend on how far an episode is
    assert_binomial(first.sum(), first.size, p)


@given(st.integers(0, 2**31), st.integers(1, 4), st.floats(0, 1), st.integers(2, 9))
@settings(deadline=None, max_examples=30)
def test_bouts_of_episodes_change_at_resets_only(seed: int, n_envs: int, p: float, length: int) -> None:
    chosen = choices(CuriousMixer(seed), 5 * length, n_envs, p, "episode", length)
    assert (chosen.reshape(5, length, n_envs) == chosen[::length][:, None]).all()


@pytest.mark.parametrize("bout", ["episode", 1e9])
@pytest.mark.parametrize("p", [0, 0.3, 1])
def test_every_reset_redraws(bout: Any, p: float) -> None:
    """In the environment that is reset, and in no other."""
    mixer = CuriousMixer(seed=0)
    chosen = choices(mixer, 3 * 3000, 2, p, bout, length=3)
    assert_binomial(chosen[::3].sum(), 6000, p)
    before = mixer.choose(2, 0.0, bout, 1.0)
    mixer.starts = np.array([True, False])
    after = mixer.choose(2, 1.0, bout, 1.0)
    assert after[0] and after[1] == before[1]


@given(st.integers(0, 2**31), BOUTS, st.sampled_from([0.0, 1.0]))
@settings(deadline=None, max_examples=30)
def test_certain_choices_are_certain_for_any_bout(seed: int, bout: Any, p: float) -> None:
    """With p_c = 0 nobody is curious, with 1 everybody; from the first step on."""
    assert (choices(CuriousMixer(seed), 30, 3, p, bout, length=7) == bool(p)).all()


# ---------------------------------------------------------------- streams, states, counts


@pytest.mark.parametrize("bout", [1, 4, "episode"])
def test_seeds_reproduce(bout: Any) -> None:
    """Equal seeds give equal choices whatever happens to numpy's global generator; other seeds give others."""

    def draw(seed: int) -> np.ndarray:
        np.random.seed(seed + 1)
        before = np.random.get_state()[1].copy()  # type: ignore[index, union-attr]
        chosen = choices(CuriousMixer(seed), 50, 3, 0.5, bout, length=5)
        assert np.array_equal(np.random.get_state()[1], before)  # type: ignore[index]
        return chosen

    assert np.array_equal(draw(3), draw(3))
    assert not np.array_equal(draw(3), draw(4))


@given(st.integers(0, 2**31), BOUTS, st.floats(0, 1), st.integers(0, 12))
@settings(deadline=None, max_examples=30)
def test_state_dict_gives_the_same_next_choices(seed: int, bout: Any, p: float, steps: int) -> None:
    """And the same counts, in the middle of a stretch and at a reset."""
    mixer, restored = CuriousMixer(seed), CuriousMixer(seed + 1)
    choices(mixer, steps, 3, p, bout, length=5)
    if steps % 5 == 4:
        mixer.starts = np.array([True, False, True])
    state = copy.deepcopy(mixer.state_dict())
    restored.load_state_dict(copy.deepcopy(state))
    assert str(restored.state_dict()) == str(mixer.state_dict()) == str(state)
    for each in (mixer, restored):
        each.choose(3, p, bout, 1.0)
    assert np.array_equal(mixer.curious, restored.curious)
    assert np.array_equal(choices(mixer, 15, 3, p, bout, 4), choices(restored, 15, 3, p, bout, 4))
    assert mixer.pop_metrics() == restored.pop_metrics()


def test_metrics_count_since_the_last_call() -> None:
    """Share of curious steps and mean length of curious stretches; a reset ends a stretch; nothing without steps."""
    mixer = CuriousMixer(seed=0)
    assert mixer.pop_metrics() == {}
    for n_envs in (1, 5):
        chosen = choices(mixer, 60, n_envs, 0.4, 3)
        found = mixer.pop_metrics()
        bouts = (np.diff(np.vstack([np.zeros(n_envs), chosen]), axis=0) == 1).sum()
        expected = {"rollout/curious_share": chosen.mean(), "rollout/curious_bout": chosen.sum() / bouts}
        assert found == pytest.approx(expected)
    assert mixer.pop_metrics() == {}
    choices(mixer, 12, 1, 1.0, "episode", length=4)
    assert mixer.pop_metrics() == {"rollout/curious_share": 1, "rollout/curious_bout": 4}
    choices(mixer, 3, 1, 0.0, 1)
    assert mixer.pop_metrics() == {"rollout/curious_share": 0}


# ---------------------------------------------------------------- in a rollout


def rollout(steps: int, monkeypatch: pytest.MonkeyPatch, **kwargs: Any) -> tuple[Any, np.ndarray, list[int]]:
    """Steps of three environments after ten random ones, and where the curious actor's action was executed."""
    n_envs, warmup = 3, 30
    env = DummyVecEnv([lambda: VectorBox(low=-2.0, high=4.0)] * n_envs)
    size = n_envs * (warmup + steps)
    model = tiny_model("MlpPolicy", env, learning_starts=warmup, buffer_size=size, gradient_steps=0, **kwargs)
    asked: list[int] = []

    def curious_actions(observations: np.ndarray, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        asked.append(len(observations))
        return np.full((len(observations), 2), 2.5, np.float32), None

    monkeypatch.setattr(model, "predict_curious", curious_actions)
    executed: list[np.ndarray] = []
    step = env.step_async
    monkeypatch.setattr(env, "step_async", lambda actions: (executed.append(actions.copy()), step(actions))[1])
    model.learn(n_envs * (warmup // n_envs + steps), log_interval=10**9)
    # 2.5 in [-2, 4] is 0.5 in [-1, 1], which is what the buffer stores.
    stored = np.isclose(model.replay_buffer.actions[: len(executed)], 0.5).all(axis=2)
    done = np.isclose(np.array(executed), 2.5).all(axis=2)
    assert np.array_equal(stored, done)
    assert not done[: warmup // n_envs].any()
    curious = done[warmup // n_envs :]
    assert len(curious) == steps
    return model, curious, asked


@pytest.mark.parametrize("probability", [0, 0.2, 1])
def test_frequency_in_a_rollout(probability: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Executed and stored actions are the curious actor's with frequency p_c, and at p_c = 0 it is never asked.

    Each environment has its own stream, the random warm-up has no curious actions, and the share is counted.
    """
    model, curious, asked = rollout(400, monkeypatch, curiosity_prob=probability)
    for environment in curious.T:
        assert_binomial(environment.sum(), 400, probability)
    assert sum(asked) == curious.sum() and 0 not in asked
    rng = np.random.default_rng(0)
    assert np.array_equal(curious, [rng.random(3) < probability for _ in range(400)])
    assert model._mixer.pop_metrics()["rollout/curious_share"] == pytest.approx(curious.mean())


def test_episode_bouts_in_a_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who acts changes at resets alone: every 20 steps, of which the random warm-up took the first 10."""
    _, curious, _ = rollout(210, monkeypatch, curiosity_prob=0.5, curiosity_bout="episode")
    first, rest = curious[:10], curious[10:].reshape(10, 20, 3)
    assert (first == first[0]).all() and (rest == rest[:, :1]).all()
    assert 0 < rest[:, 0].mean() < 1


@pytest.mark.parametrize("bout", [1, 6, "episode"])
def test_logged_bout_is_the_mean_as_it_happened(bout: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the stretches of each environment, which resets cut: after 10 steps, then every 20."""
    model, curious, _ = rollout(210, monkeypatch, curiosity_prob=0.4, curiosity_bout=bout)
    episodes = np.split(curious, range(10, 210, 20))
    runs = [len(run) for each in episodes for env in each.T for run in "".join(map(str, env.astype(int))).split("0")]
    lengths = [length for length in runs if length > 0]
    written: dict[str, float] = {}
    monkeypatch.setattr(model.logger, "record", lambda key, value, *rest, **kwargs: written.update({key: value}))
    model.dump_logs()
    assert written["rollout/curious_bout"] == pytest.approx(np.mean(lengths))
    assert written["rollout/curious_share"] == pytest.approx(curious.mean())


# ---------------------------------------------------------------- a random second actor


@given(st.integers(0, 2**31), st.integers(1, 4), st.floats(0.1, 1), BOUTS, st.integers(0, 7))
@settings(deadline=None, max_examples=40)
def test_random_actions_are_held_for_a_bout(seed: int, n_envs: int, p: float, bout: Any, length: int) -> None:
    """A new one in each step with L = 1, else where who acts is redrawn; environments hold their own."""
    mixer, n_drawn = CuriousMixer(seed), 0

    def sample() -> np.ndarray:
        nonlocal n_drawn
        n_drawn += 1
        return np.array([n_drawn, -n_drawn])

    held = np.zeros(n_envs, dtype=int)
    for step in range(30):
        if length and step and step % length == 0:
            mixer.starts = np.ones(n_envs, dtype=bool)
        began, before = (mixer.starts if step else np.ones(n_envs, dtype=bool)), n_drawn
        was = mixer.curious.copy() if step else np.zeros(n_envs, dtype=bool)
        curious = mixer.choose(n_envs, p, bout, 1.0)
        if not curious.any():
            continue
        actions = mixer.hold(sample)
        assert actions.shape[0] == curious.sum() and (actions[:, 1:] == -actions[:, :1]).all()
        now = held.copy()
        now[curious] = actions[:, 0]
        new = curious & (now > before)
        assert new[curious & (began | ~was)].all() and n_drawn - before == new.sum()
        if bout == 1:
            assert np.array_equal(new, curious)
        elif bout == "episode":
            assert np.array_equal(new, curious & began)
        assert np.array_equal(now[curious & ~new], held[curious & ~new])
        held = now


def test_a_held_action_goes_on_after_a_resume(tmp_path: Path) -> None:
    """Inside a bout, to the end of the episode."""
    settings: dict[str, Any] = dict(curiosity="random", curiosity_bout="episode", curiosity_prob=1.0, learning_starts=0)
    model = tiny_model("MlpPolicy", VectorBox(), **settings)
    model.learn(5, callback=ExactCheckpoint(5, tmp_path / "at"))
    resumed = CuReSAC.resume(tmp_path / "at", VectorBox())
    resumed.learn(10, reset_num_timesteps=False)
    actions = resumed.replay_buffer.actions[:15, 0]  # type: ignore[union-attr]
    assert (actions == actions[0]).all()
