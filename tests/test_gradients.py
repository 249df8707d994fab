"""Which loss moves which parameters, and by how much, for both ways of updating the encoder."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.nn import functional as F

from sb3_cure import CuReSAC
from sb3_cure.srl import CURL, RAE, SRLOutput

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])
HEADS = pytest.mark.parametrize("srl", ["rae", "curl"])
#: Number of the update: actors follow in every second one; alternating phases are of 100 steps
WITH_ACTORS, WITHOUT_ACTORS = 0, 1
RL_WITH_ACTORS, RL_WITHOUT_ACTORS = 100, 101

ENCODER = {"trunk", "projection"}
TASK_ACTOR = {"actor", "actor projection", "temperature"}
CURIOUS_ACTOR = {"curious actor", "curious actor projection", "curious temperature"}


def filled_model(**kwargs: Any) -> CuReSAC:
    """A model with random transitions in its buffer that has not been trained.

    Plain gradient descent, because Adam would move every parameter by the same distance; targets do not follow, so
    that only a gradient could move them.
    """
    defaults = dict(learning_starts=40, learning_rate=0.1, tau=0.0, encoder_tau=0.0, curiosity_prob=0.0)
    policy_kwargs = {"optimizer_class": th.optim.SGD, **kwargs.pop("policy_kwargs", {})}
    model = tiny_model("CnnPolicy", PixelBox(), policy_kwargs=policy_kwargs, **{**defaults, **kwargs})
    return model.learn(40)


def train_once(model: CuReSAC, n_updates: int) -> dict[str, float]:
    """The ``n_updates``-th update, on a batch and with noise that depend on nothing else.

    :return: What was logged
    """
    model._n_updates = n_updates
    np.random.seed(1)
    th.manual_seed(1)
    model.logger.name_to_value.clear()
    if model.srl_schedule == "simultaneous":
        model.train(1, batch_size=8)
    else:  # one of the two updates of a step
        model._n_updates, model._part = 100 * (n_updates // 100), n_updates % 100
        model._gradient_step(model.replay_buffer.sample(8))
    return {key: float(value) for key, value in model.logger.name_to_value.items()}


def groups(model: CuReSAC) -> dict[str, list[th.Tensor]]:
    """Everything that is trained, by its role; copied."""
    policy = model.policy
    modules: dict[str, Any] = {
        "trunk": policy.encoder.trunk,
        "projection": policy.encoder.projection,
        "head": policy.srl,
        "critic": policy.critic,
        "curious critic": policy.curious_critic,
        "encoder target": policy.encoder_target,
        "critic target": policy.critic_target,
        "curious critic target": policy.curious_critic_target,
    }
    parameters = {name: list(module.parameters()) for name, module in modules.items() if module is not None}
    parameters["temperature"] = [model.log_ent_coef]
    if model.curious_log_ent_coef is not None:
        parameters["curious temperature"] = [model.curious_log_ent_coef]
    for name, actor in (("actor", policy.actor), ("curious actor", policy.curious_actor)):
        if actor is not None:
            own = list(actor.features_extractor.parameters())
            parameters[f"{name} projection"] = own
            parameters[name] = [p for p in actor.parameters() if all(p is not q for q in own)]
    return {name: [p.detach().clone() for p in tensors] for name, tensors in parameters.items()}


def equal(first: list[th.Tensor], second: list[th.Tensor]) -> bool:
    return all(th.equal(a, b) for a, b in zip(first, second, strict=True))


def moved(before: dict[str, list[th.Tensor]], after: dict[str, list[th.Tensor]]) -> set[str]:
    """Names of the groups that moved; each moves as a whole or not at all."""
    result = set()
    for name in before:
        changes = [not th.equal(a, b) for a, b in zip(before[name], after[name], strict=True)]
        assert len(set(changes)) == 1, (name, changes)
        if changes[0]:
            result.add(name)
    return result


NO_HEAD = {"srl": None, "curiosity": None, "policy_kwargs": {"share_encoder": True}}
CURIOUS_ONLY = {"task": False, "srl_schedule": "alternating"}
TABLE: dict[str, tuple[dict[str, Any], int, set[str]]] = {
    "srl": ({"srl_schedule": "alternating"}, WITH_ACTORS, ENCODER | {"head"}),
    "task critic": (NO_HEAD, WITHOUT_ACTORS, ENCODER | {"critic"}),
    "task critic and actor": (NO_HEAD, WITH_ACTORS, ENCODER | {"critic"} | TASK_ACTOR),
    "curious critic": (CURIOUS_ONLY, RL_WITHOUT_ACTORS, ENCODER | {"curious critic"}),
    "curious critic and actor": (CURIOUS_ONLY, RL_WITH_ACTORS, ENCODER | {"curious critic"} | CURIOUS_ACTOR),
    "curious critic, kept out": (
        {**CURIOUS_ONLY, "curiosity_encoder_grad": False},
        RL_WITH_ACTORS,
        {"curious critic"} | CURIOUS_ACTOR,
    ),
    "both critics": ({"srl_schedule": "alternating"}, RL_WITHOUT_ACTORS, ENCODER | {"critic", "curious critic"}),
    "srl and task": ({"curiosity": None}, WITHOUT_ACTORS, ENCODER | {"head", "critic"}),
    "srl and bonus": ({"curiosity": "bonus"}, WITHOUT_ACTORS, ENCODER | {"head", "critic"}),
    "srl and random": ({"curiosity": "random"}, WITHOUT_ACTORS, ENCODER | {"head", "critic"}),
    "srl and curious": ({"task": False}, WITHOUT_ACTORS, ENCODER | {"head", "curious critic"}),
    "all": ({}, WITH_ACTORS, ENCODER | {"head", "critic", "curious critic"} | TASK_ACTOR | CURIOUS_ACTOR),
}


@UPDATES
@HEADS
@pytest.mark.parametrize("name", TABLE)
def test_who_moves_what(name: str, srl: str, update: str) -> None:
    """One update with some of the losses moves exactly the groups of the table; targets have no gradient at all."""
    kwargs, n_updates, expected = TABLE[name]
    model = filled_model(**{"srl": srl, **kwargs}, update=update)
    before = groups(model)
    train_once(model, n_updates)
    assert moved(before, groups(model)) == expected
    for target in (model.policy.encoder_target, model.policy.critic_target, model.policy.curious_critic_target):
        if target is not None:
            assert all(not parameter.requires_grad and parameter.grad is None for parameter in target.parameters())


@UPDATES
@pytest.mark.parametrize("curiosity", ["separate", None])
@pytest.mark.parametrize("collector", ["curious", "random"])
def test_pretraining_moves_no_task_network(collector: str, curiosity: str | None, update: str) -> None:
    """It trains encoder and head, and with the curious collector the curious agent, but nothing of the task."""
    model = filled_model(curiosity=curiosity, update=update, learning_starts=10, gradient_steps=0)
    before = groups(model)
    model.gradient_steps = 1
    model.pretrain(30, collector=collector)
    after = groups(model)
    assert before.keys() == after.keys()
    curious = {"curious critic"} | CURIOUS_ACTOR if curiosity == "separate" and collector == "curious" else set()
    assert moved(before, after) == ENCODER | {"head"} | curious


@UPDATES
@pytest.mark.parametrize("task", [True, False])
def test_actors_do_not_touch_what_critics_and_head_train(update: str, task: bool) -> None:
    """With and without the actor's update encoder, head and critics are the same bit for bit, gradients included."""
    kwargs: dict[str, Any] = {"curiosity": None} if task else {"task": False}
    after, gradients = [], []
    for n_updates in (WITH_ACTORS, WITHOUT_ACTORS):
        model = filled_model(**kwargs, update=update)
        train_once(model, n_updates)
        after.append(groups(model))
        critic = model.policy.critic if task else model.policy.curious_critic
        modules = (model.policy.encoder, model.policy.srl, critic)
        gradients.append([parameter.grad for module in modules for parameter in module.parameters()])
    assert moved(*after) == (TASK_ACTOR if task else CURIOUS_ACTOR)
    assert equal(*gradients)


