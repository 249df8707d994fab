"""FrameStackReplayBuffer against SB3's ReplayBuffer fed the same stream, and what it promises beyond that."""

import itertools
import pickle
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cure import buffers
from sb3_cure.buffers import FrameStackReplayBuffer

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
    """Our buffer and SB3's, fed the same stream of palette frames; every transition has its own reward."""

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
        self.ours = FrameStackReplayBuffer(
            buffer_size, self.space, action_space, "cpu", n_envs, frame_stack=frame_stack, **kwargs
        )
        self.sb3 = ReplayBuffer(buffer_size, self.space, action_space, "cpu", n_envs, **kwargs)
        self.rng = np.random.default_rng(0)
        self.frames = palette(channels)
        self.stacks = [[0] * frame_stack for _ in range(n_envs)]
        self.tails: list[list[int]] = [[] for _ in range(n_envs)]
        self.costs: list[int] = []
        self.n_added = 0

    def render(self, stacks: list[list[int]]) -> np.ndarray:
        return self.frames[np.array(stacks)].reshape(self.n_envs, *self.space.shape)

    def step(self, events: list[tuple[str, int, int]]) -> None:
        """Per environment: what happens, and two codes for the frames that come next."""
        obs = [list(stack) for stack in self.stacks]
        next_obs, dones, infos = [], np.zeros(self.n_envs), []
        for i, (what, code, next_code) in enumerate(events):
            successor = digits(code, self.frame_stack) if what == "jump" else [*obs[i][1:], code % PALETTE]
            next_obs.append(successor)
            dones[i] = what in ("terminate", "truncate")
            infos.append(
                {"TimeLimit.truncated": what == "truncate", "env_fault": "broken" if what == "fault" else None}
            )
            if dones[i]:
                self.stacks[i] = [next_code % PALETTE] * self.frame_stack
            else:
                self.stacks[i] = digits(next_code, self.frame_stack) if what == "break" else list(successor)
        self.count_frames(obs, next_obs)
        self.add(self.render(obs), self.render(next_obs), dones, infos)

    def count_frames(self, obs: list[list[int]], next_obs: list[list[int]]) -> None:
        """How many frames this row needs in addition to the ones before, at most."""

        def runs(stack: list[int]) -> int:
            return 1 + sum(a != b for a, b in itertools.pairwise(stack))

        cost = 0
        for i in range(self.n_envs):
            cost += 0 if obs[i] == self.tails[i] else runs(obs[i])
            cost += 1 if next_obs[i][:-1] == obs[i][1:] else runs(next_obs[i])
        self.costs.append(cost)
        self.tails = next_obs

    def add(self, obs: np.ndarray, next_obs: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        rewards = self.n_added + np.arange(self.n_envs, dtype=np.float32)
        self.n_added += self.n_envs
        actions = np.stack([self.action_space.sample() for _ in range(self.n_envs)])
        for buffer in (self.ours, self.sb3):
            buffer.add(obs, next_obs, actions, rewards, dones, infos)

    def relearn(self, code: int) -> None:
        """What `learn()` does: every environment is reset, no `done` is stored."""
        self.stacks = [[(code + i) % PALETTE] * self.frame_stack for i in range(self.n_envs)]

    def save_and_load(self) -> None:
        self.ours = pickle.loads(pickle.dumps(self.ours, protocol=pickle.HIGHEST_PROTOCOL))

    def reset(self) -> None:
        self.ours.reset()
        self.sb3.reset()
        self.costs.clear()
        self.tails = [[] for _ in range(self.n_envs)]

    def valid_rows(self) -> np.ndarray:
        return (self.ours.pos - 1 - np.arange(self.ours.size())) % self.ours.buffer_size

    def check(self) -> None:
        """Every stored transition equals SB3's; rows went only if the frames did not suffice."""
        assert (self.ours.pos, self.ours.full) == (self.sb3.pos, self.sb3.full)
        assert min(len(self.costs), 1) <= self.ours.size() <= self.sb3.size()
        if self.n_envs == 1:
            # All frames of a row were stored with it or with the `frame_stack` rows before it
            for age in range(self.sb3.size()):
                if sum(self.costs[-1 - age - self.frame_stack :]) <= self.ours.frame_capacity:
                    assert age < self.ours.size()
        rows = np.repeat(self.valid_rows(), self.n_envs)
        envs = np.tile(np.arange(self.n_envs), self.ours.size())
        if len(rows):
            assert_equal(transitions(self.ours, rows, envs), transitions(self.sb3, rows, envs))


def transitions(buffer: ReplayBuffer, rows: np.ndarray, envs: np.ndarray) -> ReplayBufferSamples:
    """`_get_samples`, with the environments given instead of drawn."""
    with mock.patch("numpy.random.randint", return_value=envs):
        return buffer._get_samples(rows)


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


EVENTS = ("step", "step", "step", "step", "terminate", "truncate", "break", "jump")
BETWEEN = ("nothing",) * 12 + ("save and load", "learn again", "reset")


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.data(),
    st.integers(1, 24),
    st.integers(1, 4),
    st.integers(1, 4),
    st.sampled_from([1, 3]),
    st.sampled_from([EVENTS, ("step", "step", "step", "terminate", "truncate"), ("break", "jump")]),
)
def test_transitions_equal_sb3s(
    data: st.DataObject, buffer_size: int, n_envs: int, frame_stack: int, channels: int, events: tuple[str, ...]
) -> None:
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
    event(f"wrapped: {twins.ours.full}, rows lost: {twins.ours.size() < twins.sb3.size()}")
    if twins.ours.size() == twins.sb3.size():
        assert_equal(seeded_sample(twins.ours), seeded_sample(twins.sb3))


