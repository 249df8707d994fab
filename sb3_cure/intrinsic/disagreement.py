"""Disagreement: how different an ensemble's predictions of the next step are."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.networks.layers import EnsembleLinear


class Disagreement(IntrinsicReward):
    """Variance over the members of an ensemble, which predict the next latents (Pathak et al., 2019, eq. 1).

    For noise that cannot be predicted all members predict the mean, so they agree in the end. The members begin
    differently, and each learns from a random part of all transitions, chosen by a hash of their places in the replay
    buffer. (If a replay buffer of your own has no ``last_sampled``: from a random part of each batch.)

    :param args: As for ``IntrinsicReward``
    :param n_members: Number of models
    :param hidden_dim: Width of their hidden layer
    :param share: Share of the transitions that each member learns from
    """

    def __init__(self, *args: Any, n_members: int = 5, hidden_dim: int = 256, share: float = 0.5):
        super().__init__(*args)
        first = EnsembleLinear(n_members, self.features_dim + get_action_dim(self.action_space), hidden_dim)
        self.members = nn.Sequential(first, nn.ReLU(), EnsembleLinear(n_members, hidden_dim, self.features_dim))
        self.n_members, self.share = n_members, share

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor, th.Tensor]:
        """Predict the next latents with each member.

        :param inputs: Its latents and actions are read
        :return: Mean squared error of each member on its part of the transitions, summed; and the variance over
            members, averaged over latents, [B]
        """
        known = th.cat([inputs.latents, inputs.batch.actions], dim=1)
        predicted = self.members(known.expand(self.n_members, *known.shape))
        errors = (predicted - inputs.next_latents).square().mean(dim=2)
        buffer = inputs.replay_buffer
        rows, env_inds = getattr(buffer, "last_sampled", None) or (np.arange(len(known)), 0)
        part = _uniform(rows * buffer.n_envs + env_inds, self.n_members) < self.share
        mask = th.from_numpy(part).to(errors.device)
        loss = ((errors * mask).sum(dim=1) / mask.sum(dim=1).clamp(min=1)).sum()
        return loss, predicted.detach().var(dim=0, correction=0).mean(dim=1)


def _uniform(places: np.ndarray, n: int) -> np.ndarray:
    """Return n numbers in [0, 1) for each place, [n, B], by the hash of SplitMix64 instead of a generator."""
    hashed = (places * n + np.arange(n)[:, None]).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashed = (hashed ^ (hashed >> np.uint64(shift))) * np.uint64(factor)
    return (hashed ^ (hashed >> np.uint64(31))) / 2.0**64
