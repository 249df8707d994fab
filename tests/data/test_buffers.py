"""The frame-stack buffer beside SB3's on the same stream, interrupted, on disks, and with wrong observations."""

import copy
import errno
import itertools
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from hypothesis import HealthCheck, event, given, settings
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from twins_for_tests import (
    ACTIONS,
    EVENTS,
    KINDS,
    Twins,
    assert_equal,
    image_space,
    random_events,
    seeded_sample,
    streams,
)

from sb3_cure.data import buffers
from sb3_cure.data.buffers import FrameStackReplayBuffer, infer_frame_stack, stored_places, transitions
from sb3_cure.data.observations import by_key

pytestmark = pytest.mark.filterwarnings("ignore:Frames do not slide", "ignore:The full replay buffer needs")
all_kinds = pytest.mark.parametrize("kind", KINDS)
Row = tuple[Any, Any, np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]


def row_of(obs: Any, next_obs: Any, n_envs: int = 1) -> Row:
    return obs, next_obs, np.zeros((n_envs, 2)), np.zeros(n_envs), np.zeros(n_envs), [{}] * n_envs


# ------------------------------------------------------------------------------------------ the same as SB3's buffers


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(streams())
def test_any_stream_equals_sb3s(twins: Twins) -> None:
    """Breaks, jumps, ends, resets, copies and wrap-around, of images, vectors, numbers and dictionaries."""
    twins.check()
    event(f"wrapped: {twins.ours.full}, rows lost: {twins.ours.size() < twins.sb3.size()}, {twins.kind}")


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(streams())
def test_restarts_are_the_next_episodes_first_observations(twins: Twins) -> None:
    """After terminations, not after timeouts, and not after the newest row, which nothing follows yet."""
    buffer, (rows, envs, ages) = twins.ours, stored_places(twins.ours)
    buffer.last_sampled = rows, envs
    found = buffer.restarts()
    sampled, following = (transitions(twins.sb3, each % buffer.buffer_size, envs) for each in (rows, rows + 1))
    goes_on = (sampled.dones[:, 0] > 0) & th.as_tensor(ages > 0)
    event(f"terminated: {bool(goes_on.any())}")
    if not goes_on.any():
        assert found is None
        return
    after, first = by_key(sampled.next_observations), by_key(following.observations)
    for key, observations in by_key(found).items():
        mask = goes_on.reshape(-1, *[1] * (observations.dim() - 1))
        assert th.equal(observations, th.where(mask, first[key], after[key]))


def distinct_frame(number: int) -> np.ndarray:
    frame = np.zeros((1, 4, 5), np.uint8)
    frame.flat[:3] = number & 255, number >> 8 & 255, number >> 16
    return frame


@pytest.mark.parametrize("buffer_size", [1, 2, 40, 700])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("frame_stack", [1, 4])
def test_ordinary_episodes_lose_no_rows(buffer_size: int, n_envs: int, frame_stack: int) -> None:
    arguments: Any = (buffer_size, image_space(frame_stack, 1), ACTIONS, "cpu", n_envs)
    ours, sb3 = FrameStackReplayBuffer(*arguments, frame_stack=frame_stack), ReplayBuffer(*arguments)
    numbers = itertools.count()
    stacks = [[distinct_frame(next(numbers))] * frame_stack for _ in range(n_envs)]
    for t in range(min(3 * buffer_size, 1000)):
        following = [[*stack[1:], distinct_frame(next(numbers))] for stack in stacks]
        for buffer in (ours, sb3):
            buffer.add(*row_of(np.array(stacks)[:, :, 0], np.array(following)[:, :, 0], n_envs))
        assert ours.size() == sb3.size()
        # Episodes of 25 steps, of which each environment is at another point
        ends = [(t + 9 * i) % 25 == 24 for i in range(n_envs)]
        stacks = [
            [distinct_frame(next(numbers))] * frame_stack if end else stack
            for stack, end in zip(following, ends, strict=True)
        ]
    assert_equal(seeded_sample(ours), seeded_sample(sb3))


