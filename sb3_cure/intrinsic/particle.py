"""Particle entropy: how far a state is from those of other episodes."""

import math
from typing import Any

import numpy as np
import torch as th
from numpy import ndarray
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_cure.intrinsic.base import IntrinsicReward, RewardInputs
from sb3_cure.intrinsic.reward_networks import make_network, scaled


class Particle(IntrinsicReward):
    """log(1 + mean distance to the k nearest neighbours) of where the step leads (Liu & Abbeel, 2021, eq. 5).

    Distances are those of features of a random network that is never trained (RE3; Seo et al., 2021): of an image
    normalised, as there; of a vector not, as a linear map's would be its direction alone. Neighbours are searched in
    the batch and in a memory of the latest samples. States of the same episode, the state itself among them, are no
    neighbours: otherwise most neighbours would be the steps before and after it. An episode also ends where the stored
    stream breaks, as in another ``learn()``.

    :param args: As for ``IntrinsicReward``
    :param n_neighbours: k
    :param memory: Number of transitions to remember, by their places in the replay buffer
    :param n_filters: Channels of the random network
    """

    features: th.Tensor

    def __init__(self, *args: Any, n_neighbours: int = 12, memory: int = 512, n_filters: int = 16):
        super().__init__(*args)
        self.n_neighbours = n_neighbours
        self.encoder = make_network(self.observation_space, [self.features_dim], n_filters).requires_grad_(False)
        if is_image_space(self.observation_space):
            self.encoder.append(nn.LayerNorm(self.features_dim, elementwise_affine=False))
        self.register_buffer("features", th.zeros(memory, self.features_dim))
        # The memory, [memory, 2]: number of the row among all that were ever added (-1: none), and environment
        self.places = np.full((memory, 2), -1)
        self.cursor = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Return the memory."""
        return {"places": th.from_numpy(self.places.copy()), "cursor": th.tensor(self.cursor)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the memory.

        :param state: Result of ``get_extra_state``
        """
        self.places, self.cursor = state["places"].cpu().numpy().copy(), int(state["cursor"])

    @classmethod
    def is_per_image(cls, **kwargs: Any) -> bool:
        """Return True: the features come from an image."""
        return True

    @th.no_grad()
    def loss(self, inputs: RewardInputs) -> tuple[None, th.Tensor]:
        """Measure the distances to the nearest neighbours.

        :param inputs: Its next observations are read, and the replay buffer
        :return: None, and the reward; 0 if there is no state of another episode, [B]
        :raises ValueError: if the replay buffer does not remember which transitions it has drawn
        """
        buffer: Any = inputs.replay_buffer
        if getattr(buffer, "last_sampled", None) is None:
            raise ValueError(
                f"intrinsic='particle' needs to know the episodes of a batch, but {type(buffer).__name__} does not "
                "remember which transitions it has drawn: leave out replay_buffer_class and optimize_memory_usage."
            )
        features = self.encoder(scaled(inputs.batch.next_observations, self.observation_space))
        known, remembered = self._remembered(buffer)
        candidates = th.cat([features, self.features[th.from_numpy(known).to(features.device)]])
        episodes = _number_episodes(buffer, *np.concatenate([buffer.last_sampled, remembered], axis=1))
        is_candidate = th.from_numpy(episodes[: len(features), None] != episodes).to(features.device)
        self._remember(buffer, features)
        return None, self._reward(features, candidates, is_candidate)

    def forget(self) -> None:
        """Forget the memory, which refers to the replay buffer."""
        self.places[:] = -1

    def _reward(self, features: th.Tensor, candidates: th.Tensor, is_candidate: th.Tensor) -> th.Tensor:
        # Computed from differences: the matrix products that torch prefers lose small distances to rounding.
        distances = th.cdist(features, candidates, compute_mode="donot_use_mm_for_euclid_dist")
        distances[~is_candidate] = math.inf
        nearest = distances.topk(min(self.n_neighbours, len(candidates)), largest=False).values
        found = nearest.isfinite()
        mean = th.where(found, nearest, 0).sum(dim=1) / found.sum(dim=1).clamp(min=1)
        return mean.log1p()

    def _remembered(self, buffer: Any) -> tuple[ndarray, tuple[ndarray, ndarray]]:
        """Places in the memory whose transitions are still stored, and their rows and environments."""
        oldest, newest = buffer.n_added - buffer.size(), buffer.n_added - 1
        numbers, env_inds = self.places.T
        # A model that was loaded without its buffer remembers rows of the former one.
        known = np.flatnonzero((numbers >= oldest) & (numbers <= newest) & (env_inds < buffer.n_envs))
        return known, ((buffer.pos - 1 - newest + numbers[known]) % buffer.buffer_size, env_inds[known])

    def _remember(self, buffer: Any, features: th.Tensor) -> None:
        """Put the batch in place of what has been remembered longest."""
        rows, env_inds = buffer.last_sampled
        # Rows are counted from the first one that was ever added: positions recur once the buffer has wrapped around.
        numbers = buffer.n_added - 1 - (buffer.pos - 1 - rows) % buffer.buffer_size
        n = min(len(rows), len(self.places))
        where = (self.cursor + np.arange(n)) % len(self.places)
        self.places[where] = np.stack([numbers, env_inds], axis=1)[-n:]
        self.features[th.from_numpy(where).to(features.device)] = features[-n:]
        self.cursor = (self.cursor + n) % len(self.places)


def _number_episodes(buffer: Any, rows: ndarray, env_inds: ndarray) -> ndarray:
    """Number the episodes of stored transitions, [n]; a new number wherever the stream breaks."""
    size, oldest = buffer.buffer_size, buffer.pos - buffer.size()
    begins = buffer.starts | (np.roll(buffer.dones, 1, axis=0) > 0)
    begins[oldest % size] = True
    first_rows, first_envs = begins.nonzero()
    # Transitions in the order of environment and age: an episode's number is how many have begun by then
    firsts = np.sort(first_envs * size + (first_rows - oldest) % size)
    return firsts.searchsorted(env_inds * size + (rows - oldest) % size, side="right")
