"""Turn learning curves into numbers: areas, steps to a return, paired differences.

Intervals are 95 %, Student's t over the pairs (seeds) of one task: wide with two or three seeds, as they should be.
Nothing is averaged over tasks, whose returns may have other scales: see rliable for that.
"""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pandas as pd
from scipy import integrate, stats

from sb3_cure.experiments.results import Experiment

#: By task and arm: environment steps [n] and values [seeds, n]
Curves: TypeAlias = dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]
#: Columns of ``summarise_arm`` that are equal where the arms of a seed begin with equal weights
_STARTS = ["start_return", "start_error"]


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


def steps_to_return(experiment: Experiment, task: str, method: str, limit: float) -> np.ndarray:
    """Environment steps of the first evaluation at or above a return, after training has begun.

    :param experiment: An experiment
    :param task: Short name of the task
    :param method: Name of the arm
    :param limit: The return
    :return: The steps of each seed with a curve, infinite without such an evaluation, [seeds]
    """
    curves = [cell.curve() for cell in experiment.finished_cells(task, method).values()]
    return np.array([next(iter(steps[1:][values[1:] >= limit]), np.inf) for steps, values in curves if len(steps) > 1])


def stack_curves(experiment: Experiment, column: str = "return_mean") -> Curves:
    """Interpolate the curves of the seeds of each arm to common steps, within what all of them span.

    :param experiment: An experiment
    :param column: As for ``CellResult.curve``
    :return: By task and arm, of those with a value in the column: environment steps [n], and values [seeds, n]
    """
    found: Curves = {}
    for task, method in experiment.arms:
        curves = [cell.curve(column) for cell in experiment.finished_cells(task, method).values()]
        # Where a step was evaluated twice, the last value counts
        seeds = [pd.Series(values, steps).groupby(level=0).last() for steps, values in curves if len(steps)]
        if seeds:
            table = pd.concat(seeds, axis=1).sort_index().interpolate("index", limit_area="inside").dropna()
            found.setdefault(task, {})[method] = table.index.to_numpy(), table.to_numpy().T
    return found


def summarise_arm(experiment: Experiment, task: str, method: str) -> pd.DataFrame:
    """Summarise the finished cells of an arm that have a curve.

    :param experiment: An experiment
    :param task: Short name of the task
    :param method: Name of the arm
    :return: By seed: ``area`` under the curve, return of the ``final`` evaluation, mean return of the ``last`` three
        evaluations (without the first one, which is before training), and return (``start_return``) and SRL error
        (``start_error``; nan: not measured) of the first one
    """
    rows = {}
    for seed, cell in experiment.finished_cells(task, method).items():
        steps, values = cell.curve()
        if len(steps) > 1:
            starts = cell.evaluations.reindex(columns=["return_mean", "task_srl_error"]).iloc[0]
            rows[seed] = [area_under_curve(steps, values), values[-1], values[1:][-3:].mean(), *starts]
    columns = ["area", "final", "last", *_STARTS]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns, dtype=float)


def unit_of_errors(experiment: Experiment, task: str, method: str) -> str:
    """Say whose SRL error an arm measures, as errors of different heads cannot be compared.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm with a finished cell
    :return: The head, or ``"reconstruction"`` if the reward has an autoencoder of its own; and whether it is per pixel
    """
    arguments = next(iter(experiment.finished_cells(task, method).values())).config["arguments"]
    if arguments.get("curiosity", "separate") not in ("separate", "bonus"):  # then no reward is made
        return str(arguments.get("srl", "rae"))
    options = arguments.get("intrinsic_kwargs") or {}
    rewards = arguments.get("intrinsic"), options.get("of")  # the latter is what "shuffled" shuffles
    own = "reconstruction" if "reconstruction" in rewards else arguments.get("srl", "rae")
    return f"{own}{', per pixel' if options.get('per_pixel') else ''}"


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
        if self.low == self.high:
            return "inconclusive (all pairs equal)"
        return "better" if self.low > 0 else "worse" if self.high < 0 else "inconclusive"


def t_interval(differences: Collection[float]) -> Estimate:
    """Mean with its 95 % interval of Student's t.

    :param differences: Between two arms, one for each seed
    :return: The estimate; nan of no value, and without an interval of a single one
    """
    values = np.sort(list(differences))  # sorted: sums do not depend on the seeds' order
    n = len(values)
    if n < 2:
        return Estimate(float(values.sum()) if n else float("nan"), n=n)
    # Of equal numbers, the standard error that is computed may not be 0
    reach = float(stats.t.ppf(0.975, n - 1) * stats.sem(values)) if np.ptp(values) else 0.0
    mean = float(values.mean())
    return Estimate(mean, mean - reach, mean + reach, n)


