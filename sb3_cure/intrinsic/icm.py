"""Intrinsic curiosity module (ICM): what a model of the next step gets wrong of what actions change."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward
from sb3_cure.intrinsic.reward_networks import MLP, make_network, scaled


class ICM(IntrinsicReward):
    """Error of a forward model in features that an inverse model trains (Pathak et al., 2017, eq. 2 to 6).

    The forward model's own loss does not reach the features, which would make them easy to predict by making them
    constant (Burda et al., 2019, section 2.1).

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the features
    :param encoder: ``"shared"``: the features are the agent's latents, and the inverse model is one more source that
        trains their encoder; ``"own"``: they come from a network of the reward's own
    :param n_filters: Channels of its convolutions
    :param hidden_dim: Width of the models' hidden layer
    :raises ValueError: for another encoder
    """

    reads: tuple[str, ...] = ("latents", "next_latents")
    trains_encoder = True

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        encoder: str = "shared",
        n_filters: int = 16,
        hidden_dim: int = 256,
    ):
        super().__init__(observation_space, action_space, features_dim)
        if encoder not in ("shared", "own"):
            raise ValueError(f"encoder is {encoder!r} in intrinsic_kwargs: choose 'shared' or 'own'.")
        self.observation_space = observation_space
        action_dim = get_action_dim(action_space)
        self.forward_model = MLP([features_dim + action_dim, hidden_dim, features_dim])
        self.inverse_model = MLP([2 * features_dim, hidden_dim, action_dim])
        self.encoder: nn.Sequential | None = None
        if encoder == "own":
            self.reads, self.trains_encoder, self.mixed_precision = (), False, True
            self.encoder = make_network(observation_space, [hidden_dim, features_dim], n_filters)
            self.norm = nn.LayerNorm(features_dim)

    @classmethod
    def configured(cls, encoder: str = "shared", **kwargs: Any) -> type[IntrinsicReward]:
        """
        :param encoder: As of the constructor
        :param kwargs: Its other arguments
        :return: This class, or one that does not train the agent's encoder
        """
        return cls if encoder == "shared" else OwnEncoder

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Its actions are what the inverse model is to tell, in [-1, 1]
        :param latents: [B, features_dim], or None with an encoder of its own
        :param next_latents: The same
        :param srl_error: Unused
        :return: Mean squared errors of both models, and the forward model's of each sample, [B]
        """
        if self.encoder is not None:
            latents, next_latents = self._encode(batch.observations), self._encode(batch.next_observations)
        assert latents is not None and next_latents is not None
        told = self.inverse_model(th.cat([latents, next_latents], dim=1))
        expected = self.forward_model(th.cat([latents.detach(), batch.actions], dim=1))
        error = (expected - next_latents.detach()).square().mean(dim=1)
        return (told - batch.actions).square().mean() + error.mean(), error.detach()

    def _encode(self, observations: th.Tensor) -> th.Tensor:
        features = self.encoder(scaled(observations, self.observation_space))  # type: ignore[misc]
        return self.norm(features)  # type: ignore[no-any-return]


class OwnEncoder(ICM):
    """With an encoder of the reward's own there is one for each image, and the agent's is left alone."""

    per_image = True
    trains_encoder = False
