"""Who acts: the task actor or the curious one (Algorithm 1 of the paper), and for how long."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.type_aliases import Schedule


class CuriousMixer:
    """Draws, per environment and step, whether the curious actor acts.

    Each environment redraws who acts (the curious actor with probability p_c) at every reset and with probability 1/L
    in every other step. L = 1 is the paper's coin. A curious stretch lasts L / (1 - p_c) steps on average, unless the
    episode ends.

    :param seed: Seed of the mixer's own random stream, so that other draws in a run do not change who acts
    """

    def __init__(self, seed: int | None = None):
        self.rng = np.random.default_rng(seed)
        #: Where the curious actor acts, [n_envs]; empty before the first step
        self.curious: npt.NDArray[np.bool_] = np.zeros(0, dtype=bool)
        #: Where a bout of the curious actor begins with this step, [n_envs]
        self.begins: npt.NDArray[np.bool_] = np.zeros(0, dtype=bool)
        #: Actions that a random second actor holds for its bout, [n_envs, *action shape]
        self.held: npt.NDArray[Any] = np.zeros(0)
        self.n_steps = self.n_curious = self.n_bouts = 0

    def choose(
        self, starts: npt.NDArray[np.bool_], probability: float | Schedule, bout: float | str, progress: float
    ) -> npt.NDArray[np.bool_]:
        """Choose who acts in the next step.

        :param starts: Where an episode begins with this step, [n_envs]
        :param probability: p_c in [0, 1], or a schedule of the remaining progress
        :param bout: L >= 1 in agent steps, or ``"episode"``: redraw at resets only
        :param progress: Remaining progress: 1 at the start of training, 0 at its end
        :return: Where the curious actor acts, [n_envs]
        :raises ValueError: if a schedule leaves [0, 1]
        """
        p = float(probability(progress) if callable(probability) else probability)
        if not 0 <= p <= 1:
            raise ValueError(f"curiosity_prob must be in [0, 1], but is {p} at a remaining progress of {progress:.2f}.")
        n_envs = len(starts)
        if len(self.curious) != n_envs:
            self.curious, starts = np.zeros(n_envs, dtype=bool), np.ones(n_envs, dtype=bool)
        before = self.curious & ~starts
        if bout == 1:
            self.begins = self.curious = self.rng.random(n_envs) < p
        else:
            redraws = starts if bout == "episode" else starts | (self.rng.random(n_envs) < 1 / float(bout))
            self.curious = np.where(redraws, self.rng.random(n_envs) < p, self.curious)
            self.begins = self.curious & redraws
        self.n_steps += n_envs
        self.n_curious += int(self.curious.sum())
        self.n_bouts += int((self.curious & ~before).sum())
        return self.curious

    def forget(self) -> None:
        """Forget who acts, which is redrawn in the next step."""
        self.curious = np.zeros(0, dtype=bool)

    def hold(self, sample: Callable[[], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Get the actions of a random second actor: drawn where a bout begins, and held until it ends.

        :param sample: Draws an action
        :return: Its actions in the environments where it acts, [n, *action shape]
        """
        for i in np.flatnonzero(self.begins):
            action = sample()
            if self.held.shape != (len(self.curious), *action.shape):
                self.held = np.zeros((len(self.curious), *action.shape), dtype=action.dtype)
            self.held[i] = action
        return self.held[self.curious]

    def pop_metrics(self) -> dict[str, float]:
        """Get the metrics since the last call.

        :return: Share of curious steps in [0, 1], and mean length of curious stretches in agent steps, by their logged
            names; empty if there were no steps
        """
        if self.n_steps == 0:
            return {}
        metrics = {"rollout/curious_share": self.n_curious / self.n_steps}
        if self.n_bouts > 0:
            metrics["rollout/curious_bout"] = self.n_curious / self.n_bouts
        self.n_steps = self.n_curious = self.n_bouts = 0
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Get everything that future draws depend on.

        :return: Arrays and numbers by name
        """
        return {**vars(self), "rng": self.rng.bit_generator.state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what ``state_dict`` has returned.

        :param state: Result of ``state_dict``
        """
        self.rng.bit_generator.state = state["rng"]
        vars(self).update({name: value for name, value in state.items() if name != "rng"})
