"""One agent's actor, critics, targets and temperature: who owns what, and what the task's agent adopts of SB3."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from torch import nn
from updates_for_tests import ALGORITHMS, filled_model, train_once

from sb3_cure import CuReSAC
from sb3_cure.cure.policies import ActorCritic
from sb3_cure.networks import layers
from sb3_cure.networks.layers import set_mode

BASES = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)


def model_of(algorithm: Any, **kwargs: Any) -> Any:
    return tiny_model("MlpPolicy", VectorBox(), algorithm, **kwargs)


@BASES
def test_task_adopts_sb3s_temperature(algorithm: Any) -> None:
    """The very objects: the model's parameter and optimiser are the agent's; nothing is registered twice."""
    model = model_of(algorithm, ent_coef="auto_0.2")
    task = model.policy.task
    assert task.log_ent_coef is model.log_ent_coef
    assert task.ent_coef_optimizer is model.ent_coef_optimizer
    assert task.ent_coef_optimizer.param_groups[0]["params"][0] is model.log_ent_coef
    assert float(task.temperature()) == pytest.approx(0.2)
    model.learn(14)
    assert task.log_ent_coef is model.log_ent_coef and task.ent_coef_optimizer is model.ent_coef_optimizer
    assert float(model.log_ent_coef.detach().exp()) == float(task.temperature()) != pytest.approx(0.2, abs=1e-9)


@BASES
def test_task_adopts_a_fixed_temperature(algorithm: Any) -> None:
    model = model_of(algorithm, ent_coef=0.3)
    task = model.policy.task
    assert task.ent_coef_tensor is model.ent_coef_tensor
    assert task.log_ent_coef is None and task.ent_coef_optimizer is None
    model.learn(14)
    assert float(task.temperature()) == pytest.approx(0.3)


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
    """Of its own kind and value; one follows its own optimiser, the other stays."""
    model = model_of(algorithm, ent_coef=ent_coef, curiosity_ent_coef=curious)
    agents = (model.policy.task, model.policy.curious)
    assert tuple(float(agent.temperature()) for agent in agents) == pytest.approx(expected)
    assert agents[0].log_ent_coef is None or agents[0].log_ent_coef is not agents[1].log_ent_coef
    model.learn(14)
    kinds = (ent_coef, ent_coef if curious is None else curious)
    for agent, kind, start in zip(agents, kinds, expected, strict=True):
        learned = isinstance(kind, str)
        assert (agent.log_ent_coef is not None) == learned == (agent.ent_coef_optimizer is not None)
        assert (float(agent.temperature()) != pytest.approx(start, abs=1e-7)) == learned
        assert not agent.temperature().requires_grad


@pytest.mark.parametrize("agent", ["task", "curious"])
def test_temperature_of_one_agent_leaves_the_other_alone(agent: str) -> None:
    """Targets and actor losses of the one change with it, those of the other do not: the entropy is the agent's own."""
    names = ["critic_loss", "actor_loss"]
    logged = []
    for coefficient in (0.1, 2.0):
        values = {"ent_coef": 0.1, "curiosity_ent_coef": 0.1}
        values["ent_coef" if agent == "task" else "curiosity_ent_coef"] = coefficient
        logged.append(train_once(filled_model(learning_rate=0.0, **values)))
    for name in names:
        changes = {
            "task": logged[0][name] != logged[1][name],
            "curious": logged[0][f"curious_{name}"] != logged[1][f"curious_{name}"],
        }
        assert changes == {"task": agent == "task", "curious": agent == "curious"}, name


@BASES
def test_policy_names_are_the_task_agents(algorithm: Any) -> None:
    """``actor``, ``critic`` and ``critic_target`` are one and the same as the task's, in SB3's model, too."""
    model = model_of(algorithm)
    policy = model.policy
    assert policy.actor is model.actor is policy.task.actor
    assert policy.critic is model.critic is policy.task.critic
    assert policy.critic_target is model.critic_target is policy.task.critic_target
    assert policy.agents == {"task": policy.task, "curious": policy.curious}
    names = [name for name, _ in policy.named_parameters(remove_duplicate=False)]
    parameters = [id(parameter) for _, parameter in policy.named_parameters(remove_duplicate=False)]
    assert len(set(parameters)) == len(names)
    assert not any("ent_coef" in name for name in names)


@BASES
def test_agents_share_no_parameter_and_no_optimiser(algorithm: Any) -> None:
    """Nor with the encoder; each optimiser has just the parameters of its owner."""
    policy = model_of(algorithm).policy
    owners = [policy.srl, *(part for agent in policy.agents.values() for part in (agent.actor, agent.critic))]
    seen = {id(parameter) for parameter in policy.encoder.parameters()}
    for owner in owners:
        own = {id(parameter) for parameter in owner.parameters()}
        held = {id(p) for group in owner.optimizer.param_groups for p in group["params"]}
        assert own == held and not own & seen
        seen |= own
    assert len({id(owner.optimizer) for owner in owners}) == len(owners)


@BASES
def test_target_critics_begin_equal_and_never_learn(algorithm: Any) -> None:
    """A copy, without gradients and never in training mode."""
    policy = model_of(algorithm).policy
    for agent in policy.agents.values():
        pairs = list(zip(agent.critic.parameters(), agent.critic_target.parameters(), strict=True))
        assert all(th.equal(a, b) and a is not b and not b.requires_grad for a, b in pairs)
        policy.set_training_mode(True)
        assert agent.critic.training and agent.actor.training and not agent.critic_target.training
    assert not policy.encoder_target.training
    policy.set_training_mode(False)
    assert not policy.task.critic.training


