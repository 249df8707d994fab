"""What each intrinsic reward seeks, what fools it and what it costs, in a small world with a television.

    python -m benchmarks.rewards --out results/rewards

A dot in three rooms side by side, seen in two grey frames. In the middle one a television shows random pixels, which
nobody can predict. ``paid``: trained on random steps in the first two rooms, what is the reward for steps in the known
room, before the television, and in the third room, where nobody has been? ``visits``: all doors open, where does a
curious agent without a task spend its time? ``shuffled`` costs the same as ``rnd`` and knows nothing.
"""

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from benchmarks.harness import make_model
from benchmarks.settings import SETTINGS, added_costs
from sb3_cure import CuReSAC
from sb3_cure.data.buffers import transitions
from sb3_cure.evaluation.result_files import Row, describe_run, read_rows, write_csv, write_json

ROOMS = ("known", "television", "new")
#: Where each begins and ends along the first axis
WALLS = (-1.0, -1 / 3, 1 / 3, 1.0)
SIZE, PROBES, BATCH_SIZE = 36, 128, 64
#: Rewards beside the agent's other settings
ARMS: dict[str, dict[str, Any]] = {
    "srl_error": {},
    "srl_error, per_pixel": dict(intrinsic_kwargs=dict(per_pixel=True)),
    "srl_error of curl": dict(srl="curl", intrinsic="srl_error"),
    "reconstruction": dict(intrinsic="reconstruction"),
    "rnd": dict(intrinsic="rnd"),
    "icm": dict(intrinsic="icm"),
    "icm, encoder='own'": dict(intrinsic="icm", intrinsic_kwargs=dict(encoder="own")),
    "impact": dict(intrinsic="impact"),
    "disagreement": dict(intrinsic="disagreement"),
    "particle": dict(intrinsic="particle"),
    "shuffled (of rnd)": dict(intrinsic="shuffled", intrinsic_kwargs=dict(of="rnd")),
}


