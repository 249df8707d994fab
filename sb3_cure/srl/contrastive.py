"""Contrastive head: InfoNCE with instance discrimination, eq. 3 of the paper, as CURL (Laskin et al., 2020)."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F

from sb3_cure.augmentations import center_crop, random_crop, random_shift
from sb3_cure.encoders import Encoder
from sb3_cure.layers import full_precision
from sb3_cure.srl.base import SRLHead, SRLOutput
from sb3_cure.values import is_integer, is_one_of


class CURL(SRLHead):
    """InfoNCE: two augmentations of one observation attract each other, those of the rest of the batch repel.

    The similarity is bilinear, q^T W k; keys come from the momentum encoder. (In the paper's eq. 3 the negatives
    lack an exp and the sign is that of a likelihood; what is meant, and done here, is cross-entropy on the diagonal.)

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations: images
    :param augmentation: ``"crop"`` as in CURL: random squares of ``crop_size`` from larger observations (rendered at
        100 px), the central one to act, latents without tanh; ``"shift"``: pad and shift as in DrQ, at any size;
        ``"auto"``: crop when observations are larger than ``crop_size``, else shift
    :param crop_size: Side of the crops, pixels
    :param pad: Largest shift, pixels
    :param bank_size: How many stored observations serve as fixed negatives in ``error``
    :raises ValueError: if observations are no images or too small to crop
    """

    mixed_precision = True

    def __init__(
        self,
        encoder: Encoder,
        observation_space: spaces.Space,
        augmentation: str = "auto",
        crop_size: int = 84,
        pad: int = 4,
        bank_size: int = 64,
    ):
        super().__init__(encoder, observation_space)
        if not (is_integer(pad, 1) and is_integer(bank_size, 1)):
            raise ValueError(
                f"srl_kwargs got pad={pad!r} and bank_size={bank_size!r}, but each must be at least 1: change "
                "srl_kwargs."
            )
        self.crops = self._resolve(observation_space, augmentation, crop_size) == "crop"
        self.crop_size = crop_size
        self.pad = pad
        # CURL starts W uniform in [0, 1).
        self.W = nn.Parameter(th.rand(encoder.features_dim, encoder.features_dim))
        # The first observations of training, kept as the negatives of `error`: within a batch they would change with
        # the batch, and a batch of one has none.
        self.register_buffer("bank", th.zeros((bank_size, *observation_space.shape), dtype=th.uint8))  # type: ignore[misc]
        self.register_buffer("bank_filled", th.zeros((), dtype=th.long))
        # The fill level as a Python number, which needs no device synchronisation; None: read it from the buffer.
        self._n_banked: int | None = None
        self.register_load_state_dict_post_hook(self._forget_fill_level)

    @staticmethod
    def _forget_fill_level(head: nn.Module, incompatible_keys: object) -> None:
        head._n_banked = None  # type: ignore[assignment]

    @staticmethod
    def _resolve(observation_space: spaces.Space, augmentation: str, crop_size: int) -> str:
        if not is_image_space(observation_space):
            raise ValueError(
                f"srl='curl' got observations {observation_space}, but it learns from two crops of one image and "
                "vectors have none: use srl='rae', or a head of your own, with 'MlpPolicy'."
            )
        size = min(observation_space.shape[1:])  # type: ignore[index]
        if not is_integer(crop_size, 0):
            raise ValueError(f"srl_kwargs got crop_size={crop_size!r}, but it counts pixels: give a whole number.")
        if augmentation == "auto":
            augmentation = "crop" if size > crop_size else "shift"
        if not is_one_of(augmentation, ("crop", "shift")):
            raise ValueError(
                f"srl_kwargs got augmentation={augmentation!r}, but srl='curl' knows 'crop', 'shift' and 'auto': "
                "choose one of them."
            )
        if augmentation == "crop" and not 1 <= crop_size < size:
            raise ValueError(
                f"srl_kwargs got augmentation='crop' with crop_size={crop_size} for observations of {size} pixels, but "
                "crops must have at least 1 pixel and be smaller than the observation: render larger (CURL: "
                "image_size=100), set another crop_size, or use augmentation='shift'."
            )
        return augmentation

    @classmethod
    def configure_encoder(
        cls,
        observation_space: spaces.Space,
        augmentation: str = "auto",
        crop_size: int = 84,
        **srl_kwargs: Any,
    ) -> tuple[spaces.Space, dict[str, Any]]:
        """The encoder sees the crop, and without a tanh, as in CURL's code; after a shift it sees all, with one.

        :param observation_space: Space of the stored observations
        :param augmentation: As in the constructor
        :param crop_size: As in the constructor
        :param srl_kwargs: The rest of the head's arguments
        :return: The space that the encoder sees, and default arguments for ``PixelEncoder``
        """
        if cls._resolve(observation_space, augmentation, crop_size) == "shift":
            return observation_space, {}
        shape = (observation_space.shape[0], crop_size, crop_size)  # type: ignore[index]
        return spaces.Box(0, 255, shape, np.uint8), {"tanh": False}

    def augment(self, observations: th.Tensor) -> th.Tensor:
        """Random crop or shift, the same for all frames of one observation.

        :param observations: [B, C, H, W], 0-255
        :return: [B, C, crop_size, crop_size], or [B, C, H, W] with shifts
        """
        return self._augment(observations)

    def center(self, observations: th.Tensor) -> th.Tensor:
        """Centre crop, or with shifts the whole image.

        :param observations: [B, C, H, W], 0-255
        :return: [B, C, crop_size, crop_size], or [B, C, H, W] with shifts
        """
        return center_crop(observations, self.crop_size) if self.crops else observations

    def loss(self, batch: ReplayBufferSamples, latents: th.Tensor) -> SRLOutput:
        """Eq. 3: cross-entropy of finding each anchor's own key among the keys of the batch.

        :param batch: Samples of the replay buffer
        :param latents: Anchors q, [B, features_dim]
        :return: Loss, and the cross-entropy of each anchor, [B]
        """
        self._fill_bank(batch.observations)
        keys = self._keys(self._augment(batch.observations))
        labels = th.arange(len(keys), device=keys.device)
        # In fp32, where autocast would round the products; row maxima are subtracted inside cross_entropy.
        with full_precision(latents):
            error = F.cross_entropy(latents.float() @ self.W @ keys.T, labels, reduction="none")
        return SRLOutput(error.mean(), error.detach())

    @th.no_grad()
    def error(self, batch: ReplayBufferSamples, latents: th.Tensor) -> th.Tensor:
        """Cross-entropy of each anchor against its own key and the fixed bank; crops from a fixed seed.

        Does not depend on the other samples of the batch. A head that has not been trained has an empty bank: the
        error is then 0.

        :param batch: Samples of the replay buffer
        :param latents: Anchors q, [B, features_dim]
        :return: [B]
        """
        negatives = self.bank[: int(self.bank_filled)]  # type: ignore[index, arg-type]
        # The same offset for all, drawn for them as one image of many channels: neither batch size nor order matters.
        views = self._augment(batch.observations.flatten(0, 1)[None], th.Generator().manual_seed(0))
        own = self._keys(views.unflatten(1, batch.observations.shape[:2])[0])
        with full_precision(latents):
            weighted = latents.float() @ self.W
            logits = (weighted * own).sum(dim=1, keepdim=True)
        if len(negatives) > 0:
            bank = self._keys(self._augment(negatives, th.Generator().manual_seed(1)))
            with full_precision(latents):
                logits = th.cat([logits, weighted @ bank.T], dim=1)
        first = th.zeros(len(logits), dtype=th.long, device=logits.device)
        # Rounding can leave less than 0, or a -0.0.
        return F.cross_entropy(logits, first, reduction="none").clamp(min=0).abs()

    @th.no_grad()
    def set_bank(self, observations: th.Tensor) -> None:
        """Choose the negatives of ``error``, which otherwise are the first observations of training.

        What the error says depends on them: observations score high that look like many of the bank. To compare
        policies, take an even mix of what they see (``sb3_cure.evaluation.even_negatives``).

        :param observations: 1 to ``bank_size`` observations as stored, [n, *shape], 0-255
        :raises ValueError: if there are none, too many, or of another shape
        """
        bank: th.Tensor = self.bank  # type: ignore[assignment]
        if not 1 <= len(observations) <= len(bank) or observations.shape[1:] != bank.shape[1:]:
            raise ValueError(
                f"set_bank got observations of shape {tuple(observations.shape)}, but the bank holds 1 to {len(bank)} "
                f"of shape {tuple(bank.shape[1:])}: choose fewer, or another srl_kwargs=dict(bank_size=...)."
            )
        self._write_bank(0, observations)

    def _augment(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        if self.crops:
            return random_crop(observations, self.crop_size, generator)
        return random_shift(observations, self.pad, generator)

    @th.no_grad()
    def _keys(self, views: th.Tensor) -> th.Tensor:
        return self.target_encoder(self.preprocess(views)).float()

    @th.no_grad()
    def _fill_bank(self, observations: th.Tensor) -> None:
        bank: th.Tensor = self.bank  # type: ignore[assignment]
        if self._n_banked is None:
            self._n_banked = int(self.bank_filled)  # type: ignore[arg-type]
        room = len(bank) - self._n_banked
        if room > 0:
            self._write_bank(self._n_banked, observations[:room])

    def _write_bank(self, start: int, observations: th.Tensor) -> None:
        """Store observations from this place on, and forget what lies behind them."""
        self._n_banked = start + len(observations)
        self.bank[start : self._n_banked] = observations  # type: ignore[index, operator]
        self.bank_filled.fill_(self._n_banked)  # type: ignore[operator]
