"""A wrapper for rl-zoo3, which puts the wrappers of a file around ``Monitor``."""

import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor


class ReportEnds(gym.Wrapper):
    """Reports episodes that wrappers end, which ``Monitor`` inside of them does not see.

    Evaluations wait for these reports, and ``enjoy`` counts episodes by them.

    :param monitor: The environment in its ``Monitor``
    :param wrap: Puts the wrappers around it
    """

    def __init__(self, monitor: Monitor, wrap: Callable[[gym.Env], gym.Env]):
        super().__init__(wrap(monitor))
        self.monitor = monitor

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Make a step.

        :param action: The action
        :return: As the environment's, with ``info["episode"]`` at the end
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if (terminated or truncated) and "episode" not in info:
            rewards, seconds = self.monitor.rewards, time.time() - self.monitor.t_start
            info["episode"] = {"r": round(sum(rewards), 6), "l": len(rewards), "t": round(seconds, 6)}
            if self.monitor.results_writer is not None:
                self.monitor.results_writer.write_row(info["episode"])
        return observation, reward, terminated, truncated, info
