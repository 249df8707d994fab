"""How rewards are built, and one reward for each image of a dictionary."""

import inspect
from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cure.data.buffers import stacks_by_key
from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.networks.layers import MeanError
from sb3_cure.srl import DictHead, heads_by_key


def make_reward(
    reward_class: type[IntrinsicReward],
    observation_space: spaces.Space,
    action_space: spaces.Box,
    features_dim: int,
    settings: dict[str, Any],
    kwargs: dict[str, Any],
) -> IntrinsicReward:
    """Build an intrinsic reward, with those settings of the agent that its constructor names.

    :param reward_class: Class of the reward
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param settings: ``frame_stack``, ``curiosity_target`` and ``srl`` (the head or None) of the agent
    :param kwargs: The reward's arguments, which override the settings
    :return: The reward; for a dictionary, one for each image if its class says so (``is_per_image``)
    :raises ValueError: if the reward needs a head, and there is none
    """
    if reward_class.needs_srl and settings.get("srl") is None:
        raise ValueError(
            f"the intrinsic reward {reward_class.__name__} is computed from an SRL head, but srl is None: choose "
            "srl='rae', srl='curl' or a head of your own, another intrinsic reward, or curiosity=None."
        )
    if isinstance(observation_space, spaces.Dict) and reward_class.is_per_image(**kwargs):
        return DictReward(reward_class, observation_space, action_space, features_dim, settings=settings, **kwargs)
    named = inspect.signature(reward_class).parameters
    offered = {**settings, "settings": settings}  # for rewards that wrap another
    own = {name: value for name, value in offered.items() if name in named}
    return reward_class(observation_space, action_space, features_dim, **{**own, **kwargs})


class DictReward(IntrinsicReward):
    """A reward of one class for each image of a dictionary: their mean, each divided by its running size.

    All of them read the joint latents, except those that are computed from the SRL head: they read the latents of
    their own image, as its head does.

    :param reward_class: Class of the rewards
    :param args: As for ``IntrinsicReward``
    :param settings: As for ``make_reward``
    :param kwargs: Arguments of each reward
    """

    def __init__(self, reward_class: type[IntrinsicReward], *args: Any, settings: dict[str, Any], **kwargs: Any):
        super().__init__(*args)
        srl: Any = settings.get("srl")
        heads, self.rewards = heads_by_key(srl), nn.ModuleList()
        frame_stack = kwargs.get("frame_stack", settings.get("frame_stack", 1))
        stacks = stacks_by_key(self.observation_space, frame_stack)
        for key, stack in stacks.items():
            own = {**settings, "frame_stack": stack, "srl": heads.get(key, srl)}
            given = {**kwargs, "frame_stack": stack} if "frame_stack" in kwargs else kwargs
            space = self.observation_space[key]  # type: ignore[index]
            self.rewards.append(make_reward(reward_class, space, self.action_space, self.features_dim, own, given))
        self.mean_reward = MeanError(len(stacks))
        self.slices = dict.fromkeys(stacks, slice(None))
        if reward_class.needs_srl and isinstance(srl, DictHead):
            self.slices = srl.slices
        for name in ("needs_srl", "trains_encoder", "measures"):
            setattr(self, name, getattr(self.rewards[0], name))

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor | None, th.Tensor]:
        """Add the losses up, and average the rewards.

        :param inputs: Observations by key
        :return: Sum of the losses, and the mean reward, [B]
        """
        found = [reward.loss(inputs.of(key, where)) for key, where, reward in self._parts()]
        losses = [loss for loss, _ in found if loss is not None]
        rewards = self.mean_reward([reward for _, reward in found], learns=True)
        return th.stack(losses).sum() if losses else None, rewards

    def error(self, observations: Any, latents: th.Tensor) -> th.Tensor:
        """Average the errors by which policies are measured.

        :param observations: As stored, by key
        :param latents: Joint latents, [B, features_dim]
        :return: [B]
        """
        errors = [reward.error(observations[key], latents[:, where]) for key, where, reward in self._parts()]
        return self.mean_reward(errors, learns=False)

    def reconstruct(self, latents: th.Tensor) -> dict[str, th.Tensor] | None:  # type: ignore[override]
        """Draw each image.

        :param latents: Joint latents, [B, features_dim]
        :return: Images by key, or None if the rewards do not decode
        """
        drawn = {key: reward.reconstruct(latents[:, where]) for key, where, reward in self._parts()}
        return None if None in drawn.values() else drawn

    def forget(self) -> None:
        """Let each reward forget what refers to the replay buffer."""
        for _, _, reward in self._parts():
            reward.forget()

    def _parts(self) -> list[tuple[str, slice, Any]]:
        return [(*item, reward) for item, reward in zip(self.slices.items(), self.rewards, strict=True)]
