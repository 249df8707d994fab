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
from sb3_cure.weights import expect_keys

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC


#: What is written of a replay buffer: counters, and arrays of rows
_COUNTERS = ("buffer_size", "n_envs", "pos")
_FRAME_COUNTERS = ("n_valid", "n_frames")
_ROWS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "marked")
#: Most frames that a buffer ever stored: enough for any training, and no sum of them overflows
_MAX_FRAMES = 2**62
_BUFFERS = (
    FrameStackReplayBuffer,
    SkippingReplayBuffer,
    sb3_buffers.ReplayBuffer,
    sb3_buffers.DictReplayBuffer,
    sb3_buffers.NStepReplayBuffer,
)


def can_be_kept(kind: type) -> bool:
    """
    :param kind: Class of a replay buffer
    :return: Whether it is written without pickle, and so can be read back without trust
    """
    return kind in _BUFFERS


def save_buffer(buffer: sb3_buffers.ReplayBuffer, path: PathOrFile, pickle: Callable[[Any], None]) -> None:
    """What ``CuReSAC.save_replay_buffer`` does.

    :param buffer: The replay buffer
    :param path: Where to, as in SB3
    :param pickle: Writes it to a path or file as SB3 does, for classes of which no more is known
    """
    with writing(path, "pkl") as target:
        if can_be_kept(type(buffer)):
            write_state(target, _buffer_state(buffer))
        else:
            pickle(target)  # a name with a suffix, as SB3 would add one


def frame_rows(buffer: FrameStackReplayBuffer) -> dict[str, Any]:
    """All that a buffer of frames holds, but for the frames.

    :param buffer: The replay buffer
    :return: Plain values, and views of the arrays as far as they are used, for ``load_frame_rows``
    """
    rows = {name: getattr(buffer, name)[: _n_rows(buffer)] for name in buffer._ROW_ARRAYS}
    counters = {name: int(getattr(buffer, f"_{name}")) for name in _FRAME_COUNTERS}
    return {**_counters(buffer), **counters, "tails": buffer._tails, "rows": rows}


def load_frame_rows(buffer: FrameStackReplayBuffer, rows: dict[str, Any], name: str) -> None:
    """Give a buffer what ``frame_rows`` took of one of the same size; the frames have to follow.

    :param buffer: The replay buffer, which changes only if all is well
    :param rows: What a file has of it, its arrays read; nobody vouches for it
    :param name: What to call the file
    :raises ArchiveError: if it does not fit the buffer or is damaged, in one sentence
    """
    expect_keys(rows, frame_rows(buffer).keys(), name)
    _check_counters(rows, name)
    if (rows["buffer_size"], rows["n_envs"]) != (buffer.buffer_size, buffer.n_envs):
        raise ArchiveError(
            f"{name} holds a replay buffer of {rows['buffer_size']} rows for {rows['n_envs']} environments, but this "
            f"model's has {buffer.buffer_size} for {buffer.n_envs}: give as many environments, and "
            f"buffer_size={rows['buffer_size'] * rows['n_envs']}."
        )
    expect_keys(rows["rows"], set(buffer._ROW_ARRAYS), name)
    _check_rows(buffer, rows, name)
    _check_array(rows["tails"], buffer._tails.shape, buffer._tails.dtype, f"{name} has tails")
    for path, array in rows["rows"].items():
        _check_finite(array, f"{name}: {path}")
    _check_frames(rows, buffer.frame_capacity, name)
    _set_counters(buffer, rows)
    buffer._tails[:] = rows["tails"]
    for path, array in rows["rows"].items():
        getattr(buffer, path)[: len(array)] = array


def _n_rows(buffer: sb3_buffers.ReplayBuffer) -> int:
    return buffer.buffer_size if buffer.full else buffer.pos


def _counters(buffer: sb3_buffers.ReplayBuffer) -> dict[str, Any]:
    return {"full": bool(buffer.full), **{name: int(getattr(buffer, name)) for name in _COUNTERS}}


def _set_counters(buffer: sb3_buffers.ReplayBuffer, state: dict[str, Any]) -> None:
    """Those that the constructor does not give."""
    buffer.pos, buffer.full = state["pos"], state["full"]
    if isinstance(buffer, FrameStackReplayBuffer):
        buffer._n_valid, buffer._n_frames = state["n_valid"], state["n_frames"]


def _buffer_state(buffer: sb3_buffers.ReplayBuffer) -> dict[str, Any]:
    """What of a buffer was written to, as views."""
    kind = {"class": type(buffer).__name__}
    if isinstance(buffer, FrameStackReplayBuffer):
        return {**kind, **frame_rows(buffer), "frames": buffer.frames[: buffer._n_frames]}
    n_rows = _n_rows(buffer)
    rows: dict[str, Any] = {}
    for name in _ROWS:
        # The memory-efficient variant keeps the next observation in the next row.
        length = min(n_rows + 1, buffer.buffer_size) if buffer.optimize_memory_usage else n_rows
        array = getattr(buffer, name, None)
        if isinstance(array, dict):
            rows[name] = {key: part[:length] for key, part in array.items()}
        elif array is not None:
            rows[name] = array[: length if name == "observations" else n_rows]
    return {**kind, **_counters(buffer), "rows": rows}


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
        n_envs = whole(state["n_envs"])
        if n_envs != model.n_envs:
            raise ArchiveError(
                f"{name} holds a replay buffer for {n_envs} environments, but this model has {model.n_envs}: load it "
                "into a model with as many environments."
            )
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
        example = make(n_envs)
        expect_keys(state, _buffer_state(example).keys(), name)
        _check_counters(state, name)
        _check_rows(example, state, name)
        buffer = make(state["buffer_size"] * n_envs)
        _set_counters(buffer, state)
        if isinstance(buffer, FrameStackReplayBuffer):
            _read_frames(buffer, state, name)
        for path, stored in _flat(state["rows"]).items():
            array = _flat(vars(buffer))[path]
            stored.read(out=array[: stored.shape[0]])
            _check_finite(array[: stored.shape[0]], f"{name}: {path}")
        if isinstance(buffer, FrameStackReplayBuffer):
            _check_frames(frame_rows(buffer), buffer.frame_capacity, name)
        return buffer


