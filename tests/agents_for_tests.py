"""What the tests read of a model's two agents."""

from typing import Any

import torch as th

from sb3_cure import CuReSAC


def q_values(model: CuReSAC, name: str, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Compute what each of an agent's critics says.

    :param model: A model
    :param name: ``"task"`` or ``"curious"``
    :param latents: Latents of the shared encoder, [B, features_dim]
    :param actions: In [-1, 1], [B, action_dim]
    :return: [B, n_critics]
    """
    return model.policy.agents[name].critic(latents, actions).squeeze(2)


def steps_of(optimizer: Any) -> int:
    """Count the steps of an optimiser.

    :param optimizer: An Adam
    :return: Steps that it has made
    """
    return max((int(state["step"]) for state in optimizer.state.values()), default=0)
