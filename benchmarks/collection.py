"""Agent steps per second end to end, beside collecting alone and updating alone."""

import statistics
import time
from typing import Any

from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from benchmarks.harness import BATCH_SIZE, make_env
from sb3_cure import CuReSAC


def _seconds_per_step(model: CuReSAC, steps: int) -> float:
    start = time.perf_counter()
    before = model.num_timesteps
    model.learn(steps, reset_num_timesteps=False)
    return (time.perf_counter() - start) / (model.num_timesteps - before)


def measure(n_envs: tuple[int, ...] = (1, 2, 4), steps: int = 24, repeats: int = 3, **kwargs: Any) -> dict[str, Any]:
    """
    :param n_envs: Numbers of environments; several live in worker processes, which can overlap with updates
    :param steps: Agent steps per measurement
    :param repeats: Rounds; medians count
    :param kwargs: For ``CuReSAC``
    :return: Milliseconds per agent step of collecting, of updating and of both, by number of environments
    """
    results: dict[str, Any] = {}
    for number in n_envs:
        vec_env = (DummyVecEnv if number == 1 else SubprocVecEnv)([make_env] * number)  # type: ignore[operator]
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
            model.gradient_steps = -1
            both = _seconds_per_step(model, steps)
            model.overlap = number > 1
            overlapped = _seconds_per_step(model, steps)
            model.overlap = False
            rounds.append(
                {
                    "collect_ms": 1e3 * collecting,
                    "update_ms": 1e3 * updating,
                    "both_ms": 1e3 * both,
                    "agent_steps_per_s": 1 / both,
                    "both_over_sum": both / (collecting + updating),
                    "overlapped_ms": 1e3 * overlapped,
                    "overlapped_over_slower": overlapped / max(collecting, updating),
                }
            )
        vec_env.close()
        medians = {name: round(statistics.median(row[name] for row in rounds[1:]), 3) for name in rounds[0]}
        if number == 1:
            medians["overlapped_ms"] = medians["overlapped_over_slower"] = "-"  # type: ignore[assignment]
        results[f"n_envs={number}"] = medians
    return results
