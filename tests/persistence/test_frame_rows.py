"""What files hold of a frame-stack buffer: it comes back whole after any stream, and others are refused."""

import copy
import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from twins_for_tests import ACTIONS, EVENTS, Twins, random_events, streams

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.persistence import ArchiveError, read_state, write_state
from sb3_cure.persistence.replay_buffers import buffer_from_state

pytestmark = pytest.mark.filterwarnings("ignore:Frames do not slide")


def model_of(twins: Twins) -> Any:
    """The part of a model that a buffer is made from."""
    return SimpleNamespace(
        replay_buffer_class=type(twins.ours),
        replay_buffer_kwargs={"frame_stack": twins.ours.frame_stack},
        observation_space=twins.space,
        action_space=ACTIONS,
        n_envs=twins.n_envs,
        device="cpu",
        optimize_memory_usage=False,
    )


def through_a_file(twins: Twins, change: Any = lambda state: None, model: Any = None) -> FrameStackReplayBuffer:
    file = io.BytesIO()
    write_state(file, twins.ours.state_dict())
    state = read_state(file)
    change(state)
    return buffer_from_state(model or model_of(twins), state, "the file")  # type: ignore[return-value]


def same(one: FrameStackReplayBuffer, other: FrameStackReplayBuffer) -> bool:
    first, second = one.state_dict(), other.state_dict()
    arrays = first["arrays"].keys() == second["arrays"].keys()
    arrays &= all(np.array_equal(array, second["arrays"][name]) for name, array in first["arrays"].items())
    return arrays and first["counters"] == second["counters"]


@settings(max_examples=60, deadline=None)
@given(streams())
def test_rows_come_back_as_written(twins: Twins) -> None:
    """Of any kind of observation, and the stream continues alike."""
    loaded = through_a_file(twins)
    assert same(loaded, twins.ours)
    other = copy.deepcopy(twins)
    other.ours = loaded
    for each in (twins, other):
        each.action_space.seed(0)
        for i in range(20):
            each.step(random_events(np.random.default_rng(i), twins.n_envs, EVENTS))
        each.check()
    assert same(other.ours, twins.ours)


CHANGES: dict[str, Any] = {
    "frames missing": lambda state: state["arrays"].pop("frames/goal"),
    "rows missing": lambda state: state["arrays"].pop("rewards"),
    "vectors missing": lambda state: state["arrays"].pop("observations/joints"),
    "another array": lambda state: state["arrays"].update(more=np.zeros(3)),
    "fewer rows": lambda state: state["counters"].update(pos=3, full=False),
    "counts missing": lambda state: state["counters"].pop("counts"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_damaged_buffers_are_refused(name: str) -> None:
    twins = Twins(12, kind="dictionary")
    for _ in range(14):
        twins.step([("step", 3, 0)])
    with pytest.raises(ArchiveError, match="the file"):
        through_a_file(twins, CHANGES[name])


def test_buffer_of_other_environments_is_refused() -> None:
    twins, other = Twins(12), Twins(12, kind="vector")
    twins.step([("step", 3, 0)])
    with pytest.raises(ArchiveError, match=r"does not fit this model .*missing.* same settings and environment"):
        through_a_file(twins, model=model_of(other))
