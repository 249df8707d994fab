"""How the curious agent values ends of episodes."""

import os
from typing import Any

import numpy as np
import pytest
import torch as th
from agents_for_tests import q_values
from envs_for_tests import Cliff, VectorBox, tiny_model

from sb3_cure import CuReSAC
from sb3_cure.srl import SRLHead, SRLOutput


class ResetsAreNovel(SRLHead):
    """No parameters; the error is high at resets, which no action leads to, and else a little higher to the right."""

    def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
        position, reset, _ = batch.observations.unbind(dim=1)
        return SRLOutput(0 * latents.square().mean(), reset + 0.05 * (position + 2))


def curious_on_the_cliff(curiosity_gamma: float, ent_coef: float, updates: int, **kwargs: Any) -> CuReSAC:
    """A curious agent, trained on random transitions of the cliff."""
    arguments: dict[str, Any] = dict(srl=ResetsAreNovel, task=False, learning_starts=1000, learning_rate=1e-3)
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


@pytest.mark.parametrize("arguments, pays", [({}, False), ({"curiosity_episodic": True}, True)])
def test_dying_is_not_preferred_by_default(arguments: dict[str, Any], pays: bool) -> None:
    """Nearly all rewards are below the mean: ending them pays if the return ends with the episode, and only then."""
    model = curious_on_the_cliff(0.9, 0.02, 500, learning_rate=3e-3, **arguments)
    gain = gain_of_dying(model)
    assert gain > 0.1 if pays else gain < -0.1
    assert pays or deaths(model) < 0.2


def test_curious_values_of_terminal_states_stay_bounded() -> None:
    """Over 20 000 updates they stay near those of the states that are learned, far from what rewards of 5 allow (500).

    No sample starts from terminal states, so that no update corrects their values, which targets bootstrap from.
    By default a tenth of the updates, with targets that follow ten times as fast: as many horizons of the return.
    """
    speed = 1 if os.environ.get("SB3_CURE_TEST_ALL") else 10
    model = curious_on_the_cliff(0.99, 0.02, 0, learning_rate=3e-3, batch_size=16, tau=0.02 * speed)
    ended = model.replay_buffer.dones[:1000, 0] == 1
    ends = th.as_tensor(model.replay_buffer.next_observations[:1000, 0][ended])
    starts = th.as_tensor(model.replay_buffer.observations[:1000, 0])
    actions = th.linspace(-1, 1, 1000)[:, None]
    for _ in range(4):
        model.train(5_000 // speed, batch_size=16)
        with th.no_grad():
            at_ends = q_values(model, "curious", model.policy.encode(ends), actions[: len(ends)])
            at_starts = q_values(model, "curious", model.policy.encode(starts), actions)
        assert float(at_starts.abs().max()) < 60
        assert float(at_starts.min()) - 5 < float(at_ends.min()) <= float(at_ends.max()) < float(at_starts.max()) + 5


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
