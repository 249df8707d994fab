"""Minutes until a return is reached: what is run, when the clock stands still, and how seeds that fall short count."""

import argparse
import json
import multiprocessing
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from benchmarks import peers
from benchmarks import time_summary as summary
from benchmarks import time_to_return as ttr
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation.result_files import read_rows, write_csv, write_json


def make_run(
    returns: Sequence[float], minutes_each: float = 1.0, stopped_by: str = "steps", limit: float = 30.0
) -> summary.Run:
    """Evaluated every ``minutes_each`` minutes of training, from 0 on."""
    rows = []
    for number, value in enumerate(returns):
        numbers = (2000 * number, 16_000 * number, 60 * minutes_each * number, value, 1.0, 10, "")
        rows.append(dict(zip(summary.COLUMNS, numbers, strict=True)))
    rows[-1]["limit"] = stopped_by
    times = {"training_seconds": 60.0, "training_wall_seconds": 90.0}
    details = {**dict.fromkeys(summary.CONDITIONS, "x"), **times, "stopped_by": stopped_by, "minutes": limit}
    return summary.Run(rows, details)


def write_run(
    out: Path, arm: str, seed: int, run: summary.Run, finished: bool = True, task: str = "cartpole-swingup"
) -> None:
    path = out / task / arm / f"seed{seed}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, summary.COLUMNS, run.rows)
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
    assert run.time_text(250) == "3.0" and run.time_text(301) == ">6.0 (steps)"


@pytest.mark.parametrize(
    ("minutes", "median"),
    [
        ([5.0, 3.0, 4.0, 1.0, 2.0], 3.0),
        ([5.0, None, 4.0, None, 6.0], 6.0),
        ([5.0, None, 4.0, None, None], None),
        ([4.0, None, None, 3.0], 4.0),
        ([None], None),
        ([2.0], 2.0),
    ],
)
def test_median_counts_censored_seeds(minutes: list[float | None], median: float | None) -> None:
    """The median is when half of all seeds are there: dropping those that are not would make it earlier."""
    runs = {
        seed: make_run([0, 50 if each is None else 500], minutes_each=each or 30.0) for seed, each in enumerate(minutes)
    }
    assert summary.median_time(summary.times_to(runs, 500)) == median


def test_early_step_limit_does_not_help_an_arm() -> None:
    """Two of five reach it. Censored when the steps ended, three would leave Kaplan and Meier a median of 20."""
    short = [make_run([0, 100], minutes_each=8) for _ in range(3)]
    runs = [make_run([0, 350], minutes_each=5), make_run([0, 350], minutes_each=20), *short]
    (row, *_) = summary.summarise({"cartpole-swingup": {"curl": dict(enumerate(runs))}})
    assert (row["target"], row["reached"], row["seeds"], row["median_minutes"]) == (300, 2, 5, "not reached")
    assert row["minutes"] == (
        "seed 0: 5.0; seed 1: 20.0; seed 2: >8.0 (steps); seed 3: >8.0 (steps); seed 4: >8.0 (steps)"
    )


def test_p_values_compare_with_best() -> None:
    """Clear differences are seen, and where neither arm gets there nothing is."""
    ours = {seed: make_run([0, 550], minutes_each=1 + seed / 10) for seed in range(5)}
    theirs = {seed: make_run([0, 0, 350], minutes_each=9 + seed / 10) for seed in range(5)}
    rows = summary.summarise({"finger-spin": {"best": ours, "drqv2": theirs}})
    p_values = {(row["arm"], row["target"]): row["p_value"] for row in rows}
    assert p_values["best", 300] == ""
    assert p_values["drqv2", 300] < 0.01 and p_values["drqv2", 500] < 0.01 and p_values["drqv2", 700] == 1


def test_return_after_minutes_is_the_last_one_until_then() -> None:
    """The last evaluation, a step beyond the limit, is the limit's; where steps ended it before, its last one holds."""
    run = make_run([20, 300, 400, 350], minutes_each=10.01, stopped_by="minutes", limit=30)
    assert [run.return_after(minutes) for minutes in (10, 10.01, 29, 30)] == [20, 300, 400, 350]
    assert np.isnan(run.return_after(31))
    assert make_run([20, 300]).return_after(30) == 300
    assert make_run([100, 100, 300, 300], 5, limit=15).mean_over_time == pytest.approx(500 / 3 + 200 / 6)