@UPDATES
@HEADS
def test_the_head_learns_from_its_own_loss_alone(srl: str, update: str) -> None:
    """Its step is the same bit for bit, whether or not there are critics."""
    heads = []
    for schedule in ("simultaneous", "alternating"):
        model = filled_model(srl=srl, srl_schedule=schedule, update=update)
        train_once(model, WITH_ACTORS)
        heads.append(groups(model)["head"])
    assert equal(*heads)


@UPDATES
@pytest.mark.parametrize("encoder_grad", [True, False])
def test_curiosity_encoder_grad(update: str, encoder_grad: bool) -> None:
    """The size of the curious reward changes the curious agent, and the encoder only if it is allowed to."""
    after = []
    for beta in (0.5, 1.0):
        model = filled_model(curiosity_beta=beta, curiosity_encoder_grad=encoder_grad, update=update)
        train_once(model, WITHOUT_ACTORS)
        after.append(groups(model))
    assert moved(*after) == {"curious critic"} | (ENCODER if encoder_grad else set())


@UPDATES
def test_each_agent_sees_its_own_reward(update: str) -> None:
    """Scaling the task reward changes the task agent's losses only, scaling beta the curious agent's only."""
    losses = []
    for factor, beta in ((1, 1.0), (10, 1.0), (1, 2.0)):
        model = filled_model(learning_rate=0.0, curiosity_beta=beta, update=update)
        model.replay_buffer.rewards *= factor
        logged = train_once(model, WITH_ACTORS)
        losses.append((logged["train/critic_loss"], logged["train/curious_critic_loss"]))
    (task, curious), more_task, more_beta = losses
    assert more_task[0] > 2 * task and more_task[1] == curious
    assert more_beta[0] == task and more_beta[1] > 1.2 * curious


