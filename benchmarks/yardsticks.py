"""What the paper's table of SRL error can mean: beside it, decoders that have learned nothing or little.

    python -m sb3_cure.experiments.yardsticks --out results/yardsticks

On random episodes of the paper's six tasks, in its pixels: the error of predicting zero (the middle grey) and the mean
image, of autoencoders that are untrained, and of the same ones while they are trained on other random episodes. Writes
``errors.csv`` and ``table.md``, which also says after how many updates an autoencoder errs less than the paper reports
for its curious policy, and what predicting zero errs in an older MuJoCo's pictures (benchmarks/zero_decoder.py).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

from sb3_cure import CuReSAC
from sb3_cure.evaluation import run_episodes, srl_errors
from sb3_cure.experiments.files import Row, describe_run, read_rows, write_csv, write_json, write_text
from sb3_cure.experiments.grid import short_name
from sb3_cure.experiments.heads import fit_head, observation_batch
from sb3_cure.experiments.published import SRL_ERROR, task_key
from sb3_cure.experiments.visitation import constant_errors, mean_target

TASKS = ("cartpole-swingup", "finger-spin", "finger-turn_easy", "ball_in_cup-catch", "reacher-easy", "reacher-hard")
#: Numbers of updates after which the autoencoder is measured
UPDATES = (0, 1, 2, 3, 5, 8, 12, 20, 30, 50)
COLUMNS = ("task", "predictor", "updates", "seed", "error_min", "error_mean", "error_max")


def measure_task(
    task: str, seeds: Sequence[int], updates: Sequence[int], steps: int, **env_kwargs: object
) -> list[Row]:
    """
    :param task: Gymnasium id
    :param seeds: Of autoencoders
    :param updates: When to measure them
    :param steps: Observations to measure on, and as many others to train on
    :param env_kwargs: Arguments of ``gymnasium.make``
    :return: Rows of ``errors.csv``
    """
    env = gym.make(task, **env_kwargs)  # type: ignore[arg-type]
    rows: list[Row] = []
    for seed in seeds:
        model = CuReSAC("CnnPolicy", env, srl="rae", curiosity=None, buffer_size=1, seed=seed)
        seen, trained_on = (next(run_episodes(model, env, 1, "random", seed=first)) for first in (100, 200))
        for episode in (seen, trained_on):
            episode.observations = episode.observations[
                np.linspace(0, len(episode.observations) - 1, steps).astype(int)
            ]

        def add(predictor: str, number: int, errors: np.ndarray, seed: int = seed) -> None:
            values = (short_name(task), predictor, number, seed, errors.min(), errors.mean(), errors.max())
            rows.append(dict(zip(COLUMNS, values, strict=True)))

        if seed == seeds[0]:
            mean_image = mean_target(model, [seen])
            add("zero", 0, constant_errors(model, seen.observations, np.zeros_like(mean_image)))
            add("mean_image", 0, constant_errors(model, seen.observations, mean_image))
        batch = observation_batch(seen.observations, model.device)
        add("autoencoder", 0, srl_errors(model, batch))
        for number in fit_head(model, trained_on.observations, max(updates)):
            if number in updates:
                add("autoencoder", number, srl_errors(model, batch))
    env.close()
    return rows


def table(rows: Sequence[Row], elsewhere: Sequence[Row] = ()) -> list[str]:
    """
    :param rows: Rows of ``errors.csv``
    :param elsewhere: Rows of ``zero_decoder.csv``: zero's error in the pictures of other versions of MuJoCo
    :return: Lines of a Markdown table: means over seeds beside the paper's
    """
    others = [{**row, "predictor": f"zero, MuJoCo {row['mujoco']}", "updates": 0} for row in elsewhere]
    predictors = [*dict.fromkeys(row["predictor"] for row in others), "zero", "mean_image", "autoencoder"]
    columns = ["task", "paper: random", "paper: cure", *predictors[:-2], "mean image", "untrained autoencoder"]
    columns += ["updates until the error is below the paper's cure", "error at the end (updates)"]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for task in dict.fromkeys(row["task"] for row in rows):
        own = [row for row in (*rows, *others) if row["task"] == task]
        constant = [_mean(own, name, 0) for name in predictors]
        published = SRL_ERROR[task_key(task)]
        measured = sorted({row["updates"] for row in own})
        below = [number for number in measured if _mean(own, "autoencoder", number) < published["curious"].mean]
        crossing = str(below[0]) if below else f"more than {measured[-1]}"
        last = f"{_mean(own, 'autoencoder', measured[-1]):.4f} ({measured[-1]})"
        shown = (published["random"].mean, published["curious"].mean, *constant)
        lines.append(f"| {task} | " + " | ".join([*(f"{value:.4f}" for value in shown), crossing, last]) + " |")
    return lines


def _mean(rows: Sequence[Row], predictor: str, updates: int) -> float:
    chosen = [row["error_mean"] for row in rows if (row["predictor"], row["updates"]) == (predictor, updates)]
    return float(np.mean(chosen))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the tasks that are missing, then write the table.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("yardsticks"), help="folder (default: yardsticks)")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "errors.csv"
    rows = read_rows(path) if path.exists() else []
    for task in TASKS:
        if not any(row["task"] == task for row in rows):
            print(task, flush=True)
            rows += measure_task(f"dmc_pixels/{task}-v0", (0, 1), UPDATES, 120)
            write_csv(path, COLUMNS, rows)
            write_json(options.out / "run.json", describe_run())
    elsewhere = options.out / "zero_decoder.csv"
    lines = table(rows, read_rows(elsewhere) if elsewhere.exists() else ())
    write_text(options.out / "table.md", "\n".join(lines) + "\n")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
