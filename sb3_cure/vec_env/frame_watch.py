"""Notice rendering that fails without a word."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_cure.envs.wrappers import action_repeat_of, told_by


class FrameFaultError(RuntimeError):
    """A frame that cannot be right."""


class FrameWatch(gym.Wrapper):
    """
    Looks at the newest frame of uint8 images, beside the physics, and changes nothing.

    While the pixels stay the same although something moves, ``info["frozen_frames"]`` counts the steps.

    :param env: The environment
    :param allow_black_frames: Whether a frame of zeros is all right
    :param frozen_steps: Environment steps (agent steps times ``action_repeat``) with the same pixels during which the
        physics moves in each agent step that make a fault; None: not looked at. In the DeepMind Control suite a
        cartpole that leaves the view of its camera shows the same pixels for up to 100 environment steps
    :param frozen_motion: What a motion is: the greatest change of a coordinate in one agent step, metres or radians
    :param state: What can be seen of an environment's state: by default the positions of dm_control's joints, and
        nothing for other environments, whose frames are then never taken to be stuck
    """

    def __init__(
        self,
        env: gym.Env,
        allow_black_frames: bool = False,
        frozen_steps: int | None = 200,
        frozen_motion: float = 0.01,
        state: Callable[[gym.Env], np.ndarray] | None = None,
    ) -> None:
        super().__init__(env)
        space = env.observation_space
        self._sees_images = isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3
        self._frame_stack = told_by(env, "frame_stack")
        self._allow_black_frames = allow_black_frames
        # Agent steps
        self._patience = None if frozen_steps is None else frozen_steps / action_repeat_of(env)
        self._motion = frozen_motion
        physics = env.get_wrapper_attr("physics") if env.has_wrapper_attr("physics") else None
        if state is None and hasattr(getattr(physics, "data", None), "qpos"):
            state = _joint_positions
        self._state = state
        self._frame: np.ndarray | None = None
        self._position = np.zeros(0)
        self._n_same = self._n_moving = 0

    def set_env_attr(self, name: str, value: Any) -> None:
        """
        :param name: Name of an attribute that SB3's ``set_attr`` would set here, where no other layer sees it
        :param value: Its value
        """
        setattr(self.env, name, value)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        # As SB3 does: not every environment takes options.
        observation, info = self.env.reset(seed=seed, **({"options": options} if options else {}))
        self._check(observation, is_step=False)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._check(observation, is_step=True)
        if self._n_moving:
            info = {**info, "frozen_frames": self._n_same}
        return observation, reward, terminated, truncated, info

    def _check(self, observation: Any, is_step: bool) -> None:
        space = self.env.observation_space
        if isinstance(space, spaces.Box) and np.shape(observation) != space.shape:
            shape = np.shape(observation)
            raise FrameFaultError(f"returned an observation of shape {shape}, but its space is of shape {space.shape}")
        if not self._sees_images:
            return
        # As in SB3, the smallest of the three dimensions tells where the channels are.
        axis = 2 if observation.shape[2] < min(observation.shape[:2]) else 0
        oldest, left_over = divmod(observation.shape[axis] * (self._frame_stack - 1), self._frame_stack)
        frame = observation if left_over else observation[(slice(None),) * axis + (slice(oldest, None),)]
        if not self._allow_black_frames and not frame.any():
            raise FrameFaultError(
                "returned a black frame, so that rendering has failed (pass allow_black_frames=True if it may be dark)"
            )
        if self._patience is None or self._state is None:
            return
        position = np.array(self._state(self.env), dtype=np.float64)
        if self._frame is None or not np.array_equal(frame, self._frame):
            self._frame, self._n_same, self._n_moving = frame.copy(), 0, 0
        else:
            self._n_same += is_step
            self._n_moving += bool(np.abs(position - self._position).max(initial=0.0) > self._motion)
        self._position = position
        if self._n_moving >= self._patience:
            raise FrameFaultError(
                f"returned the same pixels {self._n_same} times in a row while its physics moved, so that rendering is "
                "stuck (raise frozen_steps if its camera sees so little)"
            )


def _joint_positions(env: gym.Env) -> np.ndarray:
    """What of the state of dm_control can be seen, not wrapped to one turn: a jump from pi to -pi would be a motion."""
    return env.get_wrapper_attr("physics").data.qpos
