"""Runs of grids: failures stop nothing else, settings are not mixed, and kills lose nothing."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from grids_for_tests import method, steps_of, write_grid

from sb3_cure import CuReSAC
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation.result_files import read_rows
from sb3_cure.experiments import cells, heads, run
from sb3_cure.experiments.grid import load_grid

QUICK: dict[str, Any] = dict(budget=40, evaluation=dict(every=40, episodes=1))

pytestmark = pytest.mark.usefixtures("quick_disk")


# -------------------------------------------------------------------- failures


def test_failing_cell_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Its sentence is printed and its traceback kept; the exit status tells; run again it is finished."""
    path, out = write_grid(tmp_path, seeds=2, **QUICK), tmp_path / "out"
    command = [str(path), "--out", str(out), "--no-pictures"]
    learn = CuReSAC.learn

    def learn_or_fail(self: CuReSAC, *args: Any, **kwargs: Any) -> CuReSAC:
        if self.seed == 0:
            raise RuntimeError("no luck")
        return learn(self, *args, **kwargs)

    with monkeypatch.context() as unlucky:
        unlucky.setattr(CuReSAC, "learn", learn_or_fail)
        assert run.main(command) == 1
    printed = capsys.readouterr().out
    assert "seed0: failed: RuntimeError: no luck" in printed and "seed1: done" in printed
    folder = out / "tiny" / "PixelBox" / "cure"
    assert "learn_or_fail" in (folder / "seed0" / "error.txt").read_text()
    assert (folder / "seed1" / "DONE").exists() and not (folder / "seed0" / "DONE").exists()
    assert run.main(command) == 0
    assert (folder / "seed0" / "DONE").exists() and not (folder / "seed0" / "error.txt").exists()
    capsys.readouterr()
    assert run.main(command) == 0
    assert "done" not in capsys.readouterr().out, "nothing is run twice"
    assert run.main([*command, "--dry-run", "--tasks", "PixelBox, "]) == 0
    assert capsys.readouterr().out.count(": done") == 2


def test_cell_of_another_process_is_not_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The status says so, as a job that waits for it would begin too early; nothing is written into its folder."""
    path, out = write_grid(tmp_path, **QUICK), tmp_path / "out"
    command = [str(path), "--out", str(out), "--no-pictures"]
    folder = out / "tiny" / "PixelBox" / "cure" / "seed0"
    folder.mkdir(parents=True)
    with cells.alone_in(folder):
        assert run.main(command) == 1
    assert "seed0 is run by another process" in capsys.readouterr().out
    assert [file.name for file in folder.iterdir()] == [".lock"]

    def run_elsewhere(cell: Any, results: Path, *args: Any) -> None:
        (folder / "DONE").touch()
        raise cells.CellIsRunning("is being run")

    monkeypatch.setattr(run, "run_cell", run_elsewhere)
    assert run.main(command) == 0, "it is done by now"


def test_checkpoint_of_a_finished_cell_is_removed(tmp_path: Path) -> None:
    """Killed between its end and that, a cell is never run again, and its replay buffer would stay for ever."""
    grid, out = load_grid(write_grid(tmp_path, **QUICK)), tmp_path / "out"
    run.run_grid(grid, out, pictures=False)
    left = out / grid.cells[0].folder / "checkpoint" / "segments"
    left.mkdir(parents=True)
    run.run_grid(grid, out, pictures=False)
    assert not left.parent.exists() and grid.cells[0].is_done(out)


# -------------------------------------------------------------- other settings


def test_other_settings_in_the_folder_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of whatever seed and arm, as they are compared; what was there stays as it was. Further seeds and arms go in."""
    path, out = write_grid(tmp_path, **QUICK), tmp_path / "out"
    assert run.run_grid(load_grid(path, seeds=[7]), out, pictures=False) == []
    files = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    monkeypatch.setitem(gym.registry, "elsewhere/PixelBox-v3", gym.registry["grids/PixelBox-v0"])
    changed = {"cure": method(batch_size=9)}
    for changes, sentence in (
        (dict(budget=80), "tiny was run with other settings: budget was 40 and is 80 now"),
        (dict(evaluation=dict(every=20, episodes=1)), "evaluation.every was 40 and is 20 now"),
        (dict(kind="visitation", methods={"other": method()}), "kind was 'curves' and is 'visitation' now"),
        (dict(methods=changed), r"seed7 .*: arguments.batch_size was \d+ and is 9 now"),
        (dict(tasks=["elsewhere/PixelBox-v3"]), "seed7 was run with other settings: task was 'grids/PixelBox-v0'"),
    ):
        with pytest.raises(UsageError, match=sentence):
            run.run_grid(load_grid(write_grid(tmp_path, **{**QUICK, **changes}), seeds=[8]), out, pictures=False)
    assert {file: file.read_bytes() for file in out.rglob("*") if file.is_file()} == files
    more = write_grid(tmp_path, **QUICK, methods={"further": method(curiosity=None)})
    assert run.run_grid(load_grid(more, seeds=[8]), out, pictures=False) == []
    described = json.loads((out / "tiny" / "grid.json").read_text())
    assert described["seeds"] == [0, 7, 8] and described["methods"].keys() == {"cure", "further"}


