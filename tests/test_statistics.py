"""Numbers of the report: read from folders of results, against values computed by hand."""

import itertools
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results_for_tests import CURE, RAE, write_cell, write_grid
from scipy import stats

from sb3_cure.experiments import published, statistics
from sb3_cure.experiments.results import ResultsError, read_results
from sb3_cure.experiments.tables import aggregate_table, of_tasks
from sb3_cure.experiments.visit_statistics import (
    GRID_INTERVALS,
    entropy_bits,
    state_coverage,
    summarise_errors,
    visits_by_pair,
)

TASK = "cartpole-swingup"
returns = st.floats(-1e3, 1e3, allow_nan=False)


def curve(*values: float) -> dict[int, float]:
    """Evaluations that divide 100 000 environment steps evenly."""
    return {round(100_000 * index / (len(values) - 1)): value for index, value in enumerate(values)}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two arms and two seeds, all done: areas 50, 100 (baseline) and 100, 200; finals 100, 200 and 200, 400."""
    folder = tmp_path / "curves"
    write_grid(folder)
    for seed in (0, 1):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 50 * (seed + 1), 100 * (seed + 1)))
        write_cell(folder, TASK, "cure_sac_ae", seed, curve(0, 100 * (seed + 1), 200 * (seed + 1)), arguments=CURE)
    return folder


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


def test_only_what_both_arms_finished_is_paired(results: Path) -> None:
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


def test_cells_that_are_missing_or_of_another_budget(tmp_path: Path) -> None:
    folder = tmp_path / "curves"
    write_grid(folder, seeds=[0, 1, 2])
    write_cell(folder, TASK, "sac_ae", 0, curve(0, 10))
    write_cell(folder, TASK, "sac_ae", 1, curve(0, 10), budget=50_000)
    (experiment,) = read_results(folder)
    assert [cell.status for cell in experiment.cells.values()] == [
        "done", "other budget: 50000 steps", "not run", "not run", "not run", "not run",
    ]  # fmt: skip
    assert list(experiment.done(TASK, "sac_ae")) == [0]
    assert statistics.paired_differences(experiment) == []


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


def test_a_task_with_a_single_pair_is_left_out_of_all_counts(tmp_path: Path) -> None:
    """And named: what is counted is what the interval rests on, as in a grid that is half run."""
    write_grid(tmp_path, tasks=["dmc_pixels/cartpole-swingup-v0", "dmc_pixels/finger-spin-v0"], seeds=3)
    for task, seeds, difference in ((TASK, 3, 40), ("finger-spin", 1, -150)):
        for seed in range(seeds):
            write_cell(tmp_path, task, "sac_ae", seed, curve(200, 200))
            write_cell(tmp_path, task, "cure_sac_ae", seed, curve(200, 200 + 2 * difference + seed))
    pooled, cartpole, finger = statistics.paired_differences(read_results(tmp_path)[0])
    assert (pooled.pairs, pooled.wins, pooled.same_starts) == (3, 3, 3) and pooled.left_out == ("finger-spin",)
    assert (pooled.t, cartpole.left_out, finger.pairs) == (cartpole.t, (), 1)
    assert of_tasks(pooled) == "1 task (left out, with a single pair: finger-spin)"


def test_t_interval_covers_what_it_says_with_three_seeds_and_percentiles_do_not() -> None:
    """Three pairs around a true difference of 1, 400 times."""
    samples = np.random.default_rng(0).normal(1, 5, size=(400, 3))
    hits = {"t": 0, "percentile": 0}
    for sample in samples:
        intervals = {
            "t": statistics.t_interval([sample]),
            "percentile": statistics.percentile_interval([sample], draws=500),
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


@given(st.lists(st.tuples(st.integers(1, 10_000), returns), min_size=2, max_size=20))
def test_area_lies_between_lowest_and_highest_return(points: list[tuple[int, float]]) -> None:
    steps = np.cumsum([step for step, _ in points])
    values = np.array([value for _, value in points])
    area = statistics.area_under_curve(steps, values)
    assert values.min() - 1e-6 <= area <= values.max() + 1e-6


@given(st.lists(st.integers(1, 5), min_size=1, max_size=4))
def test_identical_arms_differ_by_nothing(sizes: list[int]) -> None:
    groups = [np.zeros(size) for size in sizes]
    for estimate in (statistics.t_interval(groups, draws=100), statistics.percentile_interval(groups, draws=100)):
        assert estimate.value == 0
        assert (estimate.low, estimate.high) == ((None, None) if max(sizes) == 1 else (0, 0))


@given(st.lists(st.lists(returns, min_size=1, max_size=5), min_size=1, max_size=3), st.randoms())
def test_order_of_seeds_changes_nothing(groups: list[list[float]], random: object) -> None:
    shuffled = [list(group) for group in groups]
    for group in shuffled:
        random.shuffle(group)  # type: ignore[attr-defined]
    for interval in (statistics.t_interval, statistics.percentile_interval):
        first = interval([np.array(group) for group in groups], draws=100)
        assert interval([np.array(group) for group in shuffled], draws=100) == first


@given(st.lists(st.lists(returns, min_size=2, max_size=5), min_size=1, max_size=3))
def test_swapping_the_arms_mirrors_the_interval(groups: list[list[float]]) -> None:
    estimate = statistics.t_interval([np.array(group) for group in groups], draws=100)
    mirrored = statistics.t_interval([-np.array(group) for group in groups], draws=100)
    assert mirrored.value == pytest.approx(-estimate.value, abs=1e-6)
    assert mirrored.low == pytest.approx(-estimate.high, abs=1e-6)  # type: ignore[operator]


def test_rliable_aggregates(tmp_path: Path) -> None:
    """Interquartile mean of 8 scores, profile, probability of improvement; and numpy's generator is left alone."""
    pytest.importorskip("rliable")
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


