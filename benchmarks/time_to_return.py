"""How many minutes of training until a return is reached: ours, the public SAC-AE and SB3's SAC on cartpole-swingup.

    git clone https://github.com/denisyarats/pytorch_sac_ae
    python -m benchmarks.time_to_return --public pytorch_sac_ae --out results/time_to_return

All arms see the pixels of the fast profile. Ours have its settings; the public code has its own (as in
``public_returns.py``) with the profile's sizes of networks; ``sb3_sac`` is SB3's ``SAC("CnnPolicy")`` with its
defaults, ``sb3_sac_our_sizes`` the same with our hidden layers, batch size, learning rate and warm-up.

Each cell (arm, seed) runs in a process with one thread until it has made ``--steps`` or trained for ``--minutes``. The
clock runs from before the training environment and the networks are made, and stands still during evaluations.
Evaluations of all arms begin in the same states. A cell writes ``<arm>/seed<k>.csv`` after each evaluation and
``seed<k>.json`` at its end; without the latter it begins anew. ``summary.csv``, ``table.md`` and
``time_to_return.png`` are made of all finished cells in the folder.

A return is reached at the first evaluation whose mean is at least as high. A seed that does not reach it is censored
at its limit, and ranks behind all that do: the median is the time at which half of the seeds have reached the return
(of Kaplan and Meier's curve, if all limits are alike), and "not reached" if fewer than half ever do.
"""

import argparse
import contextlib
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from matplotlib.figure import Figure
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import public_returns
from benchmarks.public_returns import PublicTraining, episode_return, public_cell
from benchmarks.public_sac_ae import checkout_folder
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation.callbacks import untouched_randomness
from sb3_cure.evaluation.plots import arm_colors, in_style, save
from sb3_cure.evaluation.result_files import (
    Row,
    checkout_commit,
    describe_run,
    read_rows,
    write_csv,
    write_json,
    write_text,
)
from sb3_cure.experiments.cells import EVAL_SEED, check_settings
from sb3_cure.experiments.grid import Cell, GridError, load_grid, read_kept
from sb3_cure.experiments.tables import NONE, Table
from sb3_cure.networks.allocator import tune_allocator

PUBLIC = public_returns.ARM
#: Grids that hold our arms
GRIDS = {"sac_ae": "curves.yml", "cure_sac_ae": "curves.yml", "curl": "curves_curl.yml"}
SB3 = ("sb3_sac", "sb3_sac_our_sizes")
ARMS = (*GRIDS, PUBLIC, *SB3)
TARGETS = (200, 250, 300)
#: More than all steps of the default limit
SB3_BUFFER_SIZE = 20_000
COLUMNS = ("agent_steps", "environment_steps", "training_seconds", "return_mean", "return_std", "episodes", "limit")
SUMMARY_COLUMNS = ("arm", "target", "seeds", "reached", "median_minutes", "of_public", "minutes")
#: One thread for each library that may start more
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}
#: Of the JSON files: what the table says about all cells
CONDITIONS = ("budget", "minutes", "eval_every", "eval_episodes", "machine", "commit")


# Cells


def make_cell(arm: str, seed: int, steps: int, every: int, episodes: int) -> Cell:
    """
    :param arm: One of ``ARMS``
    :param seed: Seed of weights, warm-up and environment
    :param steps: Limit in environment steps
    :param every: Agent steps between two evaluations
    :param episodes: Episodes of an evaluation
    :return: What to run
    """
    if arm == PUBLIC:
        cell = public_cell(load_grid(public_returns.GRID).cells[0])
    else:
        ours = arm if arm in GRIDS else "sac_ae"
        cell = load_grid(public_returns.GRID.with_name(GRIDS[ours]), methods=[ours]).cells[0]
    if arm in SB3:
        arguments = {"policy": "CnnPolicy", "buffer_size": SB3_BUFFER_SIZE}
        if arm == "sb3_sac_our_sizes":
            known = {"learning_rate": 1e-3, "batch_size": 128, **cell.arguments}  # the former by default
            arguments |= {name: known[name] for name in ("learning_rate", "learning_starts", "batch_size")}
            arguments["policy_kwargs"] = {"net_arch": known["policy_kwargs"]["net_arch"]}
        cell = replace(cell, arguments=arguments)
    return replace(cell, method=arm, seed=seed, budget=steps, eval_every=every, eval_episodes=episodes)


