"""How many minutes of training until a return is reached: ours beside public code, on one thread.

    git clone https://github.com/denisyarats/pytorch_sac_ae     # two more clones: see benchmarks/peers.py
    python -m benchmarks.time_to_return --arms best curl public sb3_sac --seeds 20 21 --public pytorch_sac_ae
    python -m benchmarks.time_to_return --summarise-only

Arms:

- names of files in ``zoo_configs/fast/`` (``best``, ``curl``, ``sac_ae`` ...): ours;
- ``public``: the authors' SAC-AE (as in ``public_returns.py``) with the profile's sizes of networks;
- ``drqv2`` and ``public_curl``: the authors' code (``peers.py``) in the best of its trials, which have the profile's
  sizes of networks and warm-up, and learning rates by two schedules: ``drqv2_{1e-4,3e-4,1e-3}_{easy,medium}`` and
  ``public_curl_{1e-3,2e-3}_{slow,quick}``, on cartpole-swingup, seed 0. The best one has the highest mean return over
  the minutes of training. ``drqv2_own`` and ``public_curl_own``: in their own settings and sizes;
- ``sb3_sac``: SB3's ``SAC("CnnPolicy")`` with its defaults; ``sb3_sac_our_sizes``: with our hidden layers, batch size,
  learning rate and warm-up.

All see the pixels of the fast profile. Each cell (task, arm, seed) runs in a process with one thread until it has
trained for ``--minutes``, or made ``--steps``. A minute is one of CPU time: that of a quiet machine, also beside other
work. The clock runs from before the training environment and the networks are made, and stands still during
evaluations, which begin in the same states in all arms. A cell writes ``<task>/<arm>/seed<k>.csv`` after each
evaluation and ``seed<k>.json`` at its end; without the latter it begins anew. ``summary.csv``, ``table.md`` and
``time_to_return.png`` are made of all finished cells in the folder.

A return is reached at the first evaluation whose mean is at least as high. A seed that does not reach it is censored at
the limit of minutes, also if the steps ended it before. Medians are those of Kaplan and Meier's curves, and p values
those of log-rank tests against ``best``.
"""

import argparse
import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import public_returns
from benchmarks.peers import PEERS, CurlTraining, DrQv2Training, peer_of, trial_arms
from benchmarks.public_returns import PublicTraining, episode_return, public_cell
from benchmarks.public_sac_ae import checkout_folder
from benchmarks.time_summary import COLUMNS, OURS, best_trial, read_runs, write_summary
from sb3_cure.cli.usage import UsageError
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation.result_files import (
    Row,
    checkout_commit,
    describe_run,
    write_csv,
    write_json,
)
from sb3_cure.evaluation.rollouts import untouched_randomness
from sb3_cure.experiments.cells import EVAL_SEED, check_settings, is_evaluation_due
from sb3_cure.experiments.grid import Cell, GridFile, Method, arm_cell, load_grid, short_name
from sb3_cure.networks.allocator import tune_allocator

PUBLIC = public_returns.ARM
SB3 = ("sb3_sac", "sb3_sac_our_sizes")
TASKS = ("cartpole-swingup", "reacher-easy", "finger-spin")
#: More than half an hour's steps
SB3_BUFFER_SIZE = 100_000
#: One thread for each library that may start more
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}

# Cells


def make_cell(arm: str, task: str, seed: int, out: Path) -> Cell:
    """Describe a cell, but for its limits and evaluations.

    :param arm: See above
    :param task: Short name of a task
    :param seed: Seed of weights, warm-up and environment
    :param out: Folder of all results, whose trials decide on a peer's settings
    :return: What to run
    :raises UsageError: if the arm is unknown, or trials are missing
    """
    peer = peer_of(arm)
    zoo = "sac_ae" if peer or arm in (PUBLIC, *SB3) else arm
    name, methods = f"dmc_pixels/{task}-v0", {arm: Method(config=f"fast/{zoo}")}
    grid = GridFile(experiment="time_to_return", kind="curves", budget=1, tasks=[name], methods=methods, seeds=[seed])
    cell = arm_cell(grid, Path(__file__), name, arm)
    if peer:
        return _peer_cell(cell, peer, out)
    if arm == PUBLIC:
        return replace(cell, arguments=public_cell(load_grid(public_returns.GRID).cells[0]).arguments)
    if arm in SB3:
        arguments = {"policy": "CnnPolicy", "buffer_size": SB3_BUFFER_SIZE}
        if arm == "sb3_sac_our_sizes":
            known = {"learning_rate": 1e-3, "batch_size": 128, **cell.arguments}  # the former by default
            arguments |= {name: known[name] for name in ("learning_rate", "learning_starts", "batch_size")}
            arguments["policy_kwargs"] = {"net_arch": known["policy_kwargs"]["net_arch"]}
        return replace(cell, arguments=arguments)
    return cell


