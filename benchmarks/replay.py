"""Replay buffer: bytes per transition and time of a sample, ours beside SB3's, on the same real frames."""

from functools import partial
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from benchmarks.harness import BATCH_SIZE, fill, interleaved, make_env, median_ratio, stream, summary
from sb3_cure.data.buffers import FrameStackReplayBuffer

OURS, SB3 = "FrameStackReplayBuffer", "SB3 ReplayBuffer"


def measure(repeats: int = 15, buffer_size: int = 12_000) -> dict[str, Any]:
    """Compare our replay buffer with SB3's.

    :param repeats: Rounds
    :param buffer_size: Capacity of both, which fill entirely: far more than a processor's cache holds
    :return: Bytes per transition and sample times
    """
    env = make_env()
    spaces = env.observation_space, env.action_space
    buffers = {
        OURS: FrameStackReplayBuffer(buffer_size, *spaces, frame_stack=3),
        SB3: ReplayBuffer(buffer_size, *spaces, handle_timeout_termination=True),
    }
    transitions = stream()
    for buffer in buffers.values():
        for _ in range(-(-buffer_size // len(transitions))):
            fill(buffer, transitions)
    times = interleaved({name: partial(b.sample, BATCH_SIZE) for name, b in buffers.items()}, repeats, calls=5)
    theirs = sum(array.nbytes for array in vars(buffers[SB3]).values() if isinstance(array, np.ndarray))
    per_transition = {OURS: buffers[OURS].nbytes / buffer_size, SB3: theirs / buffer_size}  # type: ignore[attr-defined]
    return {
        "transitions": buffer_size,
        "bytes_over_one_frame": round(per_transition[OURS] / (3 * 84 * 84), 4),
        "sample_sb3_over_ours": round(median_ratio(times, SB3, OURS), 2),
        "bytes_per_transition": {name: {"bytes": round(value, 1)} for name, value in per_transition.items()},
        "sample": {name: summary(values) for name, values in times.items()},
    }
