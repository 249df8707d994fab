"""Which loss moves which parameters, and by how much, for both ways of updating the encoder and both algorithms."""

from typing import Any

import pytest
import torch as th
from updates_for_tests import BATCH, StraightLine, equal, filled_model, groups, moved, prepare, sampled, train_once

from sb3_cure.networks.augmentations import Augmentation
from sb3_cure.srl import SRL_HEADS

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])

ENCODER = {"trunk", "projection"}
TASK_ACTOR = {"actor", "actor projection", "temperature"}
CURIOUS_ACTOR = {"curious actor", "curious actor projection", "curious temperature"}
EVERYTHING = ENCODER | {"head", "critic", "curious critic"} | TASK_ACTOR | CURIOUS_ACTOR

NO_HEAD = {"srl": None, "curiosity": None}
# Arguments, what of (srl, rl, actors) is updated, and what moves
TABLE: dict[str, tuple[dict[str, Any], tuple[bool, bool, bool], set[str]]] = {
    "srl": ({}, (True, False, True), ENCODER | {"head"}),
    "task critic": (NO_HEAD, (False, True, False), ENCODER | {"critic"}),
    "task critic and actor": (NO_HEAD, (False, True, True), ENCODER | {"critic"} | TASK_ACTOR),
    "curious critic": ({"task": False}, (False, True, False), ENCODER | {"curious critic"}),
    "curious critic and actor": ({"task": False}, (False, True, True), ENCODER | {"curious critic"} | CURIOUS_ACTOR),
    "curious critic, kept out": (
        {"task": False, "curiosity_encoder_grad": False},
        (False, True, True),
        {"curious critic"} | CURIOUS_ACTOR,
    ),
    "both critics": ({}, (False, True, False), ENCODER | {"critic", "curious critic"}),
    "srl and bonus": ({"curiosity": "bonus"}, (True, True, False), ENCODER | {"head", "critic"}),
    "srl and random": ({"curiosity": "random"}, (True, True, False), ENCODER | {"head", "critic"}),
    "all": ({}, (True, True, True), EVERYTHING),
    **{f"all, {srl}": ({"pixels": True, "srl": srl}, (True, True, True), EVERYTHING) for srl in SRL_HEADS},
    "all, tqc": ({"algorithm": "tqc"}, (True, True, True), EVERYTHING),
}


@UPDATES
@pytest.mark.parametrize("name", TABLE)
def test_losses_move_their_own_parameters(name: str, update: str) -> None:
    """One update with some of the losses moves exactly the groups of the table; targets have no gradient at all."""
    kwargs, learns, expected = TABLE[name]
    model = filled_model(**kwargs, update=update)
    before = groups(model)
    train_once(model, *learns)
    assert moved(before, groups(model)) == expected
    for target in (model.policy.encoder_target, *(agent.critic_target for agent in model.policy.agents.values())):
        assert all(not parameter.requires_grad and parameter.grad is None for parameter in target.parameters())


@UPDATES
@pytest.mark.parametrize("curiosity", ["separate", None])
@pytest.mark.parametrize("collector", ["curious", "random"])
def test_pretraining_moves_no_task_network(collector: str, curiosity: str | None, update: str) -> None:
    """It trains encoder and head, and with the curious collector the curious agent; what is saved keeps its names."""
    model = filled_model(curiosity=curiosity, update=update, learning_starts=10, gradient_steps=0)
    before, names = groups(model), (model._get_torch_save_params(), model.policy.state_dict().keys())
    model.gradient_steps = 1
    model.pretrain(16, collector=collector, keep_replay_buffer=True)
    after = groups(model)
    assert (model._get_torch_save_params(), model.policy.state_dict().keys()) == names
    curious = {"curious critic"} | CURIOUS_ACTOR if curiosity == "separate" and collector == "curious" else set()
    assert moved(before, after) == ENCODER | {"head"} | curious


@UPDATES
@pytest.mark.parametrize("task", [True, False])
def test_actors_touch_neither_encoder_critics_nor_head(update: str, task: bool) -> None:
    """With and without the actor's update these are the same bit for bit, gradients included."""
    kwargs: dict[str, Any] = {"curiosity": None} if task else {"task": False}
    after, gradients = [], []
    for actors in (True, False):
        model = filled_model(**kwargs, update=update)
        train_once(model, actors=actors)
        after.append(groups(model))
        agent = model.policy.task if task else model.policy.curious
        modules: Any = (model.policy.encoder, model.policy.srl, agent.critic)
        gradients.append([parameter.grad for module in modules for parameter in module.parameters()])
    assert moved(*after) == (TASK_ACTOR if task else CURIOUS_ACTOR)
    assert equal(*gradients)


@UPDATES
@pytest.mark.parametrize("srl", SRL_HEADS)
def test_head_learns_from_its_own_loss_alone(srl: str, update: str) -> None:
    """Its step is the same bit for bit, whether or not there are critics."""
    heads = []
    for rl in (True, False):
        model = filled_model(pixels=srl == "curl", srl=srl, update=update)
        train_once(model, rl=rl)
        heads.append(groups(model)["head"])
    assert equal(*heads)


@UPDATES
@pytest.mark.parametrize("encoder_grad", [True, False])
def test_curious_reward_trains_the_encoder_if_allowed(update: str, encoder_grad: bool) -> None:
    """Its size changes the curious critics, the encoder unless ``curiosity_encoder_grad=False``, nothing else."""
    after = []
    for beta in (0.5, 1.0):
        settings: dict[str, Any] = dict(curiosity_beta=beta, curiosity_encoder_grad=encoder_grad, update=update)
        model = filled_model(normalize_curiosity=False, **settings)
        train_once(model, actors=False)
        after.append(groups(model))
    assert moved(*after) == {"curious critic"} | (ENCODER if encoder_grad else set())


