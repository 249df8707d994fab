"""Models and replay buffers from strangers: what is saved needs no pickle, and hostile or broken files are refused.

Every file of the corpus is loaded with little memory, watched for anything that code from the file would do, and has to
be refused in one sentence (``benchmarks.fuzz.outcome``).
"""

import io
import json
import math
import os
import pickle
import pickletools
import struct
import tracemalloc
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from benchmarks.fuzz import example_model, examples, fuzz, load, members_of, outcome, watching, zip_of
from sb3_cure import CuReSAC
from sb3_cure.buffers import SkippingReplayBuffer
from sb3_cure.callbacks import ExactCheckpoint
from sb3_cure.encoders import VectorEncoder
from sb3_cure.persistence import ArchiveError
from sb3_cure.settings import DERIVED, NEVER_SAVED, SCHEMA
from sb3_cure.zoo import ActingCuReSAC

# -------------------------------------------------------------------- settings

SPACES = [
    spaces.Box(-1, 1, (2,), np.float32),
    spaces.Box(0, 255, (3, 4, 5), np.uint8),
    spaces.Box(-np.inf, np.inf, (), np.float64),
    spaces.Box(np.array([0.0, -1.0], np.float32), np.array([1.0, np.inf], np.float32)),
    spaces.Discrete(5, start=-2),
    spaces.MultiDiscrete([3, 4], start=[1, 0]),
    spaces.MultiBinary(4),
    spaces.MultiBinary([2, 3]),
    spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Box(0, 1, (1,))}),
    spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.MultiBinary(1)])]),
]


def test_spaces() -> None:
    """Every kind of space comes back as it was, to the type of its numbers and the order of its parts."""
    model = tiny_model("MlpPolicy", VectorBox())
    model.spaces = SPACES
    file = io.BytesIO()
    model.save(file)
    for space, read in zip(SPACES, CuReSAC.load(file, trusted=True).spaces, strict=True):
        assert read == space and repr(read) == repr(space) and type(read) is type(space) and read.dtype == space.dtype


NOISES = [
    NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)),
    VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.3), dt=0.5), 1),
]


@pytest.mark.parametrize("noise", NOISES, ids=lambda noise: type(noise).__name__)
@pytest.mark.parametrize(
    "schedule", [3e-4, ConstantSchedule(1e-3), LinearSchedule(1e-3, 0.0, 0.5), FloatSchedule(LinearSchedule(1, 0, 1))]
)
@pytest.mark.parametrize("shared", [True, False], ids=["shared encoder", "SB3's SAC"])
def test_everything_allow_listed_comes_back(schedule: Any, noise: Any, shared: bool) -> None:
    """SB3's schedules and noises, torch's activations and optimisers, extractors: as they were, with their state."""
    extras = {} if shared else dict(srl=None, curiosity=None)
    policy_kwargs = dict(
        activation_fn=nn.ELU, optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.1), n_critics=1
    )
    if not shared:
        policy_kwargs.update(features_extractor_class=FlattenExtractor, features_extractor_kwargs={})
    model = tiny_model(
        "MlpPolicy", VectorBox(), learning_rate=schedule, action_noise=noise, policy_kwargs=policy_kwargs, **extras
    ).learn(14)
    file = io.BytesIO()
    model.save(file)
    loaded = CuReSAC.load(file)
    assert loaded.policy_kwargs == model.policy_kwargs and loaded.policy_class is model.policy_class
    assert loaded.train_freq == model.train_freq and loaded.replay_buffer_class is model.replay_buffer_class
    for progress in (1.0, 0.7, 0.1):
        assert loaded.lr_schedule(progress) == model.lr_schedule(progress)
    for copy in (model, loaded):
        np.random.seed(0)
        copy.drawn = [copy.action_noise() for _ in range(3)]
    assert differences(model.drawn, loaded.drawn) == []
    assert differences(state_of(model), state_of(loaded)) == []


class Unknown(VectorEncoder):
    """A user's features extractor."""


class OwnModel(CuReSAC):
    """A user's algorithm with an argument of its own."""

    def __init__(self, *args: Any, spam: float = 1.0, **kwargs: Any):
        self.spam = spam
        super().__init__(*args, **kwargs)


def test_what_no_archive_holds_is_asked_for() -> None:
    """A function and a class deep in a setting: named with the key to give, and not asked for when given either way."""
    policy_kwargs = dict(features_extractor_class=Unknown)
    model = tiny_model("MlpPolicy", VectorBox(), learning_rate=lambda _: 1e-3, policy_kwargs=policy_kwargs)
    file = io.BytesIO()
    model.save(file)
    with pytest.raises(
        ArchiveError, match=r"test_archive.Unknown.*custom_objects=\{'learning_rate': ..., 'policy_kwargs'"
    ):
        CuReSAC.load(file)
    with pytest.raises(ArchiveError, match=r"load with custom_objects=\{'policy_kwargs': ...\}"):
        CuReSAC.load(file, learning_rate=0.1)
    given = {"learning_rate": lambda _: 1e-3, "policy_kwargs": model.policy_kwargs}
    assert differences(state_of(model), state_of(CuReSAC.load(file, custom_objects=given))) == []


def test_settings_that_the_class_has_not() -> None:
    """A subclass's own settings come back; the base class, which does not know them, refuses them but for trusted."""
    model = OwnModel("MlpPolicy", VectorBox(), spam=0.5, policy_kwargs=dict(net_arch=[4]), device="cpu")
    file = io.BytesIO()
    model.save(file)
    assert OwnModel.load(file).spam == 0.5
    assert OwnModel.load(file, spam=2.0).spam == 2.0
    with pytest.raises(ArchiveError, match=r"the setting 'spam', which CuReSAC does not have"):
        CuReSAC.load(file)
    assert CuReSAC.load(file, trusted=True).spam == 0.5