def test_returns_of_another_scale_are_no_scores(tmp_path: Path) -> None:
    """Pendulum's returns are negative: divided by 1000 they would make an empty profile and a senseless IQM."""
    folder = tmp_path / "curves"
    write_grid(folder)
    for seed in (0, 1):
        for method in ("sac_ae", "cure_sac_ae"):
            write_cell(folder, TASK, method, seed, curve(-1500, -900))
    with pytest.raises(ResultsError, match=f"a return on {TASK} is -900"):
        statistics.aggregate(read_results(folder)[0])


def test_an_arm_may_have_a_baseline_of_its_own(tmp_path: Path) -> None:
    """Two arms that differ in one thing are compared with each other, the others with the experiment's baseline."""
    folder = tmp_path / "curves"
    write_grid(folder, seeds=1, methods={"base": {}, "one": {}, "two": {"baseline": "one"}}, baseline="base")
    for method, final in (("base", 100), ("one", 300), ("two", 340)):
        write_cell(folder, TASK, method, 0, curve(0, final))
    (experiment,) = read_results(folder)
    found = {(row.method, row.other): row.t.value for row in statistics.paired_differences(experiment, "finals")}
    assert found == {("one", "base"): 200, ("two", "one"): 40}


def test_improvement_is_over_an_arms_own_baseline(tmp_path: Path) -> None:
    """Two beats the experiment's baseline always, the one it is compared with never."""
    pytest.importorskip("rliable")
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
    assert ">P(arm > its baseline)" in table.columns
    assert table.note.endswith("Baseline: base, of two one.")


def test_experiments_are_found_at_any_depth(tmp_path: Path) -> None:
    """Two of one name (100k steps, 500k steps) lie in folders that tell them apart."""
    for place in ("curves", "500k/curves"):
        write_grid(tmp_path / place)
    assert [experiment.name for experiment in read_results(tmp_path)] == ["500k/curves", "curves"]
    assert [experiment.name for experiment in read_results(tmp_path / "500k" / "curves")] == ["curves"]


