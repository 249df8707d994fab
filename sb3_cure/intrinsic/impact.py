"""Impact: how much a step changes, in features that tell what actions do."""

import torch as th
from gymnasium import spaces

from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.icm import ICM


class Impact(ICM):
    """Distance of a step's two latents, which ICM's models train (RIDE; Raileanu and Rocktäschel, 2020, section 4).

    Unlike ICM's own reward it does not fade as the models learn. Without the paper's division by the square root of how
    often the episode has seen a state: batches of a replay buffer hold no whole episodes.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the latents
    :param hidden_dim: Width of the models' hidden layer
    """

    def __init__(
        self, observation_space: spaces.Space, action_space: spaces.Box, features_dim: int, hidden_dim: int = 256
    ):
        super().__init__(observation_space, action_space, features_dim, hidden_dim=hidden_dim)

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: As of ``ICM``
        :param latents: [B, features_dim]
        :param next_latents: The same
        :param srl_error: Unused
        :return: ICM's loss, and the distance of each sample's latents, [B]
        """
        loss, _ = super().loss(batch, latents, next_latents, srl_error)
        assert latents is not None and next_latents is not None
        return loss, (next_latents - latents).detach().square().sum(dim=1).sqrt()
