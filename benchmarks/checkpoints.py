"""What an incremental checkpoint costs, beside the bare writing of the new frames."""

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.harness import fill, make_model, stream
from sb3_cure import CuReSAC
from sb3_cure.checkpoint import CheckpointWriter

BUFFER_SIZE, NEW_STEPS = 80_000, 10_000
#: The paper's networks, and some that are next to nothing: what is left then is the replay buffer's share
NETWORKS: dict[str, dict[str, Any]] = {
    "paper's networks": {},
    "tiny networks": {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 1, "features_dim": 4}},
}


def _collect(model: CuReSAC, steps: int) -> None:
    transitions = stream()
    for start in range(0, steps, len(transitions)):
        fill(model.replay_buffer, transitions[: steps - start])  # type: ignore[arg-type]


def _write_frames(model: CuReSAC, n_frames: int, path: Path) -> float:
    """Seconds to write so many frames and to wait for the disk: the least that a checkpoint can take."""
    buffer: Any = model.replay_buffer
    start = time.perf_counter()
    with path.open("wb") as file:
        file.write(buffer.frames[:n_frames].reshape(-1).data)
        file.flush()
        os.fsync(file.fileno())
    seconds = time.perf_counter() - start
    path.unlink()
    return seconds


def _peak_mb(reset: bool = False) -> float:
    """Greatest resident memory of this process since the last reset, MiB (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
        return psutil.Process().memory_info().rss / 2**20
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def measure(repeats: int = 5, directory: str | None = None) -> dict[str, Any]:
    """
    :param repeats: Checkpoints, each after ``NEW_STEPS`` new transitions, taken in turn with the bare writing
    :param directory: Where to write; by default where temporary files go
    :return: Seconds of both, their ratio, and the memory that a checkpoint needs meanwhile
    """
    results: dict[str, Any] = {}
    for name, policy_kwargs in NETWORKS.items():
        model = make_model(buffer_size=BUFFER_SIZE, policy_kwargs=policy_kwargs)
        model.train(2, 8)  # so that the optimisers have a state
        _collect(model, BUFFER_SIZE)
        with tempfile.TemporaryDirectory(dir=directory) as folder:
            writer = CheckpointWriter(folder)
            generation = writer.write(model, keep=3)
            times: dict[str, list[float]] = {"frames": [], "checkpoint": []}
            extra = []
            for _ in range(repeats):
                before = model.replay_buffer._n_frames
                _collect(model, NEW_STEPS)
                times["frames"].append(
                    _write_frames(model, model.replay_buffer._n_frames - before, Path(folder) / "bare")
                )
                resident = _peak_mb(reset=True)
                start = time.perf_counter()
                generation = writer.write(model, keep=3)
                times["checkpoint"].append(time.perf_counter() - start)
                extra.append(_peak_mb() - resident)
            ratios = [b / a for a, b in zip(times["frames"], times["checkpoint"], strict=True)]
            new_mb = (generation.segments[-1].size + sum(entry.size for entry in generation.files)) / 1e6
        results[name] = {
            "new_frames_mb": round(generation.segments[-1].size / 1e6),
            "all_that_is_written_mb": round(new_mb),
            "frames_alone_s": round(statistics.median(times["frames"]), 3),
            "checkpoint_s": round(statistics.median(times["checkpoint"]), 3),
            "ratio": round(statistics.median(ratios), 2),
            "extra_memory_mb": round(float(np.max(extra))),
        }
    return results
