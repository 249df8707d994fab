"""Read the folders that experiments wrote, and refuse what would give wrong numbers."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_cure.cli.usage import UsageError
from sb3_cure.experiments.grid import DONE, ERROR, SETTINGS, first_difference, read_json, seed_of, short_name

FINISHED, UNFINISHED, FAILED, NOT_RUN = "done", "unfinished", "failed", "not run"
#: Settings that all cells of a task share, with the budget of those that train
_SHARED = ("eval_every", "eval_episodes", "coverage")
_FIX = "remove the cell's folder and run the grid again"


@dataclass(frozen=True)
class CellResult:
    """One training run as found on disk.

    :param task: Short name of the task (``"cartpole-swingup"``)
    :param method: Name of the arm
    :param seed: Seed
    :param folder: Its folder
    :param status: ``"done"``, ``"unfinished"``, ``"failed"`` or ``"not run"``; only done cells have the following
        fields and enter statistics
    :param config: ``config.json``
    :param run: ``run.json``
    :param evaluations: ``eval.csv`` (missing values are nan)
    :param visitation: ``visitation.csv``
    :param coverage: ``coverage.csv``
    """

    task: str
    method: str
    seed: int
    folder: Path
    status: str
    config: dict[str, Any] = field(default_factory=dict)
    run: dict[str, Any] = field(default_factory=dict)
    evaluations: pd.DataFrame = field(default_factory=pd.DataFrame)
    visitation: pd.DataFrame = field(default_factory=pd.DataFrame)
    coverage: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def is_done(self) -> bool:
        return self.status == FINISHED

    def curve(self, column: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
        """Environment steps and values, where there are any.

        :param column: A column of ``eval.csv``, or ``"cells"`` of ``coverage.csv``
        :return: Steps and values, [n] each
        """
        table = self.coverage if column == "cells" else self.evaluations
        if column not in table:
            return np.zeros(0), np.zeros(0)
        known = table.dropna(subset=[column])
        return known["environment_steps"].to_numpy(float), known[column].to_numpy(float)

    def states(self) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
        """True physics states that were visited (``visits.npz``).

        :return: States by actor, [n, d] each, and the units of their coordinates; both empty if there are none
        """
        path = self.folder / "visits.npz"
        if not self.is_done or not path.exists():
            return {}, ()
        with np.load(path) as file:
            names = [name for name in file.files if name.endswith("_states")]
            found = {name.removesuffix("_states"): np.asarray(file[name], dtype=np.float64) for name in names}
            return found, tuple(map(str, file["state_units"])) if found else ()


@dataclass(frozen=True)
class Experiment:
    """All cells of a grid, run or not.

    :param name: Its folder below the one that was read (``"500k/curves"``), or its own name
    :param folder: Its folder
    :param grid: ``grid.json``
    :param cells: By (task, method, seed), in the grid's order; cells that the grid does not name come last
    """

    name: str
    folder: Path
    grid: dict[str, Any]
    cells: dict[tuple[str, str, int], CellResult]

    @property
    def kind(self) -> str:
        """``"curves"`` or ``"visitation"``."""
        return self.grid["kind"]

    @property
    def budget(self) -> int:
        """Environment steps of each cell."""
        return self.grid["budget"]

    @property
    def baseline(self) -> str:
        """The arm that the others are compared with."""
        return self.grid["baseline"]

    def baseline_of(self, method: str) -> str:
        """The arm with which an arm is compared: its own baseline if the grid gives it one.

        :param method: Name of an arm
        :return: Name of its baseline
        """
        return self.grid["methods"].get(method, {}).get("baseline") or self.baseline

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for task, _, _ in self.cells))

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(method for _, method, _ in self.cells))

    @property
    def arms(self) -> list[tuple[str, str]]:
        """All pairs of a task and a method."""
        return [(task, method) for task in self.tasks for method in self.methods]

    @property
    def seeds(self) -> list[int]:
        return sorted({seed for _, _, seed in self.cells})

    @property
    def finished(self) -> list[CellResult]:
        return [cell for cell in self.cells.values() if cell.is_done]

    def of_arm(self, task: str, method: str) -> dict[int, CellResult]:
        """Cells of an arm on a task.

        :param task: Short name of the task
        :param method: Name of the arm
        :return: Cells by seed
        """
        return {seed: self.cells[key] for seed in self.seeds if (key := (task, method, seed)) in self.cells}

    def finished_cells(self, task: str, method: str) -> dict[int, CellResult]:
        """Finished cells of an arm on a task.

        :param task: Short name of the task
        :param method: Name of the arm
        :return: Cells by seed
        """
        return {seed: cell for seed, cell in self.of_arm(task, method).items() if cell.is_done}


def read_results(folder: str | Path) -> list[Experiment]:
    """Read everything that ``sb3-cure experiment`` wrote.

    :param folder: A folder with experiments anywhere below it, or the folder of one
    :return: The experiments, by name
    :raises UsageError: with one sentence that names the folder or file, if there are none, if files are missing or
        damaged, or if cells were run with different settings
    """
    folder = Path(folder)
    if (folder / "grid.json").exists():
        return [_read_experiment(folder / "grid.json")]
    grids = sorted(folder.rglob("grid.json"))
    lost = {path.parents[3] for path in folder.rglob(f"*/*/seed*/{DONE}")} - {path.parent for path in grids}
    if lost:
        raise UsageError(f"{min(lost)} holds finished cells, but no grid.json: run the grid again, which writes it.")
    if not grids:
        raise UsageError(f"{folder} holds no experiment: give the folder that `sb3-cure experiment` wrote.")
    return [_read_experiment(path, path.parent.relative_to(folder).as_posix()) for path in grids]


def _read_experiment(path: Path, name: str | None = None) -> Experiment:
    grid, root = read_json(path), path.parent
    tasks = [short_name(task) for task in grid["tasks"]]
    keys = [(task, method, seed) for task in tasks for method in grid["methods"] for seed in grid["seeds"]]
    for found in sorted(root.glob("*/*/seed*")):
        if (seed := seed_of(found)) is not None:
            keys.append((found.parent.parent.name, found.parent.name, seed))
    order = list(dict.fromkeys(task for task, _, _ in keys))
    keys = sorted(dict.fromkeys(keys), key=lambda key: order.index(key[0]))
    cells = {key: _read_cell(root, *key) for key in keys}
    experiment = Experiment(name or grid["experiment"], root, grid, cells)
    for first, other in itertools.combinations(experiment.finished, 2):
        if first.task == other.task:
            both_train = first.config["budget"] and other.config["budget"]
            shared = (*_SHARED, "budget") if both_train else _SHARED
            _check_settings(first, other, SETTINGS if first.method == other.method else shared)
    for cell in experiment.finished:
        if experiment.kind == "visitation" and cell.visitation.columns.empty:
            raise UsageError(f"{cell.folder} has no visitation.csv: {_FIX}.")
        if cell.config["budget"] > 0 and (experiment.kind != "visitation" or len(cell.evaluations)):
            _check_curve(cell)
    return experiment


def _check_settings(first: CellResult, other: CellResult, keys: Iterable[str]) -> None:
    """Refuse to average over cells that were run with different settings."""
    if difference := first_difference(first.config, other.config, keys):
        key, one, another = difference
        raise UsageError(
            f"{other.folder} was run with {key} {another!r}, but {first.folder} with {one!r}: "
            "put one of them into another folder."
        )


def _read_cell(root: Path, task: str, method: str, seed: int) -> CellResult:
    folder = root / task / method / f"seed{seed}"
    if not folder.is_dir():
        return CellResult(task, method, seed, folder, NOT_RUN)
    if not (folder / DONE).exists():
        return CellResult(task, method, seed, folder, FAILED if (folder / ERROR).exists() else UNFINISHED)
    config, run = read_json(folder / "config.json"), read_json(folder / "run.json")
    if (short_name(config["task"]), config["method"], config["seed"]) != (task, method, seed):
        raise UsageError(f"{folder / 'config.json'} is of another cell than its folder: put it back.")
    names = ("eval.csv", "visitation.csv", "coverage.csv")
    tables = (_read_csv(folder / name) for name in names)
    return CellResult(task, method, seed, folder, FINISHED, config, run, *tables)


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path) if path.exists() else pd.DataFrame()
    except ValueError as error:
        raise UsageError(f"{path} cannot be read ({error}): {_FIX}.") from None


def _check_curve(cell: CellResult) -> None:
    """Refuse a curve that does not go from 0 to the budget, or lacks returns: its area would be wrong."""
    path, budget = cell.folder / "eval.csv", cell.config["budget"]
    steps, _ = cell.curve("environment_steps")
    if len(steps) == 0 or steps[0] > 0 or steps[-1] < budget or not (np.diff(steps) > 0).all():
        raise UsageError(f"{path} does not go step by step from 0 to {budget} environment steps: {_FIX}.")
    if cell.config["arguments"].get("task", True) and cell.evaluations["return_mean"].isna().any():
        raise UsageError(f"{path} has a row without return_mean: {_FIX}.")
