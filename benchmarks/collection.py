"""Agent steps per second end to end, beside collecting alone and updating alone."""

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


def measure(n_envs: tuple[int, ...] = (1, 2, 4), steps: int = 40, repeats: int = 3, **kwargs: Any) -> dict[str, Any]:
    """
    :param n_envs: Numbers of environments
    :param steps: Agent steps per measurement
    :param repeats: Rounds; the median counts
    :param kwargs: For ``CuReSAC``
    :return: Seconds per agent step of collecting, of updating and of both, by number of environments
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
            rounds.append((collecting, updating, _seconds_per_step(model, steps)))
        middle = sorted(rounds[1:], key=lambda row: row[2] / (row[0] + row[1]))[repeats // 2]
        collecting, updating, both = middle
        results[f"n_envs={number}"] = {
            "collect_ms": round(1e3 * collecting, 2),
            "update_ms": round(1e3 * updating, 2),
            "both_ms": round(1e3 * both, 2),
            "agent_steps_per_s": round(1 / both, 2),
            "both_over_sum": round(both / (collecting + updating), 3),
        }
        vec_env.close()
    return results
