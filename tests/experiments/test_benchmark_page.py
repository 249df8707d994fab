"""The page of what to expect: what counts as run, and how episodes of several seeds are pooled."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import table
from sb3_cure.experiments.grid import load_grid


def write_cell(path: Path, steps: list[int], returns: list[float]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {"environment_steps": steps, "agent_steps": [step // 8 for step in steps], "return_mean": returns}
    pd.DataFrame({**columns, "return_std": 10.0}).to_csv(path, index=False)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Results with a random policy, which is then not played."""
    rows = [
        (task, seed, 7.0) for task in ("cartpole-swingup", "ball_in_cup-catch", "reacher-easy") for seed in (20, 21)
    ]
    (tmp_path / "fast_benchmark").mkdir()
    pd.DataFrame(rows, columns=["task", "seed", "return"]).to_csv(tmp_path / "fast_benchmark/random.csv", index=False)
    return tmp_path


def row_of(page: str, arm: str) -> list[str]:
    line = next(line for line in page.splitlines() if line.startswith(f"| `{arm}` |"))
    return [text.strip() for text in line.strip("|").split("|")[1:]]


def test_only_cells_at_the_budget_count(results: Path, tmp_path: Path) -> None:
    """One whole cell, one that has stopped before, and one that trained by the clock, beyond the budget."""
    arms = results / "fast_benchmark" / "cartpole-swingup"
    write_cell(arms / "curl" / "seed20" / "eval.csv", [0, 100_000], [20, 500])
    write_cell(arms / "sac_ae" / "seed20" / "eval.csv", [0, 90_000], [20, 300])
    clock = results / "by_the_clock_amx" / "cartpole-swingup" / "best" / "seed20.csv"
    write_cell(clock, [0, 100_000, 200_000], [20, 600, 900])
    table.main(["--results", str(results), "--page", str(tmp_path / "page.md")])
    page = (tmp_path / "page.md").read_text()
    assert row_of(page, "curl") == [f"500 ± 10 (seeds: 1) {table.MARK}", "not run", "not run"]
    assert row_of(page, "sac_ae") == [f"not run {table.MARK}", "not run", "not run"]
    assert row_of(page, "best")[0] == f"600 ± 10 (seeds: 1) {table.MARK}"
    assert row_of(page, "random") == ["7 ± 0"] * 3
    assert (results / "fast_benchmark" / "benchmark.png").exists()


def test_cells_about_dense_rewards_count_where_the_grid_has_none(results: Path, tmp_path: Path) -> None:
    """The recipe has a cell of its own on one task alone; with curiosity it has none."""
    for task in ("cartpole-swingup", "reacher-easy"):
        for arm, value in {"plain": 300, "cure": 400}.items():
            for seed in range(220, 224):
                cell = results / "fast_dense" / task / arm / f"seed{seed}" / "eval.csv"
                write_cell(cell, [0, 100_000], [20, value])
    cell = results / "fast_benchmark" / "reacher-easy" / "best" / "seed21" / "eval.csv"
    write_cell(cell, [0, 100_000], [20, 900])
    table.main(["--results", str(results), "--page", str(tmp_path / "page.md")])
    page = (tmp_path / "page.md").read_text()
    assert row_of(page, "best") == [
        f"300 ± 10 (seeds: 4) {table.MARK}",
        f"not run {table.MARK}",
        "900 ± 10 (seeds: 1)",
    ]
    assert row_of(page, "best_cure")[::2] == [f"400 ± 10 (seeds: 4) {table.MARK}", "400 ± 10 (seeds: 4)"]


def test_pooled_deviation_is_that_of_all_episodes() -> None:
    episodes = np.random.default_rng(0).normal([[0], [5], [9]], size=(3, 10))
    pooled = table.pool(list(episodes.mean(axis=1)), list(episodes.std(axis=1)))
    assert np.allclose(pooled, (episodes.mean(), episodes.std()))


def test_minutes_are_those_of_the_agent_steps() -> None:
    rows = pd.DataFrame({"agent_steps": [0, 12_500], "return_mean": [0.0, 400.0], "return_std": [0.0, 20.0]})
    assert table.cell_text([rows, rows], 2, 48.0) == "400 ± 20, 10 min"


def test_grid_seeds_are_other_ones_than_those_of_tuning() -> None:
    tuned = {cell.seed for name in ("tuning", "bracket") for cell in load_grid(f"fast/{name}").cells}
    assert not tuned & {cell.seed for cell in load_grid("fast/benchmark").cells}
