"""What the encoder sees of an observation: a random view to learn from, a centred one to act and to measure."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.data.observations import image_spaces


class Augmentation:
    """No augmentation: the encoder sees observations as they are stored.

    Calling it draws a random view. Views have the dtype and the scale of observations: images uint8 in 0-255.

    :param observation_space: Space of the stored observations
    """

    def __init__(self, observation_space: spaces.Space):
        self.observation_space = observation_space
        #: Space of the views
        self.view_space = observation_space

    def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """
        :param observations: Observations as stored, [B, *shape]
        :param generator: Source of the randomness (default: torch's global one)
        :return: Random views, [B, *view shape]
        """
        return observations

    def center(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: Observations as stored, [B, *shape]
        :return: The view without randomness, [B, *view shape]
        """
        return observations

    def of(self, key: str) -> "Augmentation":
        """
        :param key: Of an image in a dictionary
        :return: What is done to that image
        """
        return Augmentation(self.observation_space[key])  # type: ignore[index]


class RandomShift(Augmentation):
    """Shifts images by up to ``pad`` pixels and repeats the border (DrQ, Yarats et al. 2021, section 4.1).

    :param observation_space: Images, channels first
    :param pad: Largest shift, pixels
    """

    def __init__(self, observation_space: spaces.Space, pad: int = 4):
        super().__init__(_images(observation_space, "shift"))
        self.pad = pad

    def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """All channels of an observation, hence all its frames, are shifted alike.

        :param observations: [B, C, H, W]
        :param generator: Source of the shifts (default: torch's global one)
        :return: [B, C, H, W]
        """
        batch, _, height, width = observations.shape
        down = th.randint(-self.pad, self.pad + 1, (batch, 1), generator=generator)
        right = th.randint(-self.pad, self.pad + 1, (batch, 1), generator=generator)
        # Rows and columns outside of the image are those of its border.
        rows = (th.arange(height) + down).clamp(0, height - 1)
        columns = (th.arange(width) + right).clamp(0, width - 1)
        return _windows(observations, rows, columns)


class RandomCrop(Augmentation):
    """Cuts a random square out of each image, every offset equally likely (CURL, Laskin et al. 2020, section 4.2).

    :param observation_space: Images, channels first, larger than the crops
    :param size: Side of the crops, pixels
    :raises ValueError: if the images are not larger
    """

    def __init__(self, observation_space: spaces.Space, size: int = 84):
        super().__init__(_images(observation_space, "crop"))
        channels, height, width = observation_space.shape  # type: ignore[misc]
        if not 0 < size < min(height, width):
            raise ValueError(
                f"augmentation='crop' cuts {size} x {size} pixels out of images of {height} x {width}: render larger "
                "(CURL: image_size=100), set augmentation_kwargs=dict(size=...), or use augmentation='shift'."
            )
        self.size = size
        self.view_space = spaces.Box(0, 255, (channels, size, size), np.uint8)

    def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """All channels of an observation, hence all its frames, are cut alike.

        :param observations: [B, C, H, W]
        :param generator: Source of the offsets (default: torch's global one)
        :return: [B, C, size, size]
        """
        batch, _, height, width = observations.shape
        # Drawn on the CPU: a CUDA draw would not repeat a CPU run, and two short vectors cost nothing to send.
        top = th.randint(height - self.size + 1, (batch, 1), generator=generator)
        left = th.randint(width - self.size + 1, (batch, 1), generator=generator)
        return _windows(observations, top + th.arange(self.size), left + th.arange(self.size))

    def center(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: [B, C, H, W]
        :return: The central squares, [B, C, size, size]
        """
        top, left = (observations.shape[2] - self.size) // 2, (observations.shape[3] - self.size) // 2
        return observations[:, :, top : top + self.size, left : left + self.size]


class DictAugmentation(Augmentation):
    """Each image of a dictionary is augmented by itself; vectors stay as they are.

    :param observation_space: Dictionary of images and vectors
    :param images: Augmentation of each image, by key
    """

    def __init__(self, observation_space: spaces.Dict, images: dict[str, Augmentation]):
        super().__init__(observation_space)
        self.images = images
        views = {key: images[key].view_space if key in images else observation_space[key] for key in observation_space}
        self.view_space = spaces.Dict(list(views.items()))

    def __call__(self, observations: Any, generator: th.Generator | None = None) -> Any:
        """
        :param observations: Observations as stored, by key
        :param generator: Source of the randomness (default: torch's global one)
        :return: Random views, by key
        """
        return observations | {key: image(observations[key], generator) for key, image in self.images.items()}

    def center(self, observations: Any) -> Any:
        """
        :param observations: Observations as stored, by key
        :return: Views without randomness, by key
        """
        return observations | {key: image.center(observations[key]) for key, image in self.images.items()}

    def of(self, key: str) -> Augmentation:
        """
        :param key: Of an image
        :return: What is done to that image
        """
        return self.images[key]


AUGMENTATIONS: dict[str | None, type[Augmentation]] = {None: Augmentation, "shift": RandomShift, "crop": RandomCrop}


def make_augmentation(
    name: str | Callable[[spaces.Space], str | None] | None, observation_space: spaces.Space, **kwargs: Any
) -> Augmentation:
    """
    :param name: ``"shift"``, ``"crop"`` or None, or what chooses one of them for an observation, or an image of it
    :param observation_space: Space of the stored observations
    :param kwargs: Arguments of the augmentation
    :return: The augmentation
    """
    if isinstance(observation_space, spaces.Dict):
        parts = {
            key: make_augmentation(name, space, **kwargs) for key, space in image_spaces(observation_space).items()
        }
        is_plain = all(type(part) is Augmentation for part in parts.values())
        return Augmentation(observation_space) if is_plain else DictAugmentation(observation_space, parts)
    if callable(name):
        name = name(observation_space)
    return AUGMENTATIONS[name](observation_space, **kwargs)


def _images(space: spaces.Space, name: str) -> spaces.Space:
    if not is_image_space(space):
        raise ValueError(f"augmentation={name!r} works on images, but observations are {space}: set augmentation=None.")
    return space


def _windows(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    """images[b, c, rows[b, i], columns[b, j]] for all b, c, i, j, in NHWC memory order. First rows are picked, each as
    one block of memory, then columns within them."""
    batch, channels, height, width = images.shape
    rows, columns = rows.to(images.device), columns.to(images.device)
    rows_of_all = rows + height * th.arange(batch, device=images.device)[:, None]
    picked = images.permute(0, 2, 3, 1).reshape(batch * height, -1).index_select(0, rows_of_all.flatten())
    pixels = channels * columns[:, :, None] + th.arange(channels, device=images.device)
    index = pixels.view(batch, 1, -1).expand(-1, rows.shape[1], -1)
    windows = picked.view(batch, -1, width * channels).gather(2, index)
    return windows.view(batch, rows.shape[1], columns.shape[1], channels).permute(0, 3, 1, 2)
