"""Every intrinsic reward: as its paper writes it, in every mode, saved and resumed exactly, and what it seeks."""

import itertools
import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import sensor_model
from envs_for_tests import KillAt, Killed, PixelBox, VectorBox, differences, samples_of, state_of, tiny_model
from srl_for_tests import noise_images, randomise
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn
from updates_for_tests import filled_model, groups, moved, sampled, train_once

from benchmarks import rewards as world
from sb3_cure import CuReSAC
from sb3_cure.data.buffers import transitions
from sb3_cure.intrinsic import INTRINSIC_REWARDS, RewardInputs, disagreement, rnd
from sb3_cure.intrinsic.reward_networks import make_network
from sb3_cure.persistence import ExactCheckpoint

#: Every reward by its name, and variants of some
ARMS: dict[str, dict[str, Any]] = {
    **{name: dict(intrinsic=name) for name in INTRINSIC_REWARDS},
    "per pixel": dict(intrinsic_kwargs=dict(per_pixel=True)),
    "icm, own encoder": dict(intrinsic="icm", intrinsic_kwargs=dict(encoder="own")),
    "particle": dict(intrinsic="particle", intrinsic_kwargs=dict(memory=20)),
    "shuffled rnd": dict(intrinsic="shuffled", intrinsic_kwargs=dict(of="rnd", n_filters=4)),
}
every_reward = pytest.mark.parametrize("arm", ARMS)


def inputs_of(model: CuReSAC, batch: Any, latents: th.Tensor, next_latents: th.Tensor) -> RewardInputs:
    """What a reward reads, with given latents."""
    read = {"observations": latents, "next_observations": next_latents}
    of_model = model._reward_inputs(batch, None)
    return RewardInputs(batch, None, read.__getitem__, model.replay_buffer, of_model.look_up)  # type: ignore[arg-type]


def reward_of(model: CuReSAC) -> Any:
    assert model.policy.intrinsic is not None
    return model.policy.intrinsic


def captured(model: CuReSAC) -> list[th.Tensor]:
    """Raw rewards of the updates to come."""
    found: list[th.Tensor] = []
    model.policy.scale.register_forward_pre_hook(lambda _, args: found.append(args[0].clone()))
    return found


def layer_by_layer(network: nn.Sequential, inputs: th.Tensor) -> th.Tensor:
    """A network of ``make_network`` without its own code."""
    for layer in network:
        if isinstance(layer, nn.Conv2d):
            inputs = nn.functional.conv2d(inputs, layer.weight, layer.bias, stride=2, padding=1)
        elif isinstance(layer, nn.ReLU):
            inputs = inputs.clamp(min=0)
        elif isinstance(layer, nn.Sequential):
            inputs = layer_by_layer(layer, inputs)
        elif isinstance(layer, nn.Linear):
            inputs = inputs @ layer.weight.T + layer.bias
        elif isinstance(layer, nn.LayerNorm):
            centred = inputs - inputs.mean(dim=1, keepdim=True)
            inputs = centred / (centred.square().mean(dim=1, keepdim=True) + layer.eps).sqrt()
            inputs = inputs if layer.weight is None else inputs * layer.weight + layer.bias
        else:
            inputs = th.stack([image.permute(1, 2, 0).flatten() for image in inputs])
    return inputs


# ---------------------------------------------------------------- in every mode


@pytest.mark.usefixtures("quick_disk")
@pytest.mark.parametrize("arm, curiosity", [*((arm, "separate") for arm in ARMS), ("rnd", "bonus")])
def test_resumed_training_is_the_uninterrupted_one(arm: str, curiosity: str, tmp_path: Path) -> None:
    """Bit for bit, with a replay buffer and memories that have gone round, from a model that was loaded."""
    arguments: dict[str, Any] = dict(curiosity=curiosity, buffer_size=14, **ARMS[arm])

    def env() -> DummyVecEnv:
        return make_vec_env(PixelBox, 1, env_kwargs=dict(episode_length=7, size=24))

    whole = tiny_model("CnnPolicy", env(), **arguments).learn(24)
    with pytest.raises(Killed):
        tiny_model("CnnPolicy", env(), **arguments).learn(24, callback=[ExactCheckpoint(6, tmp_path), KillAt(21)])
    np.random.seed(99)
    th.manual_seed(99)
    resumed = CuReSAC.resume(tmp_path, env(), device="cpu").learn(24, callback=ExactCheckpoint(100, tmp_path))
    assert any("intrinsic" in name for name in state_of(whole)["policy"]) == bool(reward_of(whole).state_dict())
    assert differences(state_of(whole), state_of(resumed)) == []
    assert whole._mixer.state_dict()["rng"] == resumed._mixer.state_dict()["rng"]


