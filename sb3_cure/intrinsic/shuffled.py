"""Another reward without its information: the control that shows what a reward is good for."""

from typing import Any

import torch as th

from sb3_cure.intrinsic.base import IntrinsicReward, OwnGenerator, RewardInputs
from sb3_cure.intrinsic.dict_reward import make_reward
from sb3_cure.intrinsic.registry import get_intrinsic_class


class Shuffled(IntrinsicReward):
    """Another reward's numbers, given to the wrong samples: the same networks, gradients, mean and spread.

    :param args: As for ``IntrinsicReward``
    :param settings: As for ``make_reward``
    :param of: Name or class of the other reward; ``"auto"``: the one that ``intrinsic="auto"`` takes with this head
    :param kwargs: Its arguments
    """

    def __init__(self, *args: Any, settings: dict[str, Any], of: str | type[IntrinsicReward] = "auto", **kwargs: Any):
        super().__init__(*args)
        reward_class = get_intrinsic_class(of, settings.get("srl"))
        spaces_of = self.observation_space, self.action_space
        self.of = make_reward(reward_class, *spaces_of, self.features_dim, settings, kwargs)
        self.random = OwnGenerator(stream=1)
        for name in ("needs_srl", "trains_encoder", "measures"):
            setattr(self, name, getattr(self.of, name))

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor | None, th.Tensor]:
        """Shuffle the other reward's numbers.

        :param inputs: For the other reward
        :return: The other reward's loss, and its reward in a random order, [B]
        """
        loss, reward = self.of.loss(inputs)
        return loss, reward[th.randperm(len(reward), generator=self.random.generator).to(reward.device)]

    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Return the other reward's error: policies are measured by it as it is."""
        return self.of.error(observations, latents)

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """Draw observations as the other reward does."""
        return self.of.reconstruct(latents)

    def forget(self) -> None:
        """Let the other reward forget what refers to the replay buffer."""
        self.of.forget()
