"""What heads, intrinsic rewards and critics get of a batch."""

from typing import NamedTuple

import torch as th


class NStep(NamedTuple):
    """Returns of n steps for the transitions of a batch, under the names that ``Samples`` has for one step.

    :param rewards: Discounted sum of n rewards, fewer where the episode or the stored stream ends, float32 [B, 1]
    :param next_observations: What the agent saw after these rewards, [B, *shape]
    :param dones: 1 where the episode terminated there, 0 elsewhere, timeouts included, float32 [B, 1]
    :param discounts: gamma to the power of the number of rewards, float32 [B, 1]
    """

    rewards: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    discounts: th.Tensor


class Samples(NamedTuple):
    """A batch of B transitions, as heads, intrinsic rewards and critics get it.

    The first fields are those of SB3's ``ReplayBufferSamples``. Observations are as stored: images uint8 in 0-255,
    channels first; vectors float32; dictionaries of both by key (those without images are one vector here). Images are
    in NHWC memory order: turn them into vectors by ``flatten`` or ``reshape``, as ``view`` fails.

    :param observations: What the agent saw, [B, *shape]
    :param actions: What it did, scaled to [-1, 1], float32 [B, action_dim]
    :param next_observations: What it saw one step later, [B, *shape]; at an episode's end its last observation, not
        the first one of the next episode
    :param dones: 1 where the episode terminated, 0 elsewhere, timeouts included, float32 [B, 1]
    :param rewards: Reward of that one step, float32 [B, 1]
    :param discounts: Discounts of a custom buffer, float32 [B, 1]; None: the discount factor of the agent
    :param views: ``observations`` as the encoder saw them (shifted or cropped), in 0-255, [B, *view shape]
    :param n_step: Returns of n steps, for the task's critic alone; None unless ``n_steps > 1``
    :param restarts: What the curious critic bootstraps from: ``next_observations``, with each terminal observation
        replaced by the first one of the next episode; None if nothing was replaced
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None = None
    views: th.Tensor = None  # type: ignore[assignment]
    n_step: NStep | None = None
    restarts: th.Tensor | None = None

    def of(self, key: str) -> "Samples":
        """Return the batch as seen by an agent whose only observation is this image.

        :param key: Key of an image in dictionaries of observations
        :return: The batch with the observations of that image, without what is for critics alone
        """
        fields = self._asdict().items()
        parts = {name: value[key] if isinstance(value, dict) else value for name, value in fields}
        return Samples(**{**parts, "n_step": None, "restarts": None})