def test_states_of_cells(tmp_path: Path) -> None:
    """Of a cell that has begun also how far it is."""
    (cell,) = load_grid(write_grid(tmp_path)).cells
    folder = tmp_path / cell.folder
    folder.mkdir(parents=True)

    def state() -> str:
        return run.status_lines([cell], tmp_path)[0].partition(": ")[2]

    assert state() == "waiting"
    (folder / "config.json").touch()
    assert state() == "interrupted"
    (folder / "eval.csv").write_text("environment_steps\n0\n1600\n")
    assert state() == "interrupted, evaluated at 1,600 environment steps"
    with cells.alone_in(folder):
        assert state() == "running, evaluated at 1,600 environment steps"
    (folder / "error.txt").touch()
    assert state().startswith("failed")
    (folder / "DONE").touch()
    assert state() == "done"


# ------------------------------------------------------------------- processes

#: Steps take a while, so that there is something to be killed; with CARDS the first ones wait until two processes
#: have begun, and tell what cards they see.
SLOW_BOX = """
import os, time
from pathlib import Path

import gymnasium as gym
from envs_for_tests import PixelBox


class SlowBox(PixelBox):
    def step(self, action):
        time.sleep(0.005)
        if folder := os.environ.get("CARDS"):
            told = Path(folder) / str(os.getpid())
            if not told.exists():  # once: a process may be killed at any later step
                told.write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "all"))
            deadline = time.monotonic() + 120
            while len(list(Path(folder).iterdir())) < 2:
                assert time.monotonic() < deadline, "no other process has begun"
                time.sleep(0.05)
        return super().step(action)


gym.register("tests/SlowBox-v0", SlowBox)
"""
#: The command, with common heads that are soon fitted
COMMAND = "from sb3_cure.experiments import cells, heads, run; heads.COMMON_UPDATES = 5; raise SystemExit(run.main())"


