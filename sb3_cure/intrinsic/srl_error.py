"""The paper's reward: the error of the state representation (section "CuRe")."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward
from sb3_cure.intrinsic.reward_networks import DITHER
from sb3_cure.networks.layers import flatten_vectors
from sb3_cure.srl.base import SRLHead


class SRLError(IntrinsicReward):
    """r_cure = L_SRL: what the SRL head does badly is worth visiting.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param per_pixel: Divide the squared error of each pixel by its running variance plus that of the dither, so that a
        ball of few pixels counts; for heads that draw, in views without noise. It costs a run of the decoder
    :param curiosity_target: Whether that error is the observation's or the next one's
    :param decay: Weight of the past in the running variances, per update
    """

    needs_srl = True
    asks = ("curiosity_target",)

    variance: th.Tensor
    weight: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        per_pixel: bool = False,
        curiosity_target: str = "observation",
        decay: float = 0.99,
    ):
        super().__init__(observation_space, action_space, features_dim)
        self.per_pixel, self.decay = per_pixel, decay
        self.about_next = curiosity_target == "next_observation"
        if per_pixel:
            self.reads = ("next_latents" if self.about_next else "latents",)
            self.mixed_precision = self.measures = True

    @classmethod
    def configured(cls, per_pixel: bool = False, **kwargs: Any) -> type[IntrinsicReward]:
        """
        :param per_pixel: As of the constructor
        :param kwargs: Its other arguments
        :return: This class, or one that reads images
        """
        return PerPixel if per_pixel else cls

    def bind(self, srl: SRLHead | None) -> None:
        """
        :param srl: The SRL head, of dictionaries that of one image
        :raises ValueError: if pixels are to be compared, and the head does not draw
        """
        if not self.per_pixel or srl is None:
            return
        if type(srl).reconstruct is SRLHead.reconstruct:
            raise ValueError(
                f"per_pixel=True compares pixels, but {type(srl).__name__} does not draw: use srl='rae', another head "
                "that implements reconstruct, or intrinsic='reconstruction'."
            )
        # In a tuple, so that the head is not registered as a part of the reward.
        self._srl = (srl,)
        space = srl.encoder.view_space
        shape = space.shape if is_image_space(space) else (get_flattened_obs_dim(space),)
        self.register_buffer("variance", th.zeros(shape))  # type: ignore[arg-type]
        self.register_buffer("weight", th.zeros(()))

    @th.no_grad()
    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[None, th.Tensor]:
        """
        :param batch: The true transitions; read if ``per_pixel``
        :param latents: [B, features_dim], if ``per_pixel`` and the error is the observation's
        :param next_latents: [B, features_dim], if ``per_pixel`` and it is the next one's
        :param srl_error: SRL error of the observations, or next observations (``curiosity_target``), [B]
        :return: None, and the error, [B]
        """
        if not self.per_pixel:
            assert srl_error is not None
            return None, srl_error
        observations = batch.next_observations if self.about_next else batch.observations
        seen = self._seen(observations)
        self.variance.lerp_(seen.var(dim=0, correction=0), 1 - self.decay)
        # An average that starts at zero, as in RewardScale
        self.weight.lerp_(th.ones_like(self.weight), 1 - self.decay)
        return None, self._error(seen, next_latents if self.about_next else latents)  # type: ignore[arg-type]

    @th.no_grad()
    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """
        :param observations: As stored, [B, *shape]
        :param latents: Theirs, [B, features_dim]
        :return: Error of each, by the variances as they are, [B]
        """
        return self._error(self._seen(observations), latents)

    def _seen(self, observations: th.Tensor) -> th.Tensor:
        (srl,) = self._srl
        views = srl.augment.center(observations)
        if views.dim() == 4:
            return views.contiguous(memory_format=th.channels_last).float().div_(255)
        return flatten_vectors(views, srl.encoder.view_space)

    def _error(self, seen: th.Tensor, latents: th.Tensor) -> th.Tensor:
        drawn = self._srl[0].reconstruct(latents)
        assert drawn is not None
        drawn = drawn.float().div_(255) if drawn.dim() == 4 else drawn.float()
        variance = self.variance / self.weight.clamp(min=1 - self.decay) + DITHER
        return (drawn.sub_(seen).square_() / variance).flatten(1).mean(dim=1)


class PerPixel(SRLError):
    """What ``SRLError`` declares with ``per_pixel=True``."""

    per_image = True
