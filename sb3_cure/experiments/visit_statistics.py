"""SRL error that policies meet, and coverage of the true state space."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from sb3_cure.experiments.results import Experiment
from sb3_cure.experiments.statistics import Estimate, paired_ratio

#: Heads by which policies are compared; others are yardsticks
HEADS = ("own", "common")
#: Number of cells along each of two coordinates, over the range of the random policy or the whole circle
GRID_INTERVALS = 10
_ACTORS = ("random", "task", "curious")
#: Arm, actor and seed
_Key: TypeAlias = tuple[str, str, int]


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A number of a policy by seed, with its ratios to those of other policies.

    :param task: Short name of the task (``"cartpole-swingup"``)
    :param method: Name of the arm
    :param actor: ``"random"``, ``"task"`` or ``"curious"``
    :param values: [seeds]
    :param ratio: Ratio to the random policy's of the same cell (geometric mean over seeds, t interval of the
        logarithms); nan for the random policy
    :param task_ratio: Ratio to that of the baseline's task policy of the same seed; nan for this policy and for the
        random one
    """

    task: str
    method: str
    actor: str
    values: np.ndarray
    ratio: Estimate
    task_ratio: Estimate

    @property
    def mean(self) -> float:
        return float(self.values.mean())


@dataclass(frozen=True, kw_only=True)
class ErrorSummary(Measured):
    """SRL error per step (mean over the episodes of a seed) under one head.

    Errors are free of dither: ratios are those of the excesses over the dither floor. Own heads differ from policy to
    policy: under them there is no ``task_ratio``.

    :param head: ``"own"``, ``"common"`` or a yardstick: ``"zero"``, ``"mean_image"``
    :param error_min: Lowest error of all steps
    :param error_max: Highest error of all steps
    """

    head: str
    error_min: float
    error_max: float


@dataclass(frozen=True, kw_only=True)
class Occupancy(Measured):
    """Occupied cells of a grid over two coordinates of the true state, averaged over all pairs of them.

    :param steps: Number of states that are counted, the same for each seed and actor
    :param dimensions: Dimension of the state
    """

    steps: int
    dimensions: int


def _compare(experiment: Experiment, task: str, numbers: Mapping[_Key, float]) -> Iterator[dict[str, Any]]:
    """Fields of ``Measured`` from numbers by (method, actor, seed), in the order of tables."""
    by_policy: dict[tuple[str, str], dict[int, float]] = {}
    for (method, actor, seed), value in numbers.items():
        by_policy.setdefault((method, actor), {})[seed] = value
    order = {method: index for index, method in enumerate(experiment.methods)}
    for method, actor in sorted(by_policy, key=lambda each: (order[each[0]], (*_ACTORS, each[1]).index(each[1]))):
        own, other = by_policy[method, actor], (experiment.baseline_of(method), "task")
        randoms = {} if actor == "random" else by_policy.get((method, "random"), {})
        tasks = {} if actor == "random" or (method, actor) == other else by_policy.get(other, {})
        yield {
            "task": task,
            "method": method,
            "actor": actor,
            "values": np.array(list(own.values())),
            "ratio": paired_ratio(own, randoms),
            "task_ratio": paired_ratio(own, tasks),
        }


def summarise_errors(experiment: Experiment) -> list[ErrorSummary]:
    """Summarise the SRL errors that policies meet.

    :param experiment: An experiment
    :return: One row per task, arm, head and actor
    """
    rows: list[ErrorSummary] = []
    for task in experiment.tasks:
        cells = [cell for cell in experiment.finished if cell.task == task and len(cell.visitation)]
        if not cells:
            continue
        visits = pd.concat([cell.visitation.assign(method=cell.method, seed=cell.seed) for cell in cells])
        found = []
        for head, judged in visits.groupby("head", sort=False):
            means = judged.groupby(["method", "actor", "seed"]).error_mean.mean()
            ends = judged.groupby(["method", "actor"]).agg({"error_min": "min", "error_max": "max"})
            for row in _compare(experiment, task, means.to_dict()):
                if head in ("own", "mean_image"):  # which differ from arm to arm
                    row["task_ratio"] = Estimate(float("nan"))
                low, high = ends.loc[row["method"], row["actor"]]
                found.append(ErrorSummary(**row, head=str(head), error_min=float(low), error_max=float(high)))
        rows += sorted(found, key=lambda row: experiment.methods.index(row.method))
    return rows


