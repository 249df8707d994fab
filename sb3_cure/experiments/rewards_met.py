"""Sum the task's rewards that training collects, by who acted and when."""

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure.envs.counting import TASK_REWARD

#: Columns of ``eval.csv``, sums of rewards: of all steps; of those in which the task policy acted, and those in which
#: the curious (or random) second actor did (the rest is the random warm-up's); and of those after the first two fifths
#: of episodes that have ended, as an episode may start in the goal
COLUMNS = ("rewards_met", "rewards_met_task", "rewards_met_curious", "rewards_met_late")


class RewardsMet(BaseCallback):
    """Sum the task's rewards of all transitions that training collects, even where an oracle's reward replaces them.

    The sums are plain attributes, which checkpoints keep.
    """

    def __init__(self) -> None:
        super().__init__()
        self.sums = dict.fromkeys(COLUMNS, 0.0)
        #: Rewards of each environment's episode so far
        self.episodes: list[list[float]] = []

    def _on_step(self) -> bool:
        given = zip(self.locals["infos"], self.locals["rewards"], strict=True)
        rewards = np.array([info.get(TASK_REWARD, reward) for info, reward in given], dtype=np.float64)
        self.sums["rewards_met"] += float(rewards.sum())
        if self.num_timesteps - len(rewards) >= self.model.learning_starts:  # type: ignore[attr-defined]
            is_second = self._second_actor_acted(len(rewards))
            self.sums["rewards_met_curious"] += float(rewards[is_second].sum())
            self.sums["rewards_met_task"] += float(rewards[~is_second].sum())
        self.episodes = self.episodes or [[] for _ in rewards]
        for episode, reward, done in zip(self.episodes, rewards.tolist(), self.locals["dones"], strict=True):
            episode.append(reward)
            if done:
                self.sums["rewards_met_late"] += sum(episode[-(-2 * len(episode) // 5) :])
                episode.clear()
        return True

    def _second_actor_acted(self, n_envs: int) -> np.ndarray:
        """Where the curious (or random) second actor chose the last actions, bool [n_envs]."""
        model: Any = self.model
        if not model.task:  # the policy itself is the curious one
            return np.ones(n_envs, dtype=bool)
        return model._mixer.curious if model.curiosity in ("separate", "random") else np.zeros(n_envs, dtype=bool)
