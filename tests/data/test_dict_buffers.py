"""A replay buffer of dictionaries equals SB3's, bit for bit, in a fraction of its memory."""

import pickle
import warnings
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer

from sb3_cure.data import buffers
from sb3_cure.data.buffers import DictFrameStackReplayBuffer, FrameStackReplayBuffer, transitions, unmarked

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
STACK = 3
SPACE = spaces.Dict(
    camera=spaces.Box(0, 255, (STACK, 5, 6), np.uint8),
    goal=spaces.Box(0, 255, (1, 4, 5), np.uint8),
    joints=spaces.Box(-1, 1, (2,), np.float64),
    mode=spaces.Discrete(4),
    touch=spaces.MultiBinary(2),
)
FRAMES = {"camera": STACK}


class Twins:
    """Our buffer and SB3's, fed the same stream; each transition's reward is its number."""

    def __init__(self, buffer_size: int, n_envs: int):
        arguments: Any = (buffer_size, SPACE, ACTIONS, "cpu", n_envs)
        self.ours, self.sb3 = DictFrameStackReplayBuffer(*arguments, frame_stack=FRAMES), DictReplayBuffer(*arguments)
        self.n_envs, self.n_added, self.faulty = n_envs, 0, set[int]()
        self.rng = np.random.default_rng(0)
        self.last = self.draw()

    def draw(self) -> dict[str, np.ndarray]:
        """First observations, in which the first frame is repeated."""
        frames = self.rng.integers(0, 256, (self.n_envs, 1, 5, 6), dtype=np.uint8)
        return {"camera": np.concatenate([frames] * STACK, axis=1), **self.rest()}

    def rest(self) -> dict[str, np.ndarray]:
        n = self.n_envs
        return {
            "goal": self.rng.integers(0, 256, (n, 1, 4, 5), dtype=np.uint8),
            "joints": self.rng.uniform(-1, 1, (n, 2)),
            "mode": self.rng.integers(0, 4, n),
            "touch": self.rng.integers(0, 2, (n, 2), dtype=np.int8),
        }

    def step(self, events: list[str]) -> None:
        """
        :param events: What happens in each environment
        """
        n, obs = self.n_envs, self.last
        frame = self.rng.integers(0, 256, (n, 1, 5, 6), dtype=np.uint8)
        successors = {"camera": np.concatenate([obs["camera"][:, 1:], frame], axis=1), **self.rest()}
        begun = self.draw()
        ends = np.array([event in ("terminate", "truncate", "break") for event in events])
        where = {key: ends.reshape(-1, *[1] * (value.ndim - 1)) for key, value in successors.items()}
        self.last = {key: np.where(where[key], begun[key], value) for key, value in successors.items()}
        self.last["camera"][[event == "cut" for event in events]] = begun["camera"][0]  # of this image alone
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": event == "truncate"} for event in events]
        for i, event in enumerate(events):
            if event == "fault":
                infos[i]["env_fault"] = "broken"
                self.faulty.add(self.n_added + i)
        dones = np.array([event in ("terminate", "truncate") for event in events])
        rewards = self.n_added + np.arange(n, dtype=np.float32)
        actions = self.rng.uniform(-1, 1, (n, 2)).astype(np.float32)
        for buffer in (self.ours, self.sb3):
            buffer.add({**obs}, {**successors}, actions, rewards, dones, infos)  # type: ignore[arg-type]
        self.n_added += n

    def check(self) -> None:
        """Every transition that can be sampled equals SB3's, and of batches drawn with equal seeds each number."""
        rows, env_inds, ages = unmarked(self.ours)
        numbers = self.n_added - (ages + 1) * self.n_envs + env_inds
        assert not self.faulty & set(numbers.tolist())
        lost = self.ours.size() < (self.sb3.buffer_size if self.sb3.full else self.sb3.pos)
        if len(rows) == 0:
            return
        same_batch(transitions(self.ours, rows, env_inds), transitions(self.sb3, rows, env_inds))
        assert transitions(self.ours, rows, env_inds).rewards.flatten().tolist() == numbers.tolist()
        if not lost and not self.faulty:
            batches = []
            for buffer in (self.ours, self.sb3):
                np.random.seed(self.n_added)
                batches.append(buffer.sample(16))
            same_batch(*batches)


