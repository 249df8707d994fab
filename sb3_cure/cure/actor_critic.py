"""One agent on the shared encoder: SAC's actor on its trunk, critics on its latents, and a temperature."""

import copy
import math

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_cure.cure.critics import LatentCritic
from sb3_cure.networks.layers import MixedPrecision, run_mlp

# Bounds of the actor's log standard deviation (paper, table of hyperparameters); SB3 clamps to [-20, 2] instead.
LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
# Keeps the logarithm finite where tanh is 1 in floating point, as in SB3.
EPSILON = 1e-6


class TrunkActor(MixedPrecision, Actor):
    """SAC's actor on the (detached) trunk features of the shared encoder, behind a projection of its own."""

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor, dict[str, th.Tensor]]:
        """Compute mean and log standard deviation before squashing.

        :param obs: Trunk features of the encoder, [B, trunk_dim]; for dictionaries, a tuple of these
        :return: Mean and log standard deviation, [B, action_dim] each, and an empty dictionary
        """
        latent = run_mlp(self.latent_pi, self.features_extractor(obs), self.compute_dtype)
        # Rescaled, not clamped: a clamped log std has no gradient that could bring it back.
        log_std = th.tanh(self.log_std(latent))  # type: ignore[operator]
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (log_std + 1)
        return self.mu(latent), log_std, {}

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Choose actions.

        :param obs: Trunk features of the encoder, [B, trunk_dim]; for dictionaries, a tuple of these
        :param deterministic: Whether to return the mean actions
        :return: Actions in [-1, 1], [B, action_dim]
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        return th.tanh(mean if deterministic else mean + th.randn_like(mean) * log_std.exp())

    def action_log_prob(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """Choose actions and compute their log-probabilities.

        :param obs: Trunk features of the encoder, [B, trunk_dim]; for dictionaries, a tuple of these
        :return: Actions in [-1, 1], [B, action_dim], and their log-probabilities, [B, 1]
        """
        mean, log_std, _ = self.get_action_dist_params(obs)
        # The same numbers as SB3's SquashedDiagGaussianDistribution. torch's Normal would validate its arguments, for
        # which a GPU has to synchronise.
        noise = th.randn_like(mean)
        actions = th.tanh(mean + noise * log_std.exp())
        log_prob = -0.5 * (noise.square() + math.log(2 * math.pi)) - log_std
        return actions, (log_prob - th.log(1 - actions.square() + EPSILON)).sum(dim=1, keepdim=True)


class ActorCritic(nn.Module):
    """One agent on the shared encoder: actor, critics, target critics and temperature, with their optimisers.

    :param actor: The actor, with its optimiser
    :param critic: The critics, with their optimiser
    """

    def __init__(self, actor: TrunkActor, critic: LatentCritic):
        super().__init__()
        self.actor = actor
        self.critic = critic
        self.critic_target = copy.deepcopy(critic).requires_grad_(False).eval()
        #: Logarithm of the learned temperature, [1], and its optimiser; None if it is fixed
        self.log_ent_coef: th.Tensor | None = None
        self.ent_coef_optimizer: th.optim.Optimizer | None = None
        #: The fixed temperature, []
        self.ent_coef_tensor: th.Tensor | None = None

    def set_temperature(self, ent_coef: str | float, lr: float, device: th.device) -> None:
        """Make a temperature as SB3's SAC does; a learned one has the optimiser of SAC-AE (beta1 = 0.5).

        :param ent_coef: ``"auto"``, ``"auto_<initial value>"``, or a fixed number
        :param lr: Learning rate
        :param device: Device of the temperature
        :raises ValueError: for an initial value of zero or below, whose logarithm would never change
        """
        if isinstance(ent_coef, str) and ent_coef.startswith("auto"):
            initial = float(ent_coef.split("_")[1]) if "_" in ent_coef else 1.0
            if initial <= 0:
                raise ValueError(f"the temperature {ent_coef!r} must begin above 0.")
            self.log_ent_coef = th.full((1,), initial, device=device).log().requires_grad_(True)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=lr, betas=(0.5, 0.999), fused=True)
        else:
            self.ent_coef_tensor = th.tensor(float(ent_coef), device=device)

    def temperature(self) -> th.Tensor:
        """Get the temperature alpha.

        :return: Detached, [1] or []
        """
        return self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()  # type: ignore[return-value]
