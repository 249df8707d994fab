"""Run a grid: in this process, or on Ray (this machine or a cluster)."""

import argparse
import os
import platform
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sb3_cure.allocator import tune_allocator
from sb3_cure.experiments.cells import ERROR, CellIsRunning, check_settings, is_held, run_cell
from sb3_cure.experiments.files import write_json, write_text
from sb3_cure.experiments.grid import Cell, Grid, GridError, check_arms, load_grid, read_kept, seed_of
from sb3_cure.experiments.heads import CommonHead, Unit, common_heads, run_head, without_model
from sb3_cure.values import check_folder, is_integer, is_number

ENGINES = ("local", "ray")
#: In the log of a job, between two lines about the whole
SUMMARY_SECONDS = 300.0
#: From what is under way or left, what can begin besides
Ready: TypeAlias = Callable[[Iterable[Unit]], Sequence[Unit]]


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

    Of a grid of kind ``"visitation"`` the common heads of a task follow when none of its cells is left.

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
    results = Path(results).resolve()
    _check_run(engine, checkpoint_minutes, cpus_per_cell, gpus_per_cell, retries)
    check_grid(grid, results)
    left = [cell for cell in grid.cells if not cell.is_done(results)]
    ready, settings = _heads_when_ready(grid, results), (results, checkpoint_minutes, pictures)
    resources = dict(num_cpus=cpus_per_cell, num_gpus=gpus_per_cell, max_retries=retries)
    with _ray(address, resources) if engine == "ray" else nullcontext() as ray:
        try:
            _keep_grid(grid, results / grid.experiment)
        except OSError as error:
            reason = f"which cannot be written to ({error.strerror})"
            raise GridError(f"--out is {results}, {reason}: give another.") from error
        with _live_progress(lambda: [*grid.cells, *common_heads(grid, results, left)], results):
            if ray is None:
                failed = _run_here(left, ready, settings)
            else:
                failed = _run_with_ray(ray, left, ready, settings, resources)
    if grid.kind == "visitation":
        with_heads, lacking = {head.task for head in common_heads(grid, results)}, without_model(grid, results)
        for task in dict.fromkeys(cell.task for cell in grid.cells if cell.task not in with_heads):
            reason = "they need two seeds of which all methods are finished."
            if task in lacking:
                reason = (
                    f"they would be made of all finished cells, but {results / lacking[task].folder} has no model.zip: "
                    "put it there, or remove that folder to have the cell run again, or choose another --out."
                )
            print(f"No common heads for {task}: {reason}")
    return failed


def check_grid(grid: Grid, results: Path) -> None:
    """
    :param grid: A grid
    :param results: Folder of all results, whether it exists or not
    :raises GridError: with one sentence, if an arm cannot work, the folder cannot be written to, or it holds cells of
        other settings: also of other seeds and arms, as they are to be compared with those that are run now
    """
    folder = results / grid.experiment
    try:
        check_folder("--out", results)
        check_folder(f"the folder of {grid.experiment} in --out", folder)
    except ValueError as error:
        raise GridError(str(error)) from error
    every: list[Unit] = [*grid.with_seeds_in(results), *common_heads(grid, results, grid.complete)]
    for unit in every:
        check_settings(results / unit.folder, unit.config())
    shared = {key: grid.description[key] for key in ("kind", "budget", "evaluation")}
    check_settings(folder, shared, "grid.json")
    evaluation = {f"eval_{key}": value for key, value in shared["evaluation"].items()}
    for path in sorted(folder.glob("*/*/seed*/config.json")):  # of arms that are not in the file, too
        if seed_of(path.parent) is not None:
            budget = shared["budget"] if read_kept(path, "budget")["budget"] else 0  # 0 of those that only pretrain
            check_settings(path.parent, {"kind": grid.kind, "budget": budget, **evaluation})
    left = [cell for cell in grid.cells if not cell.is_done(results)]
    tasks = {cell.task for cell in left}
    check_arms([cell for cell in grid.complete if cell.task in tasks] if grid.kind == "visitation" else left)


def _heads_when_ready(grid: Grid, results: Path) -> Ready:
    """Common heads: those of a task, once, when none of its cells is left."""
    waiting = {cell.task for cell in grid.cells}

    def ready(left: Iterable[Unit]) -> Sequence[Unit]:
        tasks = waiting - {unit.task for unit in left}
        waiting.difference_update(tasks)
        return [head for head in common_heads(grid, results) if head.task in tasks and not head.is_done(results)]

    return ready


