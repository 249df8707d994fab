"""Cells: what one training keeps, that the arms of a seed are paired, and that no interruption shows in the results."""

import json
import math
import random
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from grids_for_tests import DMC_TASK, TASK, method, steps_of, write_grid
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure import CuReSAC
from sb3_cure.cli.usage import UsageError
from sb3_cure.evaluation import plots
from sb3_cure.evaluation.result_files import read_rows
from sb3_cure.experiments import cells, media, run, visitation
from sb3_cure.experiments.cells import run_cell
from sb3_cure.experiments.grid import Cell, Grid, load_grid

pytestmark = pytest.mark.usefixtures("quick_disk")


@pytest.fixture
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture of reconstructions is drawn anew for each of its rows, which takes half a second each time."""
    monkeypatch.setattr(media, "ROWS_OF_RECONSTRUCTIONS", 1)


def only_cell(folder: Path, **changes: Any) -> Cell:
    (cell,) = load_grid(write_grid(folder, **changes)).cells
    return cell


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Cell, Path]:
    """A cell that was trained without pictures, and the folder of all results."""
    out = tmp_path_factory.mktemp("finished")
    cell = only_cell(out)
    run_cell(cell, out, pictures=False)
    return cell, out


# -------------------------------------------------------------------- results


def test_cell_keeps_its_curve(finished: tuple[Cell, Path]) -> None:
    """Evaluated untrained, at every interval and at the end."""
    cell, out = finished
    rows = read_rows(out / cell.folder / "eval.csv")
    assert [row["environment_steps"] for row in rows] == [0, 160, 320, 400]
    assert [row["agent_steps"] for row in rows] == [0, 40, 80, 100]
    # 2 of the burst, and one per step after the 20 of the warm-up
    assert [row["updates"] for row in rows] == [0, 2 + 20, 2 + 60, 2 + 80]
    assert all(row["curious_srl_error"] > 0 and row["task_srl_error"] > 0 for row in rows)
    assert rows[-1]["task_srl_error"] < rows[0]["task_srl_error"], "the autoencoder has learned"
    episodes = read_rows(out / cell.folder / "episodes.csv")
    for row in rows:
        at = (row["environment_steps"], "task")
        returns = [each["return"] for each in episodes if (each["environment_steps"], each["actor"]) == at]
        assert len(returns) == 2 and row["return_mean"] == pytest.approx(np.mean(returns))
    assert CuReSAC.load(out / cell.folder / "model.zip").num_timesteps == 100
    assert not (out / cell.folder / "checkpoint").exists()


def test_cell_keeps_what_it_was_run_with(finished: tuple[Cell, Path]) -> None:
    """Versions, machine, commit, and the arguments as given."""
    cell, out = finished
    conditions = json.loads((out / cell.folder / "run.json").read_text())
    assert conditions["attempts"] == 1 and conditions["device"] == "cpu" and conditions["precision"] == "fp32"
    assert {"mujoco", "torch", "sb3_contrib", "sb3_cure"} <= conditions["versions"].keys() and "commit" in conditions
    config = json.loads((out / cell.folder / "config.json").read_text())
    assert config["action_repeat"] == 4 and config["arguments"]["batch_size"] == 8


def test_curious_policy_is_evaluated_at_the_end_only(tmp_path: Path) -> None:
    cell = only_cell(tmp_path, budget=120, evaluation=dict(every=40, episodes=1, curious="end"))
    rows = read_rows(run_cell(cell, tmp_path, 0, pictures=False) / "eval.csv")
    assert [row["curious_return_mean"] != "" for row in rows] == [False] * 3 + [True]


@pytest.mark.parametrize(
    ("arm", "by_task", "by_second"),
    [
        (dict(curiosity=None), 80, 0),
        (dict(curiosity_prob=1.0), 0, 80),
        (dict(curiosity="random", curiosity_prob=1.0), 0, 80),
        (dict(task=False), 0, 80),
    ],
)
def test_rewards_met_by_actor_and_late(
    arm: dict[str, Any], by_task: int, by_second: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reward of 1 in each of 100 steps: 20 of the warm-up, 80 by who acted; late are 12 of the 20 of an episode."""
    step = PixelBox.step

    def step_for_one(self: PixelBox, action: np.ndarray) -> tuple[Any, ...]:
        observation, _, *rest = step(self, action)
        return observation, 1.0, *rest

    monkeypatch.setattr(PixelBox, "step", step_for_one)
    cell = only_cell(tmp_path, methods={"arm": method(**arm)}, evaluation=dict(every=200, episodes=1))
    last = read_rows(run_cell(cell, tmp_path, pictures=False) / "eval.csv")[-1]
    assert last["rewards_met"] == 100 and last["rewards_met_late"] == 5 * 12
    assert (last["rewards_met_task"], last["rewards_met_curious"]) == (by_task, by_second)


