"""Run a grid: in this process, or in several side by side."""

import argparse
import re
import shutil
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TypeAlias

import torch as th

from sb3_cure.cli.progress import time_text
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation.result_files import read_rows, write_json, write_text
from sb3_cure.experiments.cells import CellIsRunning, check_cell, check_settings, is_held, run_cell
from sb3_cure.experiments.grid import ERROR, Grid, check_arms, load_grid, read_json
from sb3_cure.experiments.heads import CommonHeads, Unit, common_heads, run_heads
from sb3_cure.vec_env.workers import leave_with_parent

#: Seconds in which worker processes may close their environments after Ctrl-C
LEAVE_SECONDS = 10.0
#: Runs a unit, and tells whether it is done
RunUnit: TypeAlias = Callable[[Unit], bool]


def run_grid(
    grid: Grid,
    results: str | Path,
    *,
    jobs: int = 1,
    checkpoint_minutes: float = 10.0,
    pictures: bool = True,
) -> list[Unit]:
    """Run the cells that are not done; after an interruption, the same call continues.

    In a grid of kind ``"visitation"`` common heads follow when all cells are done.

    :param grid: The grid
    :param results: Folder of all results
    :param jobs: Cells at a time. Several run in new processes, which share torch's threads and the GPU, and know only
        tasks and classes that are named with their module
    :param checkpoint_minutes: Minutes between two checkpoints, the most that an interruption loses of a cell
    :param pictures: Whether to draw and to film each cell as well
    :return: The cells and common heads that are not done: those that failed, each with its traceback in ``error.txt``,
        and those that another process is running
    :raises UsageError: with one sentence, before anything is written, if the grid cannot be run
    """
    if jobs < 1:
        raise UsageError(f"jobs must be 1 or more, not {jobs}.")
    results = Path(results).resolve()
    check_grid(grid, results)
    run_unit = partial(_run_unit, results=results, checkpoint_minutes=checkpoint_minutes, pictures=pictures)
    run_all = partial(_run_here, run_unit) if jobs == 1 else partial(_run_side_by_side, run_unit, jobs, results)
    _write_grid(grid, results / grid.experiment)
    for cell in grid.cells:
        if cell.is_done(results):  # and was killed before it removed this
            shutil.rmtree(results / cell.folder / "checkpoint", ignore_errors=True)
    failed = run_all([cell for cell in grid.cells if not cell.is_done(results)])
    heads = common_heads(grid, results)
    failed += run_all([each for each in heads if not each.is_done(results)])
    lacking = {cell.task for cell in grid.cells if grid.kind == "visitation"} - {each.task for each in heads}
    for task in sorted(lacking):
        print(f"No common heads for {task}: they need two seeds of which all methods are finished, with model.zip.")
    return [unit for unit in failed if not unit.is_done(results)]  # by another process meanwhile


def check_grid(grid: Grid, results: Path) -> None:
    """Refuse an arm that cannot be built, and a folder with results of other settings.

    Results of other seeds and arms count, too, as they will be compared.

    :param grid: A grid
    :param results: Folder of all results, whether it exists or not
    :raises UsageError: with one sentence
    """
    shared = {key: grid.description.get(key) for key in ("kind", "budget", "evaluation", "coverage")}
    check_settings(results / grid.experiment / "grid.json", shared)
    for cell in grid.with_seeds_in(results):
        check_cell(results / cell.folder, cell)
    check_arms(cell for cell in grid.cells if not cell.is_done(results))


def _write_grid(grid: Grid, folder: Path) -> None:
    """Write ``grid.json``; seeds, tasks and methods of earlier calls stay part of the experiment."""
    path = folder / "grid.json"
    description = dict(grid.description)
    if path.exists():
        before = read_json(path)
        description["seeds"] = sorted({*before["seeds"], *description["seeds"]})
        description["tasks"] = list(dict.fromkeys([*before["tasks"], *description["tasks"]]))
        description["methods"] = {**before["methods"], **description["methods"]}
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, description)


# ---------------------------------------------------------------- cells


def _run_here(run_unit: RunUnit, units: Sequence[Unit]) -> list[Unit]:
    failed, start = [], time.monotonic()
    for number, unit in enumerate(units, 1):
        if not run_unit(unit):
            failed.append(unit)
        left = (time.monotonic() - start) * (len(units) / number - 1)
        print(
            f"{number - len(failed)} of {len(units)} finished" + (f", about {time_text(left)} left" if left else ""),
            flush=True,
        )
    return failed


