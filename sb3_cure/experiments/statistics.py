"""Turn learning curves into numbers: areas, steps to a return, paired differences.

Intervals are 95 %: each task's mean difference is drawn from Student's t around the mean of its pairs (seeds), tasks
are averaged with equal weights, and the interval is the middle 95 % of the draws: a parametric bootstrap, stratified by
task. With one task it is the paired t interval, exactly. It is wide with two or three seeds, as it should be.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import integrate, stats

from sb3_cure.experiments.results import CellResult, Experiment

#: Draws of a mean over several tasks
DRAWS = 100_000


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


def restricted_mean(times: np.ndarray, limit: float) -> float:
    """Restricted mean time: what did not happen until the limit counts as the limit.

    Unlike a median, it uses all times, and unlike a mean of the finite ones, it does not favour an arm whose slow seeds
    never get there.

    :param times: Time of each seed, infinite if it did not happen, [seeds]
    :param limit: Time at which all were last observed
    :return: Mean of min(time, limit); nan without a time
    """
    return float(np.minimum(times, limit).mean()) if len(times) else float("nan")


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
    :param starts: Return and SRL error of the first evaluation by seed, before training; nan: not measured [seeds, 2]
    :param finals: Return of the last evaluation by seed
    :param lasts: Mean return of the last three evaluations by seed
    :param reached: For each threshold the steps of each seed
    """

    seeds: tuple[int, ...]
    areas: np.ndarray
    starts: np.ndarray
    finals: np.ndarray
    lasts: np.ndarray
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
    starts = [cell.evaluations.reindex(columns=["return_mean", "task_srl_error"]).iloc[0] for cell in cells.values()]
    return ArmSummary(
        tuple(cells),
        np.array([area_under_curve(*curve) for curve in curves]),
        np.array(starts, dtype=float).reshape(-1, 2),
        np.array([values[-1] for _, values in curves]),
        np.array([values[-3:].mean() for _, values in curves]),
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


def t_interval(groups: Sequence[np.ndarray]) -> Estimate:
    """Mean of the groups' means, with the stratified t interval that this module's docstring describes.

    Groups of one value have no spread: where others have more, only those count.

    :param groups: Differences between the arms, seed by seed: one array per task
    :return: The estimate; without an interval if every group has a single value
    """
    groups = [np.sort(group) for group in groups if len(group)]  # sorted: sums do not depend on the seeds' order
    judged = [group for group in groups if len(group) > 1] or groups
    value = float(np.mean([group.mean() for group in judged])) if judged else float("nan")
    n = sum(len(group) for group in judged)
    if n == len(judged):  # one value each
        return Estimate(value, n=n)
    if len(judged) == 1:
        reach = float(stats.t.ppf(0.975, n - 1) * stats.sem(judged[0]))
    else:
        rng = np.random.default_rng(0)
        drawn = np.mean([stats.sem(group) * rng.standard_t(len(group) - 1, DRAWS) for group in judged], axis=0)
        # The distribution is symmetric: one quantile of the distance is steadier than two of the ends.
        reach = float(np.percentile(np.abs(drawn), 95))
    return Estimate(value, value - reach, value + reach, n)


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
    """Cells of the true state that an arm reached, over those of its baseline, see ``paired_ratio``.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :return: The ratio
    """
    return paired_ratio(*_at_common_end(experiment, task, method, "cells"))


def rewards_met_difference(experiment: Experiment, task: str, method: str) -> Estimate:
    """log(1 + c), c the sum of rewards that training met, minus that of the arm's baseline.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :return: Mean over the seeds that both have done, with its t interval
    """
    ours, theirs = _at_common_end(experiment, task, method, "rewards_met")
    return t_interval([np.array([np.log1p(ours[seed]) - np.log1p(theirs[seed]) for seed in ours])])


def _at_common_end(experiment: Experiment, task: str, method: str, column: str) -> Iterator[dict[int, float]]:
    """Values of an arm, and of its baseline, by seed: of each pair at the last step at which both were counted."""
    ours, theirs = (
        {seed: cell.curve(column)[1] for seed, cell in experiment.done(task, arm).items()}
        for arm in (method, experiment.baseline_of(method))
    )
    last = {seed: min(len(ours[seed]), len(theirs[seed])) - 1 for seed in ours if seed in theirs}
    return ({seed: float(arm[seed][end]) for seed, end in last.items() if end >= 0} for arm in (ours, theirs))


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


def sign_flip_p(groups: Sequence[np.ndarray]) -> float:
    """Two-sided sign-flip test of paired differences, whose mean is 0 if the arms can be exchanged in each pair.

    Exact up to 16 pairs: all signs are tried. With n pairs p is at least 2^(1-n). No distribution is assumed.

    :param groups: Differences between the arms: one array per task; tasks are weighed evenly
    :return: p value
    """
    weighted = np.concatenate([group / len(group) for group in groups if len(group)] or [np.zeros(0)])
    if len(weighted) < 2:  # which scipy refuses: with either sign it is as far from 0
        return 1.0
    # scipy compares with a tolerance, so that a sum's rounding does not decide
    found = stats.permutation_test(
        (weighted,), np.sum, permutation_type="samples", n_resamples=2**16, vectorized=True, random_state=0
    )
    return float(found.pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Correct p values for their number by Holm's step-down method.

    :param p_values: Of all comparisons, [n]
    :return: Corrected values in the same order, [n]
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)
    corrected = np.empty(len(p))
    corrected[order] = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(corrected, 1)


@dataclass(frozen=True)
class PairedDifference:
    """Difference between two arms, seed by seed.

    :param method: The arm
    :param other: The arm that is subtracted
    :param task: Short name, or None for all tasks together
    :param differences: By task, one value per seed that both arms have done
    :param t: Mean difference with its t interval
    :param same_starts: In how many pairs both arms have the same return and, where both measure it, the same SRL error
        before training, as they do from equal weights
    :param left_out: Tasks with a single pair, which do not count where others have more
    """

    method: str
    other: str
    task: str | None
    differences: dict[str, np.ndarray]
    t: Estimate
    same_starts: int
    left_out: tuple[str, ...] = ()

    @property
    def wins(self) -> int:
        """In how many pairs the arm is above the baseline."""
        return int(sum((values > 0).sum() for values in self.differences.values()))

    @property
    def p(self) -> float:
        """p value of ``sign_flip_p``, not corrected."""
        return sign_flip_p(list(self.differences.values()))

    @property
    def pairs(self) -> int:
        return sum(len(values) for values in self.differences.values())


def paired_differences(experiment: Experiment, measure: str = "areas") -> list[PairedDifference]:
    """Every arm minus its baseline: per task, and over all tasks where there are several.

    :param experiment: An experiment
    :param measure: ``"areas"`` or ``"finals"``
    :return: Arm by arm, all tasks together first; arms without a single pair are left out
    """
    arms = {arm: summarise_arm(experiment, *arm) for arm in experiment.arms}
    found = []
    for method in experiment.methods:
        other = experiment.baseline_of(method)
        if method == other:
            continue
        by_task, same = {}, {}
        for task in experiment.tasks:
            ours, theirs = arms[task, method], arms[task, other]
            _, mine, its = np.intersect1d(ours.seeds, theirs.seeds, assume_unique=True, return_indices=True)
            if len(mine):
                by_task[task] = getattr(ours, measure)[mine] - getattr(theirs, measure)[its]
                # Returns of sparse tasks are all zero at first: there the SRL error tells equal weights
                first, second = ours.starts[mine], theirs.starts[its]
                same[task] = int(((first == second) | np.isnan(first) | np.isnan(second)).all(axis=1).sum())
        # As t_interval does: count what the interval rests on
        judged = {task: values for task, values in by_task.items() if len(values) > 1} or by_task
        rows: dict[str | None, dict[str, np.ndarray]] = {task: {task: values} for task, values in by_task.items()}
        if len(rows) > 1:
            rows = {None: judged, **rows}
        for name, values in rows.items():
            without = () if name else tuple(task for task in by_task if task not in judged)
            interval, starts_alike = t_interval(list(values.values())), sum(same[task] for task in values)
            found.append(PairedDifference(method, other, name, values, interval, starts_alike, without))
    return found
