"""Count the cells of the true state that all collected transitions have reached."""

from collections.abc import Sequence
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure.evaluation.result_files import Row, write_csv

COLUMNS = ("environment_steps", "agent_steps", "cells")


class CoverageRecorder(BaseCallback):
    """Count the cells that training environments in ``CellInfo`` report, and write ``coverage.csv``.

    All transitions of training count, of both actors and from the first step of the random warm-up on; those of
    pretraining do not. The counts are plain attributes, which checkpoints keep.

    :param at: Environment steps after which a row is written
    :param action_repeat: Environment steps per agent step
    :param path: The file
    """

    def __init__(self, at: Sequence[int], action_repeat: int, path: Path):
        super().__init__()
        self._at, self._action_repeat, self._path = sorted(at), action_repeat, path
        #: Cells reached, each as its numbers with commas between them
        self.cells: set[str] = set()
        self.rows: list[Row] = []

    def _on_step(self) -> bool:
        self.cells.update(",".join(map(str, info["cell"])) for info in self.locals["infos"])
        steps = self.num_timesteps * self._action_repeat
        while len(self.rows) < len(self._at) and steps >= self._at[len(self.rows)]:
            values = (steps, self.num_timesteps, len(self.cells))
            self.rows.append(dict(zip(COLUMNS, values, strict=True)))
        return True

    def _on_training_end(self) -> None:
        write_csv(self._path, COLUMNS, self.rows)