def settings_of(cell: Cell, minutes: float) -> dict[str, Any]:
    """
    :param cell: From ``make_cell``
    :param minutes: Its limit
    :return: Settings to keep beside the results
    """
    names = ("method", "seed", "task", "env_kwargs", "arguments", "budget", "eval_every", "eval_episodes")
    return {**{name: getattr(cell, name) for name in names}, "minutes": minutes, "eval_seed": EVAL_SEED}


class Record:
    """Measures the time of training, evaluates on schedule with the clock stopped, and tells when time is up.

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
        self._started = np.array([time.perf_counter(), time.process_time()])

    def times(self) -> tuple[float, float]:
        """
        :return: Wall-clock and CPU seconds of training so far
        """
        wall, cpu = np.array([time.perf_counter(), time.process_time()]) - self._started
        return float(wall), float(cpu)

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clock for a while."""
        times = self.times()
        yield
        self._started = np.array([time.perf_counter(), time.process_time()]) - times

    def is_time_up(self) -> bool:
        """
        :return: Whether the limit in minutes is reached
        """
        return self.times()[0] >= 60 * self.minutes

    def visit(self, step: int, act: Callable[[np.ndarray], np.ndarray], finished: bool = False) -> None:
        """Evaluate if that is due.

        :param step: Agent steps so far
        :param act: Deterministic policy, from an observation to an action
        :param finished: Whether training has ended, by either limit
        """
        if not finished and step % self.cell.eval_every:
            return
        limit = "" if not finished else "steps" if step == self.total else "minutes"
        if self.rows and self.rows[-1]["agent_steps"] == step:
            self.rows[-1]["limit"] = limit
        else:
            self._evaluate(step, act, limit)
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


def train(cell: Cell, record: Record, checkout: Path | None) -> None:
    """Train one cell until either limit.

    :param cell: From ``make_cell``
    :param record: Of this cell
    :param checkout: Folder that holds the public implementation's files, which only its arm needs
    """
    if cell.method == PUBLIC:
        assert checkout is not None
        public = PublicTraining(checkout, cell)
        for step in public.steps():
            record.visit(step, public.agent.select_action)
            if record.is_time_up():
                break
        record.visit(step, public.agent.select_action, finished=True)
        return
    env = gym.make(cell.task, **cell.env_kwargs)
    if cell.method in SB3:
        model: Any = SAC(env=env, seed=cell.seed, device="cpu", **cell.build_arguments())
    else:
        model = cell.make_model(env, device="cpu")
    model.learn(record.total, callback=_Visits(record))


def run_cell(out: Path, cell: Cell, minutes: float, checkout: Path | None) -> None:
    """Run one cell from its beginning.

    :param out: Folder of all results
    :param cell: From ``make_cell``
    :param minutes: Limit in minutes of training
    :param checkout: Folder that holds the public implementation's files
    """
    th.set_num_threads(1)
    tune_allocator()
    path = cell_path(out, cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC).isoformat(timespec="seconds")
    record = Record(path, cell, minutes, gym.make(cell.task, **cell.env_kwargs))
    train(cell, record, checkout)
    wall, cpu = record.times()
    times = {"training_seconds": round(wall, 1), "training_cpu_seconds": round(cpu, 1)}
    details = {"stopped_by": record.rows[-1]["limit"], **times, "load_average": os.getloadavg(), "started": started}
    if cell.method == PUBLIC and checkout is not None:
        details["public_commit"] = checkout_commit(checkout)
    write_json(path.with_suffix(".json"), {**settings_of(cell, minutes), **details, **describe_run()})


def cell_path(out: Path, cell: Cell) -> Path:
    """
    :param out: Folder of all results
    :param cell: From ``make_cell``
    :return: Its CSV file; the JSON file beside it tells that it is finished
    """
    return out / cell.method / f"seed{cell.seed}.csv"


def run_missing(out: Path, cells: Sequence[Cell], minutes: float, jobs: int, checkout: Path | None) -> list[str]:
    """Run what is not finished, each cell in a process of its own.

    :param out: Folder of all results
    :param cells: From ``make_cell``
    :param minutes: Limit of each in minutes of training
    :param jobs: Cells at a time
    :param checkout: Folder that holds the public implementation's files
    :return: Names of the cells that failed
    :raises GridError: if the folder holds cells of other settings
    """
    for cell in cells:
        path = cell_path(out, cell).with_suffix(".json")
        check_settings(path, settings_of(cell, minutes))

    def run(cell: Cell) -> bool:
        process = get_context("spawn").Process(target=run_cell, args=(out, cell, minutes, checkout))
        process.start()
        process.join()
        return process.exitcode == 0

    missing = [cell for cell in cells if not cell_path(out, cell).with_suffix(".json").exists()]
    os.environ.update(ONE_THREAD)
    with ThreadPoolExecutor(jobs) as threads:
        done = list(threads.map(run, missing))
    return [f"{cell.method}, seed {cell.seed}" for cell, well in zip(missing, done, strict=True) if not well]