def state_coverage(experiment: Experiment) -> list[Occupancy]:
    """Coverage of the true states by every actor.

    States are counted on grids over two coordinates at a time: a grid over all of them has either a few cells per
    coordinate or so many that each step has its own. ``GRID_INTERVALS`` cells span the range between the 1st and the
    99th percentile of each coordinate over the random policy's episodes of all seeds (of an angle, the circle), and
    cells of that size continue without end, so that no arm's cells depend on the other arms. For every actor and seed
    the same number of states is counted (drawn at random): else the longer run would cover more.

    :param experiment: An experiment
    :return: One row per task, arm and actor
    """
    rows = []
    for task in experiment.tasks:
        visits, units = _visits(experiment, task)
        if not visits:
            continue
        steps = min(len(states) for states in visits.values())
        low, width = _grid_of_random(visits, units)
        occupied = {}
        for key, states in visits.items():  # the same draw of all, as arms of a seed share the random policy's states
            drawn = np.random.default_rng(0).choice(states, steps, replace=False)
            occupied[key] = float(np.mean(occupied_cells(drawn, low, width)))
        for row in _compare(experiment, task, occupied):
            rows.append(Occupancy(**row, steps=steps, dimensions=len(low)))
    return rows


def occupied_cells(states: np.ndarray, low: np.ndarray, width: np.ndarray) -> list[int]:
    """Count the cells that states occupy on grids over two coordinates at a time.

    :param states: True states, [n, d]
    :param low: Lower edge of a cell, [d]; the grid has no end on any side
    :param width: Width of the cells, > 0, [d]
    :return: Number of occupied cells for each pair of coordinates (or for the only coordinate)
    """
    places = np.floor((states - low) / width).astype(np.int64)
    places -= places.min(axis=0)
    ends = places.max(axis=0) + 1
    pairs = itertools.combinations(range(states.shape[1]), 2) if states.shape[1] > 1 else [(0, 0)]
    return [len(np.unique(places[:, i] * ends[j] + places[:, j])) for i, j in pairs]


def _visits(experiment: Experiment, task: str) -> tuple[dict[_Key, np.ndarray], tuple[str, ...]]:
    """True states by arm, actor and seed, and the units of their coordinates."""
    visits: dict[_Key, np.ndarray] = {}
    units: tuple[str, ...] = ()
    for method in experiment.methods:
        for seed, cell in experiment.finished_cells(task, method).items():
            states, own_units = cell.states()
            visits |= {(method, actor, seed): visited for actor, visited in states.items() if visited.size}
            units = own_units or units
    return visits, units


def _grid_of_random(visits: Mapping[_Key, np.ndarray], units: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Lower edge and width of the cells, by the random policy's episodes, those of each seed once.

    (All arms of a seed have the same ones.)
    """
    randoms = {seed: states for (_, actor, seed), states in visits.items() if actor == "random"}
    low, high = np.percentile(np.concatenate(list((randoms or visits).values())), [1, 99], axis=0)
    largest = np.max([np.abs(states).max(axis=0) for states in visits.values()], axis=0)
    is_angle = np.array([unit == "rad" for unit in units]) & (largest < np.pi + 1e-3)
    # A little beyond the circle, so that rounding at the seam opens no new cells.
    low, high = np.where(is_angle, -np.pi - 1e-3, low), np.where(is_angle, np.pi + 1e-3, high)
    return low, np.where(high > low, (high - low) / GRID_INTERVALS, 1.0)
