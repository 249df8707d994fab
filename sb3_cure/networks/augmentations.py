"""Augmentations: the encoder sees a random view of observations in training, and a centred one otherwise."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_cure.data.observations import image_spaces

#: Crops are this share of an image's sides: 84 of 100 pixels in CURL
CROP_SHARE = 0.84


class Augmentation:
    """No augmentation, and the base class of all others: a view is the observation itself.

    Views have the dtype and the scale of observations: images are uint8 in 0-255.

    :param observation_space: Space of the stored observations
    """

    #: Whether views are drawn at random
    is_random: ClassVar[bool] = False

    def __init__(self, observation_space: spaces.Space):
        self.observation_space = observation_space
        #: Space of the views
        self.view_space = observation_space

    def __call__(self, observations: Any, generator: th.Generator | None = None) -> Any:
        """Draw random views.

        :param observations: Observations as stored, [B, *shape], or by key
        :param generator: Source of the randomness (default: torch's global one)
        :return: [B, *view shape], or by key
        """
        return observations

    def center(self, observations: Any) -> Any:
        """Return the views without randomness, to act and to measure.

        :param observations: Observations as stored, [B, *shape], or by key
        :return: [B, *view shape], or by key
        """
        return observations

    def of(self, key: str) -> "Augmentation":
        """Return the augmentation of one image in a dictionary.

        :param key: Key of the image
        :return: Its augmentation
        """
        return Augmentation(self.observation_space[key])  # type: ignore[index]


class RandomShift(Augmentation):
    """Shifts images by up to ``pad`` pixels and repeats the border (DrQ, Yarats et al. 2021, section 4.1).

    :param observation_space: Space of images, channels first
    :param pad: Largest shift, pixels
    """

    is_random = True

    def __init__(self, observation_space: spaces.Space, pad: int = 4):
        super().__init__(_image_space(observation_space, "shift"))
        self.pad = pad

    def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """Shift all channels of an observation, hence all its frames, alike.

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
    """Cuts a random window out of each image, every offset equally likely (CURL, Laskin et al. 2020, section 4.2).

    :param observation_space: Space of images, channels first
    :param size: Sides of the crops, pixels: one number or (height, width); None: 84 % of each side of the images
    :raises ValueError: if the crops are not smaller than the images
    """

    is_random = True

    def __init__(self, observation_space: spaces.Space, size: int | tuple[int, int] | None = None):
        super().__init__(_image_space(observation_space, "crop"))
        channels, height, width = observation_space.shape  # type: ignore[misc]
        if size is None:
            size = round(CROP_SHARE * height), round(CROP_SHARE * width)
        self.height, self.width = (size, size) if isinstance(size, int) else size
        if not (0 < self.height < height and 0 < self.width < width):
            raise ValueError(
                f"augmentation='crop' cannot cut {self.height} x {self.width} pixels out of images of {height} x "
                f"{width}: set a smaller augmentation_kwargs=dict(size=...), or use augmentation='shift'."
            )
        self.view_space = spaces.Box(0, 255, (channels, self.height, self.width), np.uint8)

    def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        """Cut all channels of an observation, hence all its frames, alike.

        :param observations: [B, C, H, W]
        :param generator: Source of the offsets (default: torch's global one)
        :return: [B, C, height, width]
        """
        batch, _, height, width = observations.shape
        # Drawn on the CPU: a CUDA draw would not repeat a CPU run, and two short vectors cost nothing to send.
        top = th.randint(height - self.height + 1, (batch, 1), generator=generator)
        left = th.randint(width - self.width + 1, (batch, 1), generator=generator)
        return _windows(observations, top + th.arange(self.height), left + th.arange(self.width))

    def center(self, observations: th.Tensor) -> th.Tensor:
        """Cut the central windows.

        :param observations: [B, C, H, W]
        :return: [B, C, height, width]
        """
        top, left = (observations.shape[2] - self.height) // 2, (observations.shape[3] - self.width) // 2
        return observations[:, :, top : top + self.height, left : left + self.width]


class DictAugmentation(Augmentation):
    """Augments each image of a dictionary by itself; vectors stay as they are.

    :param observation_space: Dictionary of images and vectors
    :param images: Augmentation of each image, by key
    """

    is_random = True

    def __init__(self, observation_space: spaces.Dict, images: dict[str, Augmentation]):
        super().__init__(observation_space)
        self.images = images
        views = {key: images[key].view_space if key in images else observation_space[key] for key in observation_space}
        self.view_space = spaces.Dict(list(views.items()))

    def __call__(self, observations: Any, generator: th.Generator | None = None) -> Any:
        """Draw random views of all images.

        :param observations: Observations as stored, by key
        :param generator: Source of the randomness (default: torch's global one)
        :return: Views by key
        """
        return observations | {key: image(observations[key], generator) for key, image in self.images.items()}

    def center(self, observations: Any) -> Any:
        """Return the views without randomness.

        :param observations: Observations as stored, by key
        :return: Views by key
        """
        return observations | {key: image.center(observations[key]) for key, image in self.images.items()}

    def of(self, key: str) -> Augmentation:
        """Return the augmentation of one image.

        :param key: Key of the image
        :return: Its augmentation
        """
        return self.images[key]


AUGMENTATIONS: dict[str | None, type[Augmentation]] = {None: Augmentation, "shift": RandomShift, "crop": RandomCrop}


def make_augmentation(
    name: str | Callable[[spaces.Space], str | None] | None, observation_space: spaces.Space, **kwargs: Any
) -> Augmentation:
    """Build an augmentation; of a dictionary one for each image.

    :param name: ``"shift"``, ``"crop"`` or None, or a function that chooses one of them for a space
    :param observation_space: Space of the stored observations
    :param kwargs: Arguments of the augmentation
    :return: The augmentation
    """
    if isinstance(observation_space, spaces.Dict):
        parts = {
            key: make_augmentation(name, space, **kwargs) for key, space in image_spaces(observation_space).items()
        }
        is_random = any(part.is_random for part in parts.values())
        return DictAugmentation(observation_space, parts) if is_random else Augmentation(observation_space)
    if callable(name):
        name = name(observation_space)
    return AUGMENTATIONS[name](observation_space, **kwargs)


def _image_space(space: spaces.Space, name: str) -> spaces.Space:
    if not is_image_space(space):
        raise ValueError(
            f"augmentation={name!r} needs images, but observations are {space}: make pixels of the environment with "
            "make_pixel_env (in settings files as env_wrapper), or set augmentation=None."
        )
    return space


def _windows(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    """Compute images[b, c, rows[b, i], columns[b, j]] for all b, c, i, j, in NHWC memory order.

    Rows are picked first, each as one block of memory, then columns within them.
    """
    batch, channels, height, width = images.shape
    rows, columns = rows.to(images.device), columns.to(images.device)
    all_rows = rows + height * th.arange(batch, device=images.device)[:, None]
    picked = images.permute(0, 2, 3, 1).reshape(batch * height, -1).index_select(0, all_rows.flatten())
    pixels = channels * columns[:, :, None] + th.arange(channels, device=images.device)
    index = pixels.view(batch, 1, -1).expand(-1, rows.shape[1], -1)
    windows = picked.view(batch, -1, width * channels).gather(2, index)
    return windows.view(batch, rows.shape[1], columns.shape[1], channels).permute(0, 3, 1, 2)
