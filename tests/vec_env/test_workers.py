"""Workers that fail: each fault is noticed and named, training goes on, other environments stay as they were."""

import os
import pickle
import re
import signal
import time
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
from envs_for_tests import KillNow, PixelBox, VectorBox, differences, tiny_model
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_cure import make_dmc_env
from sb3_cure.persistence.env_state import load_vec_env_state, vec_env_state
from sb3_cure.vec_env import EnvFaultError, FaultTolerantSubprocVecEnv, workers

#: What the sentence says of each kind of fault
SAID = {
    "raise": r"raised RuntimeError\('lens broken'\)",
    "die": "was killed by SIGKILL",
    "hang": r"did not answer within timeout=\d",
    "black": "returned a black frame",
    "frozen": r"returned the same pixels in \d steps while its physics moved",
}
RESTARTED = [kind for kind in SAID if kind != "frozen"]

pytestmark = pytest.mark.filterwarnings("ignore:Environment [0-9]+ :RuntimeWarning", "ignore:.*fork:DeprecationWarning")


class Breakable(gym.Wrapper):
    """Works until ``env_method("break_down", kind)``."""

    kind: str | None = None
    frozen: np.ndarray | None = None

    def break_down(self, kind: str) -> None:
        self.kind = kind

    def get_kind(self) -> str | None:
        return self.kind

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
    return Breakable(Monitor(make_dmc_env("cartpole", "swingup", image_size=24, renderer="fast")))


def breakable_box(**kwargs: Any) -> gym.Env:
    return Breakable(PixelBox(size=12, **kwargs))


def position(env: gym.Env) -> np.ndarray:
    return env.unwrapped.position


def make(env_fns: list[Callable[[], gym.Env]], on_env_fault: str = "restart", **kwargs: Any) -> Any:
    """Forked workers: quick, and right where the parent has made no OpenGL context."""
    return FaultTolerantSubprocVecEnv(env_fns, on_env_fault=on_env_fault, start_method="fork", **kwargs)


def step(env: VecEnv, value: float = 0.0) -> Any:
    return env.step(np.full((env.num_envs, *env.action_space.shape), value, np.float32))


def step_until_fault(env: VecEnv) -> Any:
    """Move until a step reports a fault."""
    for k in range(8):
        result = step(env, 0.5 if k % 2 else -0.5)
        if any("env_fault" in info for info in result[3]):
            return result
    raise AssertionError("no fault was reported")


def kill(env: Any, index: int = 1) -> None:
    os.kill(env.processes[index].pid, signal.SIGKILL)


# ------------------------------------------------------------------------------------------- real DeepMind Control


@pytest.fixture(scope="module")
def fresh() -> Iterator[ProcessPoolExecutor]:
    """A process that has rendered nothing, so that it may fork workers which do."""
    with ProcessPoolExecutor(1, mp_context=get_context("forkserver"), initializer=import_dmc) as process:
        yield process


def import_dmc() -> None:
    breakable_dmc().close()


class BreakDown(BaseCallback):
    """Breaks environment 0 in each way, one after the other, and keeps what the steps say."""

    def __init__(self) -> None:
        super().__init__()
        self.left, self.sentences, self.first_observations = list(RESTARTED), [], []

    def _on_step(self) -> bool:
        assert "env_fault" not in self.locals["infos"][1]
        info = self.locals["infos"][0]
        if "env_fault" in info:
            assert self.locals["dones"][0] and self.locals["rewards"][0] == 0 and "episode" not in info
            self.sentences.append(info["env_fault"])
            self.first_observations.append(self.locals["new_obs"][0])
        elif self.left and self.n_calls > 12 and len(self.sentences) == len(RESTARTED) - len(self.left):
            self.training_env.env_method("break_down", self.left.pop(0), indices=0)
        return True


def train_on_breaking_dmc() -> dict[str, Any]:
    env = make([breakable_dmc, breakable_dmc], timeout=4)
    model = tiny_model("CnnPolicy", env, overlap=True)
    breaking = BreakDown()
    model.learn(80, callback=breaking)
    env.close()
    return {
        "sentences": breaking.sentences,
        "first": breaking.first_observations,
        "restarts": env.restarts,
        "steps": model.num_timesteps,
        "stored": model.replay_buffer.pos,
        "children": len(psutil.Process().children()),
    }


def test_training_on_real_pixels_survives_faults(fresh: ProcessPoolExecutor) -> None:
    result = fresh.submit(train_on_breaking_dmc).result()
    for kind, sentence in zip(RESTARTED, result["sentences"], strict=True):
        assert re.match(rf"Environment 0 .*{SAID[kind]}.* in step\.$", sentence), sentence
    assert result["restarts"] == [4, 0] and result["steps"] == 80
    assert result["stored"] == 40 - 4, "a step with a fault is stored for no environment"
    for first in result["first"]:  # of an episode: the stack repeats its first frame
        assert np.array_equal(first[:3], first[3:6]) and np.array_equal(first[:3], first[6:]) and first.any()
    assert result["children"] == 0


