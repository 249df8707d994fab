"""Another reward without its information: the control of record for what a reward is good for."""

from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, LookUp, OwnGenerator
from sb3_cure.intrinsic.registry import get_intrinsic_class
from sb3_cure.srl.base import SRLHead


class Shuffled(IntrinsicReward):
    """The rewards of another reward, given to the wrong samples of the batch: the same networks, gradients, mean and
    spread.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param of: Name or class of the other reward
    :param kwargs: Its arguments
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        of: str | type[IntrinsicReward] = "srl_error",
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, features_dim)
        self.of = get_intrinsic_class(of)(observation_space, action_space, features_dim, **kwargs)
        self.random = OwnGenerator(stream=1)
        for name in ("needs_srl", "reads", "trains_encoder", "mixed_precision", "measures"):
            setattr(self, name, getattr(self.of, name))

    @classmethod
    def configured(cls, of: str | type[IntrinsicReward] = "srl_error", **kwargs: Any) -> type[IntrinsicReward]:
        """
        :param of: Name or class of the other reward
        :param kwargs: Its arguments
        :return: The class whose declarations hold
        """
        return get_intrinsic_class(of).configured(**kwargs)

    def bind(self, srl: SRLHead | None) -> None:
        """
        :param srl: For the other reward
        """
        self.of.bind(srl)

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """
        :param replay_buffer: For the other reward
        :param look_up: The same
        :param encode: The same
        """
        self.of.attach(replay_buffer, look_up, encode)

    def forget(self) -> None:
        """For the other reward."""
        self.of.forget()

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor | None, th.Tensor]:
        """
        :param batch: For the other reward
        :param latents: The same
        :param next_latents: The same
        :param srl_error: The same
        :return: The other reward's loss, and its reward in a random order, [B]
        """
        loss, reward = self.of.loss(batch, latents, next_latents, srl_error)
        return loss, reward[th.randperm(len(reward), generator=self.random.generator).to(reward.device)]

    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Policies are measured by the other reward as it is.

        :param observations: As stored, [B, *shape]
        :param latents: Theirs, [B, features_dim]
        :return: [B]
        """
        return self.of.error(observations, latents)

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """
        :param latents: [B, features_dim]
        :return: What the other reward draws
        """
        return self.of.reconstruct(latents)