@given(st.integers(2, 6), st.integers(1, 4), st.integers(0, 1000))
def test_measures_are_those_of_rliable(seeds: int, tasks: int, seed: int) -> None:
    """With ties, too: scores are tenths."""
    metrics, library = pytest.importorskip("rliable.metrics"), pytest.importorskip("rliable.library")
    arm, base = np.random.default_rng(seed).integers(0, 11, (2, seeds, tasks)) / 10
    taus = np.linspace(0, 1, 7)
    assert statistics.interquartile_mean(arm) == pytest.approx(metrics.aggregate_iqm(arm))
    expected = metrics.probability_of_improvement(arm, base)
    assert statistics.probability_of_improvement(arm, base) == pytest.approx(expected)
    np.testing.assert_allclose(statistics.share_above(arm, taus), library.score_distributions(arm, taus))


def test_missing_rliable_is_one_sentence(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rliable", None)
    with pytest.raises(ResultsError, match=r"pip install 'sb3-cure\[experiments\]'"):
        statistics.aggregate(read_results(results)[0])


def test_errors_and_their_ratio(tmp_path: Path) -> None:
    """Curious over random: 4 and 9 in the two seeds, 6 in the geometric mean."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation")
    for seed, ratio in enumerate((4.0, 9.0)):
        rows = [
            ("random", "own", 0, 0.001, 0.002, 0.003, 1), ("random", "own", 1, 0.002, 0.004, 0.008, 1),
            ("curious", "own", 0, 0.001, 0.003 * ratio, 0.05 + seed, 1), ("random", "zero", 0, 0.05, 0.05, 0.05, 1),
        ]  # fmt: skip
        write_cell(folder, TASK, "cure_sac_ae", seed, {}, visitation=rows)
    summary = {(row.head, row.actor): row for row in summarise_errors(read_results(folder)[0])}
    assert list(summary) == [("own", "random"), ("own", "curious"), ("zero", "random")]
    random, curious = summary["own", "random"], summary["own", "curious"]
    assert (random.error_min, random.error_mean, random.error_max) == pytest.approx((0.001, 0.003, 0.008))
    assert curious.error_mean == pytest.approx(0.003 * 6.5) and curious.error_max == pytest.approx(1.05)
    assert curious.ratio.value == pytest.approx(6)
    spread = stats.t.ppf(0.975, 1) * np.log(9 / 4) / 2
    assert curious.ratio.high == pytest.approx(6 * np.exp(spread))
    assert np.isnan(random.ratio.value) and np.isnan(curious.task_ratio.value)


def test_curious_policies_are_compared_with_the_baselines_task_policy_of_their_seed(tmp_path: Path) -> None:
    """Errors 8 and 18 over 4 and 2: 2 and 9, whose geometric mean is sqrt(18); cells 3 over 1."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation")
    corners = np.array([[0.0, 0.0], [1.0, 1.0], [9.0, 9.0]])
    still, roaming = np.repeat(corners[:1], 30, axis=0), np.repeat(corners, 10, axis=0)
    for seed, (task, curious) in enumerate(((4.0, 8.0), (2.0, 18.0))):
        for method, actor, error, visited in (
            ("sac_ae", "task", task, still),
            ("cure_sac_ae", "curious", curious, roaming),
        ):
            rows = [("random", "own", 0, 1, 1, 1, 1), (actor, "own", 0, error, error, error, 1)]
            rows += [(actor, "common", 0, error, error, error, 1)]
            states = {"random": still, actor: visited}
            write_cell(folder, TASK, method, seed, {}, visitation=rows, states=states)
    (experiment,) = read_results(folder)
    errors = {(row.head, row.method, row.actor): row.task_ratio for row in summarise_errors(experiment)}
    compared = ("common", "cure_sac_ae", "curious")  # the own heads of two agents are two yardsticks
    assert errors[compared].value == pytest.approx(np.sqrt(18))
    assert np.isnan([errors[key].value for key in errors if key != compared]).all()
    coverage = {(row.method, row.actor): row.task_ratio for row in state_coverage(experiment)}
    assert coverage["cure_sac_ae", "curious"].value == pytest.approx(3)
    assert np.isnan([coverage[key].value for key in coverage if key != ("cure_sac_ae", "curious")]).all()


