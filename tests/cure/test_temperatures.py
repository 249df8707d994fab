"""Each agent has a temperature of its own, and uses no other."""

from typing import Any

import pytest
from agents_for_tests import actor_critic, one_update
from envs_for_tests import VectorBox, tiny_model

from sb3_cure import CuReSAC

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])


def frozen_model(**kwargs: Any) -> CuReSAC:
    """A model with transitions in its buffer, in which nothing moves: of equal seeds, updates log equal losses."""
    return tiny_model("MlpPolicy", VectorBox(), learning_starts=40, learning_rate=0.0, **kwargs).learn(40)


@both_updates
@pytest.mark.parametrize("hotter, other", [("task", "curious"), ("curious", "task")])
def test_temperature_changes_only_its_own_losses(hotter: str, other: str, update: str) -> None:
    """Target of the critics, loss of the actor and of the temperature: all with the agent's own temperature."""
    model = frozen_model(update=update)
    prefix = {"task": "", "curious": "curious_"}
    losses = []
    for temperature in (0.1, 3.0):
        actor_critic(model, hotter).set_temperature(temperature)
        actor_critic(model, other).set_temperature(0.5)
        model._n_rl_batches = 0  # an update of the actors, too
        losses.append(one_update(model))
    for name in ("critic_loss", "actor_loss", "ent_coef_loss", "ent_coef"):
        assert losses[0][prefix[hotter] + name] != losses[1][prefix[hotter] + name], name
        assert losses[0][prefix[other] + name] == losses[1][prefix[other] + name], name


@both_updates
def test_each_temperature_learns_from_its_own_actor(update: str) -> None:
    """An actor far more random than wanted cools its own temperature, one far too certain heats its own."""
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=40, update=update).learn(40)
    # Outputs of `log_std` are squashed to [-10, 2]: the first is all but deterministic, the second about uniform.
    for name, log_std in (("task", -10.0), ("curious", 0.8)):
        actor = actor_critic(model, name).actor
        actor.log_std.weight.data.zero_()
        actor.log_std.bias.data.fill_(log_std)
        actor.mu.weight.data.zero_()
    model.target_entropy = -0.5
    before = {name: float(actor_critic(model, name).log_ent_coef.detach()) for name in ("task", "curious")}
    one_update(model)
    moved = {name: float(actor_critic(model, name).log_ent_coef.detach()) - before[name] for name in before}
    assert moved["task"] > 0 > moved["curious"]
