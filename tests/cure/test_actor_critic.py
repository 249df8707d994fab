"""One agent's actor, critics, targets and temperature: who owns what, and who learns from what."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from torch import nn
from updates_for_tests import ALGORITHMS, filled_model, train_once

from sb3_cure.networks.layers import EnsembleLinear, set_mode

BASES = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)


def model_of(algorithm: Any = ALGORITHMS["sac"], **kwargs: Any) -> Any:
    return tiny_model("MlpPolicy", VectorBox(), algorithm, **kwargs)


# ---------------------------------------------------------------- temperatures


@BASES
@pytest.mark.parametrize(
    ("ent_coef", "curious", "expected"),
    [
        ("auto_0.1", None, (0.1, 0.1)),
        ("auto_0.1", "auto_0.5", (0.1, 0.5)),
        ("auto", 0.4, (1.0, 0.4)),
        (0.2, "auto", (0.2, 1.0)),
        (0.2, None, (0.2, 0.2)),
        (0.2, 0.0, (0.2, 0.0)),
    ],
)
def test_each_agent_has_a_temperature_of_its_own(
    algorithm: Any, ent_coef: Any, curious: Any, expected: tuple[float, float]
) -> None:
    """Of its own kind and value, learned or fixed; SB3's attributes are the task's."""
    model = model_of(algorithm, ent_coef=ent_coef, curiosity_ent_coef=curious)
    task, second = model.policy.task, model.policy.curious
    assert tuple(float(agent.temperature()) for agent in (task, second)) == pytest.approx(expected)
    model.learn(14)
    kinds = (ent_coef, ent_coef if curious is None else curious)
    for agent, kind, start in zip((task, second), kinds, expected, strict=True):
        learned = isinstance(kind, str)
        assert (agent.log_ent_coef is not None) == learned == (agent.ent_coef_optimizer is not None)
        assert (float(agent.temperature()) != pytest.approx(start, abs=1e-7)) == learned
        assert not agent.temperature().requires_grad
    assert task.log_ent_coef is model.log_ent_coef and task.ent_coef_optimizer is model.ent_coef_optimizer
    if task.log_ent_coef is None:
        assert task.ent_coef_tensor is model.ent_coef_tensor
    else:
        assert task.ent_coef_optimizer.param_groups[0]["params"][0] is model.log_ent_coef is not second.log_ent_coef


@pytest.mark.parametrize("update", ["sequential", "joint"])
@pytest.mark.parametrize("hotter", ["task", "curious"])
def test_temperature_changes_only_its_own_losses(hotter: str, update: str) -> None:
    """Target of the critics, loss of the actor and of the temperature."""
    logged = []
    for coefficient in ("auto_0.1", "auto_2"):
        values = {"ent_coef": "auto_0.1", "curiosity_ent_coef": "auto_0.1"}
        values["ent_coef" if hotter == "task" else "curiosity_ent_coef"] = coefficient
        logged.append(train_once(filled_model(learning_rate=0.0, update=update, **values)))
    for name in ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef"):
        for agent, prefix in (("task", ""), ("curious", "curious_")):
            assert (logged[0][prefix + name] != logged[1][prefix + name]) == (agent == hotter), (agent, name)


def test_each_temperature_learns_from_its_own_actor() -> None:
    """An actor far too certain heats its own temperature, one far more random than wanted cools its own."""
    model = filled_model()
    agents = model.policy.agents
    # Outputs of `log_std` are squashed to [-10, 2]: the first is all but deterministic, the second about uniform.
    for agent, log_std in ((agents["task"], -10.0), (agents["curious"], 0.8)):
        agent.actor.log_std.weight.data.zero_()
        agent.actor.log_std.bias.data.fill_(log_std)
        agent.actor.mu.weight.data.zero_()
    model.target_entropy = -0.5
    before = {name: float(agent.temperature()) for name, agent in agents.items()}
    train_once(model)
    assert float(agents["task"].temperature()) > before["task"]
    assert float(agents["curious"].temperature()) < before["curious"]


# ---------------------------------------------------------------- who owns what


@BASES
def test_agents_own_their_parameters_and_optimizers(algorithm: Any) -> None:
    """Shared with nobody; the model's and the policy's ``actor`` and ``critic`` are the task's."""
    model = model_of(algorithm)
    policy = model.policy
    for name in ("actor", "critic", "critic_target"):
        assert getattr(policy, name) is getattr(model, name) is getattr(policy.task, name)
    owners = [policy.srl, *(part for agent in policy.agents.values() for part in (agent.actor, agent.critic))]
    seen = {id(parameter) for parameter in policy.encoder.parameters()}
    for owner in owners:
        own = {id(parameter) for parameter in owner.parameters()}
        held = {id(p) for group in owner.optimizer.param_groups for p in group["params"]}
        assert own == held and not own & seen
        seen |= own
    names, parameters = zip(*policy.named_parameters(remove_duplicate=False), strict=True)
    assert len(set(map(id, parameters))) == len(names), "saved once"


