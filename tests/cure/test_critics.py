"""Twin Q and truncated quantiles: targets, losses and values against loops, and actions in full precision."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_contrib.common.utils import quantile_huber_loss
from torch import nn
from updates_for_tests import ALGORITHMS, critic_values

from sb3_cure.cure.critics import LatentCritic, TruncatedQuantiles, TwinQ
from sb3_cure.networks import layers
from sb3_cure.networks.precision import compute_in

BASES = pytest.mark.parametrize("algorithm", ALGORITHMS)


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


def make(kind: type[TwinQ], n_critics: int = 2, n_quantiles: int = 4, dropped: int = 1) -> tuple[TwinQ, LatentCritic]:
    """Critics of 3 latents and 2 actions, for a model with this setting."""
    th.manual_seed(0)
    kwargs = {"n_quantiles": n_quantiles} if kind is TruncatedQuantiles else {}
    critic = kind.make(3, 2, [8, 8], nn.ReLU, n_critics=n_critics, **kwargs)
    return kind(SimpleNamespace(top_quantiles_to_drop_per_net=dropped)), critic


def inputs(batch: int = 6) -> tuple[th.Tensor, th.Tensor]:
    return th.randn(batch, 3, generator=seeded(1)), th.rand(batch, 2, generator=seeded(2)) * 2 - 1


@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_critics_are_separate_networks_of_latents_and_actions(n_critics: int) -> None:
    """[B, n_critics, n_values] in the networks' order; no parameter is shared."""
    latents, actions = inputs()
    for kind, n_values in ((TwinQ, 1), (TruncatedQuantiles, 4)):
        _, critic = make(kind, n_critics)
        values = critic(latents, actions)
        assert values.shape == (6, n_critics, n_values)
        for i, expected in enumerate(critic_values(critic, latents, actions)):
            th.testing.assert_close(values[:, i], expected)
        sizes = [layer.bias.numel() for layer in critic.ensemble if list(layer.parameters())]
        assert sum(p.numel() for p in critic.parameters()) == sum(sizes) + sum(
            layer.weight[0].numel() * n_critics for layer in critic.ensemble if list(layer.parameters())
        )


@BASES
def test_by_default_there_are_two_critics(algorithm: str) -> None:
    """With one value or 25 quantiles each, as in SB3 and sb3-contrib; of an agent and where they are made."""
    critic = tiny_model("MlpPolicy", VectorBox(), ALGORITHMS[algorithm]).policy.critic
    kind, n_values = {"sac": (TwinQ, 1), "tqc": (TruncatedQuantiles, 25)}[algorithm]
    for each, features_dim in ((critic, 8), (kind.make(3, 2, [8], nn.ReLU), 3)):
        assert each(th.zeros(6, features_dim), th.zeros(6, 2)).shape == (6, 2, n_values)


@pytest.mark.parametrize("n_critics", [1, 2])
def test_residual_critics_one_layer_after_the_other(n_critics: int) -> None:
    """Linear, x + MLP(LayerNorm(x)) per entry of net_arch, LayerNorm, linear; each network has its own parameters."""
    critic = LatentCritic(3, 2, [8, 5], nn.ReLU, n_critics, n_values=4, critic_arch="residual")
    for i, parameter in enumerate(critic.parameters()):  # of the norms, ones and zeros
        parameter.data += 0.1 * th.randn(parameter.shape, generator=seeded(i))
    first, *blocks, norm, last = critic.ensemble
    assert [tuple(block.branch[1].weight.shape) for block in blocks] == [(n_critics, 8, 8), (n_critics, 8, 5)]
    latents, actions = inputs()
    values = critic(latents, actions)
    assert values.shape == (6, n_critics, 4)

    def linear(layer: Any, x: th.Tensor, i: int) -> th.Tensor:
        return x @ layer.weight[i] + layer.bias[i, 0]

    def normed(layer: Any, x: th.Tensor, i: int) -> th.Tensor:
        return nn.functional.layer_norm(x, (8,), layer.weight[i, 0], layer.bias[i, 0])

    for i in range(n_critics):
        x = linear(first, th.cat([latents, actions], dim=1), i)
        for norm_in, widen, _, narrow in (block.branch for block in blocks):
            x = x + linear(narrow, linear(widen, normed(norm_in, x, i), i).relu(), i)
        th.testing.assert_close(values[:, i], linear(last, normed(norm, x, i), i))


