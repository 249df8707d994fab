"""Self-predictive representations (SPR; Schwarzer et al., 2021), one step ahead."""

import copy

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_cure.networks.encoders import Encoder
from sb3_cure.networks.layers import init_weights
from sb3_cure.srl.dynamics import NextLatents


class SPR(NextLatents):
    """Predicts a projection of the momentum encoder's next latents, with cosine similarity.

    As in the paper, prediction and target are compared after a projection, and the prediction goes through a predictor
    after it; the target's projection is a moving average. There are three differences. K = 1, as the replay buffer
    gives single transitions (their Atari agents predict 5 steps). The transition model is an MLP, as latents are
    vectors. The target is standardised (see ``NextLatents``), because otherwise, without critics, all latents
    collapsed to one vector within 100 updates. With ``augmentation="auto"`` images are shifted.

    :param encoder: The shared encoder
    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param hidden_dim: Width of the transition model
    :param tau: Polyak rate of the target's projection, after each update of the head
    """

    def __init__(
        self,
        encoder: Encoder,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        hidden_dim: int = 256,
        tau: float = 0.05,
    ):
        super().__init__(encoder, observation_space, action_space)
        size = encoder.features_dim
        self.transition = nn.Sequential(*create_mlp(self.n_inputs, size, [hidden_dim]))
        self.projection = nn.Linear(size, size)
        self.predictor = nn.Linear(size, size)
        init_weights(self)
        self.target_projection = copy.deepcopy(self.projection).requires_grad_(False)
        self.tau = tau

    @classmethod
    def choose_augmentation(cls, observation_space: spaces.Space) -> str | None:
        """Choose shifts for images.

        :param observation_space: Space of the stored observations
        :return: ``"shift"`` for images, None for vectors
        """
        return "shift" if is_image_space(observation_space) else None

    def project(self, latents: th.Tensor) -> th.Tensor:
        """Project latents by the moving average of the projection.

        :param latents: Of the next observations, by the momentum encoder, [B, features_dim]
        :return: Their projection, [B, features_dim]
        """
        return self.target_projection(latents)

    def distance(self, inputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Compute eq. 2 of the paper with K = 1, plus one.

        :param inputs: Latents and action, [B, n_inputs]
        :param target: Projection of the next latents, standardised, [B, features_dim]
        :return: 1 - cosine similarity of each prediction, in [0, 2], [B]
        """
        predicted = self.predictor(self.projection(self.transition(inputs)))
        # Rounding can leave a similarity above 1.
        return (1 - F.cosine_similarity(predicted, target, dim=1)).clamp(min=0)

    @th.no_grad()
    def after_step(self) -> None:
        """Update the moving average of the projection."""
        for target, online in zip(self.target_projection.parameters(), self.projection.parameters(), strict=True):
            target.lerp_(online, self.tau)
