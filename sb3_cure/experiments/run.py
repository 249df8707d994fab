"""Run a grid: in this process, or on Ray (this machine or a cluster)."""

import argparse
import os
import platform
import re
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from rich.console import Console
from rich.live import Live

from sb3_cure.evaluation.result_files import write_json, write_text
from sb3_cure.experiments.cells import ERROR, CellIsRunning, check_settings, is_held, run_cell
from sb3_cure.experiments.grid import Cell, Grid, GridError, check_arms, load_grid, read_kept
from sb3_cure.experiments.heads import CommonHeads, Unit, common_heads, run_heads
from sb3_cure.networks.allocator import tune_allocator

ENGINES = ("local", "ray")
#: In the log of a job, between two lines about the whole
SUMMARY_SECONDS = 300.0
_PLURALS = {Cell: "cells", CommonHeads: "tasks' common heads"}
_ALL, _ENDED = Path("all"), re.compile(": (done|failed)")
#: Folder of results, minutes between checkpoints, whether to draw
Settings: TypeAlias = tuple[Path, float, bool]
#: Runs all of some units, and returns those that failed
RunAll: TypeAlias = Callable[[Sequence[Unit], Settings], list[Unit]]


def run_grid(
    grid: Grid,
    results: str | Path,
    *,
    engine: str = "local",
    checkpoint_minutes: float = 10.0,
    pictures: bool = True,
    address: str | None = None,
    cpus_per_cell: float = 1,
    gpus_per_cell: float | None = None,
    retries: int = 3,
) -> list[Unit]:
    """Run the cells that are not done; started again after any interruption, it goes on.

    Of a grid of kind ``"visitation"`` common heads follow when all cells are run.

    :param grid: The grid
    :param results: Folder of all results; with several machines one that they share
    :param engine: ``"local"``: one after the other in this process; ``"ray"``: side by side in worker processes
    :param checkpoint_minutes: At most so many minutes of a cell are lost by an interruption
    :param pictures: Whether to draw and to film each cell as well
    :param address: Of a Ray cluster (``"auto"`` from within it); None: a cluster of this machine alone
    :param cpus_per_cell: Ray: cores per cell or common head, also its threads
    :param gpus_per_cell: Ray: share of a GPU per cell; 0.25 lets four cells share a card, 0 computes on the CPU. None
        only where no machine has a GPU: Ray would start a cell per core, all on the first card
    :param retries: Ray: how often a cell whose worker died is begun again, from its checkpoint
    :return: The cells and common heads that failed; each has its traceback in ``error.txt``, if it can be written
    :raises GridError: with one sentence, before anything is written, for what cannot be run
    """
    if engine not in ENGINES:
        raise GridError(f"engine is {engine!r}, but it must be one of {', '.join(ENGINES)}: choose one.")
    results = Path(results).resolve()
    check_grid(grid, results)
    settings = (results, checkpoint_minutes, pictures)
    resources = dict(num_cpus=cpus_per_cell, num_gpus=gpus_per_cell, max_retries=retries)
    with _ray(address, resources) if engine == "ray" else nullcontext(_run_here) as run_all:
        _keep_grid(grid, results / grid.experiment)
        with _live_progress(lambda: [*grid.cells, *common_heads(grid, results, grid.cells)], results):
            failed = run_all([cell for cell in grid.cells if not cell.is_done(results)], settings)
            heads = common_heads(grid, results)
            failed += run_all([each for each in heads if not each.is_done(results)], settings)
    lacking = {cell.task for cell in grid.cells if grid.kind == "visitation"} - {each.task for each in heads}
    for task in sorted(lacking):
        print(f"No common heads for {task}: they need two seeds of which all methods are finished, with model.zip.")
    return failed


def check_grid(grid: Grid, results: Path) -> None:
    """
    :param grid: A grid
    :param results: Folder of all results, whether it exists or not
    :raises GridError: with one sentence, if an arm cannot work, or the folder holds cells of other settings: also of
        other seeds and arms, as they are to be compared with those that are run now
    """
    shared = {key: grid.description.get(key) for key in ("kind", "budget", "evaluation", "coverage")}
    check_settings(results / grid.experiment, shared, "grid.json")
    for cell in grid.with_seeds_in(results):
        check_settings(results / cell.folder, cell.config())
    check_arms(cell for cell in grid.cells if not cell.is_done(results))


