"""Whose error rewards a transition, for heads of single observations and for heads of transitions."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import one_update
from envs_for_tests import VectorBox, tiny_model
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_cure import CuReSAC
from sb3_cure.srl import SRLHead, SRLOutput

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])


class Single(SRLHead):
    """A head of single observations: the error is twice the first number of an observation, made positive."""

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        return SRLOutput(0 * latents.square().mean(), 2 + 2 * batch.observations[:, 0])


class Transitions(SRLHead):
    """A head that predicts s' from (s, a), where ``next = observation + 0.3 action`` within the square: its error is 0
    for true transitions, and only for these."""

    needs_next_latents = True

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.rate = nn.Parameter(th.tensor(0.3))
        self.seen: list[ReplayBufferSamples] = []

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        self.seen.append(batch)
        predicted = (batch.observations + self.rate * batch.actions).clamp(-1, 1)
        error = (predicted - batch.next_observations).square().mean(dim=1)
        return SRLOutput(error.mean(), error.detach())


class Undeclared(Transitions):
    """The same, without saying so."""

    needs_next_latents = False


def model_with_transitions(srl: type[SRLHead], **kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), srl=srl, learning_starts=60, learning_rate=0.0, **kwargs).learn(60)


def last_batch(model: CuReSAC, monkeypatch: pytest.MonkeyPatch) -> ReplayBufferSamples:
    """Let updates see one batch, and return it."""
    batch = model.replay_buffer.sample(32)
    monkeypatch.setattr(model.replay_buffer, "sample", lambda *args, **kwargs: batch)
    return batch


@both_updates
@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_single_observation_heads_err_about_the_target(
    target: str, update: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_with_transitions(Single, curiosity_target=target, update=update)
    batch = last_batch(model, monkeypatch)
    about = batch.observations if target == "observation" else batch.next_observations
    assert not th.allclose(batch.observations, batch.next_observations)
    logged = one_update(model)
    assert logged["curious_reward_raw_mean"] == pytest.approx(float((2 + 2 * about[:, 0]).mean()), rel=1e-5)
    assert logged["curious_reward_raw_max"] == pytest.approx(float((2 + 2 * about[:, 0]).max()), rel=1e-5)


@both_updates
@pytest.mark.parametrize("target", ["observation", "next_observation"])
def test_transition_models_always_see_true_transitions(
    target: str, update: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(s, a, s'), never (s', a, s'): of a perfect model the curious reward is made of errors of 0."""
    model = model_with_transitions(Transitions, curiosity_target=target, update=update)
    batch = last_batch(model, monkeypatch)
    model.policy.srl.seen.clear()
    logged = one_update(model)
    assert all(th.equal(seen.observations, batch.observations) for seen in model.policy.srl.seen)
    assert logged["curious_reward_raw_max"] < 1e-10


def test_transition_models_must_say_what_they_are() -> None:
    """Else what they would be shown for the next observations' errors is no transition: that fails, loudly."""
    model = model_with_transitions(Undeclared, curiosity_target="next_observation")
    with pytest.raises(TypeError, match="NoneType"):
        model.train(1, batch_size=8)
    model_with_transitions(Undeclared).train(1, batch_size=8)
