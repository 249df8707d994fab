"""Intrinsic curiosity module (ICM): the error of a forward model in features that depend on actions."""

from typing import Any

import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.intrinsic.reward_networks import MLP, make_network, scaled


class ICM(IntrinsicReward):
    """Error of a forward model in features that an inverse model trains (Pathak et al., 2017, eq. 2 to 6).

    The forward model's own loss does not reach the features: it would make them constant, hence easy to predict (Burda
    et al., 2019, section 2.1).

    :param args: As for ``IntrinsicReward``
    :param encoder: ``"shared"``: the features are the agent's latents, and the inverse model trains their encoder, too;
        ``"own"``: they come from a network of the reward's own (for a dictionary, one for each image)
    :param n_filters: Channels of its convolutions
    :param hidden_dim: Width of the models' hidden layer
    :raises ValueError: for another encoder
    """

    trains_encoder = True

    def __init__(self, *args: Any, encoder: str = "shared", n_filters: int = 16, hidden_dim: int = 256):
        super().__init__(*args)
        if encoder not in ("shared", "own"):
            raise ValueError(f"encoder is {encoder!r} in intrinsic_kwargs: choose 'shared' or 'own'.")
        features_dim, action_dim = self.features_dim, get_action_dim(self.action_space)
        self.forward_model = MLP([features_dim + action_dim, hidden_dim, features_dim])
        self.inverse_model = MLP([2 * features_dim, hidden_dim, action_dim])
        self.encoder: nn.Sequential | None = None
        if encoder == "own":
            self.trains_encoder = False
            self.encoder = make_network(self.observation_space, [hidden_dim, features_dim], n_filters)
            self.norm = nn.LayerNorm(features_dim)

    @classmethod
    def is_per_image(cls, encoder: str = "shared", **kwargs: Any) -> bool:
        """Return whether the features come from an image."""
        return encoder == "own"

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor, th.Tensor]:
        """Predict the action from the features before and after it, and the next features from the action.

        :param inputs: Its latents (or observations, with an encoder of the reward's own) and actions are read
        :return: Mean squared errors of both models, and the forward model's of each sample, [B]
        """
        batch = inputs.batch
        if self.encoder is None:
            features, next_features = inputs.latents, inputs.next_latents
        else:
            features, next_features = self._encode(batch.observations), self._encode(batch.next_observations)
        actions = self.inverse_model(th.cat([features, next_features], dim=1))
        predicted = self.forward_model(th.cat([features.detach(), batch.actions], dim=1))
        error = (predicted - next_features.detach()).square().mean(dim=1)
        return (actions - batch.actions).square().mean() + error.mean(), error.detach()

    def _encode(self, observations: th.Tensor) -> th.Tensor:
        assert self.encoder is not None
        return self.norm(self.encoder(scaled(observations, self.observation_space)))  # type: ignore[no-any-return]
