"""What the latents do not hold of the image: the paper's idea for heads that do not draw."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward
from sb3_cure.intrinsic.reward_networks import scaled
from sb3_cure.networks.decoders import PixelDecoder, VectorDecoder, squared_error


class Reconstruction(IntrinsicReward):
    """Squared error of a decoder that is trained on detached latents, of where the step leads.

    The SRL error of an autoencoder, apart from the head: the encoder may learn by contrast, whose own error falls with
    novelty, and pictures show what its latents hold.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param n_filters: Channels of the decoder's hidden layers (images)
    :param n_layers: Its transposed convolutions; small images allow fewer
    """

    reads = ("next_latents",)
    mixed_precision = True
    measures = True
    per_image = True

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        n_filters: int = 16,
        n_layers: int = 4,
    ):
        super().__init__(observation_space, action_space, features_dim)
        self.observation_space = observation_space
        self.decoder: PixelDecoder | VectorDecoder
        if is_image_space(observation_space):
            shape: tuple[int, ...] = observation_space.shape  # type: ignore[assignment]
            self.decoder = PixelDecoder(features_dim, shape, n_filters, min(n_layers, (min(shape[1:]) + 1) // 4))
        else:
            self.decoder = VectorDecoder(features_dim, get_flattened_obs_dim(observation_space))

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Its next observations are what is to be drawn
        :param latents: Unused
        :param next_latents: [B, features_dim]
        :param srl_error: Unused
        :return: Mean squared error, and that of each sample, [B]
        """
        assert next_latents is not None
        error = self._squared_error(batch.next_observations, next_latents)
        return error.mean(), error.detach()

    @th.no_grad()
    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """
        :param observations: As stored, [B, *shape]
        :param latents: Theirs, [B, features_dim]
        :return: Squared error of each, to measure by, [B]
        """
        return self._squared_error(observations, latents)

    @th.no_grad()
    def reconstruct(self, latents: th.Tensor) -> th.Tensor:
        """
        :param latents: [B, features_dim]
        :return: Images in 0-255 (uint8), vectors as decoded, [B, *shape]
        """
        drawn = self.decoder(latents).float()
        return ((drawn + 0.5) * 255).round().clamp(0, 255).to(th.uint8) if drawn.dim() == 4 else drawn

    def _squared_error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        return squared_error(self.decoder, latents, observations, self._target)

    def _target(self, observations: th.Tensor) -> th.Tensor:
        if observations.dim() == 4:  # in the order in which it is drawn
            return observations.float().div_(255).sub_(0.5)
        return scaled(observations, self.observation_space)
