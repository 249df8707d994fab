"""Twin Q-values and truncated quantiles, of networks computed one layer after the other."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import VectorBox, tiny_model
from torch import nn
from updates_for_tests import ALGORITHMS, critic_values, filled_model, groups, moved, train_once

from sb3_cure.cure.critics import LatentCritic, QuantileCritic, TwinCritic

CRITICS = pytest.mark.parametrize("n_critics", [1, 2, 3])


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


def inputs(batch: int = 6) -> tuple[th.Tensor, th.Tensor]:
    return th.randn(batch, 3, generator=seeded(1)), th.rand(batch, 2, generator=seeded(2)) * 2 - 1


@CRITICS
def test_critics_are_separate_networks(n_critics: int) -> None:
    """[B, n_critics, n_values] in the networks' order, each with its own parameters."""
    latents, actions = inputs()
    critic = LatentCritic(3, 2, [8, 6], nn.ReLU, n_critics, n_values=4)
    values = critic(latents, actions)
    assert values.shape == (6, n_critics, 4)
    for i, expected in enumerate(critic_values(critic, latents, actions)):
        th.testing.assert_close(values[:, i], expected)
    # Weights and biases of 5 -> 8 -> 6 -> 4
    assert sum(p.numel() for p in critic.parameters()) == n_critics * (5 * 8 + 8 + 8 * 6 + 6 + 6 * 4 + 4)


@CRITICS
def test_residual_critics_one_layer_after_the_other(n_critics: int) -> None:
    """Linear, x + MLP(LayerNorm(x)) per entry of net_arch, LayerNorm, linear; each network has its own parameters."""
    critic = LatentCritic(3, 2, [8, 5], nn.ReLU, n_critics, n_values=4, critic_arch="residual")
    for i, parameter in enumerate(critic.parameters()):  # of the norms, ones and zeros
        parameter.data += 0.1 * th.randn(parameter.shape, generator=seeded(i))
    first, *blocks, norm, last = critic.ensemble
    assert [tuple(block.branch[1].weight.shape) for block in blocks] == [(n_critics, 8, 8), (n_critics, 8, 5)]
    latents, actions = inputs()
    values = critic(latents, actions)

    def linear(layer: Any, x: th.Tensor, i: int) -> th.Tensor:
        return x @ layer.weight[i] + layer.bias[i, 0]

    def normed(layer: Any, x: th.Tensor, i: int) -> th.Tensor:
        return nn.functional.layer_norm(x, (8,), layer.weight[i, 0], layer.bias[i, 0])

    for i in range(n_critics):
        x = linear(first, th.cat([latents, actions], dim=1), i)
        for norm_in, widen, _, narrow in (block.branch for block in blocks):
            x = x + linear(narrow, linear(widen, normed(norm_in, x, i), i).relu(), i)
        th.testing.assert_close(values[:, i], linear(last, normed(norm, x, i), i))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_residual_critics_of_both_agents_train(algorithm: str, precision: str) -> None:
    policy_kwargs = {"net_arch": [16, 16], "critic_arch": "residual"}
    model = filled_model(algorithm, pixels=True, precision=precision, policy_kwargs=policy_kwargs)
    before = groups(model)
    train_once(model)
    assert {"critic", "curious critic"} <= moved(before, groups(model))


@pytest.mark.parametrize("policy_kwargs", [{"critic_arch": "resnet"}, {"critic_arch": "residual", "net_arch": []}])
def test_impossible_critic_arch_is_refused(policy_kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="critic_arch"):
        tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs)


@CRITICS
def test_twin_critic_takes_the_smallest_value(n_critics: int) -> None:
    """To bootstrap from and to maximise; the loss is half the sum of the mean squared errors, as SB3's."""
    critic = TwinCritic(3, 2, [8], nn.ReLU, n_critics)
    latents, actions = inputs()
    values = critic(latents, actions)
    smallest = th.tensor([[min(row.flatten().tolist())] for row in values])
    th.testing.assert_close(critic.target_values(latents, actions), smallest)
    th.testing.assert_close(critic.value(latents, actions), smallest)
    target = th.randn(6, 1, generator=seeded(3))
    expected = 0.5 * sum(nn.functional.mse_loss(values[:, i], target) for i in range(n_critics))
    th.testing.assert_close(critic.loss(latents, actions, target), expected)


@CRITICS
@pytest.mark.parametrize("dropped", [0, 1, 3])
def test_quantile_critic_drops_the_largest(n_critics: int, dropped: int) -> None:
    """Of all critics' quantiles together, so many per critic; the actor's value is the mean of all."""
    critic = QuantileCritic(3, 2, [8], nn.ReLU, n_critics, n_quantiles=4, top_quantiles_to_drop_per_net=dropped)
    latents, actions = inputs()
    every = critic(latents, actions).flatten(1)
    for kept, row in zip(critic.target_values(latents, actions), every, strict=True):
        assert kept.tolist() == sorted(row.tolist())[: (4 - dropped) * n_critics]
    th.testing.assert_close(critic.value(latents, actions), every.mean(dim=1, keepdim=True))


@pytest.mark.parametrize("dropped", [-1, 2])
def test_critic_keeps_some_of_its_quantiles(dropped: int) -> None:
    with pytest.raises(ValueError, match="must be at least 0, and leave some of n_quantiles=2"):
        QuantileCritic(3, 2, [8], nn.ReLU, 2, n_quantiles=2, top_quantiles_to_drop_per_net=dropped)