@pytest.mark.parametrize("pixels", [True, False])
@every_reward
def test_trains_without_a_task_and_in_pretraining(arm: str, pixels: bool) -> None:
    """A reward that is finite and differs between samples pays the curious critics, and the head still learns."""
    short: dict[str, Any] = dict(episode_length=7)  # so that particles find some of other episodes
    policy, env = ("CnnPolicy", PixelBox(size=24, **short)) if pixels else ("MlpPolicy", VectorBox(**short))
    model = tiny_model(policy, env, task=False, **ARMS[arm]).learn(20)
    logged = train_once(model)
    assert all(map(math.isfinite, logged.values())) and logged["curious_reward_std"] > 0
    model = tiny_model(policy, env, curiosity=None, **ARMS[arm])
    before, sources = groups(model), set(model.policy.encoder_update.total_weights)
    model.pretrain(14)
    assert "head" in moved(before, groups(model)) and "actor" not in moved(before, groups(model))
    assert set(model.policy.encoder_update.total_weights) == sources and model.policy.intrinsic is None
    model.learn(12)


@every_reward
def test_optimiser_has_what_is_trained_and_the_encoder_what_is_declared(arm: str) -> None:
    """Frozen networks are not stepped; a source of the encoder is there exactly where the reward trains it."""
    model = filled_model(pixels=True, curiosity_encoder_grad=False, **ARMS[arm])
    reward = reward_of(model)
    sources = model.policy.encoder_update.total_weights
    assert ("intrinsic" in sources) == reward.trains_encoder == (arm in ("icm", "impact"))
    trained = [p for p in reward.parameters() if p.requires_grad]
    held = [] if reward.optimizer is None else reward.optimizer.param_groups[0]["params"]
    assert set(map(id, held)) == set(map(id, trained))
    before = {name: p.clone() for name, p in reward.named_parameters()}
    train_once(model)
    changed = {name for name, p in reward.named_parameters() if not th.equal(p, before[name])}
    assert changed == {name for name, p in reward.named_parameters() if p.requires_grad}


def test_each_image_of_a_dictionary_has_a_reward_that_learns() -> None:
    model = sensor_model(intrinsic="rnd").learn(20)
    before = {name: p.clone() for name, p in reward_of(model).named_parameters() if p.requires_grad}
    assert {name.split(".")[1] for name in before} == {"0", "1"}
    model.train(1, 8)
    after = dict(reward_of(model).named_parameters())
    assert not any(th.equal(after[name], p) for name, p in before.items())


# ---------------------------------------------------------------- rnd


@pytest.mark.parametrize("pixels", [True, False])
def test_rnd_is_the_error_on_the_whitened_newest_frame(pixels: bool) -> None:
    """By the statistics of the warm-up's newest frames, clipped; they are frozen, and so is the target."""
    rate = 0.01 if pixels else 0.2
    model = filled_model(pixels=pixels, srl=None, intrinsic="rnd", learning_rate=rate, buffer_size=40)
    reward, found, buffer = reward_of(model), captured(model), model.replay_buffer
    everything: Any = transitions(buffer, np.arange(40), np.zeros(40, int))  # type: ignore[arg-type]

    def newest(images: th.Tensor) -> th.Tensor:
        return images[:, 3:].float() / 255 - 0.5 if pixels else images.float()

    warm_up, batch = newest(everything.next_observations), sampled(model)
    deviation = (warm_up.var(dim=0, correction=0) + (8.1e-5 if pixels else 1e-6)).sqrt()
    whitened = ((newest(batch.next_observations) - warm_up.mean(dim=0)) / deviation).clamp(-5, 5)
    with th.no_grad():
        guess, goal = (layer_by_layer(net, whitened) for net in (reward.predictor, reward.target))
    train_once(model)
    th.testing.assert_close(found[0], (guess - goal).square().mean(dim=1), rtol=1e-4, atol=1e-6)
    mean = reward.mean.clone()
    for _ in range(20):
        train_once(model)
    assert float(found[-1].mean()) < 0.8 * float(found[0].mean())
    space: Any = model.observation_space
    for _ in range(10):  # unlike any before
        new = space.sample()[None]
        buffer.add(new, new, np.zeros((1, 2)), np.zeros(1), np.ones(1), [{}])  # type: ignore[union-attr]
    train_once(model)
    assert th.equal(reward.mean, mean)


