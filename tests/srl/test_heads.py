"""What all built-in heads have in common, and what those of transitions need. Losses: ``tests/test_gradients.py``."""

import copy
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import differences, samples_of, tiny_model
from gymnasium.wrappers import TimeLimit
from torch import nn
from updates_for_tests import filled_model, standardised, train_once

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.data.samples import Samples
from sb3_cure.envs import physics_state_names, physics_state_units
from sb3_cure.evaluation.probe import state_probe
from sb3_cure.evaluation.rollouts import Episode, run_episodes, srl_errors
from sb3_cure.srl import SRL_HEADS

HEADS = pytest.mark.parametrize("srl", SRL_HEADS)
OF_TRANSITIONS = pytest.mark.parametrize("srl", ["spr", "forward", "inverse"])


# ---------------------------------------------------------------- the error


@HEADS
@pytest.mark.parametrize("pixels", [True, False])
def test_error_is_finite_and_not_negative(srl: str, pixels: bool) -> None:
    """Of every built-in head, in training and when it is measured; also after an update in bf16."""
    if srl == "curl" and not pixels:
        pytest.skip("compares views of images")
    model = filled_model(pixels=pixels, srl=srl, precision="bf16", curiosity=None)
    train_once(model, rl=False)
    head, batch = model.policy.srl, samples_of(model, 16)
    latents = model.policy.encode(batch.observations)
    output = head.loss(batch, latents, *([latents.flip(0)] if head.needs_next_latents else []))
    measured = head.error(batch, latents)
    for error in (output.error, measured):
        assert error.shape == (16,) and error.dtype == th.float32 and not error.requires_grad
        assert error.isfinite().all() and (error >= 0).all() and error.std() > 0


