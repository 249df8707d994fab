"""What SRL error policies meet, and how much of the true state space they cover."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_cure.experiments.results import CellResult, Experiment, ResultsError
from sb3_cure.experiments.statistics import Estimate, t_interval

#: Heads by which policies are compared; others are yardsticks
HEADS = ("own", "common")
#: Of the range of the random policy, or of the whole circle, along each of two coordinates
GRID_INTERVALS = 10


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
    :raises ResultsError: if a file cannot be read, or cells of a task have states of different coordinates
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
    kinds: dict[tuple[str, ...], Path] = {}
    for method in experiment.methods:
        for seed, cell in experiment.done(task, method).items():
            states, units = cell.states()
            found = {(method, seed, actor): visited for actor, visited in states.items() if visited.size}
            visits.update(found)
            if found:
                kinds.setdefault(units, cell.folder)
    if len(kinds) > 1:
        (units, one), (others, other) = list(kinds.items())[:2]
        raise ResultsError(
            f"{one} has states with the units {', '.join(units)}, but {other} has {', '.join(others)}: they are of two "
            "tasks; put the one that does not belong there back."
        )
    return visits, next(iter(kinds), ())


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