def test_rnd_reads_the_newest_frame_of_any_buffer(tmp_path: Path) -> None:
    """SB3's own knows nothing of frames; an archive is loaded without environments."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", intrinsic="rnd", replay_buffer_class=ReplayBuffer)
    assert reward_of(model).space.shape == (3, 36, 36)
    model.save(tmp_path / "model")
    assert reward_of(CuReSAC.load(tmp_path / "model")).space.shape == (3, 36, 36)


def test_rnd_without_warm_up_measures_until_it_has_seen_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a single transition everything else would be clipped."""
    monkeypatch.setattr(rnd, "ENOUGH", 20)
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, task=False, intrinsic="rnd", learning_starts=0)
    for steps, seen in ((12, 12), (12, 20), (5, 20)):
        model.learn(steps, reset_num_timesteps=False)
        reward, stored = reward_of(model), model.replay_buffer.next_observations[:seen, 0]  # type: ignore[union-attr]
        th.testing.assert_close(reward.mean, th.as_tensor(stored).mean(dim=0), rtol=1e-4, atol=1e-5)
        th.testing.assert_close(reward.variance, th.as_tensor(stored).var(dim=0, correction=0), rtol=1e-4, atol=1e-5)


def test_rnd_whitens_normalised_observations() -> None:
    """Of a ``VecNormalize`` it sees what the networks see."""
    env = VecNormalize(DummyVecEnv([lambda: VectorBox()]), norm_reward=False)
    model = tiny_model("MlpPolicy", env, srl=None, intrinsic="rnd", learning_starts=40).learn(40)
    env.training = False
    model.train(1, 8)
    seen = env.normalize_obs(model.replay_buffer.next_observations[:40, 0])  # type: ignore[union-attr]
    th.testing.assert_close(reward_of(model).mean, th.as_tensor(seen).float().mean(dim=0))


# ---------------------------------------------------------------- icm


@pytest.mark.parametrize("encoder", ["shared", "own"])
def test_icm_is_the_forward_error_in_features_of_the_inverse_model(encoder: str) -> None:
    """Features learn from the inverse model alone; the forward model learns on them detached."""
    kwargs = dict(intrinsic="icm", intrinsic_kwargs=dict(encoder=encoder))
    model = filled_model(pixels=True, srl=None, task=False, curiosity_encoder_grad=False, **kwargs)
    reward, found, batch = reward_of(model), captured(model), sampled(model)
    before = groups(model)
    trained = model.policy.encoder if encoder == "shared" else reward.encoder

    def features(observations: th.Tensor) -> th.Tensor:
        if encoder == "shared":
            return trained(observations.float() / 255)
        return layer_by_layer(nn.Sequential(*trained, reward.norm), observations.float() / 255 - 0.5)

    here, there = features(batch.observations), features(batch.next_observations)
    actions = layer_by_layer(reward.inverse_model, th.cat([here, there], dim=1))
    inverse = (actions - batch.actions).square().mean()
    gradients = th.autograd.grad(inverse, list(trained.parameters()), retain_graph=True)
    expected = layer_by_layer(reward.forward_model, th.cat([here, batch.actions], dim=1))
    error = (expected - there).square().mean(dim=1).detach()
    old = [p.detach().clone() for p in trained.parameters()]
    train_once(model, actors=False)
    th.testing.assert_close(found[0], error, rtol=1e-4, atol=1e-6)
    if encoder == "own":
        for parameter, start, gradient in zip(trained.parameters(), old, gradients, strict=True):
            th.testing.assert_close(parameter.detach(), start - 0.1 * gradient, rtol=1e-3, atol=1e-5)
    steps = [(start - p.detach()).flatten() for start, p in zip(old, trained.parameters(), strict=True)]
    direction, gradient = th.cat(steps), th.cat([each.flatten() for each in gradients])
    # The joint update normalises the length of a source's gradient, not its direction.
    assert float(nn.functional.cosine_similarity(direction, gradient, dim=0)) > 0.999
    assert ("trunk" in moved(before, groups(model))) == (encoder == "shared")