def same_batch(ours: Any, sb3s: Any) -> None:
    for name, mine, theirs in zip(ours._fields, ours, sb3s, strict=True):
        mine, theirs = ({"": each} if not isinstance(each, dict) else each for each in (mine, theirs))
        assert mine.keys() == theirs.keys()
        for key, value in mine.items():
            if value is None:
                assert theirs[key] is None
                continue
            assert (value.dtype, value.shape) == (theirs[key].dtype, theirs[key].shape), (name, key)
            assert th.equal(value, theirs[key]), (name, key)


EVENTS = [("step",) * 9 + ("terminate", "truncate"), ("step", "step", "break", "cut", "fault"), ("break",)]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data(), st.integers(1, 20), st.integers(1, 3), st.sampled_from(EVENTS))
def test_any_stream_equals_sb3s(data: st.DataObject, buffer_size: int, n_envs: int, events: tuple[str, ...]) -> None:
    """Ends of episodes, breaks, faults, copies and wrap-around, in any order, of several environments."""
    twins = Twins(buffer_size, n_envs)
    row = st.lists(st.sampled_from(events), min_size=n_envs, max_size=n_envs)
    for number, kinds in enumerate(data.draw(st.lists(row, min_size=1, max_size=30))):
        twins.step(kinds)
        if number % 7 == 3:
            twins.ours = pickle.loads(pickle.dumps(twins.ours))
    twins.check()
    rng = np.random.default_rng(1)
    for _ in range(2 * twins.ours.buffer_size):  # shared rows stay shared in copies
        twins.step([str(rng.choice(events)) for _ in range(n_envs)])
    twins.check()


def test_rows_that_one_image_loses_are_lost_for_all() -> None:
    """Where a stream breaks in each step, its ring gives up rows; those that are left are whole."""
    twins = Twins(100, 1)
    for _ in range(150):
        twins.step(["cut"])
    assert 10 < twins.ours.size() < 60 and twins.ours.images["goal"].size() == 100
    twins.check()
    drawn = twins.ours.sample(200).rewards
    assert float(drawn.min()) >= 150 - twins.ours.size()
    with pytest.raises(IndexError):
        twins.ours.observations_at(np.array([(twins.ours.pos - 1 - twins.ours.size()) % 100]), np.array([0]))
    twins.ours.reset()
    assert twins.ours.size() == 0 and all(image.size() == 0 for image in twins.ours.images.values())


