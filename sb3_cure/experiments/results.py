"""Reads the folders that experiments wrote, and refuses what would make a wrong number."""

import csv
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_cure.evaluation.result_files import read_rows
from sb3_cure.experiments.grid import comparable, seed_of, short_name

DONE, UNFINISHED, FAILED, NOT_RUN = "done", "unfinished", "failed", "not run"
_AGAIN = "remove the cell's folder and run the grid again"


class ResultsError(ValueError):
    """Results that cannot be read; the message is one sentence that names the file."""


@dataclass(frozen=True)
class CellResult:
    """One training run as found on disk.

    :param task: Short name of the task (``"cartpole-swingup"``)
    :param method: Name of the arm
    :param seed: Seed
    :param folder: Where its files lie
    :param status: ``"done"``, ``"unfinished"``, ``"failed"``, ``"not run"``, or which other budget it was run with;
        only cells that are done have what follows, and enter statistics
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
    def done(self) -> bool:
        return self.status == DONE

    @property
    def sees_published_pixels(self) -> bool:
        """Whether its images are those of the published results: only then numbers compare."""
        arguments = self.config.get("arguments", {})
        if not str(self.config.get("task", "")).startswith("dmc_pixels/"):
            return False
        crops = "crop" in (arguments.get("augmentation"), arguments.get("srl_kwargs", {}).get("augmentation"))
        usual = {"image_size": 100 if crops else 84, "frame_stack": 3, "renderer": "dmc", "grayscale": False}
        return {**usual, **self.config.get("env_kwargs", {})} == usual

    def curve(self, column: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
        """
        :param column: A column of ``eval.csv``, or ``"cells"`` of ``coverage.csv``
        :return: Environment steps and values where there are any, [n] each
        """
        table = self.coverage if column == "cells" else self.evaluations
        if column not in table:
            return np.zeros(0), np.zeros(0)
        known = table[np.isfinite(table[column])]
        return known["environment_steps"].to_numpy(float), known[column].to_numpy(float)

    def states(self) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
        """
        :return: True physics states by actor, [n, d] each, and the units of their coordinates (``visits.npz``); both
            empty if there are none
        :raises ResultsError: if the file cannot be read
        """
        path = self.folder / "visits.npz"
        if not self.done or not path.exists():
            return {}, ()
        try:
            with np.load(path, allow_pickle=False) as file:
                names = [name for name in file.files if name.endswith("_states")]
                found = {name.removesuffix("_states"): np.asarray(file[name], dtype=np.float64) for name in names}
                return found, tuple(map(str, file["state_units"])) if found else ()
        except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
            raise ResultsError(f"{path} cannot be read ({error}): {_AGAIN}.") from None


@dataclass(frozen=True)
class Experiment:
    """All cells of a grid, run or not.

    :param name: Its folder below the one that was read (``"500k/curves"``), or its own name
    :param folder: Where it lies
    :param grid: ``grid.json``
    :param kind: ``"curves"``, ``"visitation"`` or ``"pretraining"``
    :param budget: Environment steps of each cell
    :param baseline: The arm that the others are compared with
    :param cells: By (task, method, seed), in the grid's order; cells on disk that the grid does not name come last
    """

    name: str
    folder: Path
    grid: dict[str, Any]
    kind: str
    budget: int
    baseline: str
    cells: dict[tuple[str, str, int], CellResult]

    def baseline_of(self, method: str) -> str:
        """
        :param method: Name of an arm
        :return: The arm with which it is compared: its own baseline if the grid gives it one
        """
        methods = self.grid["methods"]
        described = methods.get(method) if isinstance(methods, dict) else None
        return str(described.get("baseline", self.baseline)) if isinstance(described, dict) else self.baseline

    @property
    def tasks(self) -> list[str]:
        return list(dict.fromkeys(task for task, _, _ in self.cells))

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(method for _, method, _ in self.cells))

    @property
    def seeds(self) -> list[int]:
        return sorted({seed for _, _, seed in self.cells})

    @property
    def finished(self) -> list[CellResult]:
        return [cell for cell in self.cells.values() if cell.done]

    def of_arm(self, task: str, method: str) -> dict[int, CellResult]:
        """
        :param task: Short name of the task
        :param method: Name of the arm
        :return: The cells of an arm on a task, by seed
        """
        found = {seed: cell for (at, arm, seed), cell in self.cells.items() if (at, arm) == (task, method)}
        return dict(sorted(found.items()))

    def done(self, task: str, method: str) -> dict[int, CellResult]:
        """
        :param task: Short name of the task
        :param method: Name of the arm
        :return: The finished cells of an arm on a task, by seed
        """
        return {seed: cell for seed, cell in self.of_arm(task, method).items() if cell.done}

    @property
    def sees_published_pixels(self) -> bool:
        """Whether all of its finished cells do, see ``CellResult``."""
        return all(cell.sees_published_pixels for cell in self.finished)


def read_results(folder: str | Path) -> list[Experiment]:
    """Read everything that ``sb3-cure experiment`` wrote.

    :param folder: A folder with experiments anywhere below it, or the folder of one
    :return: The experiments, by name
    :raises ResultsError: with one sentence that names the folder or file and what is wrong with it
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder} is no folder: give the one that `sb3-cure experiment` wrote.")
    if (folder / "grid.json").exists():
        return [_read_experiment(folder / "grid.json")]
    grids = sorted(folder.rglob("grid.json"))
    lost = {path.parents[3] for path in folder.rglob("*/*/seed*/DONE")} - {path.parent for path in grids}
    if lost:
        raise ResultsError(f"{min(lost)} holds finished cells, but no grid.json: run the grid again, which writes it.")
    if not grids:
        raise ResultsError(
            f"{folder} holds no experiment (no grid.json in it, nor anywhere below it): give the folder that "
            "`sb3-cure experiment` wrote."
        )
    return [_read_experiment(path, path.parent.relative_to(folder).as_posix()) for path in grids]