def test_what_was_noted_at_a_model_comes_back(tmp_path: Path) -> None:
    """An attribute that a callback has set, say; to a class that did not save it an archive gives none, nor a method's.

    Loading is by the class itself, by one that extends it, and from a checkpoint.
    """
    arguments: dict[str, Any] = dict(learning_starts=5, policy_kwargs=dict(net_arch=[4]), device="cpu")
    model: Any = OwnModel("MlpPolicy", VectorBox(), warmup_updates=0, **arguments)
    model.run_id, model.names = "abc", [np.str_("spam")]
    model.learn(10, callback=ExactCheckpoint(5, tmp_path))
    file = io.BytesIO()
    model.save(file)

    class Extended(OwnModel):
        """A user's class that extends the one that was saved."""

    loaded: list[Any] = [OwnModel.load(file), Extended.load(file), OwnModel.resume(tmp_path, VectorBox())]
    assert [(each.run_id, each.names) for each in loaded] == [("abc", ["spam"])] * 3
    with pytest.raises(ArchiveError, match=r"the setting 'names', which CuReSAC does not have"):
        CuReSAC.load(file)
    model.learn = "spam"
    model.save(file := io.BytesIO())
    with pytest.raises(ArchiveError, match=r"the setting 'learn', which OwnModel does not have"):
        OwnModel.load(file)


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(verbose=True),
        dict(srl_kwargs=OrderedDict(latent_penalty=1e-6)),
        dict(replay_buffer_kwargs=OrderedDict()),
        dict(policy_kwargs=dict(net_arch=(8,))),
        dict(policy_kwargs=dict(net_arch=OrderedDict(pi=(8,), qf=[np.int64(8)]))),
        dict(seed=np.int64(3), stats_window_size=np.int64(5)),
        dict(stats_window_size=10**6),
        dict(ent_coef=np.str_("auto_0.1"), srl=np.str_("rae")),
        {name: np.int64(2) for name in ("batch_size", "learning_starts", "gradient_steps", "warmup_updates")},
        {name: np.int64(2) for name in ("srl_period", "actor_update_interval", "target_update_interval")},
        {name: np.float32(0.5) for name in ("tau", "gamma", "curiosity_prob", "curiosity_beta", "curiosity_gamma")},
        {name: np.float32(0.5) for name in ("encoder_tau", "ent_coef_lr_factor", "target_entropy")},
        dict(ent_coef=np.float32(0.5), learning_starts=1e1),
    ],
    ids=str,
)
def test_whatever_can_be_trained_can_be_loaded(kwargs: dict[str, Any]) -> None:
    """Arguments of types that are not quite the documented ones, and a number of steps with an exponent."""
    model = tiny_model("MlpPolicy", VectorBox(), **kwargs).pretrain(1.2e1).learn(1.4e1)
    file = io.BytesIO()
    model.save(file)
    loaded = CuReSAC.load(file, env=VectorBox())
    assert differences(state_of(model), state_of(loaded)) == []
    if not {"policy_kwargs", "srl"} & kwargs.keys():  # of which others cannot be given
        for given in (dict(kwargs), dict(custom_objects=kwargs)):
            CuReSAC.load(file, **given).save(again := io.BytesIO())
            CuReSAC.load(again)
    assert loaded.learn(1e1, reset_num_timesteps=False).num_timesteps == 24


def test_a_model_for_which_memory_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its replay buffer is what can be smaller here."""

    def allocate(*args: Any, **kwargs: Any) -> None:
        raise MemoryError("Unable to allocate 68.7 GiB")

    file = io.BytesIO()
    tiny_model("MlpPolicy", VectorBox()).save(file)
    monkeypatch.setattr(ReplayBuffer, "__init__", allocate)
    with pytest.raises(
        ArchiveError, match=r"needs more memory than there is \(Unable to allocate 68.7 GiB\): load it with "
    ):
        CuReSAC.load(file, env=VectorBox())


def test_files_of_before_are_read() -> None:
    """Which hold the number of steps as it was given, and no class."""
    CuReSAC.load(io.BytesIO(saved_by(None)))
    CuReSAC.load(io.BytesIO(setting("_total_timesteps", 14.0)()))
    with pytest.raises(ArchiveError, match=r"_total_timesteps=14.5, but _total_timesteps is a whole number"):
        CuReSAC.load(io.BytesIO(setting("_total_timesteps", 14.5)()))


@pytest.mark.parametrize(("before", "after"), [(3, 1), (3, 2), (2, 3)])
def test_noise_of_another_number_of_environments(before: int, after: int) -> None:
    """Each has its own when training goes on."""
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2))
    file = io.BytesIO()
    tiny_model("MlpPolicy", DummyVecEnv([VectorBox] * before), action_noise=noise).learn(12).save(file)
    loaded = CuReSAC.load(file, env=DummyVecEnv([VectorBox] * after)).learn(12)
    assert np.shape(loaded.action_noise()) == ((after, 2) if after > 1 else (2,))


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(),
        dict(srl=None, curiosity=None),
        dict(ent_coef=0.1, curiosity="bonus"),
        dict(srl=None, curiosity=None, use_sde=True),
    ],
    ids=str,
)
def test_all_that_a_model_has_is_a_setting_with_a_schema_or_no_setting(kwargs: dict[str, Any]) -> None:
    """So that what else an archive may have is a subclass's own."""
    model = tiny_model("MlpPolicy", VectorBox(), learning_starts=5, **kwargs).learn(12)
    assert vars(model).keys() <= SCHEMA.keys() | NEVER_SAVED | DERIVED
    assert not SCHEMA.keys() & (NEVER_SAVED | DERIVED)
    assert {*model._excluded_save_params()} <= NEVER_SAVED | {"_custom_logger"}


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("name", sorted(NEVER_SAVED | DERIVED))
def test_parts_of_the_running_model_are_no_settings(name: str, trusted: bool) -> None:
    """No archive can set one, or have it asked for, nor does `save` write one."""
    for node in (None, {"placeholder": "spam"}):
        file = io.BytesIO(setting(name, node)())
        with pytest.raises(ArchiveError, match=rf"has {name}, which is no setting"):
            CuReSAC.load(file, custom_objects={name: None}, trusted=trusted)
    if name in NEVER_SAVED:
        with pytest.raises(ValueError, match=rf"include=\['{name}'\], which an archive does not hold"):
            example_model().save(io.BytesIO(), include=[name])


# ----------------------------------------------------------- SB3's conventions