def test_agents_begin_with_different_orthogonal_weights() -> None:
    """Equal ones would make the curious agent's exploration the task's; biases are zero (SAC-AE)."""
    policy = tiny_model("CnnPolicy", PixelBox()).policy
    for part in ("actor", "critic"):
        layers: Any = [
            [layer for layer in getattr(agent, part).modules() if isinstance(layer, nn.Linear | EnsembleLinear)]
            for agent in policy.agents.values()
        ]
        assert len(layers[0]) >= 2
        for first, second in zip(*layers, strict=True):
            assert not th.equal(first.weight, second.weight)
            for layer in (first, second):
                weights = layer.weight.detach()
                for weight in weights if weights.dim() == 3 else [weights]:
                    smaller = weight if len(weight) <= weight.shape[1] else weight.T
                    th.testing.assert_close(smaller @ smaller.T, th.eye(len(smaller)), rtol=0, atol=1e-5)
                assert not layer.bias.any()


@BASES
def test_targets_begin_equal_and_never_train(algorithm: Any) -> None:
    policy = model_of(algorithm).policy
    pairs = [(agent.critic, agent.critic_target) for agent in policy.agents.values()]
    pairs.append((policy.encoder, policy.encoder_target))
    policy.set_training_mode(True)
    for source, target in pairs:
        parameters = zip(source.parameters(), target.parameters(), strict=True)
        assert all(th.equal(a, b) and a is not b and not b.requires_grad for a, b in parameters)
        assert source.training and not target.training
    policy.set_training_mode(False)
    assert not policy.encoder.training


def test_modes_change_as_torch_changes_them() -> None:
    """Of all modules, also of those that came later, and of one that overrides ``train``."""

    class Frozen(nn.Dropout):
        def train(self, mode: bool = True) -> "Frozen":
            return super().train(False)

    modules = nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.Dropout()), Frozen().eval())
    modules.register_module("missing", None)
    for mode in (False, True):
        set_mode(modules, mode)
        assert [module.training for module in modules.modules()] == [mode, mode, mode, mode, False]
    modules.append(nn.Dropout())
    set_mode(modules, False)
    assert not modules[-1].training


@pytest.mark.parametrize("factor", [0.1, 2.0])
def test_learning_rate_reaches_every_optimizer(factor: float) -> None:
    """A schedule's value in everything but the temperatures, which follow it at their ratio."""
    model = model_of(learning_rate=lambda left: 1e-3 * left, ent_coef_lr_factor=factor, intrinsic="rnd")
    policy = model.policy
    for agent in policy.agents.values():  # before the first update, too
        assert agent.ent_coef_optimizer.param_groups[0]["lr"] == pytest.approx(factor * 1e-3)
    model.learn(20)
    model._current_progress_remaining = 0.4
    model.train(1, 4)
    owners: list[Any] = [part for agent in policy.agents.values() for part in (agent.actor, agent.critic)]
    rates = [owner.optimizer.param_groups[0]["lr"] for owner in (policy.srl, policy.intrinsic, *owners)]
    assert [*rates, policy.encoder_update.learning_rate] == pytest.approx([4e-4] * 7)
    temperatures = [agent.ent_coef_optimizer.param_groups[0]["lr"] for agent in policy.agents.values()]
    assert temperatures == pytest.approx([factor * 4e-4] * 2)


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_parameters_frozen_in_training_stay(update: str) -> None:
    """Also where the last update left a gradient."""
    model = tiny_model("CnnPolicy", PixelBox(), update=update).learn(15)
    frozen = [model.policy.encoder.trunk[0], model.policy.srl.decoder, model.policy.critic.ensemble[0]]
    before = [parameter.clone() for part in frozen for parameter in part.requires_grad_(False).parameters()]
    model.learn(5, reset_num_timesteps=False)
    assert all(map(th.equal, before, (parameter for part in frozen for parameter in part.parameters())))


# ---------------------------------------------------------------- the actor


def test_acting_and_learning_draw_the_same_actions() -> None:
    """SB3's squashed Gaussian, from the same stream, with its log-probabilities."""
    model = model_of()
    actor, features = model.policy.actor, th.randn(5, model.policy.encoder.trunk_dim)
    with th.no_grad():
        mean, log_std, _ = actor.get_action_dist_params(features)
        th.manual_seed(3)
        acted = actor(features)
        th.manual_seed(3)
        learned, log_prob = actor.action_log_prob(features)
        th.manual_seed(3)
        of_sb3, log_prob_of_sb3 = actor.action_dist.log_prob_from_params(mean, log_std)
        th.testing.assert_close(actor(features, deterministic=True), th.tanh(mean))
    assert th.equal(acted, learned) and not th.equal(acted, th.tanh(mean))
    th.testing.assert_close(acted, of_sb3)
    th.testing.assert_close(log_prob[:, 0], log_prob_of_sb3)


def test_log_std_is_rescaled_not_clamped() -> None:
    """Within [-10, 2] (the paper's bounds) for any features, the middle at 0, with a gradient almost everywhere."""
    actor = tiny_model("CnnPolicy", PixelBox()).policy.actor
    features = th.rand(64, actor.features_extractor.linear.in_features, generator=th.Generator().manual_seed(0))
    raw = actor.log_std(actor.latent_pi(actor.features_extractor(features))).detach()
    _, log_std, _ = actor.get_action_dist_params(features)
    th.testing.assert_close(log_std.detach(), -4 + 6 * raw.tanh())
    log_std.sum().backward()
    assert float(actor.log_std.bias.grad.abs().min()) > 0
    with th.no_grad():
        actor.log_std.weight.mul_(1e3)
        extreme = actor.get_action_dist_params(features)[1]
    assert -10 <= float(extreme.min()) < -9.99
    assert 1.99 < float(extreme.max()) <= 2