@pytest.mark.parametrize("kind", SAID)
@pytest.mark.parametrize("on_env_fault", ["raise", "restart"])
def test_fault_is_named_and_reported(kind: str, on_env_fault: str) -> None:
    """Frozen frames always raise, as transitions before the error are wrong, too."""
    env = make([breakable_box, breakable_box], on_env_fault, timeout=1, state=position, frozen_steps=10)
    env.seed(0)
    env.reset()
    last = step(env)[0]
    env.env_method("break_down", kind, indices=1)
    if on_env_fault == "restart" and kind != "frozen":
        obs, rewards, dones, infos = step_until_fault(env)
        assert re.match(rf"Environment 1 .*{SAID[kind]}", infos[1]["env_fault"]) and "env_fault" not in infos[0]
        assert dones.tolist() == [False, True] and rewards[1] == 0
        assert infos[1]["TimeLimit.truncated"] and np.array_equal(infos[1]["terminal_observation"], last[1])
        assert np.array_equal(obs[1, :3], obs[1, 3:]) and env.restarts == [0, 1]
        assert not any("env_fault" in info for info in step(env)[3])
    else:
        with pytest.raises(EnvFaultError, match=rf"Environment 1 .*{SAID[kind]}") as caught:
            step_until_fault(env)
        notes = "".join(getattr(caught.value, "__notes__", []))
        assert ("lens broken" in notes and "in step" in notes) == (kind == "raise"), "the worker's own traceback"
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
        for call in (partial(step, env), env.reset):  # rather than hang, or answer with what is left of an older step
            with pytest.raises(EnvFaultError, match=re.escape(str(caught.value))):
                call()
    env.close()


