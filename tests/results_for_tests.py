"""Folders of results as experiments write them, with chosen numbers."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

EVAL_COLUMNS = (
    "environment_steps", "agent_steps", "updates", "seconds", "return_mean", "return_std",
    "task_srl_error", "curious_return_mean", "curious_srl_error", "rewards_met",
)  # fmt: skip
RAE = {"policy": "CnnPolicy", "srl": "rae", "curiosity": None}
CURE = {"policy": "CnnPolicy", "srl": "rae"}


TASK = "cartpole-swingup"


def write_grid(folder: Path, **changes: Any) -> dict[str, Any]:
    """A grid of one task, two arms and two seeds, but for the changes.

    :param folder: Folder of the experiment
    :param changes: Keys of ``grid.json``
    :return: The grid
    """
    grid: dict[str, Any] = {
        "experiment": folder.name,
        "kind": "curves",
        "budget": 100_000,
        "seeds": [0, 1],
        "tasks": ["dmc_pixels/cartpole-swingup-v0"],
        "methods": {"sac_ae": {"config": "../sac_ae.yml"}, "cure_sac_ae": {"config": "../cure_sac_ae.yml"}},
        "baseline": "sac_ae",
        "evaluation": {"every": 10_000, "episodes": 10},
        **changes,
    }
    if isinstance(grid["seeds"], int):
        grid["seeds"] = list(range(grid["seeds"]))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "grid.json").write_text(json.dumps(grid))
    return grid


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])


def write_cell(
    folder: Path,
    task: str,
    method: str,
    seed: int,
    curve: Mapping[int, float],
    *,
    arguments: Mapping[str, Any] = RAE,
    budget: int = 100_000,
    done: bool = True,
    visitation: Sequence[Sequence[Any]] = (),
    states: Mapping[str, np.ndarray] | None = None,
    state_units: Sequence[str] | None = None,
    curious: bool = False,
    rewards_met: float | str | Sequence[float] = "",
    **config: Any,
) -> Path:
    """One cell.

    :param folder: Folder of the experiment
    :param task: Short name
    :param method: Arm
    :param seed: Seed
    :param curve: Return by environment steps
    :param arguments: CuReSAC's arguments
    :param budget: Environment steps
    :param done: Whether it is marked as finished
    :param visitation: Rows of ``visitation.csv``: actor, head, episode, min, mean, max, return
    :param states: True states by actor
    :param state_units: Units of their coordinates
    :param curious: Whether the columns of a curious actor are filled
    :param rewards_met: Rewards that training met, in all rows or until each
    :param config: Further keys of ``config.json``
    :return: Its folder
    """
    cell = folder / task / method / f"seed{seed}"
    cell.mkdir(parents=True, exist_ok=True)
    content = {
        "experiment": folder.name, "task": f"dmc_pixels/{task}-v0", "method": method, "seed": seed, "budget": budget,
        "action_repeat": 8, "n_envs": 1, "env_kwargs": {}, "arguments": dict(arguments), **config,
    }  # fmt: skip
    (cell / "config.json").write_text(json.dumps(content))
    run = {
        "versions": {"sb3_cure": "0.1.0", "torch": "2.13.0"}, "machine": "x86_64, 2 threads, AVX512", "device": "cpu",
        "precision": "bf16", "commit": "abc1234", "started": "2026-01-01T00:00:00", "finished": "2026-01-01T01:00:00",
        "seconds": 3600.0, "attempts": 1,
    }  # fmt: skip
    (cell / "run.json").write_text(json.dumps(run))
    sums = rewards_met if isinstance(rewards_met, list) else [rewards_met] * len(curve)
    rows = [
        [step, step // 8, step // 8, step / 100, value, 5.0, 0.001]
        + ([value / 2, 0.002] if curious else ["", ""])
        + [met]
        for (step, value), met in zip(curve.items(), sums, strict=True)
    ]
    write_csv(cell / "eval.csv", EVAL_COLUMNS, rows)
    if visitation or states is not None:
        columns = ("actor", "head", "episode", "error_min", "error_mean", "error_max", "return")
        write_csv(cell / "visitation.csv", columns, visitation)
        arrays = {}
        for actor, values in (states or {}).items():
            units = ["m"] * values.shape[1] if state_units is None else state_units
            arrays[f"{actor}_states"], arrays[f"{actor}_errors"] = values, np.zeros(len(values))
            arrays["state_names"] = np.array([f"x{index}" for index in range(values.shape[1])])
            arrays["state_units"] = np.array(units)
        np.savez(cell / "visits.npz", **arrays)
    if done:
        (cell / "DONE").touch()
    return cell


def curve(*values: float) -> dict[int, float]:
    """Evaluations that divide 100 000 environment steps evenly."""
    return {round(100_000 * index / (len(values) - 1)): value for index, value in enumerate(values)}


def write_two_arms(folder: Path) -> None:
    """Two arms and two seeds, all done: areas 50, 100 (baseline) and 100, 200; finals 100, 200 and 200, 400."""
    write_grid(folder)
    for seed in (0, 1):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 50 * (seed + 1), 100 * (seed + 1)))
        write_cell(folder, TASK, "cure_sac_ae", seed, curve(0, 100 * (seed + 1), 200 * (seed + 1)), arguments=CURE)