@pytest.mark.parametrize("encoder", ["shared", "own"])
def test_icm_of_a_dictionary_is_one_model_of_shared_features_or_one_for_each_image(encoder: str) -> None:
    reward = reward_of(sensor_model(intrinsic="icm", intrinsic_kwargs=dict(encoder=encoder)))
    models = [each for each in reward.modules() if isinstance(each, INTRINSIC_REWARDS["icm"])]
    assert len(models) == (1 if encoder == "shared" else 2)


# ---------------------------------------------------------------- impact


def test_impact_is_how_far_latents_move_before_the_step() -> None:
    """The models that the encoder learns from are ICM's."""
    pair = [filled_model(pixels=True, srl=None, task=False, intrinsic=name) for name in ("impact", "icm")]
    model, batch, found = pair[0], sampled(pair[0]), captured(pair[0])
    here, there = (model.policy.encoder(x.float() / 255) for x in (batch.observations, batch.next_observations))
    for each in pair:
        train_once(each, actors=False)
    th.testing.assert_close(found[0], (here - there).detach().norm(dim=1), rtol=1e-4, atol=1e-6)
    learned = [reward_of(each).state_dict() for each in pair]
    assert differences(*learned) == []


# ---------------------------------------------------------------- disagreement


def test_disagreement_is_the_variance_of_members_that_learn_apart() -> None:
    """One member after the other, each on its part of the transitions."""
    model = filled_model(srl=None, intrinsic="disagreement", intrinsic_kwargs=dict(n_members=3), learning_rate=0.05)
    reward, found, batch = reward_of(model), captured(model), sampled(model)
    parts = th.from_numpy(disagreement._uniform(model.replay_buffer.last_sampled[0], 3) < 0.5)  # type: ignore[union-attr]
    first, second = reward.members[0], reward.members[2]
    with th.no_grad():
        here, there = model.policy.encode(batch.observations), model.policy.encode(batch.next_observations)
    inputs = th.cat([here, batch.actions], dim=1)
    hidden = [(inputs @ first.weight[i] + first.bias[i, 0]).clamp(min=0) for i in range(3)]
    guesses = [h @ second.weight[i] + second.bias[i, 0] for i, h in enumerate(hidden)]
    mean = sum(guesses) / 3
    variance = sum((guess - mean) ** 2 for guess in guesses) / 3
    losses = [((g - there)[part] ** 2).mean() for g, part in zip(guesses, parts, strict=True)]
    (gradient,) = th.autograd.grad(sum(losses), second.weight)  # type: ignore[arg-type]
    old = second.weight.detach().clone()
    train_once(model)
    th.testing.assert_close(found[0], variance.mean(dim=1).detach(), rtol=1e-4, atol=1e-7)  # type: ignore[union-attr]
    th.testing.assert_close(second.weight.detach(), old - 0.05 * gradient, rtol=1e-4, atol=1e-6)
    assert not any(th.equal(first.weight[i], first.weight[j]) for i, j in itertools.combinations(range(3), 2))
    assert not th.equal(parts[0], parts[1])


