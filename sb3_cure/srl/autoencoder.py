"""Regularised autoencoder (RAE): eq. 2 of the paper, as SAC-AE (Yarats et al., 2019) implements it."""

from functools import partial

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.networks.decoders import PixelDecoder, squared_error
from sb3_cure.networks.encoders import Encoder
from sb3_cure.networks.fast_ops import random_bytes_like
from sb3_cure.networks.layers import small_mlp
from sb3_cure.srl.base import SRLHead, SRLOutput


class RAE(SRLHead):
    """Regularised autoencoder: squared reconstruction error + latent penalty + weight decay of the decoder.

    The paper's eq. 2 gives the log-likelihood a plus sign; here the squared error is *minimised*. Images are reduced to
    5 bits and dithered with uniform noise, as in SAC-AE (after Glow).

    The decoder draws the centred view, so that latents need not hold the shift or the crop.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations: images, or anything that SB3 can flatten
    :param latent_penalty: lambda_z, on half the squared norm of the latents
    :param decoder_weight_decay: lambda_theta, applied by the decoder's optimiser
    :param bits: Bits that are kept of each pixel's 8
    """

    warmup_updates = 1000

    def __init__(
        self,
        encoder: Encoder,
        observation_space: spaces.Space,
        latent_penalty: float = 1e-6,
        decoder_weight_decay: float = 1e-7,
        bits: int = 5,
    ):
        super().__init__(encoder, observation_space)
        if not 1 <= bits <= 8:
            raise ValueError(f"bits is {bits}, but a pixel has 8: give a whole number from 1 to 8.")
        self.latent_penalty = latent_penalty
        self.optimizer_kwargs = {"weight_decay": decoder_weight_decay}
        self.bits = bits
        self.pixels = is_image_space(encoder.view_space)
        self.decoder: nn.Module
        if self.pixels:
            self.decoder = PixelDecoder(
                encoder.features_dim,
                encoder.view_space.shape,  # type: ignore[arg-type]
                # SAC-AE's sizes for features extractors that do not have these
                getattr(encoder, "n_filters", 32),
                getattr(encoder, "n_layers", 4),
            )
        else:
            self.decoder = small_mlp(encoder.features_dim, get_flattened_obs_dim(encoder.view_space))

    def target(self, views: th.Tensor, dither: bool) -> th.Tensor:
        """Compute the decoder's target.

        :param views: Centred views, [B, *view shape], images in 0-255
        :param dither: Whether to add uniform noise within a quantisation step (training), or its mean (measuring)
        :return: Images in [-0.5, 0.5], [B, C, H, W]; vectors as ``encoder.vector_target`` gives them, [B, out_dim]
        """
        if not self.pixels:
            return self.encoder.vector_target(views)
        # NHWC, as the decoder writes: reading two memory orders at once is far slower than one copy of bytes.
        images = views.contiguous(memory_format=th.channels_last)
        # SAC-AE's floor(x / 2^(8 - bits)) / 2^bits + U(0, 1) / 2^bits - 0.5, for speed in int16 until the last line:
        # in units of 1/256 of a quantisation step.
        levels = th.bitwise_right_shift(images, 8 - self.bits).to(th.int16).sub_(2 ** (self.bits - 1)).mul_(256)
        middle = 128.0
        if dither:
            levels.add_(random_bytes_like(images))
            middle = 0.5
        return levels.float().add_(middle).div_(256 * 2**self.bits)

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Compute eq. 2 of the paper; the optimizer applies the decoder's weight decay.

        :param batch: Samples of the replay buffer
        :param latents: [B, features_dim]
        :param next_latents: Unused
        :return: Loss, and the mean squared error of each observation, [B]
        """
        error = self._squared_error(batch, latents, dither=True)
        penalty = 0.5 * latents.square().sum(dim=1).mean()
        return SRLOutput(error.mean() + self.latent_penalty * penalty, error.detach())

    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """Compute the mean squared error of each observation, against the target without noise.

        :param batch: Samples of the replay buffer
        :param latents: [B, features_dim]
        :return: [B]
        """
        return self._squared_error(batch, latents, dither=False).detach()

    def _squared_error(self, batch: Samples, latents: th.Tensor, dither: bool) -> th.Tensor:
        centred = self.augment.center(batch.observations)
        return squared_error(self.decoder, latents, centred, partial(self.target, dither=dither))

    def reconstruct(self, latents: th.Tensor) -> th.Tensor:
        """Draw views from latents.

        :param latents: [B, features_dim]
        :return: Images in 0-255 (uint8), [B, C, H, W]; vectors as decoded, [B, out_dim]
        """
        drawn = self.decoder(latents).float()
        return ((drawn + 0.5) * 256).clamp(0, 255).to(th.uint8) if self.pixels else drawn
