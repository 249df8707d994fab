"""Numbers of learning curves, against values computed by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from results_for_tests import CURE, TASK, curve, write_cell, write_grid, write_two_arms
from scipy import stats

from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import ResultsError, read_results
from sb3_cure.experiments.tables import aggregate_table

returns = st.floats(-1e3, 1e3, allow_nan=False)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


def test_areas_finals_and_thresholds(results: Path) -> None:
    (experiment,) = read_results(results)
    arm = statistics.summarise_arm(experiment, TASK, "sac_ae", thresholds=(100, 150, 500))
    assert arm.seeds == (0, 1)
    np.testing.assert_allclose(arm.areas, [50, 100])
    np.testing.assert_allclose(arm.finals, [100, 200])
    # Over two values a, b the range from the 25th to the 75th percentile is |a - b| / 2: 0, 25 and 50 on the curve.
    assert arm.curve_iqr == pytest.approx(25)
    assert statistics.interquartile_range(arm.finals) == pytest.approx(50)
    np.testing.assert_array_equal(arm.reached[100], [100_000, 50_000])
    np.testing.assert_array_equal(arm.reached[150], [np.inf, 100_000])
    np.testing.assert_array_equal(arm.reached[500], [np.inf, np.inf])


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
    assert (difference.percentile.low, difference.percentile.high) == (50, 100)
    assert difference.t.verdict == "inconclusive"
    assert difference.same_starts == 2
    (final,) = statistics.paired_differences(experiment, "finals")
    assert final.t.value == pytest.approx(150)
    (mirrored,) = statistics.paired_differences(experiment, baseline="cure_sac_ae")
    assert (mirrored.method, mirrored.other, mirrored.t.value) == ("sac_ae", "cure_sac_ae", -difference.t.value)


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


def test_several_tasks_count_alike(tmp_path: Path) -> None:
    """Differences 0, 20 on one task and 100, 100, 130 on the other: 10 and 110 make 60, not the mean of all five."""
    folder = tmp_path / "curves"
    write_grid(folder, tasks=["a/x-y-v0", "a/z-w-v0"], seeds=3)
    for task, differences in {"x-y": (0, 20), "z-w": (100, 100, 130)}.items():
        for seed, difference in enumerate(differences):
            write_cell(folder, task, "sac_ae", seed, curve(100, 100))
            write_cell(folder, task, "cure_sac_ae", seed, curve(100 + difference, 100 + difference))
    pooled, *rows = statistics.paired_differences(read_results(folder)[0])
    assert pooled.task is None and [row.task for row in rows] == ["x-y", "z-w"]
    assert pooled.t.value == pytest.approx(60) and pooled.t.n == 5
    assert (pooled.same_starts, rows[0].same_starts, rows[1].same_starts) == (1, 1, 0)
    assert pooled.t.low is not None and pooled.t.high is not None
    assert pooled.t.low < pooled.percentile.low and pooled.t.high > pooled.percentile.high  # type: ignore[operator]


def test_t_interval_covers_truth_with_three_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three pairs around a true difference of 1, 400 times."""
    samples = np.random.default_rng(0).normal(1, 5, size=(400, 3))
    monkeypatch.setattr(statistics, "RESAMPLES", 300)
    hits = {"t": 0, "percentile": 0}
    for sample in samples:
        intervals = {
            "t": statistics.t_interval([sample]),
            "percentile": statistics.percentile_interval([sample]),
        }
        for name, interval in intervals.items():
            hits[name] += interval.low <= 1 <= interval.high  # type: ignore[operator]
    assert hits["t"] / 400 > 0.92
    assert hits["percentile"] / 400 < 0.85


def test_interval_over_tasks_agrees_with_theory() -> None:
    """Many seeds on two tasks: Student's t is normal, the mean of two has the root of the summed variances / 2."""
    groups = [np.random.default_rng(seed).normal(0, scale, 400) for seed, scale in ((0, 1.0), (1, 3.0))]
    estimate = statistics.t_interval(groups)
    expected = stats.norm.ppf(0.975) * np.sqrt(sum(group.var(ddof=1) / 400 for group in groups)) / 2
    assert estimate.high is not None
    assert estimate.high - estimate.value == pytest.approx(expected, rel=0.02)


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4))
def test_identical_arms_differ_by_nothing(sizes: list[int]) -> None:
    groups = [np.zeros(size) for size in sizes]
    for estimate in (statistics.t_interval(groups, draws=100), statistics.percentile_interval(groups)):
        assert estimate.value == 0
        assert (estimate.low, estimate.high) == ((None, None) if max(sizes) == 1 else (0, 0))


