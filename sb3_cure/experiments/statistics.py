"""Reads results of experiment grids and turns them into numbers: areas, paired differences, aggregates, coverage.

Intervals are 95 %. Two kinds are used, and named wherever they are shown:

- *t*: each task's mean difference is drawn from Student's t around the mean of its pairs (seeds), tasks are averaged
  with equal weights, and the interval is the middle 95 % of the draws: a parametric bootstrap, stratified by task.
  With one task it is the paired t interval, exactly. It is wide with two or three seeds, as it should be.
- *percentile*: seeds are resampled with replacement within each task, as rliable does. It cannot reach beyond the seeds
  that were run, so that with 2-5 of them it covers the truth in about 50-85 % of cases instead of 95.
"""

import csv
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import integrate, stats

from sb3_cure.experiments import published
from sb3_cure.experiments.files import Row, read_rows
from sb3_cure.experiments.grid import short_name

DONE, UNFINISHED, FAILED, NOT_RUN = "done", "unfinished", "failed", "not run"
#: Heads by which policies are compared; others are yardsticks
HEADS = ("own", "common")
#: The highest return of an episode in the DeepMind Control suite: scores of rliable are returns divided by it.
HIGHEST_RETURN = 1000.0
#: Below this part of a published mean, a return is suspected to be a bug of ours.
SUSPECT_BELOW = 0.75
#: Of the range of the random policy, or of the whole circle, along each of two coordinates
GRID_INTERVALS = 10
DRAWS = 100_000
RLIABLE_REPS = 2000


class ResultsError(ValueError):
    """Results that cannot be read; the message is one sentence that names the file."""


