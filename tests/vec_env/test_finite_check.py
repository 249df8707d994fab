"""Rewards, observations and actions are finite, or an error; nothing of such a step is stored."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize

from sb3_cure import CuReSAC
from sb3_cure.vec_env import BadTransitionError, FiniteCheck, check_environments

NAN, INF = float("nan"), float("inf")


class Flawed(VectorBox):
    """Episodes of 5 steps; returns a value in some reward, observation or first observation ("reset").

    :param flaws: What is flawed, by step since the first reset
    :param value: The value
    :param as_dict: Whether observations are dictionaries with a text, which is not in their space
    """

    def __init__(self, flaws: dict[int, str] | None = None, value: Any = NAN, as_dict: bool = False):
        super().__init__(episode_length=5)
        self.flaws, self.value, self.total, self.as_dict = dict(flaws or {}), value, 0, as_dict
        if as_dict:
            self.observation_space = spaces.Dict(joints=self.observation_space)  # type: ignore[assignment]

    def returned(self, observation: np.ndarray, flaw: str) -> Any:
        if self.flaws.get(self.total) == flaw:
            observation = observation.astype(np.float64)
            observation[0] = self.value
        return {"joints": observation, "text": "go left"} if self.as_dict else observation

    def reset(self, **kwargs: Any) -> Any:
        observation, info = super().reset(**kwargs)
        return self.returned(observation, "reset"), info

    def step(self, action: np.ndarray) -> Any:
        observation, reward, *rest = super().step(action)
        self.total += 1
        reward = self.value if self.flaws.get(self.total) == "reward" else reward
        return self.returned(observation, "observation"), reward, *rest


FLAWS = {
    "reward": ({7: "reward"}, "environment 1 returned nan in the reward at agent step 14"),
    "observation": ({7: "observation"}, "environment 1 returned nan in the observation.* at agent step 14"),
    "terminal": ({5: "observation"}, "environment 1 returned nan in the terminal observation.* at agent step 10"),
    "reset": ({5: "reset"}, "environment 1 returned nan in the observation.* at agent step 10"),
    "first reset": ({0: "reset"}, "environment 1 returned nan in the first observation.* at agent step 0"),
}


@pytest.mark.parametrize("as_dict", [False, True])
@pytest.mark.parametrize("flaw", FLAWS)
def test_nothing_of_a_bad_step_is_stored(flaw: str, as_dict: bool) -> None:
    """Of no environment; the next `learn` begins with a reset."""
    flaws, sentence = FLAWS[flaw]
    venv = DummyVecEnv([functools.partial(Flawed, each, as_dict=as_dict) for each in ({}, flaws)])
    model = tiny_model("MultiInputPolicy" if as_dict else "MlpPolicy", venv, learning_starts=100)
    with pytest.raises(BadTransitionError, match=sentence):
        model.learn(40)
    assert model.replay_buffer.pos == max(max(flaws) - 1, 0)
    venv.envs[1].unwrapped.flaws.clear()
    model.learn(1, reset_num_timesteps=False)
    # Otherwise the next transition would span the steps between.
    assert venv.envs[1].unwrapped.n_steps == 1


@pytest.mark.parametrize("flaw", ["reward", "observation"])
@pytest.mark.parametrize("value", [1e39, -INF, None])
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning", "error:overflow")
def test_numbers_of_workers_are_checked_in_float32(flaw: str, value: Any) -> None:
    """They would be stored, and shown to the networks, as infinity; a missing reward arrives as an object."""
    value = NAN if value is None and flaw == "observation" else value
    venv = FiniteCheck(SubprocVecEnv([functools.partial(Flawed, {2: flaw}, value)], start_method="fork"))
    try:
        venv.reset()
        venv.step(np.zeros((1, 2), np.float32))
        with pytest.raises(BadTransitionError, match=rf"environment 0 returned .* in the {flaw} at agent step 2"):
            venv.step(np.zeros((1, 2), np.float32))
    finally:
        venv.close()


def test_no_environment_gets_an_action_that_is_not_finite() -> None:
    noise = NormalActionNoise(np.zeros(2), np.array([0.0, NAN]))
    env = VectorBox()
    model = tiny_model("MlpPolicy", env, action_noise=noise)
    with pytest.raises(BadTransitionError, match=r"chose the action \[.* nan\] for environment 0 at agent step 0"):
        model.learn(5)
    assert env.n_steps == 0 and model.replay_buffer.pos == 0


@pytest.mark.parametrize(
    ("step", "flaw", "kind"),
    [
        (0, "reset", "first observation"),
        (3, "reward", "reward"),
        (3, "observation", "observation"),
        (5, "observation", "terminal observation"),
    ],
)
@pytest.mark.parametrize("as_dict", [False, True])
def test_values_that_normalization_clips_are_found(step: int, flaw: str, kind: str, as_dict: bool) -> None:
    """The replay buffer would store the original ones, or the bound of the clipped terminal observation."""
    venv = VecNormalize(DummyVecEnv([functools.partial(Flawed, {step: flaw}, INF, as_dict)]))
    model = tiny_model("MultiInputPolicy" if as_dict else "MlpPolicy", venv)
    with pytest.raises(BadTransitionError, match=f"environment 0 returned inf in the {kind}"):
        model.learn(10)
    assert np.isfinite(venv.ret_rms.mean) and np.isfinite(venv.ret_rms.var)


def test_spoilt_statistics_are_not_the_environments_fault() -> None:
    venv = VecNormalize(DummyVecEnv([VectorBox]))
    venv.obs_rms.mean[:] = NAN
    with pytest.raises(BadTransitionError, match=r"VecNormalize made nan in the first obs.* load or make a new"):
        FiniteCheck(venv).reset()


class Asking(VecEnvWrapper):
    """Asks the environments for something at each reset and step, as SB3's ``VecVideoRecorder`` asks for pictures."""

    def reset(self) -> Any:
        self.found = [self.venv.env_method("get_wrapper_attr", "episode_length")]
        return self.venv.reset()

    def step_wait(self) -> Any:
        self.found.append(self.venv.env_method("get_wrapper_attr", "episode_length"))
        return self.venv.step_wait()


