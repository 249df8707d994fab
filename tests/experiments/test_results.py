"""Reading folders of results, and refusing what would give wrong numbers."""

import json
from pathlib import Path

import numpy as np
import pytest
from results_for_tests import CURE, TASK, curve, write_cell, write_grid, write_two_arms

from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import ResultsError, read_results
from sb3_cure.experiments.visit_statistics import state_coverage


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


def test_only_finished_cells_enter_statistics(tmp_path: Path) -> None:
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


def test_experiments_are_found_at_any_depth(tmp_path: Path) -> None:
    """Experiments of one name (100k steps, 500k steps) are named by their folders."""
    for place in ("curves", "500k/curves"):
        write_grid(tmp_path / place)
    assert [experiment.name for experiment in read_results(tmp_path)] == ["500k/curves", "curves"]
    assert [experiment.name for experiment in read_results(tmp_path / "500k" / "curves")] == ["curves"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("grid.json", "{"),
        ("grid.json", '{"experiment": "x"}'),
        ("run.json", ""),
        ("config.json", '{"task": "a/other-v0"}'),
        ("eval.csv", "environment_steps\n1\n"),
        ("eval.csv", "environment_steps,return_mean\n0,x\n"),
        ("eval.csv", ""),
        ("eval.csv", "environment_steps,return_mean\n0,1\n200000,1\n100000,2\n"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n90000,2\n"),
        ("eval.csv", "environment_steps,return_mean\n9,1\n100000,2\n"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n50000,\n100000,2\n"),
    ],
)
def test_damaged_files_are_named(results: Path, name: str, content: str) -> None:
    path = results / name if name == "grid.json" else results / TASK / "sac_ae" / "seed0" / name
    path.write_text(content)
    with pytest.raises(ResultsError, match=name):
        read_results(results)


def test_missing_curve_of_finished_cell_is_refused(results: Path) -> None:
    (results / TASK / "sac_ae" / "seed0" / "eval.csv").unlink()
    with pytest.raises(ResultsError, match=r"eval\.csv cannot be read"):
        read_results(results)


@pytest.mark.parametrize(
    ("method", "seed", "settings"),
    [("sac_ae", 1, {"arguments": {"gamma": 0.5}}), ("cure_sac_ae", 0, {"eval_episodes": 3, "arguments": CURE})],
)
def test_cells_of_other_settings_are_refused(results: Path, method: str, seed: int, settings: dict) -> None:
    """Seeds of an arm must share all settings, arms of a task their evaluations."""
    for path in results.rglob("config.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "eval_episodes": 10}))
    write_cell(results, TASK, method, seed, curve(0, 1), **{"eval_episodes": 10, **settings})
    with pytest.raises(ResultsError, match=f"was run with {next(iter(settings))}"):
        read_results(results)


def test_moved_cells_are_refused(results: Path) -> None:
    (results / TASK / "sac_ae" / "seed0").rename(results / TASK / "sac_ae" / "seed7")
    with pytest.raises(ResultsError, match="is of another cell than its folder"):
        read_results(results)


def test_finished_cells_need_their_grid(results: Path, tmp_path: Path) -> None:
    """Else they would be missing in the report without a word."""
    write_grid(results.parent / "another")
    (results / "grid.json").unlink()
    with pytest.raises(ResultsError, match=r"curves holds finished cells, but no grid\.json"):
        read_results(results.parent)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ResultsError, match="holds no experiment"):
        read_results(tmp_path / "empty")


def test_states_of_two_tasks_are_refused(tmp_path: Path) -> None:
    write_grid(tmp_path, kind="visitation")
    walk = np.random.default_rng(0).normal(size=(50, 2))
    rows = [("random", "own", 0, 1, 1, 1, 1)]
    path = write_cell(tmp_path, TASK, "sac_ae", 0, {}, visitation=rows, states={"random": walk})
    units = ("rad", "rad/s")
    write_cell(tmp_path, TASK, "sac_ae", 1, {}, visitation=rows, states={"random": walk}, state_units=units)
    with pytest.raises(ResultsError, match=r"seed0 has .* units m, m, but \S+seed1 has .* units rad, rad/s"):
        state_coverage(read_results(tmp_path)[0])
    (path / "visits.npz").write_bytes(b"PK no zip")
    with pytest.raises(ResultsError, match=r"visits\.npz cannot be read"):
        state_coverage(read_results(tmp_path)[0])
