"""Run the Python of pages of the documentation in miniature: ``python snippets_for_tests.py folder ...``.

Each folder has a ``page.py``, which runs there in a process and namespace of its own. Trainings last a few steps of
short episodes with tiny networks and images, and callbacks come due in them. Packages are imported once, before the
fork.
"""

import importlib
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common import env_util

import sb3_cure
from sb3_cure import envs, evaluation
from sb3_cure.cure.base import CuReBase
from sb3_cure.envs import dmc
from sb3_cure.evaluation import callbacks, rollouts
from sb3_cure.persistence import ExactCheckpoint

STEPS = 8
NETWORKS = {"net_arch": [8]}
FILTERS = {"n_filters": 2, "n_layers": 3}
TRAINING = {"learning_starts": 4, "warmup_updates": 1, "batch_size": 4}


def shrink(owner: Any, name: str, change: Callable[..., Any]) -> None:
    """Replace a function by ``change(function, *arguments)``."""
    function = getattr(owner, name)
    setattr(owner, name, lambda *args, **kwargs: change(function, *args, **kwargs))


def tiny_model(build: Callable[..., None], model: Any, *args: Any, **kwargs: Any) -> None:
    networks = {**(kwargs.get("policy_kwargs") or {}), **NETWORKS}
    networks["features_extractor_kwargs"] = {**networks.get("features_extractor_kwargs", {}), **FILTERS}
    build(model, *args, **{**kwargs, **TRAINING, "policy_kwargs": networks})


def few(run: Callable[..., Any], model: Any, steps: int, *args: Any, **kwargs: Any) -> Any:
    return run(model, min(steps, STEPS), *args, **kwargs)


def short_episodes(make: Callable[..., gym.Env], *args: Any, **kwargs: Any) -> gym.Env:
    return gym.wrappers.TimeLimit(make(*args, **kwargs), 20)


def small_env(make: Callable[..., gym.Env], *args: Any, **kwargs: Any) -> gym.Env:
    # 36 px: the smallest images of SB3's own network
    return gym.wrappers.TimeLimit(make(*args, **{**kwargs, "image_size": 36}), 4)


def two_episodes(run: Callable[..., Any], model: Any, env: gym.Env, n: int, *args: Any, **kwargs: Any) -> Any:
    return run(model, env, min(n, 2), *args, **kwargs)


def soon(begin: Callable[..., None], callback: Any, *args: Any, **kwargs: Any) -> None:
    begin(callback, *args, **kwargs)
    callback.every = min(callback.every, STEPS)


def checkpoint_soon(begin: Callable[..., None], callback: Any, save_freq: int, *args: Any, **kwargs: Any) -> None:
    begin(callback, min(save_freq, STEPS), *args, **kwargs)


def one_worker(make: Callable[..., Any], env: Any, n_envs: int = 1, **kwargs: Any) -> Any:
    return make(env, 1, **kwargs)


def run_page(folder: str) -> bool:
    """Whether the page ran to its end."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] == 0
    status = 1
    try:
        os.chdir(folder)
        exec(compile(Path("page.py").read_text(), "page.py", "exec"), {"__name__": "__main__"})
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def shrink_models(small: Callable[..., gym.Env] = short_episodes) -> None:
    """And environments and evaluations, but not what notebooks have as parameters, such as steps."""
    shrink(CuReBase, "__init__", tiny_model)
    shrink(dmc, "make_dmc_env", small)
    sb3_cure.make_dmc_env = envs.make_dmc_env = dmc.make_dmc_env
    shrink(rollouts, "run_episodes", two_episodes)
    evaluation.run_episodes = callbacks.run_episodes = rollouts.run_episodes


def shrink_everything() -> None:
    shrink_models(small_env)
    for name in ("learn", "pretrain", "fit_representation"):
        shrink(sb3_cure.CuReSAC, name, few)
    shrink(envs, "make_pixel_env", small_env)
    sb3_cure.make_pixel_env = envs.make_pixel_env
    shrink(env_util, "make_vec_env", one_worker)
    shrink(callbacks.PeriodicCallback, "__init__", soon)
    shrink(ExactCheckpoint, "__init__", checkpoint_soon)


if __name__ == "__main__":
    # What the pages would import one after the other, which takes longer than all that they do
    for package in ("torch._dynamo", "matplotlib.pyplot", "tensorboard", "imageio", "mujoco", "shimmy"):
        importlib.import_module(package)
    shrink_everything()
    failed = [folder for folder in sys.argv[1:] if not run_page(folder)]
    sys.exit(f"failed: {failed}" if failed else 0)