def straight_line(
    model: CuReSAC, batch: ReplayBufferSamples, agents: tuple[str, ...] = ("", "curious_")
) -> dict[str, th.Tensor]:
    """Losses of one update of the autoencoder and of the agents, written out from the papers.

    Nothing moves in between (as if all learning rates were 0). Noise is drawn in the order of Algorithm 1. The losses
    that train the encoder keep their graph.

    :param agents: The prefixes of those that update, in this order
    """
    policy = model.policy
    obs, next_obs = batch.observations.float() / 255, batch.next_observations.float() / 255
    with th.no_grad():
        next_latents = policy.encoder_target(next_obs)
        next_features = policy.encoder.trunk(next_obs)
        features = policy.encoder.trunk(obs)
    latents = policy.encoder(obs)
    dithered = policy.srl.target(batch.observations, dither=True)
    errors = ((policy.srl.decoder(latents) - dithered) ** 2).mean(dim=(1, 2, 3))
    result = {"srl_loss": errors.mean() + 1e-6 * 0.5 * (latents**2).sum(dim=1).mean()}
    errors = errors.detach()
    standardised = (errors - errors.mean()) / errors.std(unbiased=False)
    rewards = {"": batch.rewards[:, 0], "curious_": model.curiosity_beta * standardised}
    gammas = {"": model.gamma, "curious_": model.curiosity_gamma}
    log_alphas = {"": model.log_ent_coef, "curious_": model.curious_log_ent_coef}
    for agent in agents:
        actor, critic, critic_target = (getattr(policy, agent + name) for name in ("actor", "critic", "critic_target"))
        with th.no_grad():
            alpha = log_alphas[agent].exp()
            next_actions, next_log_prob = actor.action_log_prob(next_features)
            next_q = th.minimum(*[q[:, 0] for q in critic_target(next_latents, next_actions)])
            value = next_q - alpha * next_log_prob
            ends = batch.dones[:, 0] if agent == "" else 0  # a curious return goes on after terminations
            target = rewards[agent] + gammas[agent] * (1 - ends) * value
        first, second = (q[:, 0] for q in critic(latents, batch.actions))
        result[f"{agent}critic_loss"] = 0.5 * (((first - target) ** 2).mean() + ((second - target) ** 2).mean())
        with th.no_grad():
            actions, log_prob = actor.action_log_prob(features)
            q = th.minimum(*[q[:, 0] for q in critic(latents, actions)])
            result[f"{agent}actor_loss"] = (alpha * log_prob - q).mean()
            # Target entropy: minus the number of actions.
            result[f"{agent}ent_coef_loss"] = -(log_alphas[agent] * (log_prob - 2)).mean()
    return result


