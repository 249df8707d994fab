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
    Looks at the newest frame of uint8 images, also of each in a dictionary, beside the physics; and changes nothing.

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
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        # Of observations that are no dictionary, under the key ""
        self._boxes = {key: part for key, part in parts.items() if isinstance(part, spaces.Box)}
        self._images = [key for key, box in self._boxes.items() if box.dtype == np.uint8 and len(box.shape) == 3]
        self._frame_stack = told_by(env, "frame_stack")
        self._allow_black_frames = allow_black_frames
        # Agent steps
        self._patience = None if frozen_steps is None else frozen_steps / action_repeat_of(env)
        self._motion = frozen_motion
        physics = env.get_wrapper_attr("physics") if env.has_wrapper_attr("physics") else None
        if state is None and hasattr(getattr(physics, "data", None), "qpos"):
            state = _joint_positions
        self._state = state
        # By the key of the image: its latest frame, and for how many steps it has stayed the same, in all and in motion
        self._frame: dict[str, np.ndarray] = {}
        self._n_same, self._n_moving = dict.fromkeys(self._images, 0), dict.fromkeys(self._images, 0)
        self._position = np.zeros(0)

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
        frozen = [self._n_same[key] for key in self._images if self._n_moving[key]]
        if frozen:
            info = {**info, "frozen_frames": max(frozen)}
        return observation, reward, terminated, truncated, info

    def _check(self, observation: Any, is_step: bool) -> None:
        parts = observation if isinstance(observation, dict) else {"": observation}
        for key, box in self._boxes.items():
            if np.shape(parts[key]) != box.shape:
                what, shape = f"{key!r}" if key else "an observation", np.shape(parts[key])
                raise FrameFaultError(f"returned {what} of shape {shape}, but its space is of shape {box.shape}")
        frames = {key: self._newest(parts[key]) for key in self._images}
        if not self._allow_black_frames and not all(frame.any() for frame in frames.values()):
            raise FrameFaultError(
                "returned a black frame, so that rendering has failed (pass allow_black_frames=True if it may be dark)"
            )
        if not frames or self._patience is None or self._state is None:
            return
        position = np.array(self._state(self.env), dtype=np.float64)
        moves = len(self._frame) > 0 and bool(np.abs(position - self._position).max(initial=0.0) > self._motion)
        self._position = position
        for key, frame in frames.items():
            if key not in self._frame or not np.array_equal(frame, self._frame[key]):
                self._frame[key], self._n_same[key], self._n_moving[key] = frame.copy(), 0, 0
            else:
                self._n_same[key] += is_step
                self._n_moving[key] += moves
            if self._n_moving[key] >= self._patience:
                raise FrameFaultError(
                    f"returned the same pixels {self._n_same[key]} times in a row while its physics moved, so that "
                    "rendering is stuck (raise frozen_steps if its camera sees so little)"
                )

    def _newest(self, image: np.ndarray) -> np.ndarray:
        # As in SB3, the smallest of the three dimensions tells where the channels are.
        axis = 2 if image.shape[2] < min(image.shape[:2]) else 0
        oldest, left_over = divmod(image.shape[axis] * (self._frame_stack - 1), self._frame_stack)
        return image if left_over else image[(slice(None),) * axis + (slice(oldest, None),)]


def _joint_positions(env: gym.Env) -> np.ndarray:
    """What of the state of dm_control can be seen, not wrapped to one turn: a jump from pi to -pi would be a motion."""
    return env.get_wrapper_attr("physics").data.qpos