class FailingStep(VectorBox):
    """Its second step fails, and its others tell whether they succeed."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, truncated, _ = super().step(action)
        if self.n_steps == 2:
            raise RuntimeError("no power")
        return obs, reward, terminated, truncated, {"is_success": False}


def test_fault_is_survived_where_episodes_are_monitored() -> None:
    """VecMonitor reads its keywords at the end of each episode, as which a fault counts."""
    env = VecMonitor(make([FailingStep]), info_keywords=("is_success",))
    env.reset()
    step(env)
    (info,) = step(env)[3]
    assert "no power" in info["env_fault"] and info["is_success"] is None and info["episode"]["l"] == 2
    env.close()


class FailingReset(VectorBox):
    """Its second reset fails once."""

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
    """In a reset that is asked for, and in that at the end of an episode."""
    env = make([VectorBox, partial(FailingReset, tmp_path / "failed")])
    env.reset()
    infos = [step(env)[3] for _ in range(3 if at_the_end else 1)][-1]
    if at_the_end:
        assert "no start" in infos[1]["env_fault"]
    else:
        assert env.reset().shape == (2, 2)
    assert env.restarts == [0, 1]
    assert not any("env_fault" in info for info in step(env)[3])
    env.close()


def test_restart_leaves_other_environments_as_they_were() -> None:
    runs = []
    for is_killed in (False, True):
        env = make([partial(breakable_box, episode_length=4)] * 2)
        env.seed(3)
        seen = [env.reset()[0]]
        for k in range(10):
            if is_killed and k == 5:
                kill(env)
            obs, rewards, dones, _ = step(env, 0.1)
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
        env.set_attr("kind", "raise", indices=[1])
        seen += [env.get_attr("kind"), env.env_method("get_kind"), env.has_attr("some"), env.has_attr("frame_stack")]
        seen += [env.env_is_wrapped(Breakable), env.get_attr("position"), env.reset(), env.render_mode]
        env.close()
        runs.append(seen)
    assert differences(*runs) == []


class Remembers(PixelBox):
    """Knows what it was made and reset with."""

    difficulty = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.arguments = (seed, options)
        return super().reset(seed=seed, options=options)


def test_new_worker_gets_what_the_old_had() -> None:
    runs = []
    for _ in range(2):
        env = make([Remembers, Remembers])
        env.set_attr("difficulty", 3, indices=1)
        env.seed(5)
        env.set_options([{}, {"level": 2}])
        first = env.reset()
        kill(env)
        obs = step(env)[0]
        assert env.get_attr("difficulty") == [0, 3]
        seed, options = env.get_attr("arguments")[1]
        assert options == {"level": 2} and seed not in (None, 5, 6) and not np.array_equal(obs[1], first[1])
        runs.append((seed, obs[1]))
        env.close()
    assert differences(*runs) == []


def test_interrupted_step_is_not_taken_for_a_reset() -> None:
    env = make([VectorBox, VectorBox])
    env.reset()
    env.step_async(np.ones((2, 2), np.float32))  # Ctrl-C comes before the answers are read
    obs = env.reset()
    assert obs.shape == (2, 2) and env.get_attr("n_steps") == [0, 0]
    env.close()


def test_restarts_leave_no_process_and_no_file_descriptor() -> None:
    me = psutil.Process()
    before, children = me.num_fds(), set(me.children())
    env = make([breakable_box, breakable_box], timeout=1.5)
    env.reset()
    held = (me.num_fds(), len(set(me.children()) - children))
    assert held[1] == 2
    for kind in RESTARTED:
        env.env_method("break_down", kind, indices=0)
        step_until_fault(env)
        step(env)
        assert (me.num_fds(), len(set(me.children()) - children)) == held, kind
    # A worker that hangs when it is closed does not outlive that either.
    env.env_method("break_down", "hang", indices=1)
    env.step_async(np.zeros((2, 2), np.float32))
    env.close()
    assert (me.num_fds(), set(me.children()) - children) == (before, set())


def job(report: int) -> None:
    """Survives a SIGTERM to all its processes, as its own handler wants, and is killed while one worker hangs."""
    os.setsid()
    signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        env = make([breakable_box] * 2)
        env.reset()
        os.killpg(0, signal.SIGTERM)
        for _ in range(50):
            step(env)
        env.env_method("break_down", "hang", indices=1)
        env.step_async(np.zeros((2, 2), np.float32))
        os.write(report, " ".join(str(process.pid) for process in env.processes).encode())
    except BaseException as error:
        os.write(report, str(error).encode())
    os.kill(os.getpid(), signal.SIGKILL)


def test_workers_survive_sigterm_and_leave_with_their_parent() -> None:
    reader, writer = os.pipe()
    parent = os.fork()
    if parent == 0:
        job(writer)
    os.close(writer)
    pids = os.read(reader, 1000).decode()
    os.close(reader)
    os.waitpid(parent, 0)
    assert re.fullmatch(r"\d+ \d+", pids), pids
    _, alive = psutil.wait_procs([psutil.Process(int(p)) for p in pids.split() if psutil.pid_exists(int(p))], 60)
    assert all(process.status() == psutil.STATUS_ZOMBIE for process in alive)


forgotten: list[VecEnv] = []


def forget_to_close() -> None:
    env = make([breakable_box] * 2)
    forgotten.append(env)
    env.reset()
    env.env_method("break_down", "hang", indices=1)
    env.step_async(np.zeros((2, 2), np.float32))


def test_program_ends_with_environments_left_open() -> None:
    program = get_context("fork").Process(target=forget_to_close)
    program.start()
    program.join(60)
    code = program.exitcode
    program.kill()
    assert code == 0


def test_resumed_environments_continue_bit_for_bit() -> None:
    """Faults after it included: their new seeds, attributes and last observations."""
    whole, resumed = (make([partial(Remembers, size=12, episode_length=9)] * 2) for _ in range(2))
    whole.set_attr("difficulty", 3, indices=1)
    whole.seed(5)
    whole.set_options([{}, {"level": 2}])
    whole.reset()
    kill(whole)
    step(whole)
    state = vec_env_state(whole)
    load_vec_env_state(resumed, state)
    assert differences(vec_env_state(resumed), state) == []
    assert resumed.get_attr("difficulty") == [0, 3]
    runs = []
    for env in (whole, resumed):
        kill(env)
        seen: list[Any] = [step(env, 0.2) for _ in range(12)]
        assert "env_fault" in seen[0][3][1]
        runs.append([seen, env.get_attr("difficulty"), env.get_attr("arguments", 1), env.restarts])
        env.close()
    assert differences(*runs) == []


class Hopeless(VectorBox):
    def step(self, action: np.ndarray) -> Any:
        raise ValueError("always")


def test_environment_that_always_fails_is_given_up() -> None:
    env = make([VectorBox, Hopeless], max_faults=2)
    env.reset()
    for _ in range(2):
        assert "env_fault" in step(env)[3][1]
    with pytest.raises(EnvFaultError, match=r"Environment 1 raised ValueError\('always'\)") as caught:
        step(env)
    assert "max_faults=2" in "".join(caught.value.__notes__)
    env.close()


def test_closed_environments_are_not_started_again() -> None:
    env = make([VectorBox])
    env.reset()
    env.close()
    for call in (env.reset, partial(step, env), partial(env.get_attr, "position")):
        with pytest.raises(EnvFaultError, match="Environment 0 has been closed"):
            call()
    assert env.restarts == [0]


class Landing(gym.Wrapper):
    """Notes in a file that it was closed.

    :param env: The environment
    :param note: The file
    """

    def __init__(self, env: gym.Env, note: Path):
        super().__init__(env)
        self.note = note

    def close(self) -> None:
        self.note.touch()
        super().close()


def test_environments_in_a_step_are_closed(tmp_path: Path) -> None:
    """As after Ctrl-C, with an observation that waits to be read, as it is larger than what a connection takes."""
    notes = [tmp_path / "waiting", tmp_path / "idle"]
    env = make([partial(Landing, PixelBox(size=300), note) for note in notes])
    env.reset()
    env.remotes[0].send(("step", np.zeros(2, np.float32)))
    start = time.monotonic()
    env.close()
    assert time.monotonic() - start < workers.CLOSE_SECONDS
    assert all(note.exists() for note in notes)


def cannot_be_made() -> gym.Env:
    raise FileNotFoundError("no model file")


def test_failed_construction_leaves_no_process_behind() -> None:
    children = set(psutil.Process().children())
    with pytest.raises(EnvFaultError, match=r"Environment 1 raised FileNotFoundError.*__main__") as caught:
        make([VectorBox, cannot_be_made])
    assert "in cannot_be_made" in caught.value.__notes__[0]
    assert set(psutil.Process().children()) <= children


def test_unknown_treatment_of_faults_is_refused() -> None:
    with pytest.raises(ValueError, match="on_env_fault must be 'raise' or 'restart', not 'ignore'"):
        FaultTolerantSubprocVecEnv([VectorBox], on_env_fault="ignore")


# ------------------------------------------------------------------------------------------------------- algorithms


def test_algorithms_survive_restarts() -> None:
    """SB3's own store a transition that stands still; ours store nothing of such a step."""
    env = make([partial(VectorBox, episode_length=6)] * 2)
    kwargs: dict[str, Any] = dict(policy_kwargs={"net_arch": [8]}, device="cpu")
    for model in (
        PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, **kwargs),
        SAC("MlpPolicy", env, learning_starts=4, **kwargs),
        tiny_model("MlpPolicy", env),
    ):
        callback = KillNow(3, 12)
        model.learn(40, callback=callback)
        assert callback.faults == 2 and model.num_timesteps >= 40
        if isinstance(model, SAC):
            buffer = model.replay_buffer
            assert buffer.pos == (20 if type(model) is SAC else 18)
            stands = (buffer.observations[: buffer.pos] == buffer.next_observations[: buffer.pos]).all(axis=-1)
            assert stands.sum() == (2 if type(model) is SAC else 0)
    env.close()


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize])
def test_rows_around_a_fault_are_transitions(wrap: Any) -> None:
    """No stored observation is of another episode than its successor, also where what is stored is not what is seen."""
    env = wrap(make([partial(VectorBox, episode_length=6)] * 2))
    buffer: Any = tiny_model("MlpPolicy", env).learn(40, callback=KillNow(3, 12)).replay_buffer
    env.close()
    rows = slice(0, buffer.pos)
    after = np.clip(buffer.observations[rows] + 0.3 * buffer.actions[rows], -1, 1)
    np.testing.assert_allclose(buffer.next_observations[rows], after, atol=1e-6)


