"""Random network distillation (RND): the error of a predictor of a random network, on the newest frame."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_cure.data.buffers import stored_places
from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.intrinsic.reward_networks import DITHER, make_network, scaled

#: Least and largest number of observations for the statistics, and how many are looked up at a time
ENOUGH, OBSERVATIONS, CHUNK = 256, 1000, 100
#: Entries of vectors whose variance is below this count as constant
SMALLEST = 1e-6


class RND(IntrinsicReward):
    """Error of a predictor of a fixed random network, on where the step leads (Burda et al., 2018, section 2.2).

    Inputs are whitened pixel by pixel and clipped to +-5, as there. The statistics are those of the replay buffer's
    contents at the first update, which is the random warm-up, and then frozen: drift would move the target. After a
    warm-up of less than ``ENOUGH`` transitions they are computed anew in each update, until there are as many
    or the buffer is full.

    :param args: As for ``IntrinsicReward``
    :param frame_stack: Frames per image, of which the newest is read
    :param n_filters: Channels of the convolutions
    :param n_outputs: Size of the prediction
    :param hidden_dim: Width of the predictor's two further layers
    """

    mean: th.Tensor
    variance: th.Tensor
    measured: th.Tensor

    def __init__(
        self, *args: Any, frame_stack: int = 1, n_filters: int = 16, n_outputs: int = 128, hidden_dim: int = 256
    ):
        super().__init__(*args)
        self.space = self.observation_space
        if is_image_space(self.space):
            channels, height, width = self.space.shape  # type: ignore[misc]
            self.space = spaces.Box(0, 255, (channels // frame_stack, height, width), np.uint8)
        self.target = make_network(self.space, [hidden_dim, n_outputs], n_filters).requires_grad_(False)
        self.predictor = make_network(self.space, [hidden_dim, hidden_dim, hidden_dim, n_outputs], n_filters)
        shape = scaled(th.as_tensor(self.space.sample())[None], self.space).shape[1:]
        self.register_buffer("mean", th.zeros(shape))
        self.register_buffer("variance", th.zeros(shape))
        # Whether the statistics are final; and cached as a bool, to avoid a GPU synchronisation (None: not read yet)
        self.register_buffer("measured", th.tensor(False))
        self._is_measured: bool | None = None
        self.register_load_state_dict_post_hook(self._read_anew)

    @staticmethod
    def _read_anew(reward: nn.Module, incompatible_keys: object) -> None:
        reward._is_measured = None  # type: ignore[assignment]

    @classmethod
    def is_per_image(cls, **kwargs: Any) -> bool:
        """Return True: the networks read one image."""
        return True

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor, th.Tensor]:
        """Predict the random network's outputs.

        :param inputs: Its next observations are read, and the replay buffer until the statistics are final
        :return: The predictor's mean squared error, and that of each sample, [B]
        """
        self._measure(inputs)
        smallest = DITHER if self.mean.dim() == 3 else SMALLEST
        seen = self._newest(inputs.batch.next_observations)
        seen = ((seen - self.mean) * (self.variance + smallest).rsqrt()).clamp_(-5, 5)
        error = (self.predictor(seen) - self.target(seen)).square().mean(dim=1)
        return error.mean(), error.detach()

    def _measure(self, inputs: RewardInputs) -> None:
        """Compute mean and variance of each pixel, unless they are final."""
        if self._is_measured is None:
            self._is_measured = bool(self.measured)
        if self._is_measured:
            return
        rows, env_inds, _ = stored_places(inputs.replay_buffer)
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), OBSERVATIONS)).astype(int)
        total = squares = th.zeros_like(self.mean, dtype=th.float64)
        for part in np.split(chosen, range(CHUNK, len(chosen), CHUNK)):
            seen = self._newest(inputs.look_up(rows[part], env_inds[part]).next_observations).double()
            total, squares = total + seen.sum(dim=0), squares + seen.square().sum(dim=0)
        mean = total / len(chosen)
        self.mean.copy_(mean)
        self.variance.copy_((squares / len(chosen) - mean.square()).clamp(min=0))
        self._is_measured = len(rows) >= ENOUGH or inputs.replay_buffer.full
        self.measured.fill_(self._is_measured)

    def _newest(self, observations: th.Tensor) -> th.Tensor:
        """Return the newest frame, scaled."""
        if observations.dim() == 4:
            observations = observations[:, -self.space.shape[0] :]  # type: ignore[index]
        return scaled(observations, self.space)