def test_finished_cell_is_not_run_twice(finished: tuple[Cell, Path]) -> None:
    cell, out = finished
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.name != ".lock"}
    run_cell(cell, out, pictures=False)
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.name != ".lock"}


def test_arms_without_srl_or_curiosity_are_measured(tmp_path: Path) -> None:
    """SAC as a baseline: returns and visits without SRL errors."""
    sac = method(srl=None, curiosity=None, warmup_updates=None)
    (cell,) = load_grid(write_grid(tmp_path, kind="visitation", budget=100, methods={"sac": sac})).cells
    folder = run_cell(cell, tmp_path)
    last = read_rows(folder / "eval.csv")[-1]
    assert last["return_mean"] > 0 and last["task_srl_error"] == "" == last["curious_return_mean"]
    heads = {(row["actor"], row["head"]) for row in read_rows(folder / "visitation.csv")}
    assert heads == {(actor, head) for actor in ("task", "random") for head in ("zero", "mean_image")}


OWN = """
import gymnasium as gym
from envs_for_tests import PixelBox
from sb3_cure.srl import RAE

gym.register("tests/Camera-v0", lambda **kwargs: PixelBox(channels_last=True, **kwargs))

class Head(RAE):
    pass
"""


@pytest.mark.usefixtures("few_rows")
def test_own_environment_and_head_are_named_by_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Images have the channels last, and frames lie on disk; the model that is kept loads with what the cell names."""
    (tmp_path / "camera_of_a_grid.py").write_text(OWN)
    (tmp_path / "frames").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    on_disk = {"frames_dir": str(tmp_path / "frames"), "frame_stack": 2}
    buffer = "sb3_cure.data.buffers.FrameStackReplayBuffer"
    overrides = dict(srl="camera_of_a_grid.Head", replay_buffer_class=buffer, replay_buffer_kwargs=on_disk)
    task = "camera_of_a_grid:tests/Camera-v0"
    cell = only_cell(tmp_path, tasks=[task], methods={"cure": method(**overrides)}, budget=160)
    try:
        run.check_grid(load_grid(tmp_path / "grid.yml"), tmp_path / "out")
        folder = run_cell(cell, tmp_path / "out")
    finally:
        gym.registry.pop("tests/Camera-v0", None)
    assert cell.folder == Path("tiny", "Camera", "cure", "seed0") and cell.is_done(tmp_path / "out")
    assert (folder / "reconstructions.png").is_file()
    assert not [each for each in recwarn if "checkpoints" in str(each.message)], "all callbacks are kept"
    loaded = CuReSAC.load(folder / "model.zip", custom_objects=cell.custom_objects())
    assert type(loaded.policy.srl).__name__ == "Head"
    assert json.loads((folder / "config.json").read_text())["arguments"]["srl"] == "camera_of_a_grid.Head"


def test_infinite_returns_end_a_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report of all experiments would refuse the cell, however often it was run."""
    step = PixelBox.step

    def step_or_nan(self: PixelBox, action: np.ndarray) -> tuple[Any, ...]:
        observation, reward, terminated, truncated, info = step(self, action)
        return observation, math.nan if truncated else reward, terminated, truncated, info

    monkeypatch.setattr(PixelBox, "step", step_or_nan)
    with pytest.raises(ValueError, match=r"gave an evaluation the returns \[nan, nan\]: correct its rewards"):
        run_cell(only_cell(tmp_path), tmp_path, pictures=False)


