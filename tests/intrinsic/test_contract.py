"""What an intrinsic reward may read, what is done with its results, and how rewards are built."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import sensor_model
from envs_for_tests import Cliff, PixelBox, VectorBox, tiny_model
from stable_baselines3.common.env_util import make_vec_env
from torch import nn
from updates_for_tests import equal, filled_model, groups, moved, train_once

from sb3_cure.intrinsic import IntrinsicReward, OwnGenerator, RewardInputs
from sb3_cure.intrinsic.rnd import RND
from sb3_cure.intrinsic.srl_error import SRLError
from sb3_cure.persistence import ExactCheckpoint
from sb3_cure.srl import RAE, SRLHead, SRLOutput

UPDATES = pytest.mark.parametrize("update", ["sequential", "joint"])


class Forward(IntrinsicReward):
    """Prediction error of a model of the next observation: a reward with parameters of its own."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        size = self.observation_space.shape[0]
        self.model = nn.Linear(size + self.action_space.shape[0], size)
        self.rewards: list[th.Tensor] = []

    def loss(self, inputs: RewardInputs) -> Any:
        batch = inputs.batch
        drawn = self.model(th.cat([batch.observations, batch.actions], dim=1))
        error = (drawn - batch.next_observations).square().mean(dim=1)
        self.rewards.append(error.detach())
        return error.mean(), error.detach()


class LatentStep(IntrinsicReward):
    """How far a step leads in the latents; keeps what it got."""

    def __init__(self, *args: Any):
        super().__init__(*args)
        self.given: list[RewardInputs] = []

    def loss(self, inputs: RewardInputs) -> Any:
        self.given.append(inputs)
        error = (inputs.latents - inputs.next_latents).square().sum(dim=1)
        return (error.mean() if self.trains_encoder else None), error.detach()


class SlowLatents(LatentStep):
    trains_encoder = True


def test_reward_that_holds_the_head_does_not_train_it() -> None:
    class Holder(Forward):
        needs_srl = True

        def __init__(self, *args: Any, srl: Any):
            super().__init__(*args)
            self.srl = srl

    policy = tiny_model("MlpPolicy", VectorBox(), srl="rae", intrinsic=Holder).policy
    (group,) = policy.intrinsic.optimizer.param_groups
    assert set(map(id, group["params"])) == set(map(id, policy.intrinsic.model.parameters()))


@UPDATES
@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
def test_reward_with_parameters_learns_them(curiosity: str, update: str) -> None:
    """By its own loss and optimizer; the agent gets the reward as it was before that step."""
    model = filled_model(srl=None, intrinsic=Forward, curiosity=curiosity, update=update)
    reward: Any = model.policy.intrinsic
    paid: list[th.Tensor] = []
    model.policy.scale.register_forward_pre_hook(lambda module, args: paid.append(args[0].clone()))
    before = groups(model)
    train_once(model, rl=False)
    assert not moved(before, groups(model))
    logged = train_once(model)
    assert "reward" in moved(before, groups(model))
    assert th.equal(paid[0], reward.rewards[0])
    assert logged["curious_reward_raw_mean"] == float(paid[0].mean())
    train_once(model)  # the same batch
    assert float(reward.rewards[1].mean()) < float(paid[0].mean())


@UPDATES
@pytest.mark.parametrize("augmentation", [None, "shift"])
def test_latents_are_of_centred_views(augmentation: str | None, update: str) -> None:
    """The online encoder's, of both observations, in fp32, without a gradient to the encoder."""
    arguments: dict[str, Any] = dict(augmentation=augmentation, update=update, learning_rate=0.0)
    model = filled_model(pixels=True, intrinsic=LatentStep, **arguments)
    with th.no_grad():
        for parameter in model.policy.encoder_target.parameters():
            parameter.mul_(1.1)
    train_once(model)
    reward: Any = model.policy.intrinsic
    (inputs,) = reward.given
    found = {name: getattr(inputs, name) for name in ("latents", "next_latents")}
    for name, observations in zip(found, (inputs.batch.observations, inputs.batch.next_observations), strict=True):
        assert found[name].dtype == th.float32 and not found[name].requires_grad
        th.testing.assert_close(found[name], model.policy.encode(observations).detach(), rtol=1e-5, atol=1e-5)
    assert not th.equal(*found.values())
    with pytest.raises(ValueError, match="needs_srl"):  # computed after the head's step it would be another
        _ = inputs.srl_error