def _run_here(cells: Sequence[Cell], ready: Ready, settings: tuple[Path, float, bool]) -> list[Unit]:
    left, failed = [*cells, *ready(cells)], []
    while left:
        # Common heads that other processes are making come last, as they are waited for.
        left.sort(key=lambda unit: isinstance(unit, CommonHead) and is_held(settings[0] / unit.folder))
        unit = left.pop(0)
        if not _run_and_tell(unit, *settings):
            failed.append(unit)
        left += ready(left)
    return failed


def _check_run(
    engine: str, checkpoint_minutes: float, cpus_per_cell: float, gpus_per_cell: float | None, retries: int
) -> None:
    if engine not in ENGINES:
        raise GridError(f"engine is {engine!r}, but it must be one of {', '.join(ENGINES)}: choose one.")
    numbers = {"checkpoint-minutes": checkpoint_minutes, "cpus-per-cell": cpus_per_cell}
    if gpus_per_cell is not None:
        numbers["gpus-per-cell"] = gpus_per_cell
    for name, value in numbers.items():
        if not is_number(value, low=0):
            raise GridError(f"--{name} is {value!r}, but it must be a number of at least 0: change it.")
    if gpus_per_cell is not None and gpus_per_cell > 1 and gpus_per_cell % 1:
        raise GridError(
            f"--gpus-per-cell is {gpus_per_cell:g}, but Ray shares one card only: give 1 or less, or a whole number."
        )
    if not is_integer(retries, -1):
        raise GridError(f"--retries is {retries!r}, but it must be at least 0, or -1 for no limit: change it.")


def _run_and_tell(unit: Unit, results: Path, checkpoint_minutes: float, pictures: bool) -> bool:
    """Whether it could be run; a failure must not stop the others."""
    tune_allocator()
    try:
        if isinstance(unit, CommonHead):
            run_head(unit, results)
        else:
            run_cell(unit, results, checkpoint_minutes, pictures)
    except CellIsRunning as elsewhere:
        print(elsewhere)
    except Exception:
        _keep_error(unit, results, traceback.format_exc())
        return False
    return True


def _run_on_worker(unit: Unit, results: Path, checkpoint_minutes: float, pictures: bool, has_gpu: bool) -> bool:
    """The same in a process of Ray's, which leaves all GPUs to see for whoever has asked for none."""
    if not has_gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    return _run_and_tell(unit, results, checkpoint_minutes, pictures)


def _keep_error(unit: Unit, results: Path, text: str) -> None:
    path = results / unit.folder / ERROR
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    except OSError as error:
        print(f"{path} cannot be written ({error.strerror}); it would tell: {text.strip().splitlines()[-1]}")


@contextmanager
def _ray(address: str | None, resources: dict[str, Any]) -> Iterator[Any]:
    """Ray, connected to a cluster that has what a cell needs."""
    try:
        import ray
    except ImportError:
        raise GridError('engine="ray" needs Ray, which is not installed: pip install "sb3-cure[cluster]".') from None
    own: dict[str, Any] = {"object_store_memory": 10**8, "include_dashboard": False} if address is None else {}
    try:
        ray.init(address=address or "local", **own)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        if "auth" in reason.lower():
            fix = "set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN or ~/.ray/auth_token to what its nodes were started with"
            sentence = f"the Ray cluster there asks for its token ({reason}): {fix}."
        else:
            fix = "start one (ray start --head), or leave --address out for this machine alone"
            sentence = f"no Ray cluster answers there ({reason}): {fix}."
        raise GridError(f"--address is {address!r}, but {sentence}") from None
    try:
        _check_resources(ray.nodes(), resources)
        yield ray
    finally:
        ray.shutdown()