def test_names_of_files(tmp_path: Path) -> None:
    """A suffix is added where there is none, folders are made, and a failed save leaves the file that was there."""
    model = tiny_model("MlpPolicy", VectorBox()).learn(12)
    with pytest.warns(UserWarning, match="does not exist"):
        model.save(tmp_path / "new" / "model")
    model.save_replay_buffer(str(tmp_path / "new" / "buffer"))
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["buffer.pkl", "model.zip"]
    CuReSAC.load(str(tmp_path / "new" / "model")).load_replay_buffer(tmp_path / "new" / "buffer.pkl")
    before = (tmp_path / "new" / "model.zip").read_bytes()
    model.get_parameters = lambda: 1 / 0  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError):
        model.save(tmp_path / "new" / "model.zip")
    assert (tmp_path / "new" / "model.zip").read_bytes() == before
    with pytest.raises(FileNotFoundError):
        CuReSAC.load(tmp_path / "none")


def test_a_link_is_written_through(tmp_path: Path) -> None:
    """As by SB3: what it leads to is replaced, and it stays a link."""
    (tmp_path / "latest.zip").symlink_to("model.zip")
    tiny_model("MlpPolicy", VectorBox(), batch_size=7).save(tmp_path / "latest")
    assert (tmp_path / "latest.zip").is_symlink() and CuReSAC.load(tmp_path / "model").batch_size == 7
    (tmp_path / "lost.zip").symlink_to("gone/model.zip")
    with pytest.warns(UserWarning, match="gone' does not exist. Will create it."):
        tiny_model("MlpPolicy", VectorBox(), batch_size=6).save(tmp_path / "lost")
    assert CuReSAC.load(tmp_path / "lost").batch_size == 6


def test_threads_save_to_one_file(tmp_path: Path) -> None:
    """As trials of one process do: one of them is the file, whole."""
    models = [tiny_model("MlpPolicy", VectorBox(), batch_size=size) for size in (5, 6, 7)]
    with ThreadPoolExecutor() as threads:
        list(threads.map(lambda model: [model.save(tmp_path / "model") for _ in range(5)], models))
    assert CuReSAC.load(tmp_path / "model").batch_size in (5, 6, 7)
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


def test_include_and_exclude(tmp_path: Path) -> None:
    """What is excluded is the class's default when loaded; what is no setting cannot be included."""
    model = tiny_model("MlpPolicy", VectorBox(), batch_size=7)
    model.save(tmp_path / "model", exclude=["batch_size", "seed"])
    loaded = CuReSAC.load(tmp_path / "model")
    assert (loaded.batch_size, loaded.seed) == (128, None)
    with pytest.raises(ValueError, match=r"include=\['replay_buffer'\], which an archive does not hold"):
        model.save(tmp_path / "other", include=["replay_buffer"])
    assert not (tmp_path / "other.zip").exists()


def test_unneeded_custom_objects() -> None:
    """rl-zoo's ``enjoy`` replaces schedules that this algorithm does not have: ignored, the others apply."""
    objects = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    model = ActingCuReSAC.load(io.BytesIO(examples()["model"]), custom_objects=objects, device="cpu")
    assert model.learning_rate == 0.0 and not hasattr(model, "clip_range") and model.replay_buffer is None


def test_system_info_is_printed_harmlessly(capsys: pytest.CaptureFixture) -> None:
    """Control sequences for the terminal are left out."""
    file = changed_model(**{"system_info.txt": b"fine\n\x1b[2Jevil"})
    CuReSAC.load(io.BytesIO(file), print_system_info=True)
    out = capsys.readouterr().out
    assert "fine\n[2Jevil" in out and "\x1b" not in out


def pickled_model(model: SAC) -> bytes:
    """A model as SB3 saves it, and this package formerly did."""
    file = io.BytesIO()
    super(CuReSAC, model).save(file)
    return file.getvalue()


def test_pickled_archives_need_trust() -> None:
    """SB3's format is refused with the reason, and loads with ``trusted=True``; its tensors are safe either way."""
    model = tiny_model("CnnPolicy", PixelBox(), learning_rate=lambda _: 1e-3).learn(13)
    data = pickled_model(model)
    with pytest.raises(ArchiveError, match=r"unpickling runs any code .* load it with trusted=True"):
        CuReSAC.load(io.BytesIO(data))
    loaded = CuReSAC.load(io.BytesIO(data), trusted=True)
    assert differences(state_of(model), state_of(loaded)) == [] and loaded.learning_rate(1) == 1e-3
    other = tiny_model("CnnPolicy", PixelBox(), seed=3)
    with watching() as events:
        other.set_parameters(io.BytesIO(data))
    assert differences(model.get_parameters(), other.get_parameters()) == [] and events == []
    model.policy.encoder.trunk[0].bias.data.fill_(np.nan)
    with pytest.raises(ArchiveError, match=r"policy has .* with values that are not finite"):
        CuReSAC.load(io.BytesIO(pickled_model(model)), trusted=True)


@pytest.mark.parametrize("trusted", [False, True])
@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_other_algorithms(algorithm: Any, trusted: bool) -> None:
    """One sentence for SB3's other archives, trusted or not."""
    file = io.BytesIO()
    algorithm("MlpPolicy", VectorBox(), policy_kwargs=dict(net_arch=[4]), device="cpu").save(file)
    with pytest.raises(ArchiveError, match="was saved by another algorithm than CuReSAC"):
        CuReSAC.load(file, trusted=trusted)


def test_set_parameters_of_another_model() -> None:
    """Parameters are checked before the first one is set: the model stays what it was."""
    model = tiny_model("CnnPolicy", PixelBox()).learn(12)
    before = state_of(model)
    file = io.BytesIO()
    wide = tiny_model(
        "CnnPolicy", PixelBox(), policy_kwargs=dict(features_extractor_kwargs=dict(n_filters=5, n_layers=2))
    )
    wide.save(file)
    for source in (file, wide.get_parameters()):
        with pytest.raises(ArchiveError, match=r"policy has .* of shape .* are expected: it belongs to a model with"):
            model.set_parameters(source)
    tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None, policy_kwargs=dict(share_encoder=True)).save(file)
    with pytest.raises(ArchiveError, match="lacks parameters"):
        model.set_parameters(file)
    sequential = tiny_model("CnnPolicy", PixelBox(), update="sequential")
    sequential.save(file := io.BytesIO())
    for source in (file, sequential.get_parameters()):
        with pytest.raises(RuntimeError, match=r"the saved encoder was trained by .* load with the update="):
            model.set_parameters(source)
    assert differences(before, state_of(model)) == []