@BASES
def test_residual_critics_train_and_load(algorithm: str, tmp_path: Path) -> None:
    """Every parameter of both agents' critics moves, in bf16, too; a loaded model goes on with the same values."""
    policy_kwargs = {"net_arch": [16, 16], "critic_arch": "residual"}
    for precision in ("fp32", "bf16"):
        arguments: dict[str, Any] = dict(precision=precision, policy_kwargs=policy_kwargs)
        model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], **arguments)
        before = {name: value.clone() for name, value in model.policy.state_dict().items()}
        model.learn(20)
        critics = [name for name in before if ".critic." in name]
        assert len(critics) == 2 * (2 + 2 * 6 + 2 + 2)
        assert not [name for name in critics if th.equal(before[name], model.policy.state_dict()[name])]
    model.save(tmp_path / "model")
    loaded = ALGORITHMS[algorithm].load(tmp_path / "model", env=model.env)
    latents, actions = th.randn(6, loaded.policy.encoder.features_dim), th.rand(6, 2)
    assert th.equal(loaded.policy.critic(latents, actions), model.policy.critic(latents, actions))
    assert loaded.learn(20)._n_updates > model._n_updates


def test_other_critic_arch_is_refused() -> None:
    """Also residual critics without a block, whose width nothing tells."""
    for policy_kwargs in ({"critic_arch": "resnet"}, {"critic_arch": "residual", "net_arch": []}):
        with pytest.raises(ValueError, match="critic_arch is 'res"):
            tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs)


@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_twin_q_takes_the_smallest_value(n_critics: int) -> None:
    """To bootstrap from and to maximise; the loss is half the sum of the mean squared errors, as SB3's."""
    critics, critic = make(TwinQ, n_critics)
    latents, actions = inputs()
    values = critic(latents, actions)
    smallest = th.tensor([[min(row.flatten().tolist())] for row in values])
    th.testing.assert_close(critics.next_values(critic, latents, actions), smallest)
    th.testing.assert_close(critics.value(critic, latents, actions), smallest)
    target = th.randn(6, 1, generator=seeded(3))
    expected = 0.5 * sum(nn.functional.mse_loss(values[:, i], target) for i in range(n_critics))
    th.testing.assert_close(critics.loss(values, target), expected)


@pytest.mark.parametrize("n_critics", [1, 2, 3])
@pytest.mark.parametrize("dropped", [0, 1, 3])
def test_largest_quantiles_are_dropped_from_the_target(n_critics: int, dropped: int) -> None:
    """Of all critics' quantiles together, so many per critic; read from the model when it is needed."""
    critics, critic = make(TruncatedQuantiles, n_critics, dropped=2)
    critics.model.top_quantiles_to_drop_per_net = dropped
    latents, actions = inputs()
    kept = critics.next_values(critic, latents, actions)
    for row, values in zip(kept, critic(latents, actions), strict=True):
        every = sorted(values.flatten().tolist())
        assert row.tolist() == every[: (4 - dropped) * n_critics]


def test_value_of_quantiles_is_their_mean() -> None:
    critics, critic = make(TruncatedQuantiles, 3)
    latents, actions = inputs()
    values = critics.value(critic, latents, actions)
    assert values.shape == (6, 1)
    th.testing.assert_close(values[:, 0], critic(latents, actions).flatten(1).mean(dim=1))


@pytest.mark.parametrize("n_critics, n_quantiles, n_targets", [(1, 1, 1), (2, 5, 8), (3, 4, 2)])
def test_quantile_huber_loss_in_loops(n_critics: int, n_quantiles: int, n_targets: int) -> None:
    """|tau - 1(d < 0)| Huber(d) over all pairs of targets and quantiles, their mean; as sb3-contrib's."""
    critics, _ = make(TruncatedQuantiles)
    values = 2 * th.randn(7, n_critics, n_quantiles, generator=seeded(0))
    target = 2 * th.randn(7, n_targets, generator=seeded(1))
    total = []
    for b in range(7):
        for c in range(n_critics):
            for i in range(n_quantiles):
                for j in range(n_targets):
                    d = float(target[b, j] - values[b, c, i])
                    huber = abs(d) - 0.5 if abs(d) > 1 else 0.5 * d * d
                    total.append(abs((i + 0.5) / n_quantiles - (d < 0)) * huber)
    assert float(critics.loss(values, target)) == pytest.approx(np.mean(total), rel=1e-5)
    theirs = quantile_huber_loss(values, target.unsqueeze(1), sum_over_quantiles=False)
    assert th.equal(critics.loss(values, target), theirs)