def test_latents_are_computed_once_when_read() -> None:
    read: list[str] = []
    rest: Any = [None] * 2
    inputs = RewardInputs(rest[0], None, lambda name: th.ones(2, 4) * (read.append(name) or len(read)), *rest)
    assert read == []
    with th.no_grad():
        first = inputs.next_latents
    assert inputs.next_latents is first and read == ["next_observations"]
    assert float(inputs.latents.mean()) == 2 and read == ["next_observations", "observations"]


@UPDATES
def test_reading_without_gradients_leaves_the_shared_graph(update: str) -> None:
    """Critics that share the encoder's pass still train the encoder."""

    class Careful(LatentStep):
        @th.no_grad()
        def loss(self, inputs: RewardInputs) -> Any:
            return super().loss(inputs)

    model = filled_model(srl=None, intrinsic=Careful, update=update)
    before = groups(model)
    train_once(model)
    assert {"trunk", "projection"} <= moved(before, groups(model))


class TellsPlace(gym.Wrapper):
    """Tells in the info where a step has led."""

    def step(self, action: Any) -> tuple[Any, ...]:
        observation, *rest, info = self.env.step(action)
        return observation, *rest, {**info, "place": observation}


def test_reward_reads_what_the_info_said(tmp_path: Path) -> None:
    """Of the same transitions as the batch, of several environments, after a round of the buffer and a resume."""
    kept: dict[str, Any] = dict(buffer_size=40, replay_buffer_kwargs=dict(info_shapes={"place": (2,)}))
    env = make_vec_env(lambda: TellsPlace(VectorBox()), n_envs=2)
    model = tiny_model("MlpPolicy", env, srl=None, intrinsic=LatentStep, **kept)
    model.learn(100, callback=ExactCheckpoint(100, tmp_path))
    resumed = type(model).resume(tmp_path, env, custom_objects={"intrinsic": LatentStep})
    resumed.learn(20, reset_num_timesteps=False)
    for each in (model, resumed):
        reward: Any = each.policy.intrinsic
        inputs = reward.given[-1]
        assert th.equal(inputs.info("place"), inputs.batch.next_observations)


@pytest.mark.parametrize("shape", [(1,), (-1, 1)])
def test_reward_is_one_number_per_sample(shape: tuple[int, ...]) -> None:
    """One number would be broadcast to the batch."""

    class OtherShape(IntrinsicReward):
        def loss(self, inputs: RewardInputs) -> Any:
            return None, inputs.batch.rewards.flatten()[: None if shape[0] < 0 else 1].reshape(shape)

    with pytest.raises(ValueError, match=r"OtherShape.loss returned a reward of shape .* one number per sample"):
        train_once(filled_model(srl=None, intrinsic=OtherShape))


def test_heads_get_vectors_in_float32() -> None:
    """Gymnasium's MuJoCo observes float64."""
    env = Cliff()
    env.observation_space = gym.spaces.Box(-2, 2, env.observation_space.shape, np.float64)
    settings: dict[str, Any] = dict(srl=None, intrinsic=LatentStep, learning_starts=100, batch_size=64, n_steps=2)
    model = tiny_model("MlpPolicy", env, **settings).learn(102)
    batch = model.policy.intrinsic.given[-1].batch
    seen = (batch.observations, batch.next_observations, batch.views, batch.n_step.next_observations, batch.restarts)
    assert {each.dtype for each in seen} == {th.float32}


@UPDATES
@pytest.mark.parametrize("augmentation", [None, "shift"])
def test_reward_that_trains_the_encoder_moves_it(augmentation: str | None, update: str) -> None:
    """Through both latents; another reward does not."""
    alone = dict(srl=None, task=False, curiosity_encoder_grad=False)
    for kind, trained in ((SlowLatents, {"trunk", "projection"}), (LatentStep, set())):
        model = filled_model(pixels=True, augmentation=augmentation, update=update, intrinsic=kind, **alone)
        before = groups(model)
        train_once(model, actors=False)
        assert moved(before, groups(model)) == trained | {"curious critic"}
        reward: Any = model.policy.intrinsic
        assert all((each.grad is not None) == bool(trained) for each in (reward.given[0].latents,))
        assert ("intrinsic" in model.policy.encoder_update.total_weights) == bool(trained)