def _read_experiment(path: Path, name: str | None = None) -> Experiment:
    grid, root = _read_json(path, "remove it and run the grid again, which writes it"), path.parent
    try:
        tasks, methods, seeds = [short_name(str(task)) for task in grid["tasks"]], list(grid["methods"]), grid["seeds"]
        budget, own_name = int(grid["budget"]), str(grid["experiment"])
        kind, baseline = str(grid["kind"]), str(grid["baseline"])
        seeds = list(range(seeds)) if isinstance(seeds, int) else list(map(int, seeds))
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"{path} describes no grid ({error!r}): remove it and run the grid again.") from None
    for part in (*tasks, *methods):
        if Path(part).name != part:
            raise ResultsError(f"{path} names {part!r}, which cannot be the name of a folder: correct it.")
    keys = [(task, method, seed) for task in tasks for method in methods for seed in seeds]
    for found in sorted(root.glob("*/*/seed*")):
        if (seed := seed_of(found)) is not None:
            keys.append((found.parent.parent.name, found.parent.name, seed))
    cells = {key: _read_cell(root / key[0] / key[1] / f"seed{key[2]}", *key, budget, kind) for key in keys}
    _check_alike(cells.values())
    order = list(dict.fromkeys(task for task, _, _ in cells))
    in_order = dict(sorted(cells.items(), key=lambda item: order.index(item[0][0])))
    return Experiment(name or own_name, root, grid, kind, budget, baseline, in_order)


def _check_alike(cells: Iterable[CellResult]) -> None:
    """Whether the seeds of an arm were run with the same settings, and all arms of a task evaluated alike."""
    first: dict[tuple[str, ...], CellResult] = {}
    for cell in (cell for cell in cells if cell.done):
        keys = (cell.config.keys() | {"arguments"}) - {"seed", "method"}
        for arm, compared in (
            ((cell.task, cell.method), keys),
            ((cell.task,), {"eval_every", "eval_episodes", "coverage"}),
        ):
            other = first.setdefault(arm, cell)
            for key in sorted(compared & other.config.keys()):
                here, there = comparable(key, cell.config.get(key), other.config[key])
                if here != there:
                    raise ResultsError(
                        f"{cell.folder} was run with {key} {here!r}, but {other.folder} with {there!r}, so that they "
                        "cannot be compared: put one of them into another folder."
                    )


