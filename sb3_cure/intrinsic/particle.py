"""Particle entropy: how far a state is from those that were seen in other episodes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy import ndarray
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.data.samples import Samples
from sb3_cure.intrinsic.base import IntrinsicReward, LookUp
from sb3_cure.intrinsic.reward_networks import make_network, scaled
from sb3_cure.networks.layers import full_precision

#: Rows of the replay buffer that are looked at in one go
CHUNK = 1000


class Particle(IntrinsicReward):
    """log(1 + mean distance to the k nearest neighbours) of where the step leads (Liu & Abbeel, 2021, eq. 5).

    Neighbours are sought in the batch and in a memory of what was sampled last. States of the same episode, the state
    itself among them, are no neighbours: else most of them would be the steps before and after it. An episode is also
    over where the stored stream breaks, as in another ``learn()``.

    :param observation_space: Space of the stored observations
    :param action_space: Action space
    :param features_dim: Size of the features
    :param space: Where distances are measured: ``"random"``, features of a random network that is never trained (RE3,
        Seo et al., 2021), which the memory keeps; or ``"latents"``, the encoder's (APT), for which the memory is
        encoded anew in each update, as stored latents go stale
    :param n_neighbours: k
    :param memory: How many transitions are remembered, by their places in the replay buffer
    :param n_filters: Channels of the random network
    :raises ValueError: for another space
    """

    per_image = True

    features: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        features_dim: int,
        space: str = "random",
        n_neighbours: int = 12,
        memory: int = 512,
        n_filters: int = 16,
    ):
        super().__init__(observation_space, action_space, features_dim)
        if space not in ("random", "latents"):
            raise ValueError(f"space is {space!r} in intrinsic_kwargs: choose 'random' or 'latents'.")
        self.observation_space, self.n_neighbours = observation_space, n_neighbours
        self.encoder: nn.Sequential | None = None
        if space == "random":
            self.mixed_precision = True
            self.encoder = make_network(observation_space, [features_dim], n_filters)
            self.encoder.append(nn.LayerNorm(features_dim, elementwise_affine=False)).requires_grad_(False)
            self.register_buffer("features", th.zeros(memory, features_dim))
        else:
            self.reads = ("next_latents",)
        # Rows and environments of the memory, [memory, 2]; a row of -1: nothing yet, or overwritten since
        self.places = np.full((memory, 2), -1)
        self._remembered: th.Tensor | None = None
        # Where the next ones go, and where the replay buffer was in the last update
        self.cursor = self.last_pos = 0
        # Number of the episode of each stored transition, of no two environments alike, [buffer_size, n_envs]
        self._episodes: ndarray | None = None

    def get_extra_state(self) -> dict[str, Any]:
        """
        :return: The memory
        """
        counters = th.tensor([self.cursor, self.last_pos])
        return {"places": th.from_numpy(self.places.copy()), "counters": counters}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``get_extra_state``
        """
        self.places = state["places"].cpu().numpy().copy()
        self.cursor, self.last_pos = state["counters"].tolist()

    @classmethod
    def configured(cls, space: str = "random", **kwargs: Any) -> type[IntrinsicReward]:
        """
        :param space: As of the constructor
        :param kwargs: Its other arguments
        :return: This class, or one that does not read images
        """
        return cls if space == "random" else IntrinsicReward

    def attach(self, replay_buffer: ReplayBuffer, look_up: LookUp, encode: Callable[[Any], th.Tensor]) -> None:
        """Forget what the replay buffer has overwritten; find out who may be whose neighbour; encode what is to be.

        :param replay_buffer: The replay buffer
        :param look_up: What it holds
        :param encode: The online encoder
        :raises ValueError: if the buffer does not tell which transitions it has drawn
        """
        if not isinstance(replay_buffer, FrameStackReplayBuffer) or replay_buffer.last_sampled is None:
            raise ValueError(
                f"intrinsic='particle' needs to know the episodes of a batch, but {type(replay_buffer).__name__} does "
                "not tell what it has drawn: leave out replay_buffer_class."
            )
        rows, env_inds = self.places.T
        size, pos, n_rows = replay_buffer.buffer_size, replay_buffer.pos, replay_buffer.size()
        overwritten = (rows - self.last_pos) % size < (pos - self.last_pos) % size
        rows[overwritten | ((pos - 1 - rows) % size >= n_rows)] = -1
        episodes = self._follow_episodes(replay_buffer)
        self.last_pos = pos
        self._sampled = np.stack(replay_buffer.last_sampled, axis=1)
        known = np.flatnonzero(rows >= 0)
        own, others = episodes[*self._sampled.T], episodes[rows[known], env_inds[known]]
        self._may_be_near = own[:, None] != np.concatenate([own, others])
        if self.encoder is not None:
            self._remembered = self.features[th.from_numpy(known).to(self.features.device)]
        elif len(known) > 0:
            self._remembered = encode(look_up(rows[known], env_inds[known]).next_observations)
        else:
            self._remembered = None

    def forget(self) -> None:
        """The memory is of the replay buffer."""
        self.places[:] = -1
        self._episodes = None

    @th.no_grad()
    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[None, th.Tensor]:
        """
        :param batch: Its next observations are read
        :param latents: Unused
        :param next_latents: [B, features_dim], in the space of latents
        :param srl_error: Unused
        :return: None, and the reward; 0 where there is no state of another episode, [B]
        """
        if self.encoder is not None:
            next_latents = self.encoder(scaled(batch.next_observations, self.observation_space))
        assert next_latents is not None
        with full_precision(next_latents):
            others = next_latents if self._remembered is None else th.cat([next_latents, self._remembered])
            # Differences, as the products that torch prefers lose the small ones.
            distances = th.cdist(next_latents, others, compute_mode="donot_use_mm_for_euclid_dist")
            distances[~th.from_numpy(self._may_be_near).to(distances.device)] = math.inf
            nearest = distances.topk(min(self.n_neighbours, len(others)), largest=False).values
            found = nearest.isfinite()
            mean = th.where(found, nearest, 0).sum(dim=1) / found.sum(dim=1).clamp(min=1)
        self._remember(next_latents)
        return None, mean.log1p()

    def _remember(self, features: th.Tensor) -> None:
        n = min(len(features), len(self.places))
        where = (self.cursor + np.arange(n)) % len(self.places)
        self.places[where] = self._sampled[-n:]
        if self.encoder is not None:
            self.features[th.from_numpy(where).to(features.device)] = features[-n:]
        self.cursor = (self.cursor + n) % len(self.places)

    def _follow_episodes(self, buffer: FrameStackReplayBuffer) -> ndarray:
        """Number the rows that are new since the last update, at first all: another number wherever a stream breaks."""
        size, n_envs = buffer.buffer_size, buffer.n_envs
        n_new = (buffer.pos - self.last_pos) % size
        if self._episodes is None:
            self._episodes, n_new = np.tile(np.arange(n_envs), (size, 1)), buffer.size()
        for start in range(0, n_new, CHUNK):
            rows = (buffer.pos - n_new + np.arange(start, min(start + CHUNK, n_new))) % size
            before = (rows - 1) % size
            begins = buffer.starts[rows] | (buffer.dones[before] > 0)
            self._episodes[rows] = self._episodes[before[:1]] + n_envs * begins.cumsum(axis=0)
        return self._episodes