@pytest.mark.parametrize("kind", ["image", "dictionary"])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_oldest_rows_go_where_frames_run_out(kind: str, n_envs: int) -> None:
    twins, rng, sampled = Twins(100 * n_envs, n_envs, kind=kind), np.random.default_rng(0), set()
    for _ in range(350):
        twins.step(random_events(rng, n_envs, ("jump", "break")))
        batch = twins.ours.sample(64)
        assert batch.rewards.min() >= twins.n_added - twins.ours.size() * n_envs
        sampled.update(batch.rewards.flatten().tolist())
    twins.check()
    # A row takes up to 2 * 3 frames, so at least a sixth of the rows must have survived
    assert 100 / 6 <= twins.ours.size() < 100 and len(sampled) > 300 * n_envs
    oldest = (twins.ours.pos - twins.ours.size()) % 100
    with pytest.raises(IndexError, match="hold transitions"):
        transitions(twins.ours, np.array([oldest - 1]), np.zeros(1, int))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n_envs", [1, 2])
def test_no_row_outlives_its_frames(seed: int, n_envs: int) -> None:
    """No two frames are equal, and one environment slides while another jumps, which writes the most frames."""
    arguments: Any = ((2 + seed) * n_envs, image_space(4, 1), ACTIONS, "cpu", n_envs)
    ours, sb3 = FrameStackReplayBuffer(*arguments, frame_stack=4), ReplayBuffer(*arguments)
    rng, numbers = np.random.default_rng(seed), itertools.count()
    stacks = [[distinct_frame(next(numbers)) for _ in range(4)] for _ in range(n_envs)]
    for _ in range(60):
        jumps = [rng.random() < (0.8 if i else 0.3) for i in range(n_envs)]
        following = [
            [distinct_frame(next(numbers)) for _ in range(4)] if jump else [*stack[1:], distinct_frame(next(numbers))]
            for stack, jump in zip(stacks, jumps, strict=True)
        ]
        for buffer in (ours, sb3):
            buffer.add(*row_of(np.array(stacks)[:, :, 0], np.array(following)[:, :, 0], n_envs))
        rows, envs, _ = stored_places(ours)
        assert_equal(transitions(ours, rows, envs), transitions(sb3, rows, envs))
        stacks = [
            [distinct_frame(next(numbers)) for _ in range(4)] if jump else stack
            for stack, jump in zip(following, jumps, strict=True)
        ]


def test_sampling_is_uniform_where_rows_are_lost() -> None:
    twins, rng = Twins(60, n_envs=3), np.random.default_rng(0)
    for _ in range(33):
        twins.step(random_events(rng, 3, ("jump", "break")))
    assert twins.ours.size() < 20
    n_transitions = 3 * twins.ours.size()
    values, counts = np.unique(seeded_sample(twins.ours, 2000 * n_transitions).rewards, return_counts=True)
    np.testing.assert_array_equal(values, np.arange(twins.n_added - n_transitions, twins.n_added))
    # Binomial, 5 standard deviations
    assert np.abs(counts - 2000).max() < 5 * 2000**0.5


def test_inputs_are_copied_and_batches_are_copies() -> None:
    twins = Twins(10)
    obs, next_obs = (twins.render([stack], [0]) for stack in ([0, 2, 3], [2, 3, 1]))
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


def test_channels_in_any_memory_order() -> None:
    """VecTransposeImage hands over transposed views."""
    twins = Twins(10, n_envs=2)
    for t in range(5):
        obs = twins.render([[t % 4, 2, 3], [1, 0, t % 4]], [0, 0])
        obs = np.moveaxis(np.ascontiguousarray(np.moveaxis(obs, 1, -1)), -1, 1)
        assert not obs.flags.c_contiguous
        twins.add(obs, obs[::-1], np.zeros(2), [{}, {}])
    twins.check()


@pytest.mark.parametrize("handle", [True, False])
@all_kinds
def test_timeouts_are_no_terminations(handle: bool, kind: str) -> None:
    twins = Twins(10, 3, kind=kind, handle_timeout_termination=handle)
    twins.step([("terminate", 1, 0), ("truncate", 1, 0), ("step", 1, 0)])
    dones = transitions(twins.ours, np.zeros(3, int), np.arange(3)).dones
    assert dones.flatten().tolist() == [1, 0 if handle else 1, 0]
    twins.check()


