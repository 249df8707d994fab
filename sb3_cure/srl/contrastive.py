"""Contrastive head: InfoNCE with instance discrimination, eq. 3 of the paper, as CURL (Laskin et al., 2020)."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn
from torch.nn import functional as F

from sb3_cure.data.samples import Samples
from sb3_cure.networks.augmentations import Augmentation, RandomCrop
from sb3_cure.networks.encoders import Encoder
from sb3_cure.srl.base import SRLHead, SRLOutput

#: Largest image, in pixels, that ``augmentation="auto"`` shifts; larger ones are cropped
LARGEST_SHIFTED = 84


class CURL(SRLHead):
    """InfoNCE: two augmentations of one observation attract each other, those of the rest of the batch repel.

    The similarity is bilinear, q^T W k; keys come from the momentum encoder. (In the paper's eq. 3 the negatives
    lack an exp and the sign is that of a likelihood; here it is cross-entropy on the diagonal.)
    With ``augmentation="auto"`` images of more than 84 pixels per side are cropped in CURL's proportion (84 of 100),
    and latents have no tanh; others are shifted, as in DrQ.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations: images
    :param bank_size: How many stored observations serve as fixed negatives in ``error``
    """

    error_tells_novelty = False

    def __init__(self, encoder: Encoder, observation_space: spaces.Space, bank_size: int = 64):
        super().__init__(encoder, observation_space)
        self.choose_augmentation(observation_space)  # refuses all but images
        # CURL starts W uniform in [0, 1).
        self.W = nn.Parameter(th.rand(encoder.features_dim, encoder.features_dim))
        # Negatives of `error`, the first observations of training: negatives from the batch would change with it, and a
        # batch of one has none.
        self.register_buffer("bank", th.zeros((bank_size, *observation_space.shape), dtype=th.uint8))  # type: ignore[misc]
        #: Observations in the bank: a Python number, as reading a tensor would synchronise a GPU
        self.n_banked = 0

    def get_extra_state(self) -> th.Tensor:
        """Return how many observations are in the bank."""
        return th.tensor(self.n_banked)

    def set_extra_state(self, state: th.Tensor) -> None:
        """Restore how many observations are in the bank.

        :param state: Result of ``get_extra_state``
        """
        self.n_banked = int(state)

    @classmethod
    def choose_augmentation(cls, observation_space: spaces.Space) -> str:
        """Choose crops for large images and shifts for small ones.

        :param observation_space: Space of the stored observations
        :return: ``"crop"`` for images of more than 84 pixels per side, else ``"shift"``
        :raises ValueError: if observations are not images
        """
        if not is_image_space(observation_space):
            raise ValueError(
                f"srl='curl' compares two views of one image, but observations are {observation_space}: use srl='rae', "
                "or a head of your own."
            )
        return "crop" if min(observation_space.shape[1:]) > LARGEST_SHIFTED else "shift"  # type: ignore[index]

    @classmethod
    def configure_encoder(cls, augmentation: Augmentation) -> dict[str, Any]:
        """Leave tanh out with crops.

        :param augmentation: Makes the views that the encoder will see
        :return: Latents of crops without tanh, as in CURL's code
        """
        return {"tanh": False} if isinstance(augmentation, RandomCrop) else {}

    def bind(self, target_encoder: Encoder, augmentation: Augmentation) -> None:
        """Set target encoder and augmentation.

        :param target_encoder: The moving average of the encoder
        :param augmentation: The policy's augmentation
        :raises ValueError: if there is no augmentation
        """
        if not augmentation.is_random:
            raise ValueError("srl='curl' compares two random views, but augmentation is None: use 'shift' or 'crop'.")
        super().bind(target_encoder, augmentation)

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        """Compute eq. 3: cross-entropy of each anchor's own key among the keys of the batch.

        :param batch: Samples of the replay buffer
        :param latents: Anchors q, [B, features_dim]
        :param next_latents: Unused
        :return: Loss, and the cross-entropy of each anchor, [B], which is high where others of the batch look alike
        """
        if th.is_grad_enabled():  # the head learns
            self._fill_bank(batch.observations)
        keys = self._keys(self.augment(batch.observations))
        labels = th.arange(len(keys), device=keys.device)
        # Row maxima are subtracted inside cross_entropy.
        error = F.cross_entropy(latents @ self.W @ keys.T, labels, reduction="none")
        return SRLOutput(error.mean(), error.detach())

    @th.no_grad()
    def error(self, batch: Samples, latents: th.Tensor) -> th.Tensor:
        """Compute each anchor's cross-entropy against its own key and the fixed bank.

        Views come from a fixed seed, and other samples of the batch do not matter. A head that has not been trained has
        an empty bank: its error is 0.

        :param batch: Samples of the replay buffer
        :param latents: Anchors q, [B, features_dim]
        :return: [B]
        """
        # The same offset for all, drawn as for one image of many channels: neither batch size nor order matters.
        views = self.augment(batch.observations.flatten(0, 1)[None], th.Generator().manual_seed(0))
        own = self._keys(views.unflatten(1, batch.observations.shape[:2])[0])
        negatives = self.bank[: self.n_banked]  # type: ignore[index, arg-type]
        bank = self._keys(self.augment(negatives, th.Generator().manual_seed(1))) if len(negatives) > 0 else own[:0]
        weighted = latents @ self.W
        logits = th.cat([(weighted * own).sum(dim=1, keepdim=True), weighted @ bank.T], dim=1)
        first = th.zeros(len(logits), dtype=th.long, device=logits.device)
        # Rounding can leave less than 0, or a -0.0.
        return F.cross_entropy(logits, first, reduction="none").clamp(min=0).abs()

    @th.no_grad()
    def set_bank(self, observations: th.Tensor) -> None:
        """Set the negatives of ``error``, which otherwise are the first observations of training.

        Observations that resemble many in the bank have a high error. To compare policies, take an even mix of what
        they see (``sb3_cure.evaluation.rollouts.balanced_negatives``).

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

    @th.no_grad()
    def _keys(self, views: th.Tensor) -> th.Tensor:
        return self.target_encoder(views)

    @th.no_grad()
    def _fill_bank(self, observations: th.Tensor) -> None:
        room = len(self.bank) - self.n_banked  # type: ignore[arg-type]
        if room > 0:
            self._write_bank(self.n_banked, observations[:room])

    def _write_bank(self, start: int, observations: th.Tensor) -> None:
        """Store observations from this place on, and drop those behind them."""
        self.n_banked = start + len(observations)
        self.bank[start : self.n_banked] = observations  # type: ignore[index, operator]