def _peer_cell(cell: Cell, name: str, out: Path) -> Cell:
    peer, arm = PEERS[name], best_trial(out, name) if cell.method == name else cell.method
    known = {f"{name}_own": peer.own, **dict(zip(trial_arms(name), peer.trials.values(), strict=True))}
    if arm not in known:
        raise UsageError(f"{arm!r} is no arm of {name}, which has {', '.join((name, *known))}.")
    arguments = {"implementation": peer.source, "settings_of": arm, **known[arm]}
    if name == "drqv2":
        return replace(cell, arguments=arguments)
    size = cell.env_kwargs["image_size"]
    larger = {**cell.env_kwargs, "image_size": 100 * size // 84}
    return replace(cell, arguments={**arguments, "image_size": size}, env_kwargs=larger)


def settings_of(cell: Cell, minutes: float) -> dict[str, Any]:
    """Collect the settings to keep beside the results.

    :param cell: From ``make_cell``
    :param minutes: Its limit
    :return: Settings by name
    """
    names = ("method", "seed", "task", "env_kwargs", "arguments", "budget", "eval_every", "eval_episodes")
    return {**{name: getattr(cell, name) for name in names}, "minutes": minutes, "eval_seed": EVAL_SEED}


class Record:
    """Measure the time of training, and evaluate on schedule with the clock stopped.

    :param path: CSV file to write
    :param cell: What is trained
    :param minutes: Limit in minutes of training
    :param env: Environment of the evaluations
    """

    def __init__(self, path: Path, cell: Cell, minutes: float, env: gym.Env):
        self.path, self.cell, self.minutes, self.env = path, cell, minutes, env
        self.action_repeat = action_repeat_of(env)
        #: Limit in agent steps
        self.total = -(-cell.budget // self.action_repeat)
        self.rows: list[Row] = []
        self._started = self._now()

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.process_time(), time.perf_counter()])

    def times(self) -> tuple[float, float]:
        """Read the clock.

        :return: CPU and wall-clock seconds of training so far
        """
        cpu, wall = self._now() - self._started
        return float(cpu), float(wall)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock for a while."""
        times = self.times()
        yield
        self._started = self._now() - times

    def progress(self, step: int) -> float:
        """Measure the share of the budget that is used up, of steps or of minutes.

        :param step: Agent steps so far
        :return: At least 1 when training ends
        """
        return max(step / self.total, self.times()[0] / (60 * self.minutes))

    def is_time_up(self) -> bool:
        """Whether the limit in minutes is reached."""
        return self.times()[0] >= 60 * self.minutes

    def visit(self, step: int, act: Callable[[np.ndarray], np.ndarray], finished: bool = False) -> None:
        """Evaluate if that is due.

        :param step: Agent steps so far
        :param act: Deterministic policy, from an observation to an action
        :param finished: Whether training has ended, by either limit
        """
        limit = "" if not finished else "steps" if step == self.total else "minutes"
        every = self.cell.eval_every * self.action_repeat
        if is_evaluation_due(self.rows, step * self.action_repeat, every, finished):
            self._evaluate(step, act, limit)
        elif finished:
            self.rows[-1]["limit"] = limit
        else:
            return
        write_csv(self.path, COLUMNS, self.rows)

    def _evaluate(self, step: int, act: Callable[[np.ndarray], np.ndarray], limit: str) -> None:
        seconds = round(self.times()[0], 2)
        with self.paused(), untouched_randomness(th.device("cpu"), EVAL_SEED):
            seeds = range(EVAL_SEED, EVAL_SEED + self.cell.eval_episodes)
            returns = [episode_return(self.env, act, seed) for seed in seeds]
        mean, std = float(np.mean(returns)), float(np.std(returns))
        values = (step, step * self.action_repeat, seconds, mean, std, len(returns), limit)
        self.rows.append(dict(zip(COLUMNS, values, strict=True)))
        name = f"{self.cell.method}, seed {self.cell.seed}"
        print(f"{name}: {step} agent steps, {seconds / 60:.1f} min, return {mean:.1f}", flush=True)


class _Visits(BaseCallback):
    """Evaluates between two agent steps, when all updates are made."""

    def __init__(self, record: Record):
        super().__init__()
        self.record = record

    def _act(self, observation: np.ndarray) -> np.ndarray:
        return self.model.predict(observation, deterministic=True)[0]

    def _on_rollout_start(self) -> None:
        self.record.visit(self.num_timesteps, self._act)

    def _on_step(self) -> bool:
        return not self.record.is_time_up()

    def _on_training_end(self) -> None:
        self.record.visit(self.num_timesteps, self._act, finished=True)


def make_training(cell: Cell, record: Record, clone: Path) -> PublicTraining:
    """Prepare the training of public code.

    :param cell: From ``make_cell``
    :param record: Of this cell
    :param clone: Folder of the code
    :return: Its training
    """
    if cell.method == PUBLIC:
        return PublicTraining(clone, cell)
    if peer_of(cell.method) == "drqv2":
        return DrQv2Training(clone, cell, record.progress)
    return CurlTraining(clone, cell)


def train(cell: Cell, record: Record, clone: Path | None) -> None:
    """Train one cell until either limit.

    :param cell: From ``make_cell``
    :param record: Of this cell
    :param clone: Folder of public code, for the arms that are
    """
    if clone is not None:
        training = make_training(cell, record, clone)
        for step in training.steps():
            record.visit(step, training.act)
            if record.is_time_up():
                break
        record.visit(step, training.act, finished=True)
        return
    env = gym.make(cell.task, **cell.env_kwargs)
    if cell.method in SB3:
        model: Any = SAC(env=env, seed=cell.seed, device="cpu", **cell.build_arguments())
    else:
        model = cell.make_model(env, device="cpu")
    model.learn(record.total, callback=_Visits(record))


def run_cell(out: Path, cell: Cell, minutes: float, clone: Path | None) -> None:
    """Run one cell from its beginning.

    :param out: Folder of all results
    :param cell: From ``make_cell``
    :param minutes: Limit in minutes of training
    :param clone: Folder of public code, for the arms that are
    """
    th.set_num_threads(1)
    tune_allocator()
    path = cell_path(out, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC).isoformat(timespec="seconds")
    record = Record(path, cell, minutes, gym.make(cell.task, **cell.env_kwargs))
    train(cell, record, clone)
    cpu, wall = record.times()
    times = {"training_seconds": round(cpu, 1), "training_wall_seconds": round(wall, 1)}
    details = {"stopped_by": record.rows[-1]["limit"], **times, "load_average": os.getloadavg(), "started": started}
    if clone is not None:
        details["public_commit"] = checkout_commit(clone)
    write_json(path.with_suffix(".json"), {**settings_of(cell, minutes), **details, **describe_run()})


def cell_path(out: Path, cell: Cell) -> Path:
    """Name a cell's file.

    :param out: Folder of all results
    :param cell: From ``make_cell``
    :return: Its CSV file; the JSON file beside it marks that it is finished
    """
    return out / short_name(cell.task) / cell.method / f"seed{cell.seed}.csv"


def run_missing(out: Path, cells: Sequence[Cell], minutes: float, jobs: int, clones: dict[str, Path]) -> list[str]:
    """Run what is not finished, each cell in a process of its own.

    :param out: Folder of all results
    :param cells: From ``make_cell``
    :param minutes: Limit of each in minutes of training
    :param jobs: Cells at a time
    :param clones: Folders of public code, by arm or peer
    :return: Names of the cells that failed
    :raises UsageError: if the folder holds cells of other settings
    """
    for cell in cells:
        path = cell_path(out, cell).with_suffix(".json")
        check_settings(path, settings_of(cell, minutes))

    def run(cell: Cell) -> bool:
        clone = clones.get(peer_of(cell.method) or cell.method)
        process = get_context("spawn").Process(target=run_cell, args=(out, cell, minutes, clone))
        process.start()
        process.join()
        return process.exitcode == 0

    missing = [cell for cell in cells if not cell_path(out, cell).with_suffix(".json").exists()]
    os.environ.update(ONE_THREAD)
    with ThreadPoolExecutor(jobs) as threads:
        done = list(threads.map(run, missing))
    return [f"{cell.method}, seed {cell.seed}" for cell, well in zip(missing, done, strict=True) if not well]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cells that are missing, then summarise all.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0, or 1 if a cell failed
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--public", type=checkout_folder, help="folder into which pytorch_sac_ae was cloned")
    parser.add_argument("--drqv2", type=PEERS["drqv2"].folder, help="folder into which drqv2 was cloned")
    parser.add_argument("--curl", type=PEERS["public_curl"].folder, help="folder into which curl was cloned")
    parser.add_argument("--out", type=Path, default=Path("results/by_the_clock"), help="default: results/by_the_clock")
    parser.add_argument("--arms", nargs="+", default=[OURS], help=f"default: {OURS}")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS[:1], help=f"default: {TASKS[0]}")
    parser.add_argument("--seeds", nargs="+", type=int, default=range(20, 25), help="default: 20 21 22 23 24")
    parser.add_argument("--minutes", type=float, default=30.0, help="limit in CPU minutes of training (default: 30)")
    parser.add_argument("--steps", type=int, default=1_000_000, help="limit in environment steps (default: 1000000)")
    parser.add_argument("--every", type=int, default=1250, help="agent steps between evaluations (default: 1250)")
    parser.add_argument("--episodes", type=int, default=10, help="of an evaluation (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time (default: 1)")
    parser.add_argument("--summarise-only", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    arms = [] if options.summarise_only else options.arms
    clones = {PUBLIC: options.public, "drqv2": options.drqv2, "public_curl": options.curl}
    for arm in arms:
        name = peer_of(arm) or arm
        if name in clones and clones[name] is None:
            parser.error(f"{arm} needs the folder of its clone: give --{name.removeprefix('public_')}")
    limits = {"budget": options.steps, "eval_every": options.every, "eval_episodes": options.episodes}
    try:
        cells = [
            replace(make_cell(arm, task, seed, options.out), **limits)
            for task in options.tasks
            for seed in options.seeds
            for arm in arms
        ]
        failed = run_missing(options.out, cells, options.minutes, options.jobs, clones)
        runs = read_runs(options.out)
    except UsageError as error:
        parser.error(str(error))
    if runs:
        print(write_summary(options.out, runs))
    for name in failed:
        print(f"{name} failed: run this again, and it begins anew")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