@dataclass(frozen=True)
class Visit:
    """SRL error of one episode under one head (a row of ``visitation.csv``)."""

    actor: str
    head: str
    episode: int
    error_min: float
    error_mean: float
    error_max: float
    total_reward: float


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
    :param evaluations: Columns of ``eval.csv`` (missing values are nan); empty if there is none
    :param visitation: Rows of ``visitation.csv``
    """

    task: str
    method: str
    seed: int
    folder: Path
    status: str
    config: dict[str, Any] = field(default_factory=dict)
    run: dict[str, Any] = field(default_factory=dict)
    evaluations: dict[str, np.ndarray] = field(default_factory=dict)
    visitation: tuple[Visit, ...] = ()

    @property
    def done(self) -> bool:
        return self.status == DONE

    @property
    def sees_published_pixels(self) -> bool:
        """Whether its images are those of the published results: only then numbers compare."""
        arguments = self.config.get("arguments", {})
        crops = arguments.get("srl_kwargs", {}).get("augmentation") == "crop"
        usual = {"image_size": 100 if crops else 84, "frame_stack": 3, "renderer": "dmc", "grayscale": False}
        return {**usual, **self.config.get("env_kwargs", {})} == usual

    def curve(self, column: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
        """
        :param column: A column of ``eval.csv``
        :return: Environment steps and values where there are any, [n] each
        """
        steps = self.evaluations.get("environment_steps", np.zeros(0))
        values = self.evaluations.get(column, np.full(len(steps), np.nan))
        there = np.isfinite(values)
        return steps[there], values[there]

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
                units = tuple(map(str, file["state_units"])) if found else ()
        except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
            raise ResultsError(f"{path} cannot be read ({error}): run the cell again.") from None
        for actor, states in found.items():
            if states.ndim != 2 or not np.isfinite(states).all() or states.shape[1] != len(units):
                shape = f"{actor}_states of shape {states.shape}, and units {units}"
                raise ResultsError(f"{path} has {shape}, but finite [n, d] and d units are needed: run the cell again.")
        return found, units


@dataclass(frozen=True)
class Experiment:
    """All cells of a grid, run or not.

    :param name: Its folder below the one that was read (``"500k/curves"``), or its own name
    :param folder: Where it lies
    :param grid: ``grid.json``
    :param cells: By (task, method, seed), in the grid's order; cells on disk that the grid does not name come last
    """

    name: str
    folder: Path
    grid: dict[str, Any]
    cells: dict[tuple[str, str, int], CellResult]

    @property
    def kind(self) -> str:
        return str(self.grid["kind"])

    @property
    def budget(self) -> int:
        return int(self.grid["budget"])

    @property
    def baseline(self) -> str:
        return str(self.grid["baseline"])

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

    def done(self, task: str, method: str) -> dict[int, CellResult]:
        """
        :return: The finished cells of an arm on a task, by seed
        """
        return {
            seed: cell
            for (at, arm, seed), cell in sorted(self.cells.items(), key=lambda item: item[0][2])
            if (at, arm) == (task, method) and cell.done
        }

    @property
    def sees_published_pixels(self) -> bool:
        """Whether all of its finished cells do, see ``CellResult``."""
        return all(cell.sees_published_pixels for cell in self.cells.values() if cell.done)

    def state(self, task: str, method: str) -> dict[str, list[int]]:
        """
        :return: Seeds of an arm on a task by the status of their cells; those of the grid are "not run" at least
        """
        seeds: dict[str, list[int]] = {}
        for (at, arm, seed), cell in sorted(self.cells.items(), key=lambda item: item[0][2]):
            if (at, arm) == (task, method):
                seeds.setdefault(cell.status, []).append(seed)
        return seeds


# Reading


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
    if not grids:
        raise ResultsError(
            f"{folder} holds no experiment (no grid.json in it, nor anywhere below it): give the folder that "
            "`sb3-cure experiment` wrote."
        )
    return [_read_experiment(path, path.parent.relative_to(folder).as_posix()) for path in grids]


def _read_experiment(path: Path, name: str | None = None) -> Experiment:
    grid = _read_json(path)
    for key, kind in (("experiment", str), ("kind", str), ("budget", int), ("baseline", str), ("tasks", list)):
        if not isinstance(grid.get(key), kind) or isinstance(grid.get(key), bool):
            raise ResultsError(f"{path} has {key} {grid.get(key)!r}, but it must be a {kind.__name__}: correct it.")
    methods, seeds = grid.get("methods"), grid.get("seeds")
    if not isinstance(methods, dict | list) or not methods:
        raise ResultsError(f"{path} has methods {methods!r}, but they must be a mapping of arms: correct it.")
    if isinstance(seeds, int):
        seeds = list(range(seeds))
    if not isinstance(seeds, list) or not all(isinstance(seed, int) for seed in seeds):
        raise ResultsError(f"{path} has seeds {grid.get('seeds')!r}, but they must be a list of numbers: correct it.")
    tasks = [short_name(str(task)) for task in grid["tasks"]]
    for part in (*tasks, *methods):
        if part in ("", ".", "..") or any(mark in part for mark in "/\\\0"):
            raise ResultsError(f"{path} names {part!r}, which cannot be the name of a folder: correct it.")
    root = path.parent
    keys = [(task, method, seed) for task in tasks for method in methods for seed in seeds]
    for found in sorted(root.glob("*/*/seed*")):
        number = found.name.removeprefix("seed")
        if found.is_dir() and number.isdecimal():
            keys.append((found.parent.parent.name, found.parent.name, int(number)))
    cells = {key: _read_cell(root / key[0] / key[1] / f"seed{key[2]}", *key, grid["budget"]) for key in keys}
    order = {task: index for index, task in reversed(list(enumerate(task for task, _, _ in cells)))}
    in_order = dict(sorted(cells.items(), key=lambda item: order[item[0][0]]))
    return Experiment(name or grid["experiment"], root, grid, in_order)


def _read_cell(folder: Path, task: str, method: str, seed: int, budget: int) -> CellResult:
    if not folder.is_dir():
        return CellResult(task, method, seed, folder, NOT_RUN)
    if not (folder / "DONE").exists():
        return CellResult(task, method, seed, folder, FAILED if (folder / "error.txt").exists() else UNFINISHED)
    config, run = _read_json(folder / "config.json"), _read_json(folder / "run.json")
    if (config.get("method", method), config.get("seed", seed)) != (method, seed):
        raise ResultsError(
            f"{folder / 'config.json'} is of method {config.get('method')!r} and seed {config.get('seed')!r}, "
            "which its folder is not: put it back."
        )
    own_budget = config.get("budget", budget)
    if own_budget not in (budget, 0):  # 0: representation learning alone, without training on the task
        return CellResult(task, method, seed, folder, f"other budget: {own_budget} steps", config, run)
    evaluations = _read_evaluations(folder / "eval.csv") if (folder / "eval.csv").exists() else {}
    visits = _read_visitation(folder / "visitation.csv") if (folder / "visitation.csv").exists() else ()
    return CellResult(task, method, seed, folder, DONE, config, run, evaluations, visits)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultsError(f"{path} cannot be read ({error.strerror}): run the cell or the experiment again.") from None
    except ValueError as error:
        raise ResultsError(f"{path} is no JSON ({error}): run the cell or the experiment again.") from None
    if not isinstance(content, dict):
        raise ResultsError(f"{path} holds a {type(content).__name__}, but it must hold an object: correct it.")
    return content


def _read_rows(path: Path, needed: Sequence[str]) -> list[Row]:
    try:
        return read_rows(path, needed)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ResultsError(f"{path} cannot be read ({error}): run the cell again.") from None
    except ValueError as error:
        raise ResultsError(f"{path} {error}: run the cell again.") from None


def _number(path: Path, line: int, column: str, value: Any) -> float:
    if value == "":
        return float("nan")
    if isinstance(value, str):
        raise ResultsError(f"{path} has {value!r} as {column} in line {line}, which is no number: correct it.")
    return float(value)


def _read_evaluations(path: Path) -> dict[str, np.ndarray]:
    rows = _read_rows(path, ("environment_steps", "return_mean"))
    columns = {
        name: np.array([_number(path, line, name, row[name]) for line, row in enumerate(rows, 2)])
        for name in (rows[0] if rows else ("environment_steps", "return_mean"))
    }
    steps = columns["environment_steps"]
    if not np.isfinite(steps).all() or (np.diff(steps) <= 0).any():
        raise ResultsError(f"{path} has environment_steps that do not grow from row to row: run the cell again.")
    return columns


def _read_visitation(path: Path) -> tuple[Visit, ...]:
    names = ("error_min", "error_mean", "error_max", "return")
    rows = _read_rows(path, ("actor", "head", "episode", *names))
    return tuple(
        Visit(
            row["actor"],
            row["head"],
            int(_number(path, line, "episode", row["episode"] or 0)),
            *(_number(path, line, name, row[name]) for name in names),
        )
        for line, row in enumerate(rows, 2)
    )


# Learning curves


def area_under_curve(steps: np.ndarray, values: np.ndarray) -> float:
    """Area under a learning curve over the environment steps that it spans: a mean return.

    :param steps: Environment steps, growing, [n]
    :param values: Returns, [n]
    :return: Trapezoidal area / (last - first step); nan with fewer than two points
    """
    if len(steps) < 2:
        return float("nan")
    return float(integrate.trapezoid(values, steps) / (steps[-1] - steps[0]))


def steps_to_threshold(steps: np.ndarray, values: np.ndarray, threshold: float) -> float:
    """
    :param steps: Environment steps, [n]
    :param values: Returns, [n]
    :param threshold: A return
    :return: Environment steps of the first evaluation at or above it; infinity if there is none
    """
    reached = np.flatnonzero(values >= threshold)
    return float(steps[reached[0]]) if len(reached) else float("inf")


def interquartile_range(values: Sequence[float] | np.ndarray) -> float:
    """
    :param values: One per seed
    :return: 75th - 25th percentile; nan with fewer than two
    """
    if len(values) < 2:
        return float("nan")
    low, high = np.percentile(values, [25, 75])
    return float(high - low)


def stack_curves(cells: Sequence[CellResult], column: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
    """The curves of several seeds on the same steps (linear in between, where evaluations fell on different ones).

    :param cells: Finished cells
    :param column: A column of ``eval.csv``
    :return: Environment steps [n], within what all of them span, and values [seeds, n]
    """
    curves = [cell.curve(column) for cell in cells]
    curves = [(steps, values) for steps, values in curves if len(steps)]
    if not curves:
        return np.zeros(0), np.zeros((0, 0))
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps for steps, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in curves])


@dataclass(frozen=True)
class ArmSummary:
    """One arm on one task.

    :param seeds: Seeds that are done and have a curve
    :param areas: Area under the curve by seed
    :param starts: Return of the first evaluation by seed, before training
    :param finals: Return of the last evaluation by seed
    :param curve_iqr: Interquartile range over seeds, averaged over the curve; nan with one seed
    :param reached: For each threshold the steps of each seed
    """

    task: str
    method: str
    seeds: tuple[int, ...]
    areas: np.ndarray
    starts: np.ndarray
    finals: np.ndarray
    curve_iqr: float
    reached: dict[float, np.ndarray]


def summarise_arm(experiment: Experiment, task: str, method: str, thresholds: Sequence[float] = ()) -> ArmSummary:
    """
    :param experiment: An experiment
    :param task: Short name
    :param method: Name of the arm
    :param thresholds: Returns
    :return: Its numbers; empty arrays if no cell with a curve is done
    """
    cells = {seed: cell for seed, cell in experiment.done(task, method).items() if len(cell.curve()[0]) > 1}
    curves = [cell.curve() for cell in cells.values()]
    _, stacked = stack_curves(list(cells.values()))
    spread = float(np.mean([interquartile_range(column) for column in stacked.T])) if len(cells) > 1 else float("nan")
    return ArmSummary(
        task,
        method,
        tuple(cells),
        np.array([area_under_curve(*curve) for curve in curves]),
        np.array([values[0] for _, values in curves]),
        np.array([values[-1] for _, values in curves]),
        spread,
        {limit: np.array([steps_to_threshold(*curve, limit) for curve in curves]) for limit in thresholds},
    )


# Estimates with intervals


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval.

    :param value: The estimate
    :param low: Lower end, None where no interval can be given (one seed)
    :param high: Upper end
    :param n: How many seeds (pairs of them, for differences) it rests on
    """

    value: float
    low: float | None = None
    high: float | None = None
    n: int = 0

    @property
    def verdict(self) -> str:
        """What a difference says: ``"better"``, ``"worse"`` or ``"inconclusive"`` (as few equal pairs are, too)."""
        if self.low is None or self.high is None:
            return "one seed: no interval"
        if self.low > 0:
            return "better"
        if self.high < 0:
            return "worse"
        return "inconclusive (all pairs equal)" if self.low == self.high == 0 else "inconclusive"


