"""The contract between the agent and an intrinsic reward, and how rewards are scaled."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.networks.layers import move_average


class RewardInputs:
    """What an intrinsic reward may read in one update; latents are computed when they are first read.

    :param batch: The true transitions
    :param srl_error: Returns the SRL error of each sample; None unless the reward sets ``needs_srl``
    :param read: Returns the latents of the batch's ``"observations"`` or ``"next_observations"``
    :param replay_buffer: The replay buffer, which has just drawn the batch
    :param look_up: Returns stored transitions by rows and environments, [n] each
    """

    def __init__(
        self,
        batch: Samples,
        srl_error: Callable[[], th.Tensor] | None,
        read: Callable[[str], th.Tensor],
        replay_buffer: ReplayBuffer,
        look_up: Callable[[np.ndarray, np.ndarray], Samples],
    ):
        self.batch = batch
        self.replay_buffer, self.look_up = replay_buffer, look_up
        self._srl_error, self._read = srl_error, read

    @cached_property
    def srl_error(self) -> th.Tensor:
        """SRL error of each sample, before the head's step, detached, [B]; only for rewards that set ``needs_srl``."""
        if self._srl_error is None:
            raise ValueError("inputs.srl_error is for rewards that set needs_srl = True.")
        return self._srl_error()

    @cached_property
    def latents(self) -> th.Tensor:
        """The online encoder's latents of the centred views, fp32, [B, features_dim]."""
        return self._read("observations")

    @cached_property
    def next_latents(self) -> th.Tensor:
        """The same latents for the next observations, [B, features_dim]."""
        return self._read("next_observations")

    def info(self, key: str) -> th.Tensor:
        """What the environment's ``info`` held under a key after each step, [B, *shape].

        :param key: A key that ``replay_buffer_kwargs=dict(info_shapes={key: shape})`` keeps
        :return: Its values in this batch, float32
        """
        buffer: Any = self.replay_buffer
        return buffer.to_torch(buffer.rows[f"infos/{key}"][buffer.last_sampled])

    def of(self, key: str, where: slice = slice(None)) -> "RewardInputs":
        """Return the inputs of a reward that sees one image of a dictionary.

        :param key: Key of the image
        :param where: The part of the latents that it reads
        :return: The same inputs, observations without their keys
        """
        return RewardInputs(
            self.batch.of(key),
            lambda: self.srl_error,
            lambda name: (self.latents if name == "observations" else self.next_latents)[:, where],
            self.replay_buffer,
            lambda rows, env_inds: self.look_up(rows, env_inds).of(key),
        )


