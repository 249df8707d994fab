"""A training that is killed and resumed equals one that was never killed, bit for bit; no fault costs more than one
checkpoint."""

import collections
import errno
import hashlib
import itertools
import pickle
import random
import shutil
import subprocess
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import filelock
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal, SensorBox, sensor_model
from envs_for_tests import KillAt, Killed, PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium.wrappers import NormalizeReward
from hypothesis import given, settings
from hypothesis import strategies as st
from logs_for_tests import KeptRows
from payloads_for_tests import EXECUTED, Payload
from stable_baselines3 import TD3
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from benchmarks import faults
from benchmarks.fuzz import watching
from sb3_cure import CuReSAC, CuReTQC
from sb3_cure.data.buffers import FrameRing, FrameStackReplayBuffer, stored_places, transitions
from sb3_cure.persistence import ArchiveError, CheckpointError, ExactCheckpoint, Persistence, ResumableEnv, read_state
from sb3_cure.persistence.checkpoints import CheckpointFolder
from sb3_cure.persistence.files import locked
from sb3_cure.persistence.generations import Generations
from sb3_cure.persistence.resume import random_state
from sb3_cure.vec_env import FaultTolerantSubprocVecEnv

pytestmark = pytest.mark.usefixtures("quick_disk")


@dataclass
class Case:
    """A training: how it is set up and how long it is."""

    make_env: Callable[[], Any]
    arguments: dict[str, Any] = field(default_factory=dict)
    policy: str = "CnnPolicy"
    algorithm: type[CuReSAC | CuReTQC] = CuReSAC
    steps: int = 60
    save_freq: int = 12
    pretrain: bool = False


def pixels(n_envs: int = 1) -> Callable[[], VecEnv]:
    return lambda: make_vec_env(PixelBox, n_envs, env_kwargs={"episode_length": 7})


def vectors() -> VecEnv:
    return make_vec_env(VectorBox, 1, env_kwargs={"episode_length": 7})


def workers(vec_env_class: Any, **kwargs: Any) -> VecEnv:
    return vec_env_class([lambda: ResumableEnv(Monitor(PixelBox(episode_length=7)))] * 2, start_method="fork", **kwargs)


CASES = {
    "rae, joint": Case(pixels()),
    "curl, sequential, four environments, small ring": Case(
        pixels(4), {"srl": "curl", "update": "sequential", "buffer_size": 60, "gradient_steps": 1}, steps=120
    ),
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
    "bouts of two environments": Case(pixels(2), {"curiosity_prob": 0.5, "curiosity_bout": 6}),
    "normalized rewards": Case(lambda: VecNormalize(pixels(2)(), norm_obs=False), {"curiosity": "bonus"}),
    "pretraining": Case(pixels(), {"curiosity": None}, pretrain=True),
    "quantile critics": Case(pixels(), {"srl": "spr"}, algorithm=CuReTQC),
    "workers": Case(lambda: workers(SubprocVecEnv)),
    "watched workers": Case(lambda: workers(FaultTolerantSubprocVecEnv, on_env_fault="restart")),
    "dictionaries, small rings": Case(
        lambda: make_vec_env(SensorBox, 2, env_kwargs={"episode_length": 7}),
        {"buffer_size": 40, "srl": "curl", "gradient_steps": 1},
        policy="MultiInputPolicy",
        steps=80,
    ),
    "dictionaries without images": Case(lambda: make_vec_env(Goal, 1), policy="MultiInputPolicy"),
}


def train(case: Case, folder: Path, resume: bool = False, *callbacks: BaseCallback) -> CuReSAC:
    """The script of a user, which is started again with ``resume=True``."""
    env = case.make_env()
    if resume:
        model = case.algorithm.resume(folder, env, device="cpu")
    else:
        model = tiny_model(case.policy, env, case.algorithm, **case.arguments)
    call = model.pretrain if case.pretrain else model.learn
    try:
        # All that is logged is kept until the end: means of before and after an interruption
        call(case.steps, callback=[ExactCheckpoint(case.save_freq, folder), *callbacks], log_interval=10**9)
    finally:
        model.env.close()
    return model


