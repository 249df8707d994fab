"""Callbacks for ``learn``."""

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure.evaluation import run_episodes, trained_actors


class EvalBothCallback(BaseCallback):
    """Evaluate the task policy and the curious policy in separate rollouts.

    Logs, for each of them, ``eval/<actor>_reward`` (mean return) and ``eval/<actor>_srl_error`` (mean noise-free SRL
    error per step). SB3's ``EvalCallback`` also works; it evaluates the task policy and keeps the best model.

    :param eval_env: One (not vectorised) environment, not the training one
    :param eval_freq: Agent steps between two evaluations
    :param n_episodes: Episodes per policy
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of every evaluation's first reset: all evaluations then start from the same states
    :param verbose: 1 prints each evaluation
    :raises ValueError: if ``eval_freq`` or ``n_episodes`` is below 1
    """

    def __init__(
        self,
        eval_env: gym.Env,
        eval_freq: int = 1000,
        n_episodes: int = 5,
        deterministic: bool = True,
        seed: int | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if eval_freq < 1 or n_episodes < 1:
            raise ValueError(
                f"EvalBothCallback got eval_freq={eval_freq} and n_episodes={n_episodes}, but each must be at least 1: "
                "give numbers >= 1."
            )
        self.eval_env = eval_env
        self.eval_freq = eval_freq
        self.n_episodes = n_episodes
        self.deterministic = deterministic
        self.seed = seed
        self._last_eval = 0
        #: One row per evaluation: agent steps and the logged values
        self.history: list[dict[str, float]] = []

    def _on_training_start(self) -> None:
        self._last_eval = self.num_timesteps

    def _on_step(self) -> bool:
        if self.num_timesteps - self._last_eval >= self.eval_freq:
            self._last_eval = self.num_timesteps
            self.evaluate()
        return True

    def evaluate(self) -> dict[str, float]:
        """Evaluate now.

        :return: Agent steps and the logged values
        """
        row: dict[str, float] = {"timesteps": self.num_timesteps}
        for actor in trained_actors(self.model):  # type: ignore[arg-type]
            episodes = run_episodes(
                self.model,  # type: ignore[arg-type]
                self.eval_env,
                self.n_episodes,
                actor,
                deterministic=self.deterministic,
                seed=self.seed,
            )
            results = [(episode.total_reward, episode.srl_errors) for episode in episodes]
            row[f"eval/{actor}_reward"] = float(np.mean([reward for reward, _ in results]))
            errors = np.concatenate([errors for _, errors in results])
            if len(errors) > 0:
                row[f"eval/{actor}_srl_error"] = float(errors.mean())
        self.history.append(row)
        for key, value in row.items():
            if key != "timesteps":
                self.logger.record(key, value)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if self.verbose >= 1:
            print(", ".join(f"{key} {value:.4g}" for key, value in row.items()))
        return row