def test_nobodys_coverage_depends_on_where_other_arms_went(tmp_path: Path) -> None:
    """And what lies beyond the random policy's range is counted in cells of its own, not in those at the border."""
    rng, found = np.random.default_rng(0), []
    near, far = rng.normal(0, 1, (500, 3)), np.repeat(np.arange(50.0), 10)[:, None] * [100.0, 0, 0]
    for others in ((), ("wild",)):
        folder = tmp_path / f"visitation{len(others)}"
        write_grid(
            folder, kind="visitation", seeds=1, methods={name: {} for name in ("calm", *others)}, baseline="calm"
        )
        for method in ("calm", *others):
            curious = 2 * near if method == "calm" else far
            write_cell(folder, TASK, method, 0, {}, states={"random": near, "curious": curious})
        rows = {(row.method, row.actor): row for row in state_coverage(read_results(folder)[0])}
        found.append((rows["calm", "random"].occupied[0], rows["calm", "curious"].occupied[0]))
    assert found[0] == found[1] and found[0][1] > 1.3 * found[0][0]
    assert rows["wild", "curious"].occupied[0] == pytest.approx((50 + 50 + 1) / 3)


def test_coverage_counts_cells_of_equally_many_states(tmp_path: Path) -> None:
    """Random stays in one corner, curious visits two opposite ones; a longer run does not count for more."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation", seeds=1)
    corners = np.array([[0.0, 0.0], [1.0, 1.0]])  # a policy that stays in one point has no range: cells of size 1
    states = {"random": np.repeat(corners[:1], 100, axis=0), "curious": np.tile(corners, (200, 1))}
    write_cell(folder, TASK, "cure_sac_ae", 0, {}, states=states)
    random, curious = state_coverage(read_results(folder)[0])
    assert (random.actor, random.occupied.tolist(), random.entropy.tolist()) == ("random", [1], [0.0])
    assert (curious.actor, curious.occupied.tolist(), curious.steps, curious.dimensions) == ("curious", [2], 100, 2)
    assert curious.entropy[0] == pytest.approx(1, abs=0.02)
    assert curious.ratio == statistics.Estimate(2, None, None, 1) and np.isnan(random.ratio.value)


@given(st.integers(1, 4), st.integers(1, 60), st.integers(0, 1000))
def test_visits_are_counted_for_each_pair_of_coordinates(dimensions: int, n: int, seed: int) -> None:
    """As when cells are told apart one by one; every state is in one cell of each pair."""
    states = np.random.default_rng(seed).normal(0, 3, (n, dimensions))
    low, width = np.full(dimensions, -1.0), np.linspace(0.5, 2, dimensions)
    pairs = list(itertools.combinations(range(dimensions), 2)) or [(0, 0)]
    found = visits_by_pair(states, low, width)
    for (i, j), counts in zip(pairs, found, strict=True):
        cells = [tuple(np.floor((state[[i, j]] - low[[i, j]]) / width[[i, j]])) for state in states]
        assert sorted(counts) == sorted(Counter(cells).values())


def test_cells_of_angles_go_round_the_circle(tmp_path: Path) -> None:
    """However often an angle is passed from pi to -pi, and whatever the random policy reaches."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation", seeds=1)
    angles = np.linspace(-np.pi, np.pi, 2000)
    states = {"random": np.full((2000, 2), [3.1, 0.0]), "curious": np.stack([angles, 0 * angles], axis=1)}
    write_cell(folder, TASK, "cure_sac_ae", 0, {}, states=states, state_units=["rad", "rad/s"])
    random, curious = state_coverage(read_results(folder)[0])
    assert (random.occupied.tolist(), curious.occupied.tolist()) == ([1], [GRID_INTERVALS])


