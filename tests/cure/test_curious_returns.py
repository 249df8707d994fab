"""How the curious agent values ends of episodes."""

from typing import Any

import numpy as np
import pytest
import torch as th
from agents_for_tests import q_values
from envs_for_tests import Cliff, VectorBox, tiny_model
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure import CuReSAC
from sb3_cure.srl import SRLHead, SRLOutput


class ResetsAreNovel(SRLHead):
    """No parameters; the error is high at resets, which no action leads to, and else a little higher to the right."""

    sign = 1

    def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
        position, reset, _ = batch.observations.unbind(dim=1)
        return SRLOutput(0 * latents.square().mean(), 1 + self.sign * reset + 0.05 * (position + 2))


class ResetsAreKnown(ResetsAreNovel):
    """The error is low at resets."""

    sign = -1


def curious_on_the_cliff(curiosity_gamma: float, ent_coef: float, updates: int, **kwargs: Any) -> CuReSAC:
    """A curious agent, trained on random transitions of the cliff."""
    arguments: dict[str, Any] = dict(task=False, learning_starts=1000, learning_rate=1e-3)
    arguments |= dict(buffer_size=1000, target_update_interval=1, tau=0.02, encoder_tau=0.05, batch_size=32)
    arguments |= dict(curiosity_gamma=curiosity_gamma, ent_coef=ent_coef, policy_kwargs={"net_arch": [16, 16]})
    model = tiny_model("MlpPolicy", Cliff(), **{**arguments, **kwargs}).learn(1000)
    assert 10 < model.replay_buffer.dones[:1000].sum() < 200
    model.train(updates, batch_size=model.batch_size)
    return model


def deaths(model: CuReSAC) -> float:
    """Of episodes of the curious policy that start in the left half, the share that end in a fall within 10 steps."""
    env = Cliff()
    falls = []
    for position in np.linspace(-0.95, 0, 20):
        observation, _ = env.reset(seed=0)
        env.position = observation[0] = position
        for _ in range(10):
            action, _ = model.predict_curious(observation, deterministic=True)
            observation, _, fell, _, _ = env.step(action)
            if fell:
                break
        falls.append(fell)
    return float(np.mean(falls))


def gain_of_dying(model: CuReSAC) -> float:
    """By how much the curious critics prefer the fall to the step back, close to the edge."""
    latents = model.policy.encode(th.tensor([[-0.9, 0.0, 0.0]] * 2))
    with th.no_grad():
        fall, step_back = q_values(model, "curious", latents, th.tensor([[-1.0], [1.0]])).mean(dim=1)
    return float(fall - step_back)


@pytest.mark.parametrize(
    ("head", "is_episodic", "pays"),
    [(ResetsAreNovel, False, True), (ResetsAreKnown, False, False), (ResetsAreNovel, True, True)],
)
def test_dying_is_worth_what_follows(head: type[SRLHead], is_episodic: bool, pays: bool) -> None:
    """By default the next episode. If the return ends, nearly all rewards are below the mean: ending them pays."""
    model = curious_on_the_cliff(0.9, 0.02, 500, learning_rate=3e-3, srl=head, curiosity_episodic=is_episodic)
    gain = gain_of_dying(model)
    assert gain > 0.1 if pays else gain < -0.1
    assert pays or deaths(model) < 0.2


def test_restarts_are_normalised_as_successors_are() -> None:
    env = VecNormalize(DummyVecEnv([Cliff]), norm_reward=False)
    model = tiny_model("MlpPolicy", env, learning_starts=200, batch_size=64).learn(200)
    batch = model._sample_batch(64, model._learners())
    ended = batch.dones[:, 0] > 0
    assert 0 < ended.sum() < 64
    assert th.equal(batch.restarts[~ended], batch.next_observations[~ended])
    # Of three numbers the last is 1 after a fall alone, and the one before it at a reset alone
    first = env.normalize_obs(np.array([[0.0, 1, 0]], np.float32))
    np.testing.assert_allclose(batch.restarts[ended][:, 1:], first[:, 1:].repeat(int(ended.sum()), 0), rtol=1e-5)


def test_transition_model_must_say_what_it_is() -> None:
    """Else it would take the next observations alone, whose error is wanted, for transitions: that fails loudly."""

    class Undeclared(SRLHead):
        def loss(self, batch: Any, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
            error = (batch.observations + 0.3 * batch.actions - batch.next_observations).square().mean(dim=1)
            return SRLOutput(error.mean() + 0 * latents.sum(), error)

    settings: dict[str, Any] = dict(srl=Undeclared, learning_starts=40)
    tiny_model("MlpPolicy", VectorBox(), **settings).learn(40).train(1, batch_size=8)
    with pytest.raises(TypeError, match="NoneType"):
        tiny_model("MlpPolicy", VectorBox(), curiosity_target="next_observation", **settings).learn(41)
