"""The same seed on the same machine gives the same run: every logged number, every parameter, every stored pixel.

Two processes, whose hashes and memory addresses differ, make the same runs one after the other.
"""

import csv
import functools
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_cure import make_dmc_env

KINDS = {"dummy": DummyVecEnv, "subproc": functools.partial(SubprocVecEnv, start_method="forkserver")}
BOX = functools.partial(PixelBox, episode_length=3)


def cartpole() -> TimeLimit:
    """Real DeepMind Control pixels in episodes of three steps."""
    return TimeLimit(make_dmc_env("cartpole", "swingup", image_size=40), 3)


#: Environment, kind and number of them, agent steps, arguments of the model. All of an episode of three steps end
#: together, and log one loss.
RUNS: dict[str, tuple[Any, str, int, int, dict[str, Any]]] = {
    "box-rae-1": (BOX, "dummy", 1, 24, {}),
    "box-rae-1-bf16": (BOX, "dummy", 1, 24, dict(precision="bf16")),
    "box-off-4": (BOX, "dummy", 4, 48, dict(srl=None, curiosity=None)),
    "box-curl-4-subproc": (BOX, "subproc", 4, 48, dict(srl="curl")),
    "dmc-rae-2": (cartpole, "dummy", 2, 30, {}),
    "dmc-curl-2-overlap": (cartpole, "subproc", 2, 30, dict(srl="curl", overlap=True)),
}


def make_run(folder: Path, name: str, seed: int = 0) -> None:
    """Train, write ``progress.csv``, and ``final.pt`` with all that the training made.

    :param folder: Where to write
    :param name: Key of ``RUNS``
    :param seed: Seed of everything
    """
    env, kind, n_envs, steps, arguments = RUNS[name]
    venv = KINDS[kind]([env] * n_envs)
    try:
        model: Any = tiny_model("CnnPolicy", venv, seed=seed, **arguments)
        model.set_logger(configure(str(folder), ["csv"]))
        model.learn(steps, log_interval=1)
        th.save({"state": state_of(model), "buffer": model.replay_buffer.state_dict()}, folder / "final.pt")
    finally:
        venv.close()


def make_runs(folder: Path) -> None:
    """Make all runs.

    :param folder: Folder for a folder of each
    """
    th.set_num_threads(1)
    # So that workers need not import everything one by one
    multiprocessing.get_context("forkserver").set_forkserver_preload(["test_determinism", "dm_control.suite", "shimmy"])
    for name in RUNS:
        make_run(folder / name, name)


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of the same runs in two processes."""
    folders = tmp_path_factory.mktemp("first"), tmp_path_factory.mktemp("second")
    for hash_seed, folder in enumerate(folders, 1):
        code = f"import pathlib, test_determinism; test_determinism.make_runs(pathlib.Path({str(folder)!r}))"
        env = {**os.environ, "PYTHONHASHSEED": str(hash_seed), "PYTHONPATH": os.pathsep.join(sys.path)}
        subprocess.run([sys.executable, "-W", "ignore", "-c", code], cwd=Path(__file__).parent, env=env, check=True)
    return folders


def rows_of(folder: Path) -> list[dict[str, str]]:
    """The CSV log as text, but for what the clock says."""
    with open(folder / "progress.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return [{key: row[key] for key in row if key not in ("time/fps", "time/time_elapsed")} for row in rows]


@pytest.mark.parametrize("name", RUNS)
def test_two_runs_are_one(name: str, twice: tuple[Path, Path]) -> None:
    """All columns but the clock's, all parameters and optimisers, and the replay buffer are equal bit for bit."""
    first, second = (rows_of(folder / name) for folder in twice)
    assert first == second
    assert len({row["train/critic_loss"] for row in first} - {""}) >= 3, "too little was trained and logged to tell"
    states = [th.load(folder / name / "final.pt", weights_only=False) for folder in twice]
    assert differences(*states) == []


def test_another_seed_is_another_run(twice: tuple[Path, Path], tmp_path: Path) -> None:
    """What is compared above would show a difference."""
    name = "box-rae-1"
    make_run(tmp_path, name, seed=1)
    assert rows_of(tmp_path) != rows_of(twice[0] / name)
    found = differences(*(th.load(folder / "final.pt", weights_only=False) for folder in (tmp_path, twice[0] / name)))
    assert {".buffer.arrays.frames/", ".buffer.arrays.actions", ".state.policy.task.actor.mu.weight"} <= set(found)


def test_seed_that_is_set_later_holds_for_the_mixer() -> None:
    """Two models without a seed, and ``set_random_seed``, choose the same actors."""
    choices = []
    for _ in range(2):
        model = tiny_model("MlpPolicy", VectorBox(), seed=None)
        model.set_random_seed(5)
        starts = np.zeros(4, dtype=bool)
        choices.append([model._mixer.choose(starts, 0.5, 1, 1.0).tolist() for _ in range(20)])
    assert choices[0] == choices[1]
