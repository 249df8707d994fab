"""Write ``docs/benchmark.md``, what to expect of each method, and its picture.

    sb3-cure experiment fast/benchmark --out results
    python -m benchmarks.step_cost fast/benchmark --out results/fast_benchmark/ms_per_step.json
    python -m benchmarks.table

Reads the cells of ``zoo_configs/experiments/fast/benchmark.yml`` in ``results/fast_benchmark/``, and where one of them
is missing that of ``time_to_return.py`` in ``results/by_the_clock_amx/``, if it has an evaluation at the same step. Of
an arm without any of these, the cells of ``zoo_configs/experiments/fast/dense.yml`` in ``results/fast_dense/`` count.
The random policy is played once and kept in ``results/fast_benchmark/random.csv``, with machine and versions beside it.
"""

import argparse
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import pandas as pd

from benchmarks.public_returns import episode_return
from sb3_cure.evaluation.plots import arm_colors, learning_curves
from sb3_cure.evaluation.result_files import Row, describe_run, write_csv, write_json, write_text
from sb3_cure.experiments.cells import EVAL_SEED
from sb3_cure.experiments.grid import Cell, Grid, load_grid, short_name
from sb3_cure.experiments.results import NOT_RUN

ROOT = Path(__file__).parents[1]
RANDOM = "random"
#: Rows of the table, with what they are
ARMS = {
    RANDOM: "uniformly random actions",
    "sac_ae": "regularised autoencoder, no augmentation",
    "curl": "contrastive head, random shifts",
    "drq": "random shifts, no head, returns of three steps",
    "best": "the recipe of `zoo_configs/fast/best.yml`",
    "best_cure": "the recipe with curiosity, `zoo_configs/fast/best_cure.yml`",
}
#: Arms that were chosen by their returns on a task; the profile that all share was chosen on the first one
TUNED = {
    "cartpole-swingup": ("sac_ae", "curl", "drq", "best", "best_cure"),
    "ball_in_cup-catch": ("best", "best_cure"),
}
#: Arms that are in ``fast/dense`` under other names, with other seeds
DENSE = {"best": "plain", "best_cure": "cure"}
MARK = "\N{DAGGER}"
#: Environment steps [n] and returns [seeds, n]
Curve: TypeAlias = tuple[np.ndarray, np.ndarray]
#: By task and arm
Curves: TypeAlias = dict[str, dict[str, Curve]]
#: By arm, one per task
Texts: TypeAlias = dict[str, list[str]]


def read_cell(paths: Sequence[Path], budget: int) -> pd.DataFrame | None:
    """Read a cell's evaluations.

    :param paths: CSV files that may hold them
    :param budget: Environment steps of the grid
    :return: Rows of the first file that comes so far, up to the budget; None if none does
    """
    for path in paths:
        if path.exists():
            rows = pd.read_csv(path)
            rows = rows[rows.environment_steps <= budget]
            if rows.environment_steps.max() == budget:
                return rows
    return None


def read_arm(results: Path, cells: Sequence[Cell]) -> list[pd.DataFrame]:
    """Read an arm's evaluations on a task.

    :param results: Folder of all results
    :param cells: The grid's cells of this arm and task
    :return: From ``read_cell``, of the seeds that have run
    """
    task, arm, budget = short_name(cells[0].task), cells[0].method, cells[0].budget
    clock, dense = results / "by_the_clock_amx" / task / arm, results / "fast_dense" / task / DENSE.get(arm, arm)
    own = [(results / cell.folder / "eval.csv", clock / f"seed{cell.seed}.csv") for cell in cells]
    for files in (own, [(path,) for path in sorted(dense.glob("seed*/eval.csv"))]):
        read = [rows for paths in files if (rows := read_cell(paths, budget)) is not None]
        if read:
            return read
    return []


def read_random(path: Path, grid: Grid) -> pd.DataFrame:
    """Read the random policy's returns; play it if that was not done.

    :param path: CSV file
    :param grid: Its cells name tasks, seeds and episodes
    :return: A row for each episode
    """
    if not path.exists():
        cells = {(cell.task, cell.seed): cell for cell in grid.cells}.values()
        rows: list[Row] = [
            {"task": short_name(cell.task), "seed": cell.seed, "return": value}
            for cell in cells
            for value in random_returns(cell)
        ]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_csv(path, ("task", "seed", "return"), rows)
        write_json(path.with_suffix(".json"), describe_run())
    return pd.read_csv(path)


def random_returns(cell: Cell) -> list[float]:
    """Play the random policy.

    :param cell: Its task, seed of actions and episodes
    :return: Return of each episode, which begin as in evaluations
    """
    env = gym.make(cell.task, **cell.env_kwargs)
    env.action_space.seed(cell.seed)
    seeds = [EVAL_SEED, *[None] * (cell.eval_episodes - 1)]
    returns = [episode_return(env, lambda _: env.action_space.sample(), seed) for seed in seeds]
    env.close()
    return returns


def pool(means: Sequence[float], stds: Sequence[float]) -> tuple[float, float]:
    """Pool the returns of several evaluations of equally many episodes.

    :param means: Mean of each
    :param stds: Standard deviation of each
    :return: Mean and standard deviation of all episodes
    """
    return float(np.mean(means)), float(np.sqrt(np.mean(np.square(stds)) + np.var(means)))


