"""What the latents miss of the image: the paper's idea for heads that do not decode."""

from typing import Any

import torch as th
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from torch import nn

from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.intrinsic.reward_networks import scaled
from sb3_cure.networks.decoders import PixelDecoder, squared_error
from sb3_cure.networks.layers import RunningStandardize, most_layers, small_mlp


class Reconstruction(IntrinsicReward):
    """Error with which a decoder, trained on detached latents, draws the next observation; vectors are standardised.

    This is an autoencoder's error for an encoder with another head, such as a contrastive one, whose own error falls
    with novelty. The decoder's pictures show what the latents hold.

    :param args: As for ``IntrinsicReward``
    :param n_filters: Channels of the decoder's hidden layers (images)
    :param n_layers: Its transposed convolutions; small images allow fewer
    """

    measures = True

    def __init__(self, *args: Any, n_filters: int = 16, n_layers: int = 4):
        super().__init__(*args)
        self.decoder: nn.Module
        self.vectors: RunningStandardize | None = None
        if is_image_space(self.observation_space):
            shape: tuple[int, ...] = self.observation_space.shape  # type: ignore[assignment]
            n_layers = min(n_layers, most_layers(*shape[1:]))
            self.decoder = PixelDecoder(self.features_dim, shape, n_filters, n_layers)
        else:
            self.vectors = RunningStandardize(self.observation_space)
            self.decoder = small_mlp(self.features_dim, get_flattened_obs_dim(self.observation_space))

    @classmethod
    def is_per_image(cls, **kwargs: Any) -> bool:
        """Return True: a decoder draws one image."""
        return True

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor, th.Tensor]:
        """Compare the next observations with what is drawn from their latents.

        :param inputs: Its next observations and their latents are read
        :return: Mean squared error, and that of each sample, [B]
        """
        if self.vectors is not None:
            self.vectors.update(inputs.batch.next_observations)
        error = self._squared_error(inputs.batch.next_observations, inputs.next_latents)
        return error.mean(), error.detach()

    @th.no_grad()
    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Compute the squared error of each observation, to measure policies.

        :param observations: As stored, [B, *shape]
        :param latents: Their latents, [B, features_dim]
        :return: [B]
        """
        return self._squared_error(observations, latents)

    @th.no_grad()
    def reconstruct(self, latents: th.Tensor) -> th.Tensor:
        """Draw observations from latents.

        :param latents: [B, features_dim]
        :return: Images in 0-255 (uint8), vectors as decoded, [B, *shape]
        """
        drawn = self.decoder(latents).float()
        return ((drawn + 0.5) * 255).round().clamp(0, 255).to(th.uint8) if drawn.dim() == 4 else drawn

    def _squared_error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        return squared_error(self.decoder, latents, observations, self._target)

    def _target(self, observations: th.Tensor) -> th.Tensor:
        return scaled(observations, self.observation_space) if self.vectors is None else self.vectors(observations)
