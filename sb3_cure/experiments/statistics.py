"""Turn learning curves into numbers: areas, paired differences, aggregates over tasks.

Intervals are 95 %. Two kinds are used, and named wherever they are shown:

- *t*: each task's mean difference is drawn from Student's t around the mean of its pairs (seeds), tasks are averaged
  with equal weights, and the interval is the middle 95 % of the draws: a parametric bootstrap, stratified by task.
  With one task it is the paired t interval, exactly. It is wide with two or three seeds, as it should be.
- *percentile*: seeds are resampled with replacement within each task (Agarwal et al. 2021, ``scipy.stats.bootstrap``).
  It cannot reach beyond the seeds that were run: with 2-5 of them it covers the truth in 50-85 % of cases, not in 95.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy import integrate, stats

from sb3_cure.experiments.results import CellResult, Experiment, ResultsError

#: The highest return of an episode in the DeepMind Control suite: scores are returns divided by it
HIGHEST_RETURN = 1000.0
DRAWS = 100_000
RESAMPLES = 2000


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
    """Environment steps of the first evaluation at or above a return.

    :param steps: Environment steps, [n]
    :param values: Returns, [n]
    :param threshold: A return
    :return: The steps; infinity if there is no such evaluation
    """
    reached = np.flatnonzero(values >= threshold)
    return float(steps[reached[0]]) if len(reached) else float("inf")


def interquartile_range(values: Sequence[float] | np.ndarray) -> float:
    """Interquartile range over seeds.

    :param values: One per seed
    :return: 75th - 25th percentile; nan with fewer than two
    """
    return float(stats.iqr(values)) if len(values) > 1 else float("nan")


def stack_curves(cells: Sequence[CellResult], column: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the curves of several seeds to common steps.

    :param cells: Finished cells
    :param column: As of ``CellResult.curve``
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

    seeds: tuple[int, ...]
    areas: np.ndarray
    starts: np.ndarray
    finals: np.ndarray
    curve_iqr: float
    reached: dict[float, np.ndarray]


def summarise_arm(experiment: Experiment, task: str, method: str, thresholds: Sequence[float] = ()) -> ArmSummary:
    """Summarise an arm on a task.

    :param experiment: An experiment
    :param task: Short name of the task
    :param method: Name of the arm
    :param thresholds: Returns
    :return: Its numbers; empty arrays if no cell with a curve is done
    """
    cells = {seed: cell for seed, cell in experiment.done(task, method).items() if len(cell.curve()[0]) > 1}
    curves = [cell.curve() for cell in cells.values()]
    _, stacked = stack_curves(list(cells.values()))
    spread = float(stats.iqr(stacked, axis=0).mean()) if len(cells) > 1 else float("nan")
    return ArmSummary(
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

    :param value: Its value
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
        """What a difference says: ``"better"``, ``"worse"`` or ``"inconclusive"``."""
        if self.low is None or self.high is None:
            return "one seed: no interval"
        if self.low == self.high == 0:
            return "inconclusive (all pairs equal)"
        return "better" if self.low > 0 else "worse" if self.high < 0 else "inconclusive"


def t_interval(groups: Sequence[np.ndarray], draws: int = DRAWS) -> Estimate:
    """Mean of the groups' means, with the stratified t interval that this module's docstring describes.

    Groups of one value have no spread: where others have more, only those count.

    :param groups: Differences between the arms, seed by seed: one array per task
    :param draws: How many, with more than one group
    :return: The estimate; without an interval if every group has a single value
    """
    judged, estimate = _judged(groups)
    if estimate.n == len(judged):  # one value each
        return estimate
    if len(judged) == 1:
        reach = float(stats.t.ppf(0.975, len(judged[0]) - 1) * stats.sem(judged[0]))
    else:
        rng = np.random.default_rng(0)
        drawn = np.mean([stats.sem(group) * rng.standard_t(len(group) - 1, draws) for group in judged], axis=0)
        # The distribution is symmetric: one quantile of the distance is steadier than two of the ends.
        reach = float(np.percentile(np.abs(drawn), 95))
    return replace(estimate, low=estimate.value - reach, high=estimate.value + reach)


def percentile_interval(groups: Sequence[np.ndarray]) -> Estimate:
    """Mean of the groups' means with the percentile bootstrap, seeds resampled within tasks: too narrow for few seeds.

    :param groups: As in ``t_interval``
    :return: The estimate
    """
    judged, estimate = _judged(groups)
    if estimate.n == len(judged):
        return estimate
    low, high = _bootstrap(_mean_of_means, judged)
    return replace(estimate, low=float(low), high=float(high))


def _bootstrap(statistic: Callable[..., np.ndarray], groups: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """95 % percentile interval, values resampled within each group."""
    found = stats.bootstrap(
        groups, statistic, n_resamples=RESAMPLES, vectorized=True, method="percentile", random_state=0
    )
    return found.confidence_interval


def _mean_of_means(*groups: np.ndarray, axis: int) -> np.ndarray:
    return np.mean([group.mean(axis=axis) for group in groups], axis=0)


def _judged(groups: Sequence[np.ndarray]) -> tuple[list[np.ndarray], Estimate]:
    """The groups that count, and the mean of their means."""
    groups = [np.sort(group) for group in groups if len(group)]  # sorted: sums do not depend on the seeds' order
    judged = [group for group in groups if len(group) > 1] or groups
    value = float(np.mean([group.mean() for group in judged])) if judged else float("nan")
    return judged, Estimate(value, n=sum(len(group) for group in judged))


def paired_ratio(ours: Mapping[int, float], theirs: Mapping[int, float]) -> Estimate:
    """Geometric mean of ours / theirs over the seeds that have both, with the t interval of the logarithms.

    :param ours: A positive number by seed
    :param theirs: Another
    :return: The estimate; nan without a common seed
    """
    ratios = [ours[seed] / theirs[seed] for seed in ours if ours[seed] > 0 and theirs.get(seed, 0) > 0]
    found = t_interval([np.log(ratios)])
    low, high = (None if end is None else float(np.exp(end)) for end in (found.low, found.high))
    return Estimate(float(np.exp(found.value)), low, high, found.n)


def cells_ratio(experiment: Experiment, task: str, method: str) -> Estimate:
    """Cells of the true state that an arm reached in the end, over those of its baseline, see ``paired_ratio``.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :return: The ratio
    """
    arms = method, experiment.baseline_of(method)
    return paired_ratio(*(final_values(experiment, task, arm, "cells") for arm in arms))


def rewards_met_difference(experiment: Experiment, task: str, method: str) -> Estimate:
    """log(1 + c), c the sum of rewards that training met, minus that of the arm's baseline.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :return: Mean over the seeds that both have done, with its t interval
    """
    arms = method, experiment.baseline_of(method)
    ours, theirs = (final_values(experiment, task, arm, "rewards_met") for arm in arms)
    return t_interval([np.array([np.log1p(ours[seed]) - np.log1p(theirs[seed]) for seed in ours if seed in theirs])])


def final_values(experiment: Experiment, task: str, method: str, column: str) -> dict[int, float]:
    """Last value of a column, by seed.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :param column: As of ``CellResult.curve``
    :return: The last value of each finished cell that has one
    """
    curves = {seed: cell.curve(column)[1] for seed, cell in experiment.done(task, method).items()}
    return {seed: float(values[-1]) for seed, values in curves.items() if len(values)}


@dataclass(frozen=True)
class PairedDifference:
    """Difference between two arms, seed by seed.

    :param method: The arm
    :param other: The arm that is subtracted
    :param task: Short name, or None for all tasks together
    :param differences: By task, one value per seed that both arms have done
    :param t: Mean difference with the t interval
    :param percentile: Mean difference with the percentile interval
    :param same_starts: In how many pairs both arms earn the same before training, as they do from equal weights
    :param left_out: Tasks with a single pair, which do not count where others have more
    """

    method: str
    other: str
    task: str | None
    differences: dict[str, np.ndarray]
    t: Estimate
    percentile: Estimate
    same_starts: int
    left_out: tuple[str, ...] = ()

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
    """Every arm minus another: per task, and over all tasks where there are several.

    :param experiment: An experiment
    :param measure: ``"areas"`` or ``"finals"``
    :param baseline: The arm that is subtracted from all others, by default of each its baseline in the grid
    :return: Arm by arm, all tasks together first; arms without a single pair are left out
    """
    arms = {arm: summarise_arm(experiment, *arm) for arm in experiment.arms}
    found = []
    for method in experiment.methods:
        other = baseline or experiment.baseline_of(method)
        by_task, same = {}, {}
        for task in experiment.tasks if method != other and other in experiment.methods else ():
            ours, theirs = arms[task, method], arms[task, other]
            _, mine, its = np.intersect1d(ours.seeds, theirs.seeds, assume_unique=True, return_indices=True)
            if len(mine):
                by_task[task] = getattr(ours, measure)[mine] - getattr(theirs, measure)[its]
                same[task] = int((ours.starts[mine] == theirs.starts[its]).sum())
        # As t_interval does: count what the interval rests on
        judged = {task: values for task, values in by_task.items() if len(values) > 1} or by_task
        rows: list[tuple[str | None, dict[str, np.ndarray]]] = [(None, judged)] if len(by_task) > 1 else []
        for name, row in [*rows, *((task, {task: values}) for task, values in by_task.items())]:
            left_out = tuple(task for task in by_task if name is None and task not in judged)
            starts_alike = sum(same[task] for task in row)
            intervals = t_interval(list(row.values())), percentile_interval(list(row.values()))
            found.append(PairedDifference(method, other, name, row, *intervals, starts_alike, left_out))
    return found


# Aggregates over tasks (Agarwal et al. 2021, as in rliable)


@dataclass(frozen=True)
class Aggregates:
    """Scores (final return / 1000) of all arms over several tasks.

    :param tasks: Tasks that count: those on which every arm that has begun has two or more seeds in common
    :param seeds: Seeds of each task
    :param iqm: Interquartile mean by arm, with the stratified bootstrap's percentile interval
    :param improvement: Probability that a run of the arm beats one of its baseline (seeds not paired), by arm
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
    """Scores of all arms on the tasks that every arm has done, with equally many seeds everywhere.

    :param experiment: An experiment
    :return: Scores [seeds, tasks] by arm, and the tasks; both empty if no task has two seeds of every arm
    """
    cells = [(cell.task, cell.method, cell.seed, cell.curve()[1]) for cell in experiment.finished]
    finals = [(*key, values[-1] / HIGHEST_RETURN) for *key, values in cells if len(values) > 1]
    table = pd.DataFrame(finals, columns=["task", "method", "seed", "score"])
    shared = table.pivot(index=["task", "seed"], columns="method", values="score").dropna()
    counts = shared.groupby("task").size()
    tasks = tuple(task for task in experiment.tasks if counts.get(task, 0) > 1)
    if not tasks:
        return {}, ()
    first = shared.groupby("task").head(min(counts[task] for task in tasks))
    return {
        method: np.stack([first.loc[task, method].to_numpy() for task in tasks], axis=1)
        for method in experiment.methods
        if method in first
    }, tasks


