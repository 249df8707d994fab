"""Returns of several steps for the task's critic, while everything else sees single steps."""

from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from hypothesis import HealthCheck, given, settings
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from twins_for_tests import Twins, assert_equal, seeded_sample, streams
from updates_for_tests import ALGORITHMS

from sb3_cure import CuReSAC
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.samples import NStep, Samples

GAMMA = 0.9
pytestmark = pytest.mark.filterwarnings("ignore:Frames do not slide")
both_algorithms = pytest.mark.parametrize("algorithm", list(ALGORITHMS))


def sb3s(twins: Twins, n_steps: int) -> NStepReplayBuffer:
    """SB3's n-step buffer with what its twin holds, and timeouts where the stream breaks, of which it does not know."""
    source: Any = twins.sb3
    arguments = (source.buffer_size * twins.n_envs, twins.space, twins.action_space, "cpu", twins.n_envs)
    buffer = NStepReplayBuffer(*arguments, n_steps=n_steps, gamma=GAMMA)
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "pos", "full")
    vars(buffer).update({name: getattr(source, name) for name in names})
    breaks = np.roll(twins.ours.starts, -1, axis=0)
    buffer.timeouts = np.where(breaks & (source.dones == 0), 1, source.timeouts)
    return buffer


def assert_sums_equal(ours: Any, reference: NStepReplayBuffer, n_steps: int, env: Any = None) -> None:
    """Of the batch that was sampled last."""
    rows, env_inds = ours.last_sampled
    with mock.patch("numpy.random.randint", return_value=env_inds):
        expected = reference._get_samples(rows, env)
    found = ours.n_step(n_steps, GAMMA, env)
    assert_equal(found, NStep(*(getattr(expected, name) for name in NStep._fields)))


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(streams())
def test_sums_of_any_stream_equal_sb3s(twins: Twins) -> None:
    """At terminations, timeouts, the newest row, lost rows, lost steps and where a stream breaks."""
    batch = seeded_sample(twins.ours, 40)
    if twins.kind != "dictionary":  # which SB3's has not
        assert_sums_equal(twins.ours, sb3s(twins, 3), 3)
    one = twins.ours.n_step(1, GAMMA)
    assert_equal(batch._replace(**one._asdict()), batch._replace(discounts=th.full((40, 1), GAMMA)))


def test_sums_end_before_a_lost_step() -> None:
    """Also where the observation stands still, and only ``break_stream`` can know."""
    space = VectorBox().observation_space
    buffer = FrameStackReplayBuffer(10, space, VectorBox().action_space, "cpu", frame_stack=1)
    for t in range(6):
        if t == 3:
            buffer.break_stream()
        still = np.zeros((1, 2), np.float32)
        buffer.add(still, still, np.zeros((1, 2)), np.array([10.0**t]), np.zeros(1), [{}])
    buffer.last_sampled = np.array([0, 1, 2, 3]), np.zeros(4, int)
    found = buffer.n_step(5, 1.0)
    assert found.rewards.flatten().tolist() == [111, 110, 100, 111_000] and found.dones.sum() == 0


def test_normalised_rewards_and_observations() -> None:
    """Each reward is normalised before it is discounted, as SB3 does."""
    venv = VecNormalize(make_vec_env(lambda: VectorBox(), 2))
    ours: Any = tiny_model("MlpPolicy", venv, n_steps=3, gamma=GAMMA).learn(40).replay_buffer
    arguments = (ours.buffer_size * 2, ours.observation_space, ours.action_space, "cpu", 2)
    reference = NStepReplayBuffer(*arguments, n_steps=3, gamma=GAMMA)
    for name in ("actions", "rewards", "dones", "timeouts", "pos", "full"):
        setattr(reference, name, getattr(ours, name))
    for name in ("observations", "next_observations"):
        setattr(reference, name, ours.rows[f"{name}/"])
    ours.sample(50, env=venv)
    assert_sums_equal(ours, reference, 3, venv)


# ------------------------------------------------------------------------------------------ who learns from what


