"""How time and memory grow with the replay buffer."""

import time
from functools import partial
from typing import Any

from benchmarks.harness import (
    anonymous_memory_mb,
    fill,
    interleaved,
    make_env,
    memory_mb,
    stream,
    summary,
)
from sb3_cure.data.buffers import FrameStackReplayBuffer


def by_buffer(sizes: tuple[int, ...] = (1000, 10_000, 80_000), repeats: int = 7) -> dict[str, Any]:
    """Time samples and measure memory by capacity of the buffer.

    :param sizes: Capacities; each buffer is filled twice over with the same real frames, again and again
    :param repeats: Rounds
    :return: By capacity: time of ``sample(128)``, and the process's memory when the buffer was full for the first time
        and after another round, MiB
    """
    env = make_env()
    transitions = stream()
    results: dict[str, Any] = {}
    for size in sizes:
        before = memory_mb()
        buffer = FrameStackReplayBuffer(size, env.observation_space, env.action_space, frame_stack=3)
        grown = []
        for _ in range(2):
            for _ in range(-(-size // len(transitions))):
                fill(buffer, transitions)
            grown.append(round(memory_mb() - before))
        times = interleaved({"sample": partial(buffer.sample, 128)}, repeats, calls=5)
        results[f"{size} transitions"] = {
            **summary(times["sample"]),
            "full_mb": grown[0],
            "one_round_later_mb": grown[1],
        }
        del buffer
    return results


def on_disk(size: int, directory: str) -> dict[str, Any]:
    """Measure a buffer whose frames lie in a file.

    :param size: Capacity of a buffer whose frames lie in a file
    :param directory: Where
    :return: Time to fill it, time of ``sample(128)``, and the memory that the process itself needs beside the file,
        when the buffer is full for the first time and after another round, MiB
    """
    env = make_env()
    transitions = stream()
    before = anonymous_memory_mb()
    buffer = FrameStackReplayBuffer(size, env.observation_space, env.action_space, frame_stack=3, frames_dir=directory)
    seconds, grown = [], []
    for _ in range(2):
        start = time.perf_counter()
        for _ in range(-(-size // len(transitions))):
            fill(buffer, transitions)
        seconds.append(round(time.perf_counter() - start))
        grown.append(round(anonymous_memory_mb() - before))
    times = interleaved({"sample": partial(buffer.sample, 128)}, 7, calls=5)
    return {
        f"{size} transitions": {
            **summary(times["sample"]),
            "file_gb": round(buffer.nbytes / 1e9, 2),
            "seconds_to_fill": seconds[0],
            "own_memory_full_mb": grown[0],
            "own_memory_one_round_later_mb": grown[1],
        }
    }