@given(st.lists(st.integers(1, 1000), min_size=1, max_size=30))
def test_entropy_is_at_most_that_of_even_visits(counts: list[int]) -> None:
    assert -1e-9 <= entropy_bits(np.array(counts)) <= np.log2(len(counts)) + 1e-9


def test_comparison_with_published_returns(results: Path) -> None:
    """150 on average where SAC-AE published 311 is below 0.75 of it: suspected; arms with curiosity are not judged."""
    baseline, cure = published.compare_with_published(read_results(results))
    assert (baseline.method, baseline.steps, baseline.ours, baseline.theirs) == ("sac_ae", 100_000, 150, (311, 11))
    assert baseline.suspect and baseline.same_method and baseline.std == pytest.approx(70.71, abs=0.01)
    assert (cure.published_as, cure.same_method, cure.suspect) == ("SAC-AE", False, False)


@pytest.mark.parametrize(("final", "suspect"), [(233.0, True), (233.5, False)])
def test_bar_of_suspicion(tmp_path: Path, final: float, suspect: bool) -> None:
    """0.75 x 311 = 233.25."""
    folder = tmp_path / "curves"
    write_grid(folder)
    write_cell(folder, TASK, "sac_ae", 0, curve(0, final), arguments=RAE)
    (row,) = published.compare_with_published(read_results(folder))
    assert row.suspect is suspect and np.isnan(row.std)


def test_the_papers_tables() -> None:
    """Every task of both tables, and the ratio that the paper calls two orders of magnitude."""
    assert {len(tasks) for tasks in published.PRETRAINING.values()} == {6}
    assert published.PRETRAINING["cure_pretraining"]["ball_in_cup_catch"] == (504, 187)
    assert set(published.SRL_ERROR) == set(published.PRETRAINING["vanilla"])
    ratios = {task: row["curious"].mean / row["random"].mean for task, row in published.SRL_ERROR.items()}
    assert min(ratios.values()) > 100 and ratios["cartpole_swingup"] == pytest.approx(270)
    for policies in published.SRL_ERROR.values():
        assert all(low <= mean <= high for low, mean, high in policies.values())
    assert published.task_key("finger-turn_easy") in published.RETURNS["DrQ-v2"][100_000]


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("grid.json", "{", r"grid\.json is no JSON .*: remove it and run the grid again, which writes it\."),
        ("grid.json", "[]", r"grid\.json holds a list"),
        ("grid.json", '{"experiment": "x"}', r"grid\.json has kind None"),
        ("eval.csv", "environment_steps\n1\n", r"eval\.csv has no column 'return_mean'"),
        ("eval.csv", "environment_steps,return_mean\n0,x\n", r"eval\.csv has 'x' as return_mean in line 2"),
        ("eval.csv", "environment_steps,return_mean\n0,1,2\n", r"eval\.csv has a row that is shorter or longer"),
        ("eval.csv", "environment_steps,return_mean\n8,1\n8,2\n", r"eval\.csv has environment_steps that do not grow"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n100000,31", r"eval\.csv ends within a line"),
        ("eval.csv", b"\xff\xfe\x00", r"eval\.csv cannot be read"),
        ("eval.csv", "", r"eval\.csv has no column 'environment_steps'"),
        ("eval.csv", "environment_steps,return_mean\n", r"evaluations of no environment steps, .* trained for 100000"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n90000,2\n", r"of from 0 to 90000 environment steps"),
        ("eval.csv", "environment_steps,return_mean\n9,1\n100000,2\n", r"of from 9 to 100000 environment steps"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n50000,\n100000,2\n", r"no return_mean in line 3"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n50000,nan\n100000,2\n", r"no return_mean in line 3"),
        ("run.json", "", r"run\.json is no JSON .*: remove the cell's folder and run the grid again\."),
        (
            "config.json",
            '{"method": "other", "seed": 0}',
            r"config\.json is of task .*, method 'other' and seed 0",
        ),
        (
            "config.json",
            '{"task": "a/other-v0"}',
            r"config\.json is of task 'other', .* its folder is not: put",
        ),
        (
            "config.json",
            '{"arguments": {"gamma": 1}}',
            r"seed1 was run with arguments .*seed0 with {'gamma': 1}",
        ),
        ("eval.csv", "environment_steps,return_mean\n0,\n100000,nan\n", r"no return_mean in line 2"),
    ],
)
def test_damaged_files_are_named_in_one_sentence(results: Path, name: str, content: str | bytes, sentence: str) -> None:
    path = results / name if name == "grid.json" else results / TASK / "sac_ae" / "seed0" / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ResultsError, match=sentence) as caught:
        read_results(results)
    assert "\n" not in str(caught.value)