@pytest.mark.parametrize("norm_obs", [False, True])
def test_vec_normalize(norm_obs: bool) -> None:
    env: Any = VecNormalize(DummyVecEnv([PixelBox]), norm_obs=norm_obs, norm_reward=True)
    arguments: Any = (30, env.venv.observation_space, ACTIONS, "cpu")
    ours, sb3 = FrameStackReplayBuffer(*arguments, frame_stack=2), ReplayBuffer(*arguments)
    env.reset()
    for _ in range(20):
        last_obs, action = env.get_original_obs().copy(), np.array([ACTIONS.sample()])
        _, _, done, infos = env.step(action)
        for buffer in (ours, sb3):
            buffer.add(last_obs, env.get_original_obs(), action, env.get_original_reward(), done, infos)
    batch = seeded_sample(ours, env=env)
    assert_equal(batch, seeded_sample(sb3, env=env))
    assert not th.equal(batch.rewards, seeded_sample(ours).rewards)
    assert batch.observations.dtype == (th.float32 if norm_obs else th.uint8)


@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(5), spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2, 2), np.float64)],
)
def test_other_action_spaces(action_space: spaces.Space) -> None:
    twins, rng = Twins(10, 2, action_space=action_space), np.random.default_rng(0)
    for _ in range(8):
        twins.step(random_events(rng, 2, EVENTS))
    twins.check()