@pytest.fixture
def slow_grid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Function that writes a grid on a task whose steps take a while, in the working directory."""
    (tmp_path / "slow_box.py").write_text(SLOW_BOX)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", *sys.path]))
    return lambda **changes: write_grid(tmp_path, tasks=["slow_box:tests/SlowBox-v0"], **changes)


def launch(path: Path, out: Path, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-c", COMMAND, str(path), "--out", str(out), "--no-pictures", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def wait_for(what: Any, seconds: float = 400) -> Any:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := what():
            return found
        time.sleep(0.05)
    raise TimeoutError(f"{what} did not come about in {seconds} s")


def has_evaluated(folder: Path) -> bool:
    """More than once, so that it is in the midst of training."""
    path = folder / "eval.csv"
    return path.exists() and len(read_rows(path)) > 1


def outcome(folder: Path) -> Any:
    evaluations = [{**row, "seconds": 0, "cpu_seconds": 0} for row in read_rows(folder / "eval.csv")]
    return evaluations, (folder / "episodes.csv").read_text()


def test_killed_grid_ends_like_one_that_was_not(tmp_path: Path, slow_grid: Any) -> None:
    """kill -9 in the middle of a cell: the same command finishes it with the same rows as without the kill."""
    path = slow_grid(evaluation=dict(every=100, episodes=1))
    (cell,) = load_grid(path).cells
    process = launch(path, tmp_path / "out", "--checkpoint-minutes", "0")
    wait_for(lambda: has_evaluated(tmp_path / "out" / cell.folder))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not cell.is_done(tmp_path / "out")
    for out in ("out", "whole"):
        assert run.run_grid(load_grid(path), tmp_path / out, pictures=False) == []
    killed, whole = (outcome(tmp_path / out / cell.folder) for out in ("out", "whole"))
    assert killed == whole and steps_of(tmp_path / "out" / cell.folder) == [0, 100, 200, 300, 400]
    assert json.loads((tmp_path / "out" / cell.folder / "run.json").read_text())["attempts"] == 2


def test_killed_ray_worker_costs_nothing(tmp_path: Path, slow_grid: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cells of half a card each run at the same time, on that card; one is killed half-way and begun again. All
    rows, also those of the common heads that follow, are those of one process without a kill."""
    pytest.importorskip("ray")
    (tmp_path / "seen").mkdir()
    methods = {"cure": method(device="cpu")}  # where the machine has a card of its own
    path = slow_grid(kind="visitation", seeds=2, budget=300, evaluation=dict(every=100, episodes=1), methods=methods)
    grid, out = load_grid(path), tmp_path / "out"
    with monkeypatch.context() as card:
        card.delenv("CUDA_VISIBLE_DEVICES")  # of the tests; Ray sets those of its workers
        card.setenv("CARDS", str(tmp_path / "seen"))
        card.setenv("RAY_OVERRIDE_RESOURCES", '{"GPU": 1, "CPU": 4}')  # Ray takes any machine's word for its cards
        ray = ["--engine", "ray", "--gpus-per-cell", "0.5", "--checkpoint-minutes", "0"]
        process = launch(path, out, *ray)
        try:
            victim = wait_for(lambda: next((cell for cell in grid.cells if has_evaluated(out / cell.folder)), None))
            holders = [int(each.name) for each in (tmp_path / "seen").iterdir()]
            locked = (out / victim.folder / ".lock").resolve()
            (holder,) = [pid for pid in holders if locked in open_files(pid)]
            os.kill(holder, signal.SIGKILL)
            assert process.wait(timeout=600) == 0
        finally:
            process.kill()
    assert {card.read_text() for card in (tmp_path / "seen").iterdir()} == {"0"}
    assert json.loads((out / victim.folder / "run.json").read_text())["attempts"] == 2
    monkeypatch.setattr(heads, "COMMON_UPDATES", 5)
    assert run.run_grid(grid, tmp_path / "here", pictures=False) == []
    for cell in grid.cells:
        assert outcome(out / cell.folder) == outcome(tmp_path / "here" / cell.folder)
        there, here = (read_rows(folder / cell.folder / "visitation.csv") for folder in (out, tmp_path / "here"))
        assert there == here and any(row["head"] == "common" for row in here)


def open_files(pid: int) -> set[Path]:
    """Of a process that may have ended."""
    try:
        return {link.resolve() for link in Path(f"/proc/{pid}/fd").iterdir()}
    except (FileNotFoundError, ProcessLookupError):
        return set()


def test_unknown_engine_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="engine must be one of local, ray"):
        run.run_grid(load_grid(write_grid(tmp_path)), tmp_path / "out", engine="rya")
    assert not (tmp_path / "out").exists()


def test_workers_without_share_see_no_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray keeps no account of what nobody asks for: a cell per core would compute on the first card."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    seen: list[str] = []
    (cell,) = load_grid(write_grid(tmp_path)).cells

    def run_unit(*_: Any) -> bool:
        seen.append(os.environ["CUDA_VISIBLE_DEVICES"])
        return True

    for has_gpu in (True, False):
        run._run_on_worker(run_unit, has_gpu, cell)
    assert seen == ["0", ""]
