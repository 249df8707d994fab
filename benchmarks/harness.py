"""What the benchmarks share: interleaved timing, a description of the machine, models on real frames."""

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import stable_baselines3
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import get_device

import sb3_cure
from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.evaluation.result_files import cpu_info, processor
from sb3_cure.networks.precision import has_fast_bf16

Times = dict[str, list[float]]

#: The paper's setting: 9x84x84 observations, batches of 128; 32 filters and 1024 hidden units are the defaults
BATCH_SIZE = 128
N_FRAMES = 600

#: Number formats that this machine computes natively; bf16 is emulated elsewhere, a hundred times slower
PRECISIONS = ("fp32", "bf16") if has_fast_bf16(get_device("auto")) else ("fp32",)


def interleaved(variants: Mapping[str, Callable[[], object]], repeats: int, calls: int = 2) -> Times:
    """Time several things in turn, so that a slow minute of the machine hits all of them.

    :param variants: What to call, by name
    :param repeats: Rounds that count; one more goes before them
    :param calls: Calls of each per round
    :return: Seconds per call of each round, by name
    """
    times: Times = {name: [] for name in variants}
    for round_number in range(repeats + 1):
        for name, call in variants.items():
            start = time.perf_counter()
            for _ in range(calls):
                call()
            if th.cuda.is_available():
                th.cuda.synchronize()
            if round_number > 0:
                times[name].append((time.perf_counter() - start) / calls)
    return times


def median_ratio(times: Times, numerator: str, denominator: str) -> float:
    """Median over rounds of the ratio of two variants.

    :param times: Result of ``interleaved``
    :param numerator: Name of a variant
    :param denominator: Name of a variant
    :return: The ratio
    """
    return statistics.median(a / b for a, b in zip(times[numerator], times[denominator], strict=True))


def summary(seconds: Sequence[float]) -> dict[str, float]:
    """Summarise times.

    :param seconds: Times of one variant
    :return: Median, least and greatest, in milliseconds
    """
    return {
        "median_ms": round(1e3 * statistics.median(seconds), 3),
        "min_ms": round(1e3 * min(seconds), 3),
        "max_ms": round(1e3 * max(seconds), 3),
    }


def memory_mb() -> float:
    """Resident memory of this process.

    :return: Resident memory of this process, MiB
    """
    return psutil.Process().memory_info().rss / 2**20


def anonymous_memory_mb() -> float:
    """Memory of this process that no file backs.

    :return: Resident memory of this process that is not a mapped file, MiB
    """
    memory = psutil.Process().memory_info()
    return (memory.rss - memory.shared) / 2**20


def describe_machine() -> dict[str, Any]:
    """Describe the machine and the versions.

    :return: What the numbers depend on
    """
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "torch_threads": th.get_num_threads(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30),
        "instructions": th.backends.cpu.get_cpu_capability(),
        "bf16_instructions": " ".join(
            flag for flag in ("avx512_bf16", "amx_bf16") if flag in cpu_info().get("flags", "")
        )
        or None,
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {
            "python": platform.python_version(),
            "torch": th.__version__,
            "mujoco": version("mujoco"),
            "stable_baselines3": stable_baselines3.__version__,
            "sb3_cure": sb3_cure.__version__,
        },
    }


def machine_title(machine: dict[str, Any]) -> str:
    """Title of a machine.

    :param machine: Result of ``describe_machine``
    :return: What tells its report from others: processors of one name may have other instructions
    """
    instructions = machine["bf16_instructions"] or machine["instructions"]
    return machine["gpu"] or f"{machine['processor']} with {instructions}, {machine['cores']} cores"


def make_env(**kwargs: Any) -> gym.Env:
    """Make the environment of the benchmarks.

    :param kwargs: For ``make_dmc_env``
    :return: Cartpole-swingup from pixels
    """
    return make_dmc_env("cartpole", "swingup", **{"renderer": "fast", **kwargs})


@cache
def stream(n_steps: int = N_FRAMES, **env_kwargs: Any) -> list[tuple[Any, ...]]:
    """Transitions of the random policy: real frames, collected once.

    :param n_steps: How many
    :param env_kwargs: For ``make_dmc_env``
    :return: Arguments of ``ReplayBuffer.add``
    """
    env = make_env(seed=0, **env_kwargs)
    env.action_space.seed(0)
    transitions = []
    observation, _ = env.reset()
    for _ in range(n_steps):
        action = env.action_space.sample()
        following, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        info = {"TimeLimit.truncated": truncated and not terminated}
        transitions.append(
            (observation[None], following[None], action[None], np.array([reward]), np.array([done]), [info])
        )
        observation = env.reset()[0] if done else following
    return transitions


def fill(buffer: ReplayBuffer, transitions: Sequence[tuple[Any, ...]]) -> None:
    """Add transitions to a buffer.

    :param buffer: Any replay buffer of SB3's kind
    :param transitions: Result of ``stream``
    """
    for transition in transitions:
        buffer.add(*transition)


def make_model(
    cls: type[Any] = CuReSAC, n_steps: int = N_FRAMES, env_kwargs: dict[str, Any] | None = None, **kwargs: Any
) -> Any:
    """A model whose buffer holds real frames, ready to ``train``.

    :param cls: ``CuReSAC`` or SB3's ``SAC``
    :param n_steps: Transitions in the buffer
    :param env_kwargs: For ``make_dmc_env``
    :param kwargs: For the class
    :return: The model
    """
    env_kwargs = env_kwargs or {}
    kwargs = {"batch_size": BATCH_SIZE, "buffer_size": n_steps, "seed": 0, **kwargs}
    model = cls("CnnPolicy", make_env(**env_kwargs), **kwargs)
    model.set_logger(configure(None, []))
    fill(model.replay_buffer, stream(n_steps, **env_kwargs))
    return model