def test_set_parameters_of_other_types() -> None:
    """As SB3: means of models are float64, and states of optimisers may be of an older torch, which lack options."""
    source, model = (tiny_model("MlpPolicy", VectorBox(), seed=seed).learn(12) for seed in (0, 1))
    given = source.get_parameters()
    given["policy"] = {name: value.double() for name, value in given["policy"].items()}
    del given["actor.optimizer"]["param_groups"][0]["decoupled_weight_decay"]
    model.set_parameters(given)
    assert differences(source.policy.state_dict(), model.policy.state_dict()) == []


# --------------------------------------------------------------- replay buffers


@pytest.mark.parametrize("steps", [0, 30, 90], ids=["empty", "part", "full"])
@pytest.mark.parametrize(
    "kwargs",
    [
        dict(),
        dict(srl=None, curiosity=None, n_steps=3),
        dict(
            srl=None,
            curiosity=None,
            optimize_memory_usage=True,
            replay_buffer_class=ReplayBuffer,
            replay_buffer_kwargs=dict(handle_timeout_termination=False),
        ),
    ],
    ids=["frames", "n-step", "memory-efficient"],
)
def test_replay_buffers(kwargs: dict[str, Any], steps: int, tmp_path: Path) -> None:
    """Every known class, empty, filled in part or all round: the same batches, in files as large as the contents."""
    model = tiny_model("CnnPolicy", PixelBox(), buffer_size=60, learning_starts=10**6, **kwargs)
    if steps:
        model.learn(steps)
    model.save_replay_buffer(tmp_path / "buffer")
    other = tiny_model("CnnPolicy", PixelBox(), buffer_size=40, seed=1, **kwargs)
    with watching() as events:
        other.load_replay_buffer(tmp_path / "buffer")
    assert events == [] and type(other.replay_buffer) is type(model.replay_buffer)
    first, second = (
        {name: value for name, value in vars(owner.replay_buffer).items() if name not in ("frames", "frame_numbers")}
        for owner in (model, other)
    )
    n_rows = min(steps, 60)
    arrays = [name for name, value in first.items() if isinstance(value, np.ndarray) and len(value) == 60]
    for name in arrays:
        first[name], second[name] = first[name][:n_rows], second[name][:n_rows]
    assert differences({**first, "device": 0, "observation_space": 0, "action_space": 0},
                       {**second, "device": 0, "observation_space": 0, "action_space": 0}) == []  # fmt: skip
    if steps:
        batches = []
        for owner in (model, other):
            np.random.seed(0)
            batches.append(owner.replay_buffer.sample(50)._asdict())
        assert differences(*batches) == []
        other.learn(5)
    sizes = sum(getattr(model.replay_buffer, name)[: n_rows + 1].nbytes for name in arrays)
    frames = getattr(model.replay_buffer, "frames", np.zeros(0))[: getattr(model.replay_buffer, "_n_frames", 0)]
    assert (tmp_path / "buffer.pkl").stat().st_size < 10_000 + sizes + frames.nbytes


class Goals(gym.Env):
    """A goal environment in which nothing happens."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    observation_space = spaces.Dict(
        {name: spaces.Box(-1, 1, (2,), np.float32) for name in ("observation", "achieved_goal", "desired_goal")}
    )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self.left = 5
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self.left -= 1
        return self.observation_space.sample(), 0.0, False, self.left == 0, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, infos: Any) -> np.ndarray:
        return np.zeros(len(achieved))


def test_dictionaries_and_pickled_buffers(tmp_path: Path) -> None:
    """Dict observations need no pickle; HER's buffer is SB3's pickle, which needs trust, and says why."""
    kwargs: dict[str, Any] = dict(srl=None, curiosity=None, policy_kwargs=dict(net_arch=[4]), learning_starts=5)
    model = CuReSAC("MultiInputPolicy", Goals(), buffer_size=50, device="cpu", **kwargs).learn(12)
    model.save_replay_buffer(tmp_path / "dictionaries")
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", env=Goals())
    loaded.load_replay_buffer(tmp_path / "dictionaries")
    for name in ("observations", "next_observations"):
        stored = getattr(model.replay_buffer, name), getattr(loaded.replay_buffer, name)
        assert differences(*({key: array[:12] for key, array in arrays.items()} for arrays in stored)) == []
    her = CuReSAC(
        "MultiInputPolicy", Goals(), replay_buffer_class=HerReplayBuffer, buffer_size=50, device="cpu", **kwargs
    ).learn(12)
    her.save_replay_buffer(tmp_path / "her")
    with pytest.raises(
        ArchiveError, match=r"her' is no replay buffer that this package saved without pickle.*trusted=True"
    ):
        her.load_replay_buffer(tmp_path / "her")
    her.load_replay_buffer(tmp_path / "her", trusted=True)
    assert isinstance(her.replay_buffer, HerReplayBuffer) and her.replay_buffer.pos == 12
    with pytest.raises(ArchiveError, match="holds a DictReplayBuffer, but this model has a HerReplayBuffer"):
        her.load_replay_buffer(tmp_path / "dictionaries")


def test_a_buffer_that_skips_is_known_by_name() -> None:
    """As class of the replay buffer it needs no custom_objects."""
    model = tiny_model(
        "MlpPolicy", VectorBox(), srl=None, curiosity=None, replay_buffer_class=SkippingReplayBuffer
    ).learn(12)
    file, buffer = io.BytesIO(), io.BytesIO()
    model.save(file)
    model.save_replay_buffer(buffer)
    loaded = CuReSAC.load(file)
    loaded.load_replay_buffer(buffer)
    assert type(loaded.replay_buffer) is loaded.replay_buffer_class is SkippingReplayBuffer
    assert differences(loaded.replay_buffer.rewards[:12], model.replay_buffer.rewards[:12]) == []


# ---------------------------------------------------------------- the corpus

HERE = Path(__file__)


class Payload:
    """Unpickled, it would write a file."""

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {HERE.parent}/executed",)


def changed_model(**members: bytes | None) -> bytes:
    """The example with other members; None: without it."""
    found = {**members_of(examples()["model"]), **members}
    return zip_of({name: content for name, content in found.items() if content is not None})


def changed_json(kind: str, change: Callable[[dict[str, Any]], Any]) -> bytes:
    """An example whose JSON was changed in place (``change`` gets the settings, or the state)."""
    members = members_of(examples()[kind])
    name = "data" if kind == "model" else "state.json"
    node = json.loads(members[name])
    change(node["settings"] if kind == "model" else node["state"]["dict"])
    return zip_of({**members, name: json.dumps(node).encode()})


def setting(name: str, value: Any) -> Callable[[], bytes]:
    """A model with another setting, as JSON."""
    return lambda: changed_json("model", lambda settings: settings.update({name: value}))


def saved_by(name: Any, **settings: Any) -> bytes:
    """A model of another class, or without one as in files before there were any, with further settings."""
    members = members_of(examples()["model"])
    content = json.loads(members["data"])
    content["settings"].update(settings)
    del content["class"]
    content |= {} if name is None else {"class": name}
    return zip_of({**members, "data": json.dumps(content).encode()})


def policy_kwarg(name: str, value: Any) -> Callable[[], bytes]:
    """A model with another argument of its policy."""
    return lambda: changed_json("model", lambda settings: settings["policy_kwargs"]["dict"].update({name: value}))


def torch_bytes(value: Any, **kwargs: Any) -> bytes:
    file = io.BytesIO()
    th.save(value, file, **kwargs)
    return file.getvalue()


def changed_weights(member: str, change: Callable[[Any], Any]) -> Callable[[], bytes]:
    """A model with another content of a member of torch."""

    def build() -> bytes:
        content = th.load(io.BytesIO(members_of(examples()["model"])[member]))
        result = change(content)
        return changed_model(**{member: torch_bytes(content if result is None else result)})

    return build


def changed_pickle(member: str, change: Callable[[bytes], bytes]) -> Callable[[], bytes]:
    """A model in which the pickle within a member of torch is another one."""

    def build() -> bytes:
        inner = members_of(members_of(examples()["model"])[member])
        name = next(name for name in inner if name.endswith("data.pkl"))
        inner[name] = change(inner[name])
        return changed_model(**{member: zip_of(inner)})

    return build


def with_numel(pickle_bytes: bytes) -> bytes:
    """A storage that claims a billion numbers, and a tensor of them: read, it would be memory beyond the file's."""
    at = next(at for op, arg, at in pickletools.genops(pickle_bytes) if op.name == "BINPERSID")
    start = max(a for op, arg, a in pickletools.genops(pickle_bytes) if a < at and op.name in ("BININT1", "BININT2"))
    length = 2 if pickle_bytes[start : start + 1] == b"K" else 3
    return pickle_bytes[:start] + b"J" + struct.pack("<i", 10**9) + pickle_bytes[start + length :]


