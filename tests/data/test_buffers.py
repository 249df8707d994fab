"""The frame-stack buffer beside SB3's ReplayBuffer on the same stream, and what no buffer may sample."""

import contextlib
import errno
import itertools
import os
import pickle
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure.data import buffers
from sb3_cure.data.buffers import (
    MARKS,
    FrameStackReplayBuffer,
    SkippingReplayBuffer,
    told_frame_stack,
    transitions,
    unmarked,
)
from sb3_cure.data.samples import Samples

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
PALETTE = 4


def image_space(frame_stack: int, channels: int = 3, height: int = 4, width: int = 5) -> spaces.Box:
    return spaces.Box(0, 255, (frame_stack * channels, height, width), np.uint8)


def palette(channels: int) -> np.ndarray:
    """Few frames, so that they recur by chance; two of them differ in a single pixel."""
    frames = np.random.default_rng(0).integers(0, 256, (PALETTE, channels, 4, 5), dtype=np.uint8)
    frames[1] = frames[0]
    frames[1, -1, -1, -1] += 1
    return frames


def digits(code: int, length: int) -> list[int]:
    return [code // PALETTE**i % PALETTE for i in range(length)]


class Twins:
    """Our buffer, SB3's, and SB3's that skips, fed the same stream of palette frames.

    Each transition has its own number, which is its reward; ``faulty`` are the numbers of those that were marked.
    """

    def __init__(
        self,
        buffer_size: int,
        n_envs: int = 1,
        frame_stack: int = 3,
        channels: int = 1,
        action_space: spaces.Space = ACTIONS,
        **kwargs: Any,
    ):
        self.n_envs, self.frame_stack, self.action_space = n_envs, frame_stack, action_space
        self.space = image_space(frame_stack, channels)
        arguments = (buffer_size, self.space, action_space, "cpu", n_envs)
        self.ours = FrameStackReplayBuffer(*arguments, frame_stack=frame_stack, **kwargs)
        self.sb3 = ReplayBuffer(*arguments, **kwargs)
        self.skipping = SkippingReplayBuffer(*arguments, **kwargs)
        self.rng = np.random.default_rng(0)
        self.frames = palette(channels)
        self.stacks = [[0] * frame_stack for _ in range(n_envs)]
        self.tails: list[list[int]] = [[] for _ in range(n_envs)]
        self.costs: list[int] = []
        self.n_added = 0
        self.faulty: set[int] = set()

    def render(self, stacks: list[list[int]]) -> np.ndarray:
        return self.frames[np.array(stacks)].reshape(self.n_envs, *self.space.shape)

    def step(self, events: list[tuple[str, int, int]]) -> None:
        """Per environment: what happens, and two codes for the frames that come next."""
        obs = [list(stack) for stack in self.stacks]
        next_obs, dones = [], np.zeros(self.n_envs)
        infos: list[dict[str, Any]] = []
        for i, (what, code, next_code) in enumerate(events):
            successor = digits(code, self.frame_stack) if what == "jump" else [*obs[i][1:], code % PALETTE]
            next_obs.append(successor)
            dones[i] = what in ("terminate", "truncate")
            infos.append({"TimeLimit.truncated": what == "truncate"})
            if what == "fault":
                n_steps = 1 + code % 3
                infos[i] |= {"env_fault": "broken", "env_fault_steps": n_steps}
                self.faulty |= {self.n_added + i - age * self.n_envs for age in range(n_steps)}
            if dones[i]:
                self.stacks[i] = [next_code % PALETTE] * self.frame_stack
            elif what == "break":
                self.stacks[i] = digits(next_code, self.frame_stack)
            elif what != "fault" or next_code % 2:  # else the observation stands still
                self.stacks[i] = list(successor)
        self.count_frames(obs, next_obs, events)
        self.add(self.render(obs), self.render(next_obs), dones, infos)

    def count_frames(self, obs: list[list[int]], next_obs: list[list[int]], events: list[Any]) -> None:
        """How many frames this row needs in addition to the ones before, at most."""

        def runs(stack: list[int]) -> int:
            return 1 + sum(a != b for a, b in itertools.pairwise(stack))

        cost = 0
        for i, (what, _, _) in enumerate(events):
            if what != "fault":
                cost += 0 if obs[i] == self.tails[i] else runs(obs[i])
                cost += 1 if next_obs[i][:-1] == obs[i][1:] else runs(next_obs[i])
            self.tails[i] = [] if what == "fault" else next_obs[i]
        self.costs.append(cost)

    def add(self, obs: np.ndarray, next_obs: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        rewards = self.n_added + np.arange(self.n_envs, dtype=np.float32)
        self.n_added += self.n_envs
        actions = np.stack([self.action_space.sample() for _ in range(self.n_envs)])
        for buffer in (self.ours, self.sb3, self.skipping):
            buffer.add(obs, next_obs, actions, rewards, dones, infos)

    def relearn(self, code: int) -> None:
        """What `learn()` does: every environment is reset, no `done` is stored."""
        self.stacks = [[(code + i) % PALETTE] * self.frame_stack for i in range(self.n_envs)]

    def save_and_load(self) -> None:
        self.ours = pickle.loads(pickle.dumps(self.ours, protocol=pickle.HIGHEST_PROTOCOL))

    def reset(self) -> None:
        for buffer in (self.ours, self.sb3, self.skipping):
            buffer.reset()
        self.costs.clear()
        self.tails = [[] for _ in range(self.n_envs)]

    def valid_rows(self) -> np.ndarray:
        return (self.ours.pos - 1 - np.arange(self.ours.size())) % self.ours.buffer_size

    def check(self) -> None:
        """Every stored transition equals SB3's, the faulty ones are marked; rows went only where frames ran out."""
        assert (self.ours.pos, self.ours.full) == (self.sb3.pos, self.sb3.full)
        assert min(len(self.costs), 1) <= self.ours.size() <= self.sb3.size()
        if self.n_envs == 1:
            # All frames of a row were stored with it or with the `frame_stack` rows before it
            room = self.ours.frame_capacity - 2 * self.frame_stack
            for age in range(self.sb3.size()):
                if sum(self.costs[-1 - age - self.frame_stack :]) <= room:
                    assert age < self.ours.size()
        ages = np.repeat(np.arange(self.ours.size()), self.n_envs)
        envs = np.tile(np.arange(self.n_envs), self.ours.size())
        rows = np.repeat(self.valid_rows(), self.n_envs)
        numbers = self.n_added - (ages + 1) * self.n_envs + envs
        good = np.array([number not in self.faulty for number in numbers], dtype=bool)
        for found, expected in zip(unmarked(self.ours), (rows, envs, ages), strict=True):
            np.testing.assert_array_equal(found, expected[good])
        if good.any():
            same = transitions(self.sb3, rows[good], envs[good])
            assert_equal(transitions(self.ours, rows[good], envs[good]), same)
            assert same.rewards.flatten().tolist() == numbers[good].tolist()

    def check_samples(self) -> None:
        """No faulty transition is drawn; where all rows are there, batches are those of SB3's buffers."""
        if len(unmarked(self.ours)[0]) == 0:
            with pytest.raises(ValueError, match="All transitions in the replay buffer are marked"):
                self.ours.sample(1)
            return
        batch = seeded_sample(self.ours)
        assert not self.faulty & set(batch.rewards.flatten().tolist())
        if self.ours.size() == self.sb3.size():
            assert_equal(batch, seeded_sample(self.skipping))
            if not self.faulty:
                assert_equal(batch, seeded_sample(self.sb3))


def assert_equal(batch: ReplayBufferSamples, expected: ReplayBufferSamples) -> None:
    for name, tensor, reference in zip(batch._fields, batch, expected, strict=True):
        if tensor is None or reference is None:
            assert tensor is reference, name
            continue
        assert (tensor.dtype, tensor.shape) == (reference.dtype, reference.shape), name
        assert th.equal(tensor, reference), name


def seeded_sample(buffer: ReplayBuffer, batch_size: int = 32, seed: int = 0, **kwargs: Any) -> ReplayBufferSamples:
    np.random.seed(seed)
    return buffer.sample(batch_size, **kwargs)


# ------------------------------------------------------------------------------------------ the same as SB3's buffer

EVENTS = ("step", "step", "step", "step", "terminate", "truncate", "break", "jump")
KINDS = [
    EVENTS,
    ("step", "step", "step", "terminate", "truncate"),
    ("break", "jump"),
    ("step", "step", "terminate", "break", "jump", "fault"),
    ("step", "step", "step", "step", "step", "fault"),
    ("fault",),
]
BETWEEN = ("nothing",) * 12 + ("save and load", "learn again", "reset")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.data(),
    st.integers(1, 24),
    st.integers(1, 4),
    st.integers(1, 4),
    st.sampled_from([1, 3]),
    st.sampled_from(KINDS),
)
def test_any_stream_equals_sb3s(
    data: st.DataObject, buffer_size: int, n_envs: int, frame_stack: int, channels: int, events: tuple[str, ...]
) -> None:
    """Breaks, jumps, faults, episodes' ends, resets, copies and wrap-around, in any order, of several environments."""
    twins = Twins(buffer_size, n_envs, frame_stack, channels)
    code = st.integers(0, PALETTE**frame_stack - 1)
    row = st.lists(st.tuples(st.sampled_from(events), code, code), min_size=n_envs, max_size=n_envs)
    n_steps = data.draw(st.integers(1, 40))
    steps = st.lists(st.tuples(st.sampled_from(BETWEEN), row), min_size=n_steps, max_size=n_steps)
    for between, envs in data.draw(steps):
        if between == "save and load":
            twins.save_and_load()
        elif between == "learn again":
            twins.relearn(envs[0][1])
        elif between == "reset":
            twins.reset()
        twins.step(envs)
        twins.check()
    event(f"wrapped: {twins.ours.full}, rows lost: {twins.ours.size() < twins.sb3.size()}, {len(twins.faulty) > 0}")
    twins.check_samples()


def random_events(rng: np.random.Generator, n_envs: int, kinds: tuple[str, ...]) -> list[tuple[str, int, int]]:
    return [(str(rng.choice(kinds)), int(rng.integers(256)), int(rng.integers(256))) for _ in range(n_envs)]


@pytest.mark.parametrize(("frame_stack", "n_envs"), [(1, 3), (2, 1), (4, 3)])
def test_long_streams_wrap_around_often(frame_stack: int, n_envs: int) -> None:
    twins = Twins(37 * n_envs, n_envs, frame_stack, channels=3)
    for t in range(400):
        twins.step(random_events(twins.rng, n_envs, (*EVENTS, "fault")))
        if t % 10 == 0:
            twins.check()
    twins.check_samples()


def distinct_frames(start: int, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Frames of which no two are equal."""
    while True:
        frame = np.zeros(shape, dtype=np.uint8)
        frame.flat[:3] = start & 255, start >> 8 & 255, start >> 16
        yield frame
        start += 1


@pytest.mark.parametrize("buffer_size", [1, 2, 40, 700])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("frame_stack", [1, 4])
def test_ordinary_episodes_lose_nothing(buffer_size: int, n_envs: int, frame_stack: int) -> None:
    twins = Twins(buffer_size, n_envs, frame_stack)
    sources = [distinct_frames(i << 16, (1, 4, 5)) for i in range(n_envs)]
    stacks = [[next(source)] * frame_stack for source in sources]
    for t in range(min(3 * buffer_size, 1000)):
        following = [[*stack[1:], next(source)] for stack, source in zip(stacks, sources, strict=True)]
        # Episodes of 25 steps, of which each environment is at another point
        dones = np.array([(t + 9 * i) % 25 == 24 for i in range(n_envs)])
        twins.add(np.array(stacks)[:, :, 0], np.array(following)[:, :, 0], dones, [{}] * n_envs)
        assert twins.ours.size() == twins.sb3.size()
        stacks = [
            [next(source)] * frame_stack if done else stack
            for stack, done, source in zip(following, dones, sources, strict=True)
        ]
    twins.costs = [1]
    twins.check()


@pytest.mark.parametrize("n_envs", [1, 4])
def test_oldest_rows_go_where_frames_run_out(n_envs: int) -> None:
    twins = Twins(100 * n_envs, n_envs, frame_stack=3)
    sampled = set()
    for _ in range(350):
        twins.step(random_events(twins.rng, n_envs, ("jump", "break")))
        oldest = twins.n_added - twins.ours.size() * n_envs
        batch = twins.ours.sample(64)
        assert batch.rewards.min() >= oldest
        sampled.update(batch.rewards.flatten().tolist())
    twins.check()
    # A row takes up to 2 * 3 frames, so at least a sixth of the rows must have survived
    assert 100 / 6 <= twins.ours.size() < 100
    assert len(sampled) > 300 * n_envs
    lost = np.setdiff1d(np.arange(100), twins.valid_rows())
    with pytest.raises(IndexError, match="hold transitions"):
        transitions(twins.ours, lost[:1], np.zeros(1, int))


def test_interrupted_add_spoils_no_other_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while frames are written: what can still be sampled is what was stored."""
    twins = Twins(30, n_envs=3)
    store = FrameStackReplayBuffer._store_frame
    for n_left in range(60):
        left = itertools.count(n_left % 16, -1)

        def interrupted(buffer: Any, frame: np.ndarray, left: Iterator[int] = left) -> int:
            if next(left) == 0:
                raise KeyboardInterrupt
            return store(buffer, frame)

        for _ in range(3):
            twins.step(random_events(twins.rng, 3, ("jump", "break")))
        stacks = twins.render([digits(n_left + i, 3) for i in range(3)])
        arguments: tuple[Any, ...] = stacks, stacks[::-1], np.zeros((3, 2)), np.zeros(3), np.zeros(3), [{}] * 3
        monkeypatch.setattr(FrameStackReplayBuffer, "_store_frame", interrupted)
        with pytest.raises(KeyboardInterrupt):
            for _ in range(20):
                twins.ours.add(*arguments)
                twins.sb3.add(*arguments)
        monkeypatch.setattr(FrameStackReplayBuffer, "_store_frame", store)
        rows = np.repeat(twins.valid_rows(), 3)
        envs = np.tile(np.arange(3), twins.ours.size())
        assert_equal(transitions(twins.ours, rows, envs), transitions(twins.sb3, rows, envs))


@pytest.mark.parametrize("broken", [False, True])
def test_sampling_is_uniform_over_transitions(broken: bool) -> None:
    twins = Twins(60, n_envs=3)
    for _ in range(33):
        twins.step(random_events(twins.rng, 3, ("jump", "break") if broken else ("step",)))
    assert (twins.ours.size() < 20) == broken
    n_transitions = 3 * twins.ours.size()
    values, counts = np.unique(seeded_sample(twins.ours, 2000 * n_transitions).rewards, return_counts=True)
    np.testing.assert_array_equal(values, np.arange(twins.n_added - n_transitions, twins.n_added))
    # Binomial, 5 standard deviations
    assert np.abs(counts - 2000).max() < 5 * 2000**0.5


def test_equal_seeds_give_sb3s_batches() -> None:
    twins = Twins(90, n_envs=3)
    for t in range(70):
        twins.step(random_events(twins.rng, 3, ("step",) if t % 40 else ("truncate",)))
        expected = seeded_sample(twins.sb3, 7, seed=t)
        for buffer in (twins.ours, twins.skipping):
            assert_equal(seeded_sample(buffer, 7, seed=t), expected)
    # No further draw: all leave the generator in the same state
    after = set()
    everyone: tuple[ReplayBuffer, ...] = (twins.ours, twins.sb3, twins.skipping)
    for each in everyone:
        seeded_sample(each)
        after.add(np.random.random())
    assert len(after) == 1


def test_inputs_are_copied_and_batches_are_copies() -> None:
    twins = Twins(10)
    obs, next_obs = twins.render([[0, 2, 3]]), twins.render([[2, 3, 1]])
    action, reward, done, infos = np.ones((1, 2), np.float32), np.ones(1), np.ones(1), [{"TimeLimit.truncated": False}]
    for buffer in (twins.ours, twins.sb3, twins.skipping):
        buffer.add(obs, next_obs, action, reward, done, infos)
    expected = twins.sb3.sample(4)
    for array in (obs, next_obs, action, reward, done):
        array[...] = 0
    infos[0]["TimeLimit.truncated"] = True
    for buffer in (twins.ours, twins.skipping):
        batch = buffer.sample(4)
        assert_equal(batch, expected)
        for tensor in batch[:5]:
            tensor.zero_()
        assert_equal(buffer.sample(4), expected)


def test_non_contiguous_observations() -> None:
    """VecTransposeImage hands over transposed views."""
    twins = Twins(10, n_envs=2)
    for t in range(5):
        obs = np.moveaxis(np.ascontiguousarray(np.moveaxis(twins.render([[t % 4, 2, 3], [1, 0, t % 4]]), 1, -1)), -1, 1)
        assert not obs.flags.c_contiguous
        twins.add(obs, obs[::-1], np.zeros(2), [{}, {}])
    twins.costs = [1]
    twins.check()


def test_reset_forgets_everything() -> None:
    twins = Twins(10)
    for _ in range(15):
        twins.step(random_events(twins.rng, 1, EVENTS))
    numbers = twins.ours.frame_numbers
    twins.reset()
    assert (twins.ours.size(), twins.ours.pos, twins.ours.full) == (0, 0, False)
    assert twins.ours.frame_numbers is not numbers
    with pytest.raises(ValueError):
        twins.ours.sample(1)
    twins.step([("step", 1, 0)])
    twins.check()
    assert twins.ours.size() == 1


@pytest.mark.parametrize("handle", [True, False])
def test_timeouts_are_no_terminations(handle: bool) -> None:
    twins = Twins(10, n_envs=3, handle_timeout_termination=handle)
    twins.step([("terminate", 1, 0), ("truncate", 1, 0), ("step", 1, 0)])
    dones = transitions(twins.ours, np.zeros(3, int), np.arange(3)).dones
    assert dones.flatten().tolist() == [1, 0 if handle else 1, 0]
    twins.check()


class TinyImages(gym.Env):
    """Random 36x36 images, three stacked; episodes of 7 steps."""

    observation_space = image_space(3, 1, 36, 36)
    action_space = ACTIONS

    def _frame(self) -> np.ndarray:
        return self.np_random.integers(0, 256, (1, 36, 36), dtype=np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t = 0
        self.obs = np.concatenate([self._frame()] * 3)
        return self.obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += 1
        self.obs = np.concatenate([self.obs[1:], self._frame()])
        return self.obs, float(action[0]), self.t == 7 and action[1] > 0, self.t == 7, {}


@pytest.mark.parametrize("norm_obs", [False, True])
def test_vec_normalize(norm_obs: bool) -> None:
    env: Any = VecNormalize(DummyVecEnv([TinyImages]), norm_obs=norm_obs, norm_reward=True)
    space = TinyImages.observation_space
    ours = FrameStackReplayBuffer(30, space, ACTIONS, "cpu", frame_stack=3)
    sb3 = ReplayBuffer(30, space, ACTIONS, "cpu")
    env.reset()
    for _ in range(20):
        last_obs = env.get_original_obs().copy()
        action = np.array([ACTIONS.sample()])
        _, _, done, infos = env.step(action)
        for buffer in (ours, sb3):
            buffer.add(last_obs, env.get_original_obs(), action, env.get_original_reward(), done, infos)
    batch = seeded_sample(ours, env=env)
    assert_equal(batch, seeded_sample(sb3, env=env))
    assert not th.equal(batch.rewards, seeded_sample(ours).rewards)
    assert batch.observations.dtype == (th.float32 if norm_obs else th.uint8)


@pytest.mark.parametrize("saves_memory", [False, True])
def test_transitions_of_sb3s_buffer_are_those_it_samples(saves_memory: bool) -> None:
    """Also where it stores each observation once, which is the next one of the row before."""
    kwargs: Any = dict(optimize_memory_usage=saves_memory, handle_timeout_termination=not saves_memory)
    buffer = ReplayBuffer(7, image_space(1), ACTIONS, "cpu", **kwargs)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 255, (13, 1, *image_space(1).shape), dtype=np.uint8)
    for obs, next_obs in itertools.pairwise(frames):
        buffer.add(obs, next_obs, np.array([ACTIONS.sample()]), rng.random(1), np.zeros(1), [{}])
    rows, env_inds, ages = unmarked(buffer)
    found = transitions(buffer, rows, env_inds)
    assert_equal(found, buffer._get_samples(rows))
    assert np.array_equal(found.observations, frames[11 - ages, 0])
    assert np.array_equal(found.next_observations, frames[12 - ages, 0])


def test_sac_trains_the_same_on_either_buffer(tmp_path: Path) -> None:
    """Through SB3's own collection, `learn` again, saving and loading: equal parameters, bit for bit."""
    parameters = []
    kwargs: dict[str, Any]
    for buffer_class, kwargs in ((ReplayBuffer, {}), (FrameStackReplayBuffer, {"frame_stack": 3})):
        model = SAC(
            "CnnPolicy",
            DummyVecEnv([TinyImages, TinyImages]),
            buffer_size=60,
            batch_size=8,
            learning_starts=10,
            replay_buffer_class=buffer_class,
            replay_buffer_kwargs=kwargs,
            policy_kwargs={"net_arch": [8], "features_extractor_kwargs": {"features_dim": 8}},
            seed=0,
            device="cpu",
        )
        model.learn(40)
        model.save_replay_buffer(tmp_path / "buffer.pkl")
        model.load_replay_buffer(tmp_path / "buffer.pkl")
        assert isinstance(model.replay_buffer, buffer_class)
        model.learn(30)
        assert model.replay_buffer.full
        assert model.replay_buffer.size() == 30
        parameters.append(list(model.policy.parameters()))
    assert all(th.equal(a, b) for a, b in zip(*parameters, strict=True))


@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(5), spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2, 2), np.float64)],
)
def test_other_action_spaces(action_space: spaces.Space) -> None:
    twins = Twins(10, n_envs=2, action_space=action_space)
    for _ in range(8):
        twins.step(random_events(twins.rng, 2, EVENTS))
    twins.check()