def test_modes_change_as_torch_changes_them() -> None:
    """Of all modules, also of those that came later, and as a module that has a mind of its own will have it."""

    class Frozen(nn.Dropout):
        def train(self, mode: bool = True) -> "Frozen":
            return super().train(False)

    modules = nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.Dropout()), Frozen().eval())
    modules.register_module("missing", None)
    for mode in (False, True):
        set_mode(modules, mode)
        assert [module.training for module in modules.modules()] == [mode, mode, mode, mode, False]
    modules.eval().append(nn.Dropout())
    set_mode(modules, False)
    assert not modules[-1].training


def test_actions_are_those_of_the_log_probabilities() -> None:
    """Acting draws what learning takes for the policy's actions: SB3's squashed Gaussian, from the same stream."""
    model = model_of(CuReSAC)
    actor, features = model.policy.task.actor, th.randn(5, model.policy.encoder.trunk_dim)
    with th.no_grad():
        mean, log_std, _ = actor.get_action_dist_params(features)
        th.manual_seed(3)
        acted = actor(features)
        th.manual_seed(3)
        learned, _ = actor.action_log_prob(features)
        th.manual_seed(3)
        of_sb3 = actor.action_dist.actions_from_params(mean, log_std)
        th.testing.assert_close(actor(features, deterministic=True), th.tanh(mean))
    assert th.equal(acted, learned)
    th.testing.assert_close(acted, of_sb3)
    assert not th.equal(acted, th.tanh(mean))


def test_the_two_agents_begin_differently() -> None:
    """Equal weights would make the curious agent's exploration the task's."""
    policy = tiny_model("MlpPolicy", VectorBox()).policy
    for part in ("actor", "critic"):
        first, second = getattr(policy.task, part), getattr(policy.curious, part)
        weights = zip(first.named_parameters(), second.named_parameters(), strict=True)
        assert all(not th.equal(a, b) for (name, a), (_, b) in weights if name.endswith("weight") and a.dim() == 2)


@pytest.mark.parametrize("factor", [0.1, 2.0])
def test_learning_rate_reaches_every_optimiser(factor: float) -> None:
    """A schedule's value in everything but the temperatures, which follow it at their ratio."""
    model = tiny_model("MlpPolicy", VectorBox(), learning_rate=lambda left: 1e-3 * left, ent_coef_lr_factor=factor)
    policy = model.policy
    for agent in policy.agents.values():  # before the first update, too
        assert agent.ent_coef_optimizer.param_groups[0]["lr"] == pytest.approx(factor * 1e-3)
    model.learn(20)
    model._current_progress_remaining = 0.4
    model.train(1, 4)
    rate = 4e-4
    owners: list[Any] = [policy.srl, *(p for agent in policy.agents.values() for p in (agent.actor, agent.critic))]
    rates = [owner.optimizer.param_groups[0]["lr"] for owner in owners]
    assert rates == pytest.approx([rate] * 5)
    assert policy.encoder_update.learning_rate == pytest.approx(rate)
    temperatures = [agent.ent_coef_optimizer.param_groups[0]["lr"] for agent in policy.agents.values()]
    assert temperatures == pytest.approx([factor * rate] * 2)


def test_temperature_without_a_model() -> None:
    """An agent by itself: a learned or a fixed one, as SB3 reads ``ent_coef``."""
    policy = tiny_model("MlpPolicy", VectorBox(), curiosity=None).policy
    for ent_coef, start, learned in (
        ("auto", 1.0, True),
        ("auto_0.25", 0.25, True),
        (0.5, 0.5, False),
        ("0.5", 0.5, False),
    ):
        agent = ActorCritic(policy.actor, policy.critic)
        agent.set_temperature(ent_coef, 1e-3, th.device("cpu"))
        assert float(agent.temperature()) == pytest.approx(start)
        assert (agent.log_ent_coef is not None) == learned
        if learned:
            group = agent.ent_coef_optimizer.param_groups[0]
            assert (group["lr"], group["betas"]) == (1e-3, (0.5, 0.999))


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


def test_actors_and_critics_are_initialised_alike() -> None:
    """Orthogonal linear maps and zero biases in both agents (SAC-AE), not torch's default."""
    policy = tiny_model("CnnPolicy", PixelBox()).policy
    for network in (policy.actor, policy.critic, policy.curious.actor, policy.curious.critic):
        linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear | layers.EnsembleLinear)]
        assert len(linear) >= 2
        for layer in linear:
            weights = layer.weight.detach()
            for weight in weights if weights.dim() == 3 else [weights]:
                smaller = weight if len(weight) <= weight.shape[1] else weight.T
                th.testing.assert_close(smaller @ smaller.T, th.eye(len(smaller)), rtol=0, atol=1e-5)
            assert not layer.bias.any()


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_what_is_frozen_in_training_stays(update: str) -> None:
    """Also where the last update before left a gradient."""
    model = tiny_model("CnnPolicy", PixelBox(), update=update).learn(15)
    frozen = [model.policy.encoder.trunk[0], model.policy.srl.decoder, model.policy.critic.ensemble[0]]
    before = [parameter.clone() for part in frozen for parameter in part.requires_grad_(False).parameters()]
    model.learn(5, reset_num_timesteps=False)
    assert all(map(th.equal, before, (parameter for part in frozen for parameter in part.parameters())))
