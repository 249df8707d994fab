"""What environments return is finite, or an error, or marked and never sampled; so are the actions they get."""

import copy
import functools
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
    unwrap_vec_wrapper,
)

from sb3_cure import CuReSAC
from sb3_cure.vec_env import BadTransitionError, FiniteCheck

NAN, INF = float("nan"), float("inf")
PLAIN: dict[str, Any] = dict(srl=None, curiosity=None)


class Flawed(VectorBox):
    """Episodes of 5 steps, in which what is told is returned at given steps, counted from the first reset.

    :param flaws: By step: ``"reward"``, ``"observation"`` or ``"reset"`` (the first observation of the episode that
        starts after this step)
    :param value: What is told
    """

    def __init__(self, flaws: dict[int, str] | None = None, value: float = NAN):
        super().__init__(episode_length=5)  # with the defaults of the class that comes next
        self.flaws, self.value, self.total = dict(flaws or {}), value, 0

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        if self.flaws.get(self.total) == "reset":
            observation[1] = self.value
        return observation, info

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        self.total += 1
        flaw = self.flaws.get(self.total)
        if flaw == "observation":
            observation[0] = self.value
        return observation, self.value if flaw == "reward" else reward, terminated, truncated, info


class FlawedBox(Flawed, VectorBox):
    """Vectors."""


class FlawedPixels(Flawed, PixelBox):
    """Images, which are whole numbers: only rewards can be flawed."""


def flawed(*flaws: dict[int, str], value: float = NAN) -> DummyVecEnv:
    return DummyVecEnv([functools.partial(FlawedBox, each, value) for each in flaws])


def steps_of(venv: VecEnv, n_steps: int) -> list[Any]:
    """Observations of a reset, then what each of some random steps returned."""
    rng = np.random.default_rng(0)
    seen: list[Any] = [copy.deepcopy(venv.reset())]
    for _ in range(n_steps):
        actions = rng.uniform(-1, 1, (venv.num_envs, 2)).astype(np.float32)
        seen.append(copy.deepcopy(venv.step(actions)))
    return seen


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
@pytest.mark.parametrize(
    "flaws, sentence",
    [
        ({7: "reward"}, "environment 1 returned the reward nan at agent step 14, but rewards must be finite"),
        ({7: "observation"}, "environment 1 returned the observation with nan in it at agent step 14, but obs"),
        ({5: "observation"}, "environment 1 returned the terminal observation with nan in it at agent step 10, but"),
        ({5: "reset"}, "environment 1 returned the observation with nan in it at agent step 10, but"),
        ({0: "reset"}, "environment 1 returned the first observation with nan in it at agent step 0, but"),
    ],
    ids=["reward", "observation", "terminal observation", "reset", "first reset"],
)
def test_bad_transitions_raise_and_are_not_stored(flaws: Any, sentence: str, extras: dict[str, Any]) -> None:
    """Nothing of that step is stored, of no environment; the next `learn` starts with a reset."""
    venv = DummyVecEnv([VectorBox, functools.partial(FlawedBox, flaws)])
    model = tiny_model("MlpPolicy", venv, learning_starts=100, **extras)
    with pytest.raises(ValueError, match=rf"{sentence}.*: it was not stored; fix .*='skip'\."):
        model.learn(40)
    assert model.replay_buffer.pos == max(max(flaws) - 1, 0)
    venv.envs[1].unwrapped.flaws.clear()
    model.learn(1, reset_num_timesteps=False)
    # Otherwise the next transition stored would span the steps between.
    assert venv.envs[1].unwrapped.n_steps == 1
    assert np.isfinite(model.replay_buffer.observations[: model.replay_buffer.pos]).all()


FLAWS = st.dictionaries(st.integers(0, 12), st.sampled_from(["reward", "observation", "reset"]), max_size=6)