def test_summary_reads_finished_cells_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without its JSON file a cell does not count."""
    for seed, minutes in enumerate((2, 4, 3)):
        write_run(tmp_path, "curl", seed, make_run([20, 305, 555], minutes))
    write_run(tmp_path, "curl", 3, make_run([800]), finished=False)
    write_run(tmp_path, "sac_ae", 3, make_run([20, 30]), task="reacher-easy")
    assert ttr.main(["--out", str(tmp_path), "--summarise-only"]) == 0
    rows = {(row["arm"], row["target"]): row for row in read_rows(tmp_path / "summary.csv")}
    assert [rows["curl", target]["median_minutes"] for target in summary.TARGETS] == [3, 6, "not reached"]
    assert rows["curl", 300]["seeds"] == 3
    table = (tmp_path / "table.md").read_text()
    assert "| 3.0 (3 of 3) | 6.0 (3 of 3) | not reached (0 of 3) |" in table
    assert table in capsys.readouterr().out
    assert (tmp_path / "time_to_return.png").exists()


def test_minutes_of_several_machines_do_not_mix(tmp_path: Path) -> None:
    for seed, machine in enumerate(("one", "another")):
        run = make_run([20, 30])
        write_run(tmp_path, "curl", seed, summary.Run(run.rows, {**run.details, "machine": machine}))
    with pytest.raises(UsageError, match="several machines"):
        summary.read_runs(tmp_path)


def test_arms_share_pixels_and_sizes(tmp_path: Path) -> None:
    """Same task, pixels, hidden layers and batches; the two of SB3 differ in what they are named for."""
    arms = ("sac_ae", "curl", "public", *ttr.SB3)
    cells = {arm: ttr.make_cell(arm, "cartpole-swingup", 3, tmp_path) for arm in arms}
    first = cells["sac_ae"]
    assert first.env_kwargs["renderer"] == "fast"
    for arm, cell in cells.items():
        assert (cell.method, cell.seed, cell.task, cell.env_kwargs) == (arm, 3, first.task, first.env_kwargs)
    assert cells["public"].arguments["hidden_dim"] == 256 and cells["public"].arguments["batch_size"] == 128
    assert cells["sb3_sac"].arguments == {"policy": "CnnPolicy", "buffer_size": 100_000}
    ours = {"learning_rate": 1e-3, "learning_starts": 500, "batch_size": 128}
    assert cells["sb3_sac_our_sizes"].arguments == {
        **{**cells["sb3_sac"].arguments, **ours},
        "policy_kwargs": {"net_arch": first.arguments["policy_kwargs"]["net_arch"]},
    }


def test_unknown_arms_are_refused(tmp_path: Path) -> None:
    """Also a recipe that has no file."""
    for arm in ("no_such_recipe", "drqv2_fast"):
        with pytest.raises(UsageError, match=arm):
            ttr.make_cell(arm, "cartpole-swingup", 0, tmp_path)


def test_peer_takes_the_settings_of_its_best_trial(tmp_path: Path) -> None:
    """Of the mean over the minutes, not of the last return; CURL's images are larger, as it crops them."""
    arms = peers.trial_arms("public_curl")
    for number, arm in enumerate(arms):
        if arm != arms[-1]:
            curve = [0, 400, 400] if number == 1 else [0, 0, 700]
            write_run(tmp_path, arm, 0, make_run(curve, minutes_each=10, limit=20))
    with pytest.raises(UsageError, match=f"{arms[-1]} are missing"):
        ttr.make_cell("public_curl", "reacher-easy", 20, tmp_path)
    write_run(tmp_path, arms[-1], 0, make_run([0, 0, 700], minutes_each=10, limit=20))
    cell = ttr.make_cell("public_curl", "reacher-easy", 20, tmp_path)
    assert cell.method == "public_curl" and cell.arguments["settings_of"] == arms[1]
    assert cell.arguments["agent"] == peers.PEERS["public_curl"].trials[arms[1].removeprefix("public_curl_")]["agent"]
    assert (cell.env_kwargs["image_size"], cell.arguments["image_size"]) == (57, 48)


@pytest.mark.parametrize("name", peers.PEERS)
def test_other_commits_of_a_peer_are_refused(name: str, tmp_path: Path) -> None:
    """What is changed in memory fits one commit."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=x", "-c", "user.email=x@example.com"]
    for command in (["init", "-q"], ["commit", "-q", "--allow-empty", "-m", "Other"]):
        subprocess.run([*git, *command], check=True)
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(argparse.ArgumentTypeError, match=peers.PEERS[name].commit):
            peers.PEERS[name].folder(str(folder))


def test_encoder_of_drqv2_gets_our_sizes() -> None:
    """Layers and strides stay; the output's size follows from image and filters."""

    class Encoder(nn.Module):
        def __init__(self, obs_shape: tuple[int, ...]):
            super().__init__()
            self.repr_dim = 32 * 35 * 35
            first = nn.Conv2d(obs_shape[0], 32, 3, stride=2)
            self.convnet = nn.Sequential(first, nn.ReLU(), nn.Conv2d(32, 32, 3, stride=1), nn.ReLU())

    encoder = peers.resized(Encoder, 16, lambda layer: None)((3, 36, 36))
    assert [layer.weight.shape for layer in encoder.convnet[::2]] == [(16, 3, 3, 3), (16, 16, 3, 3)]
    assert encoder.convnet[0].stride == (2, 2)
    assert encoder.convnet(th.zeros(1, 3, 36, 36)).numel() == encoder.repr_dim == 16 * 15 * 15