def aggregate(experiment: Experiment) -> Aggregates | None:
    """Aggregate final returns over tasks.

    :param experiment: An experiment
    :return: The aggregates, None if no task has two seeds of every arm
    :raises ResultsError: if there are returns that are no scores between 0 and 1
    """
    scores, tasks = score_matrices(experiment)
    if not scores:
        return None
    for task, values in zip(tasks, np.concatenate(list(scores.values())).T, strict=True):
        if len(wrong := values[(values < -1e-6) | (values > 1 + 1e-6)]):
            raise ResultsError(
                f"scores are returns divided by {HIGHEST_RETURN:.0f}, the highest one of the DeepMind Control "
                f"suite, but a return on {task} is {wrong[0] * HIGHEST_RETURN:.6g}."
            )
    n, taus = len(next(iter(scores.values()))), np.linspace(0, 1, 1001)

    def interval(statistic: Callable[..., Any], *matrices: np.ndarray) -> tuple[Any, Any, Any]:
        columns = [column for matrix in matrices for column in matrix.T]
        low, high = _bootstrap(statistic, columns)
        return statistic(*columns, axis=-1), low, high

    iqm, improvement, profiles = {}, {}, {}
    for method, matrix in scores.items():
        iqm[method] = Estimate(*interval(interquartile_mean, matrix), n)
        profiles[method] = interval(partial(share_above, taus=taus), matrix)
        if method != (other := experiment.baseline_of(method)) and other in scores:
            improvement[method] = Estimate(*interval(probability_of_improvement, matrix, scores[other]), n)
    return Aggregates(tasks, n, iqm, improvement, taus, profiles)


def interquartile_mean(*scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of all scores.

    :param scores: For each task, scores [..., seeds]
    :param axis: The seeds' axis
    :return: The mean, [...]
    """
    return stats.trim_mean(np.concatenate(scores, axis=axis), 0.25, axis=axis)


def probability_of_improvement(*scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """How often a run of an arm beats one of the baseline on the same task (ties count half).

    :param scores: For each task the arm's, then for each task the baseline's [..., seeds]
    :param axis: The seeds' axis, the last
    :return: The probability, [...]
    """
    n = len(scores) // 2
    pairs = zip(scores[:n], scores[n:], strict=True)
    return np.mean([(np.sign(a[..., :, None] - b[..., None, :]).mean((-2, -1)) + 1) / 2 for a, b in pairs], axis=0)


def share_above(*scores: np.ndarray, taus: np.ndarray, axis: int = -1) -> np.ndarray:
    """Share of the scores above each threshold: the performance profile.

    :param scores: For each task, scores [..., seeds]
    :param taus: Thresholds, [n]
    :param axis: The seeds' axis
    :return: The shares, [n, ...]
    """
    together = np.concatenate(scores, axis=axis)
    return np.stack([(together > tau).mean(axis=axis) for tau in taus])