def cell_text(evaluations: Sequence[pd.DataFrame], n_seeds: int, ms_per_step: float | None) -> str:
    """Format the last evaluations of an arm on a task.

    :param evaluations: From ``read_arm``
    :param n_seeds: Seeds of the grid
    :param ms_per_step: Milliseconds of an agent step, if measured
    :return: Mean and deviation of all episodes, and minutes of training; or that it has not run
    """
    if not evaluations:
        return NOT_RUN
    last = pd.DataFrame([rows.iloc[-1] for rows in evaluations])
    mean, std = pool(last.return_mean, last.return_std)
    text = f"{mean:.0f} ± {std:.0f}"
    if len(last) != n_seeds:
        text += f" (seeds: {len(last)})"
    if ms_per_step is not None:
        text += f", {last.agent_steps.mean() * ms_per_step / 60_000:.0f} min"
    return text


def stack(evaluations: Sequence[pd.DataFrame]) -> Curve:
    """Interpolate the curves of several seeds to the steps of the first.

    :param evaluations: From ``read_arm``
    :return: Environment steps [n] and returns [seeds, n]
    """
    steps = evaluations[0].environment_steps.to_numpy(float)
    return steps, np.stack([np.interp(steps, rows.environment_steps, rows.return_mean) for rows in evaluations])


def collect(results: Path, grid: Grid, costs: dict[str, Any]) -> tuple[Texts, Curves]:
    """Collect what is shown.

    :param results: Folder of all results
    :param grid: The grid
    :param costs: Milliseconds of an agent step, by task and arm (``step_cost.py``)
    :return: Texts of the table, and curves
    """
    budget, n_seeds = grid.description["budget"], len(grid.description["seeds"])
    random = read_random(results / grid.experiment / "random.csv", grid)
    texts: Texts = {arm: [] for arm in ARMS}
    curves: Curves = {}
    for name in grid.description["tasks"]:
        task = short_name(name)
        returns = random["return"][random.task == task]
        texts[RANDOM].append(f"{returns.mean():.0f} ± {returns.std(ddof=0):.0f}")
        of_seed = returns.groupby(random.seed).mean().to_numpy()
        curves[task] = {RANDOM: (np.array([0.0, budget]), np.stack([of_seed, of_seed], axis=1))}
        for arm in list(ARMS)[1:]:
            evaluations = read_arm(results, [cell for cell in grid.cells if (cell.task, cell.method) == (name, arm)])
            cost = costs.get(task, {}).get(arm, {}).get("ms_per_step")
            mark = f" {MARK}" if arm in TUNED.get(task, ()) else ""
            texts[arm].append(cell_text(evaluations, n_seeds, cost) + mark)
            if evaluations:
                curves[task][arm] = stack(evaluations)
    return texts, curves


PAGE = """# What to expect

<!-- Written by `python -m benchmarks.table`: change that file, not this page. -->

Returns of each method after {budget:,} environment steps in the profile of `zoo_configs/fast/` (small images and
networks, for CPUs): mean and standard deviation of all evaluation episodes, {episodes} for each of the seeds {seeds},
with deterministic actions. The highest return is 1000. {minutes}

{table}

{mark} The arm's settings were chosen on this task, with other seeds: expect less elsewhere.

{arms}

`best` and `best_cure` make an update for every second agent step, the others for every one: they learn less from a
step, and take fewer minutes ([how long to a return](speed.md#time-to-a-return)). `drq` is the recipe with an update for
every step, `recipe("fast/best", train_freq=1)`.

![episode return over environment steps]({picture})

Lines are means over seeds, bands one standard deviation; the numbers of seeds are those that have run. These pixels are
not the papers', so that returns compare with each other and not with published ones. The cells are those of
`zoo_configs/experiments/fast/benchmark.yml`. Their raw data is in `results/fast_benchmark/`; those that have not run
there are taken from `results/by_the_clock_amx/` (in bf16, on another CPU), or, with seeds from 220 on, from the
experiment on [dense rewards](../results/curiosity.md) in `results/fast_dense/`.
"""


def write_page(results: Path, page: Path) -> None:
    """Write the page, and its picture into the folder of results.

    :param results: Folder of all results
    :param page: Markdown file
    """
    grid = load_grid("fast/benchmark")
    folder = results / grid.experiment
    file = folder / "ms_per_step.json"
    costs = json.loads(file.read_text()) if file.exists() else {"tasks": {}, "conditions": {}}
    texts, curves = collect(results, grid, costs["tasks"])
    colors = arm_colors(list(ARMS), RANDOM)
    drawn = {task: by_arm for task, by_arm in curves.items() if len(by_arm) > 1} or curves  # not random alone
    learning_curves(folder / "benchmark.png", drawn, colors, "episode return\n(deterministic actions)")
    cpus = sorted({f"{each['processor']} ({each['instructions']})" for each in costs["conditions"].values()})
    minutes = "Minutes: agent steps times the CPU time of one, on one thread of " + ", ".join(cpus) + "."
    lines = [f"| | {' | '.join(curves)} |", "|---" * (1 + len(curves)) + "|"]
    lines += [f"| `{arm}` | {' | '.join(cells)} |" for arm, cells in texts.items()]
    text = PAGE.format(
        budget=grid.description["budget"],
        episodes=grid.cells[0].eval_episodes,
        seeds=", ".join(map(str, grid.description["seeds"])),
        minutes=minutes if cpus else "Minutes of training: not measured.",
        table="\n".join(lines),
        mark=MARK,
        arms="\n".join(f"- `{arm}`: {what}" for arm, what in ARMS.items()),
        picture=os.path.relpath(folder / "benchmark.png", page.parent),
    )
    write_text(page, text)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page.

    :param arguments: Command line, ``sys.argv`` by default
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=ROOT / "results", help="folder of all results")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmark.md", help="file to write")
    options = parser.parse_args(arguments)
    write_page(options.results, options.page)


if __name__ == "__main__":
    main()
