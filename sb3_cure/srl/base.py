"""The contract between the agent and a state-representation-learning (SRL) head."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_cure.encoders import Encoder
from sb3_cure.layers import preprocess


class SRLOutput(NamedTuple):
    """What a head says of a batch.

    :param loss: Scalar to minimise; its gradient reaches the head and, through the latents, the encoder
    :param error: SRL error of each sample, [B], detached, finite, >= 0: the raw material of the curious reward
    """

    loss: th.Tensor
    error: th.Tensor


class SRLHead(nn.Module):
    """Base class of SRL heads. Subclass it, implement ``loss``, and pass the class: ``CuReSAC(..., srl=MyHead)``.

    A head owns its parameters (trained by its loss alone) but not the encoder, whose latents it is given. ``batch`` is
    always SB3's ``ReplayBufferSamples`` with observations as stored: images unscaled in 0-255.

    :param encoder: The shared encoder; read ``encoder.features_dim``. Only the latents that ``loss`` is given
        carry its gradient to the encoder; what else is encoded with it counts as constant
    :param observation_space: Space of the stored observations
    """

    #: Gradient steps in one burst after the random warm-up, unless ``warmup_updates`` says otherwise
    warmup_updates: ClassVar[int] = 0
    #: Whether ``loss`` is run under autocast where networks compute in bf16 (fast for convolutions). The head then has
    #: to see to it that its error is made in fp32 (``layers.full_precision``); otherwise all of it is
    mixed_precision: ClassVar[bool] = False
    #: Whether the head is about transitions (s, a, s') rather than single observations: its error then rewards the
    #: transition whatever ``curiosity_target`` says. Other heads are asked for the next observations' errors with a
    #: batch of these alone, all of whose other fields are None
    needs_next_latents: ClassVar[bool] = False
    #: Optimiser of the head's own parameters, set by the policy; None if it has none
    optimizer: th.optim.Optimizer | None = None
    #: Extra arguments (but the learning rate) of the optimiser of the head's own parameters, e.g. weight decay
    optimizer_kwargs: dict[str, Any]

    def __init__(self, encoder: Encoder, observation_space: spaces.Space):
        super().__init__()
        self.observation_space = observation_space
        self.optimizer_kwargs = {}
        # In tuples, so that the encoders are not registered as parts of the head: it does not train or save them.
        self._encoder = (encoder,)
        self._target_encoder = (encoder,)

    @classmethod
    def configure_encoder(
        cls, observation_space: spaces.Space, **srl_kwargs: Any
    ) -> tuple[spaces.Space, dict[str, Any]]:
        """What this head wants of the encoder, asked before the encoder exists.

        :param observation_space: Space of the stored observations
        :param srl_kwargs: The head's arguments
        :return: The space that the encoder sees (smaller if the head crops), and default arguments for ``PixelEncoder``
        """
        return observation_space, {}

    @property
    def encoder(self) -> Encoder:
        """The shared encoder."""
        return self._encoder[0]

    @property
    def target_encoder(self) -> Encoder:
        """The encoder's moving average (momentum encoder); never trained by gradients."""
        return self._target_encoder[0]

    def bind_target_encoder(self, target_encoder: Encoder) -> None:
        """Called once by the policy.

        :param target_encoder: The moving average of the encoder
        """
        self._target_encoder = (target_encoder,)

    def preprocess(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: Observations after ``augment`` or ``center``, [B, *shape], images in 0-255
        :return: The encoder's input: images in [0, 1]
        """
        return preprocess(observations, self.observation_space)

    def augment(self, observations: th.Tensor) -> th.Tensor:
        """What the encoder sees in training; the identity unless a head augments.

        :param observations: [B, *shape], images in 0-255
        :return: [B, *encoder shape], images in 0-255
        """
        return observations

    def center(self, observations: th.Tensor) -> th.Tensor:
        """The deterministic counterpart of ``augment``, used to act and to measure.

        :param observations: [B, *shape], images in 0-255
        :return: [B, *encoder shape], images in 0-255
        """
        return observations

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        """The training loss. It may be noisy and may use the other samples of the batch.

        :param batch: Samples of the replay buffer
        :param latents: The encoder's output for ``augment(batch.observations)``, [B, encoder.features_dim]
        :return: Loss (scalar) and error per sample ([B], detached)
        """
        raise NotImplementedError(f"{type(self).__name__} must implement loss(batch, latents) -> SRLOutput")

    def error(self, batch: ReplayBufferSamples, latents: th.Tensor) -> th.Tensor:
        """The noise-free error, for measuring and plotting; by default that of ``loss``.

        :param batch: Samples of the replay buffer
        :param latents: The encoder's output for ``center(batch.observations)``, [B, encoder.features_dim]
        :return: Error per sample, [B]
        """
        return SRLOutput(*self.loss(batch, latents)).error

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """
        :param latents: [B, encoder.features_dim]
        :return: Observations [B, *shape] (images in 0-255), or None if the head does not decode
        """
        return None