@settings(max_examples=100, deadline=None)
@given(st.lists(FLAWS, min_size=2, max_size=2), st.sampled_from([NAN, INF, -INF, 1e39]))
@pytest.mark.filterwarnings("ignore:environment", "ignore:overflow")
def test_skipped_transitions_are_marked_and_others_unchanged(flaws: list[Any], value: float) -> None:
    """Marked is what has a bad reward, ends or starts in a bad observation, and nothing else; the rest is finite."""

    def seeded(each: list[Any]) -> VecEnv:
        venv = FiniteCheck(flawed(*each, value=value), "skip")
        venv.seed(0)
        return venv

    venv = seeded(flaws)
    found, clean = steps_of(venv, 12), steps_of(seeded([{}, {}]), 12)
    n_bad, last = 0, found[0]
    for t, (row, right) in enumerate(zip(found[1:], clean[1:], strict=True), start=1):
        obs, rewards, _, infos = row
        ends = [np.asarray(info.get("terminal_observation", 0.0)) for info in infos]
        assert all(np.isfinite(array).all() for array in (last, obs, rewards, *ends))
        for i, flaw in enumerate(flaws):
            bad_start = flaw.get(t - 1) == ("reset" if (t - 1) % 5 == 0 else "observation")
            bad = bad_start or flaw.get(t) in ("reward", "observation")
            n_bad += bad
            assert ("bad_transition" in infos[i]) == bad, (t, i)
            if not bad and flaw.get(t) != "reset":
                assert differences([part[i] for part in row], [part[i] for part in right]) == []
            if flaw.get(t) == "observation" and t % 5 != 0:
                np.testing.assert_array_equal(obs[i], last[i])  # a stand-in: the last good one
        last = obs
    assert venv.n_bad == n_bad


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
def test_skipping_warns_once_per_kind_and_counts(extras: dict[str, Any]) -> None:
    """The policy never sees what is not finite, with every kind of flaw while it acts and learns."""
    flaws = {0: "reset", 15: "reset", 17: "reward", 18: "reward", 20: "observation", 22: "observation"}
    env = FlawedBox(flaws)
    model = tiny_model("MlpPolicy", env, on_bad_transition="skip", learning_starts=3, gradient_steps=0, **extras)
    seen = []
    predict = model.predict
    model.predict = lambda observation, **kw: (seen.append(observation), predict(observation, **kw))[1]  # type: ignore[method-assign, assignment]
    with pytest.warns(UserWarning) as caught:
        model.learn(30, log_interval=100)
    told = [str(w.message) for w in caught if "on_bad_transition" in str(w.message)]
    kinds = ("first observation with nan", "observation with nan", "reward nan", "terminal observation with nan")
    assert len(told) == 4
    assert all(any(f"the {kind}" in sentence for sentence in told) for kind in kinds)
    assert model.num_timesteps == 30 and len(seen) == 27 and np.isfinite(seen).all()
    # Steps 1 and 16 start in a bad observation, 17 and 18 have a bad reward, 20 and 22 end in one, 23 starts there.
    assert model.env.n_bad == 7
    recorded = {}
    model.logger.dump = lambda step: recorded.update(model.logger.name_to_value)  # type: ignore[method-assign]
    model.dump_logs()
    assert recorded["rollout/bad_transitions"] == 7


@pytest.mark.parametrize("env", [FlawedBox, FlawedPixels], ids=["ReplayBuffer", "FrameStackReplayBuffer"])
@pytest.mark.filterwarnings("ignore:environment")
def test_skipped_transitions_are_never_sampled(env: Any) -> None:
    venv = DummyVecEnv([functools.partial(env, {t: "reward" for t in range(2, 40, 3)}), env])
    policy = "MlpPolicy" if env is FlawedBox else "CnnPolicy"
    model = tiny_model(policy, venv, on_bad_transition="skip", learning_starts=1000)
    good = []
    step_wait = model.env.step_wait

    def spy() -> Any:
        result = step_wait()
        good.extend(venv.actions[i].tobytes() for i in range(2) if "bad_transition" not in result[3][i])
        return result

    model.env.step_wait = spy
    model.learn(80)
    assert model.env.n_bad == 13 and len(good) == len(set(good)) == 67
    assert {action.tobytes() for action in model.replay_buffer.sample(2000).actions.numpy()} == set(good)


@pytest.mark.parametrize("extras", [{}, PLAIN], ids=["all", "plain SAC"])
@pytest.mark.parametrize("mode", ["raise", "skip"])
def test_no_environment_gets_an_action_that_is_not_finite(mode: str, extras: dict[str, Any]) -> None:
    """Not the environment's fault, hence never skipped; here it comes from the noise."""
    noise = NormalActionNoise(np.zeros(2), np.array([0.0, NAN]))
    env = VectorBox()
    model = tiny_model("MlpPolicy", env, action_noise=noise, on_bad_transition=mode, **extras)
    with pytest.raises(ValueError, match=r"chose the action \[.* nan\] for environment 0 at agent step 0, but actions"):
        model.learn(5)
    assert env.n_steps == 0 and model.replay_buffer.pos == 0


