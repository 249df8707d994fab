"""Wrappers that turn an environment which renders itself or returns images into one seen through pixels."""

import copy
from collections import deque
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import RepeatAction
from PIL import Image

from sb3_cure.data.observations import by_key, image_spaces
from sb3_cure.envs.rendering import (
    choose_backend,
    free_mujoco_contexts,
    free_when_dropped,
    mujoco_renderer_of,
    render_in_own_context,
)
from sb3_cure.envs.spaces_check import UNBOUNDED, check_observation_space

#: Rows and columns of a fast frame that are averaged to one of the image. This smooths edges as multisampling does,
#: which takes software renderers several times as long
OVERSAMPLING = 2


def at_least_one(name: str, value: Any) -> int:
    """Check that a number is a positive integer.

    :param name: Name of the number, for the message
    :param value: The number
    :return: A plain integer
    :raises ValueError: If it is not an integer of at least 1
    """
    if not _is_positive_integer(value):
        raise ValueError(f"{name} must be an integer of at least 1, not {value!r}.")
    return int(value)


def _is_positive_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 1)


def to_image(frame: np.ndarray, image_size: int, grayscale: bool = False) -> np.ndarray:
    """Make an observation from a rendered frame.

    :param frame: uint8 [height, width, 3]
    :param image_size: Height and width of the observation
    :param grayscale: One channel of luminance instead of three of RGB
    :return: Copy, uint8 [1 or 3, image_size, image_size]
    """
    if grayscale:
        frame = np.asarray(Image.fromarray(frame).convert("L"))[..., None]
    return resize_image(np.array(np.moveaxis(frame, -1, 0), order="C"), image_size, image_size)


