"""Folders of results: what is read, and what would make a wrong number."""

from pathlib import Path

import numpy as np
import pytest
from results_for_tests import RAE, TASK, curve, write_cell, write_grid, write_two_arms

from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import ResultsError, read_results
from sb3_cure.experiments.visit_statistics import state_coverage


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


def test_cells_not_run_are_told(tmp_path: Path) -> None:
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
    """Two of one name (100k steps, 500k steps) lie in folders that tell them apart."""
    for place in ("curves", "500k/curves"):
        write_grid(tmp_path / place)
    assert [experiment.name for experiment in read_results(tmp_path)] == ["500k/curves", "curves"]
    assert [experiment.name for experiment in read_results(tmp_path / "500k" / "curves")] == ["curves"]


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("grid.json", "{", "cannot be read"),
        ("grid.json", "[]", "holds a list"),
        ("grid.json", '{"experiment": "x"}', "KeyError"),
        ("eval.csv", "environment_steps\n1\n", "no column 'return_mean'"),
        ("eval.csv", "environment_steps,return_mean\n0,x\n", "'x'"),
        ("eval.csv", "environment_steps,return_mean\n0,1,2\n", "shorter or longer"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n200000,1\n100000,2\n", "do not grow"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n100000,31", "ends within a line"),
        ("eval.csv", b"\xff\xfe\x00", "cannot be read"),
        ("eval.csv", "", "no column"),
        ("eval.csv", "environment_steps,return_mean\n", "evaluations of no environment steps"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n90000,2\n", "from 0 to 90000 environment steps"),
        ("eval.csv", "environment_steps,return_mean\n9,1\n100000,2\n", "from 9 to 100000 environment steps"),
        ("eval.csv", "environment_steps,return_mean\n0,1\n50000,\n100000,2\n", "no return_mean in line 3"),
        ("eval.csv", "environment_steps,return_mean\n0,\n100000,nan\n", "no return_mean in line 2"),
        ("run.json", "", "cannot be read"),
        ("config.json", '{"method": "other", "seed": 0}', "method 'other' and seed 0"),
        ("config.json", '{"task": "a/other-v0"}', "task 'other'"),
        ("config.json", '{"arguments": {"gamma": 1}}', "with {'gamma': 1}"),
    ],
)
def test_damaged_files_are_named(results: Path, name: str, content: str | bytes, reason: str) -> None:
    path = results / name if name == "grid.json" else results / TASK / "sac_ae" / "seed0" / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ResultsError, match=f"seed0.*{reason}" if name == "config.json" else f"{name}.*{reason}"):
        read_results(results)


def test_lost_evaluations_are_refused(tmp_path: Path) -> None:
    """Else what lies between is made up; but evaluations are no denser than rollouts, and fall after them."""
    settings = {"budget": 1000, "eval_every": 100}
    long = {**settings, "n_envs": 8, "arguments": {**RAE, "train_freq": 5}}  # 8 * 8 * 5 = 320 steps per rollout
    for points, config in (({0: 1, 104: 1, 200: 2, **dict.fromkeys(range(300, 1001, 100), 3)}, settings),
                          ({0: 1, 320: 2, 640: 3, 960: 4, 1280: 5}, long)):  # fmt: skip
        write_grid(tmp_path, budget=1000)
        path = write_cell(tmp_path, TASK, "sac_ae", 0, points, **config)
        assert len(read_results(tmp_path)[0].done(TASK, "sac_ae")[0].curve()[0]) == len(points)
        lost, *_ = [step for step in points if step > 0]
        write_cell(
            tmp_path, TASK, "sac_ae", 0, {step: value for step, value in points.items() if step != lost}, **config
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


def test_arms_evaluated_differently_are_refused(tmp_path: Path) -> None:
    """As after folders of two grids were copied into one."""
    write_grid(tmp_path)
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1), eval_every=100_000, eval_episodes=10)
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, curve(0, 1), eval_every=100_000, eval_episodes=3)
    with pytest.raises(ResultsError, match=r"seed0 was run with eval_episodes 3, but .*seed0 with 10, so that they"):
        read_results(tmp_path)


def test_finished_cells_need_their_grid(results: Path) -> None:
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


def test_states_of_two_tasks_are_refused(tmp_path: Path) -> None:
    """Its seed would be missing in the coverage; and states of two tasks would be counted as of one."""
    write_grid(tmp_path, kind="visitation")
    walk = np.random.default_rng(0).normal(size=(50, 2))
    path = write_cell(tmp_path, TASK, "sac_ae", 0, {}, states={"random": walk})
    write_cell(tmp_path, TASK, "sac_ae", 1, {}, states={"random": walk}, state_units=("rad", "rad/s"))
    with pytest.raises(ResultsError, match=r"seed0 has .* units m, m, but \S+seed1 has .* units rad, rad/s"):
        state_coverage(read_results(tmp_path)[0])
    (path / "visits.npz").unlink()
    with pytest.raises(ResultsError, match=r"seed0 is marked as DONE, but has no visits\.npz: remove the cell"):
        read_results(tmp_path)


def test_names_in_grid_stay_inside_folder(results: Path) -> None:
    write_grid(results, methods={"../../secret": {}, "sac_ae": {}})
    with pytest.raises(ResultsError, match="cannot be the name of a folder"):
        read_results(results)
