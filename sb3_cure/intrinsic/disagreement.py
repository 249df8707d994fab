"""Disagreement: where several models of the next step expect different things."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, LookUp
from sb3_cure.networks.layers import EnsembleLinear


class Disagreement(IntrinsicReward):
    """Variance over the members of an ensemble, which predict the next latents (Pathak et al., 2019, eq. 1).

    Noise that nobody can predict makes all members expect its mean, where they agree in the end. The members begin
    differently, and each learns from a random part of all transitions, which a hash of their places in the replay
    buffer chooses. (Where a replay buffer of one's own does not tell the places: from a random part of each batch.)

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param n_members: Number of models
    :param hidden_dim: Width of their hidden layer
    :param share: Share of the transitions that each member learns from
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
        self._places: np.ndarray | None = None

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """Find out which transitions are in the batch.

        :param replay_buffer: The replay buffer
        :param look_up: Unused
        :param encode: Unused
        """
        drawn = getattr(replay_buffer, "last_sampled", None)
        self._places = None if drawn is None else drawn[0] * replay_buffer.n_envs + drawn[1]

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Its actions, which were executed, are read
        :param latents: [B, features_dim]
        :param next_latents: What is to be predicted, [B, features_dim]
        :param srl_error: Unused
        :return: Mean squared error of each member on its part of the transitions, summed; and the variance over
            members, averaged over latents, [B]
        """
        assert latents is not None and next_latents is not None
        inputs = th.cat([latents, batch.actions], dim=1)
        expected = self.members(inputs.expand(self.n_members, *inputs.shape))
        errors = (expected - next_latents).square().mean(dim=2)
        places = np.arange(len(inputs)) if self._places is None else self._places
        part = th.from_numpy(_uniform(places, self.n_members) < self.share).to(errors.device)
        loss = ((errors * part).sum(dim=1) / part.sum(dim=1).clamp(min=1)).sum()
        return loss, expected.detach().var(dim=0, correction=0).mean(dim=1)


def _uniform(places: np.ndarray, n: int) -> np.ndarray:
    """n numbers in [0, 1) for each place, [n, B], by a hash (that of SplitMix64) instead of a generator."""
    hashed = (places * n + np.arange(n)[:, None]).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashed = (hashed ^ (hashed >> np.uint64(shift))) * np.uint64(factor)
    return (hashed ^ (hashed >> np.uint64(31))) / 2.0**64