def test_wrappers_around_normalization_reach_the_environments() -> None:
    venv = Asking(VecNormalize(DummyVecEnv([VectorBox])))
    tiny_model("MlpPolicy", venv).learn(5)
    assert venv.found == [[VectorBox().episode_length]] * 6


class OneBuffer(DummyVecEnv):
    """Returns its own array each time, as some vectorised environments do."""

    def _obs_from_buf(self) -> Any:
        return self.buf_obs[None]


def test_observations_are_copied() -> None:
    venv = check_environments(OneBuffer([VectorBox]))
    seen, kept = [], []
    for t in range(3):
        observations: Any = venv.step(np.ones((1, 2), np.float32))[0] if t else venv.reset()
        seen.append(observations)
        kept.append(observations.copy())
    np.testing.assert_array_equal(seen, kept)
    assert len(np.unique(seen, axis=0)) == 3


def test_check_is_put_on_once_and_hides_nothing(tmp_path: Path) -> None:
    """Of archives, other environments, attributes, and SB3's evaluation, which compares environments."""
    venv = VecNormalize(DummyVecEnv([lambda: Monitor(VectorBox())]))
    model = tiny_model("MlpPolicy", venv)
    assert model.get_env() is venv and type(model.env) is FiniteCheck and model.env.venv is venv
    assert check_environments(model.env) is model.env
    envs = list(venv.unwrapped.envs)
    evaluation = VecNormalize(DummyVecEnv([lambda: Monitor(VectorBox())]), training=False)
    model.learn(12, callback=EvalCallback(evaluation, eval_freq=10, n_eval_episodes=1, verbose=0))
    assert evaluation.obs_rms.count > 1
    model.set_env(venv)
    model.learn(1)
    assert model.get_env() is venv and venv.unwrapped.envs == envs, "not put into another CopyObservations"
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=model.get_env())
    assert loaded.env.venv is venv
    loaded.learn(12)