def test_values_that_normalization_hides_are_found() -> None:
    """Frozen VecNormalize clips an infinite reward to 10, but the buffer stores the original."""
    venv = VecNormalize(flawed({3: "reward"}, value=INF), training=False, norm_obs=False)
    model = tiny_model("MlpPolicy", venv)
    with pytest.raises(BadTransitionError, match="the reward inf at agent step 3"):
        model.learn(10)
    assert model.replay_buffer.pos == 2
    venv = VecNormalize(flawed({0: "reset"}, value=INF), training=False)
    with pytest.raises(BadTransitionError, match="environment 0 returned the first observation with inf in it"):
        FiniteCheck(venv).reset()


class NanAtTheEnd(VectorBox):
    """Its last rewards are not finite, in episodes of some numbers."""

    def __init__(self, *in_episodes: int) -> None:
        super().__init__()
        self.in_episodes, self.n_episodes = in_episodes, 0

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self.n_episodes += 1
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        is_bad = truncated and self.n_episodes in self.in_episodes
        return observation, NAN if is_bad else reward, terminated, truncated, info


def test_spoilt_statistics_are_not_the_environments_fault() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: NanAtTheEnd(1)]), norm_obs=False)
    model = tiny_model("MlpPolicy", venv)
    with pytest.raises(BadTransitionError, match="environment 0 returned the reward nan"):
        model.learn(60)
    with pytest.raises(
        BadTransitionError, match=r"VecNormalize made the reward nan .*make a new VecNormalize, or load"
    ):
        model.learn(5)


def test_skipping_and_normalization_are_refused_together() -> None:
    """In the constructor, and in `learn` after `set_env`; VecNormalize's averages would stay bad for good."""
    sentence = r"on_bad_transition='skip' was given with VecNormalize, but .*: leave on_bad_transition='raise', or use"
    with pytest.raises(ValueError, match=sentence):
        tiny_model("MlpPolicy", VecNormalize(DummyVecEnv([VectorBox])), on_bad_transition="skip")
    model = tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip")
    model.set_env(VecNormalize(DummyVecEnv([VectorBox])))
    with pytest.raises(ValueError, match=sentence):
        model.learn(1)


def test_one_skipped_reward_hides_no_other_returns() -> None:
    model = tiny_model("MlpPolicy", DummyVecEnv([lambda: Monitor(NanAtTheEnd(2))]), on_bad_transition="skip")
    with pytest.warns(UserWarning, match="returned the reward nan"):
        model.learn(80)
    assert len(model.ep_info_buffer) == 3 and np.isfinite([each["r"] for each in model.ep_info_buffer]).all()


class NoReward(VectorBox):
    """Its third reward is None."""

    n_all = 0

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *rest = super().step(action)
        self.n_all += 1
        return observation, None if self.n_all == 3 else reward, *rest


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_missing_reward_of_a_worker_is_bad() -> None:
    """Rewards then arrive as objects."""
    venv = FiniteCheck(SubprocVecEnv([NoReward, VectorBox], start_method="fork"), "skip")
    try:
        with pytest.warns(UserWarning, match="returned the reward nan at agent step 6"):
            rewards = [each[1] for each in steps_of(venv, 4)[1:]]
        assert np.isfinite(np.array(rewards, np.float32)).all() and rewards[2][0] == 0 and venv.n_bad == 1
    finally:
        venv.close()


class Huge(VectorBox):
    """Returns numbers that are infinite only as float32."""

    def __init__(self, of: str) -> None:
        super().__init__()
        self.of = of

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *rest = super().step(action)
        if self.of == "reward":
            return observation, 1e39, *rest
        return np.array([0.0, 1e39]), reward, *rest


@pytest.mark.parametrize("of", ["reward", "observation"])
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning", "error:overflow")
def test_number_beyond_float32_is_bad(of: str) -> None:
    """It would be stored, and shown to the networks, as infinity; workers return float64."""
    venv = FiniteCheck(SubprocVecEnv([functools.partial(Huge, of)], start_method="fork"))
    try:
        with pytest.raises(BadTransitionError, match=rf"the {of} (with )?1e\+39 .* must be finite in float32"):
            steps_of(venv, 1)
    finally:
        venv.close()


