"""Numbers of learning curves, against values computed by hand."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from results_for_tests import CURE, TASK, curve, write_cell, write_grid, write_two_arms

from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import read_results

returns = st.floats(-1e3, 1e3, allow_nan=False)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


def test_areas_finals_and_thresholds(results: Path) -> None:
    (experiment,) = read_results(results)
    arm = statistics.summarise_arm(experiment, TASK, "sac_ae")
    assert list(arm.index) == [0, 1]
    np.testing.assert_allclose(arm.area, [50, 100])
    np.testing.assert_allclose(arm.final, [100, 200])
    for limit, steps in ((100, [100_000, 50_000]), (150, [np.inf, 100_000]), (500, [np.inf, np.inf])):
        np.testing.assert_array_equal(statistics.steps_to_return(experiment, TASK, "sac_ae", limit), steps)


def test_return_before_training_is_none_of_the_agents(tmp_path: Path) -> None:
    """An untrained policy may earn much, which reaches and solves nothing."""
    write_grid(tmp_path, seeds=1)
    write_cell(tmp_path, TASK, "sac_ae", 0, {0: 660, 50_000: 465, 100_000: 0})
    (experiment,) = read_results(tmp_path)
    np.testing.assert_allclose(statistics.summarise_arm(experiment, TASK, "sac_ae")["last"], [465 / 2])
    for limit, steps in ((250, 50_000), (500, np.inf)):
        np.testing.assert_array_equal(statistics.steps_to_return(experiment, TASK, "sac_ae", limit), [steps])


def test_equal_starts_are_told_by_the_error(tmp_path: Path) -> None:
    """Returns of a sparse task are zero at first whatever the weights; an arm without errors is told by returns."""
    folder = tmp_path / "curves"
    write_grid(folder, seeds=3)
    for seed, error in enumerate(("0.001", "0.002", "")):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 0))
        cell = write_cell(folder, TASK, "cure_sac_ae", seed, curve(0, 0))
        rows = (cell / "eval.csv").read_text()
        (cell / "eval.csv").write_text(rows.replace(",0.001,", f",{error},"))
    (difference,) = statistics.paired_differences(read_results(folder)[0])
    assert (difference.same_starts, difference.pairs) == (2, 3)


def test_equal_starts_of_different_heads_are_told_by_returns(tmp_path: Path) -> None:
    """Their errors have different units."""
    folder = tmp_path / "curves"
    write_grid(folder, seeds=2)
    for seed, start in enumerate((3, 4)):
        write_cell(folder, TASK, "sac_ae", seed, curve(3, 5))
        cell = write_cell(folder, TASK, "cure_sac_ae", seed, curve(start, 5), arguments={**CURE, "srl": "curl"})
        (cell / "eval.csv").write_text((cell / "eval.csv").read_text().replace(",0.001,", ",0.7,"))
    (difference,) = statistics.paired_differences(read_results(folder)[0])
    assert (difference.same_starts, difference.pairs) == (1, 2)


def test_area_counts_steps_not_evaluations() -> None:
    """Trapezoids: 10 on 0..10, then 5 on average over 90 steps."""
    area = statistics.area_under_curve(np.array([0, 10, 100]), np.array([10.0, 10.0, 0.0]))
    assert area == pytest.approx((10 * 10 + 90 * 5) / 100)


def test_differences_pair_the_seeds(results: Path) -> None:
    """50 and 100: mean 75, standard error 25, t with one degree of freedom."""
    (experiment,) = read_results(results)
    (difference,) = statistics.paired_differences(experiment)
    assert (difference.method, difference.task, difference.wins, difference.pairs) == ("cure_sac_ae", TASK, 2, 2)
    assert difference.t.value == pytest.approx(75)
    assert difference.t.high == pytest.approx(75 + 12.7062 * 25, rel=1e-5)
    assert difference.t.verdict == "inconclusive"
    assert difference.same_starts == 2
    (final,) = statistics.paired_differences(experiment, "final")
    assert final.t.value == pytest.approx(150)


def test_equal_pairs_say_nothing() -> None:
    """Not that chance is ruled out: seeds may agree by saturating. Rounding makes no spread of it."""
    for difference, n in itertools.product((0.0, 0.1, 0.7), (2, 3, 6, 7)):
        assert statistics.t_interval([difference] * n).verdict == "inconclusive (all pairs equal)"


def test_unfinished_cells_are_not_paired(results: Path) -> None:
    """An unfinished cell enters nothing, whatever its files hold; with one pair left there is no interval."""
    (results / TASK / "cure_sac_ae" / "seed1" / "DONE").unlink()
    (results / TASK / "cure_sac_ae" / "seed1" / "eval.csv").write_text("half a li")
    write_cell(results, TASK, "cure_sac_ae", 7, curve(0, 900), arguments=CURE)  # a seed that the baseline has not
    (experiment,) = read_results(results.parent)
    statuses = {(method, seed): cell.status for (_, method, seed), cell in experiment.cells.items()}
    assert statuses["cure_sac_ae", 1] == "unfinished"
    (difference,) = statistics.paired_differences(experiment)
    assert (difference.pairs, difference.t.value, difference.t.low) == (1, 50, None)
    assert difference.t.verdict == "one seed: no interval"


def test_tasks_are_not_mixed(tmp_path: Path) -> None:
    """Differences 0, 20 on one task and 100, 100, 130 on the other: 10 and 110, and no mean of the two."""
    folder = tmp_path / "curves"
    write_grid(folder, tasks=["a/x-y-v0", "a/z-w-v0"], seeds=3)
    for task, differences in {"x-y": (0, 20), "z-w": (100, 100, 130)}.items():
        for seed, difference in enumerate(differences):
            write_cell(folder, task, "sac_ae", seed, curve(100, 100))
            write_cell(folder, task, "cure_sac_ae", seed, curve(100 + difference, 100 + difference))
    rows = statistics.paired_differences(read_results(folder)[0])
    assert [(row.task, row.t.value, row.pairs) for row in rows] == [("x-y", 10, 2), ("z-w", 110, 3)]
    assert [row.same_starts for row in rows] == [1, 0]


def test_t_interval_covers_truth_with_three_seeds() -> None:
    """Three pairs around a true difference of 1, 400 times."""
    intervals = [statistics.t_interval(sample) for sample in np.random.default_rng(0).normal(1, 5, size=(400, 3))]
    hits = sum(interval.low <= 1 <= interval.high for interval in intervals)  # type: ignore[operator]
    assert 0.92 < hits / 400 < 0.98


def test_sign_flips_are_counted_exactly() -> None:
    """Of 8 signs of 1, 2, 3 the sums 6 and -6 are as far from 0; with 3, -2, 4 four of them: 5, -5, 9, -9."""
    assert statistics.sign_flip_p(np.array([1.0, 2.0, 3.0])) == 2 / 8
    assert statistics.sign_flip_p(np.array([3.0, -2.0, 4.0])) == 4 / 8
    assert statistics.sign_flip_p(np.array([5.0])) == 1


def test_holm_steps_down() -> None:
    """3 x .01; then 2 x .03; the largest is at least what was before it; order is kept."""
    np.testing.assert_allclose(statistics.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(statistics.holm([0.9, 0.6]), [1, 1])


def test_ratio_needs_positive_numbers() -> None:
    """An error of zero has no logarithm, and the interval of the other pairs would not be that of all."""
    ours, theirs = {0: 0.2, 1: 0.4, 2: 0.3}, {0: 0.1, 1: 0.1, 3: 0.1}
    assert statistics.paired_ratio(ours, theirs).value == pytest.approx(8**0.5)
    assert np.isnan(statistics.paired_ratio({**ours, 1: 0}, theirs).value)


@settings(deadline=None, max_examples=20)
@given(st.lists(returns, min_size=1, max_size=8), st.randoms())
def test_order_of_seeds_changes_nothing(differences: list[float], random: object) -> None:
    shuffled = list(differences)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert statistics.t_interval(differences) == statistics.t_interval(shuffled)


def test_rewards_met_are_compared_at_the_last_common_step(tmp_path: Path) -> None:
    """The first arm went on beyond the budget: at the budget the second had met ten times as many."""
    write_grid(tmp_path, seeds=[0])
    write_cell(tmp_path, TASK, "sac_ae", 0, {0: 0, 100_000: 0, 200_000: 0}, rewards_met=[0, 9, 999])
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, {0: 0, 100_000: 0}, rewards_met=[0, 99])
    found = statistics.rewards_met_difference(read_results(tmp_path)[0], TASK, "cure_sac_ae")
    assert found.value == pytest.approx(np.log(10))


def test_arms_that_were_evaluated_at_other_steps_are_compared_at_the_same(tmp_path: Path) -> None:
    """Equal rewards at equal steps differ by nothing, however often one of the arms was evaluated."""
    write_grid(tmp_path, seeds=[0])
    write_cell(tmp_path, TASK, "sac_ae", 0, {0: 0, 50_000: 0, 100_000: 0}, rewards_met=[0, 50, 100])
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, {0: 0, 100_000: 0}, rewards_met=[0, 100])
    found = statistics.rewards_met_difference(read_results(tmp_path)[0], TASK, "cure_sac_ae")
    assert found.value == 0


def test_difference_is_from_own_baseline(tmp_path: Path) -> None:
    """Two is above the experiment's baseline, and below the arm that it is compared with."""
    folder = tmp_path / "curves"
    write_grid(folder, seeds=2, methods={"base": {}, "one": {}, "two": {"baseline": "one"}}, baseline="base")
    for method, final in (("base", 100), ("one", 300), ("two", 200)):
        for seed in (0, 1):
            write_cell(folder, TASK, method, seed, curve(0, final))
    differences = statistics.paired_differences(read_results(folder)[0])
    assert [(row.method, row.other, row.t.value) for row in differences] == [("one", "base", 100), ("two", "one", -50)]
