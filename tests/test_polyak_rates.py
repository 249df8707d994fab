"""How fast each target network follows."""

import pytest
import torch as th
from agents_for_tests import actor_critic, one_update
from envs_for_tests import VectorBox, tiny_model


@pytest.mark.parametrize("update", ["sequential", "joint"])
def test_targets_follow_at_their_own_rates(update: str) -> None:
    """Critics of both agents at ``tau``, the encoder at ``encoder_tau``: here each has to make up a distance of 1."""
    model = tiny_model(
        "MlpPolicy", VectorBox(), learning_starts=40, learning_rate=0.0, tau=0.1, encoder_tau=0.6, update=update
    ).learn(40)
    pairs = {
        "encoder": (model.policy.encoder, model.policy.encoder_target),
        "task": (actor_critic(model, "task").critic, actor_critic(model, "task").critic_target),
        "curious": (actor_critic(model, "curious").critic, actor_critic(model, "curious").critic_target),
    }
    with th.no_grad():
        for source, target in pairs.values():
            for parameter, followed in zip(target.parameters(), source.parameters(), strict=True):
                parameter.copy_(followed + 1)
    one_update(model)
    left = {
        name: [float((p - q).detach().mean()) for p, q in zip(target.parameters(), source.parameters(), strict=True)]
        for name, (source, target) in pairs.items()
    }
    assert left["encoder"] == pytest.approx([0.4] * len(left["encoder"]), abs=1e-5)
    assert left["task"] == pytest.approx([0.9] * len(left["task"]), abs=1e-5)
    assert left["curious"] == pytest.approx([0.9] * len(left["curious"]), abs=1e-5)
