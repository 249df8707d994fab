"""What policies meet and where they go, against values computed by hand."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results_for_tests import write_cell, write_grid
from scipy import stats

from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import read_results
from sb3_cure.experiments.visit_statistics import (
    GRID_INTERVALS,
    occupied_cells,
    state_coverage,
    summarise_errors,
)

TASK = "cartpole-swingup"


def test_error_ratio_is_geometric_mean(tmp_path: Path) -> None:
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
    assert (random.error_min, random.mean, random.error_max) == pytest.approx((0.001, 0.003, 0.008))
    assert curious.mean == pytest.approx(0.003 * 6.5) and curious.error_max == pytest.approx(1.05)
    assert curious.ratio.value == pytest.approx(6)
    spread = stats.t.ppf(0.975, 1) * np.log(9 / 4) / 2
    assert curious.ratio.high == pytest.approx(6 * np.exp(spread))
    assert np.isnan(random.ratio.value) and np.isnan(curious.task_ratio.value)


def test_task_ratio_pairs_seeds_with_baseline(tmp_path: Path) -> None:
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
            rows += [(actor, head, 0, error, error, error, 1) for head in ("common", "mean_image")]
            states = {"random": still, actor: visited}
            write_cell(folder, TASK, method, seed, {}, visitation=rows, states=states)
    (experiment,) = read_results(folder)
    errors = {(row.head, row.method, row.actor): row.task_ratio for row in summarise_errors(experiment)}
    # Own heads and mean images of two agents are two yardsticks.
    compared = ("common", "cure_sac_ae", "curious")
    assert errors[compared].value == pytest.approx(np.sqrt(18))
    assert np.isnan([errors[key].value for key in errors if key != compared]).all()
    coverage = {(row.method, row.actor): row.task_ratio for row in state_coverage(experiment)}
    assert coverage["cure_sac_ae", "curious"].value == pytest.approx(3)
    assert np.isnan([coverage[key].value for key in coverage if key != ("cure_sac_ae", "curious")]).all()


def test_coverage_ignores_where_others_went(tmp_path: Path) -> None:
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
        found.append((rows["calm", "random"].values[0], rows["calm", "curious"].values[0]))
    assert found[0] == found[1] and found[0][1] > 1.3 * found[0][0]
    assert rows["wild", "curious"].values[0] == pytest.approx((50 + 50 + 1) / 3)


def test_coverage_counts_equally_many_states(tmp_path: Path) -> None:
    """Random stays in one corner, curious visits two opposite ones; a longer run does not count for more."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation", seeds=1)
    corners = np.array([[0.0, 0.0], [1.0, 1.0]])  # a policy that stays in one point has no range: cells of size 1
    states = {"random": np.repeat(corners[:1], 100, axis=0), "curious": np.tile(corners, (200, 1))}
    write_cell(folder, TASK, "cure_sac_ae", 0, {}, states=states)
    random, curious = state_coverage(read_results(folder)[0])
    assert (random.actor, random.values.tolist()) == ("random", [1])
    assert (curious.actor, curious.values.tolist(), curious.steps, curious.dimensions) == ("curious", [2], 100, 2)
    assert curious.ratio == statistics.Estimate(2, None, None, 1) and np.isnan(random.ratio.value)


def test_random_policy_covers_as_much_in_each_arm(tmp_path: Path) -> None:
    """All arms of a seed have its episodes; of longer ones as many states are drawn as of the shortest."""
    rng, arms = np.random.default_rng(0), ("calm", "wild")
    write_grid(tmp_path, kind="visitation", seeds=1, methods={name: {} for name in arms}, baseline="calm")
    states = {"random": rng.normal(0, 1, (2000, 2)), "task": rng.normal(0, 1, (300, 2))}
    for method in arms:
        write_cell(tmp_path, TASK, method, 0, {}, states=states)
    rows = {(row.method, row.actor): row.values[0] for row in state_coverage(read_results(tmp_path)[0])}
    assert rows["calm", "random"] == rows["wild", "random"] and rows["calm", "task"] == rows["wild", "task"]


@given(st.integers(1, 4), st.integers(1, 60), st.integers(0, 1000))
def test_cells_are_counted_by_pair(dimensions: int, n: int, seed: int) -> None:
    """As when cells are told apart one by one; every state is in one cell of each pair."""
    states = np.random.default_rng(seed).normal(0, 3, (n, dimensions))
    low, width = np.full(dimensions, -1.0), np.linspace(0.5, 2, dimensions)
    pairs = list(itertools.combinations(range(dimensions), 2)) or [(0, 0)]
    found = occupied_cells(states, low, width)
    for (i, j), count in zip(pairs, found, strict=True):
        assert count == len({tuple(np.floor((state[[i, j]] - low[[i, j]]) / width[[i, j]])) for state in states})


def test_cells_of_angles_close_the_circle(tmp_path: Path) -> None:
    """However often an angle is passed from pi to -pi, and whatever the random policy reaches."""
    folder = tmp_path / "visitation"
    write_grid(folder, kind="visitation", seeds=1)
    angles = np.linspace(-np.pi, np.pi, 2000)
    states = {"random": np.full((2000, 2), [3.1, 0.0]), "curious": np.stack([angles, 0 * angles], axis=1)}
    write_cell(folder, TASK, "cure_sac_ae", 0, {}, states=states, state_units=["rad", "rad/s"])
    random, curious = state_coverage(read_results(folder)[0])
    assert (random.values.tolist(), curious.values.tolist()) == ([1], [GRID_INTERVALS])