def random_events(rng: np.random.Generator, n_envs: int, kinds: tuple[str, ...]) -> list[tuple[str, int, int]]:
    return [(str(rng.choice(kinds)), int(rng.integers(256)), int(rng.integers(256))) for _ in range(n_envs)]


@pytest.mark.parametrize("frame_stack", [1, 2, 4])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_long_streams_wrap_around_many_times(frame_stack: int, n_envs: int) -> None:
    twins = Twins(37 * n_envs, n_envs, frame_stack, channels=3)
    for t in range(400):
        twins.step(random_events(twins.rng, n_envs, EVENTS))
        if t % 5 == 0:
            twins.check()


def distinct_frames(start: int, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Frames of which no two are equal."""
    while True:
        frame = np.zeros(shape, dtype=np.uint8)
        frame.flat[:3] = start & 255, start >> 8 & 255, start >> 16
        yield frame
        start += 1


@pytest.mark.parametrize("buffer_size", [1, 2, 5, 40, 700])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("frame_stack", [1, 3, 4])
def test_ordinary_episodes_lose_nothing(buffer_size: int, n_envs: int, frame_stack: int) -> None:
    twins = Twins(buffer_size, n_envs, frame_stack)
    sources = [distinct_frames(i << 16, (1, 4, 5)) for i in range(n_envs)]
    stacks = [[next(source)] * frame_stack for source in sources]
    for t in range(min(3 * buffer_size, 1200)):
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
    rows = np.repeat(twins.valid_rows(), n_envs)
    envs = np.tile(np.arange(n_envs), twins.ours.size())
    assert_equal(transitions(twins.ours, rows, envs), transitions(twins.sb3, rows, envs))


@pytest.mark.parametrize("n_envs", [1, 4])
def test_where_frames_run_out_the_oldest_rows_go(n_envs: int) -> None:
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
    survivors = twins.valid_rows()
    lost = np.setdiff1d(np.arange(100), survivors)
    with pytest.raises(IndexError, match="hold no transition"):
        twins.ours._get_samples(lost[:1])


def test_one_environment_that_keeps_breaking_does_not_corrupt_a_calm_one() -> None:
    twins = Twins(6 * 4, n_envs=4, frame_stack=4)
    for _ in range(200):
        twins.step([("step", 0, 0), *random_events(twins.rng, 3, ("jump", "break"))])
        twins.check()


@pytest.mark.parametrize("broken", [False, True])
def test_sampling_is_uniform_over_rows_and_environments(broken: bool) -> None:
    twins = Twins(60, n_envs=3)
    for _ in range(33):
        twins.step(random_events(twins.rng, 3, ("jump", "break") if broken else ("step",)))
    assert (twins.ours.size() < 20) == broken
    n_transitions = 3 * twins.ours.size()
    n_draws = 2000 * n_transitions
    values, counts = np.unique(seeded_sample(twins.ours, n_draws).rewards, return_counts=True)
    np.testing.assert_array_equal(values, np.arange(twins.n_added - n_transitions, twins.n_added))
    # Binomial, 5 standard deviations
    assert np.abs(counts - 2000).max() < 5 * 2000**0.5


def test_equal_seeds_give_sb3s_batches() -> None:
    twins = Twins(90, n_envs=3)
    for t in range(70):
        twins.step(random_events(twins.rng, 3, ("step",) if t % 40 else ("truncate",)))
        assert_equal(seeded_sample(twins.ours, 7, seed=t), seeded_sample(twins.sb3, 7, seed=t))
    # No further draw: both leave the generator in the same state
    seeded_sample(twins.ours)
    after = np.random.random()
    seeded_sample(twins.sb3)
    assert after == np.random.random()


@pytest.mark.parametrize("buffer_size", [80_000, 1_000_000])
def test_bytes_per_transition(buffer_size: int) -> None:
    actions = spaces.Box(-1, 1, (38,), np.float32)  # the largest of the DeepMind Control suite
    space = image_space(3, 3, 84, 84)
    resident = pytest.importorskip("psutil").Process().memory_info
    before = resident().rss
    buffer = FrameStackReplayBuffer(buffer_size, space, actions, device="cpu", frame_stack=3)
    assert resident().rss - before < 50e6  # committed only when written to
    arrays = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
    assert {"frames", "actions", "rewards", "dones", "timeouts"} <= arrays.keys()
    assert buffer.nbytes == sum(array.nbytes for array in arrays.values())
    assert buffer_size * 21_168 < buffer.nbytes <= 1.05 * 21_168 * buffer_size


def test_inputs_are_copied_and_batches_are_copies() -> None:
    twins = Twins(10)
    obs, next_obs = twins.render([[0, 2, 3]]), twins.render([[2, 3, 1]])
    action, reward, done, infos = np.ones((1, 2), np.float32), np.ones(1), np.ones(1), [{"TimeLimit.truncated": False}]
    for buffer in (twins.ours, twins.sb3):
        buffer.add(obs, next_obs, action, reward, done, infos)
    expected = twins.sb3.sample(4)
    for array in (obs, next_obs, action, reward, done):
        array[...] = 0
    infos[0]["TimeLimit.truncated"] = True
    batch = twins.ours.sample(4)
    assert_equal(batch, expected)
    for tensor in batch[:5]:
        tensor.zero_()
    assert_equal(twins.ours.sample(4), expected)


def test_non_contiguous_observations() -> None:
    """VecTransposeImage hands over transposed views."""
    twins = Twins(10, n_envs=2)
    for t in range(5):
        obs = np.moveaxis(np.ascontiguousarray(np.moveaxis(twins.render([[t % 4, 2, 3], [1, 0, t % 4]]), 1, -1)), -1, 1)
        assert not obs.flags.c_contiguous
        twins.add(obs, obs[::-1], np.zeros(2), [{}, {}])
    twins.costs = [1]
    twins.check()


@pytest.mark.parametrize("n_steps", [0, 7, 50])
def test_saved_and_loaded_through_sb3(tmp_path: Any, n_steps: int) -> None:
    twins = Twins(20)
    for _ in range(n_steps):
        twins.step(random_events(twins.rng, 1, EVENTS))
    save_to_pkl(tmp_path / "buffer.pkl", twins.ours)
    loaded = load_from_pkl(tmp_path / "buffer.pkl")
    for name, array in vars(twins.ours).items():
        if isinstance(array, np.ndarray):
            np.testing.assert_array_equal(getattr(loaded, name), array, err_msg=name)
            assert getattr(loaded, name).flags.writeable
    n_frames, loaded_from = loaded._n_frames, twins.ours
    twins.ours = loaded
    twins.step([("step", 1, 1)])
    # The stream goes on, so its frames are shared across the file
    assert n_steps == 0 or loaded._n_frames <= n_frames + 1 + (twins.costs[-1] > 1) * 3
    assert loaded_from.pos == n_steps % 20
    twins.check()


def test_a_saved_buffer_is_as_large_as_its_contents(tmp_path: Any) -> None:
    buffer = FrameStackReplayBuffer(10_000, image_space(3, 3, 84, 84), ACTIONS, "cpu", frame_stack=3)
    obs = np.ones((1, 9, 84, 84), np.uint8)
    buffer.add(obs, obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    assert (tmp_path / "buffer.pkl").stat().st_size < 1e6  # most of it the bounds of the observation space


def test_reset_forgets_everything() -> None:
    twins = Twins(10)
    for _ in range(15):
        twins.step(random_events(twins.rng, 1, EVENTS))
    twins.reset()
    assert (twins.ours.size(), twins.ours.pos, twins.ours.full) == (0, 0, False)
    with pytest.raises(ValueError):
        twins.ours.sample(1)
    with pytest.raises(IndexError, match="hold no transition"):
        twins.ours._get_samples(np.array([3]))
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


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Tiny networks: threads that wait for each other on a busy machine take most of the time."""
    n_threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(n_threads)


@pytest.mark.usefixtures("one_thread")
def test_sac_trains_the_same_on_either_buffer(tmp_path: Any) -> None:
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
        model.learn(40)
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


def test_extend_adds_one_row_per_item() -> None:
    twins = Twins(40, n_envs=2)
    obs = np.stack([twins.render([[t % 4, t % 4, t % 4], [2, t % 4, 1]]) for t in range(6)])
    columns: tuple[Any, ...] = obs, obs, np.ones((6, 2, 2)), np.ones((6, 2)), np.zeros((6, 2)), [[{}, {}]] * 6
    twins.ours.extend(*columns)
    twins.sb3.extend(*columns)
    twins.costs = [1]
    twins.check()
    assert twins.ours.size() == 6


def test_warns_when_memory_will_not_suffice(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("psutil")
    monkeypatch.setattr(buffers.psutil, "virtual_memory", lambda: SimpleNamespace(available=1000))
    with pytest.warns(UserWarning, match="not have apparently enough memory"):
        Twins(100)


GOOD = image_space(3)


@pytest.mark.parametrize(
    ("space", "kwargs", "parts"),
    [
        (spaces.Box(0, 1, (9, 84, 84), np.float32), {}, ["float32", "uint8 images", "use stable_baselines3's Rep"]),
        (spaces.Dict({"image": GOOD}), {}, ["Dict(", "uint8 images", "DictReplayBuffer"]),
        (spaces.Discrete(3), {}, ["Discrete(3)", "uint8 images", "ReplayBuffer"]),
        (spaces.Box(0, 255, (84, 84), np.uint8), {}, ["(84, 84)", "(frame_stack * c, height, width)", "concatenate"]),
        (spaces.Box(0, 255, (3, 3, 84, 84), np.uint8), {}, ["(3, 3, 84, 84)", "height", "concatenate"]),
        (spaces.Box(0, 255, (84, 84, 9), np.uint8), {}, ["(84, 84, 9)", "channels last", "VecTransposeImage"]),
        (image_space(2), {}, ["6 channels", "frame_stack=4", "pass the number"]),
        (GOOD, {"frame_stack": 0}, ["frame_stack is 0", "at least 1", "pass the number"]),
        (GOOD, {"frame_stack": -3}, ["frame_stack is -3", "at least 1", "pass the number"]),
        (GOOD, {"frame_stack": 3.0}, ["frame_stack is 3.0", "integer", "pass the number"]),
        (GOOD, {"frame_stack": 3, "optimize_memory_usage": True}, ["True", "already stores", "leave it False"]),
    ],
)
def test_refusals_are_one_sentence(space: spaces.Space, kwargs: dict[str, Any], parts: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        FrameStackReplayBuffer(10, space, ACTIONS, **{"frame_stack": 4 if space.shape == (6, 4, 5) else 3, **kwargs})
    message = str(error.value)
    assert all(part in message for part in parts), message
    assert message.endswith(".") and "\n" not in message and ". " not in message


@pytest.mark.parametrize("which", ["obs", "next_obs"])
@pytest.mark.parametrize(
    ("bad", "part"),
    [
        (np.zeros((2, 9, 4, 5), np.float32), "float32"),
        (np.zeros((9, 4, 5), np.uint8), "(9, 4, 5)"),
        (np.zeros((3, 9, 4, 5), np.uint8), "(3, 9, 4, 5)"),
        (np.zeros((2, 4, 5, 9), np.uint8), "(2, 4, 5, 9)"),
    ],
)
def test_refuses_observations_of_another_kind(which: str, bad: np.ndarray, part: str) -> None:
    buffer = FrameStackReplayBuffer(10, GOOD, ACTIONS, "cpu", n_envs=2, frame_stack=3)
    arrays = {"obs": np.zeros((2, 9, 4, 5), np.uint8), "next_obs": np.zeros((2, 9, 4, 5), np.uint8), which: bad}
    with pytest.raises(ValueError) as error:
        buffer.add(**arrays, action=np.zeros((2, 2)), reward=np.zeros(2), done=np.zeros(2), infos=[{}, {}])
    message = str(error.value)
    assert message.startswith(f"{which} is ") and part in message and "expects uint8 of shape (2, 9, 4, 5)" in message
    assert buffer.size() == 0


def test_frame_stack_is_required() -> None:
    with pytest.raises(TypeError, match="frame_stack"):
        FrameStackReplayBuffer(10, GOOD, ACTIONS)  # type: ignore[call-arg]


def test_frames_in_a_file_are_the_same_frames(tmp_path: Path) -> None:
    """A buffer whose frames lie on disk samples what one in memory samples, also after pickling; nothing is left."""
    space = spaces.Box(0, 255, (6, 8, 8), np.uint8)
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    arguments: dict[str, Any] = dict(device="cpu", frame_stack=2)
    in_memory = FrameStackReplayBuffer(20, space, action_space, **arguments)
    in_file = FrameStackReplayBuffer(20, space, action_space, frames_dir=tmp_path, **arguments)
    rng = np.random.default_rng(0)
    stack = rng.integers(0, 256, (1, 6, 8, 8), np.uint8)
    for step in range(33):
        following = np.concatenate([stack[:, 3:], rng.integers(0, 256, (1, 3, 8, 8), np.uint8)], axis=1)
        for buffer in (in_memory, in_file):
            buffer.add(stack, following, np.ones((1, 2)), np.array([step]), np.array([False]), [{}])
        stack = following
    assert isinstance(in_file.frames, np.memmap)
    copied = pickle.loads(pickle.dumps(in_file))
    assert isinstance(copied.frames, np.memmap)
    batches = []
    for buffer in (in_memory, in_file, copied):
        np.random.seed(0)
        batches.append(buffer.sample(50))
    for batch in batches[1:]:
        for field, expected in zip(batch, batches[0], strict=True):
            assert field is expected is None or th.equal(field, expected)
    # Copies do not share the file.
    copied.frames[:] = 0
    np.random.seed(0)
    assert th.equal(in_file.sample(50).observations, batches[0].observations)
    assert list(tmp_path.iterdir()) == []


def test_frames_dir_without_room_is_one_sentence(tmp_path: Path) -> None:
    """Known at the first step, because a full disk would kill the process later; nothing is needed to only act."""
    space = spaces.Box(0, 255, (6, 84, 84), np.uint8)
    stack = np.zeros((1, 6, 84, 84), np.uint8)
    transition: tuple[Any, ...] = (stack, stack, np.ones((1, 2)), np.zeros(1), np.zeros(1), [{}])
    new = FrameStackReplayBuffer(20, space, ACTIONS, frame_stack=2, frames_dir=tmp_path / "new")
    assert not (tmp_path / "new").exists()
    new.add(*transition)
    assert (tmp_path / "new").is_dir()
    mistyped = FrameStackReplayBuffer(20, space, ACTIONS, frame_stack=2, frames_dir=tmp_path / "not" / "there")
    with pytest.raises(
        ValueError, match=r"frames_dir is '.*/there', but .* GB for frames cannot be reserved there \(No"
    ):
        mistyped.add(*transition)
    taken = FrameStackReplayBuffer(20, space, ACTIONS, frame_stack=2, frames_dir=tmp_path / "taken")
    (tmp_path / "taken").touch()
    with pytest.raises(ValueError, match=r"frames_dir is '.*/taken', but .* GB for frames cannot be reserved there \("):
        taken.add(*transition)
    huge = FrameStackReplayBuffer(10**8, space, ACTIONS, frame_stack=2, frames_dir=tmp_path)
    with pytest.raises(ValueError, match="name a directory on a disk with room, or make buffer_size smaller"):
        huge.add(*transition)


@pytest.mark.parametrize("seed", [0, 1, 2, 95])  # the last one has a stream in which it comes to that
def test_no_row_outlives_its_frames_where_observations_stand_still_around_a_mark(seed: int) -> None:
    """What continues the stack of before the mark would need older frames than the marked row between them."""
    buffer, rng = (
        FrameStackReplayBuffer(6, image_space(3, 1), ACTIONS, "cpu", frame_stack=3),
        np.random.default_rng(seed),
    )
    source = distinct_frames(1, (1, 4, 5))
    stack = [next(source) for _ in range(3)]
    rows: dict[int, np.ndarray] = {}
    for _ in range(25):
        what = rng.choice(["mark", "jump", "step", "step"])
        following = [next(source) for _ in range(3)] if what == "jump" else [*stack[1:], next(source)]
        rows[buffer.pos], next_obs = np.concatenate(stack), np.concatenate(following)
        infos = [{"bad_transition": "bad" if what == "mark" else None}]
        buffer.add(rows[buffer.pos][None], next_obs[None], np.zeros((1, 2)), np.zeros(1), np.zeros(1), infos)
        stack = stack if what == "mark" else following
        for row in (buffer.pos - 1 - np.arange(buffer.size())) % buffer.buffer_size:
            if not buffer.marked[row, 0]:
                batch = buffer.transitions(np.array([row]), np.array([0]))
                np.testing.assert_array_equal(batch.observations[0].numpy(), rows[int(row)])
