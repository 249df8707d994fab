"""Small heads, as the policy would build them, and batches of noise."""

import copy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import make_augmentation
from sb3_cure.networks.encoders import Encoder, PixelEncoder
from sb3_cure.srl import SRLHead


def image_space(channels: int = 6, height: int = 36, width: int | None = None) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width or height), np.uint8)


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


def noise_images(space: spaces.Box, batch: int = 8, seed: int = 0) -> th.Tensor:
    return th.randint(256, (batch, *space.shape), dtype=th.uint8, generator=seeded(seed))


def batch_of(observations: th.Tensor, views: th.Tensor | None = None) -> Samples:
    """A batch of which a head may read observations and views only."""
    rest: Any = None
    return Samples(observations, rest, rest, rest, rest, views=observations if views is None else views)


def encode(encoder: Encoder, views: th.Tensor) -> th.Tensor:
    """Latents of views, images in 0-255."""
    return encoder(views)


def randomise(module: th.nn.Module, seed: int = 0) -> None:
    """Give all parameters values at which nothing is zero by construction."""
    with th.no_grad():
        for i, parameter in enumerate(module.parameters()):
            parameter.normal_(std=0.2, generator=seeded(seed + i))


def make(head_class: type[SRLHead], space: spaces.Box, size: int | None = None, **kwargs: Any) -> tuple[Encoder, Any]:
    """A small encoder, and its head with a momentum encoder that differs.

    :param head_class: Class of the head
    :param space: Images
    :param size: Side of random crops, pixels; None: what the head asks for
    :param kwargs: Arguments of the head
    """
    name = head_class.choose_augmentation(space) if size is None else "crop"
    augmentation = make_augmentation(name, space, **({} if size is None else {"size": size}))
    defaults = head_class.configure_encoder(augmentation)
    encoder = PixelEncoder(augmentation.view_space, features_dim=7, n_filters=4, n_layers=2, **defaults)  # type: ignore[arg-type]
    head = head_class(encoder, space, **kwargs)
    target = copy.deepcopy(encoder).requires_grad_(False)
    randomise(target)
    head.bind(target, augmentation)
    return encoder, head
