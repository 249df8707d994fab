"""What an incremental checkpoint costs, beside the bare writing of the new frames."""

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import psutil

from benchmarks.harness import fill, make_model, stream
from sb3_cure import CuReSAC
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.persistence.checkpoints import CheckpointFolder

BUFFER_SIZE, NEW_STEPS, KEEP = 80_000, 10_000, 3
#: The paper's networks, and some that are next to nothing: what is left then is the replay buffer's share
NETWORKS: dict[str, dict[str, Any]] = {
    "paper's networks": {},
    "tiny networks": {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 1, "features_dim": 4}},
}


def _collect(model: CuReSAC, steps: int) -> None:
    transitions = stream()
    for start in range(0, steps, len(transitions)):
        fill(model.replay_buffer, transitions[: steps - start])  # type: ignore[arg-type]


def _write_frames(model: CuReSAC, n_frames: int, at_once: int, folder: Path, number: int) -> float:
    """Seconds to write so many frames, to wait for the disk, and to keep three such files."""
    content = cast(FrameStackReplayBuffer, model.replay_buffer).rings[""].frames[:n_frames].reshape(-1).data
    start = time.perf_counter()
    with (folder / f"bare-{at_once}-{number}").open("wb") as file:
        for first in range(0, len(content), at_once):
            file.write(content[first : first + at_once])
        file.flush()
        os.fsync(file.fileno())
    (folder / f"bare-{at_once}-{number - KEEP}").unlink(missing_ok=True)
    return time.perf_counter() - start


def _peak_mb(reset: bool = False) -> float:
    """Greatest resident memory of this process since the last reset, MiB (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
        return psutil.Process().memory_info().rss / 2**20
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def measure(repeats: int = 5, directory: str | None = None) -> dict[str, Any]:
    """Time checkpoints against the bare writing of their frames.

    :param repeats: Checkpoints, each after ``NEW_STEPS`` new transitions, in turn with the bare writing of the frames,
        in one call and in pieces as a checkpoint writes them
    :param directory: Where to write; by default where temporary files go
    :return: Seconds of all three, the ratios of their sums, and the memory that a checkpoint needs meanwhile
    """
    results: dict[str, Any] = {}
    for networks, policy_kwargs in NETWORKS.items():
        model = make_model(buffer_size=BUFFER_SIZE, policy_kwargs=policy_kwargs)
        model.train(2, 8)  # so that the optimisers have a state
        _collect(model, BUFFER_SIZE)
        with tempfile.TemporaryDirectory(dir=directory) as folder:
            writer = CheckpointFolder(folder)
            writer.write(model, model._run, KEEP)
            times: dict[str, list[float]] = {name: [] for name in ("at once", "in pieces", "checkpoint")}
            extra = []
            for number in range(repeats + KEEP):
                before = model.replay_buffer.counts[""]
                _collect(model, NEW_STEPS)
                n_frames = model.replay_buffer.counts[""] - before
                # Each is the first one in turn: what comes first finds other free memory for the disk's cache.
                for name in np.roll(list(times), number):
                    if name == "checkpoint":
                        resident = _peak_mb(reset=True)
                        start = time.perf_counter()
                        writer.write(model, model._run, KEEP)
                        times[name].append(time.perf_counter() - start)
                        extra.append(_peak_mb() - resident)
                    else:
                        at_once = 2**40 if name == "at once" else 2**22
                        times[name].append(_write_frames(model, n_frames, at_once, Path(folder), number))
            times = {name: values[KEEP:] for name, values in times.items()}  # from when files are also removed
            newest = max((Path(folder) / "segments").iterdir(), key=lambda path: path.stat().st_mtime).stat().st_size
            generation = writer.generations.folder(writer.generations.numbers()[-1])
            new_mb = (newest + sum(path.stat().st_size for path in generation.iterdir())) / 1e6
        results[networks] = {
            "new_frames_mb": round(newest / 1e6),
            "all_that_is_written_mb": round(new_mb),
            "frames_at_once_s": round(statistics.median(times["at once"]), 3),
            "frames_in_pieces_s": round(statistics.median(times["in pieces"]), 3),
            "checkpoint_s": round(statistics.median(times["checkpoint"]), 3),
            "ratio_to_at_once": round(sum(times["checkpoint"]) / sum(times["at once"]), 2),
            "ratio_to_in_pieces": round(sum(times["checkpoint"]) / sum(times["in pieces"]), 2),
            "extra_memory_mb": round(float(np.max(extra))),
        }
    return results