def _run_side_by_side(run_unit: RunUnit, jobs: int, results: Path, units: Sequence[Unit]) -> list[Unit]:
    """Run each unit in a process of its own, ``jobs`` of them at a time."""
    context, threads = get_context("spawn"), max(th.get_num_threads() // jobs, 1)
    waiting, failed = list(units), []
    running: dict[SpawnProcess, Unit] = {}
    resource_tracker.ensure_running()  # the first process would start it, which unblocks SIGINT
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                unit = waiting.pop(0)
                process = context.Process(target=_work, args=(run_unit, threads, unit))
                with _interrupts_blocked():
                    process.start()
                    running[process] = unit
            connection.wait([process.sentinel for process in running])
            for process in [each for each in running if not each.is_alive()]:
                unit, code = running.pop(process), process.exitcode or 0
                if not unit.is_done(results):
                    failed.append(unit)
                    if code != 0:
                        how = f"was killed by signal {-code}" if code < 0 else f"ended with status {code}"
                        _write_error(unit, results, f"its process {how}\n")
                n_finished = len(units) - len(waiting) - len(running) - len(failed)
                print(f"{n_finished} of {len(units)} finished", flush=True)
    finally:  # Ctrl-C
        for process in running:
            process.terminate()
        for process in running:
            process.join(LEAVE_SECONDS)
            process.kill()
            process.join()
    return failed


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Hold SIGINT back, also in processes that are started meanwhile."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _work(run_unit: RunUnit, threads: int, unit: Unit) -> None:
    """Run a unit in a worker process."""
    # Ctrl-C reaches all processes of a terminal, but the parent decides what it means, and sends SIGTERM.
    signal.signal(signal.SIGINT, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=leave_with_parent, daemon=True).start()
    th.set_num_threads(threads)
    with suppress(KeyboardInterrupt):  # after environments were closed
        run_unit(unit)


def _run_unit(unit: Unit, results: Path, checkpoint_minutes: float, pictures: bool) -> bool:
    """Run a unit; a failure is written into its folder and does not stop the others.

    :return: Whether it is done
    """
    try:
        if isinstance(unit, CommonHeads):
            run_heads(unit, results)
        else:
            run_cell(unit, results, checkpoint_minutes, pictures)
        print(f"{unit.folder}: done", flush=True)
    except CellIsRunning as elsewhere:
        print(elsewhere, flush=True)
        return False
    except (Exception, SystemExit):  # the latter from simulators whose window was closed
        _write_error(unit, results, traceback.format_exc())
        return False
    return True


def _write_error(unit: Unit, results: Path, text: str) -> None:
    print(f"{unit.folder}: failed: {text.strip().splitlines()[-1]}", flush=True)
    with suppress(OSError):  # such as a full disk, which may have been the reason
        (results / unit.folder).mkdir(parents=True, exist_ok=True)
        write_text(results / unit.folder / ERROR, text)


# ---------------------------------------------------------------- progress


def status_lines(units: Sequence[Unit], results: Path) -> list[str]:
    """State of each unit, with the last evaluation of cells that have begun.

    Locks of other machines may be invisible: their cells read "interrupted" then.

    :param units: Cells and common heads
    :param results: Folder of all results
    :return: One line for each
    """
    return [f"{unit.folder}: {_status(unit, results)}" for unit in units]


def _status(unit: Unit, results: Path) -> str:
    folder = results / unit.folder
    if unit.is_done(results):
        return "done"
    if is_held(folder):
        state = "running"
    elif (folder / ERROR).exists():
        state = "failed"
    else:
        state = "interrupted" if (folder / "config.json").exists() else "waiting"
    evaluations = read_rows(folder / "eval.csv") if (folder / "eval.csv").exists() else []
    if not evaluations:
        return state
    return f"{state}, evaluated at {evaluations[-1]['environment_steps']:,} environment steps"


# ---------------------------------------------------------------- command line


def _steps(text: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps: write for example 100000, 100k or 1M")
    return round(float(match[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[match[2]])


def _seed_choice(text: str) -> int | list[int]:
    return [int(part) for part in text.split(",") if part] if "," in text else int(text)


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.strip(", ").split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-cure experiment",
        description="Run a grid of experiments; finished cells are not run again, interrupted ones continue.",
    )
    add = parser.add_argument
    add("grid", help="YAML file, or the name of one of the package's grids, such as curves or fast/curves")
    add("--out", type=Path, default=Path("results"), help="folder of results (default: results)")
    seeds = "a number of seeds (5: the first ones, where the grid lists its seeds), or a list (0,3,4; one alone: 3,)"
    add("--seeds", type=_seed_choice, metavar="SEEDS", help=seeds)
    add("--tasks", type=_names, help="some of the grid's tasks: cartpole-swingup,finger-spin")
    add("--methods", type=_names, help="some of the grid's methods")
    budget = "environment steps of training, such as 100k; those of pretraining and coverage change in proportion"
    add("--budget", type=_steps, help=budget)
    add("--jobs", type=int, default=1, help="cells at a time, each in a process of its own (default: 1)")
    add("--checkpoint-minutes", type=float, default=10, help="between two checkpoints of a cell")
    add("--no-pictures", dest="pictures", action="store_false", help="neither draw nor film")
    add("--dry-run", action="store_true", help="list the cells and their states, run nothing")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command ``sb3-cure experiment``.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0 if all cells are done, 1 if some are not, 130 after Ctrl-C
    :raises UsageError: with one sentence, if the grid cannot be run
    """
    options = vars(_parser().parse_args(arguments))
    choice = {name: options.pop(name) for name in ("seeds", "tasks", "methods", "budget")}
    path, out, dry_run = (options.pop(name) for name in ("grid", "out", "dry_run"))
    grid = load_grid(path, **choice)
    if dry_run:
        check_grid(grid, out)
        print("\n".join(status_lines([*grid.cells, *common_heads(grid, out)], out)))
        return 0
    try:
        failed = run_grid(grid, out, **options)
    except KeyboardInterrupt:
        print(
            f"Stopped: {out} keeps the finished cells and the last checkpoints, from which the same command continues."
        )
        return 130
    for unit in failed:
        folder = out / unit.folder
        print(f"{unit.folder} " + ("is run by another process" if is_held(folder) else f"failed, see {folder / ERROR}"))
    return 1 if failed else 0