def test_bootstrap_masks_belong_to_transitions() -> None:
    """A member never learns from transitions that are not its own; those of one row differ between environments."""
    env = DummyVecEnv([lambda: VectorBox()] * 2)
    arguments: dict[str, Any] = dict(intrinsic="disagreement", intrinsic_kwargs=dict(n_members=1))
    model = tiny_model("MlpPolicy", env, srl=None, learning_starts=200, **arguments).learn(200)
    buffer: Any = model.replay_buffer
    learned: dict[tuple[int, int], set[bool]] = {}
    for _ in range(40):
        batch = model.policy.samples(buffer.sample(32))
        target = th.zeros(32, model.policy.encoder.features_dim).requires_grad_(True)
        reward_of(model).loss(inputs_of(model, batch, target.detach(), target))[0].backward()
        for i, place in enumerate(zip(*buffer.last_sampled, strict=True)):
            learned.setdefault(place, set()).add(bool(target.grad[i].any()))  # type: ignore[index]
    assert len(learned) > 150 and all(len(each) == 1 for each in learned.values())
    assert 0.3 < np.mean([each == {True} for each in learned.values()]) < 0.7
    pairs = [(learned[row, 0], learned[row, 1]) for row in range(100) if {(row, 0), (row, 1)} <= learned.keys()]
    assert 0.2 < np.mean([first != second for first, second in pairs]) < 0.8


# ---------------------------------------------------------------- particle


def nearest_mean(own: th.Tensor, others: list[th.Tensor], k: int) -> float:
    distances = sorted(float((own - other).norm()) for other in others)[:k]
    return math.log(1 + sum(distances) / len(distances)) if distances else 0.0


@pytest.mark.parametrize("n_envs, size", [(1, 20), (2, 20), (2, 5)], ids=str)
def test_particle_is_the_distance_to_neighbours_of_other_episodes(n_envs: int, size: int) -> None:
    """Over batch and memory, also one smaller than a batch.

    The replay buffer overwrites its oldest rows, once all of them between two updates, and its stream breaks without an
    end, as in another ``learn()``.
    """
    env = DummyVecEnv([lambda: VectorBox(episode_length=4)] * n_envs)
    kwargs = dict(n_neighbours=3, memory=size)
    arguments: dict[str, Any] = dict(intrinsic="particle", intrinsic_kwargs=kwargs, buffer_size=24 * n_envs)
    model = tiny_model("MlpPolicy", env, srl=None, task=False, learning_starts=24 * n_envs, **arguments)
    model.learn(24 * n_envs)
    model.policy.encoder.update_statistics = lambda views: None  # latents before an update are those in it
    reward, found, buffer = reward_of(model), captured(model), model.replay_buffer
    assert buffer is not None
    episode, number, done = np.arange(24) // 4, 5, True  # of each row; of the latest one, and whether it is its last
    seen = np.zeros((n_envs, 2))
    memory: deque[Any] = deque(maxlen=size)  # row, environment and features; None: overwritten since

    def encode(row: int, env_ind: int) -> th.Tensor:
        with th.no_grad():
            seen = th.as_tensor(buffer.next_observations[row, env_ind])[None]  # type: ignore[union-attr]
            return layer_by_layer(reward.encoder, seen)[0]

    for update in range(7):
        for _ in range(26 if update == 4 else 3):  # the oldest rows go
            row, breaks = buffer.pos, buffer.pos % 4 == 2
            number += done or breaks
            seen, episode[row], done = seen + 0.001 * breaks, number, row % 4 == 3
            following = seen + 0.1 * np.random.randn(n_envs, 2)  # near, so that it matters which of them count
            buffer.add(seen, following, np.zeros((n_envs, 2)), np.zeros(n_envs), np.full(n_envs, done), [{}] * n_envs)
            seen = following
            for i, place in enumerate(memory):
                memory[i] = None if place is None or place[0] == row else place
        state = np.random.get_state()
        buffer.sample(8)
        np.random.set_state(state)
        batch = [(*place, encode(*place)) for place in zip(*buffer.last_sampled, strict=True)]  # type: ignore[attr-defined]
        candidates = batch + [place for place in memory if place is not None]
        expected = [
            nearest_mean(own, [f for r, e, f in candidates if e != env_ind or episode[r] != episode[row]], 3)
            for row, env_ind, own in batch
        ]
        model.train(1, 8)
        np.testing.assert_allclose(found[-1], expected, rtol=1e-3, atol=1e-5)
        memory.extend(batch)
    assert found[-1].min() > 0 and len({float(value) for value in found[-1]}) > 2


