"""What a user's own intrinsic reward is given, and what is done with what it returns."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import VectorBox, tiny_model
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn
from updates_for_tests import equal, filled_model, groups, moved, train_once

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic import IntrinsicReward
from sb3_cure.networks.encoders import Encoder

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])
Latents = th.Tensor | None


class Forward(IntrinsicReward):
    """Prediction error of a model of the next observation: a reward with parameters of its own."""

    def __init__(self, observation_space: Any, action_space: Any, features_dim: int):
        super().__init__(observation_space, action_space, features_dim)
        size = observation_space.shape[0]
        self.model = nn.Linear(size + action_space.shape[0], size)
        self.rewards: list[th.Tensor] = []

    def loss(self, batch: Samples, latents: Latents, next_latents: Latents, srl_error: Latents) -> Any:
        drawn = self.model(th.cat([batch.observations, batch.actions], dim=1))
        error = (drawn - batch.next_observations).square().mean(dim=1)
        self.rewards.append(error.detach())
        return error.mean(), error.detach()


class LatentStep(IntrinsicReward):
    """How far a step leads in the latents; keeps what it was given."""

    reads = ("latents", "next_latents")

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.given: list[tuple[Samples, th.Tensor, th.Tensor, Latents]] = []

    def loss(self, batch: Samples, latents: Latents, next_latents: Latents, srl_error: Latents) -> Any:
        assert latents is not None and next_latents is not None
        self.given.append((batch, latents, next_latents, srl_error))
        error = (latents - next_latents).square().sum(dim=1)
        return (error.mean() if self.trains_encoder else None), error.detach()


class SlowLatents(LatentStep):
    trains_encoder = True


@UPDATES
@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
@pytest.mark.parametrize("algorithm", ["sac", "tqc"])
def test_reward_with_parameters_learns_them(algorithm: str, curiosity: str, update: str) -> None:
    """By its own loss and optimiser; the agent gets the reward as it was before that step."""
    model = filled_model(algorithm, srl=None, intrinsic=Forward, curiosity=curiosity, update=update)
    reward: Any = model.policy.intrinsic
    assert reward.optimizer is not None and isinstance(reward.optimizer, th.optim.SGD)
    paid: list[th.Tensor] = []
    scale = model.policy.scale
    scale.register_forward_hook(lambda module, args, out: paid.append(args[0].clone()))
    before = groups(model)
    logged = train_once(model)
    assert "reward" in moved(before, groups(model))
    assert th.equal(paid[0], reward.rewards[0])
    assert logged["curious_reward_raw_mean"] == float(paid[0].mean())
    weight, bias = before["reward"]
    batch_loss = float(paid[0].mean())
    train_once(model)  # the same batch
    assert float(reward.rewards[1].mean()) < batch_loss
    assert not th.equal(weight, reward.model.weight) and not th.equal(bias, reward.model.bias)


def test_reward_learns_from_its_own_loss_alone() -> None:
    """A step of its own optimiser along the gradient of the mean error, whatever the agents do."""
    model = filled_model(srl=None, intrinsic=Forward)
    (weight, bias) = groups(model)["reward"]
    train_once(model)
    reward: Any = model.policy.intrinsic
    again = filled_model(srl=None, intrinsic=Forward, learning_rate=0.0)
    twin: Any = again.policy.intrinsic
    train_once(again)
    gradients = [parameter.grad for parameter in twin.model.parameters()]
    for parameter, old, gradient in zip(reward.model.parameters(), (weight, bias), gradients, strict=True):
        th.testing.assert_close(parameter.detach(), old - 0.1 * gradient)
    assert equal([weight, bias], groups(again)["reward"])


def test_reward_learns_in_rl_updates_only() -> None:
    model = filled_model(intrinsic=Forward)
    before = groups(model)
    train_once(model, rl=False)
    assert "reward" not in moved(before, groups(model))


@UPDATES
@pytest.mark.parametrize("precision, extractor", [("fp32", None), ("bf16", None), ("bf16", NatureCNN)])
@pytest.mark.parametrize("augmentation", [None, "shift"])
def test_latents_are_of_centred_views_in_fp32(
    augmentation: str | None, precision: str, extractor: Any, update: str
) -> None:
    """The online encoder's, as it is by then, of both observations; without a gradient to the encoder."""
    arguments: dict[str, Any] = dict(augmentation=augmentation, precision=precision, update=update)
    if extractor is not None:
        kwargs = {"features_extractor_class": extractor, "features_extractor_kwargs": {"features_dim": 8}}
        arguments["policy_kwargs"] = kwargs
    model = filled_model(pixels=True, intrinsic=LatentStep, learning_rate=0.0, **arguments)
    train_once(model)
    reward: Any = model.policy.intrinsic
    ((batch, latents, next_latents, srl_error),) = reward.given
    assert latents.dtype == next_latents.dtype == srl_error.dtype == th.float32
    assert not latents.requires_grad and not next_latents.requires_grad
    assert srl_error.shape == (8,) and not srl_error.requires_grad
    with th.no_grad(), model._autocast():
        for found, observations in ((latents, batch.observations), (next_latents, batch.next_observations)):
            th.testing.assert_close(found, model.policy.encode(observations).float(), rtol=1e-5, atol=1e-5)
    assert not th.equal(latents, next_latents)