class InDictionaries(FlawedBox):
    """The same observations in dictionaries, one entry of which is never flawed."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.observation_space = spaces.Dict({"a": self.observation_space, "b": self.observation_space})  # type: ignore[assignment]

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        return {"a": observation, "b": np.ones_like(observation)}, info

    def step(self, action: np.ndarray) -> Any:
        observation, *rest = super().step(action)
        return {"a": observation, "b": np.ones_like(observation)}, *rest


@settings(max_examples=60, deadline=None)
@given(st.lists(FLAWS, min_size=2, max_size=2), st.integers(0, 8), st.sampled_from([FlawedBox, InDictionaries]))
@pytest.mark.filterwarnings("ignore:environment")
def test_restored_check_goes_on_identically(flaws: list[Any], before: int, kind: Any) -> None:
    """Stand-ins, counts, the last good observations and what was warned of come back."""
    venv = FiniteCheck(DummyVecEnv([functools.partial(kind, each) for each in flaws]), "skip")
    steps_of(venv, before)
    restored = FiniteCheck(copy.deepcopy(venv.venv), "skip")
    restored.load_state_dict(copy.deepcopy(venv.state_dict()))
    told = []
    for each in (venv, restored):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            seen = [copy.deepcopy(each.step(np.full((2, 2), 0.1, np.float32))) for _ in range(5)]
        told.append([seen, each.state_dict(), [str(warning.message) for warning in caught]])
    assert differences(told[0], told[1]) == []


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda venv: pickle.loads(pickle.dumps(venv))])
def test_copied_check_goes_on_identically(copied: Any) -> None:
    """As with a copy of a model."""
    venv = FiniteCheck(DummyVecEnv([VectorBox]), "skip")
    venv.reset()
    other = copied(venv)
    assert other.envs is not venv.envs and other.get_attr("n_steps") == [0]
    action = np.ones((1, 2), np.float32)
    assert differences(list(venv.step(action)), list(other.step(action))) == []


def test_reset_after_restoring_knows_no_stand_ins() -> None:
    venv, restored = FiniteCheck(flawed({0: "reset"}), "skip"), FiniteCheck(flawed({}), "skip")
    with pytest.warns(UserWarning, match="first observation with nan"):
        assert not venv.reset().any()
    restored.load_state_dict(venv.state_dict())
    restored.reset()
    for each, marked in ((venv, True), (restored, False)):
        infos = each.step(np.zeros((1, 2), np.float32))[3]
        assert ("bad_transition" in infos[0]) == marked


def test_check_is_put_on_once_and_hides_nothing(tmp_path: Path) -> None:
    """Of archives, other environments, attributes, and SB3's evaluation, which compares environments."""
    venv = VecNormalize(DummyVecEnv([lambda: Monitor(VectorBox())]))
    model = tiny_model("MlpPolicy", venv)
    assert model.get_env() is venv and type(model.env) is FiniteCheck and model.env.venv is venv
    assert FiniteCheck(model.env).venv is venv and unwrap_vec_wrapper(model.env, VecNormalize) is venv
    assert model.env.unwrapped is venv.unwrapped and model.env.has_attr("episode_length")
    assert model.env.get_attr("episode_length") == [20] and model.env.envs is venv.venv.envs
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluation = VecNormalize(DummyVecEnv([lambda: Monitor(VectorBox())]), training=False)
        model.learn(12, callback=EvalCallback(evaluation, eval_freq=10, n_eval_episodes=1, verbose=0))
    assert evaluation.obs_rms.count > 1
    model.set_env(venv)
    model.learn(1)
    assert model.get_env() is venv and model.env.venv is venv
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=model.get_env())
    assert loaded.env.venv is venv and CuReSAC.load(tmp_path / "model").env is None
    loaded.learn(12)


@pytest.mark.parametrize(
    "arguments",
    [
        dict(srl=None, curiosity=None, n_steps=3),
        dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    ],
    ids=["n-step", "memory-efficient"],
)
def test_buffers_that_cannot_skip_are_refused_before_training(arguments: dict[str, Any]) -> None:
    """Rather than at the first bad transition."""
    model = tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip", **arguments)
    with pytest.raises(ValueError, match="ReplayBuffer cannot promise that faulty transitions are never sampled"):
        model.learn(5)
    assert model.num_timesteps == 0


@pytest.mark.parametrize(("scale", "warns"), [(255, True), (1, False)])
def test_black_images_are_warned_of_once(scale: int, warns: bool) -> None:
    """What SB3 makes of floats in [0, 1] in a space of uint8; no training ends for it, as there are dark rooms."""

    class Floats(PixelBox):
        def observe(self, first: bool = False) -> np.ndarray:
            return super().observe(first) / scale

    # VecFrameStack's first frames are of no camera.
    venv = FiniteCheck(VecFrameStack(DummyVecEnv([lambda: Floats(frame_stack=1)]), 3))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        steps_of(venv, 250)
    said = [str(warning.message) for warning in caught]
    assert len(said) == warns and all("no pixel of the images so far is brighter than 1 of" in each for each in said)
