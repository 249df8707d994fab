"""What files hold of a frame-stack buffer: whatever stream it has seen, it goes on alike."""

import copy
import io
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from test_buffers import ACTIONS, Twins, assert_equal, random_events, seeded_sample

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.persistence import read_state, write_state
from sb3_cure.persistence.replay_buffers import buffer_from_state, buffer_state

FAULTS = ("step", "step", "terminate", "break", "jump", "fault", "fault")


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


def model_of(twins: Twins) -> Any:
    """What is asked of the model that a buffer is for."""
    return SimpleNamespace(
        replay_buffer_class=FrameStackReplayBuffer,
        replay_buffer_kwargs={"frame_stack": twins.frame_stack},
        observation_space=twins.space,
        action_space=ACTIONS,
        n_envs=twins.n_envs,
        device="cpu",
        optimize_memory_usage=False,
    )


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def flat(buffer: FrameStackReplayBuffer) -> dict[str, Any]:
    """State by name; without the slots of marked transitions, which are whatever was there."""
    state = buffer_state(buffer)
    arrays, counters = state.pop("arrays"), state.pop("counters")
    arrays["frame_slots"] = np.where(arrays["marked"][..., None, None], 0, arrays["frame_slots"])
    return {**state, **arrays, **counters}


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_rows_come_back_as_written(data: st.DataObject) -> None:
    twins, file = filled(data), io.BytesIO()
    write_state(file, buffer_state(twins.ours))
    loaded: Any = buffer_from_state(model_of(twins), read_state(file), "the file")
    assert same(flat(loaded), flat(twins.ours))
    if loaded.size() and not loaded.marked[twins.valid_rows()].all():
        assert_equal(seeded_sample(loaded), seeded_sample(twins.ours))
    events = [random_events(np.random.default_rng(i), twins.n_envs, FAULTS) for i in range(20)]
    other = copy.deepcopy(twins)
    other.ours = loaded
    for each in (twins, other):
        each.action_space.seed(0)
        for row in events:
            each.step(row)
    assert same(flat(loaded), flat(twins.ours))
    assert np.array_equal(loaded.frames, twins.ours.frames)