def arrays_in(value: Any) -> dict[str, Any]:
    """Arrays and counters of a replay buffer, and of its dictionaries and rings of frames."""
    attributes = value if isinstance(value, dict) else vars(value)
    inside = {k: arrays_in(part) for k, part in attributes.items() if isinstance(part, dict | FrameRing)}
    return {**inside, **{k: part for k, part in attributes.items() if isinstance(part, np.ndarray | int)}}


def outcome(model: CuReSAC) -> dict[str, Any]:
    """All that training leaves behind."""
    return {
        "networks": state_of(model),
        "buffer": arrays_in(model.replay_buffer),
        "counters": (model.num_timesteps, model._n_updates, model._episode_num),
        "episodes": [(episode["r"], episode["l"]) for episode in model.ep_info_buffer or ()],
        # Shares of the encoder's gradient are measured now and then, and not kept
        "to be logged": {k: v for k, v in model.logger.name_to_value.items() if not k.startswith("train/encoder_")},
        "next draws": (np.random.random(3), th.rand(3), random.random(), model.action_space.sample()),
    }


_REFERENCE: dict[str, dict[str, Any]] = {}


@pytest.mark.parametrize(("name", "steps"), [*((name, 31) for name in CASES), ("rae, joint", 1)])
def test_interrupted_training_continues_bit_for_bit(
    name: str, steps: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    case = CASES[name]
    if name not in _REFERENCE:
        _REFERENCE[name] = outcome(train(case, tmp_path_factory.mktemp("reference")))
    with pytest.raises(Killed):
        train(case, tmp_path, False, KillAt(steps))
    np.random.seed(99)  # whatever another process begins with
    th.manual_seed(99)
    assert differences(_REFERENCE[name], outcome(train(case, tmp_path, True))) == []


@settings(max_examples=5, deadline=None)
@given(kills=st.lists(st.integers(1, 25), min_size=1, max_size=4), save_freq=st.integers(1, 30))
def test_any_kills_at_any_steps(kills: list[int], save_freq: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    case = Case(vectors, policy="MlpPolicy", save_freq=save_freq, steps=40)
    if "kills" not in _REFERENCE:
        _REFERENCE["kills"] = outcome(train(case, tmp_path_factory.mktemp("reference")))
    folder = tmp_path_factory.mktemp("killed")
    for attempt, calls in enumerate([*kills, 99]):
        try:
            model = train(case, folder, attempt > 0, KillAt(calls))
            break
        except Killed:
            continue
    assert differences(_REFERENCE["kills"], outcome(model)) == []


def test_speed_is_that_of_both_parts(tmp_path: Path) -> None:
    """Logged steps are those of the whole call, and so is the time."""

    class Slow(BaseCallback):
        def _on_training_start(self) -> None:
            self.model.start_time -= 1000 * 10**9

        def _on_step(self) -> bool:
            return True

    model = tiny_model("MlpPolicy", VectorBox())
    with pytest.raises(Killed):
        model.learn(40, callback=[Slow(), ExactCheckpoint(10, tmp_path), KillAt(25)])
    resumed, kept = CuReSAC.resume(tmp_path, VectorBox()), KeptRows()
    resumed.set_logger(Logger(None, [kept]))
    resumed.learn(40, callback=ExactCheckpoint(10, tmp_path), log_interval=1)
    assert 1000 <= kept.rows[-1]["time/time_elapsed"] < 2000


SCRIPT = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import torch
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
    model.learn(130, callback=ExactCheckpoint(10, folder / "checkpoints"))
    model.save(folder / "final")
    """
)


def run_script(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)])


def test_kill_9_of_dmc_training_loses_nothing(tmp_path: Path) -> None:
    """The whole story in a user's words: the same script, started again."""
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    whole, killed = run_script(tmp_path / "whole"), run_script(tmp_path / "killed")
    while max(Generations(tmp_path / "killed" / "checkpoints").numbers(), default=-1) < 4:
        assert killed.poll() is None
        time.sleep(0.002)
    killed.kill()
    killed.wait()
    assert not (tmp_path / "killed" / "final.zip").exists()
    assert run_script(tmp_path / "killed").wait() == whole.wait() == 0
    models = [CuReSAC.load(tmp_path / name / "final", device="cpu") for name in ("whole", "killed")]
    assert models[0]._n_updates == models[1]._n_updates > 0
    assert differences(*map(state_of, models)) == []


# ------------------------------------------------------------------------------------------ learn after resume


def interrupted(folder: Path, env: Any = None) -> CuReSAC:
    """A model as resumed after 20 of the 40 steps of a ``learn``."""
    with pytest.raises(Killed):
        tiny_model("MlpPolicy", VectorBox()).learn(40, callback=[ExactCheckpoint(10, folder), KillAt(25)])
    return CuReSAC.resume(folder, env or VectorBox(), device="cpu")


@pytest.mark.parametrize("first", [(40, True), (20, False)], ids=["what was left", "more steps"])
def test_learn_after_resume_ends_where_it_should(first: tuple[int, bool], tmp_path: Path) -> None:
    """Either way 20 steps more, which are those of the interrupted training."""
    model = interrupted(tmp_path)
    assert model.num_timesteps == 20
    model.learn(first[0], reset_num_timesteps=first[1])
    assert model.num_timesteps == 40
    whole = tiny_model("MlpPolicy", VectorBox()).learn(40)
    assert differences(state_of(whole), state_of(model)) == []
    assert model.learn(5, reset_num_timesteps=False).num_timesteps == 45
    assert model.learn(7).num_timesteps == 7


def test_more_steps_can_be_interrupted_again(tmp_path: Path) -> None:
    """They are a call of their own: what is left of it is counted from its beginning."""
    with pytest.raises(Killed):
        interrupted(tmp_path).learn(30, callback=[ExactCheckpoint(10, tmp_path), KillAt(25)], reset_num_timesteps=False)
    again = CuReSAC.resume(tmp_path, VectorBox(), device="cpu")
    assert again.num_timesteps == 40
    assert again.learn(30).num_timesteps == 50  # of which 20 were made


def test_finished_training_is_continued(tmp_path: Path) -> None:
    results = []
    for resumes in (False, True):
        model = train(CASES["vectors"], tmp_path / str(resumes))
        if resumes:
            with pytest.warns(UserWarning, match="trains nothing"):
                model = CuReSAC.resume(tmp_path / "True", vectors(), device="cpu").learn(60)
        assert model.num_timesteps == 60
        results.append(outcome(model.learn(20, reset_num_timesteps=False)))
    assert differences(*results) == []


def test_call_after_a_finished_one_is_a_call_of_its_own(tmp_path: Path) -> None:
    """A script of two calls that was killed between them; also if it is killed again in the second."""
    results = []
    for kill in (None, 0, 15):
        folder = tmp_path / str(kill)
        model = train(CASES["vectors"], folder)
        if kill is not None:
            model = CuReSAC.resume(folder, vectors(), device="cpu")
            with pytest.warns(UserWarning, match="trains nothing: .* already made its 60 agent steps"):
                model.learn(60)
        if kill:
            with pytest.raises(Killed):
                model.learn(20, callback=[ExactCheckpoint(10, folder), KillAt(kill)])
            model = CuReSAC.resume(folder, vectors(), device="cpu")
        results.append(outcome(model.learn(20)))
    assert results[0]["counters"][0] == 20
    assert differences(results[0], results[1]) == [] == differences(results[0], results[2])


def test_learn_ends_interrupted_pretraining(tmp_path: Path) -> None:
    """``is_pretraining`` tells which call was interrupted; ``learn`` then begins as after any pretraining."""
    with pytest.raises(Killed):
        train(CASES["pretraining"], tmp_path, False, KillAt(31))
    model = CuReSAC.resume(tmp_path, pixels()(), device="cpu")
    assert model.is_pretraining and model.num_timesteps == 24
    assert not model.learn(15).is_pretraining
    assert (model.num_timesteps, model.replay_buffer.size()) == (15, 15)


@pytest.mark.parametrize("keeps", [False, True])
def test_learn_after_finished_pretraining_begins_as_in_one_script(keeps: bool, tmp_path: Path) -> None:
    """If the script was killed between the two calls; what is kept of pretraining does not happen twice."""
    arguments: dict[str, Any] = {"callback": ExactCheckpoint(12, tmp_path), "keep_replay_buffer": keeps}
    whole = tiny_model("CnnPolicy", pixels()()).pretrain(60, **arguments)
    resumed = CuReSAC.resume(tmp_path, pixels()(), device="cpu")
    with pytest.warns(UserWarning, match="trains nothing"):
        resumed.pretrain(60, **arguments)
    results = [outcome(model.learn(15)) for model in (whole, resumed)]
    assert differences(*results) == []
    actions = whole.replay_buffer.actions
    assert not keeps or not (actions[60:70] == actions[:10]).any(), "the random warm-up is that of pretraining"


class Unwilling(BaseCallback):
    """Refuses the training at its beginning."""

    def _init_callback(self) -> None:
        raise Killed

    def _on_step(self) -> bool:
        return True


def test_failed_learn_can_be_called_again(tmp_path: Path) -> None:
    model = interrupted(tmp_path)
    with pytest.raises(Killed):
        model.learn(40, callback=Unwilling())
    whole = tiny_model("MlpPolicy", VectorBox()).learn(40)
    assert differences(state_of(whole), state_of(model.learn(40))) == []


class SafeTD3(Persistence, TD3):
    """An algorithm of SB3 that can be resumed."""


def test_other_algorithms_continue_bit_for_bit(tmp_path: Path) -> None:
    """The mixin needs nothing of CuReSAC."""
    arguments: Any = dict(learning_starts=5, buffer_size=60, seed=0, device="cpu", policy_kwargs=dict(net_arch=[4]))
    with pytest.raises(ValueError, match="replay_buffer_class=FrameStackReplayBuffer"):
        SafeTD3("MlpPolicy", vectors(), **arguments).learn(40, callback=ExactCheckpoint(8, tmp_path))
    arguments |= dict(replay_buffer_class=FrameStackReplayBuffer, replay_buffer_kwargs=dict(frame_stack=1))
    results = []
    for name in ("whole", "killed"):
        model = SafeTD3("MlpPolicy", vectors(), **arguments)
        if name == "killed":
            with pytest.raises(Killed):
                model.learn(40, callback=[ExactCheckpoint(8, tmp_path), KillAt(21)])
            model = SafeTD3.resume(tmp_path, vectors(), device="cpu")
        results.append(state_of(model.learn(40)))
    assert differences(*results) == []


# ---------------------------------------------------------------------------------------- a new episode, said


class NoState(gym.Wrapper):
    """A wrapper of the user's that does not say what its state is."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.seen = 0


def test_new_episode_is_said_once_with_its_reason(tmp_path: Path) -> None:
    """In the training, and when it is resumed; statistics of all wrappers go on, and the first states are others."""

    def make() -> VecNormalize:
        return VecNormalize(DummyVecEnv([lambda: Monitor(NormalizeReward(NoState(VectorBox(99))))]))

    def counts(env: Any) -> list[float]:
        return [env.obs_rms.count, env.ret_rms.count, float(env.get_attr("return_rms")[0].count)]

    env, said = make(), []
    for begins in (True, False):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")  # as in a program
            if begins:
                first = tiny_model("MlpPolicy", env)
                with pytest.raises(Killed):
                    first.learn(60, callback=[KillAt(31), ExactCheckpoint(10, tmp_path)])
            else:
                resumed = CuReSAC.resume(tmp_path, make(), device="cpu")
                assert counts(resumed.get_vec_normalize_env()) == pytest.approx([each - 1 for each in counts(env)])
                resumed.learn(60, callback=ExactCheckpoint(10, tmp_path))
        said.append([str(each.message) for each in caught if "NoState has no state_dict()" in str(each.message)])
    # The resumed training says that it has begun a new episode, too.
    assert [len(each) for each in said] == [1, 2] and said[0] == said[1][1:]
    assert resumed.num_timesteps == 60
    rewards = resumed.replay_buffer.rewards
    assert not np.array_equal(rewards[30:40], rewards[:10])


# -------------------------------------------------------------------------------------------------- callbacks


class Best(BaseCallback):
    """Attributes of many kinds, public and private."""

    def __init__(self, setting: str = "first") -> None:
        super().__init__()
        self._best, self.found, self.setting = -np.inf, False, setting
        self.seen: dict[str, int] = collections.Counter()
        self._history: list[float] = []
        self.loss = th.zeros(())
        self.file = sys.stdout

    def _on_rollout_start(self) -> None:
        self.seen["rollouts"] += 1

    def _on_step(self) -> bool:
        self._best, self.found = np.float32(self.num_timesteps), np.bool_(True)
        self._history.append(0.1 * self.num_timesteps)
        self.loss = self.loss + 1
        return True


@pytest.mark.parametrize("place", ["before", "after", "inside"])
def test_callbacks_continue_from_the_checkpoint(place: str, tmp_path: Path) -> None:
    """With all that has changed in them, wherever the checkpoint stands; what cannot be kept is said once."""

    def callbacks(setting: str) -> tuple[Best, list[BaseCallback]]:
        best, keep = Best(setting), ExactCheckpoint(12, tmp_path)
        places = {"before": [keep, best], "after": [best, keep], "inside": [best, EveryNTimesteps(50, keep)]}
        return best, places[place]  # type: ignore[return-value]

    with warnings.catch_warnings(record=True) as said, pytest.raises(Killed):
        warnings.simplefilter("default")  # as in a program
        tiny_model("MlpPolicy", vectors()).learn(60, callback=[*callbacks("first")[1], KillAt(33)])
    assert [str(each.message) for each in said if "keep" in str(each.message)] == ["checkpoints do not keep Best.file."]
    best, all_callbacks = callbacks("second")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        CuReSAC.resume(tmp_path, vectors()).learn(60, callback=all_callbacks)
    assert (best._best, best.found, best.seen, best.loss, best.setting) == (60, True, {"rollouts": 60}, 60, "second")
    assert type(best.seen) is collections.Counter and len(best._history) == 60


class Holds(BaseCallback):
    """A network, which is called like a function, what holds itself, and a state that files do not hold."""

    def __init__(self) -> None:
        super().__init__()
        self.net, self.tree = th.nn.Linear(1, 1), {}
        self.tree["self"] = self.tree

    def _on_step(self) -> bool:
        return True


class Tells(Holds):
    def state_dict(self) -> dict[str, Any]:
        return {"opened": Path(__file__).open()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        raise AssertionError


def test_what_checkpoints_cannot_keep_of_callbacks_is_told(tmp_path: Path) -> None:
    """And ends no training."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        tiny_model("MlpPolicy", vectors()).learn(30, callback=[ExactCheckpoint(10, tmp_path), Holds(), Tells()])
        CuReSAC.resume(tmp_path, vectors()).learn(40, callback=[Holds(), Tells()])
    kept = {str(each.message) for each in said if "do not keep" in str(each.message)}
    assert kept == {f"checkpoints do not keep {name}." for name in ("Holds.net", "Holds.tree", "Tells.state_dict()")}


def test_training_survives_that_its_checkpoints_are_removed(tmp_path: Path) -> None:
    """The next one has all frames anew."""

    class Remove(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 25:
                shutil.rmtree(tmp_path / "kept")
            return True

    model = tiny_model("CnnPolicy", pixels()())
    model.learn(60, callback=[ExactCheckpoint(10, tmp_path / "kept"), Remove()])
    resumed = CuReSAC.resume(tmp_path / "kept", pixels()(), device="cpu")
    assert differences(arrays_in(model.replay_buffer), arrays_in(resumed.replay_buffer)) == []


def test_folder_of_a_new_training_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Begun after the checkpoints of a running one were removed, by a name that the working directory decides."""
    monkeypatch.chdir(tmp_path)

    class Restart(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 25:
                shutil.rmtree(tmp_path / "kept")
                tiny_model("MlpPolicy", vectors()).learn(10, callback=ExactCheckpoint(10, tmp_path / "kept"))
                monkeypatch.chdir(tmp_path.parent)
            return True

    with pytest.raises(CheckpointError, match="another training writes checkpoints"):
        tiny_model("MlpPolicy", vectors()).learn(60, callback=[ExactCheckpoint(10, "kept"), Restart()])
    assert CuReSAC.resume(tmp_path / "kept", vectors(), device="cpu").num_timesteps == 10


def test_callbacks_may_know_each_other(tmp_path: Path) -> None:
    """Each is kept once."""

    def pair() -> tuple[Best, Best]:
        best, other = Best(), Best("other")
        best.other, other.other = other, best  # type: ignore[attr-defined]
        return best, other

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(Killed):
            tiny_model("MlpPolicy", vectors()).learn(30, callback=[*pair(), ExactCheckpoint(10, tmp_path), KillAt(25)])
        best, other = pair()
        CuReSAC.resume(tmp_path, vectors()).learn(30, callback=[best, other, ExactCheckpoint(10, tmp_path)])
    assert len(best._history) == len(other._history) == 30


def test_evaluations_continue(tmp_path: Path) -> None:
    """SB3's callback, and the one inside it."""

    def evaluation() -> EvalCallback:
        env = make_vec_env(VectorBox, 1, env_kwargs={"episode_length": 7})
        kwargs: Any = dict(eval_freq=9, n_eval_episodes=1, log_path=str(tmp_path / "log"), verbose=0, warn=False)
        return EvalCallback(env, callback_after_eval=Best(), **kwargs)

    first, second = evaluation(), evaluation()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(Killed):
            tiny_model("MlpPolicy", vectors()).learn(
                60, callback=[ExactCheckpoint(20, tmp_path / "kept"), first, KillAt(50)]
            )
        CuReSAC.resume(tmp_path / "kept", vectors()).learn(
            60, callback=[ExactCheckpoint(20, tmp_path / "kept"), second]
        )
    assert second.evaluations_timesteps == [9, 18, 27, 36, 45, 54] and second.n_calls == 60
    assert second.callback._history == pytest.approx([0.9, 1.8, 2.7, 3.6, 4.5, 5.4])  # type: ignore[union-attr]


# -------------------------------------------------------------------------------------------------- contents


def test_frames_are_written_once(tmp_path: Path) -> None:
    model = train(Case(pixels(), {"buffer_size": 40}, steps=100, save_freq=10), tmp_path)
    kept = Generations(tmp_path)
    numbers = kept.numbers()
    assert len(numbers) == 3 and numbers[-1] == 10
    ring = model.replay_buffer.rings[""]
    frame_bytes = int(np.prod(ring.frame_shape))
    segments = read_state(kept.folder(numbers[-1]) / "state.safetensors")["segments"][""]
    for name, first, last, _ in segments:
        assert kept.segments.joinpath(name).stat().st_size == (last - first) * frame_bytes
    assert all(one[2] == other[1] for one, other in itertools.pairwise(segments))
    # No more is kept than the ring holds and what the older generations and the oldest segment need.
    frames = sum(path.stat().st_size for path in kept.segments.iterdir()) / frame_bytes
    assert frames <= ring.capacity + 4 * 15
    before = {path.name for path in kept.segments.iterdir()}
    CuReSAC.resume(tmp_path, pixels()()).learn(10, callback=ExactCheckpoint(10, tmp_path), reset_num_timesteps=False)
    assert len({path.name for path in kept.segments.iterdir()} - before) == 1


def test_frames_of_each_image_are_written_once(tmp_path: Path) -> None:
    """The new ones of each image alone; all come back."""
    env = CASES["dictionaries, small rings"].make_env
    model: Any = sensor_model(env(), gradient_steps=0, buffer_size=50)
    model.learn(60, ExactCheckpoint(10, tmp_path, keep=2))
    kept, buffer = Generations(tmp_path), model.replay_buffer
    state = read_state(kept.folder(kept.numbers()[-1]) / "state.safetensors")
    sizes = {path.name: path.stat().st_size for path in kept.segments.iterdir()}
    assert state["segments"].keys() == buffer.rings.keys() == {"front", "wrist"}
    for key, ring in buffer.rings.items():
        spans = state["segments"][key]
        assert [first for _, first, *_ in spans][1:] == [last for *_, last, _ in spans[:-1]]
        assert spans[-1][2] == buffer.counts[key] and len(spans) >= 5
        frame = int(np.prod(ring.frame_shape))
        assert all(sizes[name] == (last - first) * frame for name, first, last, _ in spans)
    resumed: Any = CuReSAC.resume(tmp_path, env(), device="cpu")
    rows, env_inds, _ = stored_places(buffer)
    found: Any
    expected: Any
    found, expected = (transitions(each, rows, env_inds) for each in (resumed.replay_buffer, buffer))
    for key in ("front", "joints", "wrist"):
        np.testing.assert_array_equal(found.next_observations[key], expected.next_observations[key])


def test_random_streams_are_those_after_deferred_updates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With ``overlap=True`` an update waits for the next step; a checkpoint makes it, and draws its numbers."""
    write, states = CheckpointFolder.write, []

    def written(self: CheckpointFolder, model: Any, run: Any, keep: int) -> dict[str, Any]:
        state = write(self, model, run, keep)
        states.append((state["random"], random_state(model)))
        return state

    monkeypatch.setattr(CheckpointFolder, "write", written)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = workers(SubprocVecEnv)
        tiny_model("CnnPolicy", env, overlap=True).learn(40, callback=ExactCheckpoint(10, tmp_path))
    env.close()
    assert len(states) >= 4
    assert [differences(saved, found) for saved, found in states] == [[] for _ in states]


def test_two_trainings_do_not_write_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A requeued job may begin while the former one ends: the second writer waits, and is refused."""
    first, second = interrupted(tmp_path), CuReSAC.resume(tmp_path, VectorBox(), device="cpu")
    tries = threading.Event()
    refused: list[Exception] = []
    save, write = CuReSAC.save, CheckpointFolder.write

    def note_write(self: CheckpointFolder, model: Any, *args: Any) -> Any:
        if model is second:
            tries.set()
        return write(self, model, *args)

    def write_another() -> None:
        try:
            second.learn(40, callback=ExactCheckpoint(10, tmp_path))
        except CheckpointError as error:
            refused.append(error)

    thread = threading.Thread(target=write_another, daemon=True)

    def slow_save(model: CuReSAC, path: Path) -> None:
        if model is first and not thread.ident:
            thread.start()
            assert tries.wait(60)
            thread.join(0.5)
            assert thread.is_alive(), "it waits"
        save(model, path)

    monkeypatch.setattr(CuReSAC, "save", slow_save)
    monkeypatch.setattr(CheckpointFolder, "write", note_write)
    first.learn(40, callback=ExactCheckpoint(10, tmp_path))
    thread.join(60)
    assert "another training writes checkpoints" in str(refused)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # every generation is whole
        assert CuReSAC.resume(tmp_path, VectorBox(), device="cpu").num_timesteps == 40


@pytest.mark.parametrize("error", [OSError(95, "Operation not supported"), NotImplementedError("no flock")])
def test_file_systems_without_locks_take_checkpoints(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise error

    monkeypatch.setattr(filelock.FileLock, "acquire", refuse)
    with pytest.warns(UserWarning, match="cannot be locked"):
        train(CASES["vectors"], tmp_path)
    assert CuReSAC.resume(tmp_path, vectors(), device="cpu").num_timesteps == 60


def test_locks_do_not_outlive_a_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the system has no locks, a file instead of one would stay after a kill, and end all checkpoints."""

    def no_locks(*args: Any) -> None:
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.warns(UserWarning, match="cannot be locked"), locked(tmp_path, 1), locked(tmp_path, 1):
        pass


def test_loaded_replay_buffer_is_checkpointed(tmp_path: Path) -> None:
    """Its frames, which no former checkpoint has, and its size."""
    other = tiny_model("CnnPolicy", PixelBox(), seed=5, buffer_size=70).learn(60)
    other.save_replay_buffer(tmp_path / "other.pkl")
    model = tiny_model("CnnPolicy", PixelBox(), buffer_size=500)
    model.learn(40, callback=ExactCheckpoint(20, tmp_path / "kept"))
    model.load_replay_buffer(tmp_path / "other.pkl")
    model.learn(20, callback=ExactCheckpoint(20, tmp_path / "kept"), reset_num_timesteps=False)
    ours, theirs = model.replay_buffer, CuReSAC.resume(tmp_path / "kept", PixelBox()).replay_buffer
    assert theirs.buffer_size == 70
    rows = np.arange(theirs.size())
    for name in ("observations", "next_observations", "rewards"):
        kept, read = (getattr(transitions(each, rows, 0 * rows), name) for each in (ours, theirs))
        assert th.equal(kept, read), name


@pytest.mark.parametrize("name", ["model.zip", "state.safetensors"])
def test_hostile_checkpoint_runs_no_code(name: str, tmp_path: Path) -> None:
    """Its checksums are those of the author's files."""
    train(CASES["vectors"], tmp_path)
    kept = Generations(tmp_path)
    folder = kept.folder(kept.numbers()[-1])
    (folder / name).write_bytes(pickle.dumps(Payload()))
    digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    lines = [line for line in (folder / "SHA256SUMS").read_text().splitlines() if not line.endswith(name)]
    (folder / "SHA256SUMS").write_text("\n".join([*lines, f"{digest}  {name}"]) + "\n")
    with watching() as events, pytest.raises(ArchiveError):
        CuReSAC.resume(tmp_path, vectors(), device="cpu")
    assert events == [] and not EXECUTED.exists()


# ------------------------------------------------------------------------------------------------ refusals


def test_failed_attempt_removes_no_older_checkpoint(tmp_path: Path) -> None:
    """The newest one may be damaged."""
    kept = Generations(tmp_path)
    for content in "ab":
        with kept.writing(keep=2) as draft:
            (draft.folder / "file").write_text(content)
    (tmp_path / "generation-000001" / "file").write_text("damaged")
    with pytest.raises(OSError, match="full"), Generations(tmp_path).writing(keep=1) as draft:
        (kept.segments / "frames").touch()
        raise OSError("full")
    with pytest.warns(UserWarning, match="damaged"):
        assert kept.newest_whole().name == "generation-000000"
    assert not draft.folder.exists() and not list(kept.segments.iterdir())


def test_other_trainings_checkpoints_are_kept(tmp_path: Path) -> None:
    """Whether they were there before, or come meanwhile; a link to the folder is the same folder."""
    (tmp_path / "link").symlink_to(tmp_path / "kept")
    train(CASES["vectors"], tmp_path / "kept")
    before = sorted(path.name for path in (tmp_path / "kept").iterdir())
    with pytest.raises(CheckpointError, match=r"holds checkpoints of another training.*CuReSAC\.resume"):
        train(CASES["vectors"], tmp_path / "link")
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == before
    first, second = (CuReSAC.resume(tmp_path / name, vectors(), device="cpu") for name in ("kept", "link"))
    first.learn(20, callback=ExactCheckpoint(10, tmp_path / "link"), reset_num_timesteps=False)
    with pytest.raises(CheckpointError, match="another training writes checkpoints"):
        second.learn(20, callback=ExactCheckpoint(10, tmp_path / "kept"), reset_num_timesteps=False)


def test_unwritable_folder_is_known_before_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    model = tiny_model("MlpPolicy", VectorBox())
    with pytest.raises(OSError):
        model.learn(5, callback=ExactCheckpoint(5, tmp_path / "file" / "below"))
    assert model.num_timesteps == 0


def test_checkpoints_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    train(CASES["vectors"], tmp_path)
    with pytest.raises(ArchiveError, match=r"for 1 environments, but this model has .* for 4"):
        CuReSAC.resume(tmp_path, make_vec_env(VectorBox, 4))
    with pytest.raises(ValueError, match=r"the saved state is of .*Monitor around VectorBox"):
        CuReSAC.resume(tmp_path, DummyVecEnv([lambda: Monitor(NoState(VectorBox()))]))
    with pytest.raises(CheckpointError, match="there is no checkpoint in"):
        CuReSAC.resume(tmp_path / "nothing", VectorBox())


def test_faults_cost_one_checkpoint_at_most(tmp_path: Path) -> None:
    """The campaign of benchmarks/faults.py, with a part of its failing writes."""
    outcomes = faults.campaign(tmp_path, points=8)
    assert [outcome for outcome in outcomes if not outcome.expected] == []
    assert len(outcomes) >= 50
    assert {outcome.resumed for outcome in outcomes} == {"newest", "former", "nothing"}
