"""Critics on the latents of the shared encoder: SAC's twin Q-values and TQC's truncated quantiles.

Targets have the shape [B, K], with K values per sample: one for SAC, the quantiles that are kept for TQC.
"""

from collections.abc import Iterable
from itertools import chain, pairwise
from typing import Any

import torch as th
from sb3_contrib.common.utils import quantile_huber_loss
from torch import nn
from torch.nn import functional as F

from sb3_cure.networks.layers import EnsembleLinear, EnsembleNorm, MixedPrecision, ResidualBlock, run_mlp


class LatentCritic(MixedPrecision):
    """Several critics side by side on the latents of the shared encoder, which they do not own.

    :param features_dim: Size of the latents
    :param action_dim: Size of the actions
    :param net_arch: Hidden layers; for ``"residual"`` the hidden units of each block, of which the first is also the
        width of all blocks
    :param activation_fn: Activation function
    :param n_critics: Number of critics
    :param n_values: Values that each critic returns
    :param critic_arch: ``"mlp"``, or ``"residual"``: a linear layer, a block ``x + MLP(LayerNorm(x))`` per entry of
        ``net_arch``, and a LayerNorm before the output (SimBa, Lee et al., 2024; BRO, Nauman et al., 2024)
    :raises ValueError: for another ``critic_arch``, or ``"residual"`` without hidden layers
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        features_dim: int,
        action_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        n_critics: int,
        n_values: int = 1,
        critic_arch: str = "mlp",
    ):
        super().__init__()
        if critic_arch not in ("mlp", "residual"):
            raise ValueError(f"critic_arch must be 'mlp' or 'residual', but is {critic_arch!r}.")
        if critic_arch == "residual" and not net_arch:
            raise ValueError("critic_arch='residual' needs hidden layers, but net_arch has none for the critics.")
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
        """Compute the values of all critics.

        :param latents: [B, features_dim]
        :param actions: In [-1, 1], [B, action_dim]
        :return: Values in fp32, [B, n_critics, n_values]
        """
        inputs = th.cat([latents, actions], dim=1).expand(self.n_critics, -1, -1)
        return run_mlp(self.ensemble, inputs, self.compute_dtype).transpose(0, 1)

    def target_values(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Compute the values to bootstrap from, without the entropy; for target critics.

        :param latents: Latents of the next observations, [B, features_dim]
        :param actions: Next actions, [B, action_dim]
        :return: [B, K]
        """
        raise NotImplementedError

    def loss(self, latents: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Compute the critics' loss.

        :param latents: [B, features_dim]
        :param actions: [B, action_dim]
        :param target: [B, K]
        :return: Scalar
        """
        raise NotImplementedError

    def value(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Compute what the actor maximises.

        :param latents: [B, features_dim]
        :param actions: [B, action_dim]
        :return: [B, 1]
        """
        raise NotImplementedError


class TwinCritic(LatentCritic):
    """SAC's critics: the target and the actor's value are the smallest Q-value (Haarnoja et al., 2018)."""

    def target_values(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self(latents, actions).amin(dim=1)

    def loss(self, latents: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        values = self(latents, actions)  # half the sum of the critics' mean squared errors, as in SB3's SAC
        return 0.5 * F.mse_loss(values, target.unsqueeze(1).expand_as(values)) * self.n_critics

    def value(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self(latents, actions).amin(dim=1)


class QuantileCritic(LatentCritic):
    """TQC's critics: quantiles, of which the largest are dropped from the target (Kuznetsov et al., 2020).

    :param args: As for ``LatentCritic``
    :param n_quantiles: Quantiles of each critic
    :param top_quantiles_to_drop_per_net: Quantiles to drop for each critic
    :param kwargs: As for ``LatentCritic``
    :raises ValueError: if no quantile is left, or the number to drop is negative
    """

    def __init__(self, *args: Any, n_quantiles: int = 25, top_quantiles_to_drop_per_net: int = 2, **kwargs: Any):
        super().__init__(*args, n_values=n_quantiles, **kwargs)  # type: ignore[misc]
        if not 0 <= top_quantiles_to_drop_per_net < n_quantiles:
            raise ValueError(
                f"top_quantiles_to_drop_per_net={top_quantiles_to_drop_per_net} must be at least 0, and leave some of "
                f"n_quantiles={n_quantiles}."
            )
        self.n_kept = (n_quantiles - top_quantiles_to_drop_per_net) * self.n_critics

    def target_values(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self(latents, actions).flatten(1).sort().values[:, : self.n_kept]

    def loss(self, latents: th.Tensor, actions: th.Tensor, target: th.Tensor) -> th.Tensor:
        # Averaged over quantiles, as in sb3-contrib's TQC
        return quantile_huber_loss(self(latents, actions), target.unsqueeze(1), sum_over_quantiles=False)

    def value(self, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self(latents, actions).mean(dim=2).mean(dim=1, keepdim=True)