class Still(VectorBox):
    """Observations tell no step from another, nor an end from a beginning."""

    def observe(self, first: bool = False) -> np.ndarray:
        return np.zeros(2, np.float32)


def test_stored_stream_breaks_at_a_fault_that_observations_do_not_show() -> None:
    """Else returns of several steps would add up rewards across it."""
    env = make([Still] * 2)
    buffer: Any = tiny_model("MlpPolicy", env).learn(20, callback=KillNow(3)).replay_buffer
    env.close()
    assert np.flatnonzero(buffer.starts[: buffer.pos].any(axis=1)).tolist() == [0, 3]


def test_monitor_keeps_episodes_before_a_fault(tmp_path: Path) -> None:
    env = make_vec_env(
        partial(PixelBox, episode_length=5, size=12),
        2,
        monitor_dir=str(tmp_path),
        vec_env_cls=FaultTolerantSubprocVecEnv,
        vec_env_kwargs=dict(on_env_fault="restart", start_method="fork"),
    )
    model = tiny_model("CnnPolicy", env, overlap=True)
    model.learn(2 * 20, callback=KillNow(7))
    env.close()
    # Environment 1: 5 steps, 2 and the fault, then 12 more
    assert [info["l"] for info in model.ep_info_buffer] == [5] * 7
    rows = (tmp_path / "1.monitor.csv").read_text().splitlines()[2:]
    assert [int(row.split(",")[1]) for row in rows] == [5] * 3


def test_restart_warns_with_the_workers_traceback() -> None:
    env = make([breakable_box])
    env.reset()
    env.env_method("break_down", "raise")
    with pytest.warns(RuntimeWarning, match=r"(?s)Environment 0 raised .*Restart 1 of its worker.*Traceback.*in step"):
        step(env)
    env.close()
