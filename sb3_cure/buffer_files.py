"""Replay buffers in files without pickle, of which the used part is written and read without a copy in memory."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common import buffers as sb3_buffers

from sb3_cure.buffers import FrameStackReplayBuffer, SkippingReplayBuffer
from sb3_cure.files import PathOrFile, reading, writing
from sb3_cure.serialization import Archive, ArchiveError, StoredArray, decode_state, sentences, write_state
from sb3_cure.settings import whole
from sb3_cure.weights import expect, expect_keys

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC


#: Classes whose contents are written without pickle, with what is written of them: counters, and arrays of rows
_COUNTERS = ("buffer_size", "n_envs", "pos")
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "marked")
_BUFFERS = (
    FrameStackReplayBuffer,
    SkippingReplayBuffer,
    sb3_buffers.ReplayBuffer,
    sb3_buffers.DictReplayBuffer,
    sb3_buffers.NStepReplayBuffer,
)


def save_buffer(buffer: sb3_buffers.ReplayBuffer, path: PathOrFile, pickle: Callable[[Any], None]) -> None:
    """What ``CuReSAC.save_replay_buffer`` does.

    :param buffer: The replay buffer
    :param path: Where to, as in SB3
    :param pickle: Writes it to a path or file as SB3 does, for classes of which no more is known
    """
    with writing(path, "pkl") as target:
        if type(buffer) not in _BUFFERS:
            # A name with a suffix, as SB3 would add one.
            pickle(target)
            return
        write_state(target, _buffer_state(buffer))


def _buffer_state(buffer: sb3_buffers.ReplayBuffer) -> dict[str, Any]:
    """What of a buffer was written to, as views."""
    state: dict[str, Any] = {"class": type(buffer).__name__, "full": bool(buffer.full)}
    state.update({name: int(getattr(buffer, name)) for name in _COUNTERS})
    n_rows = buffer.buffer_size if buffer.full else buffer.pos
    if isinstance(buffer, FrameStackReplayBuffer):
        state.update(n_valid=buffer._n_valid, n_frames=buffer._n_frames, tails=buffer._tails)
        state["frames"] = buffer.frames[: buffer._n_frames]
        state["rows"] = {name: getattr(buffer, name)[:n_rows] for name in buffer._ROW_ARRAYS}
        return state
    state["rows"] = {}
    for name in _ROWS:
        # The memory-efficient variant keeps the next observation in the next row.
        length = min(n_rows + 1, buffer.buffer_size) if buffer.optimize_memory_usage else n_rows
        array = getattr(buffer, name, None)
        if isinstance(array, dict):
            state["rows"][name] = {key: part[:length] for key, part in array.items()}
        elif array is not None:
            state["rows"][name] = array[: length if name == "observations" else n_rows]
    return state


def is_pickled_buffer(path: PathOrFile) -> bool:
    """
    :param path: A replay buffer's file
    :return: Whether it is not one that this module wrote
    """
    with reading(path, "pkl") as (file, _):
        return file.read(2) != b"PK"


def load_buffer(model: "CuReSAC", path: PathOrFile) -> sb3_buffers.ReplayBuffer:
    """What ``CuReSAC.load_replay_buffer`` does for files without pickle.

    :param model: The model that it is for
    :param path: The file
    :return: A buffer of the model's class, of the size that was saved
    :raises ArchiveError: if it does not fit the model or is damaged, in one sentence
    """
    with reading(path, "pkl") as (file, name), sentences(name, "load it on a machine with more"):
        archive = Archive(file, name)
        state = decode_state(archive, materialize=lambda stored: stored)
        kind = model.replay_buffer_class
        if kind is sb3_buffers.ReplayBuffer and state.get("class") == SkippingReplayBuffer.__name__:
            kind = SkippingReplayBuffer  # what the first mark has made of it
        if kind not in _BUFFERS or state.get("class") != kind.__name__:
            raise ArchiveError(
                f"{name} holds a {state.get('class')!s:.50}, but this model has a {kind.__name__ if kind else None}: "
                "load the replay buffer of a model with the same settings."
            )
        size, n_envs, pos = (whole(state[counter]) for counter in _COUNTERS)
        if n_envs != model.n_envs:
            raise ArchiveError(
                f"{name} holds a replay buffer for {n_envs} environments, but this model has {model.n_envs}: load it "
                "into a model with as many environments."
            )
        if pos >= size or type(state["full"]) is not bool or not isinstance(state["rows"], dict):
            raise ArchiveError(f"{name} holds a replay buffer at row {pos} of {size}: it is damaged.")
        make: Callable[[int], sb3_buffers.ReplayBuffer] = partial(
            kind,
            observation_space=model.observation_space,
            action_space=model.action_space,
            device=model.device,
            n_envs=n_envs,
            optimize_memory_usage=model.optimize_memory_usage,
            **model.replay_buffer_kwargs,
        )
        # One row tells the shape of all.
        _check_rows(make(n_envs), state, name)
        buffer = make(size * n_envs)
        buffer.pos, buffer.full = pos, state["full"]
        if isinstance(buffer, FrameStackReplayBuffer):
            _read_frames(buffer, state, name)
        for path, stored in _flat(state["rows"]).items():
            array = _flat(vars(buffer))[path]
            stored.read(out=array[: stored.shape[0]])
            _check_finite(array[: stored.shape[0]], f"{name}: {path}")
        if isinstance(buffer, FrameStackReplayBuffer):
            _check_frames(buffer, name)
        return buffer


def _flat(arrays: dict[str, Any]) -> dict[str, Any]:
    """Arrays by name, those in dictionaries (of Dict observations) by both names."""
    flat: dict[str, Any] = {}
    for name, value in arrays.items():
        flat.update(
            {f"{name}/{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
        )
    return flat


def _check_rows(example: sb3_buffers.ReplayBuffer, state: dict[str, Any], name: str) -> None:
    """Shapes and types of all that is stored, before there is a buffer for it.

    :param example: A buffer of one row
    :param state: What is stored, arrays not read yet
    :param name: What to call the file
    """
    expected, stored = _flat(_buffer_state(example)["rows"]), _flat(state["rows"])
    expect_keys(stored, expected.keys(), name)
    size, n_rows = state["buffer_size"], state["buffer_size"] if state["full"] else state["pos"]
    for path, array in stored.items():
        shares = example.optimize_memory_usage and path.startswith("observations")
        shape = (min(n_rows + 1, size) if shares else n_rows, *expected[path].shape[1:])
        if not isinstance(array, StoredArray) or (array.shape, array.dtype) != (shape, expected[path].dtype):
            kind = f"{array.dtype} of shape {array.shape}" if isinstance(array, StoredArray) else type(array).__name__
            raise ArchiveError(
                f"{name} has {path:.50} as {kind:.100}, but this model's replay buffer needs {expected[path].dtype} of "
                f"shape {shape}: load the replay buffer of a model with the same settings and environment."
            )


def _read_frames(buffer: FrameStackReplayBuffer, state: dict[str, Any], name: str) -> None:
    n_frames = min(whole(state["n_frames"]), buffer.frame_capacity)
    frames, tails = expect(StoredArray, state["frames"]), expect(StoredArray, state["tails"])
    shapes = (n_frames, *buffer.frame_shape), buffer._tails.shape
    if (frames.shape, tails.shape, frames.dtype, tails.dtype) != (*shapes, np.dtype(np.uint8), buffer._tails.dtype):
        raise ArchiveError(
            f"{name} has frames of shape {frames.shape!s:.100}, but this model's replay buffer needs {shapes[0]}: load "
            "the replay buffer of a model with the same settings and environment."
        )
    buffer._n_frames, buffer._n_valid = state["n_frames"], whole(state["n_valid"])
    if n_frames:
        buffer.reserve_frames()
        frames.read(out=buffer.frames[:n_frames])
    tails.read(out=buffer._tails)


def _check_frames(buffer: FrameStackReplayBuffer, name: str) -> None:
    """Whether what refers to frames refers to some that are there."""
    n_rows = buffer.buffer_size if buffer.full else buffer.pos
    valid = np.arange(buffer.pos - min(buffer._n_valid, n_rows), buffer.pos) % buffer.buffer_size
    for array, low, high in (
        (buffer.frame_slots[:n_rows], 0, min(buffer._n_frames, buffer.frame_capacity)),
        (buffer.oldest_frame[:n_rows], 0, buffer._n_frames),
        (buffer.oldest_frame[valid], buffer._n_frames - buffer.frame_capacity, buffer._n_frames),
        (buffer._tails, -buffer.frame_capacity, buffer._n_frames),
        (np.array([buffer._n_valid]), 0, n_rows + 1),
    ):
        if array.size and not (array.min() >= low and array.max() < high):
            raise ArchiveError(f"{name} has rows whose frames are not in it: it is damaged.")


def _check_finite(array: np.ndarray, path: str) -> None:
    if array.dtype.kind == "f":
        for start in range(0, len(array), 1000):
            if not np.isfinite(array[start : start + 1000]).all():
                raise ArchiveError(f"{path:.100} has values that are not finite: what it was saved from is broken.")