def test_no_row_of_a_finished_curve_may_be_lost(tmp_path: Path) -> None:
    """Else what lies between is made up; but evaluations are no denser than rollouts, and fall after them."""
    settings = {"budget": 1000, "eval_every": 100}
    long = {**settings, "n_envs": 8, "arguments": {**RAE, "train_freq": 5}}  # 8 * 8 * 5 = 320 steps per rollout
    for curve, config in (({0: 1, 104: 1, 200: 2, **dict.fromkeys(range(300, 1001, 100), 3)}, settings),
                          ({0: 1, 320: 2, 640: 3, 960: 4, 1280: 5}, long)):  # fmt: skip
        write_grid(tmp_path, budget=1000)
        path = write_cell(tmp_path, TASK, "sac_ae", 0, curve, **config)
        assert len(read_results(tmp_path)[0].done(TASK, "sac_ae")[0].curve()[0]) == len(curve)
        lost, *_ = [step for step in curve if step > 0]
        write_cell(
            tmp_path, TASK, "sac_ae", 0, {step: value for step, value in curve.items() if step != lost}, **config
        )
        with pytest.raises(ResultsError, match=r"eval\.csv has no evaluation between 0 and \d+ environment steps: "):
            read_results(tmp_path)
    write_grid(tmp_path / "visits", kind="visitation", budget=1000)
    write_cell(tmp_path / "visits", TASK, "sac_ae", 0, {0: 1, 500: 2}, **settings, states={})
    with pytest.raises(ResultsError, match=r"eval\.csv has evaluations of from 0 to 500 environment steps"):
        read_results(tmp_path / "visits")
    (path / "eval.csv").unlink()
    with pytest.raises(ResultsError, match=r"seed0 is marked as DONE, but has no eval\.csv: remove the cell's folder"):
        read_results(tmp_path)


def test_arms_that_were_evaluated_otherwise_are_not_compared(tmp_path: Path) -> None:
    """As after folders of two grids were copied into one."""
    write_grid(tmp_path)
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1), eval_every=100_000, eval_episodes=10)
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, curve(0, 1), eval_every=100_000, eval_episodes=3)
    with pytest.raises(ResultsError, match=r"seed0 was run with eval_episodes 3, but .*seed0 with 10, so that they"):
        read_results(tmp_path)


def test_experiments_without_their_grid_are_not_passed_over(results: Path) -> None:
    """One beside others would be missing in the report, and nobody would see it."""
    write_grid(results.parent / "another")
    (results / "grid.json").unlink()
    with pytest.raises(ResultsError, match=r"curves holds finished cells, but no grid\.json: run the grid again"):
        read_results(results.parent)


def test_damaged_states_and_missing_folders(results: Path, tmp_path: Path) -> None:
    (results / TASK / "sac_ae" / "seed0" / "visits.npz").write_bytes(b"PK no zip")
    with pytest.raises(ResultsError, match=r"visits\.npz cannot be read"):
        state_coverage(read_results(results)[0])
    with pytest.raises(ResultsError, match="is no folder"):
        read_results(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ResultsError, match="holds no experiment"):
        read_results(tmp_path / "empty")


