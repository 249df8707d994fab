"""What the paper's table of SRL error can mean: beside it, decoders that have learned nothing or little.

    python -m benchmarks.yardsticks --out results/yardsticks

On random episodes of the paper's six tasks, in its pixels: the error of predicting zero (the middle grey) and the mean
image, of autoencoders that are untrained, and of the same ones while they are trained on other random episodes. Writes
``errors.csv`` and ``table.md``, which also says after how many updates an autoencoder errs less than the paper reports
for its curious policy, and what other decoders err that learn nothing of the state, also in an older MuJoCo's pictures
(``zero_decoder.py``).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd

from benchmarks import zero_decoder
from sb3_cure import CuReSAC
from sb3_cure.evaluation.result_files import Row, describe_run, read_rows, write_csv, write_json, write_text
from sb3_cure.evaluation.rollouts import run_episodes, srl_errors
from sb3_cure.experiments.grid import short_name
from sb3_cure.experiments.heads import fit_head, observation_batch
from sb3_cure.experiments.published import SRL_ERROR
from sb3_cure.experiments.tables import NONE, Table
from sb3_cure.experiments.visitation import constant_errors, mean_target

TASKS = ("cartpole-swingup", "finger-spin", "finger-turn_easy", "ball_in_cup-catch", "reacher-easy", "reacher-hard")
#: Numbers of updates after which the autoencoder is measured
UPDATES = (0, 1, 2, 3, 5, 8, 12, 20, 30, 50)
_PAPER = {"random": "random", "cure": "curious"}
COLUMNS = ("task", "predictor", "updates", "seed", "error_min", "error_mean", "error_max")


def measure_task(
    task: str, seeds: Sequence[int], updates: Sequence[int], steps: int, **env_kwargs: object
) -> list[Row]:
    """Measure the predictors on a task.

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


def table(errors: pd.DataFrame, elsewhere: pd.DataFrame) -> Table:
    """Means over seeds with the lowest and the highest error of all frames, a column per task.

    :param errors: ``errors.csv``
    :param elsewhere: ``zero_decoder.csv``: what decoders err that learn nothing of the state, by version of MuJoCo
    :return: These beside the paper's numbers
    """
    tasks = [task for task in TASKS if task in set(errors.task)]
    papers = {task: SRL_ERROR[task.replace("-", "_")] for task in tasks}
    rows = {f"paper: {name}": [_text(*papers[task][actor]) for task in tasks] for name, actor in _PAPER.items()}
    for (mujoco, predictor), own in elsewhere.groupby(["mujoco", "predictor"], sort=False):
        means = own.groupby("task").error_mean.mean()
        rows[f"{predictor}, MuJoCo {mujoco}"] = _texts(own, tasks)
        rows[f"paper's cure / {predictor}, MuJoCo {mujoco}"] = [
            f"{papers[task]['curious'].mean / means[task]:.3g}" if task in means else NONE for task in tasks
        ]
    autoencoder = errors[errors.predictor == "autoencoder"]
    last = autoencoder.updates.max()
    rows["mean image"] = _texts(errors[errors.predictor == "mean_image"], tasks)
    rows["untrained autoencoder"] = _texts(autoencoder[autoencoder.updates == 0], tasks)
    rows[f"autoencoder after {last} updates"] = _texts(autoencoder[autoencoder.updates == last], tasks)
    rows["updates until its error is below the paper's cure"] = []
    for task in tasks:
        curve = autoencoder[autoencoder.task == task].groupby("updates").error_mean.mean()
        below = curve.index[curve < papers[task]["curious"].mean]
        rows["updates until its error is below the paper's cure"].append(f"{below[0]}" if len(below) else f"> {last}")
    lines = [[name, *texts] for name, texts in rows.items()]
    frame = pd.DataFrame(lines, columns=["mean (min to max)", *(f">{task}" for task in tasks)])
    return Table("SRL error: the paper's beside decoders that have learned nothing or little", frame)


def _texts(rows: pd.DataFrame, tasks: Sequence[str]) -> list[str]:
    found = rows.groupby("task").agg({"error_min": "min", "error_mean": "mean", "error_max": "max"})
    return [_text(*found.loc[task]) if task in found.index else NONE for task in tasks]


def _text(low: float, mean: float, high: float) -> str:
    return f"{mean:.4f} ({low:.4f} to {high:.4f})"


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
    others = pd.read_csv(elsewhere) if elsewhere.exists() else pd.DataFrame(columns=zero_decoder.COLUMNS)
    text = table(pd.read_csv(path), others).markdown()
    write_text(options.out / "table.md", text)
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