def laughs(_: bytes) -> bytes:
    """A list of two lists of two lists ..., 2^60 in all."""
    steps = b"".join(b"]q%c(h%ch%ce" % (i + 1, i, i) for i in range(60))
    return b"\x80\x02]q\x00" + steps + b"."


def raw_zip(members: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members:
            with pytest.warns() if name in archive.namelist() else _nothing():
                archive.writestr(zipfile.ZipInfo(name), content, compression)
    return file.getvalue()


def _nothing() -> Any:
    return io.BytesIO()


def patched(data: bytes, old: bytes, new: bytes) -> bytes:
    """A file with other bytes somewhere, at the last place where the old ones are."""
    at = data.rindex(old)
    return data[:at] + new + data[at + len(old) :]


def declared_larger() -> bytes:
    """A directory entry that declares 2 GB for the last member."""
    data = examples()["model"]
    at = data.rindex(b"PK\1\2")
    return data[: at + 20] + struct.pack("<LL", 2**31, 2**31) + data[at + 28 :]


def sb3_with(name: str) -> bytes:
    """SB3's format with a payload among the settings."""
    file = io.BytesIO()
    data = {"srl": "rae", "curiosity": None, "policy_class": CuReSAC, name: Payload()}
    save_to_zip_file(file, data=data, params={}, pytorch_variables={})
    return file.getvalue()


def npy(array: Any = None, header: str | None = None, body: bytes = b"") -> bytes:
    file = io.BytesIO()
    if header is None:
        np.save(file, array, allow_pickle=True)
        return file.getvalue()
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def optimizer_state(change: Callable[[dict], None]) -> Callable[[], bytes]:
    return changed_weights("critic.optimizer.pth", change)


def as_pickle(name: str) -> Callable[[], bytes]:
    return lambda: changed_model(**{name: pickle.dumps(Payload(), protocol=2)})


def as_torch(name: str) -> Callable[[], bytes]:
    return lambda: changed_model(**{name: torch_bytes({"weight": Payload()})})


def box(shape: list[int], low: Any = 0, high: Any = 255, dtype: str = "|u1") -> dict[str, Any]:
    return {"Box": {"tuple": [low, high, shape, dtype]}}


def noisy(noise: Any) -> bytes:
    """A model with an action noise."""
    model, file = example_model(), io.BytesIO()
    try:
        model.action_noise = noise
        model.save(file)
    finally:
        model.action_noise = None
    return file.getvalue()


SLOTS = [
    "policy.pth", "actor.optimizer.pth", "policy.encoder_optimizer.pth", "curious_ent_coef_optimizer.pth",
    "pytorch_variables.pth",
]  # fmt: skip

MODELS: dict[str, Callable[[], bytes]] = {
    # code
    "a pickle": lambda: pickle.dumps(Payload()),
    "a pickle as data": as_pickle("data"),
    "a pickle as an array": lambda: changed_model(**{"arrays/0.npy": npy(np.array([Payload()], dtype=object))}),
    **{f"a pickle as {name}": as_pickle(name) for name in SLOTS},
    **{f"a payload in {name}": as_torch(name) for name in SLOTS},
    "torch's old format": lambda: changed_model(
        **{"policy.pth": torch_bytes({"w": th.zeros(1)}, _use_new_zipfile_serialization=False)}
    ),
    "SB3's format, a payload as a setting": lambda: sb3_with("learning_rate"),
    "SB3's format, a payload that nobody needs": lambda: sb3_with("spam"),
    "cloudpickle as data": lambda: changed_model(data=cloudpickle.dumps(lambda: os.system("true"))),
    "a global": changed_pickle("policy.pth", lambda _: b"\x80\x02cos\nsystem\nq\x00X\x04\x00\x00\x00true\x85R."),
    "a global by the stack": changed_pickle("policy.pth", lambda _: b"\x80\x04\x8c\x02os\x8c\x06system\x93."),
    "an allowed class with arguments": changed_pickle(
        "policy.pth", lambda _: b"\x80\x02ccollections\nOrderedDict\n]\x85R."
    ),
    "a persistent id without storage": changed_pickle("policy.pth", lambda _: b"\x80\x02K\x01Q."),
    "an unknown instruction": changed_pickle(
        "policy.pth", lambda p: p[:-1] + b"\x8e" + struct.pack("<Q", 2**40) + b"."
    ),
    "a huge memo": changed_pickle("policy.pth", lambda p: p[:2] + b"}r" + struct.pack("<I", 2**32 - 1) + p[2:]),
    "2^60 lists": changed_pickle("policy.pth", laughs),
    "an empty stack": changed_pickle("policy.pth", lambda _: b"\x80\x02R."),
    "no end": changed_pickle("policy.pth", lambda p: p[:-1]),
    "a storage larger than its member": changed_pickle("policy.pth", with_numel),
    # no archive
    "nothing": lambda: b"",
    "a text": lambda: b"I am a model\n" * 100,
    "random bytes": lambda: np.random.default_rng(0).bytes(10_000),
    "half a file": lambda: examples()["model"][: len(examples()["model"]) // 2],
    "a byte missing": lambda: examples()["model"][:-1],
    "a byte more": lambda: examples()["model"] + b"x",
    "an empty zip": lambda: zip_of({}),
    "a replay buffer": lambda: examples()["buffer"],
    "a file of torch": lambda: torch_bytes({"w": th.zeros(3)}),
    # zip
    "compressed": lambda: raw_zip(list(members_of(examples()["model"]).items()), zipfile.ZIP_DEFLATED),
    "a zip bomb": lambda: raw_zip([("data", b" " * 10**7)], zipfile.ZIP_DEFLATED),
    "a bomb within": lambda: changed_model(
        **{"policy.pth": raw_zip([("archive/data.pkl", bytes(10**7))], zipfile.ZIP_LZMA)}
    ),
    "a member above": lambda: changed_model(**{"../evil": b"x"}),
    "a member at the root": lambda: changed_model(**{"/etc/evil": b"x"}),
    "a member on a drive": lambda: changed_model(**{"C:\\evil": b"x"}),
    "an unknown member": lambda: changed_model(**{"evil.py": b"x"}),
    "two equal members": lambda: raw_zip([*members_of(examples()["model"]).items(), ("data", b"{}")]),
    "a declared size": declared_larger,
    "20 000 members": lambda: changed_model(**{f"arrays/{i}.npy": b"" for i in range(20_000)}),
    "encrypted": lambda: patched(examples()["model"], b"PK\1\2\x14\x03\x14\0\0\0", b"PK\1\2\x14\x03\x14\0\1\0"),
    "a wrong checksum": lambda: patched(examples()["model"], b'"settings"', b'"Settings"'),
    "no data": lambda: changed_model(data=None),
    "no version": lambda: changed_model(_stable_baselines3_version=None),
    "no networks": lambda: changed_model(**{"policy.pth": None}),
    "further networks": lambda: changed_model(**{"spam.pth": torch_bytes({"w": th.zeros(2)})}),
    # JSON
    "deep JSON": lambda: changed_model(data=b'{"sb3_cure": 1, "settings": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"),
    "rather deep JSON": setting("spam", json.loads("[" * 500 + "]" * 500)),
    "large JSON": setting("spam", [0] * 3_000_000),
    "no JSON": lambda: changed_model(data=b"{'sb3_cure': 1}"),
    "JSON of a list": lambda: changed_model(data=b"[1, 2]"),
    "JSON with NaN": lambda: changed_model(data=b'{"sb3_cure": 1, "settings": {"gamma": NaN}}'),
    "JSON with two equal keys": lambda: changed_model(data=b'{"sb3_cure": 1, "sb3_cure": 1, "settings": {}}'),
    "a number of 5000 digits": lambda: changed_model(
        data=b'{"sb3_cure": 1, "settings": {"seed": ' + b"9" * 5000 + b"}}"
    ),
    "another version": lambda: changed_model(data=b'{"sb3_cure": 99, "settings": {}}'),
    "no settings": lambda: changed_model(data=b'{"sb3_cure": 1, "settings": {}}'),
    # settings
    "an unknown type": setting("gamma", {"eval": "1"}),
    "an unknown class": setting("policy_class", {"name": "os.system"}),
    "a class of another kind": setting("policy_class", {"name": "torch.nn.modules.activation.ReLU"}),
    "an unknown setting": lambda: saved_by("test_archive.OwnModel", spam=1),
    "an unknown setting of nobody": lambda: saved_by(None, spam=1),
    "a class that is no name": lambda: saved_by(7),
    "a part of the running model": setting("policy", 1),
    "a method's name": setting("_setup_model", 1),
    "a placeholder": setting("gamma", {"placeholder": "\x1b[2J" + "x" * 10_000}),
    "an array that is not there": setting("_last_obs", {"array": 7}),
    "an array used twice": setting("_last_original_obs", {"array": 0}),
    **{
        f"{name}={value!s:.30}": setting(name, value)
        for name, value in {
            "gamma": "x",
            "tau": {"float": "7ff8000000000000"},
            "num_timesteps": -1,
            "seed": [0],
            "learning_rate": True,
            "n_envs": 10**9,
            "buffer_size": 10**15,
            "batch_size": 0,
            "use_sde": 1,
            "srl": "spam",
            "task": None,
            "ent_coef": "auto_nan",
            "train_freq": {"TrainFreq": {"tuple": [1, "years"]}},
            "policy_kwargs": [],
            "_mixer": 3,
            "log_ent_coef": 1.0,
            "ep_info_buffer": 5,
            "replay_buffer_class": {"name": "sb3_cure.srl.contrastive.CURL"},
            "action_noise": {"NormalActionNoise": {"tuple": [0, 1, "|O"]}},
            "_stats_window_size": 10**12,
            "curiosity_prob": {"FloatSchedule": {"tuple": [{"name": "torch.nn.modules.activation.ReLU"}]}},
        }.items()
    },
    # memory
    "a huge observation": setting("observation_space", box([10**6, 10**6, 3])),
    "huge spaces together": setting("observation_space", {"Tuple": {"tuple": [box([2000, 2000])] * 50}}),
    "a huge discrete space": setting("observation_space", {"Discrete": {"tuple": [10**12, 0, "<i8"]}}),
    "many long stacks": lambda: changed_json(
        "model",
        lambda settings: settings.update(n_envs=2**16, replay_buffer_kwargs={"dict": {"frame_stack": 4096}}),
    ),
    "huge noise": lambda: noisy(NormalActionNoise(np.zeros(10**5), np.zeros(1))),
    "noise that is large when it is drawn": lambda: noisy(NormalActionNoise(np.zeros((10**4, 1)), np.zeros((1, 2)))),
    "noise of noise": lambda: noisy(VectorizedActionNoise(NOISES[1], 3)),
    "huge layers": policy_kwarg("net_arch", [10**6, 10**6]),
    "many layers": policy_kwarg("net_arch", [1] * 300_000),
    "many critics": policy_kwarg("n_critics", 10**9),
    "many filters": policy_kwarg("features_extractor_kwargs", {"dict": {"n_filters": 10**7, "n_layers": 2}}),
    "many features": policy_kwarg("features_extractor_kwargs", {"dict": {"features_dim": 10**10, "n_layers": 2}}),
    "a huge bank": setting("srl_kwargs", {"dict": {"bank_size": 10**12}}),
    # weights
    "NaN weights": changed_weights(
        "policy.pth", lambda state: state["encoder.trunk.0.weight"].fill_(math.nan)[:0].tolist() or None
    ),
    "infinite bias": changed_weights("policy.pth", lambda state: {**state, "actor.mu.bias": th.full((2,), math.inf)}),
    "NaN temperature": changed_weights(
        "pytorch_variables.pth", lambda state: {**state, "log_ent_coef": th.tensor([math.nan])}
    ),
    "a wrong shape": changed_weights("policy.pth", lambda state: {**state, "actor.mu.bias": th.zeros(3)}),
    "a wrong type": changed_weights("policy.pth", lambda state: {**state, "actor.mu.bias": th.zeros(2).double()}),
    "a number for weights": changed_weights("policy.pth", lambda state: {**state, "actor.mu.bias": 0.0}),
    "a parameter missing": changed_weights(
        "policy.pth", lambda state: {key: value for key, value in state.items() if key != "actor.mu.bias"}
    ),
    "a parameter more": changed_weights("policy.pth", lambda state: {**state, "spam": th.zeros(2)}),
    "an expanded tensor": changed_weights(
        "policy.pth", lambda state: {**state, "actor.mu.bias": th.zeros(1).expand(2)}
    ),
    "weights in a list": changed_weights("policy.pth", lambda state: [th.zeros(2)]),
    "variables missing": changed_weights("pytorch_variables.pth", lambda state: {}),
    "an optimiser's moment of another shape": optimizer_state(
        lambda state: state["state"][0].update(exp_avg=th.zeros(1))
    ),
    "an optimiser's infinite moment": optimizer_state(
        lambda state: state["state"][0]["exp_avg_sq"].fill_(math.inf)[:0].tolist() or None
    ),
    "an optimiser without moments": optimizer_state(
        lambda state: state["state"][0].pop("exp_avg")[:0].tolist() or None
    ),
    "an optimiser of more parameters": optimizer_state(lambda state: state["state"].update({99: state["state"][0]})),
    "an optimiser's rate of NaN": optimizer_state(lambda state: state["param_groups"][0].update(lr=math.nan)),
    "an optimiser's rate of text": optimizer_state(lambda state: state["param_groups"][0].update(lr=[{"a": 1}])),
    "an optimiser's other parameters": optimizer_state(lambda state: state["param_groups"][0].update(params=[0, 0])),
    "an encoder's optimiser without sizes": changed_weights(
        "policy.encoder_optimizer.pth", lambda state: state.pop("mean_squares") and None
    ),
}


def changed_buffer(change: Callable[[dict[str, Any]], Any]) -> Callable[[], bytes]:
    return lambda: changed_json("buffer", change)


def changed_array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[], bytes]:
    """A replay buffer with another array."""

    def build() -> bytes:
        members = members_of(examples()["buffer"])
        state = json.loads(members["state.json"])["state"]["dict"]
        member = f"arrays/{(state.get(name) or state['rows']['dict'][name])['array']}.npy"
        return zip_of({**members, member: npy(change(np.load(io.BytesIO(members[member]))))})

    return build


def old_buffer() -> bytes:
    file = io.BytesIO()
    super(CuReSAC, example_model()).save_replay_buffer(file)
    return file.getvalue()


BUFFERS: dict[str, Callable[[], bytes]] = {
    "a pickle": lambda: pickle.dumps(Payload()),
    "an old pickled buffer": old_buffer,
    "nothing": lambda: b"",
    "half a file": lambda: examples()["buffer"][: len(examples()["buffer"]) // 2],
    "a model": lambda: examples()["model"],
    "a state": lambda: examples()["state"],
    "a zip bomb": lambda: raw_zip([("state.json", b" " * 10**7)], zipfile.ZIP_DEFLATED),
    "another class": changed_buffer(lambda state: state.update({"class": "ReplayBuffer"})),
    "other environments": changed_buffer(lambda state: state.update(n_envs=10**9)),
    "a huge size": changed_buffer(lambda state: state.update(buffer_size=10**15)),
    "a row outside": changed_buffer(lambda state: state.update(pos=10**6)),
    "a negative row": changed_buffer(lambda state: state.update(pos=-1)),
    "full although it is not": changed_buffer(lambda state: state.update(full=True)),
    "full or not": changed_buffer(lambda state: state.update(full=1)),
    "more valid rows": changed_buffer(lambda state: state.update(n_valid=10**6)),
    "more frames": changed_buffer(lambda state: state.update(n_frames=10**6)),
    "rows missing": changed_buffer(lambda state: state["rows"]["dict"].pop("rewards")),
    "rows in a list": changed_buffer(lambda state: state.update(rows=[])),
    "no counter": changed_buffer(lambda state: state.pop("pos")),
    "NaN rewards": changed_array("rewards", lambda rewards: np.full_like(rewards, np.nan)),
    "infinite actions": changed_array("actions", lambda actions: np.full_like(actions, np.inf)),
    "other actions": changed_array("actions", lambda actions: np.zeros((*actions.shape[:2], 7), actions.dtype)),
    "double rewards": changed_array("rewards", lambda rewards: rewards.astype(np.float64)),
    "objects": changed_array("rewards", lambda rewards: np.array([Payload()], dtype=object)),
    "small frames": changed_array("frames", lambda frames: frames[:, :, :5]),
    "frames missing": changed_array("frames", lambda frames: frames[:3]),
    "frames outside": changed_array("frame_slots", lambda slots: slots + 10**6),
    "negative frames": changed_array("frame_slots", lambda slots: slots - 10**6),
    "tails outside": changed_array("tails", lambda tails: tails + 10**12),
}

STATES: dict[str, Callable[[], bytes]] = {
    "a pickle": lambda: pickle.dumps(Payload()),
    "nothing": lambda: b"",
    "objects": lambda: state_with(npy(np.array([Payload()], dtype=object))),
    "no header": lambda: state_with(b"spam"),
    "a header of code": lambda: state_with(npy(header="__import__('os').system('true')")),
    "a deep header": lambda: state_with(npy(header="-" * 100 + "1")),
    "a huge shape": lambda: state_with(npy(header="{'descr': '<f8', 'fortran_order': False, 'shape': (10**12,), }")),
    "a larger shape": lambda: state_with(
        npy(header="{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,), }", body=bytes(8))
    ),
    "a negative shape": lambda: state_with(
        npy(header="{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -1), }", body=bytes(8))
    ),
    "a shape without numbers": lambda: state_with(
        npy(header="{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999), }")
    ),
    "a structure": lambda: state_with(npy(np.zeros(2, dtype=[("a", "f4")]))),
    "bools that are none": lambda: state_with(
        npy(header="{'descr': '|b1', 'fortran_order': False, 'shape': (2,), }", body=b"\2\1")
    ),
    "a compressed array": lambda: raw_zip(list(members_of(examples()["state"]).items()), zipfile.ZIP_BZIP2),
    "an array too many": lambda: zip_of({**members_of(examples()["state"]), "arrays/3.npy": npy(np.zeros(2))}),
    "a gap in the arrays": lambda: zip_of({**members_of(examples()["state"]), "arrays/9.npy": npy(np.zeros(2))}),
    "a list": lambda: zip_of({"state.json": b'{"version": 1, "state": []}'}),
    "a deque that is too long": lambda: zip_of(
        {"state.json": b'{"version": 1, "state": {"dict": {"a": {"deque": [1, [1, 2]]}}}}'}
    ),
    "a tensor of another size": lambda: changed_json(
        "state", lambda state: state["weights"]["tensor"].__setitem__(1, [9, 9])
    ),
    "a tensor of no type": lambda: changed_json(
        "state", lambda state: state["weights"]["tensor"].__setitem__(0, "spam")
    ),
    "a scalar of objects": lambda: changed_json("state", lambda state: state.update(a={"scalar": ["|O", "0" * 16]})),
}


def state_with(array: bytes) -> bytes:
    return zip_of({"state.json": b'{"version": 1, "state": {"dict": {"a": {"array": 0}}}}', "arrays/0.npy": array})


CORPUS = [
    pytest.param(kind, build, id=f"{kind}: {name}")
    for kind, files in {"model": MODELS, "buffer": BUFFERS, "state": STATES}.items()
    for name, build in files.items()
]


@pytest.mark.parametrize("kind, build", CORPUS)
def test_hostile_and_broken_files(kind: str, build: Callable[[], bytes]) -> None:
    """Refused in one sentence; no code is run, no file is written, and memory stays where it was."""
    data = build()
    assert outcome(lambda: load(kind, data)) == "refused"
    assert not (HERE.parent / "executed").exists()


@pytest.mark.parametrize("name", ["many long stacks", "huge noise", "noise that is large when it is drawn"])
def test_what_would_become_large_is_named(name: str) -> None:
    """Rather than refused for lack of memory, which a larger machine has."""
    with pytest.raises(ArchiveError, match=r"the archive has .*: it (is damaged, or )?was made to exhaust memory"):
        load("model", MODELS[name]())


def test_a_noise_is_not_copied_for_every_environment() -> None:
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.ones(2)), 200)
    noise.base_noise = NormalActionNoise(np.zeros(10**5), np.ones(10**5))
    data = noisy(noise)
    tracemalloc.start()
    try:
        with pytest.raises(ArchiveError, match=r"action_noise with numbers of shape \(100000,\), but actions have"):
            load("model", data)
        assert tracemalloc.get_traced_memory()[1] < 10 * len(data) < 200 * 8 * 10**5
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("shape", [(), (1,), (2,)])
def test_noises_of_any_shape_that_fits_come_back(shape: tuple[int, ...], n_envs: int) -> None:
    base = NormalActionNoise(np.zeros(shape), np.ones(shape))
    read = CuReSAC.load(io.BytesIO(noisy(base if n_envs == 1 else VectorizedActionNoise(base, n_envs)))).action_noise
    assert len(getattr(read, "noises", [read])) == n_envs and getattr(read, "base_noise", read)._mu.shape == shape


@pytest.mark.parametrize(
    "name", ["a payload in policy.pth", "NaN weights", "a wrong shape", "a storage larger than its member"]
)
def test_hostile_parameters(name: str) -> None:
    """``set_parameters`` of such a file: the same refusal, and the model stays what it was."""
    model = example_model()
    before = state_of(model)
    data = MODELS[name]()
    assert outcome(lambda: model.set_parameters(io.BytesIO(data))) == "refused"
    assert differences(before, state_of(model)) == []


def test_the_payload_works() -> None:
    """The corpus would notice: the same payload, trusted, is run."""
    with watching() as events:
        with pytest.raises(Exception):  # noqa: B017
            CuReSAC.load(io.BytesIO(sb3_with("spam")), trusted=True)
    (HERE.parent / "executed").unlink()
    assert any(event.startswith("os.system") for event in events)


def test_fuzz() -> None:
    """500 mutated files: loaded or refused in one sentence, nothing else."""
    counts, failures = fuzz(500, seed=1)
    assert failures == []
    outcomes = [name.split(": ")[1] for count in counts.values() for name in count]
    assert {"loaded", "refused"} == set(outcomes)
