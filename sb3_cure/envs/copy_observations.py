"""Copy what environments return, and check it against their observation space."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_cure.envs.wrappers import action_repeat_of


class TransparentWrapper(gym.Wrapper[Any, Any, Any, Any]):
    """Passes attributes that are set on it to the environment: SB3's ``set_attr`` sets them on the outermost layer."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "env" or name.startswith("_"):
            super().__setattr__(name, value)
        else:
            setattr(self.env, name, value)

    @property
    def action_repeat(self) -> int:
        """Environment steps per agent step, also of Gymnasium's ``RepeatAction``; SB3's ``get_attr`` finds it here."""
        return action_repeat_of(self.env)


class CopyObservations(TransparentWrapper):
    """Copies observations, and checks their sizes and types against the space.

    Renderers such as MuJoCo's draw every frame into the same array, so that the last observation of an episode would
    become the first one of the next. SB3's ``DummyVecEnv`` casts floats to uint8, and broadcasts arrays of other sizes,
    without a word. Keys that are not in the space are left out.

    ``CuReSAC`` puts environments of this process into this wrapper, and ``FaultTolerantSubprocVecEnv`` its own. With
    SB3's ``SubprocVecEnv`` do it yourself: ``SubprocVecEnv([lambda: CopyObservations(MyEnv())])``.

    :param env: The environment
    """

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, with the arguments that it takes.

        :param kwargs: Arguments of the environment's ``reset``
        :return: Copy of the first observation, and the info
        """
        observation, info = self.env.reset(**kwargs)
        return self.observation(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        :param action: The action
        :return: What the environment returns, with a copy of the observation
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.observation(observation), reward, terminated, truncated, info

    def observation(self, observation: Any) -> Any:
        """Copy and check an observation.

        :param observation: An array or a number, or a dictionary of these
        :return: Copy with the keys of the space
        :raises ValueError: If it has another size than its space, or numbers that an integer space cannot hold
        """
        space = self.observation_space
        if isinstance(space, spaces.Dict):
            return {key: _checked_copy(observation[key], part, repr(key)) for key, part in space.spaces.items()}
        return _checked_copy(observation, space, "an observation")


def _checked_copy(value: Any, space: spaces.Space, name: str) -> np.ndarray:
    array = np.array(value)
    if space.shape is None or space.dtype is None:
        return array
    if array.size != np.prod(space.shape):
        raise ValueError(
            f"{name} was returned with the shape {array.shape}, but its space has the shape {space.shape}."
        )
    if array.dtype == space.dtype or not np.issubdtype(space.dtype, np.integer):
        return array
    with np.errstate(invalid="ignore"):
        cast = array.astype(space.dtype)
    if not np.array_equal(cast, array):
        example = array[cast != array][0]
        raise ValueError(
            f"{name} was returned as {array.dtype} with numbers such as {example:.4g}, but its space is {space.dtype}, "
            "which cannot hold them: return unscaled uint8 images, or declare a float space if it is no image."
        )
    return cast