def paired_ratio(ours: Mapping[int, float], theirs: Mapping[int, float]) -> Estimate:
    """Geometric mean of ours / theirs over the seeds that have both, with the t interval of the logarithms.

    :param ours: A positive number by seed
    :param theirs: Another
    :return: The estimate; nan without a common seed, or if one of the numbers is not positive
    """
    pairs = [(ours[seed], theirs[seed]) for seed in ours if seed in theirs]
    if any(min(pair) <= 0 for pair in pairs):
        return Estimate(float("nan"))
    found = t_interval([np.log(mine / other) for mine, other in pairs])
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
    """log(1 + c), where c is the sum of rewards that training met, minus the same of the arm's baseline.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :return: Mean over the seeds that both have done, with its t interval
    """
    ours, theirs = _at_common_end(experiment, task, method, "rewards_met")
    return t_interval([np.log1p(ours[seed]) - np.log1p(theirs[seed]) for seed in ours])


def _at_common_end(experiment: Experiment, task: str, method: str, column: str) -> Iterator[dict[int, float]]:
    """Values of an arm, and of its baseline, by seed, at the last step that both of a pair reached (interpolated)."""
    arms = [experiment.finished_cells(task, arm) for arm in (method, experiment.baseline_of(method))]
    ours, theirs = (
        {seed: curve for seed, cell in cells.items() if len((curve := cell.curve(column))[0])} for cells in arms
    )
    last = {seed: min(ours[seed][0][-1], theirs[seed][0][-1]) for seed in ours if seed in theirs}
    return ({seed: float(np.interp(end, *arm[seed])) for seed, end in last.items()} for arm in (ours, theirs))


def final_values(experiment: Experiment, task: str, method: str, column: str) -> dict[int, float]:
    """Last value of a column, by seed.

    :param experiment: An experiment
    :param task: Short name of a task
    :param method: Name of an arm
    :param column: As for ``CellResult.curve``
    :return: The last value of each finished cell that has one
    """
    curves = {seed: cell.curve(column)[1] for seed, cell in experiment.finished_cells(task, method).items()}
    return {seed: float(values[-1]) for seed, values in curves.items() if len(values)}


def sign_flip_p(differences: np.ndarray) -> float:
    """Two-sided sign-flip test of paired differences, whose mean is 0 if the arms can be exchanged in each pair.

    Exact up to 16 pairs: all signs are tried. With n pairs p is at least 2^(1-n). No distribution is assumed.

    :param differences: Between the arms, [pairs]
    :return: p value
    """
    if len(differences) < 2:  # which scipy refuses: with either sign it is as far from 0
        return 1.0
    # scipy compares with a relative tolerance, so that a sum's rounding does not decide
    found = stats.permutation_test(
        (differences,), np.sum, permutation_type="samples", n_resamples=2**16, vectorized=True, random_state=0
    )
    return float(found.pvalue)


def holm(p_values: Sequence[float]) -> np.ndarray:
    """Correct p values for multiple comparisons by Holm's step-down method.

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
    """Difference between two arms on a task, seed by seed.

    :param method: The arm
    :param other: The arm that is subtracted
    :param task: Short name of the task
    :param differences: One for each seed that both arms have done, [pairs]
    :param same_starts: In how many pairs both arms have the same return and, where both measure that of the same head,
        the same SRL error before training, as they do from equal weights
    """

    method: str
    other: str
    task: str
    differences: np.ndarray
    same_starts: int

    @property
    def pairs(self) -> int:
        return len(self.differences)

    @property
    def wins(self) -> int:
        """In how many pairs the arm is above the baseline."""
        return int((self.differences > 0).sum())

    @property
    def t(self) -> Estimate:
        """Mean difference with its t interval."""
        return t_interval(self.differences)

    @property
    def p(self) -> float:
        """p value of ``sign_flip_p``, not corrected."""
        return sign_flip_p(self.differences)


def paired_differences(experiment: Experiment, measure: str = "area") -> list[PairedDifference]:
    """Every arm minus its baseline, task by task.

    :param experiment: An experiment
    :param measure: ``"area"`` or ``"final"``
    :return: Arm by arm; without those that share no seed with their baseline
    """
    arms = {arm: summarise_arm(experiment, *arm) for arm in experiment.arms}
    found = []
    for method, task in itertools.product(experiment.methods, experiment.tasks):
        other = experiment.baseline_of(method)
        change = (arms[task, method] - arms[task, other]).dropna(subset=[measure])  # of the seeds that both have
        if method != other and len(change):
            # Returns of sparse tasks are all zero at first: there the SRL error tells equal weights
            has_one_unit = len({unit_of_errors(experiment, task, each) for each in (method, other)}) == 1
            starts = change[_STARTS if has_one_unit else _STARTS[:1]]
            same_starts = int(starts.fillna(0).eq(0).all(axis=1).sum())
            found.append(PairedDifference(method, other, task, change[measure].to_numpy(), same_starts))
    return found