@UPDATES
def test_head_trains_the_encoder_beside_a_reward_of_its_error_that_does(update: str) -> None:
    """The step of the reward's loss comes first; the head's is then of the encoder as it is by now."""

    class Both(SlowLatents):
        needs_srl = True

    logged = train_once(filled_model(intrinsic=Both, update=update))
    assert logged["latent_grad_norm_srl"] > 0 < logged["latent_grad_norm_intrinsic"]


@pytest.mark.parametrize("curiosity", [None, "bonus", "separate"])
@pytest.mark.parametrize("reward", [Forward, SlowLatents])
def test_rewards_survive_pretraining(reward: type[IntrinsicReward], curiosity: str | None) -> None:
    """The pretraining's curious agent gets them; a bonus is still added afterwards."""
    model = tiny_model("MlpPolicy", VectorBox(), intrinsic=reward, curiosity=curiosity)
    sources = set(model.policy.encoder_update.total_weights)
    model.pretrain(14).learn(14)
    assert set(model.policy.encoder_update.total_weights) == sources
    assert (model.policy.intrinsic is None) == (curiosity is None)


class Judges(IntrinsicReward):
    """Keeps the head's weights as they are when it is computed, and its settings."""

    needs_srl = True

    def __init__(self, *args: Any, srl: Any, curiosity_target: str, frame_stack: int, width: int = 3):
        super().__init__(*args)
        self.parts, self.settings = (srl,), (curiosity_target, frame_stack, width)
        self.seen: list[th.Tensor] = []
        self.errors: list[th.Tensor] = []

    @classmethod
    def is_per_image(cls, **kwargs: Any) -> bool:
        return True

    def loss(self, inputs: RewardInputs) -> Any:
        self.seen.append(next(self.parts[0].parameters()).detach().clone())
        self.errors.append(inputs.srl_error)
        return None, inputs.srl_error


def test_constructor_gets_the_settings_that_it_names() -> None:
    """The user's arguments override them; of dictionaries each image has its own."""
    model = tiny_model("MlpPolicy", VectorBox(), intrinsic=Judges, curiosity_target="next_observation")
    reward: Any = model.policy.intrinsic
    assert reward.parts == (model.policy.srl,) and reward.settings == ("next_observation", 1, 3)
    assert not any("srl" in name or "parts" in name for name in reward.state_dict())
    model = sensor_model(intrinsic=Judges, intrinsic_kwargs=dict(width=4), replay_buffer_kwargs=dict(frame_stack=2))
    policy: Any = model.policy
    assert [part.settings for part in policy.intrinsic.rewards] == [("observation", 2, 4)] * 2
    assert [part.parts[0] for part in policy.intrinsic.rewards] == list(policy.srl.heads)
    with pytest.raises(ValueError, match="srl is None"):
        tiny_model("MlpPolicy", VectorBox(), srl=None, intrinsic=Judges)


