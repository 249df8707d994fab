"""What a head is given, and what is done with what it returns."""

import copy
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import sensor_model
from envs_for_tests import PixelBox, VectorBox, tiny_model
from torch import nn
from updates_for_tests import BATCH, equal, filled_model, groups, moved, train_once

from sb3_cure.data.samples import Samples
from sb3_cure.networks.encoders import Encoder
from sb3_cure.srl import RAE, SRL_HEADS, SRLHead, SRLOutput, get_srl_class, heads_by_key

UPDATES = pytest.mark.parametrize("update", ["joint", "sequential"])
ENCODER = {"trunk", "projection"}
AGENTS = {"critic", "actor", "actor projection", "temperature"}
BOTH_AGENTS = AGENTS | {f"curious {name}" for name in AGENTS}


class Positions(SRLHead):
    """A user's head: draws a vector from the latents."""

    def __init__(self, encoder: Encoder, observation_space: Any, width: int = 8):
        super().__init__(encoder, observation_space)
        size = observation_space.shape[0]
        self.decode = nn.Sequential(nn.Linear(encoder.features_dim, width), nn.ReLU(), nn.Linear(width, size))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        error = (self.decode(latents) - batch.views).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


class Forward(SRLHead):
    """Predicts the next latents, which get a gradient, too; keeps what it was given."""

    needs_next_latents = True

    def __init__(self, encoder: Encoder, observation_space: Any):
        super().__init__(encoder, observation_space)
        self.predict = nn.Linear(encoder.features_dim + 2, encoder.features_dim)
        self.given: list[tuple[th.Tensor, th.Tensor]] = []

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        assert next_latents is not None
        self.given.append((latents, next_latents))
        error = (self.predict(th.cat([latents, batch.actions], dim=1)) - next_latents).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


@UPDATES
@pytest.mark.parametrize("algorithm", ["sac", "tqc"])
def test_users_head_trains(algorithm: str, update: str) -> None:
    """With its arguments; it and the encoder learn, and its error pays the curious agent."""
    model = filled_model(algorithm, srl=Positions, srl_kwargs={"width": 12}, update=update)
    assert model.policy.srl.decode[0].out_features == 12
    before = groups(model)
    first = train_once(model)
    assert moved(before, groups(model)) == ENCODER | {"head"} | BOTH_AGENTS
    assert first["curious_reward_raw_mean"] == first["srl_error"]
    for _ in range(10):
        last = train_once(model, rl=False)
    assert last["srl_loss"] < first["srl_loss"]


def test_head_is_given_the_stored_batch_and_its_views() -> None:
    """Latents are the encoder's of the views, in fp32; the other fields are what the buffer holds."""
    seen: list[tuple[Samples, th.Tensor]] = []

    class Spy(RAE):
        def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            assert next_latents is None
            seen.append((batch, latents))
            return super().loss(batch, latents)

    model = filled_model(pixels=True, srl=Spy, augmentation="shift", learning_rate=0.0)
    logged = train_once(model)
    ((batch, latents),) = seen
    np.random.seed(1)
    for ours, stored in zip(batch[:5], model.replay_buffer.sample(BATCH)[:5], strict=True):
        assert th.equal(ours, stored)
    assert batch.views.dtype == th.uint8 and not th.equal(batch.views, batch.observations)
    th.testing.assert_close(latents, model.policy.encoder(batch.views.float() / 255))
    assert latents.dtype == th.float32 and latents.requires_grad
    assert logged["srl_error"] == logged["curious_reward_raw_mean"]


# ---------------------------------------------------------------- next latents


@UPDATES
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_head_that_needs_next_latents_gets_them(precision: str, update: str) -> None:
    """With their gradient: the encoder moves along both."""
    model = filled_model(srl=Forward, update=update, precision=precision, curiosity=None, learning_rate=0.01)
    encoder, twin = model.policy.encoder, copy.deepcopy(model.policy.encoder)
    np.random.seed(1)
    batch = model.replay_buffer.sample(BATCH)
    twin.update_statistics(batch.observations)
    latents, following = twin(batch.observations), twin(batch.next_observations)
    loss, _ = model.policy.srl.loss(Samples(*batch, views=batch.observations), latents, following)
    along = th.autograd.grad(loss, list(twin.parameters()), retain_graph=True)
    at_latents = th.autograd.grad(loss, [latents, following])
    model.policy.srl.given.clear()
    train_once(model, rl=False)
    ((now, then),) = model.policy.srl.given
    assert now.grad.any() and then.grad.any()
    assert now.dtype == then.dtype == th.float32
    if precision == "fp32":
        size = 1.0 if update == "sequential" else float(th.cat(at_latents).norm())
        for parameter, old, gradient in zip(encoder.parameters(), twin.parameters(), along, strict=True):
            th.testing.assert_close(parameter, old - 0.01 * gradient / size)


@UPDATES
def test_loss_that_moves_no_encoder_is_told(update: str) -> None:
    class Apart(Positions):
        """Encodes for itself what it was given the latents of."""

        def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            return super().loss(batch, self.encoder(batch.views))

    model = filled_model(srl=Apart, update=update)
    with pytest.warns(UserWarning, match="loss of Apart does not depend on the latents that it is given"):
        train_once(model, rl=False)


@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_transition_head_always_sees_the_true_transition(target: str) -> None:
    """``curiosity_target`` shows it nothing else: its error is of (s, a, s') either way."""
    model = filled_model(srl=Forward, curiosity_target=target, learning_rate=0.0)
    logged = train_once(model)
    assert len(model.policy.srl.given) == 1
    assert logged["curious_reward_raw_mean"] == logged["srl_error"]


# ---------------------------------------------------------------- precision and what is returned