def test_fewer_rows_than_environments_or_samples() -> None:
    twins = Twins(2, n_envs=4)
    assert twins.ours.buffer_size == 1
    for _ in range(9):
        twins.step(random_events(twins.rng, 4, ("step", "truncate")))
        twins.check()
    assert twins.ours.sample(50).observations.shape == (50, 3, 4, 5)


# ------------------------------------------------------------------------------------------ memory, disks and copies


@pytest.mark.parametrize("buffer_size", [80_000, 1_000_000])
@pytest.mark.parametrize("frame_stack", [1, 3])
def test_bytes_per_transition(buffer_size: int, frame_stack: int) -> None:
    """At most 1.05 of one frame, with the largest action of the DeepMind Control suite; committed when written to."""
    space, actions = image_space(frame_stack, 3, 84, 84), spaces.Box(-1, 1, (38,), np.float32)
    resident = pytest.importorskip("psutil").Process().memory_info
    before = resident().rss
    buffer = FrameStackReplayBuffer(buffer_size, space, actions, device="cpu", frame_stack=frame_stack)
    assert resident().rss - before < 50e6
    arrays = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
    assert buffer.nbytes == sum(array.nbytes for array in arrays)
    assert buffer_size * 21_168 < buffer.nbytes <= 1.05 * 21_168 * buffer_size


