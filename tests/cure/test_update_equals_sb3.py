"""With ``srl=None, curiosity=None`` an update is that of SB3's SAC and of sb3-contrib's TQC, up to rounding.

Both get the same weights, batches and noise, the same map to the log standard deviation, and no encoder to train.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import VectorBox
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.cure.actor_critic import LOG_STD_MAX, LOG_STD_MIN

PAIRS = {"sac": (SAC, CuReSAC), "tqc": (TQC, CuReTQC)}
N_QUANTILES = 5


def make_pair(name: str, optimizer_class: type[th.optim.Optimizer]) -> tuple[Any, Any]:
    """SB3's model and ours, of equal weights, each with the same transitions in its replay buffer."""
    policy_kwargs: dict[str, Any] = dict(net_arch=[16, 16], optimizer_class=optimizer_class)
    if name == "tqc":
        policy_kwargs["n_quantiles"] = N_QUANTILES
    settings: dict[str, Any] = dict(
        learning_rate=1e-2, buffer_size=200, learning_starts=100, batch_size=16, tau=0.05, gamma=0.9, gradient_steps=1,
        ent_coef="auto_0.5", target_update_interval=1, seed=0, device="cpu",
    )  # fmt: skip
    theirs = PAIRS[name][0]("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs, **settings)
    ours = PAIRS[name][1](
        "MlpPolicy",
        VectorBox(),
        policy_kwargs={**policy_kwargs, "features_extractor_class": FlattenExtractor},
        srl=None,
        curiosity=None,
        actor_update_interval=1,
        ent_coef_lr_factor=1,
        precision="fp32",
        **settings,
    )
    for model in (theirs, ours):
        model.learn(100)  # random actions of one seed: the same transitions
        temperature = optimizer_class([model.log_ent_coef], lr=1e-2)
        model.ent_coef_optimizer = temperature
    ours.policy.task.ent_coef_optimizer = temperature
    copy_weights(theirs, ours)
    return theirs, ours


def copy_weights(theirs: Any, ours: Any) -> None:
    """Give our model the weights of SB3's; ensemble layers are transposed and side by side."""
    for (_, mine), (_, other) in zip(named_parameters(ours), named_parameters(theirs), strict=True):
        mine.data.copy_(other.data)


def named_parameters(model: Any) -> Iterator[tuple[str, th.Tensor]]:
    """Names and parameters of actor, critics, targets and temperature, in one order and in SB3's shapes (views)."""
    actor = model.policy.actor
    for part in (actor.latent_pi, actor.mu, actor.log_std):
        yield from part.named_parameters()
    for critic in (model.policy.critic, model.policy.critic_target):
        if hasattr(critic, "ensemble"):
            for i in range(critic.n_critics):
                for name, parameter in critic.ensemble.named_parameters():
                    # Views, so that what is copied arrives
                    yield name, parameter.data[i].T if name.endswith("weight") else parameter.data[i, 0]
        else:
            networks = critic.q_networks if hasattr(critic, "q_networks") else critic.quantile_critics
            for network in networks:
                yield from network.named_parameters()
    yield "log_ent_coef", model.log_ent_coef


def gradients(model: Any) -> Iterator[tuple[str, th.Tensor]]:
    """Gradients in the order and shapes of ``named_parameters``; NaN where there is none (targets)."""
    actor = model.policy.actor
    for part in (actor.latent_pi, actor.mu, actor.log_std):
        yield from ((name, parameter.grad) for name, parameter in part.named_parameters())
    networks = getattr(model.policy.critic, "q_networks", None) or model.policy.critic.quantile_critics
    for network in networks:
        yield from ((name, parameter.grad) for name, parameter in network.named_parameters())
    for network in networks:
        yield from ((name, th.full_like(parameter, th.nan)) for name, parameter in network.named_parameters())
    yield "log_ent_coef", model.log_ent_coef.grad


@pytest.fixture
def same_noise(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Lets both models draw given noise: SB3 first for the current action, ours first for the next one."""

    def set_noise(ours: bool, current: th.Tensor, following: th.Tensor) -> None:
        queue = [following, current] if ours else [current, following]
        monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *_, **__: queue.pop(0))
        monkeypatch.setattr(th, "randn_like", lambda *_, **__: queue.pop(0))

    def rescaled(self: Any, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor, dict]:
        latent = self.latent_pi(self.extract_features(obs, self.features_extractor))
        log_std = LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (th.tanh(self.log_std(latent)) + 1)
        return self.mu(latent), log_std, {}

    monkeypatch.setattr("stable_baselines3.sac.policies.Actor.get_action_dist_params", rescaled)
    monkeypatch.setattr("sb3_contrib.tqc.policies.Actor.get_action_dist_params", rescaled)
    return set_noise


def update_both(theirs: Any, ours: Any, set_noise: Any, seed: int) -> None:
    generator = th.Generator().manual_seed(seed)
    current, following = (th.randn(16, 2, generator=generator) for _ in range(2))
    for model in (theirs, ours):
        set_noise(model is ours, current.clone(), following.clone())
        np.random.seed(seed)  # of the batch
        model.train(gradient_steps=1, batch_size=16)


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("n_updates", [1, 50])
def test_updates_with_sgd_equal_sb3(name: str, n_updates: int, same_noise: Any) -> None:
    """Every parameter, target and temperature agrees to 1e-5."""
    theirs, ours = make_pair(name, th.optim.SGD)
    for seed in range(n_updates):
        update_both(theirs, ours, same_noise, seed)
    for (label, mine), (_, other) in zip(named_parameters(ours), named_parameters(theirs), strict=True):
        assert th.allclose(mine, other, rtol=0, atol=1e-5), label


@pytest.mark.parametrize("name", PAIRS)
def test_update_with_adam_equals_sb3(name: str, same_noise: Any) -> None:
    """Wherever the gradient is more than rounding: Adam's first step is its sign."""
    theirs, ours = make_pair(name, th.optim.Adam)
    update_both(theirs, ours, same_noise, 0)
    rows = zip(named_parameters(ours), named_parameters(theirs), gradients(theirs), strict=True)
    for (label, mine), (_, other), (_, gradient) in rows:
        clear = ~(gradient.abs() <= 1e-6)
        assert clear.any() and th.allclose(mine[clear], other[clear], rtol=0, atol=1e-5), label
