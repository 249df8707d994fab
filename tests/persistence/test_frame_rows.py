"""What files hold of a frame-stack buffer's rows: read back as written, and refused where it is broken."""

import copy
import io
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st
from sb3_cure.buffer_files import frame_rows, load_frame_rows
from sb3_cure.serialization import ArchiveError, read_state, write_state
from test_buffers import ACTIONS, Twins, assert_equal, random_events, seeded_sample

from sb3_cure.buffers import FrameStackReplayBuffer

FAULTS = ("step", "step", "terminate", "break", "jump", "fault", "fault")
#: What a field of a file may have become
PLAIN = (None, True, -1, 0, 1, 5, 2**62, 2**64, 1.0, float("nan"), "spam", b"", [], {}, np.float32(1), np.zeros(3))
NUMBERS = (0, 1, -1, 7, -(2**31), 2**31 - 1, -(2**63), 2**63 - 1, 1e30, float("nan"), float("inf"))


def filled(data: st.DataObject) -> Twins:
    """A buffer after a random stream with faults, which was reset now and then."""
    twins = Twins(data.draw(st.integers(1, 12)), data.draw(st.integers(1, 3)), data.draw(st.integers(1, 3)))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    kinds = data.draw(st.sampled_from([FAULTS, ("fault",), ("break", "jump")]))
    for _ in range(data.draw(st.integers(0, 30))):
        if rng.random() < 0.03:
            twins.ours.reset()
        twins.step(random_events(rng, twins.n_envs, kinds))
    return twins


def fresh(twins: Twins) -> FrameStackReplayBuffer:
    """An empty buffer of the same size, but with the frames."""
    size, n_envs = twins.ours.buffer_size * twins.n_envs, twins.n_envs
    buffer = FrameStackReplayBuffer(size, twins.space, ACTIONS, "cpu", n_envs, frame_stack=twins.frame_stack)
    buffer.frames[:] = twins.ours.frames
    return buffer


def contents(buffer: FrameStackReplayBuffer) -> dict[str, Any]:
    others = ("last_sampled", "frame_numbers")  # the latter is another one in every copy
    return {name: value for name, value in vars(copy.deepcopy(buffer)).items() if name not in others}


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_rows_come_back_as_written(data: st.DataObject) -> None:
    twins, file = filled(data), io.BytesIO()
    write_state(file, frame_rows(twins.ours))
    loaded = fresh(twins)
    load_frame_rows(loaded, read_state(file), "the file")
    assert same(flat(frame_rows(loaded)), flat(frame_rows(twins.ours)))
    if loaded.size() and not loaded.marked[twins.valid_rows()].all():
        assert_equal(seeded_sample(loaded), seeded_sample(twins.ours))
    # It goes on alike, too.
    events = [random_events(np.random.default_rng(i), twins.n_envs, FAULTS) for i in range(20)]
    other = copy.deepcopy(twins)
    other.ours = loaded
    for each in (twins, other):
        each.action_space.seed(0)
        for row in events:
            each.step(row)
    assert same(flat(frame_rows(loaded)), flat(frame_rows(twins.ours)))
    assert np.array_equal(loaded.frames, twins.ours.frames)


def flat(rows: dict[str, Any]) -> dict[str, Any]:
    """By name; without the slots of marked transitions, which are whatever was there."""
    arrays = dict(rows.pop("rows"))
    arrays["frame_slots"] = np.where(arrays["marked"][..., None, None], 0, arrays["frame_slots"])
    return {**arrays, **rows}


def broken(data: st.DataObject, value: Any) -> Any:
    """Another value for a field."""
    if not isinstance(value, np.ndarray) or data.draw(st.booleans()):
        return data.draw(st.sampled_from(PLAIN))
    change = data.draw(st.sampled_from(["type", "shape", "number", "numbers"]))
    if change == "type":
        return value.astype(data.draw(st.sampled_from(["f2", ">f4", "f8", "i1", "i4", "i8", "u8", "?", "c8"])))
    if change == "shape":
        return data.draw(st.sampled_from([value[:-1], value[..., None], value.ravel(), np.concatenate([value, value])]))
    value, number = value.copy(), data.draw(st.sampled_from(NUMBERS))
    if value.size:
        with np.errstate(all="ignore"):
            number = np.array(number).astype(value.dtype)
        value.flat[... if change == "numbers" else data.draw(st.integers(0, value.size - 1))] = number
    return value


@settings(max_examples=150, deadline=None)
@given(st.data())
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_broken_rows_are_refused_or_harmless(data: st.DataObject) -> None:
    twins = filled(data)
    rows = copy.deepcopy(frame_rows(twins.ours))
    where = rows["rows"] if data.draw(st.booleans()) else rows
    name = data.draw(st.sampled_from([*where, "another"]))
    value = broken(data, where.get(name))
    if data.draw(st.integers(0, 9)):
        where[name] = value
    else:
        where.pop(name, None)
    buffer = fresh(twins)
    before = contents(buffer)
    try:
        load_frame_rows(buffer, rows, "the file")
    except ArchiveError as error:
        event("refused")
        assert str(error).count("\n") == 0 and str(error).endswith(".")
        assert same(contents(buffer), before)
        return
    event("loaded")
    for _ in range(2):
        if buffer.size() and not buffer.marked[(buffer.pos - 1 - np.arange(buffer.size())) % buffer.buffer_size].all():
            batch = buffer.sample(20)
            assert all(bool(tensor.isfinite().all()) for tensor in batch if tensor is not None)
        twins.ours = buffer
        for i in range(15):
            twins.step(random_events(np.random.default_rng(i), twins.n_envs, FAULTS))