@pytest.mark.parametrize("srl", ["vae", "spr", "forward", "inverse"])
def test_measured_error_is_that_of_a_transition_alone(srl: str) -> None:
    """It draws nothing, changes nothing, and does not depend on the other samples."""
    model = filled_model(pixels=True, srl=srl, augmentation="shift", curiosity=None)
    train_once(model, rl=False)
    head, batch = model.policy.srl, samples_of(model, 16)
    latents = model.policy.encode(batch.observations).detach()
    before, drawn = copy.deepcopy(model.policy.state_dict()), th.get_rng_state()
    errors = head.error(batch, latents)
    assert th.equal(th.get_rng_state(), drawn) and not differences(before, model.policy.state_dict())
    part = Samples(*(None if column is None else column[3:5] for column in batch))  # type: ignore[arg-type]
    th.testing.assert_close(head.error(part, latents[3:5]), errors[3:5], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(srl_errors(model, batch), errors, rtol=1e-4, atol=1e-5)


def test_moving_average_of_spr_keeps_no_graph() -> None:
    """Which would grow with each update."""
    model = filled_model(pixels=True, srl="spr", curiosity=None)
    train_once(model, rl=False)
    target: Any = model.policy.srl.target_projection  # type: ignore[union-attr]
    assert all(parameter.grad_fn is None and not parameter.requires_grad for parameter in target.parameters())


def test_noise_of_the_vae_is_that_of_its_own_variance() -> None:
    """Measured, it draws from the mean; trained, from N(mean, sigma^2): what is drawn varies as much as that."""
    model = filled_model(srl="vae", curiosity=None)
    head: Any = model.policy.srl
    head.decoder = drawn = nn.Identity()
    batch = Samples(th.zeros(20_000, 2), *[None] * 4)  # type: ignore[arg-type]
    head.target = lambda views, dither: th.zeros(20_000, 8)
    with th.no_grad():
        head.log_variance.bias.copy_(th.linspace(-6, 1, 8))
    latents = th.full((20_000, 8), 0.5)
    seen: list[th.Tensor] = []
    drawn.register_forward_hook(lambda _, inputs, output: seen.append(output))
    head.loss(batch, latents)
    head.error(batch, latents)
    in_training, measured = seen
    th.testing.assert_close(in_training.mean(dim=0), latents[0], rtol=0, atol=0.05)
    th.testing.assert_close(in_training.var(dim=0), th.linspace(-6, 1, 8).exp(), rtol=0.05, atol=0)
    assert th.equal(measured, latents)


def test_vae_begins_with_noise_smaller_than_its_latents_and_pays_for_divergence() -> None:
    """Latents lie in (-1, 1): more noise would hide them. A divergence never lowers the loss."""
    head: Any = filled_model(srl="vae", curiosity=None).policy.srl
    latents = th.linspace(-0.9, 0.9, 8).expand(16, 8)
    assert float(head.log_variance(latents).detach().exp().max()) < 0.5
    batch = Samples(th.zeros(16, 2), *[None] * 4)  # type: ignore[arg-type]
    losses = []
    for beta in (0.0, head.beta):
        head.beta = beta
        th.manual_seed(0)
        losses.append(head.loss(batch, latents).loss.item())
    assert losses[1] > losses[0]


# ---------------------------------------------------------------- heads of transitions


@OF_TRANSITIONS
def test_error_is_about_the_true_transition(srl: str) -> None:
    """``curiosity_target`` shows the head nothing else; its error pays the curious agent."""
    model = filled_model(srl=srl, curiosity_target="next_observation", learning_rate=0.0)
    shown: list[Samples] = []
    loss = model.policy.srl.loss
    model.policy.srl.loss = lambda batch, *given: (shown.append(batch), loss(batch, *given))[1]  # type: ignore
    logged = train_once(model)
    ((batch,), sampled) = shown, model.replay_buffer
    np.random.seed(1)
    for ours, stored in zip(batch[:4], sampled.sample(len(batch.actions))[:4], strict=True):
        assert th.equal(ours, stored)
    assert logged["curious_reward_raw_mean"] == logged["srl_error"]


def let_predict(head: Any, latents: th.Tensor) -> None:
    """Let these be the latents of next observations that the head predicts."""
    head.project = lambda latents: latents
    head.target_encoder.forward = lambda views: latents


@pytest.mark.parametrize("size", [1e-2, 1.0])
@pytest.mark.parametrize("srl", ["spr", "forward"])
def test_small_latents_are_no_easier_to_predict(srl: str, size: float) -> None:
    """The target is standardised; else a collapsed encoder would be the best one. By the batch, or as was seen."""
    model = filled_model(srl=srl, curiosity=None)
    head: Any = model.policy.srl
    seen: list[th.Tensor] = []
    head.distance = lambda inputs, target: (seen.append(target), target.square().mean(dim=1))[1]
    latents = 0.3 + size * th.randn(64, 8, generator=th.Generator().manual_seed(0))
    let_predict(head, latents)
    batch = samples_of(model, 64)
    for _ in range(200):
        head.loss(batch, latents)
    th.testing.assert_close(seen[0], standardised(latents))
    assert float(seen[0].var()) > 0.8
    head.error(batch, latents)
    th.testing.assert_close(seen[-1], seen[0], rtol=1e-3, atol=1e-3)


def test_running_statistics_of_targets_follow_slowly() -> None:
    """A batch moves them towards its own; it neither replaces them nor throws them beyond."""
    model = filled_model(srl="spr", curiosity=None)
    head: Any = model.policy.srl
    batch, low, high = samples_of(model, 64), 1 + th.randn(64, 8), 50 + 9 * th.randn(64, 8)
    let_predict(head, low)
    for _ in range(50):
        head.loss(batch, low)
    before = head.mean.clone(), head.variance.clone()
    let_predict(head, high)
    head.loss(batch, low)
    for old, new, goal in zip(before, (head.mean, head.variance), (high.mean(dim=0), high.var(dim=0)), strict=True):
        assert ((old < new) & (new < goal)).all()


# ---------------------------------------------------------------- what they learn

#: Updates, batch and learning rate after which latents tell the positions
LEARNS = {"vae": (700, 32, 2e-3), "spr": (400, 48, 1e-3), "forward": (300, 32, 2e-3), "inverse": (200, 32, 2e-3)}


def cups() -> gym.Env:
    """Short episodes, so that there are many starts, and a ball of fewer faces, which takes most of the drawing."""
    env = make_dmc_env("ball_in_cup", "catch", image_size=36, grayscale=True, renderer="fast")
    quality = env.get_wrapper_attr("physics").model.vis.quality
    quality.numslices, quality.numstacks = 12, 8
    return TimeLimit(env, 25)


def model_of_cups(env: gym.Env, srl: str | None, hidden: int = 16, **kwargs: Any) -> CuReSAC:
    small = dict(net_arch=[hidden], features_extractor_kwargs=dict(n_filters=8))
    return tiny_model("CnnPolicy", env, srl=srl, curiosity=None, policy_kwargs=small, buffer_size=1000, **kwargs)


@pytest.fixture(scope="module")
def real_frames() -> Iterator[tuple[gym.Env, Any, list[Episode]]]:
    """An environment of DeepMind Control, 1000 random transitions of it, and other episodes with their states."""
    env = cups()
    model = model_of_cups(env, "rae", learning_starts=1000).learn(1000)
    yield env, model.replay_buffer, list(run_episodes(model, env, 20, "random", states=True, seed=7))
    env.close()


def r2_of_positions(model: CuReSAC, env: gym.Env, episodes: list[Episode]) -> float:
    """Of a linear map from latents to where cup and ball are."""
    found = state_probe(model, episodes, physics_state_names(env), physics_state_units(env))
    return float(np.mean([found[name] for name in ("cup_x", "cup_z", "ball_x", "ball_z")]))


@pytest.mark.parametrize(
    "srl", [*(pytest.param(srl, marks=pytest.mark.long) for srl in ("vae", "spr")), "forward", "inverse"]
)
def test_latents_tell_the_state(srl: str, real_frames: tuple[gym.Env, Any, list[Episode]]) -> None:
    """The positions of cup and ball, from images, by a linear map: far better than those of the untrained encoder.

    Trained by the head alone, in which a collapse of the latents would show, too.
    """
    env, buffer, episodes = real_frames
    updates, batch_size, learning_rate = LEARNS[srl]
    model = model_of_cups(env, srl, learning_rate=learning_rate, batch_size=batch_size).learn(1)
    model.replay_buffer = buffer
    untrained = r2_of_positions(model, env, episodes)
    model.fit_representation(updates)
    trained = r2_of_positions(model, env, episodes)
    assert untrained < 0.15 and trained > 0.4, (untrained, trained)


@pytest.mark.long
def test_augmentation_alone_makes_latents_tell_the_state(real_frames: tuple[gym.Env, Any, list[Episode]]) -> None:
    """Without a head, by what the task's critics teach the encoder of shifted images (DrQ's idea)."""
    env, buffer, episodes = real_frames
    shifted: Any = dict(augmentation="shift", augmentation_kwargs=dict(pad=2), gamma=0.9, learning_rate=1e-3)
    model = model_of_cups(env, None, hidden=64, **shifted).learn(1)
    model.replay_buffer = buffer
    untrained = r2_of_positions(model, env, episodes)
    model.train(800, 48)
    trained = r2_of_positions(model, env, episodes)
    assert untrained < 0.15 and trained > 0.4, (untrained, trained)
