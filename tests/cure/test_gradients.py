"""Which loss moves which parameters, and by how much, for both ways of updating the encoder and both algorithms."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import VectorBox, tiny_model
from torch.nn import functional as F
from updates_for_tests import (
    ALGORITHMS,
    BATCH,
    StraightLine,
    equal,
    filled_model,
    groups,
    moved,
    prepare,
    sampled,
    train_once,
)

from sb3_cure import CuReSAC
from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import Augmentation
from sb3_cure.srl import CURL, RAE, SRL_HEADS, SRLOutput

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])
BASES = pytest.mark.parametrize("algorithm", ALGORITHMS)

ENCODER = {"trunk", "projection"}
TASK_ACTOR = {"actor", "actor projection", "temperature"}
CURIOUS_ACTOR = {"curious actor", "curious actor projection", "curious temperature"}

NO_HEAD = {"srl": None, "curiosity": None, "policy_kwargs": {"share_encoder": True}}
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
    "srl and task": ({"curiosity": None}, (True, True, False), ENCODER | {"head", "critic"}),
    "srl and bonus": ({"curiosity": "bonus"}, (True, True, False), ENCODER | {"head", "critic"}),
    "srl and random": ({"curiosity": "random"}, (True, True, False), ENCODER | {"head", "critic"}),
    "all": ({}, (True, True, True), ENCODER | {"head", "critic", "curious critic"} | TASK_ACTOR | CURIOUS_ACTOR),
}


def check_moves(model: CuReSAC, learns: tuple[bool, bool, bool], expected: set[str]) -> None:
    before = groups(model)
    train_once(model, *learns)
    assert moved(before, groups(model)) == expected
    for target in (model.policy.encoder_target, *(agent.critic_target for agent in model.policy.agents.values())):
        assert all(not parameter.requires_grad and parameter.grad is None for parameter in target.parameters())


@UPDATES
@pytest.mark.parametrize("name", TABLE)
def test_who_moves_what(name: str, update: str) -> None:
    """One update with some of the losses moves exactly the groups of the table; targets have no gradient at all."""
    kwargs, learns, expected = TABLE[name]
    check_moves(filled_model(**kwargs, update=update), learns, expected)


@UPDATES
@pytest.mark.parametrize("algorithm, srl", [("tqc", "curl"), *(("sac", srl) for srl in SRL_HEADS)])
def test_who_moves_what_from_images(algorithm: str, srl: str, update: str) -> None:
    model = filled_model(algorithm, pixels=True, srl=srl, update=update)
    check_moves(model, *TABLE["all"][1:])


@UPDATES
@pytest.mark.parametrize("curiosity", ["separate", None])
@pytest.mark.parametrize("collector", ["curious", "random"])
def test_pretraining_moves_no_task_network(collector: str, curiosity: str | None, update: str) -> None:
    """It trains encoder and head, and with the curious collector the curious agent, but nothing of the task."""
    model = filled_model(curiosity=curiosity, update=update, learning_starts=10, gradient_steps=0)
    before = groups(model)
    model.gradient_steps = 1
    model.pretrain(16, collector=collector)
    after = groups(model)
    assert before.keys() == after.keys()
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
        modules = (model.policy.encoder, model.policy.srl, agent.critic)
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
def test_curiosity_encoder_grad(update: str, encoder_grad: bool) -> None:
    """The size of the curious reward changes the curious agent, and the encoder only if it is allowed to."""
    after = []
    for beta in (0.5, 1.0):
        model = filled_model(curiosity_beta=beta, curiosity_encoder_grad=encoder_grad, update=update)
        train_once(model, actors=False)
        after.append(groups(model))
    assert moved(*after) == {"curious critic"} | (ENCODER if encoder_grad else set())


@UPDATES
def test_each_agent_sees_its_own_reward(update: str) -> None:
    """Scaling the task reward changes the task agent's losses only, scaling beta the curious agent's only."""
    losses = []
    for factor, beta in ((1, 1.0), (10, 1.0), (1, 2.0)):
        model = filled_model(learning_rate=0.0, curiosity_beta=beta, update=update)
        model.replay_buffer.rewards *= factor
        logged = train_once(model)
        losses.append((logged["critic_loss"], logged["curious_critic_loss"]))
    (task, curious), more_task, more_beta = losses
    assert more_task[0] > 2 * task and more_task[1] == curious
    assert more_beta[0] == task and more_beta[1] > 1.2 * curious


@UPDATES
@pytest.mark.parametrize(
    "algorithm, pixels, kwargs",
    [
        ("sac", False, {}),
        ("sac", False, {"curiosity_episodic": True}),
        ("sac", True, {}),
        ("tqc", False, {}),
        ("tqc", True, {}),
        ("tqc", False, {"curiosity": "bonus"}),
        ("sac", True, {"srl": "curl"}),
        ("tqc", False, {"srl": "vae", "srl_kwargs": {"beta": 0.03}}),
        ("sac", True, {"srl": "vae", "srl_kwargs": {"beta": 0.03}, "augmentation": "shift"}),
        ("tqc", False, {"srl": "spr"}),
        ("sac", True, {"srl": "spr"}),
        ("tqc", False, {"srl": "forward"}),
        ("sac", True, {"srl": "forward"}),
        ("tqc", False, {"srl": "inverse"}),
        ("sac", True, {"srl": "inverse", "augmentation": "shift"}),
        ("sac", True, {"srl": None, "curiosity": None, "augmentation": "shift"}),
    ],
    ids=lambda value: "-".join(str(each) for each in value.values()) if isinstance(value, dict) else str(value),
)
def test_whole_update_equals_straight_line_code(
    algorithm: str, pixels: bool, kwargs: dict[str, Any], update: str
) -> None:
    """Every loss, and every parameter, target and temperature after it; nothing of the two agents is equal.

    Of a sequential update each part reads the encoder as the former part has left it. Without a head, on shifted
    images, this is DrQ (Yarats et al., 2021) with one view for the target and one for the critics (K = M = 1).
    """
    model = filled_model(
        algorithm,
        pixels,
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
    if algorithm == "tqc":
        model.top_quantiles_to_drop_per_net = 1  # read when it is needed, not when the model is made
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


def test_dropped_quantiles_are_read_from_the_model_at_use() -> None:
    """The more are dropped, the lower the target: it shows in the very next update."""
    losses = []
    for dropped in (0, 4):
        model = filled_model("tqc", learning_rate=0.0)
        prepare(model)
        model.top_quantiles_to_drop_per_net = dropped
        losses.append(train_once(model)["critic_loss"])
    assert losses[0] != losses[1]


@pytest.mark.parametrize("srl", SRL_HEADS)
def test_joint_losses_equal_sequential_ones_where_nothing_moves(srl: str) -> None:
    """With learning rate 0 and equal seeds all that is logged is equal to the last bit, but for the shares."""
    logged = []
    for update in ("sequential", "joint"):
        model = filled_model(pixels=True, srl=srl, learning_rate=0.0, update=update)
        for _ in range(3):
            values = train_once(model)
        logged.append({key: value for key, value in values.items() if "share" not in key})
    assert {"srl_loss", "critic_loss", "curious_critic_loss", "curious_actor_loss"} <= logged[0].keys()
    assert logged[0] == logged[1]


@UPDATES
@BASES
@pytest.mark.parametrize(
    "kwargs, sources",
    [
        ({}, {"srl", "task", "curious"}),
        ({"curiosity_encoder_grad": False}, {"srl", "task"}),
        ({"task": False}, {"srl", "curious"}),
        (NO_HEAD, {"task"}),
    ],
    ids=["all", "curious-kept-out", "curious-only", "no-head"],
)
def test_shares_and_norms_of_the_sources_are_logged(
    kwargs: dict[str, Any], sources: set[str], update: str, algorithm: str
) -> None:
    """For just the losses that train the encoder; shares are positive and add up to 1."""
    logged = train_once(filled_model(algorithm, **kwargs, update=update))
    shares = {key.split("_")[-1]: value for key, value in logged.items() if key.startswith("encoder_share_")}
    norms = {key.split("_")[-1]: value for key, value in logged.items() if key.startswith("latent_grad_norm_")}
    assert shares.keys() == norms.keys() == sources
    assert sum(shares.values()) == pytest.approx(1)
    assert min(shares.values()) > 0
    assert min(norms.values()) > 0


class FaintRAE(RAE):
    """An autoencoder whose loss is a thousandth of what it should be."""

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        output = super().loss(batch, latents)
        return SRLOutput(1e-3 * output.loss, output.error)


def test_keys_of_curl_get_no_gradient() -> None:
    """CURL's W and anchors are trained as if the keys were constants; the momentum encoder is not trained."""
    model = filled_model(pixels=True, srl="curl")
    head, batch = model.policy.srl, sampled(model)
    assert isinstance(head, CURL)
    latents = model.policy.encoder(model.policy.augment(batch.observations)).detach().requires_grad_()
    th.manual_seed(2)
    loss = head.loss(batch, latents).loss
    anchors_grad, w_grad = th.autograd.grad(loss, [latents, head.W])
    th.manual_seed(2)
    keys = model.policy.encoder_target(model.policy.augment(batch.observations)).detach()
    probabilities = F.softmax(latents.detach() @ head.W.detach() @ keys.T, dim=1)
    residual = (probabilities - th.eye(BATCH)) / BATCH
    th.testing.assert_close(anchors_grad, residual @ keys @ head.W.detach().T, rtol=1e-4, atol=1e-7)
    th.testing.assert_close(w_grad, latents.detach().T @ residual @ keys, rtol=1e-4, atol=1e-7)
    for target in (model.policy.encoder_target, model.policy.encoder):
        assert all(parameter.grad is None for parameter in target.parameters())


