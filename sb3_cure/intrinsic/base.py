"""The contract between the agent and an intrinsic reward, and how rewards are scaled."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.srl.base import SRLHead

#: From rows and environments of a replay buffer, [n] each, to its samples
LookUp = Callable[[np.ndarray, np.ndarray], Samples]


class IntrinsicReward(nn.Module):
    """What the curious agent is rewarded for. Subclass it, implement ``loss``, and pass the class as ``intrinsic=``.

    The reward is computed afresh for each sampled batch, so that it is never stale. Targets, statistics and memories
    belong into buffers, which are saved; random numbers come from a generator of its own (``OwnGenerator``), so that
    runs of one seed that differ in their reward alone draw alike elsewhere. What is declared below may depend on
    arguments: set it on ``self``, and let ``configured`` tell it before there is an object.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    """

    #: Whether the reward is made of the SRL error, so that ``srl=None`` is refused
    needs_srl: bool = False
    #: Which of ``"latents"`` and ``"next_latents"`` the reward reads; the other ones are None
    reads: tuple[str, ...] = ()
    #: Whether the latents keep their graph, so that this loss trains the encoder, too
    trains_encoder: bool = False
    #: Whether ``loss`` runs under autocast where the agent computes in bf16; the reward itself is fp32
    mixed_precision: bool = False
    #: Whether policies are measured by ``error`` rather than by the SRL error
    measures: bool = False
    #: Whether the reward reads observations as one image or vector: of a dictionary, each image then has a reward of
    #: its own (``DictReward``). Else a reward that reads observations gets the dictionary
    per_image: bool = False
    #: What the constructor is told of the agent unless ``intrinsic_kwargs`` says otherwise: ``"frame_stack"`` (frames
    #: per image that the replay buffer knows of, else 1), ``"curiosity_target"``
    asks: ClassVar[tuple[str, ...]] = ()
    #: Optimiser of the reward's own parameters, set by the policy; None if it has none
    optimizer: th.optim.Optimizer | None = None

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Box, features_dim: int):
        super().__init__()

    @classmethod
    def configured(cls, **kwargs: Any) -> "type[IntrinsicReward]":
        """
        :param kwargs: The reward's arguments
        :return: The class whose ``needs_srl``, ``trains_encoder`` and ``asks`` hold with them
        """
        return cls

    def bind(self, srl: SRLHead | None) -> None:
        """Called once by the policy.

        :param srl: The SRL head, if there is one
        :raises ValueError: if it is not one that the reward can be made of
        """

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """Called by the algorithm before each ``loss``, for rewards that look beyond the batch.

        :param replay_buffer: The replay buffer, which has just drawn the batch
        :param look_up: What it holds: samples by rows and environments, [n] each
        :param encode: The online encoder: latents, [n, features_dim], of centred views of stored observations
        """

    def forget(self) -> None:
        """Called when the replay buffer was emptied: forget what refers to it."""

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor | None, th.Tensor]:
        """The reward of a batch, as it is before the step that the loss then makes.

        :param batch: The true transitions
        :param latents: The online encoder's latents of the centred views, fp32, [B, features_dim]
        :param next_latents: The same of the next observations, [B, features_dim]
        :param srl_error: SRL error of each sample, detached, [B]; None without SRL
        :return: Loss of the reward's own parameters (None if it has none), and the reward, detached, [B]
        """
        raise NotImplementedError

    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """What policies are measured by, if ``measures`` says so.

        :param observations: As stored, [B, *shape]
        :param latents: Theirs, [B, features_dim]
        :return: [B]
        """
        raise NotImplementedError(f"{type(self).__name__} must implement error(observations, latents)")

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """
        :param latents: [B, features_dim]
        :return: Observations as drawn (images in 0-255), or None if nothing is drawn
        """
        return None


class OwnGenerator(nn.Module):
    """Random numbers of a reward's own; their state is saved with its parameters.

    :param stream: Number of the stream, so that two rewards that work together draw differently
    """

    def __init__(self, stream: int = 0):
        super().__init__()
        # While a reward is built, torch's seed is one that is the same under every reward.
        self.generator = th.Generator().manual_seed(th.initial_seed() + stream)

    def get_extra_state(self) -> th.Tensor:
        """
        :return: State of the generator
        """
        return self.generator.get_state()

    def set_extra_state(self, state: th.Tensor) -> None:
        """
        :param state: Of ``get_extra_state``
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
        """Begin the average anew."""
        self.variance.zero_()
        self.weight.zero_()

    @th.no_grad()
    def forward(self, reward: th.Tensor, beta: float, normalize: bool, center: bool) -> th.Tensor:
        """
        :param reward: Raw reward of each sample, [B]
        :param beta: Factor of the reward, beta in the paper
        :param normalize: Whether to standardise; False is the paper's letter
        :param center: Whether the mean is subtracted when standardising. Not for a bonus on top of a task's reward,
            which would make long episodes neither better nor worse: it is divided by its root mean square, as in
            units of its deviation an error that varies little would be clipped to a constant
        :return: Scaled reward, [B, 1]
        """
        if normalize:
            mean = reward.mean()
            variance = (reward - mean if center else reward).square().mean()
            # A spread below a thousandth of the rewards' size is rounding: rewards that are all alike earn nothing.
            variance = th.maximum(variance, 1e-6 * reward.square().mean())
            finite = variance.isfinite()
            self.variance.copy_(th.where(finite, self.variance.lerp(variance, 1 - self.decay), self.variance))
            # The average starts at zero: its total weight undoes that bias, as Adam does for its moments.
            self.weight.copy_(
                th.where(finite, self.weight.lerp(th.ones_like(self.weight), 1 - self.decay), self.weight)
            )
            # Not a number as long as no finite rewards were seen: those that are not reach no critic.
            deviation = (self.variance / self.weight).sqrt() + 1e-8
            reward = ((reward - mean if center else reward) / deviation).clamp(-self.clip, self.clip)
        return beta * reward.unsqueeze(1)