def t_interval(groups: Sequence[np.ndarray], draws: int = DRAWS) -> Estimate:
    """Mean of the groups' means, with the stratified t interval that this module's head describes.

    Groups of one value have no spread to judge by: where others have more, only those count.

    :param groups: Differences between the arms, seed by seed: one array per task
    :param draws: How many, with more than one group
    :return: The estimate; without an interval if every group has a single value
    """
    groups = [np.sort(group) for group in groups if len(group)]  # sorted: sums do not depend on the seeds' order
    if not groups:
        return Estimate(float("nan"))
    judged = [group for group in groups if len(group) > 1] or groups
    means = np.array([group.mean() for group in judged])
    value, n = float(means.mean()), sum(len(group) for group in judged)
    if len(judged[0]) < 2:
        return Estimate(value, n=n)
    errors = np.array([group.std(ddof=1) / np.sqrt(len(group)) for group in judged])
    if len(judged) == 1:
        reach = float(stats.t.ppf(0.975, len(judged[0]) - 1) * errors[0])
        return Estimate(value, value - reach, value + reach, n)
    rng = np.random.default_rng(0)
    drawn = sum(
        error * rng.standard_t(len(group) - 1, draws) for error, group in zip(errors, judged, strict=True)
    ) / len(judged)
    # The distribution is symmetric: one quantile of the distance is steadier than two of the ends.
    reach = float(np.percentile(np.abs(drawn), 95))
    return Estimate(value, value - reach, value + reach, n)


