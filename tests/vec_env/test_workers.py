"""Workers that fail: each kind of fault is noticed and told, training goes on, other environments are as they were."""

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
from envs_for_tests import KillNow, PixelBox, VectorBox, differences, tiny_model
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_cure import make_dmc_env
from sb3_cure.data import buffers
from sb3_cure.data.buffers import SkippingReplayBuffer
from sb3_cure.persistence.env_state import load_vec_env_state, restore_error, vec_env_state
from sb3_cure.vec_env import EnvFaultError, FaultTolerantSubprocVecEnv

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


def train_on_breaking_dmc() -> dict[str, Any]:
    env = made([breakable_dmc, breakable_dmc], timeout=4, frozen_steps=10)
    model = tiny_model("CnnPolicy", env, overlap=True)
    sampled, original = [], buffers.transitions

    def spy(buffer: Any, rows: np.ndarray, env_inds: np.ndarray, *rest: Any) -> Any:
        sampled.append(buffer.marked[rows, env_inds].any())
        return original(buffer, rows, env_inds, *rest)

    buffers.transitions = spy
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


def test_training_on_real_pixels_survives_every_fault(fresh: ProcessPoolExecutor) -> None:
    result = fresh.submit(train_on_breaking_dmc).result()
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


@pytest.mark.parametrize("kind", list(SAID))
def test_fault_stops_with_its_sentence(kind: str) -> None:
    env = made([breakable_box, breakable_box], "raise", timeout=1, state=position, frozen_steps=10)
    env.seed(0)
    env.reset()
    env.env_method("break_down", kind, indices=1)
    with pytest.raises(EnvFaultError) as caught:
        step_until_fault(env)
    told, notes = str(caught.value), getattr(caught.value, "__notes__", [])
    assert re.match(rf"Environment 1 .*{SAID[kind]}.*: pass on_env_fault='restart'", told), told
    # The traceback is the worker's own
    assert ("lens broken" in "".join(notes) and "in step" in notes[0]) == (kind == "raise")
    # It stays failed, rather than hang or answer with what is left of an older step
    for call in (partial(env.step, still(env)), env.reset):
        with pytest.raises(EnvFaultError, match=re.escape(told)):
            call()
    env.close()


class FailingReset(VectorBox):
    """Its first reset is all right, and the second one fails; in the worker after that, all are all right."""

    def __init__(self, flag: Path) -> None:
        super().__init__(episode_length=3)
        self.flag, self.n_resets = flag, 0

    def reset(self, **kwargs: Any) -> Any:
        self.n_resets += 1
        if self.n_resets == 2 and not self.flag.exists():
            self.flag.touch()
            raise RuntimeError("no start")
        return super().reset(**kwargs)


@pytest.mark.parametrize("at_the_end", [False, True])
def test_fault_during_reset_is_survived(at_the_end: bool, tmp_path: Path) -> None:
    """In a reset that was asked for, and in that at the end of an episode."""
    env = made([VectorBox, partial(FailingReset, tmp_path / "failed")])
    env.reset()
    dones = [env.step(still(env))[2:] for _ in range(3 if at_the_end else 1)][-1]
    if at_the_end:
        assert "raised RuntimeError('no start') in step" in dones[1][1]["env_fault"]
    else:
        assert env.reset().shape == (2, 2)
    assert env.restarts == [0, 1]
    assert not any("env_fault" in info for info in env.step(still(env))[3])
    env.close()


def test_restart_leaves_other_environments_as_they_were() -> None:
    """Their streams are those of a run without the fault."""
    runs = []
    for kill in (False, True):
        env = made([partial(breakable_box, episode_length=4)] * 2)
        env.seed(3)
        seen = [env.reset()[0]]
        for k in range(10):
            if kill and k == 5:
                os.kill(env.processes[1].pid, signal.SIGKILL)
            obs, rewards, dones, _ = env.step(still(env) + 0.1)
            seen.append((obs[0], rewards[0], dones[0]))
        runs.append(seen)
        env.close()
    assert differences(*runs) == []


# ------------------------------------------------------------------------------------------ the vectorised environment


def test_without_faults_it_equals_sb3s() -> None:
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
def test_dead_worker_answers_whatever_is_asked(name: str) -> None:
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


def test_failing_call_costs_no_episode() -> None:
    env = made([breakable_box, breakable_box])
    env.reset()
    with pytest.raises(EnvFaultError, match=r"Environment 0 raised AttributeError.*'nothing'.* in get_attr"):
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


def test_new_worker_gets_what_the_old_had() -> None:
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
    env = made([breakable_box, breakable_box], timeout=1.5, state=position, frozen_steps=10)
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


def test_sigterm_to_all_is_left_to_the_parent(fresh: ProcessPoolExecutor) -> None:
    for told, alive in fresh.submit(run_jobs, ["forkserver"]).result():
        assert re.fullmatch(r"\d+ \d+", told), told
        assert alive == []


forgotten: list[VecEnv] = []


def forget_to_close() -> None:
    env = made([breakable_box] * 2)
    forgotten.append(env)
    env.reset()
    env.env_method("break_down", "hang", indices=1)
    env.step_async(still(env))


def test_program_ends_with_environments_left_open() -> None:
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
def test_resumed_environments_go_on_bit_for_bit(found_in_saving: bool) -> None:
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
    assert restore_error(whole) is None
    state = vec_env_state(whole)
    assert whole.restarts == [0, 1 + found_in_saving]
    load_vec_env_state(resumed, state)
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


def test_resumed_worker_has_the_short_timeout() -> None:
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


def test_attributes_that_cannot_be_saved_are_named() -> None:
    env = made([breakable_box])
    env.set_attr("tool", partial(print))
    env.reset()
    assert "FaultTolerantSubprocVecEnv.state_dict()" in str(restore_error(env))
    env.close()


class Hopeless(VectorBox):
    def step(self, action: np.ndarray) -> Any:
        raise ValueError("always")


def test_environment_that_always_fails_is_given_up() -> None:
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


def test_failed_construction_leaves_no_process_behind() -> None:
    children = set(psutil.Process().children())
    with pytest.raises(EnvFaultError, match=r"Environment 1 raised FileNotFoundError.* when it was made") as caught:
        made([VectorBox, cannot_be_made])
    assert str(caught.value).endswith(
        "mend what makes it; a script that starts workers needs `if __name__ == '__main__':`."
    )
    assert "in cannot_be_made" in caught.value.__notes__[0]
    assert set(psutil.Process().children()) <= children


def test_unknown_way_to_treat_faults_is_refused() -> None:
    with pytest.raises(ValueError, match="on_env_fault='ignore' is unknown: use 'raise', or 'restart'"):
        FaultTolerantSubprocVecEnv([VectorBox], on_env_fault="ignore")


# ------------------------------------------------------------------------------------------------------- algorithms


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


def test_restart_is_told_with_the_workers_traceback() -> None:
    env = made([breakable_box])
    env.reset()
    env.env_method("break_down", "raise")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env.step(still(env))
    env.close()
    (told,) = [str(warning.message) for warning in caught if warning.category is RuntimeWarning]
    assert re.match(r"Environment 0 raised RuntimeError\('lens broken'\).* This is restart 1.\nTraceback", told)