@pytest.mark.parametrize("slides", [True, False], ids=["oldest frame first", "newest frame first"])
def test_warns_before_frames_that_do_not_slide_cost_transitions(slides: bool) -> None:
    """Long before the buffer is full: a short training would never hear of it."""
    buffer = FrameStackReplayBuffer(1000, image_space(3, 1), ACTIONS, "cpu", frame_stack=3)
    rng, order = np.random.default_rng(0), slice(None) if slides else slice(None, None, -1)
    frames, zeros = rng.integers(0, 256, (503, 4, 5), dtype=np.uint8), np.zeros(1)
    caught = contextlib.nullcontext() if slides else pytest.warns(UserWarning, match="seldom 3 frames")
    with caught:
        for t in range(500):
            obs, next_obs = frames[None, t : t + 3][:, order], frames[None, t + 1 : t + 4][:, order]
            buffer.add(obs, next_obs, np.zeros((1, 2)), zeros, zeros, [{}])
    assert (buffer.size() == 500) is slides


def test_warns_where_memory_will_not_suffice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("psutil")
    arguments: Any = (1000, image_space(3), ACTIONS, "cpu")
    monkeypatch.setattr(buffers.psutil, "virtual_memory", lambda: SimpleNamespace(available=100_000))
    with pytest.warns(UserWarning, match="0.00 GB are available"):
        FrameStackReplayBuffer(*arguments, frame_stack=3)
    FrameStackReplayBuffer(*arguments, frame_stack=3, frames_dir=tmp_path)  # a warning would fail