def percentile_interval(groups: Sequence[np.ndarray], draws: int = 20_000) -> Estimate:
    """The same mean with the percentile bootstrap, seeds resampled within tasks: too narrow for few seeds.

    :param groups: As in ``t_interval``
    :param draws: How many
    :return: The estimate
    """
    groups = [np.sort(group) for group in groups if len(group)]
    judged = [group for group in groups if len(group) > 1] or groups
    if not judged:
        return Estimate(float("nan"))
    value, n = float(np.mean([group.mean() for group in judged])), sum(len(group) for group in judged)
    if len(judged[0]) < 2:
        return Estimate(value, n=n)
    rng = np.random.default_rng(0)
    means = [group[rng.integers(len(group), size=(draws, len(group)))].mean(axis=1) for group in judged]
    low, high = np.percentile(np.mean(means, axis=0), [2.5, 97.5])
    return Estimate(value, float(low), float(high), n)


@dataclass(frozen=True)
class PairedDifference:
    """An arm minus another, seed by seed.

    :param method: The arm
    :param other: The arm that is subtracted
    :param task: Short name, or None for all tasks together
    :param differences: By task, one value per seed that both arms have done
    :param t: Mean difference with the t interval
    :param percentile: Mean difference with the percentile interval
    :param same_starts: In how many pairs both arms earn the same before training, as they do from equal weights
    """

    method: str
    other: str
    task: str | None
    differences: dict[str, np.ndarray]
    t: Estimate
    percentile: Estimate
    same_starts: int

    @property
    def wins(self) -> int:
        """In how many pairs the arm is above the baseline."""
        return int(sum((values > 0).sum() for values in self.differences.values()))

    @property
    def pairs(self) -> int:
        return sum(len(values) for values in self.differences.values())