@UPDATES
@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_srl_error_is_of_the_head_before_its_step(target: str, update: str) -> None:
    """Views of the target, seen by the online encoder; nothing but the head's own step follows."""
    judged: list[Any] = []

    class Spy(RAE):
        def loss(self, batch: Any, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            output = super().loss(batch, latents)
            judged.append((batch, latents.detach(), next(self.parameters()).detach().clone(), output.error))
            return output

    model = filled_model(
        pixels=True, srl=Spy, intrinsic=Judges, augmentation="shift", curiosity_target=target, update=update
    )
    policy: Any = model.policy
    with th.no_grad():
        for parameter in policy.encoder_target.parameters():
            parameter.mul_(1.5)
    start = next(policy.srl.parameters()).detach().clone()
    encoder = [parameter.detach().clone() for parameter in policy.encoder.parameters()]
    train_once(model)
    assert not th.equal(start, next(policy.srl.parameters()))
    batch, latents, weights, error = judged[-1]
    assert len(judged) == (1 if target == "observation" else 2)
    assert th.equal(weights, start) and th.equal(policy.intrinsic.seen[0], start)
    assert th.equal(policy.intrinsic.errors[0], error)
    if target == "next_observation":
        assert th.equal(batch.observations, judged[0][0].next_observations) and batch.actions is None
        assert not th.equal(batch.views, batch.observations)
    with th.no_grad():
        for parameter, old in zip(policy.encoder.parameters(), encoder, strict=True):
            parameter.copy_(old)
    th.testing.assert_close(latents, policy.encoder(batch.views.float() / 255).detach())


@UPDATES
def test_error_that_a_reward_reads_leaves_the_shared_graph(update: str) -> None:
    """In a phase of RL the head's error is computed for the reward alone, and the critics still train the encoder."""
    model = filled_model(srl="rae", update=update)
    before = groups(model)
    train_once(model, srl=False)
    assert not equal(before["trunk"], groups(model)["trunk"]) and equal(before["head"], groups(model)["head"])


@pytest.mark.parametrize(
    ("srl", "expected"),
    [("rae", SRLError), ("vae", SRLError), *((srl, RND) for srl in ("curl", "spr", "forward", "inverse", None))],
)
def test_auto_follows_the_errors_that_tell_novelty(
    srl: str | None, expected: type[IntrinsicReward], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The choice is printed, and survives a file and a checkpoint."""
    model = filled_model(pixels=True, srl=srl, intrinsic="auto", verbose=1)
    assert type(model.policy.intrinsic) is expected
    assert f"rewarded by {expected.__name__} " in capsys.readouterr().out
    model.save(tmp_path / "model")
    model.learn(10, callback=ExactCheckpoint(10, tmp_path / "checkpoint"))
    loaded = type(model).load(tmp_path / "model", env=model.env)
    resumed = type(model).resume(tmp_path / "checkpoint", PixelBox())
    for again in (loaded, resumed):
        assert again.intrinsic == "auto" and type(again.policy.intrinsic) is expected
        assert equal(groups(again).get("reward", []), groups(model).get("reward", []))


@pytest.mark.parametrize(("srl", "expected"), [("rae", SRLError), ("curl", RND)])
def test_shuffled_control_is_of_the_reward_that_auto_takes(srl: str, expected: type[IntrinsicReward]) -> None:
    """Also with a head for each image of a dictionary, where each image has a reward."""
    reward: Any = filled_model(pixels=True, srl=srl, intrinsic="shuffled").policy.intrinsic
    assert type(reward.of) is expected
    reward = sensor_model(srl=srl, intrinsic="shuffled").policy.intrinsic
    assert type(getattr(reward.of, "rewards", [reward.of])[0]) is expected


def test_auto_takes_the_word_of_a_head_of_the_users() -> None:
    """A head that says nothing is followed, as in the paper."""

    class Silent(SRLHead):
        def loss(self, batch: Any, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            error = latents.square().sum(dim=1)
            return SRLOutput(error.mean(), error.detach())

    class Says(Silent):
        error_tells_novelty = False

    for head, reward in ((Silent, SRLError), (Says, RND)):
        assert type(filled_model(srl=head, intrinsic="auto").policy.intrinsic) is reward


def test_rewards_draw_from_generators_of_their_own() -> None:
    """Whatever a reward draws, networks begin alike and torch's stream goes on alike; two rewards draw apart."""

    class Greedy(Forward):
        def __init__(self, *args: Any):
            super().__init__(*args)
            th.rand(1000)
            self.random = OwnGenerator()

    states, streams = [], []
    for intrinsic, kwargs in (("srl_error", {}), (Greedy, {}), ("shuffled", dict(of=Greedy))):
        model = tiny_model("MlpPolicy", VectorBox(), intrinsic=intrinsic, intrinsic_kwargs=kwargs)
        states.append({k: v.clone() for k, v in model.policy.state_dict().items() if not k.startswith("intrinsic")})
        model.learn(14)
        streams.append(th.get_rng_state())
    for state, stream in zip(states, streams, strict=True):
        assert all(th.equal(value, states[0][name]) for name, value in state.items()) and th.equal(stream, streams[0])
    reward: Any = model.policy.intrinsic
    assert len({part.random.generator.initial_seed() for part in (reward, reward.of)}) == 2


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (dict(intrinsic="novelty"), "intrinsic is"),
        (dict(intrinsic=nn.Linear), "intrinsic"),
        (dict(srl=None, intrinsic="shuffled", intrinsic_kwargs=dict(of="srl_error")), "srl is None"),
        (dict(srl="inverse", intrinsic="srl_error", intrinsic_kwargs=dict(per_pixel=True)), "Inverse does not draw"),
        (dict(intrinsic="shuffled", intrinsic_kwargs=dict(of="novelty")), "choose one of"),
        (dict(intrinsic="icm", intrinsic_kwargs=dict(encoder="mine")), "encoder is 'mine'"),
    ],
)
def test_impossible_rewards_are_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        tiny_model("MlpPolicy", VectorBox(), **arguments)