def _keep_grid(grid: Grid, folder: Path) -> None:
    """Write ``grid.json``; what an earlier call ran besides stays part of the experiment."""
    path = folder / "grid.json"
    description = dict(grid.description)
    if path.exists():
        before = read_kept(path, "seeds", "tasks", "methods")
        description["seeds"] = sorted({*before["seeds"], *description["seeds"]})
        description["tasks"] = list(dict.fromkeys([*before["tasks"], *description["tasks"]]))
        description["methods"] = {**before["methods"], **description["methods"]}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, description)
    except OSError as error:
        raise GridError(f"{folder} cannot be written to ({error.strerror}): give another --out.") from error


# --------------------------------------------------------------------- engines


def _run_here(units: Sequence[Unit], settings: Settings) -> list[Unit]:
    left, failed = list(units), []
    while left:
        # What other processes are making comes last: common heads are waited for.
        left.sort(key=lambda unit: is_held(settings[0] / unit.folder))
        unit = left.pop(0)
        if not _run_and_tell(unit, *settings):
            failed.append(unit)
    return failed


def _run_and_tell(unit: Unit, results: Path, checkpoint_minutes: float, pictures: bool) -> bool:
    """Whether it could be run; a failure must not stop the others."""
    tune_allocator()
    try:
        if isinstance(unit, CommonHeads):
            run_heads(unit, results)
        else:
            run_cell(unit, results, checkpoint_minutes, pictures)
    except CellIsRunning as elsewhere:
        print(elsewhere)
    except Exception:
        _keep_error(unit, results, traceback.format_exc())
        return False
    return True


def _run_on_worker(unit: Unit, settings: Settings, has_gpu: bool) -> bool:
    """The same in a process of Ray's, which leaves all GPUs to see for whoever has asked for none."""
    if not has_gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    return _run_and_tell(unit, *settings)


def _keep_error(unit: Unit, results: Path, text: str) -> None:
    path = results / unit.folder / ERROR
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        print(f"{path} cannot be written ({error.strerror}); it would tell: {text.strip().splitlines()[-1]}")


@contextmanager
def _ray(address: str | None, resources: dict[str, Any]) -> Iterator[RunAll]:
    """Connect to a cluster that has what a cell needs."""
    try:
        import ray
    except ImportError:
        raise GridError('engine="ray" needs Ray, which is not installed: pip install "sb3-cure[cluster]".') from None
    own: dict[str, Any] = {"object_store_memory": 10**8, "include_dashboard": False} if address is None else {}
    try:
        ray.init(address=address or "local", **own)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        fix = "start one (ray start --head), or leave --address out for this machine alone"
        if "auth" in reason.lower():
            fix = "set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or ~/.ray/auth_token to what its nodes were started with"
        raise GridError(f"--address is {address!r}, but Ray does not connect there ({reason}): {fix}.") from None
    try:
        _check_resources(ray.nodes(), resources)
        # A process for each: what one leaves behind does not burden the next.
        remote = ray.remote(max_calls=1, **{**resources, "num_gpus": resources["num_gpus"] or 0})(_run_on_worker)

        def run_all(units: Sequence[Unit], settings: Settings) -> list[Unit]:
            pending = {remote.remote(unit, settings, bool(resources["num_gpus"])): unit for unit in units}
            failed = []
            while pending:
                for reference in ray.wait(list(pending), timeout=5)[0]:
                    unit = pending.pop(reference)
                    error = ""
                    try:
                        succeeded = ray.get(reference)
                    except ray.exceptions.RayError as died:  # more often than `retries`: nobody else could have told
                        succeeded, error = False, f"{died}\n"
                    if succeeded and not (settings[0] / unit.folder).exists():
                        error = f"{settings[0]} on the worker's machine is another folder than here: share one (--out)"
                    if error:
                        _keep_error(unit, settings[0], error)
                    if error or not succeeded:
                        failed.append(unit)
            return failed

        yield run_all
    finally:
        ray.shutdown()