def paired_differences(
    experiment: Experiment, measure: str = "areas", baseline: str | None = None
) -> list[PairedDifference]:
    """Every arm against another: per task, and over all tasks where there are several.

    :param experiment: An experiment
    :param measure: ``"areas"`` or ``"finals"``
    :param baseline: The arm that is subtracted from all others, by default of each its baseline in the grid
    :return: Arm by arm, all tasks together first; arms without a single pair are left out
    """
    arms = {
        (task, method): summarise_arm(experiment, task, method)
        for task in experiment.tasks
        for method in experiment.methods
    }
    found = []
    for method in experiment.methods:
        other = experiment.baseline_of(method) if baseline is None else baseline
        if method == other:
            continue
        by_task, same = {}, {}
        for task in experiment.tasks:
            arm, base = arms[task, method], arms.get((task, other))
            shared = [seed for seed in arm.seeds if base is not None and seed in base.seeds]
            if base is not None and shared:
                by_task[task], starts = (
                    np.array([_by_seed(arm, name)[seed] - _by_seed(base, name)[seed] for seed in shared])
                    for name in (measure, "starts")
                )
                same[task] = int((starts == 0).sum())
        rows = [{task: values} for task, values in by_task.items()]
        for row in [by_task, *rows] if len(rows) > 1 else rows:
            groups = list(row.values())
            name = None if row is by_task else next(iter(row))
            starts_alike = sum(same[task] for task in row)
            intervals = t_interval(groups), percentile_interval(groups)
            found.append(PairedDifference(method, other, name, row, *intervals, starts_alike))
    return found


def _by_seed(arm: ArmSummary, measure: str) -> dict[int, float]:
    return dict(zip(arm.seeds, getattr(arm, measure), strict=True))


# Aggregates over tasks, by rliable


@dataclass(frozen=True)
class Aggregates:
    """Scores (final return / 1000) of all arms over several tasks.

    :param tasks: Tasks that count: those on which every arm that has begun has two or more seeds in common
    :param seeds: Seeds of each task
    :param iqm: Interquartile mean by arm, with the stratified bootstrap's percentile interval
    :param improvement: Probability that a run of the arm beats one of the baseline (seeds not paired), by arm
    :param taus: Scores at which the profiles are read
    :param profiles: Share of runs above each, by arm: value, low, high
    """

    tasks: tuple[str, ...]
    seeds: int
    iqm: dict[str, Estimate]
    improvement: dict[str, Estimate]
    taus: np.ndarray
    profiles: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def score_matrices(experiment: Experiment) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """What rliable works on. It needs equally many seeds everywhere: the first that all tasks have.

    :param experiment: An experiment
    :return: Scores [seeds, tasks] by arm, and the tasks; both empty if no task has two seeds of every arm
    """
    arms = {
        (task, method): dict(zip(arm.seeds, arm.finals, strict=True))
        for task in experiment.tasks
        for method in experiment.methods
        if (arm := summarise_arm(experiment, task, method)).seeds
    }
    methods = [method for method in experiment.methods if any(key[1] == method for key in arms)]
    shared = {
        task: sorted(set.intersection(*(set(arms.get((task, method), ())) for method in methods)))
        for task in experiment.tasks
        if methods
    }
    tasks = tuple(task for task, seeds in shared.items() if len(seeds) > 1)
    if not tasks:
        return {}, ()
    n = min(len(shared[task]) for task in tasks)
    scores = {
        method: np.array([[arms[task, method][seed] / HIGHEST_RETURN for seed in shared[task][:n]] for task in tasks]).T
        for method in methods
    }
    return scores, tasks


def aggregate(experiment: Experiment) -> Aggregates | None:
    """
    :param experiment: An experiment
    :return: rliable's aggregates, None if no task has two seeds of every arm
    :raises ResultsError: if there are returns that are no scores between 0 and 1, or rliable cannot be imported
    """
    scores, tasks = score_matrices(experiment)
    if not scores:
        return None
    for index, task in enumerate(tasks):
        for score in np.concatenate([values[:, index] for values in scores.values()]):
            if not -1e-6 <= score <= 1 + 1e-6:
                raise ResultsError(
                    f"scores are returns divided by {HIGHEST_RETURN:.0f}, the highest one of the DeepMind Control "
                    f"suite, but a return on {task} is {score * HIGHEST_RETURN:.0f}."
                )
    library = _import_rliable()
    n = len(next(iter(scores.values())))
    taus = np.linspace(0, 1, 51)

    def estimates(values: Mapping[str, Any], function: Any) -> dict[str, Estimate]:
        points, intervals = library.get_interval_estimates(
            values, lambda *x: np.array([function(*x)]), reps=RLIABLE_REPS
        )
        return {
            name: Estimate(float(points[name][0]), float(intervals[name][0, 0]), float(intervals[name][1, 0]), n)
            for name in values
        }

    with _fixed_numpy_seed():
        iqm = estimates(scores, interquartile_mean)
        base = scores.get(experiment.baseline)
        others = {} if base is None else {name: (own, base) for name, own in scores.items() if own is not base}
        improvement = estimates(others, probability_of_improvement)
        points, intervals = library.create_performance_profile(
            scores, taus, custom_profile_func=share_above, reps=RLIABLE_REPS
        )
    profiles = {name: (points[name], intervals[name][0], intervals[name][1]) for name in scores}
    return Aggregates(tasks, n, iqm, improvement, taus, profiles)