def resize_image(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Average areas of an image, channel by channel.

    :param image: uint8 [channels, old height, old width]
    :param height: New height
    :param width: New width
    :return: uint8 [channels, height, width]
    """
    if image.shape[1:] == (height, width):
        return image
    channels = (Image.fromarray(each).resize((width, height), Image.Resampling.BOX) for each in image)
    return np.stack([np.asarray(each) for each in channels])


def draw_fast(env: gym.Env, image_size: int) -> None:
    """Let an environment draw frames of ``OVERSAMPLING`` times the observed size, without shadows and reflections.

    :param env: A MuJoCo environment of Gymnasium or Gymnasium-Robotics
    :param image_size: Height and width of the observation in pixels
    :raises ValueError: If it is another environment
    """
    renderer = mujoco_renderer_of(env)
    if renderer is None:
        raise ValueError(f"renderer='fast' is for Gymnasium's MuJoCo environments, which {env} is not: use 'env'.")
    choose_backend()
    free_mujoco_contexts(renderer)  # What follows takes effect when the next frame makes new ones.
    visual, size = renderer.model.vis, OVERSAMPLING * image_size
    visual.quality.shadowsize = visual.quality.offsamples = 0
    renderer.model.mat_reflectance[:] = 0
    renderer.width = renderer.height = size
    visual.global_.offwidth = max(visual.global_.offwidth, size)
    visual.global_.offheight = max(visual.global_.offheight, size)


class NormalizeActions(gym.ActionWrapper[Any, np.ndarray, np.ndarray], RecordConstructorArgs):
    """Takes float32 actions in [-1, 1], clips them to that range and scales them to the bounds of the environment.

    Actions without bounds are clipped and not scaled; with one bound, [-1, 1] is scaled to the range within 2 of it.
    Unlike :class:`gymnasium.wrappers.RescaleAction`, this accepts missing bounds, always takes float32, and clips. The
    environment gets actions of its space: in its dtype and within its bounds.

    :param env: An environment whose actions are floats in a ``Box``
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        bounds = env.action_space
        if not isinstance(bounds, spaces.Box) or not np.issubdtype(bounds.dtype, np.floating):
            raise ValueError(
                f"The actions {bounds} cannot be scaled: expected floats in a Box; leave out NormalizeActions."
            )
        low, high = bounds.low.astype(np.float64), bounds.high.astype(np.float64)
        has_low, has_high = low > -UNBOUNDED, high < UNBOUNDED
        low = np.where(has_low, low, np.where(has_high, high - 2.0, -1.0))
        high = np.where(has_high, high, low + 2.0)
        # Scaled by centre and half width: bounds of -1 and 1 then leave each action bit-equal.
        self._center, self._half_width = (high + low) / 2, (high - low) / 2
        self.action_space = spaces.Box(-1.0, 1.0, bounds.shape, np.float32)

    def action(self, action: np.ndarray) -> np.ndarray:
        bounds: Any = self.env.action_space
        scaled = self._center + self._half_width * np.clip(action, -1.0, 1.0)
        # The sum, or another dtype, may be beyond a bound by a rounding error.
        return np.clip(scaled.astype(bounds.dtype), bounds.low, bounds.high)


class ActionRepeat(RepeatAction):
    """Repeats each action, sums the rewards, and stops early where the episode ends.

    Unlike Gymnasium's wrapper, it has an attribute ``action_repeat``, and videos have fewer frames per second.

    :param env: The environment
    :param num_repeats: Environment steps per agent step
    :raises ValueError: If ``num_repeats`` is not an integer of at least 1
    """

    def __init__(self, env: gym.Env, num_repeats: int) -> None:
        num_repeats = at_least_one("action_repeat", num_repeats)
        super().__init__(env, num_repeats)
        if "render_fps" in env.metadata:
            self.metadata = {**env.metadata, "render_fps": env.metadata["render_fps"] / num_repeats}

    @property
    def action_repeat(self) -> int:
        """Environment steps per agent step; the environment within may repeat actions, too."""
        return action_repeat_of(self)


def positive_attribute(env: gym.Env, name: str) -> int:
    """Look for an attribute of an environment.

    :param env: Any environment
    :param name: Name of an attribute that is an integer of at least 1
    :return: Its value, or 1 if the environment has none or means something else by that name
    """
    value = env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else 1
    return int(value) if _is_positive_integer(value) else 1


def action_repeat_of(env: gym.Env) -> int:
    """Look for the action repeat of an environment.

    :param env: Any environment
    :return: Environment steps per agent step: those of Gymnasium's ``RepeatAction``, ours included, times the attribute
        ``action_repeat`` of the rest, else 1
    """
    if isinstance(env, RepeatAction):
        return int(env.num_repeats) * action_repeat_of(env.env)
    if isinstance(env, gym.Wrapper) and not hasattr(env, "action_repeat"):
        return action_repeat_of(env.env)
    return positive_attribute(env, "action_repeat")


class PixelObservation(gym.ObservationWrapper[np.ndarray, Any, Any], RecordConstructorArgs):
    """Replaces observations by rendered frames: uint8 of shape (channels, image_size, image_size), one render per step.

    :param env: An environment made with ``render_mode="rgb_array"``
    :param image_size: Height and width of the observation in pixels; frames of another size are area-averaged to it
    :param grayscale: One channel of luminance instead of three of RGB
    :param renderer: ``"env"`` or ``"fast"``, see :func:`make_pixel_env`
    :raises ValueError: If ``image_size`` is not an integer of at least 1, if ``env`` cannot be drawn fast, or, when
        first reset, if it does not render uint8 RGB frames
    """

    def __init__(self, env: gym.Env, image_size: int = 84, grayscale: bool = False, renderer: str = "env") -> None:
        RecordConstructorArgs.__init__(self, image_size=image_size, grayscale=grayscale, renderer=renderer)
        super().__init__(env)
        self.image_size = at_least_one("image_size", image_size)
        if renderer not in ("env", "fast"):
            raise ValueError(f"renderer must be 'env' or 'fast', not {renderer!r}.")
        if renderer == "fast":
            draw_fast(env, self.image_size)
        free_when_dropped(self)
        self.grayscale = grayscale
        shape = (1 if grayscale else 3, self.image_size, self.image_size)
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)

    def observation(self, observation: Any) -> np.ndarray:
        """Render a frame.

        :param observation: The environment's own, unused
        :return: uint8 [channels, image_size, image_size]
        :raises ValueError: If the environment renders something else than uint8 RGB frames
        """
        frame: Any = self.render()  # some of PyBullet's have an alpha channel, which is left out
        is_image = isinstance(frame, np.ndarray) and frame.dtype == np.uint8 and frame.ndim == 3
        if not (is_image and frame.shape[-1] in (3, 4)):
            given = f"{frame.dtype} {frame.shape}" if isinstance(frame, np.ndarray) else f"a {type(frame).__name__}"
            raise ValueError(
                f"Frames must be uint8 [height, width, 3], but {self.env} with render_mode={self.env.render_mode!r} "
                f"rendered {given}: make it with render_mode='rgb_array' (env_kwargs in YAML), and let its render() "
                "return such frames."
            )
        return to_image(frame[..., :3], self.image_size, self.grayscale)

    def render(self) -> Any:
        """Render a frame.

        :return: A frame, uint8 [height, width, 3]
        """
        return render_in_own_context(self.env)

    def close(self) -> None:
        """Close the environment, and free what MuJoCo draws with."""
        if (renderer := mujoco_renderer_of(self.env)) is not None:
            free_mujoco_contexts(renderer)
        super().close()


