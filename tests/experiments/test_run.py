"""Runs of grids: failures stop nothing else, settings are not mixed, and kills lose nothing."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import psutil
import pytest
from grids_for_tests import method, steps_of, write_grid

from sb3_cure import CuReSAC
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation.result_files import read_rows
from sb3_cure.experiments import cells, run
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

#: Steps take a while, so that there is something to be killed; the first ones wait until two processes have begun.
SLOW_BOX = """
import os, time
from pathlib import Path

import gymnasium as gym
from envs_for_tests import PixelBox


class SlowBox(PixelBox):
    def step(self, action):
        time.sleep(0.005)
        if folder := os.environ.get("TOGETHER"):
            (Path(folder) / str(os.getpid())).touch()
            deadline = time.monotonic() + 120
            while len(list(Path(folder).iterdir())) < 2:
                assert time.monotonic() < deadline, "no other process has begun"
                time.sleep(0.05)
        return super().step(action)


gym.register("tests/SlowBox-v0", SlowBox)
"""


class SideBySide:
    """The command that runs both cells of a grid at the same time.

    :param path: The grid
    """

    def __init__(self, path: Path):
        self.grid, self.out, self.begun = load_grid(path), path.parent / "out", path.parent / "begun"
        self.begun.mkdir()
        command = [sys.executable, "-m", "sb3_cure.cli.main", "experiment", str(path), "--out", str(self.out)]
        options = ["--no-pictures", "--checkpoint-minutes", "0.01", "--jobs", "2"]
        environment = {**os.environ, "TOGETHER": str(self.begun)}
        self.process = subprocess.Popen(
            [*command, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # which a shell's background job ignores
        )

    def wait_for_training(self) -> None:
        """Wait until both cells are in the midst of training."""
        cells = self.grid.cells
        wait_for(lambda: all(has_evaluated(self.out / cell.folder) for cell in cells))
        assert not any(cell.is_done(self.out) for cell in cells)
        self.workers = [int(file.name) for file in self.begun.iterdir()]


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SideBySide]:
    """A command with two cells of a task whose steps take a while."""
    (tmp_path / "slow_box.py").write_text(SLOW_BOX)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", *sys.path]))
    evaluation = dict(every=100, episodes=1)
    running = SideBySide(write_grid(tmp_path, tasks=["slow_box:tests/SlowBox-v0"], seeds=2, evaluation=evaluation))
    try:
        running.wait_for_training()
        yield running
    finally:
        running.process.kill()
        running.process.communicate()


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


def test_killed_grid_ends_like_one_that_was_not(command: SideBySide, tmp_path: Path) -> None:
    """kill -9 in the middle of two cells: their processes leave, and the same command finishes both with the same rows
    as without the kill."""
    killed, whole = command.out, tmp_path / "whole"
    command.process.kill()
    wait_for(lambda: not any(psutil.pid_exists(pid) for pid in command.workers))
    for out in (killed, whole):
        assert run.run_grid(command.grid, out, pictures=False) == []
    for cell in command.grid.cells:
        assert outcome(killed / cell.folder) == outcome(whole / cell.folder)
        assert steps_of(whole / cell.folder) == [0, 100, 200, 300, 400]
        assert json.loads((killed / cell.folder / "run.json").read_text())["attempts"] == 2


#: A cell of seed 1 ends without a word, one of seed 2 raises, one of seed 3 is killed, as long as FAILS is set.
FAILING_BOX = """
import os, signal

import gymnasium as gym
from envs_for_tests import PixelBox


class FailingBox(PixelBox):
    def reset(self, *, seed=None, options=None):
        if "FAILS" in os.environ:
            if seed == 1:
                os._exit(3)
            if seed == 2:
                raise SystemExit("the window was closed")
            if seed == 3:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed, options=options)


gym.register("tests/FailingBox-v0", FailingBox)
"""


def test_workers_fail_and_finish_as_this_process_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What failed is known by its sentence and stops no other, and another call finishes it, in a worker or here;
    each worker has its share of the threads."""
    (tmp_path / "failing_box.py").write_text(FAILING_BOX)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("torch.get_num_threads", lambda: 4)
    monkeypatch.setenv("FAILS", "")
    path = write_grid(tmp_path, tasks=["failing_box:tests/FailingBox-v0"], seeds=[1, 2, 3, 4], **QUICK)
    command = [str(path), "--out", str(tmp_path / "out"), "--no-pictures"]
    assert run.main([*command, "--jobs", "2"]) == 1
    assert "1 of 4 finished" in capsys.readouterr().out
    ended, raised, killed, other = (tmp_path / "out" / cell.folder for cell in load_grid(path).cells)
    assert "ended with status 3" in (ended / "error.txt").read_text()
    assert "the window was closed" in (raised / "error.txt").read_text()
    assert "killed by signal 9" in (killed / "error.txt").read_text()
    assert (other / "DONE").exists() and "2 threads" in (other / "run.json").read_text()
    monkeypatch.delenv("FAILS")
    assert run.main([*command, "--jobs", "2", "--seeds", "3,"]) == 0
    assert (killed / "DONE").exists() and run.main(command) == 0
    assert all((folder / "DONE").exists() for folder in (ended, raised, killed))


def test_number_of_jobs_is_positive(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="jobs must be 1 or more, not -1"):
        run.run_grid(load_grid(write_grid(tmp_path)), tmp_path / "out", jobs=-1)
    assert not (tmp_path / "out").exists()


def test_interrupted_command_leaves_no_worker(command: SideBySide) -> None:
    """Ctrl-C ends in one sentence."""
    for pid in [*command.workers, command.process.pid]:  # as a terminal does
        os.kill(pid, signal.SIGINT)
    printed, _ = command.process.communicate(timeout=600)
    assert command.process.returncode == 130 and printed.splitlines()[-1].startswith("Stopped: ")
    assert "Traceback" not in printed and not any(cell.is_done(command.out) for cell in command.grid.cells)
    assert not any(psutil.pid_exists(pid) for pid in command.workers)