# rliable's three measures, whose own calls of scipy and loops take a minute for 2000 resamples of a few arms.


def interquartile_mean(scores: np.ndarray) -> float:
    """
    :param scores: [seeds, tasks]
    :return: Mean of the middle half of all scores
    """
    cut = scores.size // 4
    return float(np.sort(scores, axis=None)[cut : scores.size - cut].mean())


def probability_of_improvement(scores: np.ndarray, baseline: np.ndarray) -> float:
    """
    :param scores: Of the arm, [seeds, tasks]
    :param baseline: Of the baseline, [seeds, tasks]
    :return: How often a run of the arm beats one of the baseline on the same task (ties count half)
    """
    return float((np.sign(scores[:, None] - baseline[None]).mean() + 1) / 2)


def share_above(scores: np.ndarray, taus: np.ndarray) -> np.ndarray:
    """
    :param scores: [seeds, tasks]
    :param taus: Thresholds, [n]
    :return: Share of the scores above each: the performance profile, [n]
    """
    return (scores.reshape(-1, 1) > taus).mean(axis=0)


def _import_rliable() -> Any:
    try:
        from rliable import library
    except (ImportError, AttributeError) as error:  # AttributeError: how it fails with pandas 3
        raise ResultsError(
            f"rliable cannot be imported ({error}): install the extra, pip install 'sb3-cure[experiments]' "
            "(rliable 1.2 needs pandas < 3)."
        ) from None
    return library


@contextmanager
def _fixed_numpy_seed() -> Iterator[None]:
    """rliable 1.2 draws from numpy's global generator, whatever random_state it is given."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)


# Visitation


@dataclass(frozen=True)
class ErrorSummary:
    """SRL error per step that an actor meets, judged by one head, over all seeds and episodes.

    :param means: Mean over the episodes by seed, [seeds]
    :param ratio: Its mean over the random actor's of the same cell (geometric mean over seeds, t interval of the
        logarithms). Measured errors are free of dither, so this is the ratio of the excesses over the dither floor
    :param task_ratio: The same over what the baseline's task policy of the same seed meets; nan under the own head,
        which is another for that policy
    """

    task: str
    method: str
    actor: str
    head: str
    error_min: float
    error_max: float
    means: np.ndarray
    ratio: Estimate
    task_ratio: Estimate

    @property
    def error_mean(self) -> float:
        return float(self.means.mean())


def summarise_errors(experiment: Experiment) -> list[ErrorSummary]:
    """
    :param experiment: An experiment
    :return: One row per task, arm, head and actor
    """
    rows = []
    for task in experiment.tasks:
        for method in experiment.methods:
            cells, other = experiment.done(task, method), experiment.baseline_of(method)
            pairs = dict.fromkeys((visit.head, visit.actor) for cell in cells.values() for visit in cell.visitation)
            heads = list(dict.fromkeys(head for head, _ in pairs))
            for head, actor in sorted(pairs, key=lambda pair: (heads.index(pair[0]), _place(pair[1]))):
                visits = [
                    visit
                    for cell in cells.values()
                    for visit in cell.visitation
                    if (visit.head, visit.actor) == (head, actor)
                ]
                means = {seed: _mean_error(cell, head, actor) for seed, cell in cells.items()}
                randoms = {seed: _mean_error(cell, head, "random") for seed, cell in cells.items()}
                tasks = {seed: _mean_error(cell, head, "task") for seed, cell in experiment.done(task, other).items()}
                rows.append(
                    ErrorSummary(
                        task,
                        method,
                        actor,
                        head,
                        min(visit.error_min for visit in visits),
                        max(visit.error_max for visit in visits),
                        np.array([mean for mean in means.values() if np.isfinite(mean)]),
                        *_ratios(means, randoms, {} if head == "own" else tasks, actor, method == other),
                    )
                )
    return rows


def _ratios(
    own: Mapping[int, float], randoms: Mapping[int, float], tasks: Mapping[int, float], actor: str, is_baseline: bool
) -> tuple[Estimate, Estimate]:
    """Over the random policy's and over the baseline's task policy's, by seed; neither of them over itself."""
    is_reference = actor == "random" or (actor == "task" and is_baseline)
    return (
        paired_ratio({} if actor == "random" else own, randoms),
        paired_ratio({} if is_reference else own, tasks),
    )


