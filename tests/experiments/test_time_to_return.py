"""Minutes until a return is reached: what is run, when the clock stands still, and how seeds that fall short count."""

import json
import multiprocessing
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image

from benchmarks import time_to_return as ttr
from sb3_cure.evaluation.result_files import read_rows, write_csv, write_json
from sb3_cure.experiments.grid import GridError


def make_run(returns: Sequence[float], minutes_each: float = 1.0, stopped_by: str = "steps") -> ttr.Run:
    """Evaluated every ``minutes_each`` minutes of training, from 0 on."""
    rows = []
    for number, value in enumerate(returns):
        numbers = (2000 * number, 16_000 * number, 60 * minutes_each * number, value, 1.0, 10, "")
        rows.append(dict(zip(ttr.COLUMNS, numbers, strict=True)))
    rows[-1]["limit"] = stopped_by
    details = {"stopped_by": stopped_by, "training_cpu_seconds": 30.0}
    return ttr.Run(rows, {**dict.fromkeys(ttr.CONDITIONS, "x"), **details})


def write_run(out: Path, arm: str, seed: int, run: ttr.Run, finished: bool = True) -> None:
    path = out / arm / f"seed{seed}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, ttr.COLUMNS, run.rows)
    if finished:
        write_json(path.with_suffix(".json"), {"seed": seed, **run.details})


def test_first_evaluation_at_target_counts() -> None:
    """An equal mean is enough, a later fall changes nothing, and nothing is read between two evaluations."""
    run = make_run([20, 199.9, 250, 100, 300], minutes_each=1.5)
    assert run.minutes_to(199) == 1.5
    assert run.minutes_to(200) == 3.0
    assert run.minutes_to(250) == 3.0
    assert run.minutes_to(250.1) == 6.0
    assert run.minutes_to(301) is None
    assert run.told(250) == "3.0" and run.told(301) == ">6.0 (steps)"


@pytest.mark.parametrize(
    ("minutes", "median"),
    [
        ([5.0, 3.0, 4.0, 1.0, 2.0], 3.0),
        ([5.0, None, 4.0, None, 6.0], 6.0),
        ([5.0, None, 4.0, None, None], None),
        ([4.0, None, None, 3.0], 4.0),
        ([None], None),
        ([2.0], 2.0),
        ([], None),
    ],
)
def test_censored_seeds_rank_last(minutes: list[float | None], median: float | None) -> None:
    """The median is when half of all seeds are there: dropping those that are not would make it earlier."""
    assert ttr.censored_median(minutes) == median


def test_early_step_limit_does_not_help_an_arm() -> None:
    """Two of five reach it. Censoring them at their early limits in Kaplan and Meier's estimate would give 20."""
    short = [make_run([0, 100], minutes_each=8) for _ in range(3)]
    runs = [make_run([0, 250], minutes_each=5), make_run([0, 250], minutes_each=20), *short]
    (_, row, _) = ttr.summarise({"curl": dict(enumerate(runs))})
    assert (row["target"], row["reached"], row["seeds"], row["median_minutes"]) == (250, 2, 5, "not reached")
    assert row["minutes"] == (
        "seed 0: 5.0; seed 1: 20.0; seed 2: >8.0 (steps); seed 3: >8.0 (steps); seed 4: >8.0 (steps)"
    )


def test_ratio_is_bounded_where_public_falls_short() -> None:
    """Its median is then at least that of the times and limits of its seeds."""

    def arm(*runs: ttr.Run) -> dict[int, ttr.Run]:
        return dict(enumerate(runs))

    ours, public = arm(make_run([0, 260], 2)), arm(make_run([0, 0, 260], 4))
    assert ttr.ratio_of_medians(ours, public, 250) == "0.25"
    assert ttr.ratio_of_medians(ours, public, 300) == ttr.NONE
    limits = arm(make_run([0, 0, 0], 10, "minutes"), make_run([0, 0, 0], 5), make_run([260, 260], 1))
    assert ttr.ratio_of_medians(ours, limits, 250) == "<0.20"  # 2 of at least 10
    assert ttr.ratio_of_medians(ours, {}, 250) == ttr.NONE


