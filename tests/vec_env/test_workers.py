"""Environments that fail: each kind of fault is noticed and told, training goes on, nothing of a fault is sampled."""

import itertools
import os
import pickle
import re
import signal
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_cure import buffers, make_dmc_env
from sb3_cure.buffers import FrameStackReplayBuffer, SkippingReplayBuffer
from sb3_cure.vec_env import EnvFaultError, FaultTolerantSubprocVecEnv
from sb3_cure.checkpoint import is_plain
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state, why_not_restorable

ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
# What the sentence says of each kind of fault
SAID = {
    "raise": r"raised RuntimeError\('lens broken'\) in step",
    "die": "was killed by SIGKILL during step",
    "hang": r"did not answer step within timeout=\d",
    "black": "returned a black frame",
    "frozen": "returned the same pixels 3 times in a row while its physics moved",
}

pytestmark = pytest.mark.filterwarnings("ignore:Environment [0-9]+ :RuntimeWarning", "ignore:.*fork:DeprecationWarning")


class Breakable(gym.Wrapper):
    """Works until it is told how to fail: ``env_method("break_down", kind)``."""

    kind: str | None = None
    frozen: np.ndarray | None = None

    def break_down(self, kind: str) -> int:
        self.kind = kind
        return os.getpid()

    def state_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "frozen": self.frozen}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        if self.frozen is not None:
            observation[-len(self.frozen) :] = self.frozen
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, *rest = self.env.step(action)
        channels = observation.shape[0] // self.get_wrapper_attr("frame_stack")
        if self.kind == "raise":
            raise RuntimeError("lens broken")
        if self.kind == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.kind == "hang":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as deep in a driver, where no signal is handled
            time.sleep(3600)
        if self.kind == "black":
            observation[-channels:] = 0
        if self.kind == "frozen":
            self.frozen = observation[-channels:].copy() if self.frozen is None else self.frozen
            observation[-channels:] = self.frozen
        return observation, *rest


def breakable_dmc() -> gym.Env:
    return Breakable(Monitor(make_dmc_env("ball_in_cup", "catch", image_size=24, renderer="fast")))


def breakable_box(**kwargs: Any) -> gym.Env:
    return Breakable(PixelBox(size=12, **kwargs))


def position(env: gym.Env) -> np.ndarray:
    return env.unwrapped.position


def made(env_fns: list[Callable[[], gym.Env]], on_env_fault: str = "restart", **kwargs: Any) -> Any:
    """Forked workers: quick, and right where the parent has made no OpenGL context."""
    return FaultTolerantSubprocVecEnv(env_fns, on_env_fault=on_env_fault, start_method="fork", **kwargs)


def still(env: VecEnv) -> np.ndarray:
    return np.zeros((env.num_envs, *env.action_space.shape), np.float32)


def step_until_fault(env: VecEnv, most: int = 5) -> Any:
    """Moving on, as a picture can only be stuck while something moves."""
    for k in range(most):
        result = env.step(np.full_like(still(env), 0.5 if k % 2 else -0.5))
        if any("env_fault" in info for info in result[3]):
            return result
    raise AssertionError("no fault was told")


# ------------------------------------------------------------------------------------------- real DeepMind Control