def _place(actor: str) -> int:
    """Of an actor in tables: the random one, with which the others are compared, comes first."""
    return ("random", "task", "curious", actor).index(actor)


def _mean_error(cell: CellResult, head: str, actor: str) -> float:
    values = [visit.error_mean for visit in cell.visitation if (visit.head, visit.actor) == (head, actor)]
    return float(np.mean(values)) if values else float("nan")


def paired_ratio(ours: Mapping[int, float], theirs: Mapping[int, float]) -> Estimate:
    """
    :param ours: A positive number by seed
    :param theirs: Another
    :return: Geometric mean of ours / theirs over the seeds that have both, with the t interval of the logarithms; nan
        without such a seed
    """
    ratios = [ours[seed] / theirs[seed] for seed in ours if ours[seed] > 0 and theirs.get(seed, 0) > 0]
    estimate = t_interval([np.log(ratios)]) if len(ratios) else Estimate(float("nan"))
    low, high = (None if end is None else float(np.exp(end)) for end in (estimate.low, estimate.high))
    return Estimate(float(np.exp(estimate.value)), low, high, estimate.n)


@dataclass(frozen=True)
class Coverage:
    """How much of the true state space an actor visits, by seed.

    :param occupied: Occupied cells of a grid over two coordinates of the state, mean over all pairs of them, [seeds]
    :param entropy: Entropy of the visits over these cells in bits, mean over all pairs, [seeds]
    :param ratio: Occupied cells over the random actor's of the same cell (geometric mean, t interval); nan for random
    :param task_ratio: Occupied cells over those of the baseline's task policy of the same seed; nan for both of these
    :param steps: States counted, of each seed and actor alike
    :param dimensions: Dimension of the state
    """

    task: str
    method: str
    actor: str
    occupied: np.ndarray
    entropy: np.ndarray
    ratio: Estimate
    task_ratio: Estimate
    steps: int
    dimensions: int


def visits_by_pair(states: np.ndarray, low: np.ndarray, width: np.ndarray) -> list[np.ndarray]:
    """
    :param states: True states, [n, d]
    :param low: Where a cell of the grid begins, [d]; the grid has no end on any side
    :param width: Of its cells, > 0, [d]
    :return: For each pair of coordinates (if there is but one: for it), how many states lie in each occupied cell
    """
    places = np.floor((states - low) / width).astype(np.int64)
    places -= places.min(axis=0)
    ends = places.max(axis=0) + 1
    pairs = itertools.combinations(range(states.shape[1]), 2) if states.shape[1] > 1 else [(0, 0)]
    return [np.unique(places[:, i] * ends[j] + places[:, j], return_counts=True)[1] for i, j in pairs]


def entropy_bits(counts: np.ndarray) -> float:
    """
    :param counts: Visits of each cell
    :return: Entropy of the distribution in bits
    """
    shares = counts / counts.sum()
    return float(-(shares * np.log2(shares)).sum()) + 0.0


def state_coverage(experiment: Experiment) -> list[Coverage]:
    """Coverage of the true states by every actor.

    States are counted on grids over two coordinates at a time: one over all of them has either a few cells per
    coordinate or so many that each step has its own. The random policy is the yardstick of a task: ``GRID_INTERVALS``
    make up the range between the 1st and the 99th percentile of each coordinate over its episodes of all seeds (the
    whole circle of an angle), and cells of that size go on without end. Thus nobody's cells depend on where the other
    arms went. Of every actor and seed equally many states are counted (drawn at random): else the longer run covers
    more.

    :param experiment: An experiment
    :return: One row per task, arm and actor
    :raises ResultsError: if a file cannot be read, or its states have another dimension than others of the task
    """
    rows = []
    for task in experiment.tasks:
        visits, units = _visits(experiment, task)
        if not visits:
            continue
        steps = min(len(states) for states in visits.values())
        low, width = _yardstick(visits, units)
        rng = np.random.default_rng(0)
        counts = {
            key: visits_by_pair(rng.choice(states, steps, replace=False), low, width) for key, states in visits.items()
        }
        occupied: dict[tuple[str, str], dict[int, float]] = {}
        for (method, seed, actor), pairs in counts.items():
            occupied.setdefault((method, actor), {})[seed] = float(np.mean([len(pair) for pair in pairs]))
        for method, actor in sorted(occupied, key=lambda arm: (experiment.methods.index(arm[0]), _place(arm[1]))):
            own, other = occupied[method, actor], experiment.baseline_of(method)
            randoms, tasks = occupied.get((method, "random"), {}), occupied.get((other, "task"), {})
            entropy = [np.mean([entropy_bits(pair) for pair in counts[method, seed, actor]]) for seed in own]
            rows.append(
                Coverage(
                    task,
                    method,
                    actor,
                    np.array(list(own.values())),
                    np.array(entropy),
                    *_ratios(own, randoms, tasks, actor, method == other),
                    steps,
                    len(low),
                )
            )
    return rows