def test_an_image_that_is_no_stack_is_told_of() -> None:
    """Three channels are three grey frames, or one in colour: told of the wrong ones, the buffer holds fewer rows."""
    space = spaces.Dict(goal=spaces.Box(0, 255, (3, 36, 36), np.uint8))
    images = np.random.default_rng(0).integers(0, 256, (131, 1, 3, 36, 36), dtype=np.uint8)
    for stack, told in ((1, False), (3, True)):
        buffer = DictFrameStackReplayBuffer(100, space, spaces.Box(-1, 1, (2,)), frame_stack=stack)
        with warnings.catch_warnings(record=True) as caught:
            for before, after in pairwise(images):
                buffer.add({"goal": before}, {"goal": after}, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
        assert ["frame_stack=" in str(each.message) for each in caught][:1] == [True] * told
        assert (buffer.size() == 100) is not told


def test_bytes_per_transition() -> None:
    """At most 1.05 of one frame of each image beside the vectors; without stacks an image is there once."""
    space = spaces.Dict(
        front=spaces.Box(0, 255, (9, 84, 84), np.uint8),
        goal=spaces.Box(0, 255, (3, 84, 84), np.uint8),
        joints=spaces.Box(-1, 1, (24,), np.float32),
        wrist=spaces.Box(0, 255, (3, 84, 84), np.uint8),
    )
    actions = spaces.Box(-1, 1, (38,), np.float32)
    buffer = DictFrameStackReplayBuffer(80_000, space, actions, frame_stack={"front": 3, "wrist": 3})
    frames = 21_168 + 21_168 + 7056  # the goal in colour, each frame of `wrist` grey
    vectors = 2 * 24 * 4
    assert 80_000 * frames < buffer.nbytes <= 80_000 * (1.05 * frames + vectors)
    arrays: dict[int, np.ndarray] = {}
    for owner in (buffer, *buffer.images.values()):
        found = [*vars(owner).values(), *getattr(owner, "observations", {}).values()]
        found += [*getattr(owner, "next_observations", {}).values()]
        arrays |= {id(value): value for value in found if isinstance(value, np.ndarray)}
    assert buffer.nbytes == sum(array.nbytes for array in arrays.values())


def test_one_number_of_frames_for_all_images(tmp_path: Any) -> None:
    """1 where it does not divide the channels; frames may lie on a disk."""
    buffer = DictFrameStackReplayBuffer(10, SPACE, ACTIONS, frame_stack=3, frames_dir=tmp_path)
    assert {key: image.frame_stack for key, image in buffer.images.items()} == {"camera": 3, "goal": 1}
    assert all(len(image.frames) == 0 for image in buffer.images.values())
    twins = Twins(10, 1)
    twins.ours = buffer
    for _ in range(25):
        twins.step(["step"])
    twins.check()
    assert isinstance(buffer.images["goal"].frames, np.memmap)
    with pytest.raises(ValueError, match="frame_stack=2 does not divide its channels"):
        DictFrameStackReplayBuffer(10, SPACE, ACTIONS, frame_stack={"camera": 2})


def test_without_images() -> None:
    """All is as in SB3's buffer, and marked transitions are left out."""
    space = spaces.Dict(a=spaces.Box(-1, 1, (2,)), b=spaces.Discrete(3))
    ours, sb3 = DictFrameStackReplayBuffer(7, space, ACTIONS), DictReplayBuffer(7, space, ACTIONS)
    space.seed(0)
    for number in range(10):
        obs, successor = ({key: np.asarray(part)[None] for key, part in space.sample().items()} for _ in range(2))
        for buffer in (ours, sb3):
            buffer.add({**obs}, {**successor}, np.zeros((1, 2)), np.array([number]), np.array([False]), [{}])  # type: ignore[arg-type]
        batches = []
        for buffer in (ours, sb3):
            np.random.seed(number)
            batches.append(buffer.sample(20))
        same_batch(*batches)
    obs, successor = {"a": np.ones((1, 2)), "b": np.array([2])}, {"a": np.ones((1, 2)), "b": np.array([1])}
    ours.add(obs, successor, np.ones((1, 2)), np.array([99]), np.array([False]), [{"bad_transition": "x"}])
    row = ours.pos - 1
    assert 99 not in ours.sample(300).rewards
    # Nothing of it is kept, which might not be a number.
    kept = [ours.actions, ours.rewards, *ours.observations.values(), *ours.next_observations.values()]
    assert not any(array[row].any() for array in kept)


def test_images_are_those_of_single_buffers() -> None:
    """Their rows are the same arrays, there once."""
    buffer = DictFrameStackReplayBuffer(10, SPACE, ACTIONS, frame_stack=FRAMES)
    assert all(type(image) is FrameStackReplayBuffer for image in buffer.images.values())
    for copied in (buffer, pickle.loads(pickle.dumps(buffer))):
        assert all(image.rewards is copied.rewards for image in copied.images.values())


def test_warns_where_memory_will_not_suffice_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of images each of which would fit."""
    pytest.importorskip("psutil")
    monkeypatch.setattr(buffers.psutil, "virtual_memory", lambda: SimpleNamespace(available=100_000))
    with pytest.warns(UserWarning, match=r"0.00 GB are available") as caught:
        DictFrameStackReplayBuffer(1000, SPACE, ACTIONS, frame_stack=FRAMES)
    assert len(caught) == 1
