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

    The loss is the sum: each encoder is trained as if its image were alone. The error is the mean over images, each
    divided by its running size (see ``MeanError``).

    :param head_class: Class of the heads
    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param kwargs: Arguments of each head
    :raises ValueError: if the encoder does not keep the images apart
    """

    def __init__(self, head_class: type[SRLHead], encoder: Encoder, observation_space: spaces.Dict, **kwargs: Any):
        if not isinstance(encoder, DictEncoder):
            raise ValueError(
                f"srl={head_class.__name__} needs the latents of each image of a dictionary, but the "
                "features_extractor_class joins them: use DictEncoder, or srl=None."
            )
        super().__init__(encoder, observation_space)
        self.heads = nn.ModuleList(
            head_class(image, observation_space[key], **kwargs) for key, image in encoder.images.items()
        )
        #: Part of the joint latents that belongs to each image, by key
        self.slices = encoder.slices
        self.mean_error = MeanError(len(self.heads))
        self.error_tells_novelty = head_class.error_tells_novelty  # type: ignore[misc]
        self.optimizer_kwargs = self.heads[0].optimizer_kwargs  # type: ignore[assignment]

    def bind(self, target_encoder: Encoder, augmentation: Augmentation) -> None:
        """Set target encoder and augmentation of each head.

        :param target_encoder: The moving average of the encoder
        :param augmentation: The policy's augmentation
        """
        super().bind(target_encoder, augmentation)
        images: Any = target_encoder.images
        for key, head in heads_by_key(self).items():
            head.bind(images[key], augmentation.of(key))

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Add the heads' losses up.

        :param batch: Samples of the replay buffer, observations by key
        :param latents: Joint latents, [B, features_dim]
        :param next_latents: Unused
        :return: Sum of the losses, and the mean error of each sample, [B]
        """
        outputs = [head.loss(batch.of(key), part) for key, head, part in self.parts(latents)]
        error = self.mean_error([output.error for output in outputs], learns=th.is_grad_enabled())
        return SRLOutput(th.stack([output.loss for output in outputs]).sum(), error)

    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """Average the heads' noise-free errors.

        :param batch: Samples of the replay buffer, observations by key
        :param latents: Joint latents, [B, features_dim]
        :return: Mean of the noise-free errors, [B]
        """
        errors = [head.error(batch.of(key), part) for key, head, part in self.parts(latents)]
        return self.mean_error(errors, learns=False)

    def reconstruct(self, latents: th.Tensor) -> dict[str, th.Tensor] | None:  # type: ignore[override]
        """Draw the views of each image.

        :param latents: Joint latents, [B, features_dim]
        :return: Views by key, or None if the heads do not decode
        """
        drawn = {key: head.reconstruct(part) for key, head, part in self.parts(latents)}
        return None if None in drawn.values() else drawn

    def after_step(self) -> None:
        """Update the moving averages of each head."""
        for head in self.heads:
            head.after_step()  # type: ignore[operator]

    def parts(self, latents: th.Tensor) -> list[tuple[str, Any, th.Tensor]]:
        """Split joint latents.

        :param latents: Joint latents, [B, features_dim]
        :return: Key, head and latents of each image
        """
        return [(key, head, latents[:, self.slices[key]]) for key, head in heads_by_key(self).items()]


def heads_by_key(head: SRLHead | None) -> dict[str, Any]:
    """Return a policy's heads by the image that they represent.

    :param head: A policy's head, or None
    :return: The head of each image of a dictionary by key, or the head itself under the key ``""``
    """
    if isinstance(head, DictHead):
        return dict(zip(head.slices, head.heads, strict=True))
    return {} if head is None else {"": head}