# Summary


@dataclass(frozen=True)
class Run:
    """One finished cell.

    :param rows: Of its CSV file
    :param details: Its JSON file
    """

    rows: list[Row]
    details: dict[str, Any]

    @property
    def minutes(self) -> float:
        """Minutes of training until its limit."""
        return self.rows[-1]["training_seconds"] / 60

    def minutes_to(self, target: float) -> float | None:
        """
        :param target: A return
        :return: Minutes of training until the first evaluation that reaches it; None: not within the limit
        """
        reached = (row["training_seconds"] / 60 for row in self.rows if row["return_mean"] >= target)
        return next(reached, None)

    def told(self, target: float) -> str:
        """
        :param target: A return
        :return: Minutes until it is reached, or those until the limit, and which limit that was
        """
        minutes = self.minutes_to(target)
        return f">{self.minutes:.1f} ({self.details['stopped_by']})" if minutes is None else f"{minutes:.1f}"


Runs = Mapping[str, Mapping[int, Run]]


def read_runs(out: Path) -> dict[str, dict[int, Run]]:
    """
    :param out: Folder of all results
    :return: Its finished cells, by arm and seed
    """
    runs: dict[str, dict[int, Run]] = {}
    for arm in ARMS:
        for path in (out / arm).glob("seed*.json"):
            details = read_kept(path)
            runs.setdefault(arm, {})[details["seed"]] = Run(read_rows(path.with_suffix(".csv"), COLUMNS), details)
    return {arm: dict(sorted(seeds.items())) for arm, seeds in runs.items()}


def censored_median(minutes: Sequence[float | None]) -> float | None:
    """
    :param minutes: Until a return is reached, one per seed; None: not within the limit
    :return: When half of the seeds have reached it; None if fewer than half do
    """
    median = statistics.median_low([math.inf if each is None else each for each in minutes] or [math.inf])
    return None if math.isinf(median) else median


def ratio_of_medians(ours: Mapping[int, Run], theirs: Mapping[int, Run], target: float) -> str:
    """
    :param ours: Runs of an arm by seed
    :param theirs: Runs of another
    :param target: A return
    :return: Median of ours over that of theirs; an upper bound if theirs is beyond their limits, a dash if ours is
    """
    one, other = (censored_median([run.minutes_to(target) for run in runs.values()]) for runs in (ours, theirs))
    if one is None or not theirs:
        return NONE
    if other is not None:
        return f"{one / other:.2f}"
    # Those that do not reach it take longer than their limits.
    at_least = [run.minutes if (found := run.minutes_to(target)) is None else found for run in theirs.values()]
    return f"<{one / statistics.median_low(at_least):.2f}"


def summarise(runs: Runs) -> list[Row]:
    """
    :param runs: Result of ``read_runs``
    :return: Rows of ``summary.csv``
    """
    rows = []
    for arm, seeds in runs.items():
        for target in TARGETS:
            minutes = [run.minutes_to(target) for run in seeds.values()]
            median = censored_median(minutes)
            values = (
                *(arm, target, len(seeds), sum(each is not None for each in minutes)),
                "not reached" if median is None else round(median, 2),
                ratio_of_medians(seeds, runs.get(PUBLIC, {}), target),
                "; ".join(f"seed {seed}: {run.told(target)}" for seed, run in seeds.items()),
            )
            rows.append(dict(zip(SUMMARY_COLUMNS, values, strict=True)))
    return rows