def test_sac_trains_the_same_on_either_buffer(tmp_path: Path) -> None:
    """Through SB3's own collection, ``learn`` again, saving and loading: equal parameters, bit for bit."""
    parameters = []
    kwargs: Any
    for buffer_class, kwargs in ((ReplayBuffer, {}), (FrameStackReplayBuffer, {"frame_stack": 2})):
        model = SAC(
            "CnnPolicy",
            DummyVecEnv([PixelBox, PixelBox]),
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
        model.learn(30)
        assert type(model.replay_buffer) is buffer_class and model.replay_buffer.size() == 30
        parameters.append(list(model.policy.parameters()))
    assert all(th.equal(a, b) for a, b in zip(*parameters, strict=True))


# ------------------------------------------------------------------------------------------ all of a row, or nothing


def interrupt(number: int, call: Callable[[], None]) -> bool:
    """Ctrl-C before the bytecode of this number within the module of buffers; whether there is one."""
    left, former = number, sys.gettrace()

    def trace(frame: Any, what: str, argument: Any) -> Any:
        nonlocal left
        if frame.f_code.co_filename != buffers.__file__:
            return None
        frame.f_trace_opcodes = True
        left -= what == "opcode"
        if left == 0 and what == "opcode":
            raise KeyboardInterrupt
        return trace

    sys._getframe().f_trace_opcodes = True  # Python 3.12 asks `settrace` whether any frame wants these events
    sys.settrace(trace)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(former)
    return False


def contents(buffer: FrameStackReplayBuffer, n: int) -> tuple[dict[str, Any], Any]:
    """Its counters, and its newest transitions."""
    rows, envs, _ = stored_places(buffer)
    counters = copy.deepcopy(buffer.state_dict(frames=False)["counters"])
    return {name: value for name, value in counters.items() if name != "_n_valid"}, transitions(
        buffer, rows[:n], envs[:n]
    )


@pytest.mark.parametrize("kind", ["image", "dictionary", "vector"])
@pytest.mark.parametrize("n_rows", [0, 3, 70], ids=["empty", "filling", "full"])
def test_interrupted_add_stores_nothing(kind: str, n_rows: int) -> None:
    """Before every third bytecode, of which a write takes more; what follows is as without the interruption."""
    twins, rng = Twins(18, 2, 2, kind), np.random.default_rng(0)
    for _ in range(n_rows):
        twins.step(random_events(rng, 2, EVENTS))
    if n_rows:  # a tail that must not be overwritten
        twins.check()
    obs, next_obs = twins.render([[0, 1], [2, 3]], [1, 2]), twins.render([[1, 3], [0, 0]], [1, 3])
    for number in itertools.count(1, 3):
        kept = min(twins.ours.size(), twins.ours.buffer_size - 1)  # not the row to be replaced
        before = contents(twins.ours, 2 * kept)
        if not interrupt(number, lambda: twins.ours.add(*row_of(obs, next_obs, 2))):
            break
        if twins.ours.pos != twins.sb3.pos:
            break  # after the last write
        after = contents(twins.ours, 2 * kept)
        assert twins.ours.size() >= kept and after[0] == before[0]
        assert_equal(after[1], before[1])
    assert number > 200
    twins.sb3.add(*row_of(obs, next_obs, 2))
    for _ in range(25):
        twins.step(random_events(rng, 2, EVENTS))
        rows, envs, _ = stored_places(twins.ours)
        assert_equal(transitions(twins.ours, rows, envs), transitions(twins.sb3, rows, envs))


WRONG: dict[str, Any] = {
    "shape": ("goal", np.zeros((1, 4, 5, 2), np.uint8), "'goal' has shape .*1, 4, 5, 2"),
    "one environment": ("joints", np.zeros((2, 3)), "'joints' has shape"),
    "broadcast": ("joints", np.zeros((1, 1)), "'joints' has shape"),
    "normalised": ("goal", np.full((1, 2, 4, 5), 0.5), "'goal' is uint8 in its space, but float64"),
    "standardised": ("goal", np.full((1, 2, 4, 5), -1.0), "'goal' is uint8"),
    "beyond 255": ("camera", np.full((1, 6, 4, 5), 256), "'camera' is uint8 in its space, but int64"),
    "not a number": ("goal", np.full((1, 2, 4, 5), np.nan, np.float32), "'goal' is uint8 in its space, but float32"),
}


@pytest.mark.parametrize("successor", [False, True])
@pytest.mark.parametrize("name", WRONG)
def test_wrong_observation_of_one_key_stores_nothing(name: str, successor: bool) -> None:
    """A second camera that fails leaves the first one where it was."""
    key, wrong, sentence = WRONG[name]
    twins = Twins(10, kind="dictionary")
    for _ in range(12):
        twins.step([("step", 3, 0)])
    size = twins.ours.size()
    before, good = contents(twins.ours, size), twins.render([[0, 1, 2]], [3])
    bad = {**good, key: wrong}
    with pytest.raises(ValueError, match=f"the observation {sentence}"):
        twins.ours.add(*(row_of(good, bad) if successor else row_of(bad, good)))
    after = contents(twins.ours, size)
    assert twins.ours.size() == size and after[0] == before[0]
    assert_equal(after[1], before[1])
    twins.step([("step", 1, 0)])
    twins.check()


@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_whole_numbers_of_another_type_are_stored(dtype: Any) -> None:
    twins = Twins(5)
    obs = twins.render([[0, 1, 2]], [0])
    twins.add(obs.astype(dtype), obs.astype(dtype), np.zeros(1), [{}])
    twins.check()


# ------------------------------------------------------------------------------------------ memory, disks and copies


@pytest.mark.parametrize("buffer_size", [80_000, 1_000_000])
@pytest.mark.parametrize("kind", ["3 frames", "1 frame", "dictionary"])
def test_bytes_per_transition(buffer_size: int, kind: str) -> None:
    """At most 1.05 of one frame of each image, with the largest action of DMC; committed when written to."""
    resident = pytest.importorskip("psutil").Process().memory_info
    front, goal, wrist = (image_space(n, channels, 84, 84) for n, channels in ((3, 3), (1, 3), (3, 1)))
    space: Any = {"3 frames": front, "1 frame": goal}.get(kind)
    stacks: Any = 3 if kind == "3 frames" else 1
    frames, vectors = 21_168, 0
    if kind == "dictionary":
        joints = spaces.Box(-1, 1, (24,), np.float32)
        space = spaces.Dict(front=front, goal=goal, joints=joints, wrist=wrist)
        stacks, frames, vectors = {"front": 3, "wrist": 3}, 21_168 + 21_168 + 7056, 2 * 24 * 4
    before = resident().rss
    buffer = FrameStackReplayBuffer(
        buffer_size, space, spaces.Box(-1, 1, (38,), np.float32), device="cpu", frame_stack=stacks
    )
    assert resident().rss - before < 50e6
    assert buffer_size * frames < buffer.nbytes <= buffer_size * (1.05 * frames + vectors)
    assert buffer.nbytes == sum(
        array.nbytes for array in [*buffer.rows.values(), *(ring.frames for ring in buffer.rings.values())]
    )


def test_optimize_memory_usage_changes_nothing() -> None:
    """SB3's own variant would store the next episode's first observation as an episode's last successor."""
    model = tiny_model(
        "CnnPolicy",
        PixelBox(episode_length=5),
        optimize_memory_usage=True,
        replay_buffer_kwargs=dict(handle_timeout_termination=False),
    )
    assert type(model.replay_buffer) is FrameStackReplayBuffer
    model.learn(14)
    twin = tiny_model("CnnPolicy", PixelBox(episode_length=5), replay_buffer_class=ReplayBuffer).learn(14)
    places = np.arange(14), np.zeros(14, int)
    ours, sb3 = (transitions(each.replay_buffer, *places) for each in (model, twin))
    assert th.equal(ours.next_observations, sb3.next_observations)
    # Nor does another `learn` end an episode, as it must with SB3's variant
    model = tiny_model("CnnPolicy", PixelBox(episode_length=50), optimize_memory_usage=True).learn(14)
    model.learn(5, reset_num_timesteps=False)
    assert not model.replay_buffer.dones.any()  # type: ignore[union-attr]


@pytest.mark.parametrize("slides", [True, False], ids=["oldest frame first", "newest frame first"])
@pytest.mark.filterwarnings("default")
def test_warns_of_frames_that_do_not_slide(slides: bool, recwarn: pytest.WarningsRecorder) -> None:
    """Long before the buffer is full: a short training would never hear of it."""
    buffer = FrameStackReplayBuffer(1000, image_space(3, 1), ACTIONS, "cpu", frame_stack=3)
    frames, order = (
        np.random.default_rng(0).integers(0, 256, (503, 4, 5), np.uint8),
        slice(None, None, 1 if slides else -1),
    )
    for t in range(500):
        buffer.add(*row_of(frames[None, t : t + 3][:, order], frames[None, t + 1 : t + 4][:, order]))
    assert any("Frames do not slide" in str(each.message) for each in recwarn) is not slides
    assert (buffer.size() == 500) is slides


def test_warns_of_too_little_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("psutil")
    arguments: Any = (1000, image_space(3), ACTIONS, "cpu")
    monkeypatch.setattr(buffers.psutil, "virtual_memory", lambda: SimpleNamespace(available=40_000))
    with pytest.warns(UserWarning, match="0.00 GB are available"):
        FrameStackReplayBuffer(*arguments, frame_stack=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FrameStackReplayBuffer(*arguments, frame_stack=3, frames_dir=tmp_path)


def test_pickled_buffer_is_as_large_as_its_contents(tmp_path: Path) -> None:
    buffer = FrameStackReplayBuffer(50_000, image_space(3, 3, 84, 84), ACTIONS, "cpu", frame_stack=3)
    obs = np.ones((1, 9, 84, 84), np.uint8)
    buffer.add(*row_of(obs, obs))
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    assert (tmp_path / "buffer.pkl").stat().st_size < 1e6  # most of it the bounds of the observation space
    loaded = load_from_pkl(tmp_path / "buffer.pkl")
    assert loaded.nbytes == buffer.nbytes and loaded.counts == {"": 2}
    loaded.add(*row_of(obs, obs))  # the stream continues, so its frames are shared across the file
    assert loaded.counts == {"": 3}


class Prioritised(FrameStackReplayBuffer):
    """A buffer of the user's own, with an argument and a state."""

    def __init__(self, *args: Any, alpha: float = 0.6, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.alpha, self.priorities = alpha, np.ones(self.buffer_size)


def test_copies_keep_what_a_subclass_adds() -> None:
    buffer = Prioritised(9, image_space(3, 3, 8, 8), ACTIONS, "cpu", frame_stack=3, alpha=0.9)
    obs = np.ones((1, 9, 8, 8), np.uint8)
    buffer.add(*row_of(obs, obs))
    buffer.priorities[0] = 5
    copied = copy.deepcopy(buffer)
    assert type(copied) is Prioritised and copied.size() == 1
    assert copied.alpha == 0.9 and copied.priorities[0] == 5
    assert copied.priorities is not buffer.priorities


def test_frames_on_disk_are_the_same_frames(tmp_path: Path) -> None:
    """Also after a copy; nothing is left in the folder."""
    twins = Twins(20)
    in_memory, folder = twins.ours, tmp_path / "new"
    twins.sb3 = FrameStackReplayBuffer(20, twins.space, ACTIONS, "cpu", frame_stack=3, frames_dir=folder)
    assert not folder.exists(), "a model that only acts needs no disk"
    for _ in range(33):
        twins.step([("step", 3, 0)])
    twins.check()
    copied = copy.deepcopy(twins.sb3)
    assert isinstance(copied.rings[""].frames, np.memmap)
    expected = seeded_sample(in_memory)
    assert_equal(seeded_sample(copied), expected)
    copied.rings[""].frames[:] = 0  # copies do not share the file, which has no name
    assert_equal(seeded_sample(twins.sb3), expected)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("where", "error"), [("not/there", FileNotFoundError), ("taken", FileExistsError), ("full", OSError)]
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
    stack = np.zeros((1, 4, 4, 5), np.uint8)
    with pytest.raises(error):
        buffer.add(*row_of(stack, stack))
    assert buffer.size() == 0


# ------------------------------------------------------------------------------------------ how many frames


@pytest.mark.parametrize(
    ("space", "frame_stack"),
    [(image_space(2, 3), 4), (spaces.Dict(camera=image_space(2, 3)), {"camera": 4})],
    ids=["image", "dictionary"],
)
def test_frames_that_do_not_divide_channels_are_refused(space: spaces.Space, frame_stack: Any) -> None:
    with pytest.raises(ValueError, match="frame_stack=4 does not divide the 6 channels"):
        FrameStackReplayBuffer(10, space, ACTIONS, frame_stack=frame_stack)


def test_one_number_of_frames_for_all_images() -> None:
    """1 where it does not divide the channels, and batches are right with any number."""
    twins, rng = Twins(20, kind="dictionary"), np.random.default_rng(0)
    for stack, frames in ((3, {"camera": 3, "goal": 1}), (2, {"camera": 2, "goal": 2})):
        twins.ours = FrameStackReplayBuffer(20, twins.space, ACTIONS, "cpu", frame_stack=stack)
        twins.between("reset")
        assert {key: ring.frame_stack for key, ring in twins.ours.rings.items()} == frames
        for _ in range(18):
            twins.step(random_events(rng, 1, ("step",)))
        rows, envs, _ = stored_places(twins.ours)
        assert_equal(transitions(twins.ours, rows, envs), transitions(twins.sb3, rows, envs))


@pytest.mark.parametrize(("said", "frames"), [(2, 2), (np.int64(6), 6), (4, 1), (0, 1), (-2, 1), ("two", 1)])
def test_environments_are_believed_where_channels_allow_it(said: Any, frames: int) -> None:
    """Of six channels, a positive number that divides them; around them, SB3's stacks slide."""
    env = DummyVecEnv([PixelBox])
    env.set_attr("frame_stack", said)
    assert infer_frame_stack(env) == frames
    assert infer_frame_stack(VecFrameStack(env, 5, channels_order="first")) == 5
    assert infer_frame_stack(None) == infer_frame_stack(DummyVecEnv([VectorBox])) == 1


@pytest.mark.parametrize(("policy", "env"), [("CnnPolicy", PixelBox()), ("MlpPolicy", VectorBox())])
def test_models_choose_the_frame_stack_buffer(policy: str, env: Any) -> None:
    buffer = tiny_model(policy, env).replay_buffer
    assert type(buffer) is FrameStackReplayBuffer and len(buffer.rings) == (policy == "CnnPolicy")


def test_transitions_of_sb3s_buffers_are_those_it_samples() -> None:
    for kind in KINDS:
        twins = Twins(7, kind=kind)
        for code in range(9):
            twins.step([("step", code, 0)])
        rows, envs, ages = stored_places(twins.sb3)
        assert rows.tolist() == [1, 0, 6, 5, 4, 3, 2] and ages.tolist() == list(range(7))
        assert isinstance(twins.sb3, DictReplayBuffer if kind == "dictionary" else ReplayBuffer)
        assert_equal(transitions(twins.sb3, rows, envs), twins.sb3._get_samples(rows))


def test_transitions_of_sb3s_compact_buffer_are_those_it_samples() -> None:
    """It keeps each observation once."""
    box = spaces.Box(-9, 9, (1,))
    buffer = ReplayBuffer(5, box, box, "cpu", optimize_memory_usage=True, handle_timeout_termination=False)
    for step in range(7):
        now, then = (np.full((1, 1), value, np.float32) for value in (step, step + 1))
        buffer.add(now, then, now, np.ones(1), np.zeros(1), [{}])
    rows, env_inds, _ = stored_places(buffer)
    assert rows.tolist() == [1, 0, 4, 3]  # and not 2, where the newest one's successor is
    assert_equal(transitions(buffer, rows, env_inds), buffer._get_samples(rows))