def _run_with_ray(
    ray: Any,
    cells: Sequence[Cell],
    ready: Ready,
    settings: tuple[Path, float, bool],
    resources: dict[str, Any],
) -> list[Unit]:
    # A process for each: what one leaves behind does not burden the next.
    run = ray.remote(max_calls=1, **{**resources, "num_gpus": resources["num_gpus"] or 0})(_run_on_worker)
    on_worker = (*settings, bool(resources["num_gpus"]))
    pending: dict[Any, Unit] = {run.remote(unit, *on_worker): unit for unit in (*cells, *ready(cells))}
    failed = []
    while pending:
        for reference in ray.wait(list(pending), timeout=5)[0]:
            unit = pending.pop(reference)
            try:
                succeeded = ray.get(reference)
            except ray.exceptions.RayError as error:
                # The worker has died more often than `retries`: nobody else could have told.
                _keep_error(unit, settings[0], f"{error}\n")
                succeeded = False
            if succeeded and not (settings[0] / unit.folder).exists():
                sentence = f"{settings[0]} on the worker's machine is another folder than here: share one (--out)"
                _keep_error(unit, settings[0], f"{sentence}\n")
                succeeded = False
            if not succeeded:
                failed.append(unit)
            pending.update({run.remote(head, *on_worker): head for head in ready(pending.values())})
    return failed


def _check_resources(nodes: Sequence[dict[str, Any]], resources: dict[str, Any]) -> None:
    """A cell that fits on no machine would wait for ever, and Ray keeps no account of GPUs that nobody asks for."""
    wanted = {"CPU": resources["num_cpus"], "GPU": resources["num_gpus"]}
    for kind, amount in wanted.items():
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


def _keep_grid(grid: Grid, folder: Path) -> None:
    """Write ``grid.json``; what an earlier call ran besides stays part of the experiment."""
    path = folder / "grid.json"
    description = dict(grid.description)
    if path.exists():
        before = read_kept(path, "seeds", "tasks", "methods")
        description["seeds"] = sorted({*before["seeds"], *description["seeds"]})
        description["tasks"] = list(dict.fromkeys([*before["tasks"], *description["tasks"]]))
        description["methods"] = {**before["methods"], **description["methods"]}
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, description)


# -------------------------------------------------------------------- progress


