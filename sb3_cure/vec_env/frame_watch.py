"""Notice rendering that fails without an error."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_cure.data.observations import image_spaces, images_of
from sb3_cure.envs.copy_observations import CopyObservations
from sb3_cure.envs.wrappers import action_repeat_of, channel_axis, positive_attribute

#: Least change of a coordinate in one agent step that counts as motion, metres or radians
FROZEN_MOTION = 0.01


class EnvFaultError(RuntimeError):
    """An environment failed. The worker's own traceback, if there is one, is a note.

    :param what: What happened
    :param restartable: Whether another worker may take its place
    """

    def __init__(self, what: str, restartable: bool = True) -> None:
        super().__init__(what)
        self.restartable = restartable


class FrameWatch(CopyObservations):
    """Copies observations, and raises an error for black frames, and for frozen frames while the physics moves.

    It looks at the newest frame of uint8 images, also of each image in a dictionary.

    :param env: The environment
    :param allow_black_frames: Whether frames of zeros are allowed
    :param frozen_steps: Environment steps (agent steps times ``action_repeat``) with equal pixels and moving physics
        that raise an error; None: never. In the DeepMind Control suite a cartpole that leaves the view of its camera
        shows equal pixels for up to 100 environment steps
    :param state: Visible part of an environment's state, [d]; by default the joint positions of dm_control. Frames of
        other environments are never taken to be frozen
    """

    def __init__(
        self,
        env: gym.Env,
        allow_black_frames: bool = False,
        frozen_steps: int | None = 200,
        state: Callable[[gym.Env], np.ndarray] | None = None,
    ) -> None:
        super().__init__(env)
        self._frame_stack = positive_attribute(env, "frame_stack")
        self._allow_black_frames = allow_black_frames
        physics = env.get_wrapper_attr("physics") if env.has_wrapper_attr("physics") else None
        if state is None and hasattr(getattr(physics, "data", None), "qpos"):
            state = _joint_positions
        self._state = None if frozen_steps is None or not image_spaces(env.observation_space) else state
        # In agent steps
        self._patience = (frozen_steps or 0) / action_repeat_of(env)
        # Latest frame of each image, and during how many moving steps it has stayed the same
        self._frames: dict[str, np.ndarray] = {}
        self._n_frozen: dict[str, int] = {}
        self._position: np.ndarray | None = None

    def observation(self, observation: Any) -> Any:
        """Copy and check an observation.

        :param observation: An array, or a dictionary of arrays
        :return: Copy
        :raises EnvFaultError: If an image is black or frozen
        """
        observation = super().observation(observation)
        images = images_of(observation, self.observation_space)
        frames = {key: self._newest(image) for key, image in images.items()}
        if not self._allow_black_frames and not all(frame.any() for frame in frames.values()):
            raise EnvFaultError(
                "returned a black frame, so that rendering has failed (pass allow_black_frames=True if it may be dark)"
            )
        if self._state is not None:
            self._check_frozen(frames, np.array(self._state(self.env), dtype=np.float64))
        return observation

    def _check_frozen(self, frames: dict[str, np.ndarray], position: np.ndarray) -> None:
        moves = self._position is not None and bool(np.abs(position - self._position).max(initial=0.0) > FROZEN_MOTION)
        self._position = position
        for key, frame in frames.items():
            if np.array_equal(frame, self._frames.get(key, np.zeros(0))):
                self._n_frozen[key] += moves
            else:
                self._frames[key], self._n_frozen[key] = frame.copy(), 0
            if self._n_frozen[key] >= self._patience:
                raise EnvFaultError(
                    f"returned the same pixels in {self._n_frozen[key]} steps while its physics moved, so that "
                    "rendering is stuck (raise frozen_steps if its camera sees so little)",
                    restartable=False,  # earlier transitions are wrong, too, and may be stored
                )

    def state_dict(self) -> dict[str, Any]:
        """Get what was seen, for exact checkpoints.

        :return: State; arguments are the new wrapper's
        """
        return {"frames": self._frames, "n_frozen": self._n_frozen, "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what was seen.

        :param state: Result of ``state_dict``
        """
        self._frames, self._n_frozen, self._position = state["frames"], state["n_frozen"], state["position"]

    def _newest(self, image: np.ndarray) -> np.ndarray:
        """Get the newest frame of a stack, channels first."""
        channels = np.moveaxis(image, channel_axis(image.shape), 0)
        n_channels, left_over = divmod(len(channels), self._frame_stack)
        return image if left_over else channels[-n_channels:]


def _joint_positions(env: gym.Env) -> np.ndarray:
    """Get the joint positions of dm_control, not wrapped to one turn: a jump from pi to -pi would look like motion."""
    return env.get_wrapper_attr("physics").data.qpos
