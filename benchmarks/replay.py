"""Replay buffer: bytes per transition and time of a sample, ours beside SB3's, on the same real frames."""

from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer

from benchmarks.harness import BATCH_SIZE, fill, interleaved, make_env, median_ratio, stream, summary
from sb3_cure.buffers import FrameStackReplayBuffer

OURS, SB3 = "FrameStackReplayBuffer", "SB3 ReplayBuffer"


def measure(repeats: int = 15, buffer_size: int = 80_000) -> dict[str, Any]:
    """
    :param repeats: Rounds
    :param buffer_size: Capacity for which bytes are counted
    :return: Bytes per transition and sample times
    """
    env = make_env()
    spaces = env.observation_space, env.action_space
    large = FrameStackReplayBuffer(buffer_size, *spaces, frame_stack=3)
    transitions = stream()
    buffers = {
        OURS: FrameStackReplayBuffer(len(transitions), *spaces, frame_stack=3),
        SB3: ReplayBuffer(len(transitions), *spaces, handle_timeout_termination=True),
    }
    for buffer in buffers.values():
        fill(buffer, transitions)
    times = interleaved({name: lambda b=b: b.sample(BATCH_SIZE) for name, b in buffers.items()}, repeats, calls=5)
    theirs = buffers[SB3]
    per_row = sum(a.nbytes for a in vars(theirs).values() if hasattr(a, "nbytes")) / len(transitions)
    return {
        "bytes_per_transition": {OURS: round(large.nbytes / buffer_size, 1), SB3: round(per_row, 1)},
        "bytes_over_one_frame": round(large.nbytes / buffer_size / (3 * 84 * 84), 4),
        "sample": {name: summary(values) for name, values in times.items()},
        "sample_sb3_over_ours": round(median_ratio(times, SB3, OURS), 2),
    }