@UPDATES
@pytest.mark.parametrize("target", ["observation", "next_observation"])
@pytest.mark.parametrize(
    "reward",
    [{"intrinsic_kwargs": {"per_pixel": False}}, {"intrinsic_kwargs": {"per_pixel": True}}, {"intrinsic": "icm"}],
)
def test_rewards_come_before_steps_of_head_and_encoder(reward: dict[str, Any], target: str, update: str) -> None:
    """They are the same however long these steps are."""
    settings: dict[str, Any] = dict(curiosity_target=target, update=update, **reward)
    logged = [train_once(filled_model(learning_rate=rate, **settings)) for rate in (0.0, 0.1)]
    assert logged[0]["curious_reward_raw_mean"] == logged[1]["curious_reward_raw_mean"] > 0


WHOLE: dict[str, tuple[str, dict[str, Any]]] = {
    "sac": ("sac", {}),
    "sac, episodic curiosity": ("sac", {"curiosity_episodic": True}),
    "sac, images": ("sac", {"pixels": True}),
    "sac, next observation": ("sac", {"curiosity_target": "next_observation"}),
    "sac, next image": ("sac", {"pixels": True, "curiosity_target": "next_observation"}),
    "tqc": ("tqc", {}),
    "tqc, images": ("tqc", {"pixels": True}),
    "tqc, bonus": ("tqc", {"curiosity": "bonus"}),
    "curl": ("sac", {"pixels": True, "srl": "curl"}),
    "vae": ("tqc", {"srl": "vae", "srl_kwargs": {"beta": 0.03}}),
    "vae, shifts": ("sac", {"pixels": True, "srl": "vae", "srl_kwargs": {"beta": 0.03}, "augmentation": "shift"}),
    "spr": ("sac", {"pixels": True, "srl": "spr"}),
    "forward": ("tqc", {"srl": "forward"}),
    "inverse, shifts": ("sac", {"pixels": True, "srl": "inverse", "augmentation": "shift"}),
    "no head, shifts": ("sac", {"pixels": True, **NO_HEAD, "augmentation": "shift"}),
}


@UPDATES
@pytest.mark.parametrize("name", WHOLE)
def test_whole_update_equals_straight_line_code(name: str, update: str) -> None:
    """Every loss, and every parameter, target and temperature after it; nothing of the two agents is equal.

    Of a sequential update each part reads the encoder as the former part has left it. Without a head, on shifted
    images, this is DrQ (Yarats et al., 2021) with one view for the target and one for the critics (K = M = 1).
    """
    algorithm, kwargs = WHOLE[name]
    if algorithm == "tqc":
        kwargs = {**kwargs, "top_quantiles_to_drop_per_net": 1}
    model = filled_model(
        algorithm,
        learning_rate=0.03,
        tau=0.2,
        encoder_tau=0.6,
        gamma=0.95,
        curiosity_beta=0.7,
        curiosity_gamma=0.8,
        ent_coef="auto_0.3",
        curiosity_ent_coef="auto_0.02",
        update=update,
        **kwargs,
    )
    prepare(model)
    batch = sampled(model)
    assert 0 < float(batch.dones.sum()) < BATCH
    assert th.equal(batch.views, batch.observations) == (type(model.policy.augmentation) is Augmentation)
    written_out = StraightLine(model)
    expected = written_out.update(batch, update == "sequential")
    before = StraightLine(model).groups()
    logged = train_once(model)
    assert {name: logged[name] for name in expected} == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert expected["ent_coef"] == pytest.approx(0.3)
    assert expected.get("curious_ent_coef", 0.02) == pytest.approx(0.02)
    for old, actual, wanted in zip(before, StraightLine(model).groups(), written_out.groups(), strict=True):
        distance = float((wanted - old).norm())
        assert distance > 0
        assert float((actual - wanted).norm()) < 2e-3 * distance + 1e-6 * float(old.norm())


@pytest.mark.parametrize("update, expected", [("joint", {"now": 1, "next": 1}), ("sequential", {"now": 4, "next": 2})])
def test_encoder_runs_no_more_often_than_it_moves(update: str, expected: dict[str, int]) -> None:
    """Joint: one run for all losses and actors, one for next observations. Sequential: one more after each step.

    The task's actor and the curious critic, between which the encoder stands still, share theirs.
    """
    model = filled_model(update=update)
    batch = sampled(model)
    seen: list[th.Tensor] = []
    model.policy.encoder.trunk.register_forward_hook(lambda module, args, out: seen.append(args[0]))
    train_once(model)
    inputs = {"now": batch.observations, "next": batch.next_observations}
    assert {name: sum(th.equal(each, value) for each in seen) for name, value in inputs.items()} == expected
    assert len(seen) == sum(expected.values())


@pytest.mark.parametrize("srl", SRL_HEADS)
def test_joint_losses_equal_sequential_ones_where_nothing_moves(srl: str) -> None:
    """With learning rate 0 and equal seeds all that is logged is equal to the last bit, but for the encoder's steps."""
    logged = []
    for update in ("sequential", "joint"):
        model = filled_model(pixels=True, srl=srl, learning_rate=0.0, update=update)
        values = [train_once(model) for _ in range(3)][-1]
        logged.append({key: value for key, value in values.items() if not key.startswith("encoder_")})
    assert {"srl_loss", "critic_loss", "curious_critic_loss", "latent_grad_norm_srl"} <= logged[0].keys()
    assert logged[0] == logged[1]
