"""What differs between SAC and TQC: critics with one value or with quantiles, their target, loss and value.

Both act on the latents of the shared encoder. Wherever a value is formed, [B, K] are K values of each sample:
K = 1 for SAC (the smallest of the twin Q values), the quantiles that are kept for TQC.
"""

from collections.abc import Iterable
from itertools import chain, pairwise
from typing import Any

import torch as th
from sb3_contrib.common.utils import quantile_huber_loss
from torch import nn
from torch.nn import functional as F

from sb3_cure.layers import EnsembleLinear, EnsembleNorm, ResidualBlock, run_mlp


class LatentCritic(nn.Module):
    """Several critics on the latents of the shared encoder, which they do not own.

    :param features_dim: Size of the latents
    :param action_dim: Size of the actions
    :param net_arch: Hidden layers; of ``"residual"`` the hidden units of each block, the first also their common width
    :param activation_fn: Activation function
    :param n_critics: Number of critics
    :param n_values: Values that each critic returns: 1, or its quantiles
    :param critic_arch: ``"mlp"``, or ``"residual"``: a linear layer, a block ``x + MLP(LayerNorm(x))`` per entry of
        ``net_arch``, and a LayerNorm before the output (SimBa, Lee et al. 2024; BRO, Nauman et al. 2024)
    :raises ValueError: for another ``critic_arch``, or ``"residual"`` without hidden layers
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        n_critics: int = 2,
        n_values: int = 1,
        critic_arch: str = "mlp",
    ):
        super().__init__()
        if critic_arch not in ("mlp", "residual"):
            raise ValueError(f"critic_arch is {critic_arch!r}, but it must be 'mlp' or 'residual': choose one.")
        if critic_arch == "residual" and not net_arch:
            raise ValueError("critic_arch is 'residual', but net_arch has no layers for the critics: name some.")
        self.n_critics = n_critics
        sizes = [features_dim + action_dim, *net_arch]
        hidden: Iterable[nn.Module]
        if critic_arch == "residual":
            sizes = sizes[:2]
            blocks = (ResidualBlock(n_critics, sizes[1], units, activation_fn) for units in net_arch)
            hidden = (EnsembleLinear(n_critics, *sizes), *blocks, EnsembleNorm(n_critics, sizes[1]))
        else:
            hidden = chain(*([EnsembleLinear(n_critics, *pair), activation_fn()] for pair in pairwise(sizes)))
        self.ensemble = nn.Sequential(*hidden, EnsembleLinear(n_critics, sizes[-1], n_values))

    def forward(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param latents: [B, features_dim]
        :param actions: In [-1, 1], [B, action_dim]
        :return: Values in fp32, [B, n_critics, n_values]
        """
        inputs = th.cat([latents, actions], dim=1).expand(self.n_critics, -1, -1)
        return run_mlp(self.ensemble, inputs).transpose(0, 1)


class TwinQ:
    """SAC's critics: the target and the actor's value are the smallest Q (Haarnoja et al. 2018).

    :param model: The algorithm, asked at each use for settings that may change
    """

    def __init__(self, model: Any):
        self.model = model

    @staticmethod
    def make(
        features_dim: int, action_dim: int, net_arch: list[int], activation_fn: type[nn.Module], **kwargs: Any
    ) -> LatentCritic:
        """
        :param features_dim: Size of the latents
        :param action_dim: Size of the actions
        :param net_arch: Hidden layers
        :param activation_fn: Activation function
        :param kwargs: ``n_critics``, ``critic_arch``
        :return: The critics
        """
        return LatentCritic(features_dim, action_dim, net_arch, activation_fn, **kwargs)

    def next_values(self, target: LatentCritic, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param target: Target critics
        :param latents: Latents of the next observations, [B, features_dim]
        :param actions: Next actions, [B, action_dim]
        :return: Values to bootstrap from, without the entropy, [B, 1]
        """
        return target(latents, actions).amin(dim=1)

    def loss(self, values: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param values: Of the critics, [B, n_critics, 1]
        :param target: [B, 1]
        :return: Half the sum of the critics' mean squared errors, as SB3's SAC
        """
        return 0.5 * F.mse_loss(values, target.unsqueeze(1).expand_as(values)) * values.shape[1]

    def value(self, critic: LatentCritic, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param critic: Critics
        :param latents: [B, features_dim]
        :param actions: [B, action_dim]
        :return: What the actor maximises, [B, 1]
        """
        return critic(latents, actions).amin(dim=1)


class TruncatedQuantiles(TwinQ):
    """TQC's critics: quantiles, of which the largest are dropped from the target (Kuznetsov et al. 2020)."""

    @staticmethod
    def make(
        features_dim: int,
        action_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        n_quantiles: int = 25,
        **kwargs: Any,
    ) -> LatentCritic:
        """
        :param features_dim: Size of the latents
        :param action_dim: Size of the actions
        :param net_arch: Hidden layers
        :param activation_fn: Activation function
        :param n_quantiles: Quantiles of each critic
        :param kwargs: ``n_critics``, ``critic_arch``
        :return: The critics
        """
        return LatentCritic(features_dim, action_dim, net_arch, activation_fn, n_values=n_quantiles, **kwargs)

    def next_values(self, target: LatentCritic, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param target: Target critics
        :param latents: Latents of the next observations, [B, features_dim]
        :param actions: Next actions, [B, action_dim]
        :return: The quantiles that are kept, in ascending order, [B, K]
        """
        quantiles, _ = th.sort(target(latents, actions).flatten(1))
        return quantiles[:, : quantiles.shape[1] - self.model.top_quantiles_to_drop_per_net * target.n_critics]

    def loss(self, values: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param values: Quantiles of the critics, [B, n_critics, n_quantiles]
        :param target: [B, K]
        :return: Quantile Huber loss, averaged over quantiles, as sb3-contrib's TQC
        """
        return quantile_huber_loss(values, target.unsqueeze(1), sum_over_quantiles=False)

    def value(self, critic: LatentCritic, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        :param critic: Critics
        :param latents: [B, features_dim]
        :param actions: [B, action_dim]
        :return: Mean of all quantiles, [B, 1]
        """
        return critic(latents, actions).mean(dim=2).mean(dim=1, keepdim=True)
