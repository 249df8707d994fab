"""Disagreement: where several models of the next step expect different things."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_cure.buffers import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, OwnGenerator
from sb3_cure.layers import EnsembleLinear


class Disagreement(IntrinsicReward):
    """Variance over the members of an ensemble, which predict the next latents (Pathak et al., 2019, eq. 1).

    Noise that nobody can predict makes all members expect its mean, where they agree in the end. The members begin
    differently, and each learns from a random part of each batch.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param n_members: Number of models
    :param hidden_dim: Width of their hidden layer
    :param share: Share of a batch that each member learns from
    """

    reads = ("latents", "next_latents")

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        n_members: int = 5,
        hidden_dim: int = 256,
        share: float = 0.5,
    ):
        super().__init__(observation_space, action_space, features_dim)
        self.members = nn.Sequential(
            EnsembleLinear(n_members, features_dim + get_action_dim(action_space), hidden_dim),
            nn.ReLU(),
            EnsembleLinear(n_members, hidden_dim, features_dim),
        )
        self.n_members, self.share = n_members, share
        self.random = OwnGenerator()

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Its actions, which were executed, are read
        :param latents: [B, features_dim]
        :param next_latents: What is to be predicted, [B, features_dim]
        :param srl_error: Unused
        :return: Mean squared error of each member on its part of the batch, summed; and the variance over members,
            averaged over latents, [B]
        """
        assert latents is not None and next_latents is not None
        inputs = th.cat([latents, batch.actions], dim=1)
        expected = self.members(inputs.expand(self.n_members, *inputs.shape))
        errors = (expected - next_latents).square().mean(dim=2)
        # Drawn on the CPU, so that a GPU learns from the same parts.
        part = th.rand(errors.shape, generator=self.random.generator).to(errors.device) < self.share
        loss = ((errors * part).sum(dim=1) / part.sum(dim=1).clamp(min=1)).sum()
        return loss, expected.detach().var(dim=0, correction=0).mean(dim=1)