def _read_cell(folder: Path, task: str, method: str, seed: int, budget: int, kind: str) -> CellResult:
    if not folder.is_dir():
        return CellResult(task, method, seed, folder, NOT_RUN)
    if not (folder / "DONE").exists():
        return CellResult(task, method, seed, folder, FAILED if (folder / "error.txt").exists() else UNFINISHED)
    config, run = _read_json(folder / "config.json"), _read_json(folder / "run.json")
    own = (short_name(str(config.get("task", task))), config.get("method", method), config.get("seed", seed))
    if own != (task, method, seed):
        raise ResultsError(
            f"{folder / 'config.json'} is of task {own[0]!r}, method {own[1]!r} and seed {own[2]!r}, which its folder "
            "is not: put it back."
        )
    own_budget = config.get("budget", budget)
    if own_budget not in (budget, 0):  # 0: representation learning alone, without training on the task
        return CellResult(task, method, seed, folder, f"other budget: {own_budget} steps", config, run)
    needed = ["visitation.csv", "visits.npz"] if kind == "visitation" else ["eval.csv"] if own_budget > 0 else []
    for name in needed:
        if not (folder / name).exists():
            raise ResultsError(f"{folder} is marked as DONE, but has no {name}: {_AGAIN}.")
    evaluations = _read_table(folder / "eval.csv", "environment_steps", "return_mean")
    if "eval.csv" in needed or (own_budget > 0 and len(evaluations)):
        _check_whole(folder / "eval.csv", evaluations, own_budget, config)
    visits = _read_table(folder / "visitation.csv", "error_min", "error_mean", "error_max", text=("actor", "head"))
    covered = _read_table(folder / "coverage.csv", "environment_steps", "cells")
    return CellResult(task, method, seed, folder, DONE, config, run, evaluations, visits, covered)


def _check_whole(path: Path, evaluations: pd.DataFrame, budget: int, config: dict[str, Any]) -> None:
    """Whether a learning curve goes from 0 to the budget, no row is left out, and all have a return (but those of a
    curious agent alone)."""
    steps, known = evaluations["environment_steps"].to_numpy(), np.isfinite(evaluations["return_mean"].to_numpy())
    # Evaluations are due at multiples of `eval_every`, and are made before the next rollout.
    every, train_freq = config.get("eval_every", np.inf), config.get("arguments", {}).get("train_freq", 1)
    rollout = (
        config.get("action_repeat", 1) * config.get("n_envs", 1) * train_freq if isinstance(train_freq, int) else np.inf
    )
    gaps = np.flatnonzero(np.diff(steps // every) > max(1, np.ceil(rollout / every)))
    if not len(steps) or steps[0] > 0 or steps[-1] < budget:
        found = f"from {steps[0]:.0f} to {steps[-1]:.0f}" if len(steps) else "no"
        reason = f"has evaluations of {found} environment steps, but the cell was trained for {budget}"
    elif not (np.diff(steps) > 0).all():
        reason = "has environment_steps that do not grow from row to row"
    elif len(gaps):
        reason = f"has no evaluation between {steps[gaps[0]]:.0f} and {steps[gaps[0] + 1]:.0f} environment steps"
    elif not known.all() and (known.any() or config.get("arguments", {}).get("task", True)):
        reason = f"has no return_mean in line {np.flatnonzero(~known)[0] + 2}"
    else:
        return
    raise ResultsError(f"{path} {reason}: {_AGAIN}.")


def _read_json(path: Path, fix: str = _AGAIN) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:  # ValueError: also of text that is no UTF-8
        raise ResultsError(f"{path} cannot be read ({error}): {fix}.") from None
    if not isinstance(content, dict):
        raise ResultsError(f"{path} holds a {type(content).__name__}, but it must hold an object: {fix}.")
    return content


def _read_table(path: Path, *numbers: str, text: tuple[str, ...] = ()) -> pd.DataFrame:
    """A CSV file with at least these columns; an empty table if there is none."""
    if not path.exists():
        return pd.DataFrame({**dict.fromkeys(numbers, np.zeros(0)), **{name: [] for name in text}})
    try:
        rows = [
            {name: np.nan if value == "" else value for name, value in row.items()}
            for row in read_rows(path, (*numbers, *text))
        ]
        table = pd.DataFrame(rows or {name: [] for name in (*numbers, *text)})
        return table.astype({name: float for name in table if name not in text})
    except (OSError, ValueError, csv.Error) as error:
        raise ResultsError(f"{path} cannot be read ({error}): {_AGAIN}.") from None