def test_states_of_a_cell_are_not_lost_without_a_word(tmp_path: Path) -> None:
    """Its seed would be missing in the coverage; and states of two tasks would be counted as of one."""
    write_grid(tmp_path, kind="visitation")
    walk = np.random.default_rng(0).normal(size=(50, 2))
    path = write_cell(tmp_path, TASK, "sac_ae", 0, {}, states={"random": walk})
    write_cell(tmp_path, TASK, "sac_ae", 1, {}, states={"random": walk}, state_units=("rad", "rad/s"))
    sentence = r"seed0 has states with the units m, m, but \S+seed1 has rad, rad/s: they are of two tasks; put"
    with pytest.raises(ResultsError, match=sentence):
        state_coverage(read_results(tmp_path)[0])
    (path / "visits.npz").unlink()
    with pytest.raises(ResultsError, match=r"seed0 is marked as DONE, but has no visits\.npz: remove the cell"):
        read_results(tmp_path)


def test_names_in_the_grid_cannot_leave_the_folder(results: Path) -> None:
    write_grid(results, methods={"../../secret": {}, "sac_ae": {}})
    with pytest.raises(ResultsError, match="cannot be the name of a folder"):
        read_results(results)


def test_other_pixels_are_not_judged_by_published_numbers(tmp_path: Path) -> None:
    """The same curves in small grey images get neither a comparison nor a verdict; crops of 100 pixels do, for CURL."""
    crops = {"srl": "curl", "srl_kwargs": {"augmentation": "crop"}}
    for name, arguments, env_kwargs, compared in (
        ("usual", {"srl": "rae"}, {"image_size": 84}, True),
        ("small", {"srl": "rae"}, {"image_size": 36, "grayscale": True}, False),
        ("fast", {"srl": "rae"}, {"renderer": "fast"}, False),
        ("crops", crops, {"image_size": 100}, True),
        ("whole", {"srl": "curl"}, {"image_size": 100}, False),
        ("shifts", {"srl": "curl"}, {}, True),
    ):
        folder = tmp_path / name
        write_grid(folder)
        write_cell(
            folder,
            TASK,
            "sac_ae",
            0,
            curve(0, 50, 100),
            arguments={**arguments, "curiosity": None},
            env_kwargs=env_kwargs,
        )
        (experiment,) = read_results(str(folder))
        rows = published.compare_with_published([experiment])
        assert bool(rows) == compared, name
        assert all(row.same_method == (name != "shifts") for row in rows), "shifts are DrQ's"


@pytest.mark.parametrize(
    ("arguments", "same"),
    [
        ({"gamma": 0.99, "policy_kwargs": {"net_arch": [1024, 1024]}, "buffer_size": 100}, True),
        ({"gamma": 0.98}, False),
        ({"learning_rate": 1e-6}, False),
        ({"policy_kwargs": {"net_arch": [8]}}, False),
        ({"srl_kwargs": {"augmentation": "shift"}}, False),
        ({"train_freq": 4}, False),
    ],
)
def test_other_settings_are_not_the_published_method(tmp_path: Path, arguments: dict[str, Any], same: bool) -> None:
    """Such an arm is no evidence of a bug."""
    write_grid(tmp_path)
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1), arguments={**RAE, **arguments})
    (row,) = published.compare_with_published(read_results(tmp_path))
    assert (row.same_method, row.suspect) == (same, same)


def test_tasks_of_others_have_no_published_numbers(tmp_path: Path) -> None:
    """Even if they have the same short name."""
    write_grid(tmp_path, tasks=["mine/cartpole-swingup-v0"])
    config = write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1)) / "config.json"
    config.write_text(config.read_text().replace("dmc_pixels/", "mine/"))
    assert published.compare_with_published(read_results(tmp_path)) == []
