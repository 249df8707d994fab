"""A training that is killed and resumed equals one that was never killed, bit for bit; no fault costs a checkpoint."""

import collections
import contextlib
import csv
import hashlib
import itertools
import multiprocessing
import os
import pickle
import random
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal, SensorBox
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium.wrappers import NormalizeObservation, NormalizeReward
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from benchmarks import faults
from benchmarks.fuzz import watching
from sb3_cure import CuReSAC, CuReTQC, make_dmc_env
from sb3_cure.data.buffers import transitions
from sb3_cure.evaluation.callbacks import EvalBothCallback, PeriodicCallback
from sb3_cure.persistence import ArchiveError, CheckpointError, ExactCheckpoint, Persistence, read_state
from sb3_cure.persistence.generations import Generations
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill of the process, unlike a loss of power, does not need it."""
    for module in ("files", "generations", "checkpoints"):
        monkeypatch.setattr(f"sb3_cure.persistence.{module}.flush_to_disk", lambda path: None)


@dataclass
class Case:
    """A training: how it is set up and how long it is."""

    make_env: Callable[[], Any]
    arguments: dict[str, Any] = field(default_factory=dict)
    policy: str = "CnnPolicy"
    algorithm: type[CuReSAC | CuReTQC] = CuReSAC
    steps: int = 60
    save_freq: int = 12
    pretrain: int = 0
    frames_on_disk: bool = False


def pixels(n_envs: int = 1, **kwargs: Any) -> Callable[[], VecEnv]:
    return lambda: make_vec_env(PixelBox, n_envs, env_kwargs={"episode_length": 7, **kwargs})


def vectors() -> VecEnv:
    return make_vec_env(VectorBox, 1, env_kwargs={"episode_length": 7})


def normalized_rewards() -> VecEnv:
    return VecNormalize(pixels()(), norm_obs=False)


def cartpole() -> Any:
    return make_dmc_env("cartpole", "swingup", image_size=24, renderer="fast")


def in_workers() -> VecEnv:
    return SubprocVecEnv([lambda: Monitor(PixelBox(episode_length=7))] * 2, start_method="fork")


def in_watched_workers() -> VecEnv:
    environments = [lambda: Monitor(PixelBox(episode_length=7))] * 2
    return FaultTolerantSubprocVecEnv(environments, on_env_fault="restart", start_method="fork")


class Flawed(VectorBox):
    """Every fifth observation is not a number."""

    def step(self, action: np.ndarray) -> Any:
        observation, *rest = super().step(action)
        return observation * (np.nan if self.n_steps % 5 == 0 else 1), *rest


CASES = {
    "rae, joint": Case(pixels()),
    "curl, sequential": Case(
        pixels(),
        {"srl": "curl", "augmentation": "crop", "augmentation_kwargs": {"size": 32}, "update": "sequential"},
    ),
    "vae": Case(pixels(), {"srl": "vae"}),
    "spr": Case(pixels(), {"srl": "spr"}, algorithm=CuReTQC),
    "forward, vectors": Case(vectors, {"srl": "forward"}, policy="MlpPolicy"),
    "inverse, sequential": Case(pixels(), {"srl": "inverse", "update": "sequential"}),
    "four environments, small ring": Case(pixels(4), {"buffer_size": 60}, steps=120),
    "frames on disk, small ring": Case(pixels(), {"buffer_size": 25}, frames_on_disk=True),
    "vectors": Case(vectors, policy="MlpPolicy"),
    "schedules, noise, alternating": Case(
        pixels(),
        {
            "learning_rate": LinearSchedule(1e-3, 1e-4, 1.0),
            "curiosity_prob": LinearSchedule(0.9, 0.1, 1.0),
            "action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2)),
            "srl_schedule": "alternating",
            "srl_period": 5,
        },
    ),
    "bouts": Case(pixels(2), {"curiosity_prob": 0.5, "curiosity_bout": 6}),
    "normalized rewards": Case(normalized_rewards, {"curiosity": "bonus"}),
    "plain SAC": Case(pixels(), {"srl": None, "curiosity": None}),
    "pretraining": Case(pixels(), {"curiosity": None}, pretrain=25),
    "quantile critics": Case(pixels(), {"update": "sequential"}, algorithm=CuReTQC),
    "workers": Case(in_workers),
    # More than is promised: a checkpoint out of turn, at a signal, makes its updates earlier. Those in turn do always.
    "overlapped updates": Case(in_workers, {"overlap": True}),
    "watched workers": Case(in_watched_workers),
    "dictionaries, small rings": Case(
        lambda: make_vec_env(SensorBox, 2, env_kwargs={"episode_length": 7}),
        {"buffer_size": 40, "srl": "curl", "intrinsic": "reconstruction", "intrinsic_kwargs": {"n_layers": 2}},
        policy="MultiInputPolicy",
        steps=80,
    ),
    "dictionaries without images": Case(lambda: make_vec_env(Goal, 1), policy="MultiInputPolicy"),
    # Checkpoints are taken after 10, 20, ... steps: episodes of 10 steps, so right after a bad observation, too.
    "bad transitions": Case(
        lambda: make_vec_env(Flawed, 1, env_kwargs={"episode_length": 10}),
        {"on_bad_transition": "skip"},
        policy="MlpPolicy",
        save_freq=5,
    ),
}


def train(case: Case, folder: Path, resume: bool = False, *callbacks: BaseCallback) -> CuReSAC:
    """The script of a user, which is started again with ``resume=True``."""
    env = case.make_env()
    checkpoints = ExactCheckpoint(case.save_freq, folder / "checkpoints")
    if resume:
        model = case.algorithm.resume(folder / "checkpoints", env, device="cpu")
    else:
        on_disk = {"replay_buffer_kwargs": {"frames_dir": folder / "frames"}} if case.frames_on_disk else {}
        model = tiny_model(case.policy, env, case.algorithm, **case.arguments, **on_disk)
    model.set_logger(configure(str(folder / "logs"), ["csv"]))
    try:
        if case.pretrain > 0:
            model.pretrain(case.pretrain, callback=[checkpoints, *callbacks], log_interval=1)
        model.learn(case.steps, callback=[checkpoints, *callbacks], log_interval=1)
    finally:
        model.env.close()
    return model


def stored_in(buffer: Any) -> dict[str, Any]:
    """Arrays and counters, of the images of a dictionary, too."""
    stored = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray | int)}
    for name in ("observations", "next_observations"):
        vectors = vars(buffer).get(name)
        stored |= {f"{name}.{key}": value for key, value in vectors.items()} if isinstance(vectors, dict) else {}
    return stored | {key: stored_in(image) for key, image in vars(buffer).get("images", {}).items()}


def outcome(model: CuReSAC, folder: Path) -> dict[str, Any]:
    """All that training leaves behind; the log without what a clock has written."""
    stored = stored_in(model.replay_buffer)
    with (folder / "logs" / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    clocks = ("time/fps", "time/time_elapsed")
    log = [{key: value for key, value in row.items() if key not in clocks} for row in rows]
    return {
        "networks": state_of(model),
        "buffer": stored,
        "log": log,
        "counters": (model.num_timesteps, model._n_updates, model._episode_num),
        "next draws": (np.random.random(3), th.rand(3), random.random(), model.action_space.sample()),
    }


class Killed(Exception):
    """Stands in for a kill where the process is to live on: nothing is written after it."""


class KillAt(BaseCallback):
    """Raises after so many calls."""

    def __init__(self, calls: int):
        super().__init__()
        self._calls = calls  # not public: it is not kept

    def _on_step(self) -> bool:
        self._calls -= 1
        if self._calls == 0:
            raise Killed
        return True


_REFERENCE: dict[str, dict[str, Any]] = {}


def reference(name: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the case leaves behind without interruption."""
    if name not in _REFERENCE:
        folder = tmp_path_factory.mktemp("reference")
        _REFERENCE[name] = outcome(train(CASES[name], folder), folder)
    return _REFERENCE[name]