def _check_resources(nodes: Sequence[dict[str, Any]], resources: dict[str, Any]) -> None:
    """A cell that fits on no machine would wait for ever, and Ray keeps no account of GPUs that nobody asks for."""
    for kind, amount in {"CPU": resources["num_cpus"], "GPU": resources["num_gpus"]}.items():
        largest = max((node["Resources"].get(kind, 0) for node in nodes if node["Alive"]), default=0)
        if amount is None and largest > 0:
            raise GridError(
                f"--gpus-per-cell is not given, but a machine of this Ray cluster has {largest:g}: give the share of "
                "one per cell (0.25: four cells on a card), or 0 to compute on the CPU."
            )
        if amount is not None and amount > largest:
            raise GridError(
                f"--{kind.lower()}s-per-cell is {amount:g}, but no machine of this Ray cluster has more than "
                f"{largest:g}: ask for less."
            )


# -------------------------------------------------------------------- progress


def read_progress(unit: Unit, results: Path) -> tuple[str, dict[str, Any]]:
    """
    :param unit: A cell or a task's common heads
    :param results: Folder of all results
    :return: ``"done"``, ``"failed"``, ``"running"``, ``"interrupted"`` or ``"waiting"``, and its ``progress.json``
    """
    folder = results / unit.folder
    try:
        progress = read_kept(folder / "progress.json", "time")
    except GridError:  # or there is none
        progress = {}
    # Another machine's lock may be unknown here; evaluations and bursts of updates are silent.
    may_run = progress and progress.get("machine") != platform.node() and time.time() - progress["time"] < 600
    if unit.is_done(results):
        return "done", progress
    if is_held(folder):
        return "running", progress
    if (folder / ERROR).exists():
        return "failed", progress
    return ("running" if may_run else "interrupted" if progress else "waiting"), progress


def tell(units: Sequence[Unit], results: Path) -> dict[Path, str]:
    """
    :param units: Cells and common heads
    :param results: Folder of all results
    :return: By folder, the state of each and, where it has begun, how far it is, how fast it goes, when it will be
        finished, and its best return; last, as if of a unit, the same of all
    """
    lines: dict[Path, str] = {}
    states: dict[type, list[str]] = {}
    left, made, spent, best = 0, 0, 0.0, (-np.inf, "")
    for unit in units:
        state, progress = read_progress(unit, results)
        states.setdefault(type(unit), []).append(state)
        done, seconds = progress.get("done", 0), progress.get("seconds", 0)
        total = unit.budget + unit.pretraining_steps if isinstance(unit, Cell) else progress.get("total", 0)
        rate = done / seconds if seconds else 0.0
        line = f"{unit.folder}: {state}"
        if state in ("running", "interrupted", "failed"):
            line += f", {done:,} of {total:,}" + (f", {rate:.1f}/s, {_duration((total - done) / rate)}" if rate else "")
        if (own := progress.get("best_return")) is not None:
            line += f", best return {own:.4g}"
            best = max(best, (own, str(unit.folder)))
        lines[unit.folder] = line
        if isinstance(unit, Cell):
            left += 0 if state in ("done", "failed") else total - done
            made, spent = made + done, spent + seconds
    told = [f"{each.count('done')} of {len(each)} {_PLURALS[kind]} done" for kind, each in states.items()]
    running = sum(each.count("running") for each in states.values())
    told += [f"{running} running"] if running else []
    # As fast as all cells so far, on average: one that has just begun tells little of its speed.
    speed = states.get(Cell, []).count("running") * made / spent if spent else 0.0
    told += [f"{speed:.1f} environment steps/s, about {_duration(left / speed)} left"] if speed else []
    told += [f"best return {best[0]:.4g} ({best[1]})"] if best[1] else []
    return {**lines, _ALL: ", ".join(told)}


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


