"""What would make the replay buffer store something else is refused or copied."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from dictionaries_for_tests import SensorBox
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_cure.vec_env import OverlappedVecEnv

CHANNELS_LAST = partial(PixelBox, channels_last=True, frame_stack=1)
SENSORS = partial(SensorBox, ("front", "joints"))


class Counters(gym.ObservationWrapper):
    """A vector of bytes."""

    def __init__(self) -> None:
        super().__init__(VectorBox())
        self.observation_space = spaces.Box(0, 255, (2,), np.uint8)

    def observation(self, observation: Any) -> Any:
        return (100 * np.abs(observation)).astype(np.uint8)


@pytest.mark.parametrize(
    ("venv", "sentence"),
    [
        (
            lambda: VecFrameStack(VecNormalize(DummyVecEnv([VectorBox])), 2),
            "inside of a wrapper that changes the shape",
        ),
        (lambda: VecNormalize(DummyVecEnv([CHANNELS_LAST]), norm_obs=False), r"VecNormalize\(VecTransposeImage\(venv"),
        (lambda: VecNormalize(DummyVecEnv([PixelBox])), "vector of .* norm_obs=False"),
        (lambda: VecNormalize(DummyVecEnv([Counters])), "normalizes integers.* norm_obs=False"),
        (lambda: VecNormalize(DummyVecEnv([SENSORS]), clip_obs=5), "vector of .* norm_obs=False"),
    ],
)
def test_normalizer_in_the_wrong_place_is_refused(venv: Any, sentence: str) -> None:
    made = venv()
    policy = "CnnPolicy" if len(made.observation_space.shape or ()) == 3 else "MultiInputPolicy"
    with pytest.raises(ValueError, match=sentence):
        tiny_model(policy, made)


def test_normalizer_in_the_right_place_trains() -> None:
    venv = VecNormalize(VecTransposeImage(DummyVecEnv([CHANNELS_LAST])), norm_obs=False)
    model = tiny_model("CnnPolicy", venv).learn(15)
    assert model._n_updates > 0 and model.replay_buffer.pos == 15
    tiny_model("MlpPolicy", VecNormalize(DummyVecEnv([Counters]), norm_obs=False)).learn(5)


class Camera(gym.Env):
    """Draws every frame into one array, as MuJoCo's renderers do: 100 at reset, then the number of the step."""

    observation_space = spaces.Box(0, 255, (3, 12, 12), np.uint8)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self) -> None:
        self.frame, self.t = np.zeros((3, 12, 12), np.uint8), 0

    def reset(self, **kwargs: Any) -> Any:
        self.t, self.frame[:] = 0, 100
        return self.frame, {}

    def step(self, action: Any) -> Any:
        self.t += 1
        self.frame[:] = self.t
        return self.frame, 0.0, False, self.t == 5, {}


@pytest.mark.parametrize("env", [Camera, lambda: DummyVecEnv([Camera, Camera])])
def test_last_observation_of_an_episode_is_stored(env: Any) -> None:
    """Not the first one of the next, which is in the same array."""
    model = tiny_model("CnnPolicy", env(), learning_starts=99).learn(24)
    n_steps = model.replay_buffer.pos
    batch = model.replay_buffer._get_samples(np.arange(n_steps))
    seen = [
        observations.flatten(1).amax(1).int().tolist() for observations in (batch.observations, batch.next_observations)
    ]
    assert seen[0] == [100 if t % 5 == 0 else t % 5 for t in range(n_steps)]
    assert seen[1] == [t % 5 + 1 for t in range(n_steps)]


def test_overlap_in_one_process_is_refused() -> None:
    with pytest.raises(ValueError, match="overlap=True needs environments in other processes"):
        OverlappedVecEnv(DummyVecEnv([VectorBox]))