def recorded_targets(model: CuReSAC, monkeypatch: pytest.MonkeyPatch) -> tuple[Samples, list[th.Tensor]]:
    """Make one update, and return its batch and the critics' targets, the task's first.

    Target critics return the mean of the latents that they get, and actors log-probabilities made of theirs.
    """
    batches, targets = [], []
    update = model._update

    def noted_update(batch: Samples, *args: Any) -> Any:
        batches.append(batch)
        return update(batch, *args)

    monkeypatch.setattr(model, "_update", noted_update)
    for agent in model.policy.agents.values():

        def noted_loss(latents: th.Tensor, actions: th.Tensor, target: th.Tensor, loss: Any = agent.critic.loss) -> Any:
            targets.append(target)
            return loss(latents, actions, target)

        monkeypatch.setattr(agent.critic, "loss", noted_loss)
        monkeypatch.setattr(agent.critic_target, "target_values", lambda latents, _: latents.mean(1, keepdim=True))
        monkeypatch.setattr(
            agent.actor, "action_log_prob", lambda seen: (th.zeros(len(seen), 2), seen.float().mean(1, keepdim=True))
        )
    model._n_rl_batches = 1  # no step of the actors, whose log-probabilities have no gradient
    model.train(1, 32)
    return batches[0], targets


@both_algorithms
@pytest.mark.parametrize("curiosity", ["separate", None])
def test_task_bootstraps_after_n_steps_and_curiosity_after_one(
    algorithm: str, curiosity: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_model(
        "CnnPolicy", PixelBox(), ALGORITHMS[algorithm], curiosity=curiosity, n_steps=3, gamma=0.5, learning_rate=0.0
    ).learn(40)
    passes: list[int] = []
    model.policy.encoder_target.register_forward_hook(lambda *args: passes.append(1))
    batch, targets = recorded_targets(model, monkeypatch)
    assert batch.n_step is not None
    assert_equal(batch.n_step, model.replay_buffer.n_step(3, 0.5))  # type: ignore[union-attr]
    assert not th.equal(batch.n_step.next_observations, batch.next_observations)
    assert len(targets) == len(passes) == (1 if curiosity is None else 2)

    def soft_value(observations: th.Tensor, agent: Any) -> th.Tensor:
        with th.no_grad():
            seen = model.policy.center(observations)
            log_prob = model.policy.encoder.trunk(seen).mean(1, keepdim=True)
            return model.policy.encoder_target(seen).mean(1, keepdim=True) - agent.temperature() * log_prob

    discounts = (1 - batch.n_step.dones) * batch.n_step.discounts
    expected = batch.n_step.rewards + discounts * soft_value(batch.n_step.next_observations, model.policy.task)
    th.testing.assert_close(targets[0], expected)
    if curiosity is not None:
        after = model.curiosity_gamma * soft_value(batch.next_observations, model.policy.curious)
        # Standardised rewards: of mean zero
        assert float((targets[1] - after).mean()) == pytest.approx(0, abs=1e-3)
        assert not th.allclose(targets[1], after)


def test_the_task_learns_from_normalised_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of rewards and observations, as everything else that is sampled."""
    venv = VecNormalize(make_vec_env(lambda: VectorBox(), 2))
    model = tiny_model("MlpPolicy", venv, curiosity=None, n_steps=3, gamma=0.5).learn(40)
    batch, _ = recorded_targets(model, monkeypatch)
    buffer: Any = model.replay_buffer
    assert batch.n_step is not None
    assert_equal(batch.n_step, buffer.n_step(3, 0.5, venv))
    assert not th.equal(batch.n_step.rewards, buffer.n_step(3, 0.5).rewards)


@both_algorithms
def test_heads_and_rewards_see_single_steps(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one-step fields are those of a model with n_steps=1, draw for draw."""
    models = [
        tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], n_steps=n, learning_rate=0.0, seed=3).learn(30)
        for n in (1, 3)
    ]
    batches = []
    for model in models:
        np.random.seed(0)
        batches.append(recorded_targets(model, monkeypatch)[0])
    one, three = batches
    assert one.n_step is None and three.n_step is not None
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert th.equal(getattr(one, name), getattr(three, name)), name