@pytest.fixture(scope="module")
def fresh() -> Iterator[ProcessPoolExecutor]:
    """A process that has rendered nothing, so that it may fork workers which do."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=import_dmc) as process:
        yield process


def import_dmc() -> None:
    """All that workers need, but for rendering."""
    breakable_dmc().close()


class BreakDown(BaseCallback):
    """Breaks environment 0 in each way, one after the other, and keeps what is told of it."""

    def __init__(self, kinds: list[str]) -> None:
        super().__init__()
        self.left, self.told, self.first_observations = list(kinds), [], []

    def _on_step(self) -> bool:
        assert "env_fault" not in self.locals["infos"][1]
        info = self.locals["infos"][0]
        if "env_fault" in info:
            assert self.locals["dones"][0] and self.locals["rewards"][0] == 0 and "episode" not in info
            self.told.append(info["env_fault"])
            self.first_observations.append(self.locals["new_obs"][0])
        elif self.left and self.n_calls > 12 and len(self.told) == 5 - len(self.left):
            self.training_env.env_method("break_down", self.left.pop(0), indices=0)
        return True


def train_on_breaking_dmc(overlap: bool) -> dict[str, Any]:
    env = made([breakable_dmc, breakable_dmc], timeout=8, frozen_steps=10)
    model = tiny_model("CnnPolicy", env, overlap=overlap)
    sampled, original = [], FrameStackReplayBuffer.transitions

    def spy(buffer: Any, rows: np.ndarray, env_inds: np.ndarray, *rest: Any) -> Any:
        sampled.append(buffer.marked[rows, env_inds].any())
        return original(buffer, rows, env_inds, *rest)

    FrameStackReplayBuffer.transitions = spy
    breaking = BreakDown(list(SAID))
    model.learn(120, callback=breaking)
    buffer = model.replay_buffer
    finite = all(bool(th.isfinite(p).all()) for p in model.policy.parameters())
    env.close()
    return {
        "told": breaking.told,
        "first": breaking.first_observations,
        "restarts": env.restarts,
        "marked": buffer.marked.sum(axis=0).tolist(),
        "sampled": (len(sampled), any(sampled)),
        "steps": model.num_timesteps,
        "finite": finite,
        "children": len(psutil.Process().children()),
    }


@pytest.mark.parametrize("overlap", [False, True])
def test_training_on_real_pixels_survives_every_fault(fresh: ProcessPoolExecutor, overlap: bool) -> None:
    result = fresh.submit(train_on_breaking_dmc, overlap).result()
    for kind, sentence in zip(SAID, result["told"], strict=True):
        assert re.match(rf"Environment 0 .*{SAID[kind]}.*: its worker is replaced", sentence), sentence
    assert result["restarts"] == [5, 0]
    # One transition of each fault, but three of the stuck picture
    assert result["marked"] == [7, 0]
    assert result["sampled"][0] > 20 and not result["sampled"][1]
    assert result["steps"] == 120 and result["finite"]
    for first in result["first"]:  # of an episode: the stack repeats its first frame
        assert np.array_equal(first[:3], first[3:6]) and np.array_equal(first[:3], first[6:]) and first.any()
    assert result["children"] == 0


def break_dmc(kind: str) -> dict[str, Any]:
    env = made([breakable_dmc, breakable_dmc], "raise", timeout=3 if kind == "hang" else 60, frozen_steps=10)
    env.seed(0)
    env.reset()
    env.env_method("break_down", kind, indices=1)
    result: dict[str, Any] = {}
    try:
        step_until_fault(env)
    except EnvFaultError as error:
        result["told"], result["notes"] = str(error), getattr(error, "__notes__", [])
    for name, call in {"step": partial(env.step, still(env)), "reset": env.reset}.items():
        try:
            call()
        except EnvFaultError as error:
            result[name] = str(error)
    env.close()
    result["children"] = len(psutil.Process().children())
    return result


@pytest.mark.parametrize("kind", list(SAID))
def test_a_fault_on_real_pixels_stops_with_its_sentence(fresh: ProcessPoolExecutor, kind: str) -> None:
    result = fresh.submit(break_dmc, kind).result()
    assert re.match(rf"Environment 1 .*{SAID[kind]}.*: pass on_env_fault='restart'", result["told"]), result["told"]
    # The traceback is the worker's own
    assert ("lens broken" in "".join(result["notes"]) and "in step" in result["notes"][0]) == (kind == "raise")
    # It stays failed, rather than hang or answer with what is left of an older step
    assert result["step"] == result["reset"] == result["told"]
    assert result["children"] == 0


def drive_cartpole_out_of_view(task: str) -> int:
    env = made([partial(make_dmc_env, "cartpole", task, image_size=36, renderer="fast")], "raise")
    env.seed(1)
    frames = [env.reset()]
    frames += [env.step(np.ones((1, 1), np.float32))[0] for _ in range(60)]
    env.close()
    return sum(np.array_equal(a[:, -3:], b[:, -3:]) for a, b in itertools.pairwise(frames))


@pytest.mark.parametrize("task", ["swingup", "balance"])
def test_a_cartpole_that_leaves_its_picture_is_no_fault(fresh: ProcessPoolExecutor, task: str) -> None:
    """The only domain of the suite that leaves the view for long: the pole swings where the camera does not see it."""
    assert fresh.submit(drive_cartpole_out_of_view, task).result() > 5


# ----------------------------------------------------------------------------------- nothing of a fault is sampled

EVENTS = ("go on", "truncate", "terminate", "raise", "die", "black", "freeze")


class Tagged(gym.Env):
    """Each frame says where it is from: environment, process, episode, step. The action says what happens."""

    observation_space = spaces.Box(0, 255, (12, 2, 2), np.uint8)
    action_space = spaces.Box(0, len(EVENTS), (1,), np.float32)
    frame_stack = 2

    def __init__(self, index: int) -> None:
        self.index, self.episode, self.frozen = index, 0, False

    def frame(self) -> np.ndarray:
        pid = os.getpid()
        tag = [self.index + 1, self.episode, self.n_steps, pid % 256, pid // 256 % 256, pid // 65536]
        return np.broadcast_to(np.array(tag, np.uint8)[:, None, None], (6, 2, 2))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.n_steps, self.episode = 0, self.episode + 1
        if not self.frozen:
            self.frames = [self.frame()] * 2
        return np.concatenate(self.frames), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        event = EVENTS[int(action[0])]
        self.n_steps += 1
        if event == "raise":
            raise RuntimeError
        if event == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        self.frozen |= event == "freeze"
        frame = np.zeros_like(self.frames[1]) if event == "black" else self.frame()
        self.frames = [self.frames[1], self.frames[1] if self.frozen else frame]
        return np.concatenate(self.frames), 0.0, event == "terminate", event == "truncate", {}


def clock(env: gym.Env) -> np.ndarray:
    return np.array([env.unwrapped.episode, env.unwrapped.n_steps])


def filled_buffers(events: np.ndarray, buffer_size: int) -> list[ReplayBuffer]:
    """Both kinds of buffer, fed as SB3 does it."""
    n_envs = events.shape[1]
    env = made(
        [partial(Tagged, i) for i in range(n_envs)], frozen_steps=3, frozen_motion=0.5, state=clock, max_faults=100
    )
    arguments = (buffer_size, env.observation_space, env.action_space, "cpu", n_envs)
    both = [FrameStackReplayBuffer(*arguments, frame_stack=2), SkippingReplayBuffer(*arguments)]
    obs = env.reset()
    for row in events:
        actions = row[:, None].astype(np.float32)
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs = new_obs.copy()
        for i in np.flatnonzero(dones):
            next_obs[i] = infos[i]["terminal_observation"]
        for buffer in both:
            buffer.add(obs, next_obs, actions, rewards, dones, infos)
        obs = new_obs
    env.close()
    return both


@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_no_transition_that_spans_a_fault_is_ever_sampled(data: st.DataObject) -> None:
    n_envs, n_steps = data.draw(st.integers(1, 3)), data.draw(st.integers(5, 25))
    row = st.lists(st.sampled_from([0, 0, 0, *range(len(EVENTS))]), min_size=n_envs, max_size=n_envs)
    events = np.array(data.draw(st.lists(row, min_size=n_steps, max_size=n_steps)))
    # The last steps move, so that a picture that is stuck has been noticed
    events = np.concatenate([events, np.zeros((4, n_envs), int)])
    both = filled_buffers(events, data.draw(st.sampled_from([n_envs * n_steps // 2, 1000])))
    for buffer in both:
        np.random.seed(0)
        batch = buffer.sample(500)
        tags, next_tags = (
            getattr(batch, name).numpy()[:, 6:, 0, 0].astype(int) for name in ("observations", "next_observations")
        )
        step = np.array([0, 0, 1, 0, 0, 0])
        assert np.array_equal(tags + step, next_tags)
        kinds = np.array(EVENTS)[batch.actions.numpy().astype(int).ravel()]
        assert not set(kinds) & {"raise", "die", "black", "freeze"}
        assert not batch.dones.numpy()[kinds != "terminate"].any()
    # Sharing frames changes nothing of all that
    if both[0].size() == both[1].size():
        batches = []
        for buffer in both:
            np.random.seed(1)
            batches.append(buffer.sample(200))
        assert differences(tuple(batches[0]), tuple(batches[1])) == []


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
    stacks = {"frame_stack": 2} if kind is FrameStackReplayBuffer else {}
    return kind(size, space, ACTIONS, "cpu", n_envs, **stacks)


@pytest.mark.parametrize("kind", [FrameStackReplayBuffer, SkippingReplayBuffer])
@pytest.mark.parametrize("key", buffers.MARKS)
def test_the_other_transitions_are_drawn_evenly(kind: type[ReplayBuffer], key: str) -> None:
    marks = {(0, 0), (1, 0), (1, 1), (3, 1), (5, 0)}
    buffer = buffer_of(kind, 16, 2)
    for transition in stream(2, 8, marks, key):
        buffer.add(*transition)
    good = {row * 2 + i for row in range(8) for i in range(2) if (row, i) not in marks}
    np.random.seed(0)
    drawn, counts = np.unique(buffer.sample(110_000).rewards.numpy().astype(int), return_counts=True)
    assert set(drawn) == good
    # 10 000 each, with a standard deviation of 95
    assert np.abs(counts - 10_000).max() < 500
    copy = pickle.loads(pickle.dumps(buffer))
    assert np.array_equal(copy.marked, buffer.marked)
    assert not np.any(buffer.rewards[buffer.marked]) and not np.any(buffer.actions[buffer.marked])


@pytest.mark.parametrize("kind", [FrameStackReplayBuffer, SkippingReplayBuffer])
def test_a_mark_is_gone_with_its_transition(kind: type[ReplayBuffer]) -> None:
    buffer = buffer_of(kind, 8, 2)
    for transition in stream(2, 4 + 3, {(2, 0), (6, 1)}, "env_fault"):  # row 2 is overwritten by row 6
        buffer.add(*transition)
    assert np.argwhere(buffer.marked).tolist() == [[2, 1]]


def test_skipping_changes_nothing_where_nothing_is_marked() -> None:
    batches = []
    for kind in (ReplayBuffer, SkippingReplayBuffer, FrameStackReplayBuffer):
        buffer = buffer_of(kind, 20, 2)
        for transition in stream(2, 14, set(), "env_fault"):
            buffer.add(*transition)
        np.random.seed(0)
        batches.append([tuple(buffer.sample(64)) for _ in range(3)])
    assert differences(batches[0], batches[1]) == differences(batches[0], batches[2]) == []


# ------------------------------------------------------------------------------------------ the vectorised environment


def test_without_faults_it_is_sb3s() -> None:
    runs = []
    for kind in (SubprocVecEnv, FaultTolerantSubprocVecEnv):
        env = kind([partial(breakable_box, episode_length=4)] * 2, start_method="fork")
        env.seed(3)
        env.set_options({"some": "option"})
        seen = [env.reset(), list(env.reset_infos)]
        rng = np.random.default_rng(0)
        seen += [env.step(rng.uniform(-1, 1, (2, 2)).astype(np.float32)) for _ in range(10)]
        env.set_attr("some", 5, indices=[1])
        seen += [env.get_attr("some", 1), env.has_attr("some"), env.has_attr("frame_stack")]
        seen += [env.env_is_wrapped(Breakable), env.get_attr("position"), env.reset(), env.render_mode]
        env.close()
        env.close()
        runs.append(seen)
    assert differences(runs[0], runs[1]) == []


ASKED = {
    "get_attr": lambda env: env.get_attr("frame_stack"),
    "set_attr": lambda env: env.set_attr("some", 1),
    "has_attr": lambda env: env.has_attr("frame_stack"),
    "env_method": lambda env: env.env_method("get_wrapper_attr", "frame_stack"),
    "env_is_wrapped": lambda env: env.env_is_wrapped(Monitor),
    "get_images": lambda env: env.get_images(),
    "reset": lambda env: env.reset(),
}


class Picture(PixelBox):
    render_mode = "rgb_array"

    def render(self) -> np.ndarray:
        return self.frames[-1].transpose(1, 2, 0)


@pytest.mark.parametrize("name", list(ASKED))
def test_whatever_is_asked_of_a_dead_worker_is_answered(name: str) -> None:
    with_fault = made([Picture, Picture])
    with_fault.reset()
    os.kill(with_fault.processes[1].pid, signal.SIGKILL)
    answers = ASKED[name](with_fault)
    assert answers is None or len(np.atleast_1d(answers)) in (1, 2)
    assert with_fault.restarts == [0, 1]
    # The episode was lost between two steps: the next one says so, unless all begin anew
    before = with_fault.get_attr("position")
    _, rewards, dones, infos = with_fault.step(np.ones((2, 2), np.float32))
    assert ("env_fault" in infos[1], bool(dones[1])) == (name != "reset", name != "reset")
    if name != "reset":
        assert np.array_equal(with_fault.get_attr("position")[1], before[1]) and rewards[1] == 0
    assert "env_fault" not in infos[0] and not np.array_equal(with_fault.get_attr("position")[0], before[0])
    assert not any("env_fault" in info for info in with_fault.step(still(with_fault))[3])
    with_fault.close()

    env = made([Picture, Picture], "raise")
    env.reset()
    os.kill(env.processes[1].pid, signal.SIGKILL)
    with pytest.raises(EnvFaultError, match="Environment 1 is lost, as its process was killed by SIGKILL during"):
        ASKED[name](env)
    env.close()


def test_a_call_that_fails_is_the_callers_and_costs_no_episode() -> None:
    env = made([breakable_box, breakable_box])
    env.reset()
    with pytest.raises(AttributeError, match=r"Environment 0 raised AttributeError.*'nothing'.* in get_attr"):
        env.get_attr("nothing")
    with pytest.raises(EnvFaultError, match=r"Environment 0 raised TypeError.* in env_method") as caught:
        env.env_method("break_down")
    assert "break_down" in caught.value.__notes__[0]
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    # The answers of environment 1 to these are not taken for what is asked next
    assert env.get_attr("frame_stack") == [2, 2]
    assert not any("env_fault" in info for info in env.step(still(env))[3])
    assert env.restarts == [0, 0]
    env.close()


class Remembers(PixelBox):
    """Tells what it was made and reset with."""

    difficulty = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.told = (seed, options)
        return super().reset(seed=seed, options=options)


def test_a_new_worker_gets_what_the_old_one_had() -> None:
    runs = []
    for _ in range(2):
        env = made([Remembers, Remembers])
        env.set_attr("difficulty", 3, indices=1)
        env.seed(5)
        env.set_options([{}, {"level": 2}])
        first = env.reset()
        os.kill(env.processes[1].pid, signal.SIGKILL)
        obs = env.step(still(env))[0]
        assert env.get_attr("difficulty") == [0, 3]
        (_, nothing), (seed, options) = env.get_attr("told")
        assert options == {"level": 2} and nothing is None
        assert seed not in (None, 5, 6) and not np.array_equal(obs[1], first[1])
        runs.append((seed, obs[1]))
        env.close()
    assert differences(runs[0], runs[1]) == []


def test_restarts_leave_no_process_and_no_file_descriptor() -> None:
    me = psutil.Process()
    before, children = me.num_fds(), set(me.children())
    env = made([breakable_box, breakable_box], timeout=4, state=position, frozen_steps=10)
    env.reset()
    held = (me.num_fds(), len(set(me.children()) - children))
    assert held[1] == 2
    for kind in SAID:
        env.env_method("break_down", kind, indices=0)
        step_until_fault(env)
        env.step(still(env))
        assert (me.num_fds(), len(set(me.children()) - children)) == held, kind
    # A worker that hangs when it is closed does not outlive that either
    env.env_method("break_down", "hang", indices=1)
    env.step_async(still(env))
    env.close()
    assert (me.num_fds(), set(me.children()) - children) == (before, set())


def test_workers_leave_when_the_parent_is_killed() -> None:
    reader, writer = os.pipe()
    parent = os.fork()
    if parent == 0:
        env = made([VectorBox, VectorBox, VectorBox])
        # One that hangs must not keep the others alive
        os.kill(env.processes[2].pid, signal.SIGSTOP)
        os.write(writer, " ".join(str(process.pid) for process in env.processes).encode())
        os.kill(os.getpid(), signal.SIGKILL)
    workers = [psutil.Process(int(pid)) for pid in os.read(reader, 100).decode().split()]
    os.waitpid(parent, 0)
    os.close(reader)
    os.close(writer)
    _, alive = psutil.wait_procs(workers[:2], timeout=30)
    workers[2].kill()
    assert all(process.status() == psutil.STATUS_ZOMBIE for process in alive)


def job(start_method: str, tell: int) -> None:
    """Survives a SIGTERM to all its processes, as its own handler wishes, then is killed with one worker in a hang."""
    os.setsid()
    signal.signal(signal.SIGTERM, lambda *_: None)
    get_context("forkserver").set_forkserver_preload([__name__])
    try:
        env = FaultTolerantSubprocVecEnv([breakable_box] * 2, start_method=start_method, start_timeout=600)
        env.reset()
        os.killpg(0, signal.SIGTERM)
        for _ in range(100):
            env.step(still(env))
        env.env_method("break_down", "hang", indices=1)
        env.step_async(still(env))
        os.write(tell, " ".join(str(process.pid) for process in env.processes).encode())
    except BaseException as error:
        os.write(tell, str(error).encode())
    os.kill(os.getpid(), signal.SIGKILL)


def run_jobs(start_methods: list[str]) -> list[tuple[str, list[str]]]:
    """What each told, and how those of its processes do that did not end."""
    readers = []
    for start_method in start_methods:
        reader, writer = os.pipe()
        if os.fork() == 0:
            job(start_method, writer)
        os.close(writer)
        readers.append(reader)
    told = []
    for reader in readers:
        told.append(os.read(reader, 1000).decode())
        os.close(reader)
    results = []
    for text in told:
        pids = [int(word) for word in text.split() if word.isdigit()]
        _, alive = psutil.wait_procs([psutil.Process(pid) for pid in pids if psutil.pid_exists(pid)], timeout=60)
        results.append((text, [process.status() for process in alive if process.status() != psutil.STATUS_ZOMBIE]))
    return results


def test_a_sigterm_to_all_is_the_parents_and_its_death_ends_all(fresh: ProcessPoolExecutor) -> None:
    for told, alive in fresh.submit(run_jobs, ["fork", "forkserver"]).result():
        assert re.fullmatch(r"\d+ \d+", told), told
        assert alive == []


forgotten: list[VecEnv] = []


def forget_to_close() -> None:
    env = made([breakable_box] * 2)
    forgotten.append(env)
    env.reset()
    env.env_method("break_down", "hang", indices=1)
    env.step_async(still(env))


def test_a_program_ends_that_forgot_to_close_its_environments() -> None:
    program = get_context("fork").Process(target=forget_to_close)
    program.start()
    program.join(60)
    code = program.exitcode
    program.kill()
    assert code == 0


def resumable(**kwargs: Any) -> Any:
    box = partial(Remembers, size=12, episode_length=9)
    return made([lambda: Breakable(box())] * 2, state=position, frozen_steps=20, max_faults=4, **kwargs)


@pytest.mark.parametrize("found_in_saving", [False, True])
def test_resumed_environments_go_on_as_the_others_bit_for_bit(found_in_saving: bool) -> None:
    whole, resumed = resumable(), resumable()
    whole.set_attr("difficulty", 3, indices=1)
    whole.seed(5)
    whole.set_options([{}, {"level": 2}])
    whole.reset()

    def follow(env: Any, steps: int) -> list[Any]:
        return [env.step(np.full_like(still(env), 0.5 if k % 2 else -0.5)) for k in range(steps)]

    def kill(env: Any) -> None:
        os.kill(env.processes[1].pid, signal.SIGKILL)

    kill(whole)
    follow(whole, 2)
    whole.env_method("break_down", "frozen", indices=0)
    follow(whole, 4)  # two more, and it is a fault
    if found_in_saving:
        kill(whole)
    state = vec_env_state(whole)
    assert state is not None and is_plain(state)
    assert whole.restarts == [0, 1 + found_in_saving]
    load_vec_env_state(resumed, state)
    assert differences(vec_env_state(resumed), state) == []
    runs = []
    for env in (whole, resumed):
        seen: list[Any] = follow(env, 4)
        kill(env)
        seen += follow(env, 12)
        runs.append([seen, env.get_attr("difficulty"), env.get_attr("told", 1), env.restarts])
        env.close()
    assert differences(*runs) == []
    faults = [info.get("env_fault_steps") for _, _, _, infos in runs[0][0] for info in infos if "env_fault" in info]
    assert sorted(faults) == [1] * (1 + found_in_saving) + [5]


def test_a_resumed_worker_is_no_new_one() -> None:
    env = resumable(timeout=2, start_timeout=20)
    env.reset()
    state = vec_env_state(env)
    env.close()
    env = resumable(timeout=2, start_timeout=20)
    load_vec_env_state(env, state)
    env.step(still(env))
    env.env_method("break_down", "hang", indices=0)
    (info, _) = env.step(still(env))[3]
    env.close()
    assert "did not answer step within timeout=2 s" in info["env_fault"]


def test_what_was_set_and_cannot_be_saved_is_said() -> None:
    env = made([breakable_box])
    env.set_attr("tool", partial(print))
    env.reset()
    assert vec_env_state(env) is None
    assert "was given tool of type partial" in str(why_not_restorable(env))
    env.close()


class Hopeless(VectorBox):
    def step(self, action: np.ndarray) -> Any:
        raise ValueError("always")


def test_an_environment_that_fails_each_time_is_given_up() -> None:
    env = made([VectorBox, Hopeless], max_faults=2)
    env.reset()
    for _ in range(2):
        assert "env_fault" in env.step(still(env))[3][1]
    with pytest.raises(
        EnvFaultError, match=r"Environment 1 failed 3 times without a good step .*ValueError\('always'\)"
    ):
        env.step(still(env))
    env.close()


def test_closed_environments_are_not_started_again() -> None:
    env = made([VectorBox])
    env.reset()
    env.close()
    for call in (env.reset, partial(env.step, still(env)), partial(env.get_attr, "position")):
        with pytest.raises(EnvFaultError, match="Environment 0 has been closed: make the environments anew"):
            call()
    assert env.restarts == [0]


def cannot_be_made() -> gym.Env:
    raise FileNotFoundError("no model file")


def test_an_environment_that_cannot_be_made_leaves_no_other_behind() -> None:
    children = set(psutil.Process().children())
    with pytest.raises(EnvFaultError, match=r"Environment 1 raised FileNotFoundError.* when it was made") as caught:
        made([VectorBox, cannot_be_made])
    assert "in cannot_be_made" in caught.value.__notes__[0]
    assert set(psutil.Process().children()) <= children


def test_what_is_no_fault_of_a_picture() -> None:
    """Dark frames where they are allowed; the same pixels at rest, without a state, or for a short time."""
    cases: list[tuple[str, dict[str, Any], float]] = [
        ("black", {"allow_black_frames": True}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 8}, 0.0),
        ("frozen", {"state": position, "frozen_steps": 8, "frozen_motion": 0.4}, 0.5),
        ("frozen", {"state": position, "frozen_steps": None}, 0.5),
        ("frozen", {"frozen_steps": 8}, 0.5),
        ("frozen", {"state": position, "frozen_steps": 64}, 0.5),
    ]
    for kind, arguments, speed in cases:
        env = made([breakable_box], "raise", **arguments)
        env.seed(1)
        env.reset()
        env.env_method("break_down", kind)
        for k in range(12):
            env.step(still(env) + (speed if k % 2 else -speed))
        env.close()


def test_stuck_pixels_are_noticed_across_short_episodes() -> None:
    env = made([partial(breakable_box, episode_length=2)], state=position, frozen_steps=20)
    env.seed(0)
    env.reset()
    env.env_method("break_down", "frozen")
    infos: list[dict[str, Any]] = [{}]
    n_steps = 0
    while "env_fault" not in infos[0]:
        infos = env.step(np.full_like(still(env), -1 if n_steps % 2 else 1))[3]  # more than a pixel
        n_steps += 1
    assert "the same pixels" in infos[0]["env_fault"] and n_steps < 20
    # All but the first, whose picture is a new one; what resets returned is no step
    assert infos[0]["env_fault_steps"] == n_steps - 1
    env.close()


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        ({"env_fns": []}, "env_fns is empty.*: pass one function for each"),
        ({"timeout": 0}, "timeout=0 is not a number greater than 0: use timeout=60"),
        ({"timeout": "60"}, "timeout='60' is not a number"),
        ({"timeout": float("nan")}, "timeout=nan is not a number greater than 0"),
        ({"start_timeout": -1}, "start_timeout=-1 is not a number greater than 0"),
        ({"max_faults": True}, "max_faults=True is not a number greater than 0"),
        ({"frozen_steps": 0}, "frozen_steps=0 is not a number greater than 0"),
        ({"frozen_motion": 0}, "frozen_motion=0 is not a number greater than 0"),
        ({"on_env_fault": "ignore"}, "on_env_fault='ignore' is unknown: use 'raise', or 'restart'"),
        ({"start_method": "thread"}, "start_method='thread' is unknown: use one of .*fork"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        FaultTolerantSubprocVecEnv(**{"env_fns": [VectorBox], **arguments})


# ------------------------------------------------------------------------------------------------------- algorithms


class KillNow(BaseCallback):
    """Kills the worker of environment 1 at some steps."""

    def __init__(self, *at: int) -> None:
        super().__init__()
        self.at, self.faults = at, 0

    def _on_step(self) -> bool:
        self.faults += sum("env_fault" in info for info in self.locals["infos"])
        if self.n_calls in self.at:
            os.kill(self.training_env.unwrapped.processes[1].pid, signal.SIGKILL)
        return True


def test_plain_algorithms_go_on() -> None:
    env = made([partial(VectorBox, episode_length=6)] * 2)
    network = {"net_arch": [8]}
    models = [
        PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, policy_kwargs=network, device="cpu"),
        SAC(
            "MlpPolicy",
            env,
            learning_starts=4,
            replay_buffer_class=SkippingReplayBuffer,
            policy_kwargs=network,
            device="cpu",
        ),
        tiny_model("MlpPolicy", env),
        tiny_model("MlpPolicy", env, srl=None, curiosity=None),
    ]
    for model in models:
        callback = KillNow(3, 12)
        model.learn(40, callback=callback)
        assert callback.faults == 2 and model.num_timesteps >= 40
        if not isinstance(model, PPO):
            assert type(model.replay_buffer) is SkippingReplayBuffer
            assert np.argwhere(model.replay_buffer.marked).tolist() == [[3, 1], [12, 1]]
    env.close()


def test_statistics_of_episodes(tmp_path: Path) -> None:
    """Of the episode with the fault there are none, and those of the ones before stay in the file."""
    env = make_vec_env(
        partial(PixelBox, episode_length=5, size=12),
        2,
        seed=0,
        monitor_dir=str(tmp_path),
        vec_env_cls=FaultTolerantSubprocVecEnv,
        vec_env_kwargs=dict(timeout=60, on_env_fault="restart", start_method="fork"),
    )
    model = tiny_model("CnnPolicy", env, overlap=True)
    model.learn(2 * 20, callback=KillNow(7))
    env.close()
    # Environment 1: 5 steps, 2 and the fault, then 12 more
    assert [info["l"] for info in model.ep_info_buffer] == [5] * 7
    rows = (tmp_path / "1.monitor.csv").read_text().splitlines()[2:]
    assert [int(row.split(",")[1]) for row in rows] == [5] * 3


def test_a_restart_is_told_with_the_traceback_of_the_worker() -> None:
    env = made([breakable_box])
    env.reset()
    env.env_method("break_down", "raise")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env.step(still(env))
    env.close()
    (told,) = [str(warning.message) for warning in caught if warning.category is RuntimeWarning]
    assert re.match(r"Environment 0 raised RuntimeError\('lens broken'\).* This is restart 1.\nTraceback", told)


class OtherShape(VectorBox):
    """Its twelfth observation has three numbers."""

    frame_stack, action_repeat = "of three", None  # names that may mean something else
    n_all = 0

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, *rest = super().step(action)
        self.n_all += 1
        return np.zeros(3, np.float32) if self.n_all == 12 else observation, *rest


def test_an_observation_of_another_shape_is_a_fault() -> None:
    """As of a camera that changes its resolution; attributes of the environment are taken for what they are."""
    venv = FaultTolerantSubprocVecEnv([OtherShape] * 2, on_env_fault="restart")
    try:
        with pytest.warns(RuntimeWarning, match=r"observation of shape \(3,\), but its space is of shape \(2,\)"):
            tiny_model("MlpPolicy", venv).learn(40)
        assert sum(venv.restarts) >= 2
    finally:
        venv.close()


def test_a_buffer_that_cannot_leave_out_what_a_fault_spoils_is_warned_of() -> None:
    """When training begins, not at the first fault."""
    venv = FaultTolerantSubprocVecEnv([VectorBox], on_env_fault="restart")
    try:
        with pytest.warns(UserWarning, match=r"on_env_fault='restart' leaves .*NStepReplayBuffer cannot"):
            tiny_model("MlpPolicy", venv, curiosity=None, n_steps=3).learn(2)
    finally:
        venv.close()
