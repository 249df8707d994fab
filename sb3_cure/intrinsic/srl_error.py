"""The paper's reward: the error of the state representation (section "CuRe")."""

from itertools import chain
from typing import Any

import torch as th

from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.intrinsic.reward_networks import DITHER
from sb3_cure.networks.layers import move_average, scale_images
from sb3_cure.srl import SRLHead


class SRLError(IntrinsicReward):
    """r_cure = L_SRL: states that the SRL head represents badly are worth visiting.

    :param args: As for ``IntrinsicReward``
    :param per_pixel: Divide the squared error of each pixel by its running variance plus that of the dither, so that a
        ball of few pixels counts; for heads that decode, in views without noise. It costs a pass of the decoder
    :param decay: Weight of the past in the running variances, per update
    :param curiosity_target: Whose error it is: ``"observation"`` or ``"next_observation"``
    :param srl: The SRL head; for dictionaries, the head of one image
    :raises ValueError: if pixels are to be compared, and the head does not decode
    """

    needs_srl = True

    variance: th.Tensor
    weight: th.Tensor

    def __init__(
        self,
        *args: Any,
        per_pixel: bool = False,
        decay: float = 0.99,
        curiosity_target: str = "observation",
        srl: SRLHead | None = None,
    ):
        super().__init__(*args)
        self.per_pixel = self.measures = per_pixel
        self.decay, self.is_about_next = decay, curiosity_target == "next_observation"
        if not per_pixel:
            return
        if type(srl).reconstruct is SRLHead.reconstruct:  # type: ignore[union-attr]
            raise ValueError(
                f"per_pixel=True compares pixels, but {type(srl).__name__} does not draw: use srl='rae', another head "
                "that implements reconstruct, or intrinsic='reconstruction'."
            )
        self._srl: tuple[Any] = (srl,)
        where = next(chain(srl.parameters(), srl.encoder.parameters())).device  # type: ignore[union-attr]
        example = th.as_tensor(self.observation_space.sample(), device=where)[None]
        self.register_buffer("variance", th.zeros(self._target(example).shape[1:]))
        self.register_buffer("weight", th.zeros(()))

    @classmethod
    def is_per_image(cls, per_pixel: bool = False, **kwargs: Any) -> bool:
        """Return whether pixels are compared."""
        return per_pixel

    @th.no_grad()
    def loss(self, inputs: RewardInputs) -> tuple[None, th.Tensor]:
        """Return the SRL error, or the error per pixel.

        :param inputs: Its SRL error is read; or, if ``per_pixel``, its (next) observations and their latents
        :return: None, and the error, [B]
        """
        if not self.per_pixel:
            return None, inputs.srl_error
        batch = inputs.batch
        target = self._target(batch.next_observations if self.is_about_next else batch.observations)
        move_average(self.variance, self.weight, target.var(dim=0, correction=0), self.decay)
        return None, self._error(target, inputs.next_latents if self.is_about_next else inputs.latents)

    @th.no_grad()
    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Compute the error per pixel of each observation, without updating the variances.

        :param observations: As stored, [B, *shape]
        :param latents: Their latents, [B, features_dim]
        :return: [B]
        """
        return self._error(self._target(observations), latents)

    def _target(self, observations: th.Tensor) -> th.Tensor:
        """Return the centred views, images in [0, 1]."""
        (srl,) = self._srl
        views = srl.augment.center(observations)
        if views.dim() == 4:
            return scale_images(views.contiguous(memory_format=th.channels_last))
        return srl.encoder.vector_target(views)  # type: ignore[no-any-return]

    def _error(self, target: th.Tensor, latents: th.Tensor) -> th.Tensor:
        drawn = self._srl[0].reconstruct(latents)
        assert drawn is not None
        drawn = drawn.float().div_(255) if drawn.dim() == 4 else drawn.float()
        variance = self.variance / self.weight.clamp(min=1 - self.decay) + DITHER
        return (drawn.sub_(target).square_() / variance).flatten(1).mean(dim=1)