def tables(runs: Runs) -> str:
    """
    :param runs: Result of ``read_runs``
    :return: Medians by arm, minutes of each seed, and conditions, in Markdown
    """
    summary = summarise(runs)
    by_arm = []
    for arm, seeds in runs.items():
        found = [row for row in summary if row["arm"] == arm]
        texts = [f"{row['median_minutes']} ({row['reached']} of {row['seeds']}), {row['of_public']}" for row in found]
        last = [(run.rows[-1]["return_mean"], run.rows[-1]["environment_steps"]) for run in seeds.values()]
        clocks = [(run.minutes, run.details["training_cpu_seconds"] / 60) for run in seeds.values()]
        (final, steps), (wall, cpu) = np.mean(last, axis=0), np.mean(clocks, axis=0)
        by_arm.append([arm, *texts, f"{final:.0f}", f"{steps:,.0f}", f"{wall:.1f}", f"{cpu:.1f}"])
    columns = ["arm", *(f">{target}" for target in TARGETS)]
    columns += [">last return", ">environment steps", ">minutes", ">CPU minutes"]
    note = (
        "Median over seeds of the minutes of training until the return is reached, how many seeds reach it, and the "
        f"median over that of {PUBLIC} (an upper bound where {PUBLIC} does not reach it). The last four columns: means "
        "over seeds at their limits. Minutes well above CPU minutes tell of a busy machine."
    )
    by_seed = [[row["arm"], str(row["target"]), row["minutes"]] for row in summary]
    details = [run.details for seeds in runs.values() for run in seeds.values()]
    told = [f"{key}: {', '.join(sorted({str(each[key]) for each in details}))}" for key in CONDITIONS]
    both = (
        Table("Minutes to a return", pd.DataFrame(by_arm, columns=columns), note),
        Table("Each seed", pd.DataFrame(by_seed, columns=["arm", ">return", "minutes"]), "; ".join(told)),
    )
    head = "# Time to a return\n\n![Return over minutes of training](time_to_return.png)\n"
    return "\n".join((head, *(each.markdown() for each in both)))


@in_style
def draw(path: Path, runs: Runs) -> None:
    """Return over minutes of training: thin lines are seeds, thick ones their mean while all of them train.

    :param path: File to write
    :param runs: Result of ``read_runs``
    """
    figure = Figure(figsize=(7.5, 4.8))
    axes = figure.subplots()
    colors = arm_colors(ARMS, PUBLIC)
    for arm, seeds in runs.items():
        curves = []
        for run in seeds.values():
            minutes = [row["training_seconds"] / 60 for row in run.rows]
            curves.append((minutes, [row["return_mean"] for row in run.rows]))
            axes.plot(*curves[-1], color=colors[arm], alpha=0.35, linewidth=0.7)
        grid = np.linspace(max(minutes[0] for minutes, _ in curves), min(minutes[-1] for minutes, _ in curves), 400)
        mean = np.mean([np.interp(grid, minutes, returns) for minutes, returns in curves], axis=0)
        axes.plot(grid, mean, color=colors[arm], linewidth=2.4, label=f"{arm} ({len(seeds)})")
    for target in TARGETS:
        axes.axhline(target, color="#333333", linestyle="--", linewidth=0.9, alpha=0.7, zorder=1)
    axes.set(xlabel="minutes of training", ylabel="return (deterministic actions)", xlim=(0, None), ylim=(0, None))
    figure.legend(loc="outside upper center", ncols=3, title="cartpole-swingup from pixels, one thread: arm (seeds)")
    save(figure, path, 120)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cells that are missing, then summarise all.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0, or 1 if a cell failed
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--public", type=checkout_folder, help="folder into which pytorch_sac_ae was cloned")
    parser.add_argument("--out", type=Path, default=Path("time_to_return"), help="folder (default: time_to_return)")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS, help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, default=range(5), help="default: 0 1 2 3 4")
    parser.add_argument("--steps", type=int, default=100_000, help="limit in environment steps (default: 100000)")
    parser.add_argument("--minutes", type=float, default=30.0, help="limit in minutes of training (default: 30)")
    parser.add_argument("--every", type=int, default=2000, help="agent steps between evaluations (default: 2000)")
    parser.add_argument("--episodes", type=int, default=10, help="of an evaluation (default: 10)")
    parser.add_argument("--jobs", type=int, default=2, help="cells at a time (default: 2)")
    parser.add_argument("--summarise-only", action="store_true", help="run nothing")
    options = parser.parse_args(arguments)
    failed = list[str]()
    if not options.summarise_only:
        if PUBLIC in options.arms and options.public is None:
            parser.error(f"--public is missing, which the arm {PUBLIC} needs")
        evaluated = options.steps, options.every, options.episodes
        cells = [make_cell(arm, seed, *evaluated) for seed in options.seeds for arm in options.arms]
        try:
            failed = run_missing(options.out, cells, options.minutes, options.jobs, options.public)
        except GridError as error:
            parser.error(str(error))
    runs = read_runs(options.out)
    if runs:
        write_csv(options.out / "summary.csv", SUMMARY_COLUMNS, summarise(runs))
        write_text(options.out / "table.md", tables(runs))
        draw(options.out / "time_to_return.png", runs)
        print((options.out / "table.md").read_text())
    for name in failed:
        print(f"{name} failed: run this again, and it begins anew")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