def test_progress_names_the_cell_and_its_best_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line a time, without the folder of results; pretraining has no returns yet."""
    monkeypatch.setattr(cells, "TimeLeft", partial(cells.TimeLeft, seconds=1e-9))
    arm = {**method(), "pretrain": {"collector": "random", "budget": 40}}
    cell = only_cell(tmp_path, methods={"cure": arm}, budget=80, evaluation=dict(every=40, episodes=1))
    folder = run_cell(cell, tmp_path, pictures=False)
    lines = capsys.readouterr().out.splitlines()
    returns = [row["return_mean"] for row in read_rows(folder / "eval.csv")]
    assert len(lines) == 10 + 20
    assert all(line.startswith(f"{cell.folder} (pretraining): step") and "return" not in line for line in lines[:10])
    assert all(line.startswith(f"{cell.folder}: step") for line in lines[10:])
    assert lines[10].endswith(f"best return {returns[0]:.4g}")
    assert lines[-1].endswith(f"best return {max(returns[:2]):.4g}")


# --------------------------------------------------------------------- pairing


def test_arms_of_a_seed_are_paired(tmp_path: Path) -> None:
    """Same weights, same warm-up, same starts of evaluations with and without curiosity; another seed differs."""
    methods = {"cure": method(), "none": method(curiosity=None)}
    grid = load_grid(write_grid(tmp_path, methods=methods, seeds=2, budget=76))
    models = {}
    for cell in grid.cells:
        run_cell(cell, tmp_path, pictures=False)
        # 19 steps, all of the warm-up: no update yet
        models[cell.method, cell.seed] = state_of(CuReSAC.load(tmp_path / cell.folder / "model.zip"))
        assert steps_of(tmp_path / cell.folder) == [0, 76]
    own = models["none", 0]["policy"]
    pairs = {seed: {key: models["cure", seed]["policy"][key] for key in own} for seed in (0, 1)}
    assert differences(own, pairs[0]) == []
    assert differences(own, pairs[1]) != []
    first, second = (read_rows(tmp_path / cell.folder / "episodes.csv") for cell in grid.cells[:2])
    assert [row for row in first if row["actor"] == "task"] == second


def pretrained_grid(folder: Path, task: str, warm_up: int, budget: int, **changes: Any) -> Grid:
    """The three arms of the paper's table, in two environments each; every phase has the same budget."""
    phases: dict[str, Any] = {"vanilla": {}}
    for collector in ("random", "curious"):
        phases[collector] = {"pretrain": {"collector": collector, "budget": budget}}
    arm = method(curiosity=None, learning_starts=warm_up, n_envs=2)
    methods = {name: {**arm, **phase} for name, phase in phases.items()}
    evaluation = dict(every=budget, episodes=1)
    return load_grid(write_grid(folder, tasks=[task], methods=methods, budget=budget, evaluation=evaluation, **changes))