def _flat(arrays: dict[str, Any]) -> dict[str, Any]:
    """Arrays by name, those in dictionaries (of Dict observations) by both names."""
    flat: dict[str, Any] = {}
    for name, value in arrays.items():
        flat.update(
            {f"{name}/{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
        )
    return flat


def _check_counters(state: dict[str, Any], name: str) -> None:
    """Types and ranges of all that is no array; that its keys are those of a buffer is known."""
    size, _, pos = (whole(state[counter]) for counter in _COUNTERS)
    if pos >= size or type(state["full"]) is not bool or not isinstance(state["rows"], dict):
        raise ArchiveError(f"{name} holds a replay buffer at row {pos} of {size}: it is damaged.")
    n_valid, n_frames = (whole(state.get(counter, 0)) for counter in _FRAME_COUNTERS)
    if n_valid > (size if state["full"] else pos) or n_frames > _MAX_FRAMES:
        raise ArchiveError(f"{name} holds a replay buffer with {n_valid} rows of {n_frames} frames: it is damaged.")


def _check_rows(like: sb3_buffers.ReplayBuffer, state: dict[str, Any], name: str) -> None:
    """Shapes and types of all rows, before they take the place of others.

    :param like: A buffer with the same rows, no matter how many
    :param state: What a file holds, its counters checked, its arrays read or not
    :param name: What to call the file
    """
    expected, stored = _flat(_buffer_state(like)["rows"]), _flat(state["rows"])
    expect_keys(stored, expected.keys(), name)
    size, n_rows = state["buffer_size"], state["buffer_size"] if state["full"] else state["pos"]
    for path, array in stored.items():
        shares = like.optimize_memory_usage and path.startswith("observations")
        shape = (min(n_rows + 1, size) if shares else n_rows, *expected[path].shape[1:])
        _check_array(array, shape, expected[path].dtype, f"{name} has {path:.50}")


def _check_array(array: Any, shape: tuple[int, ...], dtype: np.dtype, what: str) -> None:
    is_array = isinstance(array, np.ndarray | StoredArray)
    if not is_array or (array.shape, array.dtype) != (shape, dtype):
        kind = f"{array.dtype} of shape {array.shape}" if is_array else type(array).__name__
        raise ArchiveError(
            f"{what} as {kind:.100}, but this model's replay buffer needs {dtype} of shape {shape}: load the replay "
            "buffer of a model with the same settings and environment."
        )


def _read_frames(buffer: FrameStackReplayBuffer, state: dict[str, Any], name: str) -> None:
    n_frames = min(buffer._n_frames, buffer.frame_capacity)
    frames, tails = state["frames"], state["tails"]
    _check_array(frames, (n_frames, *buffer.frame_shape), np.dtype(np.uint8), f"{name} has frames")
    _check_array(tails, buffer._tails.shape, buffer._tails.dtype, f"{name} has tails")
    if n_frames:
        buffer.reserve_frames()
        frames.read(out=buffer.frames[:n_frames])
    tails.read(out=buffer._tails)


def _check_frames(state: dict[str, Any], capacity: int, name: str) -> None:
    """Whether what refers to frames refers to some that are there.

    :param state: As of ``frame_rows``, all but this checked
    :param capacity: Number of frames that there is room for
    :param name: What to call the file
    """
    size, pos, n_valid, n_frames = (state[counter] for counter in ("buffer_size", "pos", *_FRAME_COUNTERS))
    slots, oldest, marked = (state["rows"][row] for row in ("frame_slots", "oldest_frame", "marked"))
    valid = np.arange(pos - n_valid, pos) % size
    # Of marked transitions no frames are kept, and their slots are whatever was there.
    for array, low, high in (
        (slots, 0, capacity),
        (slots[~marked], 0, n_frames),
        (oldest - marked.all(axis=1), -1, n_frames),
        (oldest[valid], n_frames - capacity, n_frames + 1),
        (state["tails"], -capacity, n_frames),
    ):
        if array.size and not (array.min() >= low and array.max() < high):
            raise ArchiveError(f"{name} has rows whose frames are not in it: it is damaged.")


def _check_finite(array: np.ndarray, path: str) -> None:
    if array.dtype.kind == "f":
        for start in range(0, len(array), 1000):
            if not np.isfinite(array[start : start + 1000]).all():
                raise ArchiveError(f"{path:.100} has values that are not finite: what it was saved from is broken.")