class Rooms(gym.Env):
    """A dot that actions move by up to 0.25; episodes begin in the known room and last 25 steps.

    :param closed: Whether the door to the new room is
    """

    frame_stack = 2

    def __init__(self, closed: bool = False):
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = spaces.Box(0, 255, (2, SIZE, SIZE), np.uint8)
        self.highest = np.array([WALLS[2] - 1e-6 if closed else 1.0, 1.0])
        self.position = np.zeros(2)
        self.n_steps = 0

    @property
    def room(self) -> int:
        """Where the dot is, a place in ``ROOMS``."""
        return int(np.digitize(self.position[0], WALLS[1:3]))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.put(ROOMS[0]), {}

    def put(self, room: str) -> np.ndarray:
        """Begin an episode in a room.

        :param room: Where to begin
        :return: First observation, [2, H, W]
        """
        first = ROOMS.index(room)
        self.position = self.np_random.uniform([WALLS[first], -1], [WALLS[first + 1], 1])
        self.n_steps = 0
        self.frame = self._draw()
        return np.stack([self.frame, self.frame])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.position = np.clip(self.position + 0.25 * np.asarray(action), -1, self.highest)
        self.n_steps += 1
        before, self.frame = self.frame, self._draw()
        return np.stack([before, self.frame]), 0.0, False, self.n_steps >= 25, {"room": self.room}

    def _draw(self) -> np.ndarray:
        frame = np.repeat(np.linspace(0, 120, SIZE).astype(np.uint8)[None], SIZE, axis=0)
        if self.room == ROOMS.index("television"):
            frame[: SIZE // 2, : SIZE // 2] = self.np_random.integers(0, 256, (SIZE // 2, SIZE // 2), np.uint8)
        row, column = np.rint((self.position[::-1] + 1) / 2 * (SIZE - 6)).astype(int)
        frame[row : row + 6, column : column + 6] = 255
        return frame


def make_agent(arm: str, seed: int, closed: bool) -> CuReSAC:
    """Make an agent with a reward.

    :param arm: A key of ``ARMS``
    :param seed: Of everything
    :param closed: Whether the new room is
    :return: A small curious agent without a task
    """
    networks = dict(net_arch=[64], features_extractor_kwargs=dict(n_filters=8, n_layers=3))
    return CuReSAC(
        "CnnPolicy", Rooms(closed), task=False, learning_starts=500, warmup_updates=0, buffer_size=5000,
        batch_size=BATCH_SIZE, precision="fp32", policy_kwargs=networks, seed=seed, device="cpu", **ARMS[arm],
    )  # fmt: skip


def paid(arm: str, seed: int, updates: int) -> dict[str, float]:
    """Mean reward by room.

    :param arm: A key of ``ARMS``
    :param seed: Of everything
    :param updates: Of the agent, on 500 random steps
    :return: Mean reward by room, before it is scaled
    """
    model = make_agent(arm, seed, closed=True).learn(500)
    model.train(updates, BATCH_SIZE)
    buffer: Any = model.replay_buffer
    env, first = Rooms(), buffer.pos
    env.reset(seed=seed + 1000)
    env.action_space.seed(seed)
    for room in ROOMS:
        # One episode each, so that particles of a room are no neighbours of each other.
        count = 0
        while count < PROBES:
            observation, action = env.put(room), env.action_space.sample()
            following, *_ = env.step(action)
            if ROOMS[env.room] == room:
                count += 1
                done = np.array([count == PROBES])
                buffer.add(observation[None], following[None], action[None], np.zeros(1), done, [{}])
    rows = first + np.arange(len(ROOMS) * PROBES)

    def probes(*args: Any, **kwargs: Any) -> ReplayBufferSamples:
        buffer.last_sampled = rows, np.zeros_like(rows)
        return transitions(buffer, *buffer.last_sampled)

    found: list[th.Tensor] = []
    buffer.sample = probes
    model.policy.scale.register_forward_pre_hook(lambda _, args: found.append(args[0]))
    model.train(1, len(rows))
    means = found[0].view(len(ROOMS), PROBES).mean(dim=1)
    return dict(zip(ROOMS, means.tolist(), strict=True))


class _Where(BaseCallback):
    def __init__(self) -> None:
        super().__init__()
        self.rooms: list[int] = []

    def _on_step(self) -> bool:
        self.rooms += [info["room"] for info in self.locals["infos"]]
        return True


def visits(arm: str, seed: int, steps: int) -> dict[str, float]:
    """Share of steps by room.

    :param arm: A key of ``ARMS``
    :param seed: Of everything
    :param steps: Of the agent, the first 500 of them random
    :return: Share of the later steps by room
    """
    where = _Where()
    make_agent(arm, seed, closed=False).learn(steps, callback=where)
    return {room: float(np.mean(np.array(where.rooms[500:]) == i)) for i, room in enumerate(ROOMS)}


def costs(repeats: int = 7) -> dict[str, dict[str, float]]:
    """Time updates by reward, as a part of ``make bench``: in its smallest setting on two threads.

    :param repeats: Rounds that count
    :return: By reward: milliseconds of an update, and how many more these are than with the error of the same head
    """
    small = SETTINGS[1]
    common: dict[str, Any] = dict(env_kwargs=small.env_kwargs, policy_kwargs=small.policy_kwargs, warmup_updates=0)
    arms = {"without curiosity": dict(curiosity=None), **ARMS}
    shift: dict[str, Any] = dict(augmentation="shift")
    models = {
        name: make_model(**common, **arm, **(shift if arm.get("srl") == "curl" else {})) for name, arm in arms.items()
    }
    plain = "srl_error", "srl_error of curl"
    return added_costs(models, small.threads, lambda name: plain["curl" in name], repeats)


def table(rows: Sequence[Row]) -> list[str]:
    """Summarise visits in a table.

    :param rows: Of ``rewards.csv``
    :return: Lines of a table: means over seeds
    """
    lines = [
        "| reward | television ÷ known | new ÷ known | visits: known | television | new |",
        "|---|---|---|---|---|---|",
    ]
    for arm in ARMS:
        own = [row for row in rows if row["arm"] == arm]
        if not own:
            continue
        ratios = [
            f"{statistics.geometric_mean(row[room] / row['known'] for row in own if row['measure'] == 'paid'):.2f}"
            for room in ROOMS[1:]
        ]
        gone = [row for row in own if row["measure"] == "visits"]
        shares = [f"{100 * statistics.mean(row[room] for row in gone):.0f} %" if gone else "" for room in ROOMS]
        lines.append(f"| {' | '.join([arm, *ratios, *shares])} |")
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all arms.

    :param arguments: Command line, ``sys.argv`` by default
    :return: 0
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/rewards"), help="folder to write")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of each reward (default: 3)")
    parser.add_argument("--updates", type=int, default=300, help="updates before rewards are compared (default: 300)")
    parser.add_argument("--steps", type=int, default=1000, help="agent steps of each visit (default: 1000)")
    parser.add_argument("--only", nargs="+", choices=ARMS, help="measure these anew and keep the others' rows")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    chosen, csv, run = options.only or list(ARMS), options.out / "rewards.csv", options.out / "run.json"
    rows: list[Row] = [row for row in read_rows(csv) if row["arm"] not in chosen] if options.only else []
    of_the_kept = {"the other arms": json.loads(run.read_text())} if rows else {}
    measures = {"paid": partial(paid, updates=options.updates), "visits": partial(visits, steps=options.steps)}
    for measure, measured in measures.items():
        for seed, arm in itertools.product(range(options.seeds), chosen):
            start = time.monotonic()
            rows.append({"arm": arm, "seed": seed, "measure": measure, **measured(arm, seed)})
            print(f"{measure}, seed {seed}, {arm}: {time.monotonic() - start:.0f} s", flush=True)
            write_csv(csv, ("arm", "seed", "measure", *ROOMS), rows)
        (options.out / "table.md").write_text("\n".join([*table(rows), ""]))
    settings = {"seeds": options.seeds, "updates": options.updates, "steps": options.steps}
    write_json(run, {**describe_run(), "settings": settings, "arms": chosen, **of_the_kept})
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