class IntrinsicReward(nn.Module):
    """Base class of intrinsic rewards. Subclass it, implement ``loss``, and pass the class as ``intrinsic=``.

    Rewards are computed anew for each sampled batch, so they are never stale. Keep targets, statistics and memories in
    buffers, which are saved, and draw random numbers from an ``OwnGenerator``, so that runs with the same
    seed and different rewards draw the same numbers elsewhere. A constructor that names ``frame_stack`` (frames per
    image), ``curiosity_target`` or ``srl`` (the head, which its own optimizer trains) gets that setting of the agent.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    """

    #: Whether the reward is computed from the SRL head: ``srl=None`` is then refused
    needs_srl: bool = False
    #: Whether the latents keep their graph, so that this loss trains the encoder, too
    trains_encoder: bool = False
    #: Whether policies are measured by ``error`` instead of by the SRL error
    measures: bool = False
    #: Optimizer of the reward's own parameters, set by the policy; None if it has none
    optimizer: th.optim.Optimizer | None = None

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, features_dim: int):
        super().__init__()
        self.observation_space, self.action_space, self.features_dim = observation_space, action_space, features_dim

    @classmethod
    def is_per_image(cls, **kwargs: Any) -> bool:
        """Return whether each image of a dictionary gets a reward of its own (``DictReward``).

        :param kwargs: The reward's arguments
        :return: By default False: ``loss`` gets the observations as a dictionary
        """
        return False

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor | None, th.Tensor]:
        """Compute the rewards of a batch, and the loss for the step that follows.

        :param inputs: The batch, its latents and its SRL error, and a look-up of stored transitions
        :return: Loss of the reward's own parameters (None if it has none), and the reward of each sample, detached, [B]
        """
        raise NotImplementedError(f"{type(self).__name__} must implement loss(inputs)")

    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Compute the error by which policies are measured if ``measures`` is True.

        :param observations: As stored, [B, *shape]
        :param latents: Their latents, [B, features_dim]
        :return: Error of each observation, [B]
        """
        raise NotImplementedError(f"{type(self).__name__} must implement error(observations, latents)")

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """Draw observations from latents.

        :param latents: [B, features_dim]
        :return: Observations (images in 0-255), or None if the reward does not decode
        """
        return None

    def forget(self) -> None:
        """Forget what refers to the replay buffer, which was emptied."""


class OwnGenerator(nn.Module):
    """A random number generator for one reward; its state is saved with the reward's parameters.

    :param stream: Number of the stream, so that two rewards that work together draw differently
    """

    def __init__(self, stream: int = 0):
        super().__init__()
        # While a reward is built, torch's seed is the same, whichever reward it is.
        self.generator = th.Generator().manual_seed(th.initial_seed() + stream)

    def get_extra_state(self) -> th.Tensor:
        """Return the state of the generator."""
        return self.generator.get_state()

    def set_extra_state(self, state: th.Tensor) -> None:
        """Restore the state of the generator.

        :param state: Result of ``get_extra_state``
        """
        self.generator.set_state(state.cpu())


class RewardScale(nn.Module):
    """r = beta * reward, by default standardised: minus the mean of the batch, divided by a running deviation.

    The paper uses the bare error. Errors of an autoencoder are of order 1e-3, far below the entropy bonus of SAC, so
    that an un-normalised curious policy stays close to random. The mean is the batch's own, because a running one lags
    behind errors that fall while the head learns. The deviation is an exponential average over updates.

    :param decay: Weight of the past in the running deviation, per update
    :param clip: Standardised rewards are clipped to [-clip, clip]
    """

    variance: th.Tensor
    weight: th.Tensor

    def __init__(self, decay: float = 0.99, clip: float = 5.0):
        super().__init__()
        self.decay = decay
        self.clip = clip
        self.register_buffer("variance", th.zeros(()))
        self.register_buffer("weight", th.zeros(()))

    def forget(self) -> None:
        """Reset the running deviation."""
        self.variance.zero_()
        self.weight.zero_()

    @th.no_grad()
    def forward(self, reward: th.Tensor, beta: float, normalize: bool, center: bool) -> th.Tensor:
        """Scale the rewards of a batch, and update the running deviation.

        :param reward: Raw reward of each sample, [B]
        :param beta: Factor of the reward, beta in the paper
        :param normalize: Whether to standardise; False is the paper's formula
        :param center: Whether to subtract the mean when standardising. False for a bonus added to a task's reward: a
            mean of zero would make long episodes neither better nor worse. The bonus is then divided by its root mean
            square; divided by its deviation, an error that varies little would be clipped to a constant
        :return: Scaled reward, [B, 1]
        """
        if normalize:
            # A spread below a thousandth of the rewards' size is rounding: rewards that are all alike are worth 0.
            least = 1e-6 * reward.square().mean()
            reward = reward - reward.mean() if center else reward
            move_average(self.variance, self.weight, th.maximum(reward.square().mean(), least), self.decay)
            deviation = (self.variance / self.weight).sqrt() + 1e-8
            # `0 * reward` turns infinite rewards into NaN, which the check of losses finds, instead of clipping them.
            reward = (reward / deviation).clamp(-self.clip, self.clip) + 0 * reward
        return beta * reward.unsqueeze(1)