class ResizeImages(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Averages areas of images, so that networks and replay buffer need less memory.

    Images are uint8, with the channels first or last, which stays as it is. In dictionaries, only images are resized.

    :param env: An environment whose observations are an image, or a dictionary with images
    :param image_size: New height and width in pixels, one number or two
    :param keys: Keys of the images to resize; None: all
    :raises ValueError: If there are no such images, or a size is not an integer of at least 1
    """

    def __init__(self, env: gym.Env, image_size: int | tuple[int, int] = 84, keys: Sequence[str] | None = None) -> None:
        RecordConstructorArgs.__init__(self, image_size=image_size, keys=keys)
        super().__init__(env)
        sizes = image_size if isinstance(image_size, tuple | list) else (image_size, image_size)  # a list, from YAML
        self.image_size = image_size
        self._height, self._width = (at_least_one("image_size", size) for size in sizes)
        space = env.observation_space
        images = image_spaces(space)
        self._keys = list(images if keys is None else keys)
        if not self._keys or not set(self._keys) <= set(images):
            check_observation_space(space)  # says more of images that are nested or floats
            missing = "" if keys is None else f" under {sorted(set(keys) - set(images))}"
            raise ValueError(f"ResizeImages found no images, uint8 with three dimensions,{missing} in {space}.")
        resized = {
            key: spaces.Box(0, 255, self._resize(np.zeros(images[key].shape, np.uint8)).shape, np.uint8)
            for key in self._keys
        }
        if isinstance(space, spaces.Dict):
            self.observation_space = spaces.Dict(list({**space.spaces, **resized}.items()))
        else:
            self.observation_space = resized[""]

    def observation(self, observation: Any) -> Any:
        """Resize an observation.

        :param observation: An image, or a dictionary
        :return: The same with smaller images
        """
        if not isinstance(observation, dict):
            return self._resize(observation)
        return {**observation, **{key: self._resize(observation[key]) for key in self._keys}}

    def _resize(self, image: np.ndarray) -> np.ndarray:
        if channel_axis(image.shape) == 0:
            return resize_image(image, self._height, self._width)
        return np.moveaxis(resize_image(np.moveaxis(image, 2, 0), self._height, self._width), 0, 2)


def channel_axis(shape: tuple[int, ...]) -> int:
    """Find the axis of the channels; as in SB3, they are the smallest dimension.

    :param shape: Shape of an observation
    :return: 0 or, of images with the channels last, 2
    """
    return 2 if len(shape) == 3 and shape[2] < min(shape[:2]) else 0


class StackFrames(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Joins the last observations along their first axis, oldest first.

    Images with the channels last (as in SB3, the smallest dimension) are joined along the last axis. In dictionaries,
    only images are stacked; the rest stays as it is.

    :param env: An environment whose observations are arrays, such as images, or dictionaries with images
    :param frame_stack: Number of observations in a stack
    :param padding: What fills the stack before an episode's first observation: ``"first"``, that observation, or
        ``"zeros"``, as in SB3's ``VecFrameStack`` (which stacks the vectors of dictionaries, too)
    :raises ValueError: If ``frame_stack`` is not an integer of at least 1, or gives images more channels than rows, or
        for another ``padding``
    """

    def __init__(self, env: gym.Env, frame_stack: int = 3, padding: str = "first") -> None:
        RecordConstructorArgs.__init__(self, frame_stack=frame_stack, padding=padding)
        super().__init__(env)
        if padding not in ("first", "zeros"):
            raise ValueError(f"padding must be 'first' or 'zeros', not {padding!r}.")
        self.padding = padding
        self.frame_stack = at_least_one("frame_stack", frame_stack)
        space = env.observation_space
        parts = by_key(space)
        is_dict = isinstance(space, spaces.Dict)
        boxes = {
            k: box for k, box in parts.items() if isinstance(box, spaces.Box) and (len(box.shape) == 3 or not is_dict)
        }
        if not boxes:
            raise ValueError(
                f"Observations of {space} cannot be stacked: expected a Box; wrap in PixelObservation first."
            )
        self._axes = {key: channel_axis(box.shape) for key, box in boxes.items()}
        stacked = {**parts, **{key: self._stacked_space(box, self._axes[key]) for key, box in boxes.items()}}
        self.observation_space = spaces.Dict(list(stacked.items())) if is_dict else stacked[""]
        self._frames: dict[str, deque[np.ndarray]] = {key: deque(maxlen=self.frame_stack) for key in boxes}

    def _stacked_space(self, box: spaces.Box, axis: int) -> spaces.Box:
        low, high = (np.concatenate([bound] * self.frame_stack, axis) for bound in (box.low, box.high))
        if low.ndim == 3 and np.argmin(low.shape) != axis:  # so SB3 finds the channels
            raise ValueError(
                f"frame_stack={self.frame_stack} images of shape {box.shape} have {low.shape[axis]} channels in all, "
                "but SB3 takes the first of the smallest dimensions for the channels: choose larger images "
                "(image_size) or fewer frames."
            )
        return spaces.Box(low, high, dtype=box.dtype.type)

    def _push(self, observation: Any, first: bool) -> Any:
        parts = observation if isinstance(observation, dict) else {"": observation}
        # Everything is copied, as an environment may write the next observation into the same arrays.
        for key, frames in self._frames.items():
            frame = np.array(parts[key])
            if first:
                frames.extend([frame if self.padding == "first" else np.zeros_like(frame)] * self.frame_stack)
            frames.append(frame)
        stacked = {key: np.concatenate(frames, self._axes[key]) for key, frames in self._frames.items()}
        if not isinstance(observation, dict):
            return stacked[""]
        return {key: stacked[key] if key in stacked else copy.copy(part) for key, part in parts.items()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._push(observation, first=True), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._push(observation, first=False), reward, terminated, truncated, info


def make_pixel_env(
    env: str | gym.Env,
    *,
    image_size: int = 84,
    frame_stack: int = 3,
    action_repeat: int = 1,
    grayscale: bool = False,
    renderer: str = "env",
    source: str = "render",
) -> gym.Env:
    """Turn a Gymnasium environment into one that an agent sees through small, stacked images.

    With ``source="render"`` observations are uint8 of shape (channels x frame_stack, image_size, image_size), oldest
    frame first, of what the environment renders, once per agent step; its own observations are dropped. With
    ``source="observation"`` its own images, alone or in a dictionary, are resized and stacked. The first frame is
    repeated at reset. Float actions in a ``Box`` become float32 in [-1, 1].

    :param env: Gymnasium id, or an environment made with ``render_mode="rgb_array"``
    :param image_size: Height and width of the images in pixels
    :param frame_stack: Number of frames in an observation
    :param action_repeat: Environment steps per agent step; their rewards are summed
    :param grayscale: One channel of luminance per rendered frame instead of three of RGB
    :param renderer: ``"env"`` gives the pixels of ``env``; ``"fast"``, for MuJoCo environments of Gymnasium, leaves out
        shadows and reflections and draws at twice the ``image_size``, which is many times faster without a GPU and
        shows other pixels: another environment (videos of it have these frames, too)
    :param source: ``"render"`` or ``"observation"``
    :return: The environment; ``get_wrapper_attr`` finds its ``image_size``, ``frame_stack`` and ``action_repeat``
    :raises ValueError: If an argument is out of range, ``env`` cannot be drawn fast or, when first reset, does not
        render RGB frames
    """
    if source not in ("render", "observation") or (source == "observation" and (grayscale or renderer != "env")):
        raise ValueError("source must be 'render', or 'observation', which takes neither grayscale nor renderer.")
    if isinstance(env, str):
        choose_backend()
        env = gym.make(env, render_mode="rgb_array")
    env = ActionRepeat(env, action_repeat)
    if isinstance(env.action_space, spaces.Box) and np.issubdtype(env.action_space.dtype, np.floating):
        env = NormalizeActions(env)
    if source == "observation":
        return StackFrames(ResizeImages(env, image_size), frame_stack)
    return StackFrames(PixelObservation(env, image_size, grayscale, renderer), frame_stack)