def returns(change: Any) -> type[SRLHead]:
    class Returns(Positions):
        def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            error = (self.decode(latents) - batch.views).square().mean(dim=1)
            return SRLOutput(error.mean(), change(error))

    return Returns


@pytest.mark.parametrize(
    "change",
    [lambda e: e, lambda e: e.detach()[:, None], lambda e: e.detach().mean(), lambda e: e.detach()[:-1]],
    ids=["graph", "column", "scalar", "short"],
)
def test_error_is_one_number_per_sample_detached(change: Any) -> None:
    """Anything else would be broadcast, or train the encoder by the curious reward, without a word."""
    model = filled_model(srl=returns(change))
    before = groups(model)
    with pytest.raises(ValueError, match=r"Returns.loss returned an error of shape .* one number per sample, detached"):
        train_once(model)
    assert not moved(before, groups(model))


def test_error_of_few_digits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"in torch\.bfloat16"):
        train_once(filled_model(srl=returns(lambda error: error.detach().to(th.bfloat16))))


class Norm(SRLHead):
    """No parameters of its own: small latents."""

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        error = latents.square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


@UPDATES
def test_head_without_parameters_trains_the_encoder(update: str) -> None:
    model = filled_model(srl=Norm, update=update)
    assert model.policy.srl.optimizer is None
    before = groups(model)
    train_once(model, rl=False)
    assert moved(before, groups(model)) == ENCODER


@pytest.mark.parametrize("srl", ["simsiam", nn.Module, 3])
def test_unknown_head_is_refused(srl: Any) -> None:
    with pytest.raises(ValueError, match="srl is"):
        get_srl_class(srl)


# ---------------------------------------------------------------- after each step


@UPDATES
@pytest.mark.parametrize("schedule", ["simultaneous", "alternating"])
def test_after_step_follows_each_update_of_the_head(schedule: str, update: str) -> None:
    """The head's own step has been made by then; in updates of actors and critics alone it is not called."""
    weights: list[th.Tensor] = []

    class Average(Positions):
        def after_step(self) -> None:
            weights.append(self.decode[0].weight.detach().clone())

    model = filled_model(srl=Average, srl_schedule=schedule, srl_period=1, update=update)
    start = model.policy.srl.decode[0].weight.detach().clone()
    model.train(4, BATCH)
    assert len(weights) == 4
    assert all(not th.equal(a, b) for a, b in zip([start, *weights], weights, strict=False))
    assert th.equal(weights[-1], model.policy.srl.decode[0].weight)


#: Height of the images of ``SensorBox``
SIDES = {"front": 36, "wrist": 28}


def test_dictionary_heads_are_each_images_own() -> None:
    """Encoder, target encoder, augmentation and moving averages of each head are those of its image."""

    class Counts(RAE):
        n_steps = 0

        def after_step(self) -> None:
            self.n_steps += 1

    model = sensor_model(srl=Counts, augmentation="shift").learn(13)
    policy: Any = model.policy
    assert tuple(policy.srl.slices) == ("front", "wrist")
    for key, head in heads_by_key(policy.srl).items():
        assert head.n_steps == 3
        assert head.augment is policy.augmentation.of(key) and head.augment.observation_space.shape[1] == SIDES[key]
        assert head.encoder is policy.encoder.images[key]
        assert head.target_encoder is policy.encoder_target.images[key]


# ---------------------------------------------------------------- what belongs to whom


@pytest.mark.parametrize("srl", SRL_HEADS)
def test_head_does_not_own_the_encoder(srl: str) -> None:
    """Its parameters and its state are its own: nothing is trained or saved twice."""
    policy = tiny_model("CnnPolicy", PixelBox(), srl=srl).policy
    encoders = {id(p) for module in (policy.encoder, policy.encoder_target) for p in module.parameters()}
    assert not encoders & {id(p) for p in policy.srl.parameters()}
    assert not any("encoder" in key for key in policy.srl.state_dict())
    assert policy.srl.encoder is policy.encoder
    assert policy.srl.target_encoder is policy.encoder_target


@pytest.mark.parametrize("name", ["encoder", "target_encoder"])
def test_network_by_the_name_of_a_shared_one_is_refused(name: str) -> None:
    """A momentum encoder of the head's own, say: reading the name would give the shared one."""

    class Momentum(Positions):
        def __init__(self, encoder: Encoder, observation_space: Any):
            super().__init__(encoder, observation_space)
            setattr(self, name, copy.deepcopy(encoder))

    with pytest.raises(ValueError, match=f"Momentum has a network '{name}'.*rename it"):
        tiny_model("MlpPolicy", VectorBox(), srl=Momentum)


def test_optimizer_arguments_may_be_the_heads_class() -> None:
    class Decaying(Positions):
        optimizer_kwargs: ClassVar[dict[str, Any]] = {"weight_decay": 0.5}

    model = tiny_model("MlpPolicy", VectorBox(), srl=Decaying)
    assert model.policy.srl.optimizer.param_groups[0]["weight_decay"] == 0.5


@UPDATES
def test_head_that_holds_the_encoder_trains_it_no_more(update: str) -> None:
    """Kept as a part, as modules usually are: it is still the encoder's optimiser alone that steps it."""

    class Holder(RAE):
        def __init__(self, encoder: Any, observation_space: Any, **kwargs: Any):
            super().__init__(encoder, observation_space, **kwargs)
            self.parts = nn.ModuleList([encoder.projection])

    models = [filled_model(srl=kind, update=update) for kind in (RAE, Holder)]
    for model in models:
        train_once(model)
    ours, theirs = (list(model.policy.encoder.parameters()) for model in models)
    assert equal(ours, theirs)
    held = {id(p) for group in models[1].policy.srl.optimizer.param_groups for p in group["params"]}
    assert held and held.isdisjoint(map(id, theirs))
