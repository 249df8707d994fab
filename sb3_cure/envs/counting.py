"""Wrappers that report or reward visits to cells of the true state, and two that report the task's reward."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_cure.envs.physics import physics_state, physics_state_names

#: Key of the info in which ``TaskReward`` puts the reward; no environment has one of this name
TASK_REWARD = "sb3_cure.task_reward"


class CellInfo(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Puts the cell of the true state that each step leads to into ``info["cell"]``.

    Cells are those of a joint grid over some coordinates, which is unbounded. Callbacks see the cell of the last step
    of an episode, too.

    :param env: A dm_control environment, such as ``make_dmc_env`` makes
    :param widths: Width of a cell along each coordinate of the grid, by name (see ``physics_state_names``), in its unit
    :raises ValueError: If there are no such coordinates
    """

    def __init__(self, env: gym.Env, widths: Mapping[str, float]) -> None:
        RecordConstructorArgs.__init__(self, widths=dict(widths))
        super().__init__(env)
        self._indices, self._widths = _grid(env, widths)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        :param action: The action
        :return: What the environment returns, with the cell, a tuple of integers, in the info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        cell = _cell(self.env, self._indices, self._widths)
        return observation, reward, terminated, truncated, {**info, "cell": cell}


class SumRewards(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Sums rewards until they are taken, by a ``TaskReward`` with any wrappers between them.

    :param env: An environment that gives the task's reward
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.sum = 0.0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and add its reward.

        :param action: The action
        :return: What the environment returns
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.sum += float(reward)
        return observation, reward, terminated, truncated, info

    def take_sum(self) -> float:
        """Return the sum and begin anew.

        :return: Sum of all rewards since it was taken last
        """
        taken, self.sum = self.sum, 0.0
        return taken


class TaskReward(gym.Wrapper[Any, Any, Any, Any]):
    """Puts the task's reward into ``info[TASK_REWARD]``, whatever inner wrappers turn it into, and may return it.

    :param env: Wrappers of any kind around ``task``
    :param task: The environment that gives the task's reward
    :param pays: Whether the task's reward is also the one that a step returns
    """

    def __init__(self, env: gym.Env, task: SumRewards, pays: bool = False) -> None:
        super().__init__(env)
        self.task, self.pays = task, pays

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        :param action: The action
        :return: What the environment returns, with the task's reward in the info
        """
        self.task.take_sum()  # discards those of steps that wrappers make while they reset
        observation, reward, terminated, truncated, info = self.env.step(action)
        met = self.task.take_sum()
        return observation, met if self.pays else reward, terminated, truncated, {**info, TASK_REWARD: met}


class CountReward(gym.RewardWrapper[Any, Any], RecordConstructorArgs):
    """Gives the reward 1 / sqrt(N), N the visits so far of the cell that a step leads to: an oracle of exploration.

    Counts of Strehl and Littman (2008), MBIE-EB. They start with the environment and continue over its episodes and
    through exact resume. Each environment counts for itself.

    :param env: As for ``CellInfo``
    :param widths: As for ``CellInfo``
    """

    def __init__(self, env: gym.Env, widths: Mapping[str, float]) -> None:
        RecordConstructorArgs.__init__(self, widths=dict(widths))
        super().__init__(env)
        self._indices, self._widths = _grid(env, widths)
        #: Visits of each cell
        self.visits: dict[tuple[int, ...], int] = {}

    def reward(self, reward: Any) -> float:
        """Count a visit.

        :param reward: The task's reward, unused
        :return: The reward of the cell that the step has led to
        """
        cell = _cell(self.env, self._indices, self._widths)
        self.visits[cell] = self.visits.get(cell, 0) + 1
        return self.visits[cell] ** -0.5

    def state_dict(self) -> dict[str, Any]:
        """Get the counts, for exact resume.

        :return: Plain data
        """
        return {"cells": np.array(list(self.visits), dtype=np.int64), "visits": list(self.visits.values())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the counts.

        :param state: Result of ``state_dict``
        """
        self.visits = dict(zip(map(tuple, state["cells"].tolist()), state["visits"], strict=True))


def _grid(env: gym.Env, widths: Mapping[str, float]) -> tuple[list[int], np.ndarray]:
    names = physics_state_names(env)
    if not widths or not set(widths) <= set(names) or min(widths.values()) <= 0:
        raise ValueError(f"widths must be > 0, for some of {', '.join(names)}, not {dict(widths)!r}.")
    return [names.index(name) for name in widths], np.array(list(widths.values()), dtype=np.float64)


def _cell(env: gym.Env, indices: list[int], widths: np.ndarray) -> tuple[int, ...]:
    return tuple(np.floor(physics_state(env)[indices] / widths).astype(int).tolist())
