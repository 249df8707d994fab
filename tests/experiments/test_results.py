"""Reading folders of results, and refusing what would give wrong numbers."""

import json
from pathlib import Path

import pytest
from results_for_tests import CURE, TASK, curve, write_cell, write_grid, write_two_arms

from sb3_cure.cli.usage import UsageError
from sb3_cure.experiments import statistics
from sb3_cure.experiments.results import read_results


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of two arms."""
    write_two_arms(tmp_path / "curves")
    return tmp_path / "curves"


def test_only_finished_cells_enter_statistics(tmp_path: Path) -> None:
    folder = tmp_path / "curves"
    write_grid(folder, seeds=[0, 1, 2])
    write_cell(folder, TASK, "sac_ae", 0, curve(0, 10))
    write_cell(folder, TASK, "sac_ae", 1, curve(0, 10), done=False)
    (experiment,) = read_results(folder)
    assert [cell.status for cell in experiment.cells.values()] == [
        "done", "unfinished", "not run", "not run", "not run", "not run",
    ]  # fmt: skip
    assert list(experiment.finished_cells(TASK, "sac_ae")) == [0]
    assert statistics.paired_differences(experiment) == []


def test_experiments_are_found_at_any_depth(tmp_path: Path) -> None:
    """Experiments of one name (100k steps, 500k steps) are named by their folders."""
    for place in ("curves", "500k/curves"):
        write_grid(tmp_path / place)
    assert [experiment.name for experiment in read_results(tmp_path)] == ["500k/curves", "curves"]
    assert [experiment.name for experiment in read_results(tmp_path / "500k" / "curves")] == ["curves"]


@pytest.mark.parametrize("name", ["grid.json", *(f"{TASK}/sac_ae/seed0/{file}" for file in ("run.json", "eval.csv"))])
@pytest.mark.parametrize("content", ["", "{"])
def test_damaged_files_are_named(results: Path, name: str, content: str) -> None:
    (results / name).write_text(content)
    with pytest.raises(UsageError, match=name):
        read_results(results)


@pytest.mark.parametrize(
    "content",
    [
        "environment_steps\n1\n",
        "environment_steps,return_mean\n0,1\n200000,1\n100000,2\n",
        "environment_steps,return_mean\n0,1\n90000,2\n",
        "environment_steps,return_mean\n9,1\n100000,2\n",
        "environment_steps,return_mean\n0,1\n50000,\n100000,2\n",
    ],
)
def test_curves_that_are_not_whole_are_refused(results: Path, content: str) -> None:
    """Their area would be wrong."""
    (results / TASK / "sac_ae" / "seed0" / "eval.csv").write_text(content)
    with pytest.raises(UsageError, match=r"eval\.csv"):
        read_results(results)


def test_missing_curve_of_finished_cell_is_refused(results: Path) -> None:
    (results / TASK / "sac_ae" / "seed0" / "eval.csv").unlink()
    with pytest.raises(UsageError, match=r"eval\.csv"):
        read_results(results)


@pytest.mark.parametrize(
    ("method", "seed", "settings"),
    [
        ("sac_ae", 1, {"arguments": {"gamma": 0.5}}),
        ("sac_ae", 1, {"budget": 50_000}),
        ("cure_sac_ae", 0, {"eval_episodes": 3, "arguments": CURE}),
        ("another", 0, {"budget": 50_000}),
    ],
)
def test_cells_of_other_settings_are_refused(results: Path, method: str, seed: int, settings: dict) -> None:
    """Seeds of an arm must share all settings, arms of a task their evaluations and budget."""
    for path in results.rglob("config.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "eval_episodes": 10}))
    write_cell(results, TASK, method, seed, curve(0, 1), **{"eval_episodes": 10, **settings})
    with pytest.raises(UsageError, match=f"was run with {next(iter(settings))}"):
        read_results(results)


def test_cells_of_earlier_versions_enter_with_those_of_today(results: Path) -> None:
    """A cell whose version did not write a key had its default."""
    write_cell(results, TASK, "sac_ae", 2, curve(0, 1), algo="cure_sac", pretrain=None)
    assert list(read_results(results)[0].finished_cells(TASK, "sac_ae")) == [0, 1, 2]
    write_cell(results, TASK, "sac_ae", 3, curve(0, 1), algo="cure_tqc", pretrain=None)
    with pytest.raises(UsageError, match=r"seed3 was run with algo 'cure_tqc', but .*seed0 with 'cure_sac'"):
        read_results(results)


def test_arms_that_do_not_train_have_another_budget(results: Path) -> None:
    write_cell(results, TASK, "pretrained", 0, {}, budget=0)
    assert (TASK, "pretrained") in read_results(results)[0].arms


def test_visits_that_are_missing_are_refused(results: Path) -> None:
    """Else ratios would rest on fewer seeds than are said to be done."""
    write_grid(results, kind="visitation")
    with pytest.raises(UsageError, match=r"seed0 has no visitation\.csv"):
        read_results(results)


def test_moved_cells_are_refused(results: Path) -> None:
    (results / TASK / "sac_ae" / "seed0").rename(results / TASK / "sac_ae" / "seed7")
    with pytest.raises(UsageError, match="is of another cell than its folder"):
        read_results(results)


def test_finished_cells_need_their_grid(results: Path, tmp_path: Path) -> None:
    """Else they would be missing in the report without a word."""
    write_grid(results.parent / "another")
    (results / "grid.json").unlink()
    with pytest.raises(UsageError, match=r"curves holds finished cells, but no grid\.json"):
        read_results(results.parent)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="holds no experiment"):
        read_results(tmp_path / "empty")