def test_particle_forgets_rows_whose_frames_were_lost() -> None:
    """Streams that break in every step leave the ring of frames room for few transitions."""
    kwargs = dict(intrinsic="particle", intrinsic_kwargs=dict(memory=40), buffer_size=24)
    model = tiny_model("CnnPolicy", PixelBox(size=24), srl=None, task=False, **kwargs).learn(24)
    buffer, found = model.replay_buffer, captured(model)
    assert buffer is not None
    for _ in range(12):
        stacks = np.random.randint(0, 256, (2, 1, 6, 24, 24), np.uint8)
        buffer.add(*stacks, np.zeros((1, 2)), np.zeros(1), np.ones(1), [{}])
        model.train(1, 8)
    assert buffer.size() < 20 and len(found) == 12 and found[-1].min() > 0


def test_particle_forgets_a_buffer_that_was_not_loaded(tmp_path: Path) -> None:
    """Rows and environments of the former buffer are no neighbours: there is but one episode so far."""
    kwargs = dict(intrinsic="particle", intrinsic_kwargs=dict(memory=20), srl=None, task=False)
    tiny_model("CnnPolicy", DummyVecEnv([PixelBox] * 2), **kwargs).learn(24).save(tmp_path / "model")
    model = CuReSAC.load(tmp_path / "model", PixelBox(episode_length=50))
    found = captured(model)
    model.learn(4, reset_num_timesteps=False)
    assert len(found) == 4 and not th.stack(found).any()


def test_particle_of_vectors_is_their_distance() -> None:
    """Farther out in a known direction is new; the random map keeps distances, times the gain of sqrt(2)."""
    encoder = reward_of(tiny_model("MlpPolicy", VectorBox(), srl=None, intrinsic="particle")).encoder
    near, far = encoder(th.tensor([[0.1, 0.2], [1.0, 2.0]]))
    th.testing.assert_close((far - near).norm().item(), math.sqrt(2) * math.hypot(0.9, 1.8))


def test_particle_of_a_single_episode_earns_nothing() -> None:
    model = filled_model(srl=None, intrinsic="particle")
    found = captured(model)
    buffer: Any = model.replay_buffer
    buffer.dones[:] = buffer.starts[1:] = 0
    train_once(model)
    assert not found[0].any()


def test_particle_tells_environments_apart() -> None:
    """Each has a single episode in the replay buffer, whose beginning was overwritten."""
    env = DummyVecEnv([lambda: VectorBox(episode_length=50)] * 2)
    model = tiny_model("MlpPolicy", env, srl=None, task=False, intrinsic="particle", buffer_size=20).learn(40)
    found, buffer = captured(model), model.replay_buffer
    assert buffer is not None and not buffer.dones.any()
    train_once(model)
    assert found[0].min() > 0


def test_particle_needs_a_buffer_that_remembers_its_batch() -> None:
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, intrinsic="particle", replay_buffer_class=ReplayBuffer)
    with pytest.raises(ValueError, match="ReplayBuffer does not remember which"):
        model.learn(14)


# ---------------------------------------------------------------- srl_error per pixel


@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_error_per_pixel_is_in_units_of_the_pixels_deviation(target: str) -> None:
    """Squared difference over running variance and dither, by the head before its step; frozen when measuring."""
    model = filled_model(pixels=True, curiosity_target=target, intrinsic_kwargs=dict(per_pixel=True))
    reward, found, batch = reward_of(model), captured(model), sampled(model)
    about = batch.observations if target == "observation" else batch.next_observations
    with th.no_grad():
        drawn = model.policy.srl.reconstruct(model.policy.encode(about)).float() / 255  # type: ignore[union-attr]
    seen = about.float() / 255
    expected = ((drawn - seen) ** 2 / (seen.var(dim=0, correction=0) + 8.1e-5)).flatten(1).mean(dim=1)
    train_once(model)
    th.testing.assert_close(found[0], expected, rtol=1e-4, atol=1e-6)
    train_once(model)  # of the same batch, so are the variances
    with th.no_grad():
        assert not th.allclose(found[1], expected, rtol=1e-4)  # the head has learned
    assert float(reward.weight) == pytest.approx(1 - 0.99**2)  # of a running mean of two updates
    before = reward.variance.clone()
    measured = samples_of(model, 8)
    th.testing.assert_close(
        model.policy.error(measured), reward.error(measured.observations, model.policy.encode(measured.observations))
    )
    assert th.equal(reward.variance, before)


