"""How often cells of the true state were visited: a reward that sees them, and what callbacks count by."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_cure.envs.physics import physics_state, physics_state_names


class Cells:
    """The joint grid over some coordinates of the true state; it has no end on any side.

    :param widths: Width of a cell along each coordinate, in its unit
    :param names: Names of all coordinates, see ``physics_state_names``
    :raises ValueError: if there are no such coordinates
    """

    def __init__(self, widths: Mapping[str, float], names: list[str]):
        if not widths or not set(widths) <= set(names) or min(widths.values()) <= 0:
            raise ValueError(f"widths are {dict(widths)!r}: give a width > 0 for some of {', '.join(names)}.")
        self._indices = [names.index(name) for name in widths]
        self._widths = np.array(list(widths.values()), dtype=np.float64)

    def of(self, state: np.ndarray) -> tuple[int, ...]:
        """
        :param state: The true state, [d]
        :return: The cell that it lies in
        """
        return tuple(np.floor(state[self._indices] / self._widths).astype(int).tolist())


class CountReward(gym.RewardWrapper, RecordConstructorArgs):
    """An oracle of exploration: the reward is 1 / sqrt(N), N the visits so far of the cell that a step leads to.

    Counts of Strehl and Littman (2008), MBIE-EB. They start with the environment, go on over its episodes and through
    exact resume; environments side by side count each for itself.

    :param env: An environment of dm_control, such as ``make_dmc_env`` makes
    :param widths: Width of a cell along each coordinate that is counted, by its name
    """

    def __init__(self, env: gym.Env, widths: Mapping[str, float]):
        RecordConstructorArgs.__init__(self, widths=dict(widths))
        super().__init__(env)
        self._cells = Cells(widths, physics_state_names(env))
        #: Visits of each cell
        self.visits: dict[tuple[int, ...], int] = {}

    def reward(self, reward: Any) -> float:
        """
        :param reward: The task's reward of a step, unused
        :return: That of the cell to which it has led
        """
        cell = self._cells.of(physics_state(self.env))
        self.visits[cell] = self.visits.get(cell, 0) + 1
        return self.visits[cell] ** -0.5

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The counts
        """
        return {"cells": np.array(list(self.visits), dtype=np.int64), "visits": list(self.visits.values())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        self.visits = dict(zip(map(tuple, state["cells"].tolist()), state["visits"], strict=True))


class CellInfo(gym.Wrapper, RecordConstructorArgs):
    """Write the cell of the true state that each step leads to into ``info["cell"]``.

    Callbacks see it there at the ends of episodes, too.

    :param env: An environment of dm_control
    :param widths: Width of a cell along each coordinate that is counted, by its name
    """

    def __init__(self, env: gym.Env, widths: Mapping[str, float]):
        RecordConstructorArgs.__init__(self, widths=dict(widths))
        super().__init__(env)
        self._cells = Cells(widths, physics_state_names(env))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :param action: The action
        :return: What the environment returns
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        cell = self._cells.of(physics_state(self.env))
        return observation, reward, terminated, truncated, {**info, "cell": cell}

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Nothing: it keeps nothing
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
