"""One head for each image of a dictionary."""

from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import Augmentation
from sb3_cure.networks.encoders import DictEncoder, Encoder
from sb3_cure.networks.layers import MeanError
from sb3_cure.srl.base import SRLHead, SRLOutput


class DictHead(SRLHead):
    """A head of one class for each image of a dictionary, each on the latents of its own image.

    Losses are added up: each encoder is trained as if its image were alone. The error is the mean over images, each
    divided by its running deviation.

    :param head_class: Class of the heads
    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param kwargs: Arguments of each head
    :raises ValueError: if the encoder does not keep the images apart
    """

    #: Of the images whose heads there are
    keys: tuple[str, ...] = ()

    def __init__(self, head_class: type[SRLHead], encoder: Encoder, observation_space: spaces.Dict, **kwargs: Any):
        if not isinstance(encoder, DictEncoder):
            raise ValueError(
                f"srl={head_class.__name__} learns from each image of a dictionary by itself, but the "
                "features_extractor_class makes one vector of all: use DictEncoder, or srl=None."
            )
        super().__init__(encoder, observation_space)
        self.heads = nn.ModuleList(
            head_class(image, observation_space[key], **kwargs) for key, image in encoder.images.items()
        )
        self.keys, self.slices = tuple(encoder.images), tuple(encoder.slices.values())
        self.mean_error = MeanError(len(self.keys))
        self.optimizer_kwargs = self.heads[0].optimizer_kwargs  # type: ignore[assignment]
        for name in ("warmup_updates", "mixed_precision"):
            setattr(self, name, getattr(head_class, name))

    def bind(self, target_encoder: Encoder, augmentation: Augmentation) -> None:
        """
        :param target_encoder: The moving average of the encoder
        :param augmentation: The policy's
        """
        super().bind(target_encoder, augmentation)
        images: Any = target_encoder.images
        for key, head in heads_by_key(self).items():
            head.bind(images[key], augmentation.of(key))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """
        :param batch: Samples of the replay buffer, observations by key
        :param latents: Joined latents, [B, features_dim]
        :param next_latents: Unused
        :return: Sum of the losses, and the mean error of each sample, [B]
        """
        outputs = [head.loss(batch.of(key), part) for key, head, part in self.parts(latents)]
        error = self.mean_error([output.error for output in outputs], learns=th.is_grad_enabled())
        return SRLOutput(th.stack([output.loss.float() for output in outputs]).sum(), error)

    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """
        :param batch: Samples of the replay buffer, observations by key
        :param latents: Joined latents, [B, features_dim]
        :return: Mean of the noise-free errors, [B]
        """
        errors = [head.error(batch.of(key), part) for key, head, part in self.parts(latents)]
        return self.mean_error(errors, learns=False)

    def reconstruct(self, latents: th.Tensor) -> dict[str, th.Tensor] | None:  # type: ignore[override]
        """
        :param latents: Joined latents, [B, features_dim]
        :return: Views by key, or None if the heads do not decode
        """
        drawn = {key: head.reconstruct(part) for key, head, part in self.parts(latents)}
        return None if None in drawn.values() else drawn

    def after_step(self) -> None:
        """Called after each update in which the heads learned."""
        for head in heads_by_key(self).values():
            head.after_step()

    def parts(self, latents: th.Tensor) -> list[tuple[str, Any, th.Tensor]]:
        """
        :param latents: Joined latents, [B, features_dim]
        :return: Key, head and latents of each image
        """
        parts = zip(self.keys, self.heads, self.slices, strict=True)
        return [(key, head, latents[:, where]) for key, head, where in parts]


def heads_by_key(head: SRLHead | None) -> dict[str, Any]:
    """
    :param head: A policy's head
    :return: What it is made of: the head of each image of a dictionary, or itself under the key ``""``
    """
    if isinstance(head, DictHead):
        return {key: head.heads[i] for i, key in enumerate(head.keys)}
    return {} if head is None else {"": head}
