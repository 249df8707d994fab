"""The comparison of sequential and joint updates: what it runs, what it keeps, what it says."""

import csv
import json
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import update_modes


def write_cell(folder: Path, srl: str, mode: str, seed: int, value: float) -> None:
    """Nine rows, of which the last three count: their columns are ``value`` - 1, ``value`` and ``value`` + 1."""
    path = folder / srl / mode / f"seed{seed}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = ("environment_steps", *update_modes.MEASURES, "curious_srl_error", "task_srl_error", "seconds")
    rows = [[8 * row, *[value + row - 7] * 3, 2 * (value + row - 7), 0.5 * (value + row - 7), row] for row in range(9)]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def test_table_pairs_arms_by_seed(tmp_path: Path) -> None:
    """Means of the last third, arm beside arm; a seed of which one arm is missing does not count."""
    write_cell(tmp_path, "curl", "sequential", 0, 10)
    write_cell(tmp_path, "curl", "joint", 0, 20)
    write_cell(tmp_path, "curl", "sequential", 3, 30)
    write_cell(tmp_path, "curl", "joint", 3, 60)
    write_cell(tmp_path, "curl", "joint", 4, 1000)
    lines = update_modes.summarise(update_modes.read_cells(tmp_path))
    numbers = {line.split("|")[2].strip(): [float(cell) for cell in line.split("|")[3:-1]] for line in lines[2:]}
    assert numbers == {"0": [10, 20] * 3, "3": [30, 60] * 3, "mean": [20, 40] * 3}


def test_policies_compare_by_error_they_meet(tmp_path: Path) -> None:
    """Errors over the random policy's, counted over all evaluations, and the time at the end of each run."""
    for seed in (0, 1):
        write_cell(tmp_path, "rae", "joint", seed, 20)
    *_, line = update_modes.compare_policies(update_modes.read_cells(tmp_path))
    assert line == "| rae | joint | 2.00 | 0.50 | 18 of 18 | 8 |"


def test_cells_run_once_with_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What exists is kept, what is missing is run, and other settings are refused before anything is run."""
    ran = []

    def run_cell(path: Path, srl: str, update: str, seed: int, steps: int) -> None:
        ran.append((srl, update, seed, steps))
        write_cell(tmp_path, srl, update, seed, 5)

    monkeypatch.setattr(update_modes, "run_cell", run_cell)
    arguments = ["--out", str(tmp_path), "--srl", "rae", "--steps", "50"]
    update_modes.main([*arguments, "--seeds", "1"])
    assert ran == [("rae", "sequential", 1, 50), ("rae", "joint", 1, 50)]
    update_modes.main([*arguments, "--seeds", "1,2"])
    assert ran[2:] == [("rae", "sequential", 2, 50), ("rae", "joint", 2, 50)]
    with pytest.raises(SystemExit):
        update_modes.main(["--out", str(tmp_path), "--srl", "rae", "--steps", "60"])
    assert len(ran) == 4
    assert "| rae | mean |" in (tmp_path / "table.md").read_text()
    assert Image.open(tmp_path / "curves.png").width > 500


def test_cell_trains_on_real_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of an actual run: returns of both policies, the training loss of the head and its measured error."""
    quick = dict(learning_starts=10, warmup_updates=0, batch_size=8)
    monkeypatch.setitem(update_modes.HEADS, "rae", {**update_modes.HEADS["rae"], **quick})
    monkeypatch.setattr(update_modes, "EVALUATIONS", 1)
    monkeypatch.setattr(update_modes, "EPISODES", 1)
    update_modes.run_cell(tmp_path / "seed0.csv", "rae", "joint", 0, 20)
    with (tmp_path / "seed0.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert json.loads((tmp_path / "seed0.json").read_text())["seed"] == 0
    assert (row["agent_steps"], row["environment_steps"]) == ("20", "160")
    assert 0 < float(row["random_srl_error"]) < 0.3 and 0 < float(row["srl_loss"]) < 0.3
    assert float(row["task_return"]) > 0