@contextmanager
def _live_progress(list_units: Callable[[], list[Unit]], results: Path) -> Iterator[None]:
    """Show how far all units are: on a terminal all the time; elsewhere a line when one ends, and one now and then."""
    live = Live(auto_refresh=False) if Console().is_terminal else None
    stopped = threading.Event()
    told = tell(list_units(), results)

    def watch() -> None:
        told_at, over = time.monotonic(), False
        while not over:
            over = stopped.wait(1.0)
            lines = tell(list_units(), results)
            if live is not None:
                live.update("\n".join(line for line in lines.values() if ": waiting" not in line), refresh=True)
                continue
            for folder, line in lines.items():
                if _ENDED.search(line) and told.get(folder) != line:
                    told[folder] = line
                    print(line, flush=True)
            if over or time.monotonic() - told_at >= SUMMARY_SECONDS:
                told_at = time.monotonic()
                print(lines[_ALL], flush=True)

    with live or nullcontext():
        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            stopped.set()
            thread.join()


# ---------------------------------------------------------------- command line


def _steps(text: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps: write for example 100000, 100k or 1M")
    return round(float(match[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[match[2]])


def _seed_choice(text: str) -> int | list[int]:
    numbers = [int(part) for part in text.split(",") if part]
    return numbers if "," in text else numbers[0]


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.strip(", ").split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sb3-cure experiment",
        description="Run a grid of experiments; what is done is not run again, what was interrupted goes on.",
    )
    add = parser.add_argument
    add("grid", help="YAML file, or the name of one of the package's grids, such as curves or fast/curves")
    add("--out", type=Path, default=Path("results"), help="folder of results (default: results)")
    seeds = "how many (5: the first ones, where the grid lists its seeds), or which (0,3,4; one alone: 3,)"
    add("--seeds", type=_seed_choice, metavar="SEEDS", help=seeds)
    add("--tasks", type=_names, help="some of the grid's tasks: cartpole-swingup,finger-spin")
    add("--methods", type=_names, help="some of the grid's methods")
    budget = "environment steps of training, for example 100k; those of pretraining in proportion"
    add("--budget", type=_steps, help=budget)
    add("--engine", choices=ENGINES, default="local", help="in this process, or on Ray")
    add("--address", help="of a Ray cluster (auto: the one this machine is part of)")
    add("--cpus-per-cell", type=float, default=1, help="Ray: cores per cell (default: 1)")
    add("--gpus-per-cell", type=float, help="Ray: share of a GPU per cell, such as 0.25; 0: compute on the CPU")
    add("--retries", type=int, default=3, help="Ray: new starts of a cell whose worker died")
    add("--checkpoint-minutes", type=float, default=10, help="between two checkpoints of a cell")
    add("--no-pictures", dest="pictures", action="store_false", help="neither draw nor film")
    add("--dry-run", action="store_true", help="list the cells and their states, run nothing")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """``sb3-cure experiment``.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0 if nothing failed, 1 if something did, 2 for what cannot be run as it was written
    """
    parser = _parser()
    options = vars(parser.parse_args(arguments))
    if "" not in sys.path:
        sys.path.append("")  # a grid may name a head of a module in the working directory
    of_ray = ("address", "gpus_per_cell", "cpus_per_cell", "retries")
    given = [name for name in of_ray if options[name] != parser.get_default(name)]
    choice = {name: options.pop(name) for name in ("seeds", "tasks", "methods", "budget")}
    path, out, dry_run = (options.pop(name) for name in ("grid", "out", "dry_run"))
    try:
        grid = load_grid(path, **choice)
        if options["engine"] == "local" and given:
            raise GridError(f"--{given[0].replace('_', '-')} is of Ray: add --engine ray.")
        if dry_run:
            check_grid(grid, out)
            units: list[Unit] = [*grid.cells, *common_heads(grid, out, grid.cells)]
            print("\n".join(list(tell(units, out).values())[:-1]), flush=True)
            return 0
        failed = run_grid(grid, out, **options)
        print("".join(f"{_failure(unit, out)}\n" for unit in failed), end="", flush=True)
    except GridError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped; the same command goes on from the last checkpoints.")
        return 130
    return 1 if failed else 0


def _failure(unit: Unit, results: Path) -> str:
    path = results / unit.folder / ERROR
    try:
        reason = path.read_text().strip().splitlines()[-1]
    except (OSError, IndexError):  # begun anew by another process meanwhile, or never written
        reason = "there is no file any more that tells why"
    return f"{unit.folder} failed: {reason} ({path})"


if __name__ == "__main__":
    raise SystemExit(main())