def sampled(model: CuReSAC) -> ReplayBufferSamples:
    """The batch that ``train_once`` draws, with torch's generator where it begins."""
    np.random.seed(1)
    batch = model.replay_buffer.sample(8)
    th.manual_seed(1)
    return batch


@th.no_grad()
def prepare(model: CuReSAC) -> None:
    """Let some transitions end an episode, errors differ between observations, targets from what they follow."""
    for parameter in model.policy.srl.parameters():
        parameter.normal_(std=0.3, generator=th.Generator().manual_seed(parameter.numel()))
    model.replay_buffer.dones[::3] = 1
    model.replay_buffer.timeouts[:] = 0
    for target in (model.policy.encoder_target, model.policy.critic_target, model.policy.curious_critic_target):
        for parameter in target.parameters():
            parameter.mul_(1.1)
    if model.curious_log_ent_coef is not None:
        model.curious_log_ent_coef += 0.7  # so that no agent's temperature stands for the other's


@UPDATES
def test_losses_against_straight_line_code(update: str) -> None:
    """RAE; critics, actors and temperatures of SAC, the curious agent's with the standardised SRL error."""
    model = filled_model(
        learning_rate=0.0, curiosity_beta=0.7, curiosity_gamma=0.8, gamma=0.95, ent_coef="auto_0.3", update=update
    )
    prepare(model)
    batch = sampled(model)
    assert 0 < float(batch.dones.sum()) < 8
    expected = {name: float(value.detach()) for name, value in straight_line(model, batch).items()}
    logged = train_once(model, WITH_ACTORS)
    assert {name: logged[f"train/{name}"] for name in expected} == pytest.approx(expected, rel=1e-4, abs=1e-6)


ALONE: dict[str, tuple[dict[str, Any], int, tuple[str, ...]]] = {
    "srl_loss": ({}, WITH_ACTORS, ()),
    "critic_loss": ({"curiosity_encoder_grad": False}, RL_WITH_ACTORS, ("",)),
    "curious_critic_loss": ({"task": False}, RL_WITH_ACTORS, ("curious_",)),
}


@UPDATES
@pytest.mark.parametrize("loss", ALONE)
def test_size_of_the_encoders_step(loss: str, update: str) -> None:
    """Gradient descent on the one loss that trains it, back to the first convolution; joint: scaled to unit norm."""
    kwargs, n_updates, agents = ALONE[loss]
    model = filled_model(srl_schedule="alternating", update=update, **kwargs)
    prepare(model)
    encoder = list(model.policy.encoder.parameters())
    batch = sampled(model)
    gradients = th.autograd.grad(straight_line(model, batch, agents)[loss], encoder)
    before = [parameter.detach().clone() for parameter in encoder]
    train_once(model, n_updates)
    norm = 1.0
    if update == "joint":
        (norm,) = map(float, model.policy.encoder_optimizer.gradient_norms.values())
    for parameter, old, gradient in zip(encoder, before, gradients, strict=True):
        expected = old - 0.1 * gradient / norm
        distance = float((expected - old).norm())
        assert distance > 0
        assert float((parameter.detach() - expected).norm()) < 1e-3 * distance + 1e-6 * float(old.norm())


@HEADS
def test_joint_losses_equal_sequential_ones_where_nothing_moves(srl: str) -> None:
    """With learning rate 0 and equal seeds all that is logged is equal to the last bit, but for the shares."""
    logged = []
    for update in ("sequential", "joint"):
        model = tiny_model("CnnPolicy", PixelBox(), srl=srl, learning_rate=0.0, update=update)
        model.learn(30, log_interval=10**9)
        assert model._n_updates == 20
        values = {key: float(value) for key, value in model.logger.name_to_value.items() if key.startswith("train/")}
        logged.append({key: value for key, value in values.items() if "share" not in key})
    losses = {f"train/{name}" for name in ("srl_loss", "critic_loss", "curious_critic_loss", "curious_actor_loss")}
    assert losses <= logged[0].keys()
    assert logged[0] == logged[1]