@given(st.integers(1, 4), st.integers(1, 6), st.integers(0, 5), st.integers(1, 5))
@settings(deadline=None, max_examples=40)
def test_target_never_exceeds_the_untruncated_mean(n_critics: int, n_quantiles: int, dropped: int, batch: int) -> None:
    """Dropping the largest makes it pessimistic, the more the more are dropped."""
    dropped = min(dropped, n_quantiles - 1)
    critics, critic = make(TruncatedQuantiles, n_critics, n_quantiles, dropped)
    latents, actions = inputs(batch)
    kept = critics.next_values(critic, latents, actions)
    assert kept.shape == (batch, n_critics * (n_quantiles - dropped))
    assert (kept.diff(dim=1) >= 0).all()
    mean = critic(latents, actions).flatten(1).mean(dim=1)
    assert (kept.mean(dim=1) <= mean + 1e-5).all()


# ---------------------------------------------------------------- precision


@BASES
@pytest.mark.parametrize("net_arch", [[], [16], [256, 256]])
@pytest.mark.parametrize("pixels", [True, False])
def test_bf16_tells_actions_apart_that_differ_in_the_third_digit(
    pixels: bool, net_arch: list[int], algorithm: str
) -> None:
    """Actions of .500 and .501 have different Q in both agents, by nearly as much as in fp32; so have vectors."""
    policy, env = ("CnnPolicy", PixelBox()) if pixels else ("MlpPolicy", VectorBox())
    arguments: dict[str, Any] = dict(precision="bf16", policy_kwargs={"net_arch": net_arch})
    model = tiny_model(policy, env, ALGORITHMS[algorithm], **arguments)
    batch = 512
    latents = th.rand(batch, model.policy.encoder.features_dim, generator=seeded(0)) * 2 - 1
    near = th.full((batch, 2), 0.5), th.full((batch, 2), 0.501)
    assert th.equal(near[0].bfloat16(), near[1].bfloat16())
    for agent in model.policy.agents.values():
        exact = agent.critic(latents, near[1]) - agent.critic(latents, near[0])
        with model._autocast():
            values = [agent.critic(latents, actions) for actions in near]
        assert values[0].dtype == th.float32
        changed = (values[0] != values[1]).float().mean()
        assert changed > 0.8
        found = values[1] - values[0]
        # Hidden layers compute in bf16: the differences are right on average, not each of them.
        assert float((found - exact).mean().abs()) < 0.5 * float(exact.abs().mean())


def test_first_layer_of_critics_is_exact_in_bf16(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit what it is in fp32; wide hidden layers in between are the only ones in bf16."""
    _, critic = make(TwinQ)
    formats: dict[int, list[th.dtype]] = {0: [], 1: [], 2: []}
    monkeypatch.setattr(layers, "WIDE", 0)  # as if they were wide
    linear = [layer for layer in critic.ensemble if isinstance(layer, layers.EnsembleLinear)]
    outputs: list[th.Tensor] = []
    linear[0].register_forward_hook(lambda module, args, out: outputs.append(out))
    for i, layer in enumerate(linear):
        layer.register_forward_hook(lambda module, args, out, i=i: formats[i].append(out.dtype))
    latents, actions = inputs()
    with compute_in(critic, "bf16"):
        critic(latents, actions)
    assert formats == {0: [th.float32], 1: [th.bfloat16], 2: [th.float32]}
    assert th.equal(outputs[0], linear[0](th.cat([latents, actions], dim=1).expand(2, -1, -1)))
    monkeypatch.undo()
    with compute_in(critic, "bf16"):
        critic(latents, actions)
    assert formats[1][-1] == th.float32


def test_bf16_tells_vectors_apart_that_differ_in_the_third_digit() -> None:
    """Angular velocities of 1.000 and 1.003 give two latents, and two actions."""
    model = tiny_model("MlpPolicy", VectorBox(), precision="bf16")
    near = th.full((1, 2), 1.0), th.full((1, 2), 1.003)
    with model._autocast(), th.no_grad():
        features = [model.policy.encoder.trunk(each) for each in near]
    assert features[0].dtype == th.float32
    assert not th.equal(*features)