def _visits(experiment: Experiment, task: str) -> tuple[dict[tuple[str, int, str], np.ndarray], tuple[str, ...]]:
    """True states by arm, seed and actor, and the units of their coordinates."""
    visits: dict[tuple[str, int, str], np.ndarray] = {}
    kinds: set[tuple[int, tuple[str, ...]]] = set()
    for method in experiment.methods:
        for seed, cell in experiment.done(task, method).items():
            states, units = cell.states()
            found = {(method, seed, actor): visited for actor, visited in states.items() if len(visited)}
            visits.update(found)
            kinds.update((visited.shape[1], units) for visited in found.values())
    if len(kinds) > 1 or (0, ()) in kinds:
        raise ResultsError(
            f"the visits.npz files of {experiment.folder / task} have states of different dimension: run again."
        )
    return visits, kinds.pop()[1] if kinds else ()


def _yardstick(
    visits: Mapping[tuple[str, int, str], np.ndarray], units: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Where the grid begins and how wide its cells are: by the random policy's episodes, those of each seed once.

    (All arms of a seed have the same ones.)
    """
    randoms = {seed: states for (_, seed, actor), states in visits.items() if actor == "random"}
    low, high = np.percentile(np.concatenate(list((randoms or visits).values())), [1, 99], axis=0)
    largest = np.max([np.abs(states).max(axis=0) for states in visits.values()], axis=0)
    is_angle = np.array([unit == "rad" for unit in units]) & (largest < np.pi + 1e-3)
    # A little beyond, so that what rounding puts behind the seam has no cells of its own.
    low, high = np.where(is_angle, -np.pi - 1e-3, low), np.where(is_angle, np.pi + 1e-3, high)
    return low, np.where(high > low, (high - low) / GRID_INTERVALS, 1.0)


# Beside published numbers


@dataclass(frozen=True)
class Comparison:
    """An arm beside a published number at the same environment steps.

    :param theirs: The published value of the method that the arm is, or builds upon; None if there is none
    :param published_as: Name of that method
    :param same_method: Whether the arm is that method, rather than adding curiosity to it
    :param ours: Mean return of the seeds at that step
    :param std: Standard deviation over seeds; nan with one
    """

    experiment: str
    task: str
    method: str
    steps: int
    seeds: int
    ours: float
    std: float
    theirs: published.MeanStd | None
    published_as: str
    same_method: bool

    @property
    def suspect(self) -> bool:
        """Whether the return is so far below the published one that a bug of ours is suspected."""
        return self.same_method and self.theirs is not None and self.ours < SUSPECT_BELOW * self.theirs.mean


def compare_with_published(experiments: Sequence[Experiment]) -> list[Comparison]:
    """
    :param experiments: Experiments; those about visitation have no returns to compare
    :return: Every arm at every published step that its curves reach, of those that see the published pixels
    """
    rows = []
    for experiment in experiments:
        for task in experiment.tasks:
            for method in experiment.methods:
                cells = [cell for cell in experiment.done(task, method).values() if len(cell.curve()[0]) > 1]
                if not cells or experiment.kind == "visitation" or cells[0].config.get("pretrain"):
                    continue
                base, curious = published.published_method(cells[0].config.get("arguments", {}))
                if base is None or not all(cell.sees_published_pixels for cell in cells):
                    continue
                steps, stacked = stack_curves(cells)
                for at, table in published.RETURNS[base].items():
                    # An agent step may be worth up to 8 environment steps, in several environments at once.
                    if len(steps) < 2 or steps[-1] < 0.99 * at:
                        continue
                    values = np.array([np.interp(at, steps, curve) for curve in stacked])
                    std = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
                    theirs = table.get(published.task_key(task))
                    rows.append(
                        Comparison(
                            experiment.name,
                            task,
                            method,
                            at,
                            len(cells),
                            float(values.mean()),
                            std,
                            theirs,
                            base,
                            not curious,
                        )
                    )
    return rows