class Clock:
    """In the place of the record's clock: CPU and wall-clock seconds."""

    seconds = 0.0

    def now(self) -> np.ndarray:
        return np.array([self.seconds, 2 * self.seconds])


class SlowEnv(gym.Env):
    """Two steps per episode, each of which takes 20 ms; the return is the seed of the reset."""

    observation_space = spaces.Box(0, 1, (1,))
    action_space = spaces.Box(-1, 1, (1,))
    action_repeat = 8

    def __init__(self, clock: Clock):
        self.clock = clock

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.left, self.seed = 2, seed
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.clock.seconds += 0.02
        self.left -= 1
        return np.zeros(1, np.float32), self.seed / 2, False, self.left == 0, {}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(ttr.Record, "_now", staticmethod(clock.now))
    return clock


def make_record(folder: Path, minutes: float, clock: Clock) -> ttr.Record:
    cell = ttr.make_cell("curl", "cartpole-swingup", 0, folder)
    limits: dict[str, Any] = {"budget": 80, "eval_every": 4, "eval_episodes": 5}
    return ttr.Record(folder / "seed0.csv", replace(cell, **limits), minutes, SlowEnv(clock))


def test_clock_stands_still_during_evaluation(tmp_path: Path, clock: Clock) -> None:
    """Evaluations at 0, 4, 8 and the last step, on the same seeds; of 0.2 seconds each none are training's."""
    record = make_record(tmp_path, 1, clock)
    for step in range(11):
        record.visit(step, np.zeros_like)
        clock.seconds += 1.5
    record.visit(10, np.zeros_like, finished=True)
    assert clock.seconds == pytest.approx(11 * 1.5 + 4 * 0.2)
    assert record.times() == pytest.approx((11 * 1.5, 2 * 11 * 1.5))
    rows = read_rows(tmp_path / "seed0.csv")
    assert [row["agent_steps"] for row in rows] == [0, 4, 8, 10]
    assert [row["environment_steps"] for row in rows] == [0, 32, 64, 80]
    assert [row["training_seconds"] for row in rows] == [0, 6, 12, 16.5]
    assert {row["return_mean"] for row in rows} == {10_002} and {row["episodes"] for row in rows} == {5}
    assert [row["limit"] for row in rows] == ["", "", "", "steps"]


def test_odd_interval_with_an_update_every_second_step(tmp_path: Path, clock: Clock) -> None:
    """The recipe is asked at even steps alone, and evaluated as often as the others."""
    record = make_record(tmp_path, 1, clock)
    record.cell = replace(record.cell, eval_every=5)
    for step in range(0, 32, 2):
        record.visit(step, np.zeros_like)
    assert [row["agent_steps"] for row in read_rows(tmp_path / "seed0.csv")] == [0, 6, 10, 16, 20, 26, 30]


def test_minutes_end_a_run_and_are_named(tmp_path: Path, clock: Clock) -> None:
    """The last evaluation may be one that was due; it is not made twice."""
    record = make_record(tmp_path, 2, clock)
    clock.seconds = 119
    assert not record.is_time_up() and record.progress(1) == 119 / 120 and record.progress(20) == 2
    clock.seconds = 120
    assert record.is_time_up()
    record.visit(4, np.zeros_like)
    record.visit(4, np.zeros_like, finished=True)
    (row,) = read_rows(tmp_path / "seed0.csv")
    assert row["limit"] == "minutes" and row["training_seconds"] == 120


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
            write_run(out, cell.method, cell.seed, summary.Run(run.rows, {**run.details, **settings}))
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
    with pytest.raises(UsageError, match="budget"):
        ttr.run_missing(tmp_path, [ttr.make_cell("curl", "cartpole-swingup", 0, tmp_path)], 30, 1, {})
    assert len(processes.ran) == 4


@pytest.mark.parametrize("arm", ["public", "drqv2_own", "public_curl"])
def test_public_arms_need_their_clones(arm: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        ttr.main(["--out", str(tmp_path), "--arms", arm])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arm", ["sac_ae", "sb3_sac"])
def test_cell_trains_on_real_pixels(arm: str, tmp_path: Path) -> None:
    """In a process of its own, with one thread."""
    limits: dict[str, Any] = {"budget": 48, "eval_every": 4, "eval_episodes": 1}
    cell = replace(ttr.make_cell(arm, "cartpole-swingup", 0, tmp_path), **limits)
    process = multiprocessing.get_context("forkserver").Process(target=ttr.run_cell, args=(tmp_path, cell, 5.0, None))
    process.start()
    process.join()
    path = ttr.cell_path(tmp_path, cell)
    rows = read_rows(path)
    assert [(row["agent_steps"], row["environment_steps"]) for row in rows] == [(0, 0), (4, 32), (6, 48)]
    assert 0 < rows[-1]["return_mean"] < 1000
    details = json.loads(path.with_suffix(".json").read_text())
    assert details["stopped_by"] == "steps" and "1 threads" in details["machine"]
    assert details["arguments"]["policy"] == "CnnPolicy" and "commit" in details
