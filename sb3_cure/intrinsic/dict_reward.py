"""One intrinsic reward for each image of a dictionary."""

from collections.abc import Callable
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

from sb3_cure.data.buffers import stacks_by_key
from sb3_cure.data.observations import image_spaces
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, LookUp
from sb3_cure.networks.layers import MeanError
from sb3_cure.srl.base import SRLHead
from sb3_cure.srl.dict_head import DictHead, heads_by_key


class DictReward(IntrinsicReward):
    """A reward of one class for each image of a dictionary: their mean, each divided by its running deviation.

    All of them read the joined latents; those that are made of the SRL error read their own image's, as its head does.

    :param reward_class: Class of the rewards, which says ``per_image = True``
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the joined latents
    :param kwargs: Arguments of each reward
    """

    def __init__(
        self,
        reward_class: type[IntrinsicReward],
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        features_dim: int,
        **kwargs: Any,
    ):
        super().__init__(observation_space, action_space, features_dim)
        images = image_spaces(observation_space)
        self.keys = list(images)
        stacks = stacks_by_key(observation_space, kwargs["frame_stack"]) if "frame_stack" in kwargs else {}
        own = {key: {"frame_stack": stack} for key, stack in stacks.items()}
        self.rewards = nn.ModuleList(
            reward_class(space, action_space, features_dim, **{**kwargs, **own.get(key, {})})
            for key, space in images.items()
        )
        self.mean_reward = MeanError(len(images))
        # Which of the joined latents each reward reads
        self._slices = dict.fromkeys(self.keys, slice(None))
        for name in ("needs_srl", "reads", "trains_encoder", "mixed_precision", "measures"):
            setattr(self, name, getattr(self.rewards[0], name))

    def bind(self, srl: SRLHead | None) -> None:
        """
        :param srl: The SRL head
        """
        if self.needs_srl and isinstance(srl, DictHead):
            self._slices = dict(zip(srl.keys, srl.slices, strict=True))
        heads = heads_by_key(srl)
        for key, reward in self._parts():
            reward.bind(heads.get(key, srl))

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """
        :param replay_buffer: The replay buffer
        :param look_up: What it holds; each reward sees its own image
        :param encode: The online encoder
        """
        for key, reward in self._parts():
            reward.attach(replay_buffer, lambda *places, key=key: look_up(*places).of(key), encode)

    def forget(self) -> None:
        """For each reward."""
        for _, reward in self._parts():
            reward.forget()

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor | None, th.Tensor]:
        """
        :param batch: The true transitions, observations by key
        :param latents: Joined latents, [B, features_dim]
        :param next_latents: The same of the next observations, [B, features_dim]
        :param srl_error: SRL error of each sample, [B]
        :return: Sum of the losses, and the mean reward, [B]
        """
        found = []
        for key, reward in self._parts():
            read = [None if each is None else each[:, self._slices[key]] for each in (latents, next_latents)]
            found.append(reward.loss(batch.of(key), *read, srl_error))
        losses = [loss.float() for loss, _ in found if loss is not None]
        rewards = self.mean_reward([reward for _, reward in found], learns=True)
        return th.stack(losses).sum() if losses else None, rewards

    def error(self, observations: Any, latents: th.Tensor) -> th.Tensor:
        """
        :param observations: As stored, by key
        :param latents: Joined latents, [B, features_dim]
        :return: [B]
        """
        parts = [(observations[key], latents[:, self._slices[key]], reward) for key, reward in self._parts()]
        return self.mean_reward([reward.error(seen, own) for seen, own, reward in parts], learns=False)

    def reconstruct(self, latents: th.Tensor) -> dict[str, th.Tensor] | None:  # type: ignore[override]
        """
        :param latents: Joined latents, [B, features_dim]
        :return: Images by key, or None if nothing is drawn
        """
        drawn = {key: reward.reconstruct(latents) for key, reward in self._parts()}
        return None if None in drawn.values() else drawn

    def _parts(self) -> list[tuple[str, Any]]:
        return list(zip(self.keys, self.rewards, strict=True))