@pytest.fixture
def warm_ups(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Filled by each cell: what its replay buffer holds of the first steps."""
    found: list[Any] = []
    finish = cells._write_results

    def keep(cell: Any, folder: Path, model: Any, *others: Any) -> None:
        found.append((model.replay_buffer.actions[:20].copy(), model.replay_buffer.rewards[:20].copy()))
        finish(cell, folder, model, *others)

    monkeypatch.setattr(cells, "_write_results", keep)
    return found


@pytest.mark.parametrize(("task", "budget"), [(TASK, 200), (DMC_TASK, 400)])
def test_pretrained_arms_have_the_same_warm_up(
    task: str, budget: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, warm_ups: list[Any]
) -> None:
    """After pretraining, environments and all random numbers begin as they do in the arm without it.

    On the tiny task each environment is in its second episode, whose start is drawn, when the warm-up ends.
    """
    begun = []

    class See(BaseCallback):
        def _on_training_start(self) -> None:
            begun.append((np.random.get_state(), th.get_rng_state(), random.getstate(), self.model._last_obs))

        def _on_step(self) -> bool:
            return True

    learn = CuReSAC.learn
    monkeypatch.setattr(CuReSAC, "learn", lambda self, n, callback, *rest: learn(self, n, [See(), *callback], *rest))
    for cell in pretrained_grid(tmp_path, task, 46, budget, seeds=2).cells[:4]:
        run_cell(cell, tmp_path, pictures=False)
    assert differences(begun[0], begun[1]) == differences(begun[0], begun[2]) == []
    assert differences(warm_ups[0], warm_ups[1]) == differences(warm_ups[0], warm_ups[2]) == []
    assert len(differences(warm_ups[0], warm_ups[3])) == 2, "another seed has another warm-up"


# --------------------------------------------------------------- interruptions


@pytest.fixture
def power(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Counts the environments' steps in ``n_steps``, and fails at number ``fails_at``."""
    counter, step = SimpleNamespace(n_steps=0, fails_at=0), PixelBox.step

    def count(self: PixelBox, action: np.ndarray) -> Any:
        counter.n_steps += 1
        if counter.n_steps == counter.fails_at:
            raise RuntimeError("the power went")
        return step(self, action)

    monkeypatch.setattr(PixelBox, "step", count)
    return counter


@pytest.mark.parametrize(
    ("minutes", "keeps", "moments"),
    [(0, False, (10, 26, 31, 60, 76)), (0, True, (31, 76)), (10, False, (31, 76))],
    ids=["each step is kept", "and what pretraining collected", "only starts are kept"],
)
def test_killed_cell_ends_like_one_that_was_not(
    minutes: float, keeps: bool, moments: tuple[int, ...], tmp_path: Path, power: SimpleNamespace
) -> None:
    """Random numbers start anew with training, not before and not when it is resumed."""
    *_, cell = pretrained_grid(tmp_path, TASK, warm_up=20, budget=120).cells
    cell = replace(cell, keep_replay_buffer=keeps)

    def outcome(folder: Path) -> Any:
        evaluations = [{**row, "seconds": 0, "cpu_seconds": 0} for row in read_rows(folder / "eval.csv")]
        return state_of(CuReSAC.load(folder / "model.zip")), (folder / "episodes.csv").read_text(), evaluations

    expected = outcome(run_cell(cell, tmp_path / "whole", minutes, pictures=False))
    assert power.n_steps == 30 + 20 + 30 + 20
    assert CuReSAC.load(tmp_path / "whole" / cell.folder / "model.zip")._keeps_replay_buffer == keeps
    assert CuReSAC.load(tmp_path / "whole" / cell.folder / "pretrained.zip").num_timesteps == 0
    # In pretraining's warm-up, among its updates, at its end; in the first evaluation, in training's updates
    for power.fails_at in moments:
        power.n_steps, folder = 0, tmp_path / f"killed-{power.fails_at}"
        with pytest.raises(RuntimeError, match="the power went"):
            run_cell(cell, folder, minutes, pictures=False)
        assert ": interrupted" in run.status_lines([cell], folder)[0]
        np.random.seed(99)  # whatever another process begins with
        th.manual_seed(99)
        steps, power.n_steps = power.fails_at, power.fails_at
        assert differences(expected, outcome(run_cell(cell, folder, minutes, pictures=False))) == [], steps
        if minutes == 0:  # of two environments one may be a step ahead
            assert power.n_steps - steps <= 100 - steps + 2, "it began where the checkpoint was taken, not anew"
        conditions = json.loads((folder / cell.folder / "run.json").read_text())
        assert len(conditions["history"]) == conditions["attempts"] == 2
        assert conditions["started"] == conditions["history"][0]["started"]
        assert [each["precision"] for each in conditions["history"]] == ["fp32", "fp32"]
        spent = [each["cpu_seconds"] for each in conditions["history"]]
        assert spent[-1] > 0 and conditions["cpu_seconds"] == pytest.approx(sum(spent), abs=0.1)


def test_no_moment_of_the_end_loses_the_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped just before ``DONE``, a cell is finished from its checkpoint, with the same rows."""
    cell = only_cell(tmp_path, budget=160)
    with monkeypatch.context() as full:
        full.setattr(cells, "write_text", lambda path, text: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run_cell(cell, tmp_path, 0, pictures=False)
    before = read_rows(tmp_path / cell.folder / "episodes.csv")
    folder = run_cell(cell, tmp_path, 0, pictures=False)
    assert cell.is_done(tmp_path) and not (folder / "checkpoint").exists()
    assert read_rows(folder / "episodes.csv") == before and steps_of(folder) == [0, 160]


def test_resumed_cell_computes_where_it_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the device of its settings, which archives do not keep."""
    cell = only_cell(tmp_path, budget=40, methods={"a": method(device="cpu")})
    with monkeypatch.context() as full:
        full.setattr(cells, "write_text", lambda path, text: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run_cell(cell, tmp_path, 0, pictures=False)
    resume, devices = CuReSAC.resume, []

    def note(path: Path, env: Any, device: str, **kwargs: Any) -> CuReSAC:
        devices.append(device)
        return resume(path, env, device, **kwargs)

    monkeypatch.setattr(CuReSAC, "resume", note)
    run_cell(cell, tmp_path, 0, pictures=False)
    assert devices == ["cpu"]


def test_two_processes_do_not_run_one_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one is refused while the first runs."""
    cell = only_cell(tmp_path, budget=40)
    refusals = []
    learn = CuReSAC.learn

    def learn_while_another_tries(self: CuReSAC, *args: Any, **kwargs: Any) -> CuReSAC:
        with pytest.raises(UsageError, match="is being run by another process") as refusal:
            run_cell(cell, tmp_path, pictures=False)
        refusals.append(refusal)
        assert ": running" in run.status_lines([cell], tmp_path)[0]
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(CuReSAC, "learn", learn_while_another_tries)
    run_cell(cell, tmp_path, pictures=False)
    assert len(refusals) == 1 and not cells.is_held(tmp_path / cell.folder)


# -------------------------------------------------------------------- pictures


@pytest.mark.usefixtures("few_rows")
def test_pictures_show_every_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of both policies; the map is that of the measured visits, of sampled and random actions."""
    maps: list[dict[str, Any]] = []
    titles: list[str] = []
    draw, write = plots.curiosity_map, media.write_video
    monkeypatch.setattr(plots, "curiosity_map", lambda *args, **how: (maps.append(args[1]), titles.append(args[3])))
    monkeypatch.setattr(media, "write_video", lambda *args: (titles.extend(args[1]), write(*args)))
    cell = only_cell(tmp_path, kind="visitation", budget=80, tasks=[DMC_TASK], evaluation=dict(every=240, episodes=1))
    folder = run_cell(cell, tmp_path)
    assert sorted(path.name for path in folder.glob("*.mp4")) == ["curious_policy.mp4", "task_policy.mp4"]
    named = "cartpole-swingup, cure, seed 0"
    assert titles == [
        f"Where policies go with sampled actions: {named}",
        f"task policy, deterministic actions: {named}",
        f"curious policy, deterministic actions: {named}",
    ]
    (drawn,), measured = maps, np.load(folder / "visits.npz")
    assert list(drawn) == ["task", "curious", "random"]
    for actor, (states, errors) in drawn.items():
        np.testing.assert_allclose(states, measured[f"{actor}_states"], rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(errors, measured[f"{actor}_errors"], rtol=1e-4, atol=1e-6)
        assert len(states) == len(errors) == 25
    draw(tmp_path / "map.png", drawn, [str(number) for number in range(4)], "", coordinates=("0", "1"))
    assert (tmp_path / "map.png").exists()


# -------------------------------------------------------------------- visits


def test_of_crops_all_is_measured_and_drawn(tmp_path: Path) -> None:
    """What the head draws, which is the centre, and not the whole image."""
    crops: dict[str, Any] = dict(augmentation="crop", augmentation_kwargs=dict(size=30))
    model = tiny_model("CnnPolicy", PixelBox(), srl="rae", **crops).learn(20)
    seen = model.replay_buffer.observations_at(np.arange(5), np.zeros(5, int))[0]
    drawn = visitation.mean_target(model, [SimpleNamespace(observations=seen)])  # type: ignore[list-item]
    assert drawn.shape == (6, 30, 30)
    media.draw_cell(model, only_cell(tmp_path), tmp_path)
    assert (tmp_path / "uncomfortable.png").exists()


class _Rooms(gym.ObservationWrapper):
    def __init__(self) -> None:
        super().__init__(VectorBox())
        self.observation_space = gym.spaces.Discrete(2)

    def observation(self, observation: np.ndarray) -> Any:
        return np.int64(observation[0] > 0)


@pytest.mark.parametrize("srl", ["rae", None])
def test_constant_predictions_err_alike_with_any_head(srl: str | None) -> None:
    """Zero and the mean of vectors, which are not quantised, and of discrete observations, as one-hot vectors."""
    seen = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    model = tiny_model("MlpPolicy", VectorBox(), srl=srl, curiosity=None)
    mean = visitation.mean_target(model, [SimpleNamespace(observations=seen)])  # type: ignore[list-item]
    assert mean == pytest.approx(seen.mean(axis=0), abs=1e-6)
    for constant in (mean, np.zeros(2)):
        expected = np.square(seen - constant).mean(axis=1)
        assert visitation.constant_errors(model, seen, constant) == pytest.approx(expected, abs=1e-6)
    model = tiny_model("MlpPolicy", _Rooms(), srl=srl, curiosity=None)
    rooms = np.array([0, 0, 1, 0])
    mean = visitation.mean_target(model, [SimpleNamespace(observations=rooms)])  # type: ignore[list-item]
    assert mean == pytest.approx([0.75, 0.25])
    assert visitation.constant_errors(model, rooms, mean) == pytest.approx([0.0625, 0.0625, 0.5625, 0.0625])
