"""Visits of cells of the true state: in the info, for callbacks, and as a reward."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from sb3_cure.envs.physics import physics_state, physics_state_names


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
        names = physics_state_names(env)
        if not widths or not set(widths) <= set(names) or min(widths.values()) <= 0:
            raise ValueError(f"widths must be > 0, for some of {', '.join(names)}, not {dict(widths)!r}.")
        self._indices = [names.index(name) for name in widths]
        self._widths = np.array(list(widths.values()), dtype=np.float64)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        :param action: The action
        :return: What the environment returns, with the cell, a tuple of integers, in the info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        cell = np.floor(physics_state(self.env)[self._indices] / self._widths).astype(int)
        return observation, reward, terminated, truncated, {**info, "cell": tuple(cell.tolist())}


class CountReward(CellInfo):
    """Gives the reward 1 / sqrt(N), N the visits so far of the cell that a step leads to: an oracle of exploration.

    Counts of Strehl and Littman (2008), MBIE-EB. They start with the environment and continue over its episodes and
    through exact resume. Each environment counts for itself.

    :param env: As of ``CellInfo``
    :param widths: As of ``CellInfo``
    """

    def __init__(self, env: gym.Env, widths: Mapping[str, float]) -> None:
        super().__init__(env, widths)
        #: Visits of each cell
        self.visits: dict[tuple[int, ...], int] = {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment.

        :param action: The action
        :return: What the environment returns, with the reward of the cell, and the cell in the info
        """
        observation, _, terminated, truncated, info = super().step(action)
        visits = self.visits[info["cell"]] = self.visits.get(info["cell"], 0) + 1
        return observation, visits**-0.5, terminated, truncated, info

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