def test_latents_are_computed_only_where_they_are_read() -> None:
    """By default a reward gets none, and the encoder does not run for them; of no head there is no error."""
    seen: list[Any] = []

    class Looks(Forward):
        def loss(self, batch: Samples, *rest: Latents) -> Any:  # type: ignore[override]
            seen.append(rest)
            return super().loss(batch, *rest)

    train_once(filled_model(srl=None, intrinsic=Looks))
    assert seen == [(None, None, None)]


def test_latents_of_a_sequential_update_are_of_the_stepped_encoder() -> None:
    """The head has moved the encoder by then."""
    model = filled_model(intrinsic=LatentStep, update="sequential", learning_rate=1.0)
    encoder: Encoder = model.policy.encoder
    before = [parameter.detach().clone() for parameter in encoder.parameters()]
    train_once(model)
    reward: Any = model.policy.intrinsic
    batch, latents, *_ = reward.given[0]
    with th.no_grad():
        for parameter, old in zip(encoder.parameters(), before, strict=True):
            parameter.copy_(old)
        assert not th.equal(model.policy.encode(batch.observations), latents)


@UPDATES
@pytest.mark.parametrize("augmentation", [None, "shift"])
def test_reward_that_trains_the_encoder_moves_it(augmentation: str | None, update: str) -> None:
    """Alone among the losses, through both latents; its norm is logged beside those of the others."""
    arguments: dict[str, Any] = dict(augmentation=augmentation, update=update, pixels=True)
    alone = dict(srl=None, task=False, curiosity_encoder_grad=False)
    model = filled_model(intrinsic=SlowLatents, **arguments, **alone)
    before = groups(model)
    logged = train_once(model, actors=False)
    assert moved(before, groups(model)) == {"trunk", "projection", "curious critic"}
    assert logged["encoder_share_intrinsic"] == 1
    reward: Any = model.policy.intrinsic
    assert all(latents.requires_grad for latents in reward.given[0][1:3])
    assert all(latents.grad.any() for latents in reward.given[0][1:3])
    still = filled_model(intrinsic=LatentStep, **arguments, **alone)
    train_once(still, actors=False)
    assert {"trunk", "projection"}.isdisjoint(moved(before, groups(still)))
    shared = train_once(filled_model(intrinsic=SlowLatents, **arguments))
    assert {f"encoder_share_{name}" for name in ("srl", "task", "curious", "intrinsic")} <= shared.keys()


@pytest.mark.parametrize("curiosity", [None, "bonus", "separate"])
@pytest.mark.parametrize("reward", [Forward, SlowLatents])
def test_rewards_survive_pretraining(reward: type[IntrinsicReward], curiosity: str | None) -> None:
    """The pretraining's curious agent is paid by them; a bonus is still paid afterwards."""
    model = tiny_model("MlpPolicy", VectorBox(), intrinsic=reward, curiosity=curiosity)
    sources = set(model.policy.encoder_update.weights)
    model.pretrain(14).learn(14)
    assert set(model.policy.encoder_update.weights) == sources
    assert (model.policy.intrinsic is None) == (curiosity is None)
    assert (model.policy.curious is None) == (curiosity != "separate")


def test_networks_begin_alike_under_every_reward() -> None:
    """Whatever a reward draws, the others' weights are the seed's, so that arms of one seed are paired."""

    class Greedy(Forward):
        def __init__(self, *args: Any):
            super().__init__(*args)
            th.rand(1000)

    rewards: list[Any] = ["srl_error", Forward, Greedy]
    states = [tiny_model("MlpPolicy", VectorBox(), intrinsic=each).policy.state_dict() for each in rewards]
    for state in states[1:]:
        assert all(th.equal(value, state[name]) for name, value in states[0].items())


@pytest.mark.parametrize(
    "intrinsic", ["novelty", nn.Linear, Forward(VectorBox().observation_space, VectorBox().action_space, 8)]
)
def test_unknown_reward_is_refused(intrinsic: Any) -> None:
    with pytest.raises(ValueError, match="intrinsic"):
        tiny_model("MlpPolicy", VectorBox(), intrinsic=intrinsic)


@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
def test_reward_made_of_the_srl_error_needs_a_head(curiosity: str) -> None:
    with pytest.raises(ValueError, match="srl is None"):
        tiny_model("MlpPolicy", VectorBox(), srl=None, curiosity=curiosity)
