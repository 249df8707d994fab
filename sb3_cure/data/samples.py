"""What heads, intrinsic rewards and critics get of a batch."""

from typing import NamedTuple

import torch as th


class Samples(NamedTuple):
    """
    A batch of B transitions, as heads, intrinsic rewards and critics get it.

    The first fields are those of SB3's ``ReplayBufferSamples``. Observations are as stored: images uint8 in 0-255,
    channels first; vectors float32; dictionaries of both by key (those without images are one vector here). Images lie
    in NHWC memory order, of which ``flatten`` and ``reshape`` make vectors, but ``view`` cannot.

    :param observations: What the agent saw, [B, *shape]
    :param actions: What it did, scaled to [-1, 1], float32 [B, action_dim]
    :param next_observations: What it saw one step later, [B, *shape]; at an episode's end its last observation, not
        the first one of the next episode
    :param dones: 1 where the episode terminated, 0 elsewhere, timeouts included, float32 [B, 1]
    :param rewards: Reward of that one step, float32 [B, 1]
    :param discounts: What a buffer of one's own says for gamma, float32 [B, 1]; None: the discount factor of the agent
    :param views: ``observations`` as the encoder saw them (shifted or cropped), in 0-255, [B, *view shape]
    :param n_step_rewards: Discounted sum of n rewards (fewer where the episode ends), float32 [B, 1]. This and what
        follows is for the task's critic alone, and None unless ``n_steps > 1``
    :param n_step_next_observations: What the agent saw after these, [B, *shape]
    :param n_step_dones: Whether the episode terminated there, float32 [B, 1]
    :param n_step_discounts: gamma to the number of rewards, float32 [B, 1]
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None = None
    views: th.Tensor = None  # type: ignore[assignment]
    n_step_rewards: th.Tensor | None = None
    n_step_next_observations: th.Tensor | None = None
    n_step_dones: th.Tensor | None = None
    n_step_discounts: th.Tensor | None = None

    def of(self, key: str) -> "Samples":
        """
        :param key: Of an image in dictionaries of observations
        :return: The batch as it is for an agent that sees this image alone
        """
        fields = self._asdict().items()
        return Samples(**{name: value[key] if isinstance(value, dict) else value for name, value in fields})