# ---------------------------------------------------------------- shuffled and dictionaries


@pytest.mark.parametrize("of", ["rnd", "icm", "srl_error"])
def test_shuffled_is_the_other_reward_for_the_wrong_samples(of: str) -> None:
    """The same numbers in another order, in each update another one; the reward's networks learn the same."""
    plain = filled_model(pixels=True, intrinsic=of)
    shuffled = filled_model(pixels=True, intrinsic="shuffled", intrinsic_kwargs=dict(of=of))
    ours, theirs = captured(plain), captured(shuffled)
    for model in (plain, shuffled):
        train_once(model, actors=False)
    assert not th.equal(ours[0], theirs[0])
    assert th.equal(ours[0].sort().values, theirs[0].sort().values)
    for own, other in zip(plain.policy.intrinsic.parameters(), reward_of(shuffled).of.parameters(), strict=True):  # type: ignore[union-attr]
        assert th.equal(own, other)
    reward_of(shuffled).of.loss = lambda inputs: (None, th.arange(8.0))
    orders = [reward_of(shuffled).loss(None)[1] for _ in range(2)]
    assert not th.equal(*orders)


@pytest.mark.parametrize("of", [None, "particle"])
def test_memories_of_an_emptied_buffer_are_forgotten(of: str | None) -> None:
    """After a pretraining, by each image's reward, also within the control."""
    kwargs: dict[str, Any] = (
        dict(intrinsic="particle") if of is None else dict(intrinsic="shuffled", intrinsic_kwargs=dict(of=of))
    )
    reward = reward_of(sensor_model(learning_starts=20, **kwargs).pretrain(30))
    parts = (reward if of is None else reward.of).rewards
    assert len(parts) == 2 and all((part.places == -1).all() for part in parts)


def test_dictionary_rewards_read_their_own_image() -> None:
    """Per pixel: the views and latents of their own head; the mean of both, each divided by its size."""
    model = sensor_model(intrinsic_kwargs=dict(per_pixel=True), learning_starts=100).learn(20)
    policy: Any = model.policy
    randomise(policy)
    sampled = policy.samples(model.replay_buffer.sample(8), random=False)  # type: ignore[union-attr]
    images = {key: noise_images(model.observation_space[key]) for key in policy.srl.slices}  # type: ignore[index]
    batch, latents = sampled._replace(observations={**sampled.observations, **images}), th.randn(8, 18)
    with th.no_grad():
        _, reward = reward_of(model).loss(inputs_of(model, batch, latents, latents))
        expected = []
        for key, head, part in policy.srl.parts(latents):
            seen, drawn = images[key].float() / 255, head.reconstruct(part).float() / 255
            error = ((drawn - seen) ** 2 / (seen.var(dim=0, correction=0) + 8.1e-5)).flatten(1).mean(dim=1)
            expected.append(error / error.square().mean().sqrt())
    th.testing.assert_close(reward, sum(expected) / 2, rtol=1e-3, atol=1e-4)


# ---------------------------------------------------------------- networks


def test_networks_see_every_pixel() -> None:
    """Whatever the size: the outputs depend on each of them."""
    space = PixelBox(size=13).observation_space
    images = th.randn(1, *space.shape, requires_grad=True)  # type: ignore[misc]
    make_network(space, [16, 4])(images).square().sum().backward()
    assert images.grad is not None and (images.grad != 0).all()


def test_new_room_pays_and_shuffled_does_not_know() -> None:
    """In a room that was never entered rnd pays much more than in the known one; its permutation the same."""
    pays = world.paid("rnd", seed=0, updates=40)
    assert pays["new"] > 2 * pays["known"]
    chance = world.paid("shuffled (of rnd)", seed=0, updates=0)
    assert 0.7 < chance["new"] / chance["known"] < 1.4
