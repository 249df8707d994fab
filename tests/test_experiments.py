"""Grids of experiments: what they hold, and that no interruption loses or repeats anything."""

import csv
import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch as th
import yaml
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

import sb3_cure
from benchmarks import zero_decoder
from sb3_cure import CuReSAC
from sb3_cure.experiments import cells, heads, media, plots, probe, run, visitation, yardsticks
from sb3_cure.experiments import files as experiment_files
from sb3_cure.experiments.cells import run_cell
from sb3_cure.experiments.files import checkout_commit, read_rows, write_csv
from sb3_cure.experiments.grid import Grid, GridError, load_grid, short_name
from sb3_cure.experiments.visitation import COLUMNS
from sb3_cure.persistence import read_state
from sb3_cure.persistence.generations import Generations

GRIDS = Path(__file__).parent.parent / "zoo_configs" / "experiments"
TASK = "tests/PixelBox-v0"
TINY: dict[str, Any] = dict(
    srl="rae", learning_starts=20, warmup_updates=2, batch_size=8, buffer_size=400, precision="fp32",
    policy_kwargs=dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4, n_layers=2)),
)  # fmt: skip
DMC = {**TINY, "env_kwargs": {"image_size": 36, "renderer": "fast", "grayscale": True}}


@pytest.fixture(autouse=True)
def _pixel_box(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The tiny task under an id: 20 steps per episode, an action repeat of 4. Checkpoints do not wait for the disk."""
    gym.register(TASK, PixelBox)
    for module in ("files", "generations", "checkpoints"):
        monkeypatch.setattr(f"sb3_cure.persistence.{module}.flush_to_disk", lambda path: None)
    yield
    del gym.registry[TASK]


def write_grid(folder: Path, **changes: Any) -> Path:
    """A grid of one cell on the tiny task, unless ``changes`` say otherwise."""
    (folder / "zoo.yml").write_text(yaml.safe_dump({"default": TINY, "dmc_pixels/cartpole-swingup-v0": DMC}))
    content: dict[str, Any] = dict(
        experiment="tiny",
        kind="curves",
        budget=400,
        seeds=1,
        evaluation=dict(every=160, episodes=2),
        tasks=[TASK],
        methods={"cure": {"config": "zoo.yml"}},
    )
    content.update(changes)
    path = folder / "grid.yml"
    path.write_text(
        yaml.safe_dump({key: value for key, value in content.items() if value is not None}, sort_keys=False)
    )
    return path


def steps_of(path: Path) -> list[int]:
    return [row["environment_steps"] for row in read_rows(path)]


# ----------------------------------------------------------------------- grids


def test_a_grid_is_every_task_with_every_method_and_seed(tmp_path: Path) -> None:
    """Seeds are outermost: an interrupted grid holds whole comparisons. Overrides beat the zoo's entry."""
    methods = {"a": {"config": "zoo.yml"}, "b": {"config": "zoo.yml", "overrides": {"curiosity_prob": 0.7}}}
    grid = load_grid(write_grid(tmp_path, methods=methods, seeds=[3, 5], baseline="b"))
    assert [(cell.seed, cell.method) for cell in grid.cells] == [(3, "a"), (3, "b"), (5, "a"), (5, "b")]
    assert [cell.arguments.get("curiosity_prob") for cell in grid.cells[:2]] == [None, 0.7]
    assert grid.cells[0].folder == Path("tiny", "PixelBox", "a", "seed3")
    assert all(cell.arguments["batch_size"] == 8 and "env_kwargs" not in cell.arguments for cell in grid.cells)
    few = load_grid(tmp_path / "grid.yml", seeds=[5], methods=["b"], tasks=["PixelBox"], budget=40)
    assert [(cell.seed, cell.method, cell.budget) for cell in few.cells] == [(5, "b", 40)]
    assert few.description["methods"].keys() == {"a", "b"}, "what was not chosen is still part of the experiment"


@pytest.mark.parametrize(
    ("own", "asked", "expected"),
    [(400, 400, (400, 100)), (400, 40, (40, 10)), (400, 1, (1, 1)), (300, 1000, (1000, 333)), (0, 0, (0, 100))],
)
def test_another_budget_is_one_of_pretraining_too(
    tmp_path: Path, own: int, asked: int, expected: tuple[int, int]
) -> None:
    """In proportion, at least a step, in cells and in the description; a method that does not pretrain has no phase."""
    pretrain = {"collector": "random", "budget": 100}
    methods = {
        "none": {"config": "zoo.yml"},
        "both": {"config": "zoo.yml", "pretrain": pretrain},
        "alone": {"config": "zoo.yml", "pretrain": pretrain, "train": False},
    }
    path = write_grid(tmp_path, budget=own, methods=methods)
    grid = load_grid(path, budget=asked)
    phases = [(cell.budget, cell.pretrain and cell.pretrain.budget) for cell in grid.cells]
    assert phases == [(asked, None), expected, (0, expected[1])]
    described = grid.description["methods"]
    assert "pretrain" not in described["none"] and grid.description["budget"] == asked
    assert described["both"]["pretrain"] == {"collector": "random", "budget": expected[1]}
    assert load_grid(path).description["methods"] == methods


def test_nothing_is_in_proportion_to_no_training(tmp_path: Path) -> None:
    """A file's budget of 0 is pretraining alone; another one can be asked for if there is no pretraining."""
    path = write_grid(tmp_path, budget=0)
    assert [cell.budget for cell in load_grid(path, budget=80).cells] == [80]
    method = {"config": "zoo.yml", "pretrain": {"collector": "random", "budget": 100}}
    write_grid(tmp_path, budget=0, methods={"p": method})
    with pytest.raises(GridError, match=r"is 0 \(pretraining alone\), but 80 was asked for, .*: change the budgets in"):
        load_grid(path, budget=80)


def test_a_method_may_have_a_baseline_of_its_own(tmp_path: Path) -> None:
    """Reports find it in ``grid.json``; the cells, which it does not change, are those without it."""
    methods: dict[str, Any] = {name: {"config": "zoo.yml"} for name in "abc"}
    cells_without = load_grid(write_grid(tmp_path, methods=methods)).cells
    methods["c"]["baseline"] = "b"
    grid = load_grid(write_grid(tmp_path, methods=methods))
    assert grid.baseline == "a" and grid.description["methods"] == methods
    assert grid.cells == cells_without


@pytest.mark.parametrize("path", sorted(GRIDS.rglob("*.yml")), ids=lambda path: str(path.relative_to(GRIDS)))
def test_the_projects_grids_can_be_built_and_trained(path: Path) -> None:
    """Every arm's arguments are accepted by CuReSAC in spaces like the task's; the last one trains for 50 steps."""
    grid = load_grid(path, seeds=1)
    assert grid.experiment == ("fast_" if path.parent.name == "fast" else "") + path.stem
    kwargs = {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2}}
    assert grid.complete[: len(grid.cells)] == grid.cells
    for cell in {cell.method: cell for cell in grid.cells}.values():
        env_kwargs = {key: value for key, value in cell.env_kwargs.items() if key == "frame_stack"}
        size = cell.env_kwargs.get("image_size", 84)
        env = PixelBox(3, size=size, action_repeat=4, **env_kwargs)
        model = CuReSAC(env=env, **{**cell.arguments, "policy_kwargs": kwargs, "buffer_size": 10})
        assert model.policy.srl is not None
        assert (model.policy.curious_actor is not None) == (
            cell.arguments.get("curiosity", "separate") == "separate" and cell.arguments["srl"] is not None
        )
    few = {"policy_kwargs": kwargs, "buffer_size": 50, "learning_starts": 30, "warmup_updates": 2, "batch_size": 4}
    model = CuReSAC(env=env, **{**cell.arguments, **few})
    if cell.pretrain is not None:
        model.pretrain(50, cell.pretrain.collector)
    if cell.budget > 0:
        model.learn(50)
    assert model.num_timesteps == (50 if cell.budget > 0 else 0)
    assert float(model.logger.name_to_value["train/srl_loss"]) > 0


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (dict(kind="curve"), "kind in .* is 'curve', but it must be one of curves, visitation, pretraining"),
        (dict(budget="many"), "budget in .* is 'many', but it must be a whole number, 0 or more"),
        (dict(budget=float("inf")), "budget in .* is inf, but it must be a whole number, 0 or more"),
        (dict(tasks=[{"a": 1}]), "task {'a': 1} in .* is not registered"),
        (dict(budget=None), "has no 'budget', which it needs"),
        (dict(seeds=0), "seeds in .* is 0, but it must be how many"),
        (dict(seeds=[1, -2]), r"seeds in .* is \[1, -2\]"),
        (dict(tasks=["dmc_pixels/cartpole-swing-v0"]), "'dmc_pixels/cartpole-swing-v0' in .* is not registered"),
        (dict(tasks="all"), "tasks in .* is 'all', but it must be a list of Gymnasium ids"),
        (dict(experiment="../elsewhere"), "experiment in .* is '../elsewhere', but it names a folder"),
        (dict(methods={"a/b": {"config": "zoo.yml"}}), "a method in .* is 'a/b', but it names a folder"),
        (dict(methods={"a": {"config": "no.yml"}}), "no.yml cannot be read .*: give the path of a YAML file"),
        (dict(methods={"a": {}}), "methods.a in .* has no 'config'"),
        (dict(methods={"a": {"config": "zoo.yml", "override": {}}}), "'override' in methods.a .* is unknown"),
        (
            dict(methods={"a": {"config": "zoo.yml", "overrides": {"prob": 1}}}),
            "'prob' in .* is no argument of CuReSAC",
        ),
        (
            dict(methods={"a": {"config": "zoo.yml", "overrides": {"policy_kwargs": "dict(net_arch=[1])"}}}),
            "policy_kwargs in .* is 'dict.*, but grids evaluate no strings",
        ),
        (
            dict(methods={"a": {"config": "zoo.yml", "pretrain": {"collector": "task", "budget": 8}}}),
            "pretrain.collector of methods.a .* is 'task', but it must be 'curious' or 'random'",
        ),
        (
            dict(methods={"a": {"config": "zoo.yml", "overrides": {"srl": "my_heads.Nowhere"}}}),
            "srl of methods.a .* is 'my_heads.Nowhere', which cannot be imported",
        ),
        (dict(baseline="sac"), "baseline in .* is 'sac', but the methods are cure"),
        (
            dict(methods={"a": {"config": "zoo.yml"}, "b": {"config": "zoo.yml", "baseline": "c"}}),
            r"baseline of methods.b in .* is 'c', but a method is compared with another one \(a\): name one, or remove",
        ),
        (
            dict(methods={"a": {"config": "zoo.yml", "baseline": "a"}, "b": {"config": "zoo.yml"}}),
            r"baseline of methods.a in .* is 'a', but a method is compared with another one \(b\): name one, or remove",
        ),
        (
            dict(methods={"a": {"config": "zoo.yml", "baseline": ["a"]}}),
            r"baseline of methods.a in .* is \['a'\], but .* another one \(there is none\): name one, or remove it",
        ),
        (dict(evaluation={"every": 0}), "evaluation.every in .* is 0, but it must be a whole number, 1 or more"),
        (dict(budgets=3), "'budgets' in .* is unknown"),
    ],
)
def test_wrong_grids_are_one_sentence(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    """Named value, expectation, fix; and nothing is written."""
    path = write_grid(tmp_path, **changes)
    with pytest.raises(GridError, match=sentence):
        load_grid(path)


def test_wrong_command_lines_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The options of ``sb3-cure experiment``, before anything is written."""
    path = str(write_grid(tmp_path))
    out = ["--out", str(tmp_path / "out")]
    for wrong, sentence in {
        "--tasks finger": "task 'finger' is not in",
        "--methods none": "method 'none' is not in",
        "--budget 10m": "'10m' is no number of steps",
        "--seeds x": "'x' names no seeds",
        "--seeds ,": "',' names no seeds",
        "--tasks ,": "',' names nothing",
        "--retries 1": "--retries is of Ray: add --engine ray",
        "--address auto": "--address is of Ray: add --engine ray",
    }.items():
        try:
            status = run.main([path, *out, *wrong.split()])
        except SystemExit as stop:  # argparse's
            status = stop.code
        assert status == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_default_that_has_changed_is_another_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Of a newer version: its seeds are not mixed with those of before, unless what they had was not kept."""
    arguments = [str(write_grid(tmp_path)), "--out", str(tmp_path / "out"), "--dry-run"]
    folder = run_cell(load_grid(write_grid(tmp_path)).cells[0], tmp_path / "out", pictures=False)
    config = json.loads((folder / "config.json").read_text())
    assert config["defaults"]["update"] == "joint" and not config["defaults"].keys() & config["arguments"].keys()
    (folder / "config.json").write_text(json.dumps({**config, "defaults": {"update": "joint", "gone": 1}}))
    assert run.main(arguments) == 0, "what arguments there are is no setting"
    monkeypatch.setitem(CuReSAC.__init__.__kwdefaults__, "update", "sequential")
    assert run.main(arguments) == 2
    sentence = "was run with other settings: defaults is {'update': 'joint'} there and {'update': 'sequential'} now."
    assert sentence in capsys.readouterr().err
    (folder / "config.json").write_text(json.dumps({key: config[key] for key in config if key != "defaults"}))
    assert run.main(arguments) == 0


def test_a_dry_run_refuses_what_a_run_would(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Settings that cannot work, and cells of other settings, which are not done for this grid."""
    out = ["--out", str(tmp_path / "out"), "--dry-run"]
    path = write_grid(tmp_path, methods={"cure": {"config": "zoo.yml", "overrides": {"curiosity_prob": 1.4}}})
    assert run.main([str(path), *out]) == 2
    assert "cannot work: curiosity_prob is 1.4" in capsys.readouterr().err
    run_cell(load_grid(write_grid(tmp_path)).cells[0], tmp_path / "out", pictures=False)
    assert run.main([str(path), *out]) == 0
    assert run.main([str(path), *out, "--budget", "800"]) == 2
    assert "seed0 was run with other settings: budget is 400 there and 800 now" in capsys.readouterr().err
    assert run.main([str(path), *out, "--checkpoint-minutes", "-1"]) == 2
    assert "--checkpoint-minutes is -1.0, but it must be" in capsys.readouterr().err


def test_an_edited_grid_is_refused_whatever_arms_it_has_left(tmp_path: Path) -> None:
    """Results of another budget, evaluation or kind do not compare, though no arm is in both; further arms go in."""
    methods = {name: {"config": "zoo.yml"} for name in "abc"}
    first = {"a": methods["a"]}
    out = tmp_path / "out"
    assert run.run_grid(load_grid(write_grid(tmp_path, budget=80, methods=first)), out, pictures=False) == []
    described = out / "tiny" / "grid.json"
    for other in (
        dict(budget=40),
        dict(budget=80, evaluation=dict(every=40, episodes=2)),
        dict(budget=80, kind="visitation"),
    ):
        grid = load_grid(write_grid(tmp_path, **{**other, "methods": {"c": methods["c"]}}))
        kept = described.read_text()
        for where in ("tiny was run", "seed0 was run"):
            with pytest.raises(GridError, match=f"{where} with other settings: (budget|eval.*|kind) is .* there and"):
                run.check_grid(grid, out)
            described.unlink(missing_ok=True)
        described.write_text(kept)
    more = load_grid(write_grid(tmp_path, budget=80, methods={"b": methods["b"]}, seeds=2), seeds=1)
    assert run.run_grid(more, out, pictures=False) == []
    assert json.loads(described.read_text())["methods"].keys() == {"a", "b"}
    alone = {"d": {**methods["a"], "pretrain": {"collector": "random", "budget": 80}, "train": False}}
    assert run.run_grid(load_grid(write_grid(tmp_path, budget=80, methods=alone)), out, pictures=False) == []
    described.unlink()
    run.check_grid(load_grid(write_grid(tmp_path, budget=80, methods=methods)), out)


def test_a_number_of_seeds_is_of_those_that_the_grid_lists(tmp_path: Path) -> None:
    listed = write_grid(tmp_path, seeds=[5, 3, 4])
    assert [cell.seed for cell in load_grid(listed, seeds=2).cells] == [3, 5]
    assert [cell.seed for cell in load_grid(listed, seeds=[0]).cells] == [0]
    with pytest.raises(GridError, match=r"--seeds asks for 4, but seeds in .* lists 3: ask for fewer, or say which"):
        load_grid(listed, seeds=4)
    assert [cell.seed for cell in load_grid(write_grid(tmp_path, seeds=2), seeds=3).cells] == [0, 1, 2]


def test_what_an_environment_raises_is_told_before_the_first_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def no_display(self: PixelBox, **_: Any) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(PixelBox, "__init__", no_display)
    assert run.main([str(write_grid(tmp_path)), "--out", str(tmp_path / "out"), "--dry-run"]) == 2
    assert "'cure' on tests/PixelBox-v0 cannot work: RuntimeError: no display" in capsys.readouterr().err


def test_of_unknown_time_limits_it_is_said_that_episodes_must_end(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Else the first evaluation would hang without a word; environments of dm_control and of Gymnasium tell theirs."""
    sentence = f"{TASK} tells no time limit: if its episodes do not end by themselves, its first evaluation never ends"
    gym.register("tests/LimitedBox-v0", PixelBox, max_episode_steps=7)
    try:
        path = write_grid(tmp_path, tasks=["dmc_pixels/cartpole-swingup-v0", "tests/LimitedBox-v0", TASK])
        run.check_grid(load_grid(path), tmp_path / "out")
    finally:
        del gym.registry["tests/LimitedBox-v0"]
    (told,) = capsys.readouterr().out.splitlines()
    assert told.startswith(sentence)


def test_checking_arms_leaves_random_numbers_alone(tmp_path: Path) -> None:
    """Their networks are built, without the replay buffer."""
    overrides = {"buffer_size": 10**12}
    grid = load_grid(write_grid(tmp_path, methods={"a": {"config": "zoo.yml", "overrides": overrides}}))
    before = th.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()
    run.check_grid(grid, tmp_path / "out")
    assert th.equal(th.get_rng_state(), before[0])
    assert (np.random.get_state()[1].tolist(), random.getstate()) == before[1:]


# ----------------------------------------------------------------------- cells


def test_a_cell_keeps_its_curve_and_is_not_run_twice(tmp_path: Path) -> None:
    """Evaluated untrained, at every interval and at the end; a second call touches nothing."""
    (cell,) = load_grid(write_grid(tmp_path)).cells
    folder = run_cell(cell, tmp_path, pictures=False)
    rows = read_rows(folder / "eval.csv")
    assert [row["environment_steps"] for row in rows] == [0, 160, 320, 400]
    assert [row["agent_steps"] for row in rows] == [0, 40, 80, 100]
    # 2 of the burst, and one per step after the 20 of the warm-up
    assert [row["updates"] for row in rows] == [0, 2 + 20, 2 + 60, 2 + 80]
    assert all(row["curious_srl_error"] > 0 and row["task_srl_error"] > 0 for row in rows)
    assert rows[0]["srl_loss"] == "" and rows[-1]["srl_loss"] < rows[1]["srl_loss"], "the autoencoder has learned"
    episodes = read_rows(folder / "episodes.csv")
    for row in rows:
        returns = [
            each["return"]
            for each in episodes
            if (each["environment_steps"], each["actor"]) == (row["environment_steps"], "task")
        ]
        assert len(returns) == 2 and row["return_mean"] == pytest.approx(np.mean(returns))
    conditions = json.loads((folder / "run.json").read_text())
    assert conditions["attempts"] == 1 and conditions["device"] == "cpu" and conditions["precision"] == "fp32"
    config = json.loads((folder / "config.json").read_text())
    assert config["action_repeat"] == 4 and config["arguments"]["batch_size"] == 8
    assert CuReSAC.load(folder / "model.zip").num_timesteps == 100
    assert not (folder / "checkpoint").exists()
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"}
    run_cell(cell, tmp_path, pictures=False)
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.name != ".lock"}


def test_the_arms_of_a_seed_are_paired(tmp_path: Path) -> None:
    """Same weights, same warm-up, same starts of evaluations with and without curiosity; another seed differs."""
    methods = {"cure": {"config": "zoo.yml"}, "none": {"config": "zoo.yml", "overrides": {"curiosity": None}}}
    grid = load_grid(write_grid(tmp_path, methods=methods, seeds=2, budget=76))
    for cell in grid.cells:
        run_cell(cell, tmp_path, pictures=False)
    models = {}
    for cell in grid.cells:
        folder = tmp_path / cell.folder
        # 19 steps, all of the warm-up: no update yet
        models[cell.method, cell.seed] = state_of(CuReSAC.load(folder / "model.zip"))
        assert steps_of(folder / "eval.csv") == [0, 76]
    own = models["none", 0]["policy"]
    pairs = {seed: {key: models["cure", seed]["policy"][key] for key in own} for seed in (0, 1)}
    assert differences(own, pairs[0]) == []
    assert differences(own, pairs[1]) != []
    first, second = (read_rows(tmp_path / cell.folder / "episodes.csv") for cell in grid.cells[:2])
    assert [row for row in first if row["actor"] == "task"] == second


def test_warm_ups_of_the_arms_are_the_same(tmp_path: Path) -> None:
    """The replay buffers of paired arms are equal when learning starts."""
    buffers = []
    for curiosity in ("separate", "random", None):
        model = CuReSAC("CnnPolicy", PixelBox(), seed=4, curiosity=curiosity, **{**TINY, "warmup_updates": 0})
        model.learn(20)
        buffer = model.replay_buffer
        buffers.append((buffer.actions[:20].copy(), buffer.rewards[:20].copy(), buffer.frames[:15].copy()))
    assert differences(buffers[0], buffers[1]) == differences(buffers[0], buffers[2]) == []


def pretrained_grid(folder: Path, task: str, warm_up: int, budget: int, **changes: Any) -> Grid:
    """The three arms of the paper's table, in two environments each; every phase has the same budget."""
    phases: dict[str, Any] = {"vanilla": {}}
    for collector in ("random", "curious"):
        phases[collector] = {"pretrain": {"collector": collector, "budget": budget}}
    overrides = {"curiosity": None, "learning_starts": warm_up, "n_envs": 2}
    methods = {arm: {"config": "zoo.yml", "overrides": overrides, **phase} for arm, phase in phases.items()}
    evaluation = dict(every=budget, episodes=1)
    return load_grid(write_grid(folder, tasks=[task], methods=methods, budget=budget, evaluation=evaluation, **changes))


def transitions_of(run_of_cell: Any) -> Any:
    """All that its replay buffer holds."""
    buffer = run_of_cell.model.replay_buffer
    return buffer.transitions(*np.divmod(np.arange(2 * buffer.pos), 2))


@pytest.mark.parametrize(("task", "budget"), [(TASK, 200), ("dmc_pixels/cartpole-swingup-v0", 400)])
def test_pretrained_arms_have_the_same_warm_up(
    task: str, budget: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After pretraining, environments and all random numbers begin as they do in the arm without it.

    On the tiny task each environment is in its second episode, whose start is drawn, when the warm-up ends.
    """
    warm_up = 46
    begun, warm_ups = [], []
    finish = cells._CellRun._keep_results

    class See(BaseCallback):
        def _on_training_start(self) -> None:
            begun.append((np.random.get_state(), th.get_rng_state(), random.getstate(), self.model._last_obs))

        def _on_step(self) -> bool:
            return True

    def keep(run_of_cell: Any) -> None:
        warm_ups.append([each[:warm_up] for each in transitions_of(run_of_cell) if each is not None])
        finish(run_of_cell)

    learn = CuReSAC.learn
    monkeypatch.setattr(CuReSAC, "learn", lambda self, steps, callback: learn(self, steps, callback=[See(), *callback]))
    monkeypatch.setattr(cells._CellRun, "_keep_results", keep)
    for cell in pretrained_grid(tmp_path, task, warm_up, budget, seeds=2).cells[:4]:
        run_cell(cell, tmp_path, pictures=False)
    assert differences(begun[0], begun[1]) == differences(begun[0], begun[2]) == []
    assert differences(warm_ups[0], warm_ups[1]) == differences(warm_ups[0], warm_ups[2]) == []
    assert len(differences(warm_ups[0], warm_ups[3])) >= 4, "another seed has another warm-up"


@pytest.mark.parametrize("draw", [np.random.uniform, random.uniform], ids=["NumPy's", "Python's"])
def test_arms_are_paired_where_environments_draw_from_common_generators(
    draw: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither evaluations, of one policy or two, nor pictures change a training; evaluations start alike all along."""
    starts: list[float] = []
    reset, finish, warm_ups = PixelBox.reset, cells._CellRun._keep_results, []

    def careless(self: PixelBox, *, seed: int | None = None, options: Any = None) -> Any:
        reset(self, seed=seed)
        self.position = np.array([draw(-1, 1), 0.0])
        starts.append(self.position[0])
        return self.observe(first=True), {}

    def keep(run_of_cell: Any) -> None:
        warm_ups.append([each[:40] for each in transitions_of(run_of_cell) if each is not None])
        finish(run_of_cell)

    def evaluate(self: Any) -> None:
        before = len(starts)
        evaluated(self)
        n_actors = len(cells.trained_actors(self.model))
        assert starts[before:] == starts[before : before + 2] * n_actors
        evaluations.add(tuple(starts[before:][:2]))

    evaluated, evaluations = cells._Record.evaluate, set()
    monkeypatch.setattr(PixelBox, "reset", careless)
    monkeypatch.setattr(cells._CellRun, "_keep_results", keep)
    monkeypatch.setattr(cells._Record, "evaluate", evaluate)
    alone = {"curiosity": None, "n_envs": 2, "learning_starts": 40}
    methods = {
        "cure": {"config": "zoo.yml", "overrides": {**alone, "curiosity": "separate"}},
        "none": {"config": "zoo.yml", "overrides": alone},
    }
    grid = load_grid(write_grid(tmp_path, methods=methods, budget=200, evaluation=dict(every=120, episodes=2)))
    for out, pictures in (("with", True), ("without", False)):
        for cell in grid.cells:
            run_cell(cell, tmp_path / out, pictures=pictures)
    assert differences(warm_ups[0], warm_ups[1]) == []
    assert warm_ups[0][0].shape[0] == 40 and len(evaluations) == 1
    for cell in grid.cells:
        tables = [(tmp_path / out / cell.folder / "episodes.csv").read_text() for out in ("with", "without")]
        assert tables[0] == tables[1]


@pytest.mark.parametrize("minutes", [0, 10], ids=["each step is kept", "only starts are kept"])
def test_a_pretrained_cell_that_was_killed_ends_like_one_that_was_not(
    minutes: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Random numbers begin anew when training does, neither before nor when it is gone on with."""
    *_, cell = pretrained_grid(tmp_path, TASK, warm_up=20, budget=120).cells
    step, finish = PixelBox.step, cells._CellRun._keep_results
    n_steps, kill_at, kept = 0, 0, []

    def count(self: PixelBox, action: np.ndarray) -> Any:
        nonlocal n_steps
        n_steps += 1
        if n_steps == kill_at:
            raise RuntimeError("the power went")
        return step(self, action)

    def keep(run_of_cell: Any) -> None:
        kept.append((transitions_of(run_of_cell), np.random.random(3), th.rand(3)))
        finish(run_of_cell)

    monkeypatch.setattr(PixelBox, "step", count)
    monkeypatch.setattr(cells._CellRun, "_keep_results", keep)

    def outcome(folder: Path) -> Any:
        episodes = (folder / "episodes.csv").read_text()
        evaluations = [{**row, "seconds": 0} for row in read_rows(folder / "eval.csv")]
        return state_of(CuReSAC.load(folder / "model.zip")), kept.pop(), episodes, evaluations

    expected = outcome(run_cell(cell, tmp_path / "whole", minutes, pictures=False))
    assert n_steps == 30 + 20 + 30 + 20
    # In pretraining's warm-up, among its updates; in the first evaluation, in training's warm-up, among its updates
    for kill_at in (10, 26, 40, 60, 76):
        n_steps, folder = 0, tmp_path / f"killed-{kill_at}"
        with pytest.raises(RuntimeError, match="the power went"):
            run_cell(cell, folder, minutes, pictures=False)
        np.random.seed(99)  # whatever another process begins with
        th.manual_seed(99)
        assert differences(expected, outcome(run_cell(cell, folder, minutes, pictures=False))) == [], kill_at
        conditions = json.loads((folder / cell.folder / "run.json").read_text())
        assert len(conditions["history"]) == conditions["attempts"] == 2
        assert conditions["started"] == conditions["history"][0]["started"]


def test_a_head_of_ones_own_is_named_by_its_class(tmp_path: Path) -> None:
    """A grid trains, keeps and loads a user's head like the package's own."""
    overrides = {"srl": "persistence.test_save_load.Denoising"}
    (cell,) = load_grid(
        write_grid(tmp_path, budget=160, methods={"own": {"config": "zoo.yml", "overrides": overrides}})
    ).cells
    folder = run_cell(cell, tmp_path, pictures=False)
    loaded = CuReSAC.load(folder / "model.zip", custom_objects=cell.custom_objects())
    assert type(loaded.policy.srl).__name__ == "Denoising"
    arguments = json.loads((folder / "config.json").read_text())["arguments"]
    assert arguments["srl"] == "persistence.test_save_load.Denoising"


CAMERA = """
import gymnasium as gym
from envs_for_tests import PixelBox
from sb3_cure.buffers import FrameStackReplayBuffer

gym.register("tests/Camera-v0", lambda **kwargs: PixelBox(channels_last=True, **kwargs))

class Buffer(FrameStackReplayBuffer):
    pass
"""


def test_cells_may_be_trained_after_each_episode(tmp_path: Path) -> None:
    """As with rl-zoo's files, in which a pair is a list."""
    path = write_grid(tmp_path, methods={"a": {"config": "zoo.yml", "overrides": {"train_freq": [1, "episode"]}}})
    grid = load_grid(path)
    assert run.run_grid(grid, tmp_path, pictures=False) == []
    assert steps_of(tmp_path / grid.cells[0].folder / "eval.csv") == [0, 160, 320, 400]


def test_an_environment_of_ones_own_is_named_with_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its images have the channels last, and its frames lie on disk; common heads load what it has trained."""
    (tmp_path / "camera_of_a_grid.py").write_text(CAMERA)
    (tmp_path / "frames").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    on_disk = {"frames_dir": str(tmp_path / "frames"), "frame_stack": 2}
    overrides = {"replay_buffer_class": "sb3_cure.buffers.FrameStackReplayBuffer", "replay_buffer_kwargs": on_disk}
    methods = {"cure": {"config": "zoo.yml", "overrides": overrides}}
    task = "camera_of_a_grid:tests/Camera-v0"
    path = write_grid(tmp_path, kind="visitation", tasks=[task], methods=methods, seeds=2)
    grid = load_grid(path)
    (tmp_path / "zoo.yml").write_text(yaml.safe_dump({"tests/Camera-v0": TINY}))  # by its id alone
    assert load_grid(path) == grid
    others = {"cure": {"config": "zoo.yml", "overrides": {"replay_buffer_class": "camera_of_a_grid.Buffer"}}}
    with pytest.raises(GridError, match="replay_buffer_class is Buffer, which checkpoints of cells cannot hold"):
        run.check_grid(load_grid(write_grid(tmp_path, tasks=[task], methods=others)), tmp_path / "out")
    try:
        assert run.run_grid(grid, tmp_path / "out") == []
    finally:
        gym.registry.pop("tests/Camera-v0", None)
        sys.modules.pop("camera_of_a_grid", None)
    assert [cell.folder for cell in grid.cells] == [Path("tiny", "Camera", "cure", f"seed{seed}") for seed in (0, 1)]
    assert all(cell.is_done(tmp_path / "out") for cell in grid.cells)
    assert (tmp_path / "out" / grid.cells[0].folder / "reconstructions.png").is_file()


def test_a_module_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(GridError, match=r"names the module 'no_camera', which cannot be imported \(No module named"):
        load_grid(write_grid(tmp_path, tasks=["no_camera:tests/Camera-v0"]))


def test_other_settings_in_the_same_folder_are_refused(tmp_path: Path) -> None:
    """A finished cell is not taken for one of another budget, and the grid's description stays as it was."""
    path = write_grid(tmp_path, budget=80)
    out = tmp_path / "out"
    assert run.run_grid(load_grid(path), out, pictures=False) == []
    files = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    for other in (load_grid(path, budget=160), load_grid(path, budget=160, seeds=[7])):
        with pytest.raises(GridError, match="was run with other settings: budget is 80 there and 160 now"):
            run.run_grid(other, out, pictures=False)
    assert {file: file.read_bytes() for file in out.rglob("*") if file.is_file()} == files
    assert run.run_grid(load_grid(path, seeds=[1]), out, pictures=False) == []
    assert json.loads((out / "tiny" / "grid.json").read_text())["seeds"] == [0, 1]


def test_a_commit_is_that_of_the_folder_itself(tmp_path: Path) -> None:
    """Marked where files differ from it; a folder inside a checkout, an unpacked archive say, has none."""
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "file").write_text("one")
    author = ["-c", "user.name=a", "-c", "user.email=a@example.com"]
    for command in (["init", "-q"], ["add", "file"], [*author, "commit", "-q", "-m", "one"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    commit = checkout_commit(tmp_path)
    assert commit is not None and len(commit) == 12 and checkout_commit(folder) is None
    (tmp_path / "file").write_text("two")
    assert checkout_commit(tmp_path) == f"{commit}-dirty"


def test_arms_reconstruct_the_same_observations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that their errors compare; and a cell that is drawn is trained as one that is not."""
    methods = {
        "sac_ae": {"config": "zoo.yml", "overrides": {"curiosity": None}},
        "cure": {"config": "zoo.yml"},
        "curl": {"config": "zoo.yml", "overrides": {"srl": "curl", "srl_kwargs": {"bank_size": 8}}},
    }
    fit = probe.fit_probe
    monkeypatch.setattr(probe, "fit_probe", lambda model, sample, updates: fit(model, sample, 1))  # not 500
    observed, rows = [], []
    monkeypatch.setattr(
        plots,
        "reconstructions_over_training",
        lambda path, shown, drawn, title: (observed.append(shown), rows.append([steps for steps, _ in drawn])),
    )
    every = load_grid(write_grid(tmp_path, budget=160, methods=methods)).cells
    for cell in every:
        run_cell(cell, tmp_path / "drawn")
        run_cell(cell, tmp_path / "not drawn", pictures=False)
        both = [tmp_path / name / cell.folder for name in ("drawn", "not drawn")]
        drawn, plain = (CuReSAC.load(folder / "model.zip").get_parameters() for folder in both)
        assert differences(drawn, plain) == []
    assert rows[8] == [0, 5, 10, 15, 20, 25, 30, 35, 40], "with the untrained autoencoder"
    assert rows[9] == [40], "drawn at the end where no picture was left by training"
    assert all(np.array_equal(shown, observed[0]) for shown in observed) and len(observed) == 10 + 10 + 9
    assert len(np.unique(observed[0], axis=0)) == len(observed[0]) == 8


@pytest.mark.parametrize("kind", ["curves", "visitation"])
def test_arms_without_srl_or_curiosity_are_measured_too(tmp_path: Path, kind: str) -> None:
    """SB3's own SAC, and a shared encoder without head, as baselines: returns and visits without SRL errors."""
    none = {"srl": None, "curiosity": None, "warmup_updates": None}
    methods = {
        "sac": {"config": "zoo.yml", "overrides": {**none, "policy_kwargs": {"net_arch": [8]}}},
        "encoder": {
            "config": "zoo.yml",
            "overrides": {**none, "policy_kwargs": {**TINY["policy_kwargs"], "share_encoder": True}},
        },
    }
    for cell in load_grid(write_grid(tmp_path, kind=kind, budget=160, methods=methods)).cells:
        folder = run_cell(cell, tmp_path)
        last = read_rows(folder / "eval.csv")[-1]
        assert last["return_mean"] > 0 and last["task_srl_error"] == "" == last["curious_return_mean"]
        if kind == "visitation":
            heads = {(row["actor"], row["head"]) for row in read_rows(folder / "visitation.csv")}
            assert heads == {(actor, head) for actor in ("task", "random") for head in ("zero", "mean_image")}


def test_no_moment_of_the_end_loses_the_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped just before ``DONE``, a cell is finished from its checkpoint, with the same rows."""
    (cell,) = load_grid(write_grid(tmp_path)).cells
    write = cells.write_text

    def fail(path: Path, text: str) -> None:
        if path.name == "DONE":
            raise OSError("the disk went")
        write(path, text)

    monkeypatch.setattr(cells, "write_text", fail)
    with pytest.raises(OSError, match="the disk went"):
        run_cell(cell, tmp_path, 0, pictures=False)
    monkeypatch.setattr(cells, "write_text", write)
    before = (tmp_path / cell.folder / "eval.csv").read_text()
    run_cell(cell, tmp_path, 0, pictures=False)
    assert (tmp_path / cell.folder / "DONE").exists() and not (tmp_path / cell.folder / "checkpoint").exists()
    rows = [line.split(",")[:3] for line in before.splitlines()]
    after = [line.split(",")[:3] for line in (tmp_path / cell.folder / "eval.csv").read_text().splitlines()]
    assert after == rows


def test_training_after_a_pretraining_that_was_stopped_at_its_end_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint of pretraining's last step is followed by all of the training."""
    method = {
        "config": "zoo.yml",
        "overrides": {"curiosity": None},
        "pretrain": {"collector": "curious", "budget": 160},
    }
    (cell,) = load_grid(write_grid(tmp_path, budget=160, methods={"p": method})).cells
    end = CuReSAC._end_pretraining

    def keep_then_fail(self: CuReSAC) -> None:
        if self._collector is not None:
            raise RuntimeError("the power went")

    # `pretrain` calls it last, after the callback has kept what there is of the last step but one.
    monkeypatch.setattr(CuReSAC, "_end_pretraining", keep_then_fail)
    with pytest.raises(RuntimeError, match="the power went"):
        run_cell(cell, tmp_path, 0, pictures=False)
    monkeypatch.setattr(CuReSAC, "_end_pretraining", end)
    folder = run_cell(cell, tmp_path, 0, pictures=False)
    assert steps_of(folder / "eval.csv") == [0, 160]
    assert CuReSAC.load(folder / "model.zip").num_timesteps == 40


def test_a_damaged_checkpoint_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The cell begins anew rather than failing for ever, and says why."""
    (cell,) = load_grid(write_grid(tmp_path, budget=160)).cells
    write = cells.write_text
    monkeypatch.setattr(cells, "write_text", lambda path, text: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_cell(cell, tmp_path, 0, pictures=False)
    monkeypatch.setattr(cells, "write_text", write)
    for path in (tmp_path / cell.folder / "checkpoint").glob("generation-*/model.zip"):
        path.write_bytes(path.read_bytes()[:1000])
    folder = run_cell(cell, tmp_path, 10, pictures=False)
    assert "begins anew, its checkpoints are kept in unusable-0: no checkpoint in" in capsys.readouterr().out
    assert len(list((folder / "unusable-0").glob("generation-*"))) == 2
    assert steps_of(folder / "eval.csv") == [0, 160] and (folder / "DONE").exists()


def test_two_processes_do_not_run_one_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one is told so, while the first is at it."""
    (cell,) = load_grid(write_grid(tmp_path, budget=40)).cells
    refusals = []
    learn = CuReSAC.learn

    def learn_while_another_tries(self: CuReSAC, *args: Any, **kwargs: Any) -> CuReSAC:
        with pytest.raises(GridError, match="is being run by another process") as refusal:
            run_cell(cell, tmp_path, pictures=False)
        refusals.append(refusal)
        assert run.read_progress(cell, tmp_path)[0] == "running"
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(CuReSAC, "learn", learn_while_another_tries)
    run_cell(cell, tmp_path, pictures=False)
    assert len(refusals) == 1


@pytest.mark.parametrize("phase", ["train", "pretrain"])
def test_a_cell_goes_on_after_any_exception(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str) -> None:
    """Stopped in the middle of either phase it goes on from the checkpoint, with all its data, and repeats no row."""
    method: dict[str, Any] = {"config": "zoo.yml"}
    if phase == "pretrain":
        method["pretrain"] = {"collector": "curious", "budget": 240}
    (cell,) = load_grid(write_grid(tmp_path, methods={"cure": method})).cells
    # 40 steps, an evaluation of two actors over two episodes (as before the first step), 25 steps; pretraining has none
    stop_at = 45 if phase == "pretrain" else 2 * 80 + 65
    step = PixelBox.step
    steps, updates = [], []

    def count(self: PixelBox, action: np.ndarray) -> Any:
        steps.append(action)
        if len(steps) == stop_at:
            raise RuntimeError("the power went")
        return step(self, action)

    train = CuReSAC.train
    monkeypatch.setattr(
        CuReSAC,
        "train",
        lambda self, *args, **kwargs: (updates.append(self.num_timesteps), train(self, *args, **kwargs)),
    )
    monkeypatch.setattr(PixelBox, "step", count)
    with pytest.raises(RuntimeError, match="the power went"):
        run_cell(cell, tmp_path, checkpoint_minutes=0, pictures=False)
    folder = tmp_path / cell.folder
    assert not (folder / "DONE").exists() and run.read_progress(cell, tmp_path)[0] == "interrupted"
    reached = updates[-1]
    updates.clear()
    run_cell(cell, tmp_path, checkpoint_minutes=0, pictures=False)
    assert steps_of(folder / "eval.csv") == [0, 160, 320, 400]
    assert updates[0] in (reached, reached + 1), "it began where the checkpoint was taken, not anew"
    conditions = json.loads((folder / "run.json").read_text())
    assert conditions["attempts"] == 2
    episodes = [(row["environment_steps"], row["actor"], row["episode"]) for row in read_rows(folder / "episodes.csv")]
    assert len(episodes) == len(set(episodes)) == 4 * 2 * 2


def test_a_failing_cell_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Its sentence is printed and its traceback kept; the exit status tells; run again it is finished."""
    path = write_grid(tmp_path, seeds=2, budget=40)
    out = tmp_path / "out"
    learn = CuReSAC.learn

    def learn_or_fail(self: CuReSAC, *args: Any, **kwargs: Any) -> CuReSAC:
        if self.seed == 0:
            raise RuntimeError("no luck")
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(CuReSAC, "learn", learn_or_fail)
    assert run.main([str(path), "--out", str(out), "--no-pictures"]) == 1
    told = capsys.readouterr().out
    assert "seed0 failed: RuntimeError: no luck" in told.replace("\n", " ")
    assert "┃ method ┃" in told and "1 of 2 cells done" in told  # a table of what is not done
    folder = out / "tiny" / "PixelBox" / "cure"
    assert "learn_or_fail" in (folder / "seed0" / "error.txt").read_text()
    assert (folder / "seed1" / "DONE").exists() and not (folder / "seed0" / "DONE").exists()
    monkeypatch.setattr(CuReSAC, "learn", learn)
    assert run.main([str(path), "--out", str(out), "--no-pictures"]) == 0
    assert (folder / "seed0" / "DONE").exists() and not (folder / "seed0" / "error.txt").exists()
    capsys.readouterr()
    assert run.main([str(path), "--out", str(out), "--no-pictures"]) == 0
    told = capsys.readouterr().out
    assert re.fullmatch(r"2 of 2 cells done, best return [\d.]+ \(tiny/PixelBox/cure/seed\d\)\n", told)
    assert run.main([str(path), "--out", str(out), "--dry-run", "--tasks", "PixelBox, "]) == 0
    assert capsys.readouterr().out.count(": done") == 2


def test_returns_that_are_no_numbers_end_a_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """With transitions skipped it was DONE, and the report of all experiments refused it, however often it was run."""
    step = PixelBox.step

    def step_or_nan(self: PixelBox, action: np.ndarray) -> tuple[Any, ...]:
        observation, reward, terminated, truncated, info = step(self, action)
        return observation, math.nan if truncated else reward, terminated, truncated, info

    monkeypatch.setattr(PixelBox, "step", step_or_nan)
    path = write_grid(tmp_path, methods={"a": {"config": "zoo.yml", "overrides": {"on_bad_transition": "skip"}}})
    assert run.main([str(path), "--out", str(tmp_path / "out"), "--no-pictures"]) == 1
    sentence = "seed0 failed: ValueError: episode 0 of the evaluation at 0 environment steps has the return nan, but"
    assert sentence in capsys.readouterr().out


def test_a_cell_that_cannot_be_written_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Not even its error can be kept: it is printed. What only tells how far a cell is may be missing."""
    path, out = write_grid(tmp_path, seeds=2, budget=40), tmp_path / "out"
    folder = out / "tiny" / "PixelBox" / "cure"
    folder.mkdir(parents=True)
    (folder / "seed0").write_text("in its place")
    write = cells.write_json

    def disk_is_full(path: Path, content: Any) -> None:
        if path.name == "progress.json":
            raise OSError("No space left on device")
        write(path, content)

    monkeypatch.setattr(cells, "write_json", disk_is_full)
    assert run.main([str(path), "--out", str(out), "--no-pictures"]) == 1
    told = capsys.readouterr().out
    assert "error.txt cannot be written (" in told and "it would tell: FileExistsError" in told
    assert "seed0 failed: there is no file any more that tells why" in told
    assert (folder / "seed1" / "DONE").exists()


def test_damaged_files_of_results_are_named(tmp_path: Path, visits: Path) -> None:
    """In one sentence, with what to do; how far a cell was, is not worth one."""
    grid, out = load_grid(visits, seeds=2), tmp_path / "out"
    assert run.run_grid(grid, out, pictures=False) == []
    cell = out / grid.cells[0].folder
    head = out / heads.common_heads(grid, out)[0].folder
    for path in (cell / "config.json", cell / "run.json", head / "common_head.json", out / "tiny" / "grid.json"):
        whole = path.read_text()
        for damaged in ("", "[]", "{", "{}"):
            if path.name in ("config.json", "grid.json") and damaged == "{}":
                continue  # refused as other settings
            path.write_text(damaged)
            with pytest.raises(GridError, match=f"{path} is damaged: put it back, or remove .*, which is then made"):
                run.run_grid(grid, out, pictures=False)
        path.write_text(whole)
    (cell / "DONE").unlink()
    for damaged in ("", "{}", "[1]", '{"seconds": 1}'):
        (cell / "progress.json").write_text(damaged)
        assert run.read_progress(grid.cells[0], out) == ("waiting", {})


def test_logs_tell_how_far_everything_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Without a terminal one line now and then, although no cell is finished; not between these moments."""
    done, running, waiting = load_grid(write_grid(tmp_path, seeds=3)).cells
    for cell in (done, running):
        (tmp_path / cell.folder).mkdir(parents=True)
    (tmp_path / done.folder / "DONE").touch()
    cells.write_progress(tmp_path / done.folder, environment_steps=400, seconds=80, best_return=4.2)
    cells.write_progress(tmp_path / running.folder, environment_steps=100, seconds=10, best_return=7.4)
    line = "1 of 3 cells done, 1 running, 10.0 environment steps/s, about 1 min left, best return 7.4 "
    line += f"({running.folder})"  # 300 and 400 steps are left: 70 s
    ticks: list[None] = []

    def list_units() -> list[heads.Unit]:
        ticks.append(None)
        return [done, running, waiting]

    printed = ""
    with cells.alone_in(tmp_path / running.folder):
        with run._live_progress(list_units, tmp_path):
            wait_for(lambda: len(ticks) > 5)
        told = capsys.readouterr().out
        assert line not in told.splitlines(), "five minutes are not over"
        assert "best return 7.4" in " ".join(told.split()), "the caption of the last table"
        write_line = run._Progress.summary

        def only_line(progress: run._Progress) -> str:
            """A second later a next one would be due, which may be before the first one is read."""
            if threading.current_thread() is not threading.main_thread():  # which draws the tables
                monkeypatch.setattr(run, "SUMMARY_SECONDS", math.inf)
            return write_line(progress)

        monkeypatch.setattr(run._Progress, "summary", only_line)
        monkeypatch.setattr(run, "SUMMARY_SECONDS", 0.0)
        with run._live_progress(list_units, tmp_path):
            while line not in printed:
                printed += wait_for(lambda: capsys.readouterr().out)
    assert printed.splitlines().count(line) == 1


@contextmanager
def unread_stdout() -> Iterator[None]:
    """Standard output is a pipe that nobody reads any more; what is left in it must not raise when Python ends."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe, redirect_stdout(pipe):
        yield
        print("more", flush=True)


def test_a_list_of_cells_may_be_cut_off(tmp_path: Path) -> None:
    """``sb3-cure experiment --dry-run | head -1`` ends without a traceback, as a program that a pipe ends."""
    path = write_grid(tmp_path)
    with unread_stdout():
        assert run.main([str(path), "--out", str(tmp_path / "out"), "--dry-run"]) == 128 + 13


def test_cells_are_finished_though_nobody_reads_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``sb3-cure experiment | tee log``, whose ``tee`` has died: neither cells nor what is shown later know of it."""
    monkeypatch.setattr(run, "SUMMARY_SECONDS", 0.0)
    write_line, run_cell, told = run._Progress.summary, run.run_cell, threading.Event()

    def line(progress: run._Progress) -> str:
        told.set()
        return write_line(progress)

    def run_later(*arguments: Any) -> None:
        """Each cell sees another line being told."""
        told.clear()
        assert told.wait(60)
        run_cell(*arguments)

    monkeypatch.setattr(run._Progress, "summary", line)
    monkeypatch.setattr(run, "run_cell", run_later)
    grid = load_grid(write_grid(tmp_path, seeds=2))
    with unread_stdout():
        assert run.run_grid(grid, tmp_path / "out", pictures=False) == []
    assert all(cell.is_done(tmp_path / "out") for cell in grid.cells)


def test_only_of_other_machines_the_clock_tells_what_runs(tmp_path: Path) -> None:
    """Their locks may be unknown here; of this machine a lock that nobody holds says that nothing runs."""
    (cell,) = load_grid(write_grid(tmp_path)).cells
    folder = tmp_path / cell.folder
    folder.mkdir(parents=True)
    assert run.read_progress(cell, tmp_path)[0] == "waiting"
    cells.write_progress(folder, environment_steps=8, seconds=2)
    here = json.loads((folder / "progress.json").read_text())
    states = []
    for change in ({}, {"machine": "another"}, {"machine": "another", "time": here["time"] - 3600}):
        (folder / "progress.json").write_text(json.dumps({**here, **change}))
        states.append(run.read_progress(cell, tmp_path)[0])
    assert states == ["interrupted", "running", "interrupted"]


# ------------------------------------------------------------------ visitation


def visitation_grid(folder: Path) -> Grid:
    methods = {
        "random": {
            "config": "zoo.yml",
            "overrides": {"curiosity": None},
            "pretrain": {"collector": "random", "budget": 240},
            "train": False,
        },
        "cure": {"config": "zoo.yml", "overrides": {"task": False}},
    }
    return load_grid(
        write_grid(folder, kind="visitation", budget=240, seeds=2, methods=methods, experiment="visits",
                   tasks=["dmc_pixels/cartpole-swingup-v0"], evaluation=dict(every=240, episodes=1))
    )  # fmt: skip


def test_visits_are_measured_by_own_common_and_ignorant_heads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On real pixels: an untrained yardstick is the image's own energy, the mean image beats it, states are true."""
    monkeypatch.setattr(heads, "COMMON_UPDATES", 150)
    monkeypatch.setattr(heads, "COMMON_SHARE", 100)
    grid = visitation_grid(tmp_path)
    assert run.run_grid(grid, tmp_path / "out", pictures=False) == []
    for cell in grid.cells:
        folder = tmp_path / "out" / cell.folder
        rows = read_rows(folder / "visitation.csv")
        actors = ["random"] if cell.method == "random" else ["curious", "random"]
        assert {(row["actor"], row["head"]) for row in rows} == {
            (actor, head) for actor in actors for head in ("own", "common", "zero", "mean_image")
        }
        assert all(0 <= row["error_min"] <= row["error_mean"] <= row["error_max"] for row in rows)
        error = {(row["actor"], row["head"]): row["error_mean"] for row in rows}
        for actor in actors:
            # Published for a prediction of zero on this task: .0520 (other camera and size here, grey)
            assert 0.02 < error[actor, "zero"] < 0.08
            assert error[actor, "mean_image"] < error[actor, "zero"] / 5
            assert error[actor, "common"] < error[actor, "zero"] / 2, "the common head has learned something"
        visits = np.load(folder / "visits.npz")
        assert list(visits["state_names"]) == ["slider", "hinge_1", "slider_velocity", "hinge_1_velocity"]
        for actor in actors:
            assert visits[f"{actor}_states"].shape == (125, 4) and visits[f"{actor}_errors"].shape == (125,)
            assert visits[f"{actor}_errors"].mean() == pytest.approx(error[actor, "own"], rel=1e-4)
    # A choice of cells changes nothing about the common heads: they are the experiment's.
    written = {path: path.read_bytes() for path in (tmp_path / "out").rglob("visitation.csv")}
    few = load_grid(tmp_path / "grid.yml", methods=["cure"], seeds=[1])
    assert run.run_grid(few, tmp_path / "out", pictures=False) == []
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("visitation.csv")} == written
    # The arms of a seed are measured on the same random episodes, another seed on others.
    returns = [
        {
            row["return"]
            for row in read_rows(tmp_path / "out" / cell.folder / "visitation.csv")
            if row["actor"] == "random"
        }
        for cell in grid.cells
    ]
    assert returns[0] == returns[1] and returns[2] == returns[3] and returns[0].isdisjoint(returns[2])


def test_yardsticks_of_vectors_are_the_same_with_any_head() -> None:
    """Zero and the mean vector, as vectors are not quantised; with an autoencoder, another head or none."""
    seen = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    episode: Any = SimpleNamespace(observations=seen)
    for srl in ("rae", None):
        model = tiny_model("MlpPolicy", VectorBox(), srl=srl, curiosity=None)
        mean = visitation.mean_target(model, [episode])
        assert mean == pytest.approx(seen.mean(axis=0), abs=1e-6)
        for constant in (mean, np.zeros(2)):
            expected = np.square(seen - constant).mean(axis=1)
            assert visitation.constant_errors(model, seen, constant) == pytest.approx(expected, abs=1e-6)


def test_yardsticks_of_discrete_observations_are_the_same_with_any_head() -> None:
    """One-hot, as an autoencoder draws them."""

    class Rooms(gym.ObservationWrapper):
        def __init__(self) -> None:
            super().__init__(VectorBox())
            self.observation_space = gym.spaces.Discrete(2)

        def observation(self, observation: np.ndarray) -> Any:
            return np.int64(observation[0] > 0)

    episode: Any = SimpleNamespace(observations=np.array([0, 0, 1, 0]))
    for srl in ("rae", None):
        model = tiny_model("MlpPolicy", Rooms(), srl=srl, curiosity=None)
        mean = visitation.mean_target(model, [episode])
        assert mean == pytest.approx([0.75, 0.25])
        assert visitation.constant_errors(model, episode.observations, mean) == pytest.approx(
            [0.0625, 0.0625, 0.5625, 0.0625]
        )


def test_pictures_show_every_policy_and_name_the_actions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of both policies; the map is that of the measured visits, of sampled and random actions, in any kind."""
    maps: list[dict[str, Any]] = []
    titles: list[str] = []
    draw, write = plots.curiosity_map, media.write_video
    monkeypatch.setattr(plots, "curiosity_map", lambda *args, **how: (maps.append(args[1]), titles.append(args[3])))
    monkeypatch.setattr(media, "write_video", lambda *args: (titles.append(args[-1]), write(*args)))
    settings: dict[str, Any] = dict(tasks=["dmc_pixels/cartpole-swingup-v0"], evaluation=dict(every=240, episodes=1))
    for kind in ("curves", "visitation"):
        (cell,) = load_grid(write_grid(tmp_path, kind=kind, budget=80, experiment=kind, **settings)).cells
        run_cell(cell, tmp_path)
        assert sorted(path.name for path in (tmp_path / cell.folder).glob("*.mp4")) == [
            "curious_policy.mp4",
            "task_policy.mp4",
        ]
    named = "cartpole-swingup, cure, seed 0"
    assert titles[:3] == titles[3:] == [
        f"Where policies go with sampled actions: {named}",
        f"task policy, deterministic actions: {named}",
        f"curious policy, deterministic actions: {named}",
    ]  # fmt: skip
    anew, measured = maps
    assert list(anew) == list(measured) == ["task", "curious", "random"]
    for actor, arrays in measured.items():
        for one, other in zip(anew[actor], arrays, strict=True):
            assert len(one) == 125
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)  # one of them from a file of float32
    draw(tmp_path / "map.png", measured, [str(number) for number in range(4)], "", coordinates=("0", "1"))
    assert (tmp_path / "map.png").exists()


@pytest.mark.parametrize(
    ("channels", "wraps", "shown"), [(2, False, 1), (3, False, 3), (4, True, 1), (4, False, 1), (9, False, 1)]
)
def test_pictures_are_drawn_of_any_number_of_channels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, channels: int, wraps: bool, shown: int
) -> None:
    """Whether or not an environment tells its frames: four channels are not a picture with transparency."""

    class Channels(PixelBox):
        def __init__(self) -> None:
            super().__init__(frame_stack=3, tells_frame_stack=False)
            self.observation_space = gym.spaces.Box(0, 255, (36, 36) if wraps else (channels, 36, 36), np.uint8)

        def observe(self, first: bool = False) -> np.ndarray:
            seen = super().observe(first)
            return seen[0] if wraps else seen[:channels]

    def make() -> gym.Env:
        return gym.wrappers.FrameStackObservation(Channels(), channels) if wraps else Channels()

    gym.registry[TASK] = gym.envs.registration.EnvSpec(TASK, make)
    drawn: list[int] = []
    draw = plots._picture
    monkeypatch.setattr(plots, "_picture", lambda image: (drawn.append(image.shape[-1]), draw(image))[1])
    (cell,) = load_grid(write_grid(tmp_path, budget=160)).cells
    folder = run_cell(cell, tmp_path / "out")
    assert (folder / "uncomfortable.png").is_file() and (folder / "DONE").is_file()
    assert set(drawn) == {shown}


def test_pictures_that_cannot_be_drawn_cost_no_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("no\nfont")

    monkeypatch.setattr(plots, "uncomfortable_frames", fail)
    (cell,) = load_grid(write_grid(tmp_path, budget=80)).cells
    folder = run_cell(cell, tmp_path / "out")
    assert cell.is_done(tmp_path / "out") and (folder / "run.json").is_file()
    assert f"{folder} is without some of its pictures: RuntimeError: no font\n" in capsys.readouterr().out


@pytest.fixture
def visits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A grid of three seeds on the tiny task, with common heads that are soon fitted."""
    monkeypatch.setattr(heads, "COMMON_UPDATES", 3)
    monkeypatch.setattr(heads, "COMMON_SHARE", 10)
    return write_grid(tmp_path, kind="visitation", budget=40, seeds=3, evaluation=dict(every=40, episodes=1))


def common_rows(out: Path) -> dict[str, list[Any]]:
    """By the cell's folder."""
    tables = {path.parent.name: read_rows(path) for path in out.rglob("visitation.csv")}
    return {name: [row for row in rows if row["head"] == "common"] for name, rows in tables.items()}


def test_common_heads_are_made_once_and_again_of_other_cells(visits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was stopped is all that the next call makes; more seeds, and cells run again, ask for others."""
    out = visits.parent / "out"
    fitted: list[int] = []
    rolled_out: list[tuple[int, str]] = []
    fit, roll_out = heads.fit_head, heads.roll_out

    def fit_but_one(model: CuReSAC, *arguments: Any) -> Iterator[int]:
        fitted.append(model.seed - 1000)
        if fitted == [0, 1]:
            raise RuntimeError("the power went")
        yield from fit(model, *arguments)

    def count(model: CuReSAC, cell: Any, env: Any, actor: str) -> Any:
        rolled_out.append((cell.seed, actor))
        return roll_out(model, cell, env, actor)

    monkeypatch.setattr(heads, "fit_head", fit_but_one)
    monkeypatch.setattr(heads, "roll_out", count)
    grid = load_grid(visits)
    (stopped,) = run.run_grid(grid, out, pictures=False)
    assert stopped.folder == Path("tiny", "PixelBox", "common_heads", "for_seed1")
    assert "the power went" in (out / stopped.folder / "error.txt").read_text()
    assert run.read_progress(stopped, out)[0] == "failed"
    rows = common_rows(out)
    assert [name for name in sorted(rows) if rows[name]] == ["seed0", "seed2"]
    assert run.run_grid(grid, out, pictures=False) == []
    assert fitted == [0, 1, 2, 1]
    # Once for the mixes, which all heads share, and once to be judged.
    every = [(seed, actor) for seed in range(3) for actor in ("task", "curious", "random")]
    assert sorted(rolled_out) == sorted(2 * every)
    assert not list(out.rglob("mix*"))
    again = common_rows(out)
    assert again["seed0"] == rows["seed0"] and again["seed2"] == rows["seed2"] and again["seed1"]
    assert run.run_grid(grid, out, pictures=False) == [] and len(fitted) == 4
    # Made anew of the same cells they are the same; after another training of a seed they are not.
    shutil.rmtree(out / "tiny" / "PixelBox" / "common_heads")
    assert run.run_grid(load_grid(visits, seeds=[0]), out, pictures=False) == []
    assert common_rows(out) == again and fitted[4:] == [0, 1, 2]
    shutil.rmtree(out / grid.cells[1].folder)
    monkeypatch.setattr(cells, "_now", lambda: "later")
    assert run.run_grid(grid, out, pictures=False) == []
    assert common_rows(out)["seed1"] and fitted[7:] == [0, 1, 2]
    assert run.run_grid(load_grid(visits, seeds=4), out, pictures=False) == []
    assert fitted[10:] == [0, 1, 2, 3]
    assert [len(rows) for rows in common_rows(out).values()] == [3] * 4


def test_variants_of_an_arm_do_not_outweigh_the_others_in_common_heads(
    visits: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mix has random, task and curious observations alike, of the first arm of each; all arms are judged by it."""
    grid = yaml.safe_load(visits.read_text())
    (first,) = grid["methods"].values()
    grid["methods"] = {"first": first, "variant": {**first, "overrides": {"curiosity_prob": 0.5}}}
    visits.write_text(yaml.safe_dump({**grid, "baseline": "first", "seeds": 2}))
    rolled_out: list[tuple[str, str]] = []
    mixed: list[int] = []
    fit, roll_out = heads.fit_head, heads.roll_out

    def fit_and_count(model: CuReSAC, observations: np.ndarray, updates: int) -> Iterator[int]:
        mixed.append(len(observations))
        yield from fit(model, observations, updates)

    def count(model: CuReSAC, cell: Any, env: Any, actor: str) -> Any:
        rolled_out.append((cell.method, actor))
        return roll_out(model, cell, env, actor)

    monkeypatch.setattr(heads, "fit_head", fit_and_count)
    monkeypatch.setattr(heads, "roll_out", count)
    assert run.run_grid(load_grid(visits), visits.parent / "out", pictures=False) == []
    assert mixed == [3 * heads.COMMON_SHARE] * 2
    for actor in ("random", "task", "curious"):  # of both seeds: once for the mix, once to be judged
        assert (rolled_out.count(("first", actor)), rolled_out.count(("variant", actor))) == (4, 2)


def test_results_name_their_commit_wherever_the_code_comes_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkout's, marked when changed; what pip was given; what an image says; nothing where nothing tells."""
    package = tmp_path / "checkout" / "sb3_cure" / "__init__.py"
    package.parent.mkdir(parents=True)
    package.touch()
    monkeypatch.setattr(sb3_cure, "__file__", str(package))
    monkeypatch.delenv("SB3_CURE_COMMIT", raising=False)
    origin = dict[str, Any]()
    installed = SimpleNamespace(read_text=lambda name: json.dumps(origin) if name == "direct_url.json" else None)
    monkeypatch.setattr(experiment_files, "distribution", lambda name: installed)
    assert experiment_files.code_commit() is None
    origin.update(url="https://example.com/repo", vcs_info={"vcs": "git", "commit_id": "0123456789abcdef"})
    assert experiment_files.code_commit() == "0123456789ab"
    git = ["git", "-C", str(package.parent.parent), "-c", "user.name=a", "-c", "user.email=a@example.com"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"]):
        subprocess.run([*git, *command], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout[:12]
    assert experiment_files.code_commit() == commit
    package.write_text("changed")
    assert experiment_files.code_commit() == f"{commit}-dirty"
    monkeypatch.setenv("SB3_CURE_COMMIT", "v1.2-3-gabc")
    assert experiment_files.code_commit() == "v1.2-3-gabc"


def test_a_cluster_that_is_too_small_leaves_no_trace(tmp_path: Path) -> None:
    """Refused before anything is written, as all that cannot work."""
    with pytest.raises(GridError, match="--cpus-per-cell is 999, but no machine of this Ray cluster has more than"):
        run.run_grid(load_grid(write_grid(tmp_path)), tmp_path / "out", engine="ray", cpus_per_cell=999)
    assert not (tmp_path / "out").exists()


def test_gpus_of_a_cluster_are_given_to_cells_or_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray keeps no account of what nobody asks for: a cell per core would compute on the first card."""
    with monkeypatch.context() as with_gpus:
        with_gpus.setenv("RAY_OVERRIDE_RESOURCES", '{"GPU": 2}')
        sentence = (
            r"--gpus-per-cell is not given, but a machine of this Ray cluster has 2: give the share of one per cell"
        )
        with pytest.raises(GridError, match=sentence):
            run.run_grid(load_grid(write_grid(tmp_path)), tmp_path / "out", engine="ray")
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    seen: list[str] = []
    monkeypatch.setattr(run, "_run_and_tell", lambda *_: seen.append(os.environ["CUDA_VISIBLE_DEVICES"]))
    cell = load_grid(write_grid(tmp_path)).cells[0]
    for has_gpu in (True, False):
        run._run_on_worker(cell, tmp_path, 10, False, has_gpu)
    assert seen == ["0", ""]


def test_cells_of_other_settings_are_refused_whatever_their_seed(tmp_path: Path) -> None:
    """One seed per job, of which somebody changed the grid in between: else arms would mix both, unseen."""
    overrides = {"config": "zoo.yml", "overrides": {"batch_size": 9}}
    run.run_grid(load_grid(write_grid(tmp_path), seeds=[7]), tmp_path / "out", pictures=False)
    changed = load_grid(write_grid(tmp_path, methods={"cure": overrides}), seeds=[8])
    with pytest.raises(GridError, match=r"seed7 was run with other settings: arguments is .*'batch_size': 8.* there"):
        run.run_grid(changed, tmp_path / "out", pictures=False)
    assert not (tmp_path / "out" / changed.cells[0].folder).exists()


def test_common_heads_see_the_other_seeds_alone(visits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The policies of a seed are judged by a head that has seen nothing of them, but all of the others."""
    seen: dict[int, set[int]] = {}

    def mix(head: heads.CommonHead, seed: int, results: Path) -> np.ndarray:
        return np.full((4, 3, 24, 24), seed, dtype=np.uint8)

    def fit(model: CuReSAC, observations: np.ndarray, updates: int) -> Iterator[int]:
        seen[model.seed - 1000] = set(np.unique(observations).tolist())
        yield 1

    monkeypatch.setattr(heads, "_mix", mix)
    monkeypatch.setattr(heads, "fit_head", fit)
    assert run.run_grid(load_grid(visits), visits.parent / "out", pictures=False) == []
    assert seen == {0: {1, 2}, 1: {0, 2}, 2: {0, 1}}


def test_common_heads_are_made_of_all_finished_seeds_whoever_ran_them(visits: Path) -> None:
    """One call per seed, none of them the file's; then nobody who knew less replaces what was made."""
    out = visits.parent / "out"
    for seed in (5, 6):
        assert run.run_grid(load_grid(visits, seeds=[seed]), out, pictures=False) == []
    grid = load_grid(visits, seeds=[7])
    known = heads.common_heads(grid, out)
    assert [head.seed for head in known] == [5, 6] and all(common_rows(out).values())
    assert run.run_grid(grid, out, pictures=False) == []
    rows = common_rows(out)
    assert [head.seeds for head in heads.common_heads(grid, out)] == [[5, 6, 7]] * 3 and rows.keys() == {
        "seed5", "seed6", "seed7"
    }  # fmt: skip
    for head in known:
        heads.run_head(head, out)
    assert common_rows(out) == rows


def test_common_heads_in_other_hands_come_last(visits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process that makes one, perhaps of fewer cells, is waited for; meanwhile the others are made."""
    out, order = visits.parent / "out", list[int]()
    assert run.run_grid(load_grid(visits, seeds=[0]), out, pictures=False) == []
    folder = out / "tiny" / "PixelBox" / "common_heads" / "for_seed0"
    folder.mkdir(parents=True)
    fit, others_are_made = heads.fit_head, threading.Event()

    def note(model: CuReSAC, *arguments: Any) -> Iterator[int]:
        order.append(model.seed - 1000)
        yield from fit(model, *arguments)
        if len(order) == 2:
            others_are_made.set()

    def hold() -> None:
        with cells.alone_in(folder):
            assert others_are_made.wait(100)

    monkeypatch.setattr(heads, "fit_head", note)
    holder = threading.Thread(target=hold)
    holder.start()
    assert run.run_grid(load_grid(visits), out, pictures=False) == []
    holder.join()
    assert order == [1, 2, 0] and all(common_rows(out).values())


def test_without_models_no_common_heads_are_made_of_the_others_alone(
    visits: Path, capsys: pytest.CaptureFixture
) -> None:
    """Repositories keep no ``model.zip``: their rows stand, but further seeds would be judged by another measure."""
    out = visits.parent / "out"
    assert run.run_grid(load_grid(visits, seeds=[0, 1, 2]), out, pictures=False) == []
    for path in out.rglob("model.zip"):
        path.unlink()
    rows = common_rows(out)
    capsys.readouterr()
    assert run.run_grid(load_grid(visits), out, pictures=False) == []
    assert "No common heads" not in capsys.readouterr().out, "they are there"
    assert run.run_grid(load_grid(visits, seeds=5), out, pictures=False) == []
    lacking = out / "tiny" / "PixelBox" / "cure" / "seed0"
    expected = f"No common heads for {TASK}: they would be made of all finished cells, but {lacking} has no model.zip:"
    assert expected in capsys.readouterr().out
    assert common_rows(out) == {**rows, "seed3": [], "seed4": []}


def test_common_heads_of_other_settings_are_refused(visits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As cells are: one that was fitted by fewer updates is not taken for another."""
    assert run.run_grid(load_grid(visits), visits.parent / "out", pictures=False) == []
    monkeypatch.setattr(heads, "COMMON_UPDATES", 4)
    with pytest.raises(GridError, match="for_seed0 was run with other settings: updates is 3 there and 4 now"):
        run.run_grid(load_grid(visits), visits.parent / "out", pictures=False)


def test_common_heads_of_pickled_models_tell_what_to_do(visits: Path, capsys: pytest.CaptureFixture) -> None:
    """Finished cells of older versions: the sentence names the file, and doing what it says is enough."""
    out = visits.parent / "out"
    options = [str(visits), "--out", str(out), "--no-pictures"]
    path = out / load_grid(visits).cells[0].folder / "model.zip"
    assert run.main([*options, "--seeds", "1"]) == 0
    SAC.save(CuReSAC.load(path), path)
    assert run.main(options) == 1
    advice = f"CuReSAC.load({str(path)!r}, trusted=True).save({str(path)!r})"
    assert f"{path} was written by an older version" in (told := capsys.readouterr().out) and advice in told
    eval(advice)
    assert run.main(options) == 0
    assert all(common_rows(out).values())


def test_yardsticks_follow_an_autoencoder_from_its_first_update() -> None:
    """Untrained it errs like a prediction of zero, as the paper reports; then it learns. Rows make the table."""
    rows = yardsticks.measure_task("dmc_pixels/cartpole-swingup-v0", (0,), (0, 1, 6), 40, frame_stack=1)
    error = {(row["predictor"], row["updates"]): row["error_mean"] for row in rows}
    # .0518 +- .0005 was measured elsewhere from the renderer's pixels alone.
    assert error["zero", 0] == pytest.approx(0.0518, abs=0.001)
    assert error["autoencoder", 0] == pytest.approx(error["zero", 0], rel=0.1)
    assert error["mean_image", 0] < error["autoencoder", 6] < error["autoencoder", 0]
    *_, line = yardsticks.table(rows)
    numbers = [f"{error[key]:.4f}" for key in (("zero", 0), ("mean_image", 0), ("autoencoder", 0))]
    assert line.startswith(f"| cartpole-swingup | 0.0002 | 0.0540 | {' | '.join(numbers)} |")
    assert line.endswith(f"| {error['autoencoder', 6]:.4f} (6) |")


def test_zero_decoder_errs_alike_in_the_script_for_older_versions_of_mujoco() -> None:
    """Which shares no code with the rest, as nothing else runs there; its rows become a column of the same table."""
    (zero, *_) = yardsticks.measure_task("dmc_pixels/reacher-easy-v0", (0,), (0,), 20)
    error = zero_decoder.zero_error("reacher", "easy", action_repeat=4, seed=0, steps=20)
    assert error == pytest.approx(zero["error_mean"], rel=0.02)
    elsewhere = [
        {"mujoco": "2.3.2", "task": task, "seed": seed, "error_mean": error}
        for task, seed, error in (("reacher-easy", 0, 0.038), ("reacher-easy", 1, 0.040), ("other", 0, 1.0))
    ]
    row = {"task": "reacher-easy", "updates": 0, "seed": 0, "error_mean": 0.05}
    rows = [{**row, "predictor": name} for name in ("zero", "mean_image", "autoencoder")]
    header, _, line = yardsticks.table(rows, elsewhere)
    assert line.split(" | ")[header.split(" | ").index("zero, MuJoCo 2.3.2")] == "0.0390"


# ------------------------------------------------------------------- processes


#: The command, with common heads that are soon fitted
FEW_UPDATES = "from sb3_cure.experiments import heads, run; heads.COMMON_UPDATES = 20; raise SystemExit(run.main())"


def launch(path: Path, out: Path, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-c", FEW_UPDATES, str(path), "--out", str(out), "--no-pictures", *options]
    return subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE, text=True)


def wait_for(what: Any, seconds: float = 400) -> Any:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := what():
            return found
        time.sleep(0.1)
    raise TimeoutError(f"{what} did not come about in {seconds} s")


def has_checkpoint(folder: Path) -> bool:
    """One that training has written, after that of its start."""
    return max(Generations(folder / "checkpoint").numbers(), default=0) > 0


def test_a_killed_grid_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    """kill -9 in the middle of a cell: the same command finishes it, later than it began, with each row once."""
    path = write_grid(
        tmp_path, tasks=["dmc_pixels/cartpole-swingup-v0"], budget=4000, evaluation=dict(every=800, episodes=1)
    )
    out = tmp_path / "out"
    folder = out / "tiny" / "cartpole-swingup" / "cure" / "seed0"
    process = launch(path, out, "--checkpoint-minutes", "0.05")
    wait_for(lambda: has_checkpoint(folder))
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = Generations(folder / "checkpoint")
    newest = kept.folder(kept.numbers()[-1])
    assert read_state(newest / "state.safetensors")["num_timesteps"] > 0 and not (folder / "DONE").exists()
    process = launch(path, out)
    assert process.wait(timeout=300) == 0
    assert steps_of(folder / "eval.csv") == [0, 800, 1600, 2400, 3200, 4000]
    assert json.loads((folder / "run.json").read_text())["attempts"] == 2


def test_a_killed_ray_worker_costs_nothing(tmp_path: Path) -> None:
    """Two workers, one killed half-way: every cell is complete, no row is doubled, and the killed cell resumed.

    The common heads that follow are those that one process makes of the same cells.
    """
    pytest.importorskip("ray")
    path = write_grid(
        tmp_path, tasks=["dmc_pixels/cartpole-swingup-v0"], kind="visitation", budget=2400, seeds=2,
        evaluation=dict(every=400, episodes=1),
    )  # fmt: skip
    out = tmp_path / "out"
    folders = [out / cell.folder for cell in load_grid(path).cells]
    process = launch(path, out, "--engine", "ray", "--checkpoint-minutes", "0.05")
    try:
        victim = wait_for(lambda: next((cell for cell in folders if has_checkpoint(cell)), None))
        holders = [
            child
            for child in psutil.Process(process.pid).children(recursive=True)
            if "ray::" in " ".join(child.cmdline()) and _holds(child, victim / ".lock")
        ]
        assert len(holders) == 1, "one worker runs the cell"
        holders[0].send_signal(signal.SIGKILL)
        assert process.wait(timeout=1200) == 0
    finally:
        process.kill()
    for cell in folders:
        assert (cell / "DONE").exists()
        assert steps_of(cell / "eval.csv") == [0, 400, 800, 1200, 1600, 2000, 2400]
        with (cell / "episodes.csv").open() as file:
            keys = [(row["environment_steps"], row["actor"], row["episode"]) for row in csv.DictReader(file)]
        assert len(keys) == len(set(keys)) == 7 * 2
    assert json.loads((victim / "run.json").read_text())["attempts"] == 2
    by_ray = common_rows(out)
    assert all(by_ray.values())
    shutil.rmtree(out / "tiny" / "cartpole-swingup" / "common_heads")
    for cell in folders:
        write_csv(cell / "visitation.csv", COLUMNS, [])
    assert launch(path, out).wait(timeout=300) == 0
    assert common_rows(out) == by_ray


CARDS = """
import os, time
from pathlib import Path

import gymnasium as gym
import numpy as np


class Waits(gym.Env):
    '''Notes the card that it sees, and begins once another process is under way as well.'''

    observation_space = gym.spaces.Box(0, 255, (3, 36, 36), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        folder, me = Path(os.environ["CARDS"]), str(os.getpid())
        (folder / me).write_text(os.environ["CUDA_VISIBLE_DEVICES"])
        deadline = time.monotonic() + 120
        while len(list(folder.iterdir())) < 2:
            if time.monotonic() > deadline:
                raise TimeoutError("no other process has begun")
            time.sleep(0.05)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 1.0, False, False, {}


gym.register("Waits-v0", entry_point=Waits, max_episode_steps=20)
"""


def test_cells_share_a_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray takes any machine's word for its cards: two cells of half a card each run at the same time, on that card."""
    pytest.importorskip("ray")
    (tmp_path / "cards.py").write_text(CARDS)
    seen = tmp_path / "seen"
    seen.mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CARDS", str(seen))
    monkeypatch.setenv("RAY_OVERRIDE_RESOURCES", '{"GPU": 1, "CPU": 4}')
    path = write_grid(tmp_path, tasks=["cards:Waits-v0"], seeds=2, budget=40, evaluation=dict(every=40, episodes=1))
    assert launch(path, tmp_path / "out", "--engine", "ray", "--gpus-per-cell", "0.5").wait(timeout=600) == 0
    assert [card.read_text() for card in seen.iterdir()] == ["0", "0"]
    assert len(list((tmp_path / "out").rglob("DONE"))) == 2


def _holds(process: psutil.Process, path: Path) -> bool:
    try:
        return any(Path(file.path) == path for file in process.open_files())
    except psutil.Error:
        return False


def test_short_names_are_folder_names() -> None:
    """Without namespace and version."""
    assert short_name("dmc_pixels/ball_in_cup-catch-v0") == "ball_in_cup-catch"
    assert short_name("HalfCheetah-v5") == "HalfCheetah"
