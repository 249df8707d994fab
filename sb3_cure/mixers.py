"""Which actor acts: at every step of every environment the curious one with probability p_c (Algorithm 1)."""

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from sb3_cure.values import is_number


class CuriousMixer:
    """Draws, per environment and step, whether the curious actor acts.

    :param probability: p_c in [0, 1], or a schedule of the remaining progress (1 at the start, 0 at the end)
    :param seed: Seed of the mixer's own random stream
    :raises ValueError: if p_c is outside [0, 1]
    """

    def __init__(self, probability: float | Schedule, seed: int | None = None):
        self.probability = probability
        self.rng = np.random.default_rng(seed)
        self.n_steps = 0
        self.n_curious = 0
        self.current_probability(1.0)

    def current_probability(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: 1 at the start of training, 0 at its end
        :return: p_c now
        :raises ValueError: if a schedule leaves [0, 1]
        """
        schedule = self.probability
        probability = schedule(progress_remaining) if callable(schedule) else schedule
        if not is_number(probability, 0, 1):
            raise ValueError(
                f"curiosity_prob is {probability!r} (progress remaining {progress_remaining:.2f}), but it is the "
                "probability p_c with which the curious actor acts: give a number, or a schedule, within [0, 1]."
            )
        return float(probability)

    def choose(self, n_envs: int, progress_remaining: float) -> np.ndarray:
        """
        :param n_envs: Number of environments
        :param progress_remaining: 1 at the start of training, 0 at its end
        :return: Boolean array [n_envs]: True where the curious actor acts
        """
        curious = self.rng.random(n_envs) < self.current_probability(progress_remaining)
        self.n_steps += n_envs
        self.n_curious += int(curious.sum())
        return curious

    def pop_share(self) -> float:
        """
        :return: Share of curious steps since the last call, in [0, 1] (NaN if there were no steps)
        """
        share = self.n_curious / self.n_steps if self.n_steps else float("nan")
        self.n_steps = self.n_curious = 0
        return share

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Its random stream and counts
        """
        return {"rng": self.rng.bit_generator.state, "n_steps": self.n_steps, "n_curious": self.n_curious}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``state_dict``
        """
        self.rng.bit_generator.state = state["rng"]
        self.n_steps, self.n_curious = state["n_steps"], state["n_curious"]