@contextmanager
def _live_progress(list_units: Callable[[], list[Unit]], results: Path) -> Iterator[None]:
    """Show how far all units are, as their files tell, whichever process or machine runs them."""
    console = Console()
    watches = console.is_terminal or console.is_jupyter
    if not watches:
        console = Console(width=120)  # rich's 80 are too few for the table, whose columns it would cut
    stopped = threading.Event()

    def refresh(show: Callable[[Table], object]) -> None:
        told, told_at = _finished(list_units(), results), time.monotonic()
        while not stopped.wait(1.0):
            try:
                if watches:
                    show(progress_table(list_units(), results))
                    continue
                told = _tell_finished(list_units(), results, told)
                if time.monotonic() - told_at >= SUMMARY_SECONDS:
                    told_at = time.monotonic()
                    print(_Progress(list_units(), results).summary(), flush=True)
            except BrokenPipeError:  # nobody reads on, and the cells are to be finished all the same
                _write_to_nobody()

    with _shown(console, progress_table(list_units(), results)) as show:
        thread = threading.Thread(target=refresh, args=(show,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            stopped.set()
            thread.join()
            show(progress_table(list_units(), results))


def _finished(units: Sequence[Unit], results: Path) -> dict[Path, str]:
    states = {unit.folder: read_progress(unit, results)[0] for unit in units}
    return {folder: state for folder, state in states.items() if state in ("done", "failed")}


def _tell_finished(units: Sequence[Unit], results: Path, told: dict[Path, str]) -> dict[Path, str]:
    """Print what has been finished since; returns what has been told."""
    finished = _finished(units, results)
    done = {folder for folder, state in finished.items() if state == "done"}
    for folder, state in finished.items():
        if told.get(folder) != state:
            print(f"{folder} {state}; {_count(units, done)} done", flush=True)
    return finished


def _count(units: Sequence[Unit], done: Container[Path]) -> str:
    """Such as "12 of 12 cells, 3 of 6 common heads"."""
    counts = []
    for name, kind in (("cells", Cell), ("common heads", CommonHead)):
        folders = [unit.folder for unit in units if isinstance(unit, kind)]
        if folders:
            counts.append(f"{sum(folder in done for folder in folders)} of {len(folders)} {name}")
    return ", ".join(counts)


def _write_to_nobody() -> None:
    """After a BrokenPipeError: else whatever is written later would raise another, at the latest when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _shown(console: Console, table: Table) -> Iterator[Callable[[Table], object]]:
    """A table on a terminal or in a notebook, and what replaces it by another; elsewhere the last one is printed."""
    if console.is_jupyter:  # where rich's Live needs ipywidgets
        from IPython.display import display

        yield display(table, display_id=True).update
    else:
        with Live(table, console=console, auto_refresh=console.is_terminal) as live:
            yield lambda later: live.update(later, refresh=True)
        if not console.is_terminal:
            console.line()  # which rich ends a table with on terminals only


class _UnitProgress(NamedTuple):
    unit: Unit
    state: str
    #: Environment steps, or updates of a common head
    done: int
    total: int
    #: Of these, per second
    rate: float
    #: Return
    best: float | None


class _Progress:
    """How far all units are, as their files tell.

    :param units: The cells of a grid, and its common heads
    :param results: Folder of all results
    """

    def __init__(self, units: Sequence[Unit], results: Path):
        self.units = units
        self.rows = [_unit_progress(unit, results) for unit in units]

    def summary(self) -> str:
        """What is done and under way, how fast it goes, when it will be finished, and the best return of all cells."""
        done = {row.unit.folder for row in self.rows if row.state == "done"}
        running = sum(row.state == "running" for row in self.rows)
        told = f"{_count(self.units, done)} done" + (f", {running} running" if running else "")
        left = [row for row in self.rows if row.state not in ("done", "failed") and isinstance(row.unit, Cell)]
        speed = sum(row.rate for row in left if row.state == "running")
        if speed:
            seconds = sum(row.total - row.done for row in left) / speed
            told += f", {speed:.1f} environment steps/s, about {_duration(seconds)} left"
        best = max(((row.best, str(row.unit.folder)) for row in self.rows if row.best is not None), default=None)
        return told + ("" if best is None else f", best return {_return(best[0])} ({best[1]})")


def _return(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _unit_progress(unit: Unit, results: Path) -> _UnitProgress:
    state, progress = read_progress(unit, results)
    if isinstance(unit, CommonHead):
        total, done = unit.updates, progress.get("updates", 0)
    else:
        total = unit.budget + (unit.pretrain.budget if unit.pretrain else 0)
        done = progress.get("environment_steps", 0)
        if unit.pretrain and progress.get("phase") == "train":
            done += unit.pretrain.budget
    rate = done / progress["seconds"] if progress.get("seconds") else 0.0
    return _UnitProgress(unit, state, done, total, rate, progress.get("best_return"))


def progress_table(units: Sequence[Unit], results: Path) -> Table:
    """
    :param units: The cells of a grid, and its common heads
    :param results: Folder of all results
    :return: What is done, how fast it goes, when it will be finished; one line where nothing is under way
    """
    progress = _Progress(units, results)
    table = Table("task", "method", "seed", "state", "environment steps", "steps/s", "left", "best return")
    for unit, state, done, total, rate, best in progress.rows:
        if state in ("running", "interrupted", "failed"):
            what = " updates" if isinstance(unit, CommonHead) else ""
            table.add_row(
                *(unit.folder.parts[1], unit.method, str(unit.seed), state, f"{done:,} of {total:,}{what}"),
                *(
                    f"{rate:.1f}",
                    _duration((total - done) / rate) if rate else "",
                    "" if best is None else _return(best),
                ),
            )
    if not table.row_count:
        table = Table.grid()
        table.add_row(progress.summary())
    else:
        table.caption = progress.summary()
    return table


def read_progress(unit: Unit, results: Path) -> tuple[str, dict[str, Any]]:
    """
    :param unit: A cell or a common head
    :param results: Folder of all results
    :return: ``"done"``, ``"failed"``, ``"running"``, ``"interrupted"`` or ``"waiting"``, and its ``progress.json``
    """
    folder = results / unit.folder
    try:
        progress = read_kept(folder / "progress.json", "time")
    except GridError:  # or there is none
        progress = {}
    if unit.is_done(results):
        return "done", progress
    if is_held(folder):
        return "running", progress
    if (folder / ERROR).exists():
        return "failed", progress
    if not progress:
        return "waiting", progress
    # Another machine's lock may be unknown here; evaluations and bursts of updates are silent.
    may_run = progress.get("machine") != platform.node() and time.time() - progress["time"] < 600
    return ("running" if may_run else "interrupted"), progress


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


# ---------------------------------------------------------------- command line


def _steps(text: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of steps: write for example 100000, 100k or 1M")
    return round(float(match[1]) * {"": 1, "k": 1_000, "M": 1_000_000}[match[2]])


def _seed_choice(text: str) -> int | list[int]:
    try:
        numbers = [int(part) for part in text.split(",") if part]
    except ValueError:
        numbers = []
    if not numbers:
        raise argparse.ArgumentTypeError(f"{text!r} names no seeds: write how many (5), or which (0,3,4)") from None
    return numbers if "," in text else numbers[0]


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError(f"{text!r} names nothing: write for example a,b")
    return names


def main(arguments: Sequence[str] | None = None) -> int:
    """``sb3-cure experiment``.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0 if nothing failed, 1 if something did, 2 for what cannot be run as it was written
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cure experiment",
        description="Run a grid of experiments; what is done is not run again, what was interrupted goes on.",
    )
    parser.add_argument("grid", type=Path, help="YAML file, for example zoo_configs/experiments/curves.yml")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder of results (default: results)")
    parser.add_argument(
        "--seeds",
        type=_seed_choice,
        help="how many (5: the first ones, where the grid lists its seeds), or which (0,3,4; one alone: 3,)",
    )
    parser.add_argument("--tasks", type=_names, help="some of the grid's tasks: cartpole-swingup,finger-spin")
    parser.add_argument("--methods", type=_names, help="some of the grid's methods")
    parser.add_argument(
        "--budget",
        type=_steps,
        help="environment steps of training, for example 100k; those of pretraining in proportion",
    )
    parser.add_argument("--engine", choices=ENGINES, default="local", help="in this process, or on Ray")
    parser.add_argument("--address", help="of a Ray cluster (auto: the one this machine is part of)")
    parser.add_argument("--cpus-per-cell", type=float, default=1, help="Ray: cores per cell (default: 1)")
    parser.add_argument(
        "--gpus-per-cell", type=float, help="Ray: share of a GPU per cell, such as 0.25; 0: compute on the CPU"
    )
    parser.add_argument("--retries", type=int, default=3, help="Ray: new starts of a cell whose worker died")
    parser.add_argument("--checkpoint-minutes", type=float, default=10, help="between two checkpoints of a cell")
    parser.add_argument("--no-pictures", action="store_true", help="neither draw nor film")
    parser.add_argument("--dry-run", action="store_true", help="list the cells and their states, run nothing")
    options = parser.parse_args(arguments)
    if "" not in sys.path:
        sys.path.append("")  # a grid may name a head of a module in the working directory
    try:
        grid = load_grid(
            options.grid, seeds=options.seeds, tasks=options.tasks, methods=options.methods, budget=options.budget
        )
        of_ray = ("address", "gpus_per_cell", "cpus_per_cell", "retries")
        given = [name for name in of_ray if getattr(options, name) != parser.get_default(name)]
        if options.engine == "local" and given:
            raise GridError(f"--{given[0].replace('_', '-')} is of Ray: add --engine ray.")
        checked = ("engine", "checkpoint_minutes", "cpus_per_cell", "gpus_per_cell", "retries")
        how = {name: getattr(options, name) for name in checked}
        if options.dry_run:
            _check_run(**how)
            check_grid(grid, options.out)
            units: list[Unit] = [*grid.cells, *common_heads(grid, options.out, grid.cells)]
            for unit in units:
                print(f"{unit.folder}: {read_progress(unit, options.out)[0]}")
            sys.stdout.flush()
            return 0
        failed = run_grid(grid, options.out, pictures=not options.no_pictures, address=options.address, **how)
        for sentence in _failures(failed, options.out):
            print(sentence)
        sys.stdout.flush()
    except GridError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped; the same command goes on from the last checkpoints.")
        return 130
    except BrokenPipeError:  # such as `--dry-run | head`, which has read enough
        _write_to_nobody()
        return 128 + signal.SIGPIPE
    return 1 if failed else 0


def _failures(failed: Iterable[Unit], results: Path) -> Iterator[str]:
    for unit in failed:
        path = Path(results) / unit.folder / ERROR
        try:
            reason = path.read_text().strip().splitlines()[-1]
        except (OSError, IndexError):  # begun anew by another process meanwhile, or never written
            reason = "there is no file any more that tells why"
        yield f"{unit.folder} failed: {reason} ({path})"


if __name__ == "__main__":
    raise SystemExit(main())
