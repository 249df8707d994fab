"""Arms of ``zoo_configs/experiments/fast/gate*.yml``: a dense reward, and an oracle of exploration."""

from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from dm_control.utils.rewards import tolerance
from gymnasium.utils import RecordConstructorArgs

from sb3_cure.intrinsic import IntrinsicReward, RewardInputs


class DenseReward(gym.RewardWrapper[Any, Any], RecordConstructorArgs):
    """Pays for the height of the pole, and on a cart for its place, in each step; evaluations keep the sparse reward.

    :param env: The suite's pendulum or cartpole
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def reward(self, reward: Any) -> float:
        """Measure height and place.

        :param reward: The task's reward, unused
        :return: From 0, hanging, to 1, upright (and in the middle, as in the dense task)
        """
        physics = self.env.get_wrapper_attr("physics")
        if hasattr(physics, "pole_vertical"):
            return float(1 + physics.pole_vertical()) / 2
        centred = (1 + tolerance(physics.cart_position(), margin=2)) / 2
        return float((1 + np.squeeze(physics.pole_angle_cosine())) / 2 * centred)


class Oracle(IntrinsicReward):
    """1 / sqrt(N), N the visits so far of the cell of the true state that a step leads to (Strehl and Littman, 2008).

    The environment is in a ``CellInfo``, and ``replay_buffer_kwargs=dict(info_shapes={"cell": ...})`` keeps its cells.

    :param args: As of ``IntrinsicReward``
    """

    def __init__(self, *args: Any):
        super().__init__(*args)
        #: Visits of each cell
        self.visits = Counter[tuple[float, ...]]()
        self.n_counted = 0

    def get_extra_state(self) -> dict[str, Any]:
        """Return the counts."""
        visits = th.tensor(list(self.visits.values()))
        return {"cells": th.tensor(list(self.visits)), "visits": visits, "n_counted": th.tensor(self.n_counted)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the counts.

        :param state: Result of ``get_extra_state``
        """
        self.visits = Counter(dict(zip(map(tuple, state["cells"].tolist()), state["visits"].tolist(), strict=True)))
        self.n_counted = int(state["n_counted"])

    def loss(self, inputs: RewardInputs) -> tuple[None, th.Tensor]:
        """Count the cells that were added since the last update, then look up those of the batch.

        :param inputs: Its ``info("cell")`` is read, and the replay buffer
        :return: None, and the reward, [B]
        """
        buffer: Any = inputs.replay_buffer
        new = np.arange(self.n_counted - buffer.n_added, 0) + buffer.pos
        for of_envs in buffer.rows["infos/cell"][new % buffer.buffer_size].tolist():
            self.visits.update(map(tuple, of_envs))
        self.n_counted = buffer.n_added
        cells = inputs.info("cell")
        counts = [self.visits[tuple(cell)] for cell in cells.tolist()]
        return None, th.tensor(counts, device=cells.device) ** -0.5