@settings(deadline=None, max_examples=20)
@given(st.lists(st.lists(returns, min_size=1, max_size=5), min_size=1, max_size=3), st.randoms())
def test_order_of_seeds_changes_nothing(groups: list[list[float]], random: object) -> None:
    shuffled = [list(group) for group in groups]
    for group in shuffled:
        random.shuffle(group)  # type: ignore[attr-defined]
    for interval in (statistics.t_interval, statistics.percentile_interval):
        first = interval([np.array(group) for group in groups])
        assert interval([np.array(group) for group in shuffled]) == first


def test_aggregates_of_two_arms(tmp_path: Path) -> None:
    """Interquartile mean of 8 scores, profile, probability of improvement; and numpy's generator is left alone."""
    folder = tmp_path / "curves"
    write_grid(folder, tasks=["a/x-y-v0", "a/z-w-v0"], seeds=4)
    for task in ("x-y", "z-w"):
        for seed, (base, final) in enumerate(zip((0, 50, 100, 500), (611, 713, 815, 1000), strict=True)):
            write_cell(folder, task, "sac_ae", seed, curve(0, base))
            write_cell(folder, task, "cure_sac_ae", seed, curve(0, final))
    (experiment,) = read_results(folder)
    state = np.random.get_state()[1].copy()  # type: ignore[index, union-attr]
    aggregates = statistics.aggregate(experiment)
    assert aggregates is not None
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # type: ignore[index]
    assert (aggregates.tasks, aggregates.seeds) == (("x-y", "z-w"), 4)
    assert aggregates.iqm["sac_ae"].value == pytest.approx(0.075)  # of 0 0 .05 .05 .1 .1 .5 .5 the middle four
    assert aggregates.iqm["sac_ae"].low < 0.075 < aggregates.iqm["sac_ae"].high  # type: ignore[operator]
    assert aggregates.improvement == {"cure_sac_ae": statistics.Estimate(1, 1, 1, 4)}
    at = int(np.argmin(np.abs(aggregates.taus - 0.3)))
    assert aggregates.profiles["sac_ae"][0][at] == pytest.approx(0.25)
    falls = aggregates.taus[1:][np.diff(aggregates.profiles["cure_sac_ae"][0]) < 0]
    np.testing.assert_allclose(falls, [0.611, 0.713, 0.815, 1.0], atol=0.002, err_msg="where the scores are")
    assert statistics.aggregate(experiment).iqm == aggregates.iqm  # type: ignore[union-attr]


def test_negative_returns_are_no_scores(tmp_path: Path) -> None:
    """Pendulum's returns are negative: divided by 1000 they would make an empty profile and a senseless IQM."""
    folder = tmp_path / "curves"
    write_grid(folder)
    for seed in (0, 1):
        for method in ("sac_ae", "cure_sac_ae"):
            write_cell(folder, TASK, method, seed, curve(-1500, -900))
    with pytest.raises(ResultsError, match=f"a return on {TASK} is -900"):
        statistics.aggregate(read_results(folder)[0])


def test_improvement_is_over_own_baseline(tmp_path: Path) -> None:
    """Two beats the experiment's baseline always, the one it is compared with never."""
    folder = tmp_path / "curves"
    write_grid(folder, seeds=2, methods={"base": {}, "one": {}, "two": {"baseline": "one"}}, baseline="base")
    for method, final in (("base", 100), ("one", 300), ("two", 200)):
        for seed in (0, 1):
            write_cell(folder, TASK, method, seed, curve(0, final))
    (experiment,) = read_results(folder)
    aggregates = statistics.aggregate(experiment)
    assert aggregates is not None
    assert {method: estimate.value for method, estimate in aggregates.improvement.items()} == {"one": 1, "two": 0}
    table = aggregate_table(experiment, aggregates)
    assert ">P(arm > its baseline)" in table.rows
    assert table.note.endswith("Baseline: base, of two one.")


def test_measures_of_scores_count_ties() -> None:
    """Two tasks, scores by hand: improvement 3.5 of 4 pairs and 1 of 4; the middle half of 1, 2, 3, 10."""
    arm, base = ([0.5, 1.0], [0.0, 0.2]), ([0.5, 0.0], [0.1, 0.3])
    found = statistics.probability_of_improvement(*map(np.array, (*arm, *base)))
    assert found == pytest.approx((3.5 / 4 + 1 / 4) / 2)
    assert statistics.interquartile_mean(np.array([10.0, 1.0]), np.array([3.0, 2.0])) == 2.5
    shares = statistics.share_above(np.array([0.2, 0.4]), np.array([0.4, 0.8]), taus=np.array([0.1, 0.4, 0.9]))
    assert shares.tolist() == [1.0, 0.25, 0.0]