@UPDATES
@HEADS
@pytest.mark.parametrize(
    "kwargs, sources",
    [
        ({}, {"srl", "task", "curious"}),
        ({"curiosity_encoder_grad": False}, {"srl", "task"}),
        ({"task": False}, {"srl", "curious"}),
        ({"curiosity": None}, {"srl", "task"}),
        (NO_HEAD, {"task"}),
    ],
    ids=["all", "curious-kept-out", "curious-only", "no-curiosity", "no-head"],
)
def test_shares_and_norms_of_the_sources_are_logged(
    srl: str, kwargs: dict[str, Any], sources: set[str], update: str
) -> None:
    """For just the losses that train the encoder; shares are positive and add up to 1."""
    model = filled_model(**{"srl": srl, **kwargs}, update=update)
    logged = train_once(model, WITHOUT_ACTORS)
    shares = {key.split("_")[-1]: value for key, value in logged.items() if key.startswith("train/encoder_share_")}
    norms = {key.split("_")[-1]: value for key, value in logged.items() if key.startswith("train/latent_grad_norm_")}
    assert shares.keys() == norms.keys() == sources
    assert sum(shares.values()) == pytest.approx(1)
    assert min(shares.values()) > 0
    assert min(norms.values()) > 0


class FaintRAE(RAE):
    """An autoencoder whose loss is a hundredth of what it should be."""

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        output = super().loss(batch, latents)
        return SRLOutput(1e-2 * output.loss, output.error)


@UPDATES
def test_a_drowned_head_is_seen(update: str) -> None:
    """Its share of the sources' gradients is next to nothing, and logged so."""
    faint = train_once(filled_model(srl=FaintRAE, update=update), WITHOUT_ACTORS)
    assert faint["train/latent_grad_norm_srl"] < 1e-4 * faint["train/latent_grad_norm_task"]
    assert faint["train/encoder_share_srl"] < 1e-4


def test_keys_get_no_gradient() -> None:
    """CURL's W and anchors are trained as if the keys were constants; the momentum encoder is not trained."""
    model = filled_model(srl="curl")
    head, batch = model.policy.srl, sampled(model)
    assert isinstance(head, CURL)
    latents = model.policy.encoder(model.policy.augment(batch.observations)).detach().requires_grad_()
    th.manual_seed(2)
    loss = head.loss(batch, latents).loss
    anchors_grad, w_grad = th.autograd.grad(loss, [latents, head.W])
    th.manual_seed(2)
    keys = model.policy.encoder_target(model.policy.augment(batch.observations)).detach()
    probabilities = F.softmax(latents.detach() @ head.W.detach() @ keys.T, dim=1)
    residual = (probabilities - th.eye(8)) / 8
    th.testing.assert_close(anchors_grad, residual @ keys @ head.W.detach().T, rtol=1e-4, atol=1e-7)
    th.testing.assert_close(w_grad, latents.detach().T @ residual @ keys, rtol=1e-4, atol=1e-7)
    for target in (model.policy.encoder_target, model.policy.encoder):
        assert all(parameter.grad is None for parameter in target.parameters())


@pytest.mark.parametrize(("period", "interval"), [(1, 1), (1, 2), (2, 4), (3, 2), (100, 2)])
def test_actors_follow_every_few_updates_of_their_critics(
    period: int, interval: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the periods of SRL and RL: of n updates of the critics each ``interval``-th, the first one included."""
    kwargs: dict[str, Any] = dict(srl_schedule="alternating", srl_period=period, actor_update_interval=interval)
    model = filled_model(learning_rate=0.0, **kwargs)
    done: list[str] = []
    for name in ("_update_actor_critic", "_update_actor"):
        update = getattr(model, name)

        def note(agent: Any, *args: Any, name: str = name, update: Any = update) -> None:
            done.append(name + agent.name)
            update(agent, *args)

        monkeypatch.setattr(model, name, note)
    model.train(max(4 * interval, 2 * period), batch_size=4)
    for agent in ("task", "curious"):
        own = [name for name in done if name.endswith(agent)]
        critics = own.count("_update_actor_critic" + agent)
        expected = [
            name
            for index in range(critics)
            for name in ["_update_actor_critic", "_update_actor"][: 1 + (index % interval == 0)]
        ]
        assert critics >= 4 and own == [name + agent for name in expected]
