"""Agent steps per second end to end, beside collecting alone and updating alone."""

import statistics
import time
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from benchmarks.harness import BATCH_SIZE, make_env
from benchmarks.settings import SETTINGS
from sb3_cure import CuReSAC


class _Clock(BaseCallback):
    """When each vector step ended."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def _on_step(self) -> bool:
        self.times.append(time.perf_counter())
        return True


def _seconds_per_step(model: CuReSAC, steps: int) -> float:
    """Seconds from one vector step to the next: the first, which starts the environments, does not count."""
    clock = _Clock()
    model.learn(steps * model.n_envs, callback=clock, reset_num_timesteps=False)
    return (clock.times[-1] - clock.times[0]) / (len(clock.times) - 1)


def measure(n_envs: tuple[int, ...] = (1, 2, 4), steps: int = 20, repeats: int = 5) -> dict[str, Any]:
    """One update per vector step, ``renderer="fast"``.

    :param n_envs: Numbers of environments; several live in worker processes, which can overlap with updates
    :param steps: Vector steps per measurement
    :param repeats: Rounds; medians count
    :return: Milliseconds per vector step of collecting, of updating, of both and of what both takes beside the update,
        by number of environments, in the paper's setting; then by one environment and thread in the small one
    """
    results = {f"n_envs={number}, renderer=fast": _measure(number, steps, repeats, {}) for number in n_envs}
    small, threads = SETTINGS[0], th.get_num_threads()
    th.set_num_threads(small.threads)
    own = _measure(1, 2 * steps, repeats, small.env_kwargs, policy_kwargs=small.policy_kwargs)
    results[f"n_envs=1, renderer=fast, {small}"] = own
    th.set_num_threads(threads)
    return results


def _measure(number: int, steps: int, repeats: int, env_kwargs: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
    vec_env = (DummyVecEnv if number == 1 else SubprocVecEnv)([partial(make_env, **env_kwargs)] * number)  # type: ignore[list-item]
    model = CuReSAC("CnnPolicy", vec_env, learning_starts=200, warmup_updates=0, buffer_size=2000, seed=0, **kwargs)
    model.set_logger(configure(None, []))
    model.learn(200)
    rounds = []
    for _ in range(repeats + 1):
        model.gradient_steps = 0
        collecting = _seconds_per_step(model, steps)
        start = time.perf_counter()
        model.train(steps, BATCH_SIZE)
        updating = (time.perf_counter() - start) / steps
        model.gradient_steps = 1
        both = _seconds_per_step(model, steps)
        row = {
            "collect_ms": 1e3 * collecting,
            "update_ms": 1e3 * updating,
            "both_ms": 1e3 * both,
            "both_minus_update_ms": 1e3 * (both - updating),
            "agent_steps_per_s": number / both,
            "both_over_sum": both / (collecting + updating),
        }
        if number > 1:
            model.overlap = True
            overlapped = _seconds_per_step(model, steps)
            model.overlap = False
            row |= {
                "overlapped_ms": 1e3 * overlapped,
                "overlapped_over_slower": overlapped / max(collecting, updating),
            }
        rounds.append(row)
    vec_env.close()
    medians: dict[str, Any] = dict.fromkeys(("overlapped_ms", "overlapped_over_slower"), "-")
    return medians | {name: round(statistics.median(row[name] for row in rounds[1:]), 3) for name in rounds[0]}