# ---------------------------------------------------------------- how often what is updated


def counted(model: CuReSAC, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the updates that are made from now on."""
    done: list[str] = []
    for name in ("_update_srl", "_update_actor_critic", "_update_actor"):
        update = getattr(model, name)

        def note(*args: Any, name: str = name, update: Any = update) -> Any:
            if name != "_update_srl":
                done.append(f"{args[0]} {'critic' if name == '_update_actor_critic' else 'actor'}")
            elif args[2]:
                done.append("srl")
            return update(*args)

        monkeypatch.setattr(model, name, note)
    return done


@UPDATES
@pytest.mark.parametrize("period", [1, 3])
def test_alternating_updates_twice_per_gradient_step(period: int, update: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After whole periods head and critics were updated as often as simultaneously; phases come in turn."""
    counts = []
    for schedule in ("simultaneous", "alternating"):
        model = filled_model(srl_schedule=schedule, srl_period=period, update=update)
        done = counted(model, monkeypatch)
        model.train(4 * period, BATCH)
        assert model._n_updates == 4 * period
        counts.append({name: done.count(name) for name in ("srl", "task critic", "curious critic", "task actor")})
        updates = [name for name in done if name in ("srl", "task critic")]
    assert counts[0] == counts[1]
    assert updates == (["srl"] * 2 * period + ["task critic"] * 2 * period) * 2


@pytest.mark.parametrize("rl", [True, False])
def test_target_critics_follow_in_rl_updates_only(rl: bool) -> None:
    """In updates of the head alone critics stand still, and their targets with them; the target encoder follows."""
    model = filled_model(tau=0.1, encoder_tau=0.3)
    prepare(model)
    before = groups(model)
    train_once(model, rl=rl)
    targets = {"encoder target", "critic target", "curious critic target"}
    found = {name for name in moved(before, groups(model)) if name in targets}
    assert found == (targets if rl else {"encoder target"})


@pytest.mark.parametrize("interval", [1, 3])
def test_targets_follow_every_few_updates(interval: int) -> None:
    """Target critics after each ``interval``-th update of critics, the target encoder of any update."""
    model = filled_model(tau=0.1, encoder_tau=0.3, target_update_interval=interval)
    prepare(model)
    times: dict[str, list[int]] = {"encoder target": [], "critic target": [], "curious critic target": []}
    phases = [(True, True), (True, False), (True, True), (True, True), (True, False), (True, True)]
    for index, (srl, rl) in enumerate(phases):
        before = groups(model)
        model._phase = lambda srl=srl, rl=rl: (srl, rl)  # type: ignore[misc]
        model.train(1, BATCH)
        after = groups(model)
        for name in times:
            if not equal(before[name], after[name]):
                times[name].append(index)
    with_critics = [index for index, (_, rl) in enumerate(phases) if rl]
    assert times["encoder target"] == list(range(0, 6, interval))
    assert times["critic target"] == times["curious critic target"] == with_critics[::interval]


@pytest.mark.parametrize(("period", "interval"), [(None, 2), (1, 2), (2, 3), (3, 1)])
def test_actors_follow_every_few_updates_of_critics(
    period: int | None, interval: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the periods of SRL and RL: of n updates of the critics each ``interval``-th, the first one included."""
    kwargs = dict(srl_schedule="alternating", srl_period=period) if period else {}
    model = filled_model(learning_rate=0.0, actor_update_interval=interval, **kwargs)
    done = counted(model, monkeypatch)
    model.train(12, BATCH)
    for agent in ("task", "curious"):
        own = [name for name in done if name.startswith(agent)]
        critics = own.count(f"{agent} critic")
        expected = [
            name
            for index in range(critics)
            for name in [f"{agent} critic", f"{agent} actor"][: 1 + (index % interval == 0)]
        ]
        assert critics >= 9 and own == expected


@pytest.mark.parametrize("schedule", ["simultaneous", "alternating"])
def test_each_update_of_the_burst_updates_actors_and_targets(schedule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As SAC-AE's code; afterwards they follow their intervals again."""
    arguments: dict[str, Any] = dict(actor_update_interval=3, target_update_interval=3, srl_schedule=schedule)
    model = tiny_model("MlpPolicy", VectorBox(), warmup_updates=4, srl_period=2, learning_starts=10, **arguments)
    done = counted(model, monkeypatch)
    followed: list[tuple[bool, ...]] = []
    update_targets = model._update_targets

    def follow(learns_rl: bool) -> None:
        before = groups(model)
        update_targets(learns_rl)
        after = groups(model)
        names = ("encoder target", "critic target", "curious critic target")
        followed.append(tuple(not equal(before[name], after[name]) for name in names))

    monkeypatch.setattr(model, "_update_targets", follow)
    burst: list[Any] = []
    collect = model.collect_rollouts

    def collect_and_look(*args: Any, **kwargs: Any) -> Any:
        n = len(followed)
        rollout = collect(*args, **kwargs)
        if len(followed) > n:
            burst.append((list(done), list(followed)))
        return rollout

    monkeypatch.setattr(model, "collect_rollouts", collect_and_look)
    model.learn(17)
    ((names, targets),) = burst
    critics = names.count("task critic")
    assert critics == names.count("task actor") == names.count("curious actor") == 4
    assert all(encoder for encoder, _, _ in targets)
    assert sum(task for _, task, _ in targets) == sum(curious for *_, curious in targets) == 4
    later = done[len(names) :]
    assert 0 < later.count("task actor") < later.count("task critic")
