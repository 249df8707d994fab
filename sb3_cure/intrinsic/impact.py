"""Impact: how much a step changes features that depend on actions."""

from typing import Any

import torch as th

from sb3_cure.intrinsic.base import RewardInputs
from sb3_cure.intrinsic.icm import ICM


class Impact(ICM):
    """Distance between a step's two latents, which ICM's models train (RIDE; Raileanu & Rocktäschel, 2020, section 4).

    Unlike ICM's own reward it does not fade as the models learn. The paper divides it by the square root of the state's
    visits in the episode, which is left out here: batches of a replay buffer hold no whole episodes.

    :param args: As for ``IntrinsicReward``
    :param hidden_dim: Width of the models' hidden layer
    """

    def __init__(self, *args: Any, hidden_dim: int = 256):
        super().__init__(*args, hidden_dim=hidden_dim)

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor, th.Tensor]:
        """Compute ICM's loss, and how far apart the latents of each step are.

        :param inputs: Its latents and actions are read
        :return: ICM's loss, and the distance of each sample's latents, [B]
        """
        loss, _ = super().loss(inputs)
        return loss, (inputs.next_latents - inputs.latents).detach().square().sum(dim=1).sqrt()
