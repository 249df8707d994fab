"""Environments of several sensors: a dot seen by two cameras, and felt."""

from typing import Any

import gymnasium as gym
import numpy as np
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces

from sb3_cure import CuReSAC


class SensorBox(PixelBox):
    """``PixelBox`` in a dictionary: ``front`` is its image, ``wrist`` a corner of it mirrored, ``joints`` the position.

    :param keys: Which of these, and ``mode``: a number from 0 to 2
    :param kwargs: Arguments of ``PixelBox``
    """

    def __init__(self, keys: tuple[str, ...] = ("front", "joints", "wrist"), **kwargs: Any):
        super().__init__(**kwargs)
        image = self.observation_space
        all_spaces = {
            "front": image,
            "wrist": spaces.Box(0, 255, (image.shape[0], 28, 28), np.uint8),
            "joints": spaces.Box(-1, 1, (2,), np.float32),
            "mode": spaces.Discrete(3),
        }
        self.keys = keys
        self.observation_space = spaces.Dict({key: all_spaces[key] for key in keys})  # type: ignore[assignment]

    def observe(self, first: bool = False) -> Any:
        image = super().observe(first)
        joints = self.position.astype(np.float32)
        seen = {"front": image, "wrist": image[:, :28, 27::-1], "joints": joints, "mode": self.n_steps % 3}
        return {key: seen[key] for key in self.keys}


class Goal(gym.Env):
    """A dot that is to come near to a goal, observed as in Gymnasium-Robotics, float64 included."""

    def __init__(self) -> None:
        box = spaces.Box(-1, 1, (2,), np.float64)
        self.observation_space = spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def observe(self) -> dict[str, np.ndarray]:
        return {"observation": self.place.copy(), "achieved_goal": self.place.copy(), "desired_goal": self.goal}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.place, self.n = np.zeros(2), 0
        self.goal = self.np_random.uniform(-1, 1, 2)
        return self.observe(), {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return -(np.linalg.norm(achieved - desired, axis=-1) > 0.2).astype(np.float32)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.place = np.clip(self.place + 0.3 * action, -1, 1)
        self.n += 1
        reward = float(self.compute_reward(self.place, self.goal, None))
        return self.observe(), reward, False, self.n >= 10, {}

    def state_dict(self) -> dict[str, Any]:
        return {"place": self.place, "goal": self.goal, "n": self.n}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)


def sensor_model(env: Any = None, algorithm: type[CuReSAC] = CuReSAC, **kwargs: Any) -> CuReSAC:
    """Make a tiny model on ``SensorBox``.

    :param env: Another environment
    :param algorithm: Class of the model
    :param kwargs: As of ``tiny_model``
    """
    extractor = {"features_extractor_kwargs": {"features_dim": 8, "n_filters": 4, "n_layers": 2}}
    kwargs["policy_kwargs"] = {**extractor, **kwargs.get("policy_kwargs", {})}
    return tiny_model("MultiInputPolicy", SensorBox() if env is None else env, algorithm, **kwargs)
