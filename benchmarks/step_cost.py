"""CPU time of an agent step, arm by arm, of a grid of experiments.

    OMP_NUM_THREADS=1 LP_NUM_THREADS=0 taskset -c 1 python -m benchmarks.step_cost fast/bracket --out step_cost.json

Arms train in turn, a few steps each, so that a slow minute of the machine hits all of them. What counts is the fastest
tenth of the rounds (the 10 % quantile), as other work only adds. It is CPU time of one thread, which is the wall-clock
time of a quiet machine. The warm-up is short and has no burst of updates. Steps and updates are told apart.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import configure

from benchmarks.harness import describe_machine
from sb3_cure.evaluation.result_files import code_commit, write_json
from sb3_cure.experiments.grid import Cell, load_grid, short_name

#: Agent steps without updates, then steps with updates that do not count
WARMUP, UNCOUNTED = 140, 40


class TimedArm:
    """An arm in training, measured in rounds.

    :param cell: The arm
    """

    def __init__(self, cell: Cell):
        changes = dict(learning_starts=WARMUP, warmup_updates=0, buffer_size=5_000, device="cpu")
        self.model = cell.make_model(cell.make_env(), **changes)
        self.model.set_logger(configure(None, []))
        self.train = self.model.train
        self.model.train = self._timed_train  # type: ignore[method-assign]
        self.seconds = 0.0
        self.model.learn(WARMUP + UNCOUNTED)

    def _timed_train(self, *args: Any, **kwargs: Any) -> None:
        start = time.process_time()
        self.train(*args, **kwargs)
        self.seconds += time.process_time() - start

    def measure(self, steps: int) -> dict[str, float]:
        """Measure the CPU time of agent steps.

        :param steps: Agent steps
        :return: CPU milliseconds of an agent step without its updates, and of an update; and updates per step
        """
        self.seconds, updates, start = 0.0, self.model._n_updates, time.process_time()
        self.model.learn(steps, reset_num_timesteps=False)
        collecting, updates = time.process_time() - start - self.seconds, self.model._n_updates - updates
        return {
            "collect_ms": 1e3 * collecting / steps,
            "update_ms": 1e3 * self.seconds / updates,
            "updates_per_step": updates / steps,
        }


def step_costs(cells: Sequence[Cell], steps: int, rounds: int) -> dict[str, dict[str, float]]:
    """Measure arms in turn.

    :param cells: One of each arm, of one task
    :param steps: Agent steps in a round
    :param rounds: How many
    :return: By arm the CPU milliseconds of the fastest tenth of its rounds, by part and together, and the median
    """
    arms = {cell.method: TimedArm(cell) for cell in cells}
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in arms}
    for number in range(rounds):
        for name, arm in arms.items():
            measured[name].append(arm.measure(steps))
        print(f"Round {number + 1} of {rounds}", flush=True)
    costs = {}
    for name, found in measured.items():
        collect, update = (
            float(np.quantile([each[key] for each in found], 0.1)) for key in ("collect_ms", "update_ms")
        )
        per_step = found[0]["updates_per_step"]
        median = statistics.median(each["collect_ms"] + each["update_ms"] * per_step for each in found)
        costs[name] = {
            "ms_per_step": round(collect + update * per_step, 1),
            "collect_ms": round(collect, 2),
            "update_ms": round(update, 2),
            "updates_per_step": per_step,
            "median_ms_per_step": round(median, 1),
        }
    return costs


def main() -> None:
    """Measure the arms of a grid, task by task; other tasks in the file are kept."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", help="YAML file, or the name of one of the package's grids")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--task", action="append", help="one of the grid's tasks (may be repeated; default: all)")
    parser.add_argument("--steps", type=int, default=8, help="agent steps of an arm in a round (default: 8)")
    parser.add_argument("--rounds", type=int, default=60, help="rounds (default: 60)")
    options = parser.parse_args()
    th.set_num_threads(1)
    grid = load_grid(options.grid, tasks=options.task)
    report = json.loads(options.out.read_text()) if options.out.exists() else {"tasks": {}, "conditions": {}}
    for task in dict.fromkeys(cell.task for cell in grid.cells):
        arms = {cell.method: cell for cell in grid.cells if cell.task == task}
        name, load = short_name(task), os.getloadavg()
        report["tasks"][name] = step_costs(list(arms.values()), options.steps, options.rounds)
        measured = {"commit": code_commit(), "steps": options.steps, "rounds": options.rounds, "load_average": load}
        report["conditions"][name] = {**measured, **describe_machine()}
        write_json(options.out, report)


if __name__ == "__main__":
    main()