def test_works_without_psutil(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which only SB3's extras install; then nothing is known of the memory."""
    monkeypatch.setitem(sys.modules, "psutil", None)
    without = runpy.run_path(buffers.__file__)
    assert without["FrameStackReplayBuffer"](1000, image_space(3), ACTIONS, "cpu", frame_stack=3).size() == 0


@pytest.mark.parametrize("n_steps", [0, 7, 50])
def test_saved_and_loaded_through_sb3(tmp_path: Path, n_steps: int) -> None:
    twins = Twins(20)
    for _ in range(n_steps):
        twins.step(random_events(twins.rng, 1, EVENTS))
    save_to_pkl(tmp_path / "buffer.pkl", twins.ours)
    loaded = load_from_pkl(tmp_path / "buffer.pkl")
    for name, array in vars(twins.ours).items():
        if isinstance(array, np.ndarray):
            np.testing.assert_array_equal(getattr(loaded, name), array, err_msg=name)
            assert getattr(loaded, name).flags.writeable
    assert loaded.frame_numbers is not twins.ours.frame_numbers
    n_frames, twins.ours = loaded._n_frames, loaded
    twins.step([("step", 1, 1)])
    # The stream goes on, so its frames are shared across the file
    assert n_steps == 0 or loaded._n_frames <= n_frames + 1 + (twins.costs[-1] > 1) * 3
    twins.check()


def test_saved_buffer_is_as_large_as_its_contents(tmp_path: Path) -> None:
    buffer = FrameStackReplayBuffer(50_000, image_space(3, 3, 84, 84), ACTIONS, "cpu", frame_stack=3)
    obs = np.ones((1, 9, 84, 84), np.uint8)
    buffer.add(obs, obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
    buffer.sample(2)
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    assert (tmp_path / "buffer.pkl").stat().st_size < 1e6  # most of it the bounds of the observation space
    assert load_from_pkl(tmp_path / "buffer.pkl").last_sampled is None


def test_frames_on_disk_are_the_same_frames(tmp_path: Path) -> None:
    """A buffer whose frames lie on disk samples what one in memory samples, also after pickling; nothing is left."""
    space = image_space(2, 3, 8, 8)
    in_memory = FrameStackReplayBuffer(20, space, ACTIONS, "cpu", frame_stack=2)
    in_file = FrameStackReplayBuffer(20, space, ACTIONS, "cpu", frame_stack=2, frames_dir=tmp_path / "new")
    assert not (tmp_path / "new").exists(), "a model that only acts needs no disk"
    rng = np.random.default_rng(0)
    stack = rng.integers(0, 256, (1, 6, 8, 8), np.uint8)
    for step in range(33):
        following = np.concatenate([stack[:, 3:], rng.integers(0, 256, (1, 3, 8, 8), np.uint8)], axis=1)
        for buffer in (in_memory, in_file):
            buffer.add(stack, following, np.ones((1, 2)), np.array([step]), np.array([False]), [{}])
        stack = following
    copied = pickle.loads(pickle.dumps(in_file))
    assert isinstance(in_file.frames, np.memmap) and isinstance(copied.frames, np.memmap)
    expected = seeded_sample(in_memory, 50)
    assert_equal(seeded_sample(in_file, 50), expected)
    assert_equal(seeded_sample(copied, 50), expected)
    # Copies do not share the file, which has no name
    copied.frames[:] = 0
    assert_equal(seeded_sample(in_file, 50), expected)
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize(
    ("where", "error"),
    [("not/there", FileNotFoundError), ("taken", FileExistsError), ("full", "No space left on device")],
)
def test_missing_room_is_known_at_first_step(
    where: str, error: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk would kill the process later."""
    (tmp_path / "taken").touch()

    def reserve(file: int, start: int, size: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", reserve, raising=False)
    buffer = FrameStackReplayBuffer(20, image_space(2), ACTIONS, frame_stack=2, frames_dir=tmp_path / where)
    stack = np.zeros((1, 6, 4, 5), np.uint8)
    with pytest.raises(error) if isinstance(error, type) else pytest.raises(OSError, match=error):
        buffer.add(stack, stack, np.ones((1, 2)), np.zeros(1), np.zeros(1), [{}])
    assert buffer.size() == 0


# ------------------------------------------------------------------------------------------ what would be cut wrongly

GOOD = image_space(3)


@pytest.mark.parametrize(
    ("space", "frame_stack", "reason"),
    [
        (spaces.Box(0, 1, (9, 84, 84), np.float32), 3, "use SB3's ReplayBuffer"),
        (spaces.Dict({"image": GOOD}), 3, "use SB3's ReplayBuffer or DictReplayBuffer"),
        (spaces.Box(0, 255, (84, 84), np.uint8), 3, "use SB3's ReplayBuffer"),
        (spaces.Box(0, 255, (84, 84, 9), np.uint8), 3, "channels come last"),
        (image_space(2), 4, "frame_stack=4 does not divide its channels"),
    ],
)
def test_observations_that_cannot_be_cut_are_refused(space: spaces.Space, frame_stack: int, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        FrameStackReplayBuffer(10, space, ACTIONS, frame_stack=frame_stack)


@pytest.mark.parametrize(("told", "frames"), [(2, 2), (6, 6), (4, None), (0, None), (-2, None), ("two", None)])
def test_environments_are_believed_where_images_can_be_cut_so(told: Any, frames: int | None) -> None:
    """Of six channels, a positive number that divides them."""
    env = DummyVecEnv([PixelBox])
    env.set_attr("frame_stack", told)
    assert told_frame_stack(env) == frames


@pytest.mark.parametrize("which", ["obs", "next_obs"])
@pytest.mark.parametrize("bad", [np.zeros((2, 9, 4, 5), np.float32), np.zeros((2, 4, 5, 9), np.uint8)])
def test_other_observations_are_not_stored(which: str, bad: np.ndarray) -> None:
    """Floats would be rounded to 0, channels that come last cut into wrong frames."""
    buffer = FrameStackReplayBuffer(10, GOOD, ACTIONS, "cpu", n_envs=2, frame_stack=3)
    arrays = {"obs": np.zeros((2, 9, 4, 5), np.uint8), "next_obs": np.zeros((2, 9, 4, 5), np.uint8), which: bad}
    with pytest.raises(ValueError, match=r"Observations are .* but this buffer stores uint8 of shape"):
        buffer.add(**arrays, action=np.zeros((2, 2)), reward=np.zeros(2), done=np.zeros(2), infos=[{}, {}])
    assert buffer.size() == 0


# ------------------------------------------------------------------------------------------ marked transitions


def stream(n_envs: int, n_steps: int, marks: set[tuple[int, int]], key: str) -> Iterator[tuple[Any, ...]]:
    """Transitions with their number as the reward; the marked ones have a key in ``info``."""
    rng = np.random.default_rng(0)
    obs = rng.integers(0, 256, (n_envs, 2, 3, 3), dtype=np.uint8)
    for row in range(n_steps):
        new = rng.integers(0, 256, (n_envs, 1, 3, 3), dtype=np.uint8)
        next_obs = np.concatenate([obs[:, 1:], new], axis=1)
        infos = [{key: "why"} if (row, i) in marks else {} for i in range(n_envs)]
        numbers = np.arange(row * n_envs, (row + 1) * n_envs, dtype=np.float32)
        yield obs, next_obs, rng.uniform(-1, 1, (n_envs, 2)), numbers, np.zeros(n_envs), infos
        obs = next_obs


def buffer_of(kind: type[ReplayBuffer], size: int, n_envs: int) -> Any:
    space = spaces.Box(0, 255, (2, 3, 3), np.uint8)
    stacks: dict[str, Any] = {"frame_stack": 2} if kind is FrameStackReplayBuffer else {}
    return kind(size, space, ACTIONS, "cpu", n_envs, **stacks)


both_kinds = pytest.mark.parametrize("kind", [FrameStackReplayBuffer, SkippingReplayBuffer])


@both_kinds
@pytest.mark.parametrize("key", MARKS)
def test_unmarked_transitions_are_drawn_evenly(kind: type[ReplayBuffer], key: str) -> None:
    marks = {(0, 0), (1, 0), (1, 1), (3, 1), (5, 0)}
    buffer = buffer_of(kind, 16, 2)
    for transition in stream(2, 8, marks, key):
        buffer.add(*transition)
    good = {row * 2 + i for row in range(8) for i in range(2) if (row, i) not in marks}
    drawn, counts = np.unique(seeded_sample(buffer, 110_000).rewards.numpy().astype(int), return_counts=True)
    assert set(drawn) == good
    # 10 000 each, with a standard deviation of 95
    assert np.abs(counts - 10_000).max() < 500
    copy = pickle.loads(pickle.dumps(buffer))
    assert np.array_equal(copy.marked, buffer.marked)
    assert not np.any(buffer.rewards[buffer.marked]) and not np.any(buffer.actions[buffer.marked])


@both_kinds
def test_mark_goes_with_its_transition(kind: type[ReplayBuffer]) -> None:
    buffer = buffer_of(kind, 8, 2)
    for transition in stream(2, 4 + 3, {(2, 0), (6, 1)}, "env_fault"):  # row 2 is overwritten by row 6
        buffer.add(*transition)
    assert np.argwhere(buffer.marked).tolist() == [[2, 1]]


@both_kinds
@pytest.mark.parametrize("marks", [set(), {(2, 0), (3, 1)}], ids=["no marks", "marks"])
def test_buffer_remembers_the_rows_it_drew(kind: type[ReplayBuffer], marks: set[tuple[int, int]]) -> None:
    buffer: Any = buffer_of(kind, 12, 2)
    for transition in stream(2, 9, marks, "env_fault"):
        buffer.add(*transition)
    batch = buffer.sample(64)
    assert_equal(transitions(buffer, *buffer.last_sampled), batch)
    assert not buffer.marked[buffer.last_sampled].any()


@both_kinds
def test_only_marked_transitions_are_an_error(kind: type[ReplayBuffer]) -> None:
    buffer = buffer_of(kind, 20, 1)
    for transition in stream(1, 2, {(0, 0), (1, 0)}, "env_fault"):
        buffer.add(*transition)
    with pytest.raises(ValueError, match="All transitions in the replay buffer are marked"):
        buffer.sample(1)


def test_skipping_needs_whole_observations() -> None:
    with pytest.raises(ValueError, match="optimize_memory_usage=True stores"):
        SkippingReplayBuffer(10, GOOD, ACTIONS, optimize_memory_usage=True, handle_timeout_termination=False)


def test_model_chooses_a_buffer_that_skips() -> None:
    """Frames once where there are any; with everything off the buffer is SB3's."""
    off: dict[str, Any] = dict(srl=None, curiosity=None)
    for model, kind in (
        (tiny_model("CnnPolicy", PixelBox()), FrameStackReplayBuffer),
        (tiny_model("MlpPolicy", VectorBox()), SkippingReplayBuffer),
        (tiny_model("MlpPolicy", VectorBox(), **off), ReplayBuffer),
        (tiny_model("CnnPolicy", PixelBox(), **off), ReplayBuffer),
        (tiny_model("MlpPolicy", VectorBox(), on_bad_transition="skip", **off), SkippingReplayBuffer),
    ):
        assert type(model.replay_buffer) is kind


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kinds", [["mark", "jump", "jump", "step"], ["jump"]], ids=["around marks", "whole stacks"])
def test_no_row_outlives_its_frames(kinds: list[str], seed: int) -> None:
    """No two frames are equal, so that each jump writes as many as there are. What continues the stack of before a mark
    would need older frames than the marked row between them."""
    buffer = FrameStackReplayBuffer(6 + seed, image_space(3, 1), ACTIONS, "cpu", frame_stack=3)
    rng, source = np.random.default_rng(seed), distinct_frames(1, (1, 4, 5))
    stack = [next(source) for _ in range(3)]
    rows: dict[int, np.ndarray] = {}
    for _ in range(60):
        what = rng.choice(kinds)
        following = [next(source) for _ in range(3)] if what == "jump" else [*stack[1:], next(source)]
        rows[buffer.pos], next_obs = np.concatenate(stack), np.concatenate(following)
        infos = [{"bad_transition": "bad" if what == "mark" else None}]
        buffer.add(rows[buffer.pos][None], next_obs[None], np.zeros((1, 2)), np.zeros(1), np.zeros(1), infos)
        if what != "mark":
            stack = [next(source) for _ in range(3)] if what == "jump" else following
        for row in (buffer.pos - 1 - np.arange(buffer.size())) % buffer.buffer_size:
            if not buffer.marked[row, 0]:
                batch = transitions(buffer, np.array([row]), np.array([0]))
                np.testing.assert_array_equal(batch.observations[0].numpy(), rows[int(row)])


def test_samples_begin_with_sb3s_fields() -> None:
    buffer = buffer_of(FrameStackReplayBuffer, 4, 1)
    buffer.add(*next(stream(1, 1, set(), "env_fault")))
    batch = Samples(*buffer.sample(4))
    assert batch._fields[:6] == ReplayBufferSamples._fields
    assert batch[5:] == (None,) * 6 and batch.observations.shape == (4, 2, 3, 3)
