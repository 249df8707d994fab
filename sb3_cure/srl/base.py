"""The contract between the agent and a state-representation-learning (SRL) head."""

from typing import Any, ClassVar, NamedTuple

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import Augmentation
from sb3_cure.networks.encoders import Encoder


class SRLOutput(NamedTuple):
    """Loss and errors of a batch.

    :param loss: Scalar to minimise; its gradient reaches the head and, through the latents, the encoder
    :param error: SRL error of each sample, [B], detached, finite, >= 0: the paper's curious reward
    """

    loss: th.Tensor
    error: th.Tensor


class SRLHead(nn.Module):
    """Base class of SRL heads. Subclass it, implement ``loss``, and pass the class: ``CuReSAC(..., srl=MyHead)``.

    A head owns its parameters (trained by its loss alone) but not the encoder, whose latents it gets.

    :param encoder: The shared encoder; read ``encoder.features_dim`` and ``encoder.view_space``. Only the latents that
        ``loss`` gets carry its gradient to the encoder; anything else encoded with it counts as constant
    :param observation_space: Space of the stored observations
    """

    #: Gradient steps in one burst after the random warm-up, unless ``warmup_updates`` says otherwise
    warmup_updates: ClassVar[int] = 0
    #: Whether the error is high where observations are new, so that ``intrinsic="auto"`` rewards it, as the paper does:
    #: true of heads that reconstruct, false of InfoNCE, which is high where others of the batch look alike
    error_tells_novelty: ClassVar[bool] = True
    #: Whether ``loss`` gets the latents of the next observations, with their gradient, as a third argument
    needs_next_latents: ClassVar[bool] = False
    #: Whether the error belongs to the transition (s, a, s'), whatever ``curiosity_target`` is. The constructor then
    #: gets ``action_space=``, too
    models_transitions: ClassVar[bool] = False
    #: Optimizer of the head's own parameters, set by the policy; None if it has none
    optimizer: th.optim.Optimizer | None = None
    #: Extra arguments (but the learning rate) of the optimizer of the head's own parameters, e.g. weight decay
    optimizer_kwargs: dict[str, Any]

    def __init__(self, encoder: Encoder, observation_space: spaces.Space):
        super().__init__()
        self.observation_space = observation_space
        self.optimizer_kwargs = dict(getattr(self, "optimizer_kwargs", {}))  # a subclass may have set them
        # In tuples, so that the encoders are not registered as submodules: the head does not train or save them.
        self._encoder = self._target_encoder = (encoder,)
        #: Draws another view of stored observations: ``self.augment(batch.observations)``
        self.augment = Augmentation(observation_space)

    @classmethod
    def choose_augmentation(cls, observation_space: spaces.Space) -> str | None:
        """Choose the augmentation for ``augmentation="auto"``.

        :param observation_space: Space of the stored observations
        :return: ``"shift"``, ``"crop"`` or None
        """
        return None

    @classmethod
    def configure_encoder(cls, augmentation: Augmentation) -> dict[str, Any]:
        """Return the encoder's default arguments with this head.

        :param augmentation: Makes the views that the encoder will see
        :return: Arguments of ``PixelEncoder`` or ``VectorEncoder``
        """
        return {}

    @property
    def encoder(self) -> Encoder:
        """The shared encoder."""
        return self._encoder[0]

    @property
    def target_encoder(self) -> Encoder:
        """The encoder's moving average (momentum encoder); never trained by gradients."""
        return self._target_encoder[0]

    def bind(self, target_encoder: Encoder, augmentation: Augmentation) -> None:
        """Set target encoder and augmentation; called once by the policy.

        :param target_encoder: The moving average of the encoder
        :param augmentation: The policy's augmentation
        :raises ValueError: if the head has a network of its own by the name of a shared one, which nothing would read
        """
        for name, shared in {"encoder": self.encoder, "target_encoder": target_encoder}.items():
            if self._modules.get(name, shared) is not shared:
                raise ValueError(f"{type(self).__name__} has a network {name!r}, the shared one's name: rename it.")
        self._target_encoder = (target_encoder,)
        self.augment = augmentation

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Compute the training loss, which may be noisy and may use the other samples of the batch.

        Where gradients are disabled, only the error is used (in phases of RL, for a frozen head, for the next
        observations): update statistics only ``if th.is_grad_enabled()``.

        :param batch: Samples of the replay buffer; ``batch.views`` is what the encoder saw
        :param latents: The encoder's output for ``batch.views``, fp32, [B, encoder.features_dim]
        :param next_latents: The same for views of the next observations, if ``needs_next_latents``
        :return: Loss (scalar) and error per sample ([B], detached)
        """
        raise NotImplementedError(f"{type(self).__name__} must implement loss(batch, latents) -> SRLOutput")

    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """Compute the noise-free error, for measuring and plotting; by default that of ``loss``.

        Policies are measured in batches of any size: a loss that reads other samples of its batch needs an ``error``
        that does not.

        :param batch: Samples of the replay buffer; ``batch.views`` are the centred ones
        :param latents: The encoder's output for ``batch.views``, [B, encoder.features_dim]
        :return: Error per sample, [B]
        """
        if not self.needs_next_latents:
            return self.loss(batch, latents).error
        next_views = self.augment.center(batch.next_observations)
        return self.loss(batch, latents, self.encoder(next_views)).error

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """Draw views from latents.

        :param latents: [B, encoder.features_dim]
        :return: Views [B, *view shape] (images in 0-255), or None if the head does not decode
        """
        return None

    def after_step(self) -> None:
        """Update moving averages; called after each step of the head."""
