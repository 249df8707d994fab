"""Decoders fitted afterwards to the latents of a frozen encoder, to see how much of the image they hold."""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn
from torch.nn import functional as F

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.observations import by_key
from sb3_cure.evaluation.encoders import encoder_of
from sb3_cure.networks.decoders import PixelDecoder
from sb3_cure.networks.layers import most_layers


def fit_decoder(model: BaseAlgorithm, sample: Callable[[int], Any], updates: int = 1000, key: str = "") -> nn.Module:
    """Fit a decoder of the encoder's inputs to its latents; the encoder is not trained.

    :param model: A model of any SB3 algorithm that learns from images with an encoder (``encoder_of``)
    :param sample: Function of a number n that returns as many observations, uint8 [n, C, H, W] or these by key, on the
        model's device
    :param updates: Updates of the decoder, of 64 observations each
    :param key: Key of the image to reconstruct, if observations are dictionaries
    :return: The decoder: latents -> images in [-0.5, 0.5]
    :raises ValueError: if the model has no encoder
    """
    images, latents = _images_and_latents(model, sample(1), key)
    shape = tuple(images.shape[1:])
    n_layers = min(4, most_layers(*shape[1:]))
    decoder: nn.Module = PixelDecoder(latents.shape[1], shape, n_layers=n_layers).to(model.device)
    optimizer = th.optim.Adam(decoder.parameters(), lr=1e-3)
    for _ in range(updates):
        images, latents = _images_and_latents(model, sample(64), key)
        loss = F.mse_loss(decoder(latents), images - 0.5)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return decoder


@th.no_grad()
def draw_latents(
    model: BaseAlgorithm, decoder: nn.Module, observations: Any, key: str = ""
) -> tuple[th.Tensor, th.Tensor]:
    """Reconstruct observations from their latents.

    :param model: The model that makes the latents
    :param decoder: Its decoder, of ``fit_decoder``
    :param observations: Observations as stored, 0-255, [B, C, H, W] or these by key
    :param key: As for ``fit_decoder``
    :return: What the encoder sees of them (a crop, say) and its reconstruction, both 0-255, [B, C, h, w]
    """
    images, latents = _images_and_latents(model, observations, key)
    return images * 255, (decoder(latents) + 0.5).clamp(0, 1) * 255


@th.no_grad()
def _images_and_latents(model: BaseAlgorithm, observations: Any, key: str) -> tuple[th.Tensor, th.Tensor]:
    """What the encoder sees of observations, in [0, 1], and its latents."""
    policy: Any = model.policy
    encode = encoder_of(policy)
    if encode is None:
        raise ValueError(f"decoders need a policy with an encoder, which {type(policy).__name__} does not have.")
    views = policy.augmentation.center(observations) if isinstance(policy, CuRePolicy) else observations
    return by_key(views)[key].float() / 255, encode(observations)