def test_summary_reads_finished_cells_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without its JSON file a cell does not count."""
    for seed, minutes in enumerate((2, 4, 3)):
        write_run(tmp_path, "curl", seed, make_run([20, 205, 255], minutes))
        write_run(tmp_path, "public", seed, make_run([20, 30, 255], 3 * minutes, "minutes"))
    write_run(tmp_path, "curl", 3, make_run([300]), finished=False)
    assert ttr.main(["--out", str(tmp_path), "--summarise-only"]) == 0
    rows = {(row["arm"], row["target"]): row for row in read_rows(tmp_path / "summary.csv", ttr.SUMMARY_COLUMNS)}
    assert [rows["curl", target]["median_minutes"] for target in ttr.TARGETS] == [3, 6, "not reached"]
    assert [rows["curl", target]["of_public"] for target in ttr.TARGETS] == [0.17, 0.33, ttr.NONE]
    assert rows["curl", 250]["seeds"] == 3
    table = (tmp_path / "table.md").read_text()
    assert "| curl | 3.0 (3 of 3), 0.17 | 6.0 (3 of 3), 0.33 | not reached (0 of 3)" in table
    assert table in capsys.readouterr().out
    assert Image.open(tmp_path / "time_to_return.png").size[0] == 900


def test_arms_share_pixels_and_sizes() -> None:
    """Same task, pixels, hidden layers and batches; the two of SB3 differ in what they are named for."""
    cells = {arm: ttr.make_cell(arm, 3, 100_000, 2000, 10) for arm in ttr.ARMS}
    first = cells["sac_ae"]
    assert first.env_kwargs["renderer"] == "fast"
    for arm, cell in cells.items():
        assert (cell.method, cell.seed, cell.budget) == (arm, 3, 100_000)
        assert (cell.task, cell.env_kwargs) == (first.task, first.env_kwargs)
    assert cells["public"].arguments["hidden_dim"] == 256 and cells["public"].arguments["batch_size"] == 128
    assert cells["sb3_sac"].arguments == {"policy": "CnnPolicy", "buffer_size": 20_000}
    ours = {"learning_rate": 1e-3, "learning_starts": 500, "batch_size": 128}
    assert cells["sb3_sac_our_sizes"].arguments == {
        **{**cells["sb3_sac"].arguments, **ours},
        "policy_kwargs": {"net_arch": first.arguments["policy_kwargs"]["net_arch"]},
    }


class SlowEnv(gym.Env):
    """Two steps per episode, each of which takes 20 ms; the return is the seed of the reset."""

    observation_space = spaces.Box(0, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))
    action_repeat = 8

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.left, self.seed = 2, seed
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        time.sleep(0.02)
        self.left -= 1
        return np.zeros(1, np.float32), self.seed / 2, False, self.left == 0, {}


def make_record(path: Path, minutes: float) -> ttr.Record:
    return ttr.Record(path, ttr.make_cell("curl", 0, 8 * 10, 4, 5), minutes, SlowEnv())


def test_clock_stands_still_during_evaluation(tmp_path: Path) -> None:
    """Evaluations at 0, 4, 8 and the last step, on the same seeds; of 0.2 seconds each none are training's."""
    record = make_record(tmp_path / "seed0.csv", minutes=1)
    began = time.perf_counter()
    for step in range(11):
        record.visit(step, np.zeros_like)
    record.visit(10, np.zeros_like, finished=True)
    assert time.perf_counter() - began > 0.8 and record.times()[0] < 0.4
    rows = read_rows(tmp_path / "seed0.csv", ttr.COLUMNS)
    assert [row["agent_steps"] for row in rows] == [0, 4, 8, 10]
    assert [row["environment_steps"] for row in rows] == [0, 32, 64, 80]
    assert {row["return_mean"] for row in rows} == {10_002} and {row["episodes"] for row in rows} == {5}
    assert [row["limit"] for row in rows] == ["", "", "", "steps"]


def test_minutes_end_a_run_and_are_named(tmp_path: Path) -> None:
    """The last evaluation may be one that was due; it is not made twice."""
    record = make_record(tmp_path / "seed0.csv", minutes=1 / 60)
    time.sleep(0.1)
    assert not record.is_time_up()
    time.sleep(0.95)
    assert record.is_time_up()
    record.visit(4, np.zeros_like)
    record.visit(4, np.zeros_like, finished=True)
    (row,) = read_rows(tmp_path / "seed0.csv")
    assert row["limit"] == "minutes" and row["training_seconds"] >= 1


class FakeProcesses:
    """In the place of a context of ``multiprocessing``: notes which cells are to run, and finishes all but one."""

    def __init__(self) -> None:
        self.ran: list[tuple[str, int]] = []

    def Process(self, target: Any, args: tuple[Any, ...]) -> "FakeProcesses":
        out, cell, minutes, _ = args
        self.ran.append((cell.method, cell.seed))
        self.exitcode = int(cell.seed == 1)
        if not self.exitcode:
            run = make_run([20, 210])
            settings = ttr.settings_of(cell, minutes)
            write_run(out, cell.method, cell.seed, ttr.Run(run.rows, {**run.details, **settings}))
        return self

    def start(self) -> None: ...

    def join(self) -> None: ...


def test_finished_cells_run_once_with_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What failed is told and begun anew, and other limits are refused before anything is run."""
    processes = FakeProcesses()
    monkeypatch.setattr(ttr, "get_context", lambda method: processes)
    monkeypatch.setattr(ttr.os, "environ", dict(ttr.os.environ))
    arguments = ["--out", str(tmp_path), "--arms", "curl", "sb3_sac", "--jobs", "1"]
    assert ttr.main([*arguments, "--seeds", "0"]) == 0
    assert processes.ran == [("curl", 0), ("sb3_sac", 0)]
    assert ttr.main([*arguments, "--seeds", "0", "1"]) == 1
    assert processes.ran[2:] == [("curl", 1), ("sb3_sac", 1)]
    with pytest.raises(SystemExit):
        ttr.main([*arguments, "--seeds", "0", "--minutes", "5"])
    with pytest.raises(GridError, match="budget"):
        cells = [ttr.make_cell("curl", 0, 50, 2000, 10)]
        ttr.run_missing(tmp_path, cells, 30, 1, None)
    assert len(processes.ran) == 4


def test_public_arm_asks_for_its_clone(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        ttr.main(["--out", str(tmp_path), "--seeds", "0"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arm", ["sac_ae", "sb3_sac"])
def test_cell_trains_on_real_pixels(arm: str, tmp_path: Path) -> None:
    """In a process of its own, with one thread."""
    cell = ttr.make_cell(arm, 0, 48, 4, 1)
    process = multiprocessing.get_context("spawn").Process(target=ttr.run_cell, args=(tmp_path, cell, 5.0, None))
    process.start()
    process.join()
    rows = read_rows(tmp_path / arm / "seed0.csv", ttr.COLUMNS)
    assert [(row["agent_steps"], row["environment_steps"]) for row in rows] == [(0, 0), (4, 32), (6, 48)]
    assert 0 < rows[-1]["return_mean"] < 1000
    details = json.loads((tmp_path / arm / "seed0.json").read_text())
    assert details["stopped_by"] == "steps" and "1 threads" in details["machine"]
    assert details["arguments"]["policy"] == "CnnPolicy" and "commit" in details
