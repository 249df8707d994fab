"""Random network distillation (RND): what a network has not learned to tell of the newest frame."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_cure.data.buffers import stored_places
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, LookUp
from sb3_cure.intrinsic.reward_networks import DITHER, make_network, scaled

#: Least and most observations that the statistics are taken of, and how many at a time
ENOUGH, OBSERVATIONS, CHUNK = 256, 1000, 100
#: Numbers of vectors that vary by less than this count as constant
SMALLEST = 1e-6


class RND(IntrinsicReward):
    """Error of a predictor of a fixed random network, on where the step leads (Burda et al., 2018, section 2.2).

    Inputs are whitened pixel by pixel and clipped to +-5, as there. The statistics are those of what the replay buffer
    holds at the first update, which is the random warm-up, and then frozen: drift would move the target. Of a warm-up
    of less than ``ENOUGH`` transitions they are taken anew in each update, until there are as many.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Unused: the encoder's latents, which move, are not read
    :param frame_stack: Frames per image, of which the newest is read
    :param n_filters: Channels of the convolutions
    :param n_outputs: Size of what is predicted
    :param hidden_dim: Width of the predictor's two further layers
    """

    mixed_precision = True
    per_image = True
    asks = ("frame_stack",)

    mean: th.Tensor
    variance: th.Tensor
    measured: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        frame_stack: int = 1,
        n_filters: int = 16,
        n_outputs: int = 128,
        hidden_dim: int = 256,
    ):
        super().__init__(observation_space, action_space, features_dim)
        self.space = observation_space
        if is_image_space(observation_space, check_channels=False):
            channels, height, width = observation_space.shape  # type: ignore[misc]
            self.space = spaces.Box(0, 255, (channels // frame_stack, height, width), np.uint8)
        self.target = make_network(self.space, [hidden_dim, n_outputs], n_filters).requires_grad_(False)
        self.predictor = make_network(self.space, [hidden_dim, hidden_dim, hidden_dim, n_outputs], n_filters)
        shape = scaled(th.as_tensor(self.space.sample())[None], self.space).shape[1:]
        self.register_buffer("mean", th.zeros(shape))
        self.register_buffer("variance", th.zeros(shape))
        # Whether the statistics are final; the same as a Python bool, which waits for no device (None: to be read)
        self.register_buffer("measured", th.tensor(False))
        self._is_measured: bool | None = None
        self.register_load_state_dict_post_hook(self._read_anew)

    @staticmethod
    def _read_anew(reward: nn.Module, incompatible_keys: object) -> None:
        reward._is_measured = None  # type: ignore[assignment]

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """Take the statistics, until they are of enough.

        :param replay_buffer: The replay buffer
        :param look_up: What it holds
        :param encode: Unused
        """
        if self._is_measured is None:
            self._is_measured = bool(self.measured)
        if self._is_measured:
            return
        rows, env_inds, _ = stored_places(replay_buffer)
        chosen = np.linspace(0, len(rows) - 1, min(len(rows), OBSERVATIONS)).astype(int)
        total, squares = th.zeros_like(self.mean, dtype=th.float64), th.zeros_like(self.mean, dtype=th.float64)
        for part in np.split(chosen, range(CHUNK, len(chosen), CHUNK)):
            seen = self._newest(look_up(rows[part], env_inds[part]).next_observations).double()
            total += seen.sum(dim=0)
            squares += seen.square().sum(dim=0)
        mean = total / len(chosen)
        self.mean.copy_(mean)
        self.variance.copy_((squares / len(chosen) - mean.square()).clamp(min=0))
        self._is_measured = len(rows) >= ENOUGH or replay_buffer.full
        self.measured.fill_(self._is_measured)

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param batch: Its next observations are read
        :param latents: Unused
        :param next_latents: Unused
        :param srl_error: Unused
        :return: The predictor's mean squared error, and that of each sample, [B]
        """
        smallest = DITHER if self.mean.dim() == 3 else SMALLEST
        seen = self._newest(batch.next_observations)
        seen = ((seen - self.mean) * (self.variance + smallest).rsqrt()).clamp_(-5, 5)
        error = (self.predictor(seen) - self.target(seen)).square().mean(dim=1)
        return error.mean(), error.detach()

    def _newest(self, observations: th.Tensor) -> th.Tensor:
        if observations.dim() == 4:
            observations = observations[:, -self.space.shape[0] :]  # type: ignore[index]
        return scaled(observations, self.space)
