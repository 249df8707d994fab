"""Train for long while environments fail at random, and watch memory, file descriptors, processes and GL contexts.

python -m benchmarks.soak --steps 100000
python -m benchmarks.soak --env dmc --steps 4000 --fault-rate 0.01
"""

import argparse
import csv
import gc
import json
import os
import signal
import sys
import time
import warnings
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.harness import describe_machine
from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.envs import make_pixel_env
from sb3_cure.persistence.files import replacing
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv

FAULTS = ("raise", "die", "hang", "black", "frozen")
#: The bar: megabytes by which resident memory may grow per 10 000 agent steps once the replay buffer is full
MAX_SLOPE = 1.0


class Dot(gym.Env[np.ndarray, np.ndarray]):
    """A dot in a square, moved by the action; the closer to the middle, the better. It renders itself, 24 x 24."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    render_mode = "rgb_array"
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.n_steps = 0
        self.position = self.np_random.uniform(-1, 1, 2)
        return self.position.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.n_steps += 1
        self.position = np.clip(self.position + 0.3 * action, -1, 1)
        reward = 1 - float(np.abs(self.position).max())
        return self.position.astype(np.float32), reward, False, self.n_steps >= 50, {}

    def render(self) -> np.ndarray:  # type: ignore[override]
        frame = np.full((24, 24, 3), 60, dtype=np.uint8)
        row, column = np.rint((self.position + 1) / 2 * 19).astype(int)
        frame[row : row + 5, column : column + 5] = 255
        return frame


class Faults(gym.Wrapper):
    """Fails at random, in one of five ways.

    :param env: Environment that observes stacked frames
    :param rate: Probability of a fault in a step
    """

    def __init__(self, env: gym.Env, rate: float) -> None:
        super().__init__(env)
        self.rate = rate
        # Of its own, so that a new worker does not fail in the same step again
        self.chance = np.random.default_rng()
        self.stuck: np.ndarray | None = None

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        channels = observation.shape[0] // self.get_wrapper_attr("frame_stack")
        fault = self.chance.choice(FAULTS) if self.chance.random() < self.rate else None
        if fault == "raise":
            raise RuntimeError("a fault was drawn")
        if fault == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "hang":
            time.sleep(3600)
        if fault == "black":
            observation[-channels:] = 0
        if fault == "frozen":
            self.stuck = observation[-channels:].copy()
        if self.stuck is not None:
            observation[-channels:] = self.stuck
        return observation, reward, terminated, truncated, info

    def gl_contexts(self) -> int:
        """Count OpenGL contexts.

        :return: Rendering contexts of dm_control that this process holds
        """
        return count_gl_contexts()


def count_gl_contexts() -> int:
    """Count OpenGL contexts.

    :return: Rendering contexts of dm_control that this process holds
    """
    base = sys.modules.get("dm_control._render.base")
    return 0 if base is None else sum(issubclass(type(thing), base.ContextBase) for thing in gc.get_objects())


def make_env(kind: str, rate: float) -> gym.Env:
    """Make an environment of the soak test.

    :param kind: ``"dot"`` or ``"dmc"``
    :param rate: Probability of a fault in a step
    :return: A pixel environment that fails now and then
    """
    if kind == "dmc":
        return Faults(make_dmc_env("ball_in_cup", "catch", image_size=36, renderer="fast"), rate)
    return Faults(make_pixel_env(Dot(), image_size=24, frame_stack=2), rate)


def state(env: gym.Env) -> np.ndarray:
    """Visible state of an environment.

    :param env: What ``make_env`` made
    :return: What moves in the picture
    """
    base = env.unwrapped
    return base.position if isinstance(base, Dot) else env.get_wrapper_attr("physics").data.qpos


class Watch(BaseCallback):
    """Writes down what the processes hold.

    :param path: CSV file
    :param every: Agent steps between two rows
    :param has_gl: Whether the environments render with OpenGL
    """

    def __init__(self, path: Path, every: int, has_gl: bool) -> None:
        super().__init__()
        self.path, self.every, self.has_gl = path, every, has_gl
        self.rows: list[dict[str, float]] = []
        self.faults: Counter[str] = Counter()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "env_fault" in info:
                sentence = info["env_fault"]
                words = {"raised": "raise", "is lost": "die", "not answer": "hang", "black": "black", "same": "frozen"}
                self.faults[next(kind for word, kind in words.items() if word in sentence)] += 1
        if self.num_timesteps % self.every == 0:
            self.rows.append(self.look())
            with replacing(self.path) as part, part.open("w", newline="") as file:
                writer = csv.DictWriter(file, self.rows[0])
                writer.writeheader()
                writer.writerows(self.rows)
        return True

    def look(self) -> dict[str, float]:
        """Record the state of the process.

        :return: One row
        """
        gc.collect()  # or the number of objects that wait for it is measured
        me = psutil.Process()
        workers = [psutil.Process(process.pid) for process in self.training_env.unwrapped.processes]  # type: ignore[attr-defined]
        others = [process for process in me.children(recursive=True) if process not in workers]
        contexts = self.training_env.env_method("gl_contexts") if self.has_gl else [0]
        return {
            "agent_steps": self.num_timesteps,
            "faults": sum(self.faults.values()),
            "rss_mb": round(me.memory_info().rss / 2**20, 2),
            "workers_rss_mb": round(sum(worker.memory_info().rss for worker in workers) / 2**20, 2),
            "others_rss_mb": round(sum(other.memory_info().rss for other in others) / 2**20, 2),
            "fds": me.num_fds(),
            "workers_fds": sum(worker.num_fds() for worker in workers),
            "others_fds": sum(other.num_fds() for other in others),
            "threads": me.num_threads(),
            "workers": len(workers),
            "other_processes": len(others),
            "zombies": sum(other.status() == psutil.STATUS_ZOMBIE for other in others),
            "gl_contexts": count_gl_contexts(),
            "workers_gl_contexts": sum(contexts),
        }


def slope(rows: list[dict[str, float]], name: str, start: float) -> float:
    """Slope of a measurement over time.

    :param rows: What was written down
    :param name: A column
    :param start: Agent steps before which rows do not count
    :return: Its least-squares growth per 10 000 agent steps
    """
    points = [(row["agent_steps"], row[name]) for row in rows if row["agent_steps"] >= start]
    steps, values = np.array(points).T
    return float(np.polyfit(steps / 10_000, values, 1)[0])


def judge(rows: list[dict[str, float]], filled: float) -> dict[str, Any]:
    """Judge whether measurements stay level.

    :param rows: What was written down
    :param filled: Agent steps after which the replay buffer is full
    :return: Growth after that, and whether it is within the bar (of memory only if 10 000 steps and more came after)
    """
    growth = {f"{name}_per_10k_steps": round(slope(rows, name, filled), 3) for name in ("rss_mb", "others_rss_mb")}
    late = [row for row in rows if row["agent_steps"] >= filled]
    held = ("fds", "workers_fds", "others_fds", "workers", "other_processes", "zombies")
    spans = {name: [min(row[name] for row in late), max(row[name] for row in late)] for name in held}
    spans |= {name: [late[0][name], late[-1][name]] for name in ("gl_contexts", "workers_gl_contexts")}
    flat = all(low == high for low, high in spans.values()) and max(row["zombies"] for row in rows) == 0
    # A slope per 10 000 steps says nothing of a shorter run
    long_enough = late[-1]["agent_steps"] - filled >= 10_000
    passes = flat and (not long_enough or max(growth.values()) <= MAX_SLOPE)
    return {**growth, "memory_is_judged": long_enough, "least_and_most": spans, "passes": passes}


def plot(rows: list[dict[str, float]], filled: float, path: Path) -> None:
    """Plot measurements over time.

    :param rows: What was written down
    :param filled: Agent steps after which the replay buffer is full
    :param path: PNG file
    """
    from matplotlib import style
    from matplotlib.figure import Figure

    from sb3_cure.evaluation.plots import STYLE, save  # after the watch, which counts this process's memory

    with style.context(STYLE):
        figure = Figure(figsize=(9, 3))
        axes = figure.subplots(1, 2)
        steps = [row["agent_steps"] for row in rows]
        for name in ("rss_mb", "workers_rss_mb", "others_rss_mb"):
            axes[0].plot(steps, [row[name] for row in rows], label=name)
        for name in ("fds", "workers_fds", "others_fds", "workers", "other_processes", "faults"):
            axes[1].plot(steps, [row[name] for row in rows], label=name)
        for axis in axes:
            axis.axvline(filled, color="grey", linestyle=":")
            axis.set_xlabel("agent steps (dotted: the replay buffer is full)")
            axis.legend(fontsize=7, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
        save(figure, path, dpi=90)


def main() -> None:
    """Train, watch, and write ``soak.json``, ``soak.csv`` and ``soak.png`` (or ``soak_dmc...``)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=100_000, help="agent steps of all environments together")
    parser.add_argument("--env", choices=("dot", "dmc"), default="dot", help="dot: tiny; dmc: ball_in_cup-catch, 36 px")
    parser.add_argument("--envs", type=int, default=4, help="environments (default: 4)")
    parser.add_argument("--fault-rate", type=float, default=5e-4, help="probability of a fault in an agent step")
    parser.add_argument("--timeout", type=float, default=2.0, help="seconds before a worker is taken to hang")
    parser.add_argument("--start-method", choices=("forkserver", "fork", "spawn"), default="forkserver")
    parser.add_argument("--out", type=Path, default=Path("results/robustness"), help="folder to write")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / ("soak.json" if options.env == "dot" else f"soak_{options.env}.json")
    th.set_num_threads(1)
    warnings.filterwarnings("ignore", message="Environment [0-9]+ ", category=RuntimeWarning)

    envs = make_vec_env(
        partial(make_env, options.env, options.fault_rate),
        options.envs,
        seed=0,
        vec_env_cls=FaultTolerantSubprocVecEnv,  # type: ignore[arg-type]
        vec_env_kwargs=dict(
            timeout=options.timeout,
            on_env_fault="restart",
            start_method=options.start_method,
            frozen_steps=20,
            state=state,
        ),
    )
    buffer_size = min(10_000, options.steps // 4)
    model = CuReSAC(
        "CnnPolicy",
        envs,
        buffer_size=buffer_size,
        learning_starts=200,
        warmup_updates=0,
        batch_size=16,
        train_freq=2,
        gradient_steps=1,
        precision="fp32",
        device="cpu",
        seed=0,
        policy_kwargs=dict(net_arch=[32], features_extractor_kwargs=dict(n_filters=4, n_layers=2, features_dim=16)),
    )
    watch = Watch(
        path.with_suffix(".csv"), max(options.steps // 100, 1) // options.envs * options.envs, options.env == "dmc"
    )
    start = time.monotonic()
    model.learn(options.steps, callback=watch)
    seconds = time.monotonic() - start
    filled = 1.2 * buffer_size
    report = {
        "what": f"{options.steps} agent steps of {options.envs} environments ({options.env}), one update per "
        f"{2 * options.envs} agent steps, {options.start_method}, time-out {options.timeout:g} s",
        "bar": f"resident memory grows by at most {MAX_SLOPE:g} MB per 10 000 steps after {filled:g} steps; file "
        "descriptors, processes and GL contexts stay as they are",
        **judge(watch.rows, filled),
        "faults": {kind: watch.faults[kind] for kind in FAULTS},
        "restarts_per_environment": envs.restarts,  # type: ignore[attr-defined]
        "minutes": round(seconds / 60, 1),
        "machine": describe_machine(),
    }
    envs.close()
    with replacing(path) as part:
        part.write_text(json.dumps(report, indent=2) + "\n")
    plot(watch.rows, filled, path.with_suffix(".png"))
    print(json.dumps({key: value for key, value in report.items() if key != "machine"}, indent=2))


if __name__ == "__main__":
    main()
