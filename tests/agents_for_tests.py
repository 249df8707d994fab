"""Where the tests find the parts of an agent: the only file of theirs that knows how a model holds its two agents."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_cure import CuReSAC


@dataclass
class ActorCriticForTests:
    """One of the two agents of a model.

    :param actor: Its actor
    :param critic: Its critics
    :param critic_target: Their moving averages
    :param log_ent_coef: Logarithm of its learned temperature, or None if that is fixed
    """

    actor: th.nn.Module
    critic: th.nn.Module
    critic_target: th.nn.Module
    log_ent_coef: th.Tensor | None

    @th.no_grad()
    def set_temperature(self, temperature: float) -> None:
        """Set the learned temperature.

        :param temperature: New value of the learned temperature
        """
        self.log_ent_coef.fill_(float(np.log(temperature)))


def actor_critic(model: CuReSAC, name: str) -> ActorCriticForTests:
    """Get one of the two agents.

    :param model: A model
    :param name: ``"task"`` or ``"curious"``
    :return: That agent
    """
    agent = model.policy.agents[name]
    return ActorCriticForTests(agent.actor, agent.critic, agent.critic_target, agent.log_ent_coef)


def q_values(model: CuReSAC, name: str, latents: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """Compute what each of an agent's critics says.

    :param model: A model
    :param name: ``"task"`` or ``"curious"``
    :param latents: Latents of the shared encoder, [B, features_dim]
    :param actions: In [-1, 1], [B, action_dim]
    :return: [B, n_critics]
    """
    return actor_critic(model, name).critic(latents, actions).squeeze(2)


def steps_of(optimizer: Any) -> int:
    """Count the steps of an optimiser.

    :param optimizer: An Adam
    :return: Steps that it has made
    """
    return max((int(state["step"]) for state in optimizer.state.values()), default=0)