@pytest.mark.parametrize(
    ("name", "calls"),
    [
        *((name, 31) for name in CASES),
        ("rae, joint", 1),
        ("rae, joint", 57),
        ("schedules, noise, alternating", 57),
        ("pretraining", 1),
        ("pretraining", 57),
    ],
)
def test_interrupted_training_goes_on_bit_for_bit(
    name: str, calls: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    expected = reference(name, tmp_path_factory)
    with pytest.raises(Killed):
        train(CASES[name], tmp_path, False, KillAt(calls // CASES[name].make_env().num_envs or 1))
    np.random.seed(99)  # whatever another process begins with
    th.manual_seed(99)
    assert differences(expected, outcome(train(CASES[name], tmp_path, True), tmp_path)) == []


@settings(max_examples=5, deadline=None)
@given(kills=st.lists(st.integers(1, 25), min_size=1, max_size=4), save_freq=st.integers(1, 30))
def test_any_kills_at_any_steps(kills: list[int], save_freq: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    case = Case(vectors, policy="MlpPolicy", save_freq=save_freq, steps=40)
    if "kills" not in _REFERENCE:
        folder = tmp_path_factory.mktemp("reference")
        _REFERENCE["kills"] = outcome(train(case, folder), folder)
    folder = tmp_path_factory.mktemp("killed")
    for attempt, calls in enumerate(kills):
        try:
            train(case, folder, attempt > 0, KillAt(calls))
        except Killed:
            continue
    assert differences(_REFERENCE["kills"], outcome(train(case, folder, True), folder)) == []


def _train_in_child(name: str, folder: Path) -> None:
    os.setsid()
    train(CASES[name], folder, False)


def _wait_for_generation(folder: Path, number: int, process: Any) -> None:
    deadline = time.monotonic() + 300
    while max(Generations(folder / "checkpoints").numbers(), default=-1) < number:
        assert process.is_alive() if hasattr(process, "is_alive") else process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.mark.parametrize(
    ("name", "delay"), [("rae, joint", 0.0), ("curl, sequential", 0.02), ("pretraining", 0.01), ("workers", 0.03)]
)
def test_kill_9_loses_nothing(
    name: str, delay: float, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    expected = reference(name, tmp_path_factory)
    child = multiprocessing.get_context("fork").Process(target=_train_in_child, args=(name, tmp_path))
    child.start()
    _wait_for_generation(tmp_path, 1, child)
    time.sleep(delay)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    assert child.exitcode == -signal.SIGKILL
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)  # workers that were forked do not notice that their parent is gone
    assert differences(expected, outcome(train(CASES[name], tmp_path, True), tmp_path)) == []


def newest_steps(kept: Generations) -> int:
    """Agent steps after which the newest checkpoint was taken."""
    return read_state(kept.folder(kept.numbers()[-1]) / "state.safetensors")["num_timesteps"]


SCRIPT = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import torch
    from stable_baselines3.common.logger import configure
    from sb3_cure import CuReSAC, make_dmc_env
    from sb3_cure.persistence import ExactCheckpoint

    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    env = make_dmc_env("cartpole", "swingup", image_size=24, renderer="fast")
    if ExactCheckpoint.exists(folder / "checkpoints"):
        model = CuReSAC.resume(folder / "checkpoints", env)
    else:
        model = CuReSAC(
            "CnnPolicy", env, learning_starts=20, batch_size=8, buffer_size=150, warmup_updates=5, precision="fp32",
            seed=0, device="cpu",
            policy_kwargs=dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4, n_layers=2)),
        )
    model.set_logger(configure(str(folder / "logs"), ["csv"]))
    model.learn(130, callback=ExactCheckpoint(10, folder / "checkpoints"), log_interval=1)
    model.save(folder / "final")
    """
)


def run_script(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)])


def what_the_script_leaves(folder: Path) -> tuple[Any, Any]:
    with (folder / "logs" / "progress.csv").open() as file:
        rows = [{k: v for k, v in row.items() if not k.startswith("time/")} for row in csv.DictReader(file)]
    return state_of(CuReSAC.load(folder / "final", device="cpu")), rows


def test_killed_script_is_started_again(tmp_path: Path) -> None:
    """The whole story in a user's words: the same script, started again."""
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    whole, killed = run_script(tmp_path / "whole"), run_script(tmp_path / "killed")
    _wait_for_generation(tmp_path / "killed", 4, killed)
    killed.kill()
    killed.wait()
    assert not (tmp_path / "killed" / "final.zip").exists()
    assert run_script(tmp_path / "killed").wait() == whole.wait() == 0
    assert differences(*map(what_the_script_leaves, (tmp_path / "whole", tmp_path / "killed"))) == []


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 1)])
def test_signals_leave_a_checkpoint(
    number: int, status: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    expected = reference("rae, joint", tmp_path_factory)
    child = multiprocessing.get_context("fork").Process(target=_train_in_child, args=("rae, joint", tmp_path))
    child.start()
    _wait_for_generation(tmp_path, 1, child)
    os.kill(child.pid, number)
    child.join()
    assert child.exitcode == status  # of a KeyboardInterrupt multiprocessing makes 1, and a shell 130
    kept = Generations(tmp_path / "checkpoints")
    assert 0 < newest_steps(kept) < 60
    assert differences(expected, outcome(train(CASES["rae, joint"], tmp_path, True), tmp_path)) == []


def test_signal_that_ends_workers_leaves_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in a terminal, or a cluster's SIGTERM, also reaches the workers."""

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 31:
                monkeypatch.setattr("sb3_cure.persistence.resume.vec_env_state", gone)
                signal.raise_signal(signal.SIGTERM)
            return True

    def gone(env: VecEnv) -> None:
        raise BrokenPipeError

    with pytest.raises(SystemExit, match="143"):
        train(CASES["vectors"], tmp_path, False, Stop())
    monkeypatch.undo()
    kept = Generations(tmp_path / "checkpoints")
    assert newest_steps(kept) == 31
    assert train(CASES["vectors"], tmp_path, True).num_timesteps == 60


def test_signal_in_the_last_step_is_obeyed(tmp_path: Path) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 60:
                signal.raise_signal(signal.SIGTERM)
            return True

    with pytest.raises(SystemExit, match="143"):
        train(CASES["vectors"], tmp_path, False, Stop())


# ------------------------------------------------------------------------------------------------- contents


def test_frames_are_written_once(tmp_path: Path) -> None:
    case = Case(pixels(), {"buffer_size": 40}, steps=100, save_freq=10)
    model = train(case, tmp_path)
    kept = Generations(tmp_path / "checkpoints")
    numbers = kept.numbers()
    assert len(numbers) == 3 and numbers[-1] == 10
    frame_bytes = int(np.prod(model.replay_buffer.frame_shape))
    segments = read_state(kept.folder(numbers[-1]) / "state.safetensors")["buffer"]["segments"]
    for name, first, last in segments:
        assert kept.segments.joinpath(name).stat().st_size == (last - first) * frame_bytes
    spans = [(first, last) for _, first, last in segments]
    assert all(one[1] == other[0] for one, other in itertools.pairwise(spans))
    # No more is kept than the ring holds and what the older generations and the oldest segment need.
    frames = sum(path.stat().st_size for path in kept.segments.iterdir()) / frame_bytes
    assert frames <= model.replay_buffer.frame_capacity + 4 * 15


def test_checkpoints_do_not_disturb_training(tmp_path: Path) -> None:
    often, seldom = (
        outcome(train(Case(pixels(), save_freq=save_freq), tmp_path / str(save_freq)), tmp_path / str(save_freq))
        for save_freq in (1, 1000)
    )
    assert differences(often, seldom) == []


@pytest.mark.parametrize("place", ["before", "after", "inside"])
def test_order_of_callbacks_does_not_matter(place: str, tmp_path: Path) -> None:
    class Rollouts(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.n_rollouts = 0

        def _on_rollout_start(self) -> None:
            self.n_rollouts += 1

        def _on_step(self) -> bool:
            return True

    counts = []
    for calls in (0, 33):
        folder = tmp_path / str(calls)
        for attempt in range(2 if calls else 1):
            env, rollouts, keep = vectors(), Rollouts(), ExactCheckpoint(12, folder)
            model = CuReSAC.resume(folder, env) if attempt else tiny_model("MlpPolicy", env)
            callbacks = {
                "before": [keep, rollouts],
                "after": [rollouts, keep],
                "inside": [rollouts, EveryNTimesteps(50, keep)],
            }
            try:
                model.learn(60, callback=[*callbacks[place], KillAt(0 if attempt else calls)])
            except Killed:
                continue
        counts.append(rollouts.n_rollouts)
    assert counts == [60, 60]


class OneStart(gym.Wrapper):
    """Every episode starts from the same state."""

    def reset(self, **_: Any) -> Any:
        return self.env.reset(seed=3)


@pytest.mark.parametrize(("case", "kill_at"), [("rae, joint", 33), ("pretraining", 58), ("pretraining", 28)])
def test_callbacks_go_on_counting(case: str, kill_at: int, tmp_path: Path) -> None:
    """From the last checkpoint, also what they counted in a call that is over."""

    class Count(PeriodicCallback):
        def __init__(self) -> None:
            super().__init__(10)
            self.at: list[int] = []

        def on_period(self) -> None:
            self.at.append(self.num_timesteps)

    class Note(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.at: list[int] = []

        def _on_step(self) -> bool:
            self.at.append(self.num_timesteps)
            return True

    def callbacks() -> tuple[Count, EvalCallback]:
        evaluation = EvalCallback(
            OneStart(PixelBox(episode_length=7)),
            callback_on_new_best=Note(),
            eval_freq=9,
            n_eval_episodes=1,
            verbose=0,
            warn=False,
        )
        return Count(), evaluation

    def at_end(each: tuple[Count, EvalCallback]) -> Any:
        count, evaluation = each
        at_best = evaluation.callback_on_new_best.at  # type: ignore[union-attr]
        return count.at, at_best, evaluation.evaluations_timesteps, evaluation.n_calls, evaluation.best_mean_reward

    whole, killed, resumed = callbacks(), callbacks(), callbacks()
    train(CASES[case], tmp_path / "whole", False, *whole)
    with pytest.raises(Killed):
        train(CASES[case], tmp_path / "killed", False, *killed, KillAt(kill_at))
    train(CASES[case], tmp_path / "killed", True, *resumed)
    assert at_end(whole) == at_end(resumed)


def test_changed_attributes_of_callbacks_come_back(tmp_path: Path) -> None:
    """Whatever their types became, dictionaries of any kind too; but not what has no plain type or is private."""

    class Best(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.best, self.found, self.where = -np.inf, False, "nowhere"
            self.seen: dict[str, int] = collections.Counter()
            self.history: list[float] = []
            self.given, self._secret, self.own = "at first", 0, object()

        def _on_step(self) -> bool:
            self.best, self.found, self.where = np.float32(self.num_timesteps), np.bool_(True), "somewhere"
            self.seen["steps"] += 1
            self.history.append(0.1 * self.num_timesteps)
            self._secret, self.own = self.num_timesteps, object()
            return True

    env, first, best = vectors(), Best(), Best()
    best.given = "now"
    tiny_model("MlpPolicy", env).learn(20, callback=[ExactCheckpoint(10, tmp_path), first])
    CuReSAC.resume(tmp_path, env).learn(20, callback=[ExactCheckpoint(10, tmp_path), best])
    assert (best.best, best.found, best.where, best.seen, best.history, best.given, best._secret) == (
        *(20, True, "somewhere", {"steps": 20}, first.history, "now", 0),
    )
    assert type(best.seen) is collections.Counter and type(best.best) is np.float32


def test_loaded_replay_buffer_is_checkpointed(tmp_path: Path) -> None:
    """Its frames, which no former checkpoint has, and its size."""
    other = tiny_model("CnnPolicy", PixelBox(), seed=5, buffer_size=70).learn(60)
    other.save_replay_buffer(tmp_path / "other.pkl")
    model = tiny_model("CnnPolicy", PixelBox(), buffer_size=500)
    model.learn(40, callback=ExactCheckpoint(20, tmp_path / "kept"))
    model.load_replay_buffer(tmp_path / "other.pkl")
    model.learn(20, callback=ExactCheckpoint(20, tmp_path / "kept"), reset_num_timesteps=False)
    ours, theirs = model.replay_buffer, CuReSAC.resume(tmp_path / "kept", PixelBox()).replay_buffer
    assert theirs.buffer_size == 70 and theirs._n_frames == ours._n_frames
    rows = np.arange(theirs.size())
    for name in ("observations", "next_observations", "rewards"):
        kept, read = (getattr(transitions(each, rows, 0 * rows), name) for each in (ours, theirs))
        assert th.equal(kept, read), name


def test_one_folder_under_two_names(tmp_path: Path) -> None:
    """A link, and a path that goes up and down."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    env = vectors()
    tiny_model("MlpPolicy", env).learn(12, callback=ExactCheckpoint(10, tmp_path / "kept"))
    for name in ("link", "sub/../kept"):
        CuReSAC.resume(tmp_path / name, env).learn(12, callback=ExactCheckpoint(10, tmp_path / "kept"))


class NoState(gym.Wrapper):
    """Keeps to itself what it is like."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.lock = threading.Lock()


def test_secretive_environments_begin_a_new_episode(tmp_path: Path) -> None:
    case = Case(lambda: DummyVecEnv([lambda: Monitor(NoState(PixelBox(episode_length=7)))]))
    with pytest.warns(UserWarning, match="NoState.*begins with a new episode"), pytest.raises(Killed):
        train(case, tmp_path, False, KillAt(31))
    with pytest.warns(UserWarning, match="NoState"):
        model = train(case, tmp_path, True)
    assert model.num_timesteps == 60
    with (tmp_path / "logs" / "progress.csv").open() as file:
        steps = [int(row["time/total_timesteps"]) for row in csv.DictReader(file)]
    # 24 steps, of which the last 3 belong to the episode that is given up; then episodes of 7 steps anew
    assert steps == [7, 14, 21, 31, 38, 45, 52, 59]


def test_statistics_outlive_secretive_environments(tmp_path: Path) -> None:
    """Of observations and returns: networks and replay buffer go on, and are used to these."""

    def make() -> VecNormalize:
        return VecNormalize(DummyVecEnv([lambda: Monitor(NoState(VectorBox()))]))

    env = make()
    with pytest.warns(UserWarning, match="NoState"), pytest.raises(Killed):
        tiny_model("MlpPolicy", env).learn(60, callback=[KillAt(31), ExactCheckpoint(30, tmp_path)])
    resumed = CuReSAC.resume(tmp_path, make(), device="cpu")
    ours, theirs = resumed.get_vec_normalize_env(), env
    assert ours is not None and ours is not theirs
    # Of the checkpoint, one step before: nothing but counts that go on comes near to these.
    assert ours.obs_rms.count == pytest.approx(theirs.obs_rms.count - 1)  # type: ignore[union-attr]
    np.testing.assert_allclose(ours.obs_rms.mean, theirs.obs_rms.mean, atol=0.05)  # type: ignore[union-attr]
    with pytest.warns(UserWarning, match="NoState"):
        resumed.learn(60, callback=ExactCheckpoint(30, tmp_path))
    assert ours.obs_rms.count > 59 and ours.ret_rms.count > 59  # type: ignore[union-attr]


@pytest.mark.parametrize("vec_env_class", [DummyVecEnv, SubprocVecEnv])
def test_statistics_of_wrappers_outlive_secretive_environments(vec_env_class: Any, tmp_path: Path) -> None:
    """Of each environment, in this process or in a worker."""

    def make() -> VecEnv:
        return vec_env_class([lambda: Monitor(NormalizeReward(NormalizeObservation(NoState(VectorBox(99)))))] * 2)

    def counts(env: Any) -> list[float]:
        return [float(each.count) for name in ("obs_rms", "return_rms") for each in env.get_attr(name)]

    env = make()
    with pytest.warns(UserWarning, match="NoState"), pytest.raises(Killed):
        tiny_model("MlpPolicy", env).learn(60, callback=[KillAt(21), ExactCheckpoint(40, tmp_path)])
    resumed = CuReSAC.resume(tmp_path, make(), device="cpu")
    assert counts(resumed.env) == pytest.approx([each - 1 for each in counts(env)])  # of the checkpoint, a step before


@pytest.mark.parametrize("kill_at", [15, 55, 100])
def test_loops_of_learn_go_on_where_they_were(kill_at: int, tmp_path: Path) -> None:
    """``reset_num_timesteps=False`` in all calls, the first one, too."""

    def loop(model: CuReSAC, kill: KillAt) -> CuReSAC:
        for _ in range(5):
            model.learn(20, callback=[kill, ExactCheckpoint(10, tmp_path)], reset_num_timesteps=False)
        return model

    with pytest.raises(Killed):
        loop(tiny_model("MlpPolicy", vectors()), KillAt(kill_at))
    assert loop(CuReSAC.resume(tmp_path, vectors(), device="cpu"), KillAt(0)).num_timesteps == 100


def test_abandoned_log_is_told(tmp_path: Path) -> None:
    with pytest.raises(Killed):
        train(CASES["vectors"], tmp_path, False, KillAt(40))
    model = CuReSAC.resume(tmp_path / "checkpoints", vectors(), device="cpu")
    with pytest.warns(UserWarning, match=r"wrote the log progress\.csv, which nothing goes on with.*set_logger"):
        model.learn(60)


def script(folder: Path, resume: bool, kill_at: int = 0) -> CuReSAC:
    """One that pretrains, learns, and learns on."""
    env = pixels()()
    model = CuReSAC.resume(folder / "checkpoints", env) if resume else tiny_model("CnnPolicy", env)
    model.set_logger(configure(str(folder / "logs"), ["csv"]))
    kill = KillAt(kill_at)
    for call, steps, resets in ((model.pretrain, 25, True), (model.learn, 30, True), (model.learn, 20, False)):
        callbacks = [kill, ExactCheckpoint(8, folder / "checkpoints")]
        call(steps, callback=callbacks, log_interval=1, reset_num_timesteps=resets)
    return model


@pytest.mark.parametrize("kill_at", [12, 40, 57, 70])
def test_scripts_go_on_in_the_right_call(kill_at: int, tmp_path: Path) -> None:
    expected = outcome(script(tmp_path / "whole", False), tmp_path / "whole")
    with pytest.raises(Killed):
        script(tmp_path / "killed", False, kill_at)
    assert differences(expected, outcome(script(tmp_path / "killed", True), tmp_path / "killed")) == []


def test_finished_training_can_be_continued(tmp_path: Path) -> None:
    case = CASES["rae, joint"]
    for name, resumes in (("whole", False), ("resumed", True)):
        model = train(case, tmp_path / name)
        if resumes:
            model = CuReSAC.resume(tmp_path / name / "checkpoints", case.make_env(), device="cpu")
            model.set_logger(configure(str(tmp_path / name / "logs"), ["csv"]))
            model.learn(case.steps)
        model.learn(20, reset_num_timesteps=False, log_interval=1)
    results = [outcome(model, tmp_path / name) for name in ("whole", "resumed")]
    assert results[0]["log"] == results[1]["log"]


def test_learning_on_after_resume_means_more_steps(tmp_path: Path) -> None:
    """As everywhere in SB3; without that word it means the total of the interrupted call."""
    for case in ("more", "total"):
        with pytest.raises(Killed):
            train(CASES["vectors"], tmp_path / case, False, KillAt(30))
    model = CuReSAC.resume(tmp_path / "more" / "checkpoints", vectors(), device="cpu")
    assert model.num_timesteps == 24
    assert model.learn(20, reset_num_timesteps=False).num_timesteps == 44
    assert model.learn(5, reset_num_timesteps=False).num_timesteps == 49
    assert CuReSAC.resume(tmp_path / "total" / "checkpoints", vectors()).learn(40).num_timesteps == 40


class SafeTD3(Persistence, TD3):
    """An algorithm of SB3 that can be resumed."""


def test_other_algorithms_go_on_bit_for_bit(tmp_path: Path) -> None:
    """The mixin needs nothing of CuReSAC."""
    results = []
    for name, kills in (("whole", False), ("killed", True)):
        arguments: Any = dict(learning_starts=5, buffer_size=60, seed=0, device="cpu", policy_kwargs=dict(net_arch=[4]))
        model = SafeTD3("MlpPolicy", vectors(), **arguments)
        callback = ExactCheckpoint(8, tmp_path / name)
        if kills:
            with pytest.raises(Killed):
                model.learn(40, callback=[callback, KillAt(21)])
            model = SafeTD3.resume(tmp_path / name, vectors(), device="cpu")
            callback = ExactCheckpoint(8, tmp_path / name)
        model.learn(40, callback=callback)
        results.append({**state_of(model), "rewards": model.replay_buffer.rewards, "steps": model.num_timesteps})
    assert differences(*results) == []


def test_failed_learn_can_be_called_again(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    expected = reference("rae, joint", tmp_path_factory)
    with pytest.raises(Killed):
        train(CASES["rae, joint"], tmp_path, False, KillAt(33))
    model = CuReSAC.resume(tmp_path / "checkpoints", pixels()(), device="cpu")
    model.set_logger(configure(str(tmp_path / "logs"), ["csv"]))
    with pytest.raises(ValueError, match="eval_env has"):
        model.learn(60, callback=EvalBothCallback(VectorBox(), 5))
    model.learn(60, callback=ExactCheckpoint(12, tmp_path / "checkpoints"), log_interval=1)
    assert differences(expected, outcome(model, tmp_path)) == []


def test_tensorboard_goes_on_in_its_folder(tmp_path: Path) -> None:
    """TensorBoard's runs are numbered, and another one has begun since."""
    board = tmp_path / "boards"

    def learn(model: CuReSAC, folder: str, *callbacks: BaseCallback) -> None:
        model.learn(60, callback=[ExactCheckpoint(12, tmp_path / folder), *callbacks], log_interval=1)

    with pytest.raises(Killed):
        learn(tiny_model("CnnPolicy", pixels()(), tensorboard_log=str(board)), "first", KillAt(33))
    learn(tiny_model("CnnPolicy", pixels()(), tensorboard_log=str(board)), "second")
    before = {path: path.stat().st_size for path in (board / "CuReSAC_2").iterdir()}
    model = CuReSAC.resume(tmp_path / "first", pixels()(), device="cpu")
    learn(model, "first")
    model.logger.close()
    steps = []
    # Named by second, process and number of the file: by these as numbers, as both may begin in one second.
    for path in sorted((board / "CuReSAC_1").iterdir(), key=lambda path: list(map(int, re.findall(r"\d+", path.name)))):
        events = EventAccumulator(str(path)).Reload()
        steps.append([event.step for event in events.Scalars("rollout/ep_rew_mean")])
    assert steps == [[7, 14, 21, 28], [28, 35, 42, 49, 56]]  # of which TensorBoard drops the first 28
    assert before.items() <= {path: path.stat().st_size for path in (board / "CuReSAC_2").iterdir()}.items()


class Payload:
    """Unpickled, it would write a file."""

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {Path(__file__).parent}/executed",)


@pytest.mark.parametrize("name", ["model.zip", "state.safetensors"])
def test_hostile_checkpoint_runs_no_code(name: str, tmp_path: Path) -> None:
    """Its checksums are those of the author's files."""
    train(CASES["vectors"], tmp_path)
    kept = Generations(tmp_path / "checkpoints")
    folder = kept.folder(kept.numbers()[-1])
    (folder / name).write_bytes(pickle.dumps(Payload()))
    digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    lines = [line for line in (folder / "SHA256SUMS").read_text().splitlines() if not line.endswith(name)]
    (folder / "SHA256SUMS").write_text("\n".join([*lines, f"{digest}  {name}"]) + "\n")
    with watching() as events, pytest.raises(ArchiveError):
        CuReSAC.resume(tmp_path / "checkpoints", vectors(), device="cpu")
    assert events == [] and not (Path(__file__).parent / "executed").exists()


# ------------------------------------------------------------------------------------------------ refusals


def test_other_trainings_checkpoints_are_kept(tmp_path: Path) -> None:
    train(CASES["vectors"], tmp_path)
    before = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    with pytest.raises(CheckpointError, match=r"holds checkpoints of another training.*CuReSAC\.resume"):
        train(CASES["vectors"], tmp_path)
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == before


def test_one_process_writes_to_a_folder(tmp_path: Path) -> None:
    with Generations(tmp_path).lock():
        with pytest.raises(CheckpointError, match="another process writes checkpoints"):
            tiny_model("MlpPolicy", VectorBox()).learn(5, callback=ExactCheckpoint(5, tmp_path))


def test_unwritable_folder_is_known_before_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    model = tiny_model("MlpPolicy", VectorBox())
    with pytest.raises(OSError):
        model.learn(5, callback=ExactCheckpoint(5, tmp_path / "file" / "below"))
    assert model.num_timesteps == 0


def test_other_number_of_environments_is_refused(tmp_path: Path) -> None:
    train(CASES["rae, joint"], tmp_path)
    with pytest.raises(CheckpointError, match=r"got 4 environments, but .* of a training with 1"):
        CuReSAC.resume(tmp_path / "checkpoints", pixels(4)())


def test_no_checkpoint_is_said(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="there is no checkpoint in"):
        CuReSAC.resume(tmp_path / "nothing", PixelBox())


# -------------------------------------------------------------------------------------------------- faults


def test_faults_cost_one_checkpoint_at_most(tmp_path: Path) -> None:
    """The campaign of benchmarks/faults.py, with a part of its failing writes."""
    outcomes = faults.campaign(tmp_path, points=15)
    assert [outcome for outcome in outcomes if not outcome.expected] == []
    assert len(outcomes) >= 90
    assert {outcome.resumed for outcome in outcomes} == {"newest", "former", "without some frames"}
