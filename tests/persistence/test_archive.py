"""Models and replay buffers from strangers: what is saved needs no pickle, and hostile files run nothing."""

import copy
import io
import json
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import Goal
from envs_for_tests import PixelBox, VectorBox, differences, state_of, tiny_model
from gymnasium import spaces
from payloads_for_tests import EXECUTED, Payload
from stable_baselines3 import SAC, TD3, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch import nn

from benchmarks.fuzz import (
    example_model,
    examples,
    fuzz,
    load,
    members_of,
    outcome,
    parts_of,
    safetensors_of,
    watching,
    zip_of,
)
from sb3_cure import CuReSAC
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.networks.encoders import VectorEncoder
from sb3_cure.persistence import ArchiveError, Persistence


def saved(model: Any, **kwargs: Any) -> io.BytesIO:
    """A model's archive."""
    model.save(file := io.BytesIO(), **kwargs)
    return file


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


def test_spaces_come_back() -> None:
    """To the type of their numbers and the order of their parts."""
    model: Any = tiny_model("MlpPolicy", VectorBox())
    model.spaces = SPACES
    loaded: Any = CuReSAC.load(saved(model))
    for space, read in zip(SPACES, loaded.spaces, strict=True):
        assert read == space and repr(read) == repr(space) and type(read) is type(space) and read.dtype == space.dtype


@pytest.mark.parametrize(
    ("schedule", "noise", "extras"),
    [
        (3e-4, NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)), {}),
        (ConstantSchedule(1e-3), NormalActionNoise(np.zeros(1), np.ones(1)), dict(curiosity=None)),
        (
            LinearSchedule(1e-3, 0.0, 0.5),
            VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.3), dt=0.5), 1),
            {},
        ),
        (FloatSchedule(LinearSchedule(1, 0, 1)), None, dict(curiosity=None)),
    ],
    ids=["number", "constant", "linear", "nested"],
)
def test_schedules_noises_and_classes_come_back(schedule: Any, noise: Any, extras: dict[str, Any]) -> None:
    policy_kwargs = dict(activation_fn=nn.ELU, optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.1))
    model: Any = tiny_model(
        "MlpPolicy", VectorBox(), learning_rate=schedule, action_noise=noise, policy_kwargs=policy_kwargs, **extras
    ).learn(14)
    loaded: Any = CuReSAC.load(saved(model))
    assert loaded.policy_kwargs == model.policy_kwargs and loaded.policy_class is model.policy_class
    with pytest.raises(ValueError, match="srl_kwargs differ"):  # of which the optimiser's would be ignored
        CuReSAC.load(saved(model), srl_kwargs=dict(decoder_weight_decay=0.5))
    assert loaded.train_freq == model.train_freq and loaded.replay_buffer_class is model.replay_buffer_class
    for progress in (1.0, 0.7, 0.1):
        assert loaded.lr_schedule(progress) == model.lr_schedule(progress)
    for each in (model, loaded) if noise is not None else ():
        np.random.seed(0)
        each.drawn = [each.action_noise() for _ in range(3)]
    assert differences(getattr(model, "drawn", 0), getattr(loaded, "drawn", 0)) == []
    assert differences(state_of(model), state_of(loaded)) == []


class Unknown(VectorEncoder):
    """A user's features extractor."""


class OwnModel(CuReSAC):
    """A user's algorithm with an argument of its own, and a counter."""

    n_calls = 0

    def __init__(self, *args: Any, spam: float = 1.0, **kwargs: Any):
        self.spam = spam
        super().__init__(*args, **kwargs)


def test_functions_and_own_classes_are_asked_for() -> None:
    """Named with the key to give, and not asked for when given either way."""
    policy_kwargs = dict(features_extractor_class=Unknown)
    model = tiny_model("MlpPolicy", VectorBox(), learning_rate=lambda _: 1e-3, policy_kwargs=policy_kwargs)
    file = saved(model)
    with pytest.raises(ArchiveError, match=r"Unknown.*custom_objects=\{('learning_rate|'policy_kwargs)'"):
        CuReSAC.load(file)
    with pytest.raises(ArchiveError, match=r"pass custom_objects=\{'policy_kwargs': ...\}"):
        CuReSAC.load(file, learning_rate=0.1)
    given = {"learning_rate": lambda _: 1e-3, "policy_kwargs": model.policy_kwargs}
    assert differences(state_of(model), state_of(CuReSAC.load(file, custom_objects=given))) == []


def test_attributes_of_subclasses_and_users_come_back() -> None:
    """A subclass's argument, and what a callback has set, say; but nothing that hides a method."""
    model: Any = OwnModel("MlpPolicy", VectorBox(), spam=0.5, policy_kwargs=dict(net_arch=[4]), device="cpu")
    model.names = [np.str_("spam")]
    model.n_calls += 1
    loaded: Any = OwnModel.load(saved(model))
    assert (loaded.spam, loaded.names, loaded.n_calls) == (0.5, ["spam"], 1)
    assert OwnModel.load(saved(model), spam=2.0).spam == 2.0
    model.learn = "spam"
    with pytest.raises(ArchiveError, match="has learn, which is no setting"):
        OwnModel.load(saved(model))


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(srl_kwargs=OrderedDict(latent_penalty=1e-6), policy_kwargs=dict(net_arch=dict(pi=(8,), qf=[np.int64(8)]))),
        dict(ent_coef=np.str_("auto_0.1"), srl=np.str_("rae"), batch_size=np.int64(2)),
        {name: np.float32(0.5) for name in ("tau", "gamma", "curiosity_prob", "target_entropy", "ent_coef")},
    ],
    ids=["containers", "texts", "numbers"],
)
def test_numbers_of_numpy_are_settings(kwargs: dict[str, Any]) -> None:
    """As TQC's target_entropy; they keep their type."""
    model = tiny_model("MlpPolicy", VectorBox(), **kwargs).learn(14)
    loaded = CuReSAC.load(saved(model), env=VectorBox())
    assert differences(state_of(model), state_of(loaded)) == []
    assert type(loaded.target_entropy) is type(model.target_entropy) and loaded.target_entropy == model.target_entropy
    assert loaded.learn(10, reset_num_timesteps=False).num_timesteps == 24


def test_no_archive_sets_parts_of_the_model() -> None:
    """Nor does `save` write one."""
    for name in example_model()._excluded_save_params():
        with pytest.raises(ArchiveError, match=rf"has {name}, which is no setting"):
            CuReSAC.load(io.BytesIO(setting(name, None)()))
        with pytest.raises(ValueError, match=rf"include=\['{name}'\], which an archive does not hold"):
            example_model().save(io.BytesIO(), include=[name])


def test_other_algorithms_are_saved_alike(tmp_path: Path) -> None:
    """The mixin needs nothing of CuReSAC."""

    class SafeTD3(Persistence, TD3):
        """TD3 without pickle."""

    arguments: Any = dict(learning_starts=5, buffer_size=50, device="cpu", policy_kwargs=dict(net_arch=[4]))
    arguments |= dict(replay_buffer_class=FrameStackReplayBuffer, replay_buffer_kwargs=dict(frame_stack=1))
    model = SafeTD3("MlpPolicy", VectorBox(), **arguments).learn(20)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SafeTD3.load(tmp_path / "model", env=VectorBox())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert differences(state_of(model), state_of(loaded)) == []
    assert loaded.learn(5, reset_num_timesteps=False).num_timesteps == 25


def test_noise_of_generalised_exploration_has_the_loaded_size(tmp_path: Path) -> None:
    class SafeSAC(Persistence, SAC):
        """SAC without pickle."""

    model: Any = SafeSAC("MlpPolicy", VectorBox(), use_sde=True, policy_kwargs=dict(net_arch=[4]))
    model.policy.actor.log_std.data.fill_(-20.0)  # as training would
    model.policy.reset_noise()
    model.save(tmp_path / "model")
    seen = np.ones((1, 2), np.float32)
    expected, found = (each.predict(seen)[0] for each in (model, SafeSAC.load(tmp_path / "model")))
    np.testing.assert_allclose(found, expected, atol=1e-4)


# ----------------------------------------------------------- SB3's conventions


def test_failed_save_leaves_the_file(tmp_path: Path) -> None:
    """A suffix is added where there is none, and folders are made."""
    model: Any = tiny_model("MlpPolicy", VectorBox()).learn(12)
    model.save(tmp_path / "new" / "model")
    model.save_replay_buffer(str(tmp_path / "new" / "buffer"))
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["buffer.pkl", "model.zip"]
    CuReSAC.load(str(tmp_path / "new" / "model")).load_replay_buffer(tmp_path / "new" / "buffer.pkl")
    before = (tmp_path / "new" / "model.zip").read_bytes()
    model.policy.actor.log_std.register_parameter("broken", nn.Parameter(th.zeros(2).to_sparse()))
    with pytest.raises(TypeError):
        model.save(tmp_path / "new" / "model.zip")
    assert (tmp_path / "new" / "model.zip").read_bytes() == before
    with pytest.raises(FileNotFoundError):
        CuReSAC.load(tmp_path / "none")


def test_links_are_written_through(tmp_path: Path) -> None:
    """As by SB3: what a link leads to is replaced, and it stays a link."""
    (tmp_path / "latest.zip").symlink_to("model.zip")
    tiny_model("MlpPolicy", VectorBox(), batch_size=7).save(tmp_path / "latest")
    assert (tmp_path / "latest.zip").is_symlink() and CuReSAC.load(tmp_path / "model").batch_size == 7


def test_arrays_of_a_setting_that_is_not_saved_are_not_written() -> None:
    """Nothing would read them."""
    model, sizes = tiny_model("MlpPolicy", VectorBox()), []
    for own in (lambda: 0, {"array": np.zeros(10**6), "function": lambda: 0}):
        model.own = own
        model.save(file := io.BytesIO())
        sizes.append(len(file.getvalue()))
    assert sizes[1] < sizes[0] + 1000


def test_excluded_settings_become_defaults() -> None:
    """Unless they are included, too."""
    loaded = CuReSAC.load(saved(tiny_model("MlpPolicy", VectorBox(), batch_size=7), exclude=["batch_size", "seed"]))
    assert (loaded.batch_size, loaded.seed) == (128, None)
    file = saved(tiny_model("MlpPolicy", VectorBox(), batch_size=7), exclude=["batch_size"], include=["batch_size"])
    assert CuReSAC.load(file).batch_size == 7


@pytest.mark.parametrize("version", [3, 99])
def test_files_of_other_versions_are_refused(version: int) -> None:
    sentence = f"has format {version} of another version of sb3_cure, and this one reads format 6"
    with pytest.raises(ArchiveError, match=sentence):
        CuReSAC.load(io.BytesIO(changed_data(lambda node: node.update(format=version))()))
    header, body = parts_of(examples()["buffer"])
    header["__metadata__"]["format"] = str(version)
    with pytest.raises(ArchiveError, match=sentence):
        example_model().load_replay_buffer(io.BytesIO(safetensors_of(header, body)))


def test_system_info_is_printed_harmlessly(capsys: pytest.CaptureFixture) -> None:
    """Control sequences for the terminal are left out."""
    file = zip_of({**members_of(examples()["model"]), "system_info.txt": b"fine\n\x1b[2Jevil"})
    CuReSAC.load(io.BytesIO(file), print_system_info=True)
    out = capsys.readouterr().out
    assert "fine\n[2Jevil" in out and "\x1b" not in out


def test_pickled_archives_need_trust() -> None:
    """SB3's format is refused with the reason, and loads with ``trusted=True``; its tensors are safe either way."""
    model = tiny_model("CnnPolicy", PixelBox(), learning_rate=lambda _: 1e-3).learn(13)
    BaseAlgorithm.save(model, file := io.BytesIO())
    with pytest.raises(ArchiveError, match=r"unpickling runs any code .* load it with trusted=True"):
        CuReSAC.load(file)
    loaded = CuReSAC.load(file, trusted=True)
    assert differences(state_of(model), state_of(loaded)) == [] and loaded.learning_rate(1) == 1e-3
    other = tiny_model("CnnPolicy", PixelBox(), seed=3)
    with watching() as events:
        other.set_parameters(file)
    assert differences(model.get_parameters(), other.get_parameters()) == [] and events == []


# ------------------------------------------------------------------ parameters


def test_parameters_of_another_model_are_refused() -> None:
    model = tiny_model("CnnPolicy", PixelBox()).learn(12)
    wide = tiny_model(
        "CnnPolicy", PixelBox(), policy_kwargs=dict(features_extractor_kwargs=dict(n_filters=5, n_layers=2))
    )
    for source in (saved(wide), wide.get_parameters()):
        with pytest.raises(RuntimeError, match="size mismatch"):
            model.set_parameters(source)
    alone = tiny_model("CnnPolicy", PixelBox(), srl=None, curiosity=None)
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters(saved(alone))


def update(model: Any) -> dict[str, Any]:
    """State after two updates from a given seed of the global generators."""
    np.random.seed(0)
    th.manual_seed(0)
    model.train(2, batch_size=8)
    return state_of(model)


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("way", ["load", "set_parameters", "deepcopy"])
def test_copies_update_alike_whatever_their_layout(way: str, fused: bool, tmp_path: Path) -> None:
    """Fused Adam steps parameters and moments in the order of memory, which differs with channels last."""
    policy_kwargs = dict(optimizer_kwargs=dict(fused=fused))
    model = tiny_model("CnnPolicy", PixelBox(channels_last=True, size=36), policy_kwargs=policy_kwargs)
    model.learn(14)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    if way == "deepcopy":
        other = copy.deepcopy(model)
    else:
        other = CuReSAC.load(tmp_path / "model", env=PixelBox(channels_last=True, size=36), device="cpu")
        other.load_replay_buffer(tmp_path / "buffer")
        other.set_logger(model.logger)
        if way == "set_parameters":
            other.set_parameters(model.get_parameters())
    permuted = 0
    for optimizer in other._optimizers():
        for parameter, state in optimizer.state.items():
            assert state["exp_avg"].stride() == state["exp_avg_sq"].stride() == parameter.stride()
            permuted += not parameter.is_contiguous()
    assert permuted > 0, "or nothing was compared"
    before = state_of(model)
    assert differences(before, state_of(other)) == []
    assert differences(update(model), update(other)) == []
    assert differences(before, state_of(model)) != []
    if way == "deepcopy":
        assert other.learn(5, reset_num_timesteps=False).num_timesteps == 19 and model.num_timesteps == 14


def test_optimizers_whose_state_has_other_shapes_are_loaded(tmp_path: Path) -> None:
    """Adafactor keeps sums of rows and columns."""
    model = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=dict(optimizer_class=th.optim.Adafactor)).learn(14)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model", VectorBox(), device="cpu")
    assert differences(state_of(model), state_of(loaded)) == []
    before = state_of(loaded)
    loaded.set_parameters(model.get_parameters())
    model.learn(5, reset_num_timesteps=False)  # which moves no number of the other one
    assert differences(before, state_of(loaded)) == [] != differences(before, state_of(model))
    assert loaded.learn(14)._n_updates > 0


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("moment", [th.zeros(()), th.zeros(1), th.zeros(10**4)], ids=lambda moment: str(moment.shape))
def test_moments_of_other_shapes_are_refused(moment: th.Tensor, fused: bool) -> None:
    """A fused step, which the file may ask for, would read and write beyond them; nothing of them is left."""
    policy_kwargs = dict(optimizer_kwargs=dict(fused=fused))
    model = tiny_model("MlpPolicy", VectorBox(), policy_kwargs=policy_kwargs).learn(12)
    parameters = model.get_parameters()
    parameters["critic.optimizer"]["param_groups"][0]["fused"] = True
    parameters["critic.optimizer"]["state"][0]["exp_avg"] = moment
    with pytest.raises(ArchiveError, match="an optimiser got exp_avg of shape"):
        model.set_parameters(parameters)
    assert not model.critic.optimizer.state
    model.train(1, 8)


# --------------------------------------------------------------- replay buffers


def goal_model(buffer_class: Any, **kwargs: Any) -> CuReSAC:
    kwargs |= dict(srl=None, curiosity=None, replay_buffer_class=buffer_class)
    return tiny_model("MultiInputPolicy", Goal(), **kwargs).learn(12)


def test_dictionaries_are_saved_without_pickle(tmp_path: Path) -> None:
    model, other = goal_model(None), goal_model(None, seed=1)
    model.save_replay_buffer(tmp_path / "dictionaries")
    other.load_replay_buffer(tmp_path / "dictionaries")
    assert differences(model.replay_buffer.state_dict(), other.replay_buffer.state_dict()) == []


@pytest.mark.parametrize("buffer_class", [HerReplayBuffer, DictReplayBuffer])
def test_pickled_buffers_need_trust(buffer_class: Any, tmp_path: Path) -> None:
    """SB3's buffers are its pickles."""
    goal_model(None).save_replay_buffer(tmp_path / "dictionaries")
    model: Any = goal_model(buffer_class)
    model.save_replay_buffer(tmp_path / "pickled")
    with pytest.raises(ArchiveError, match=r"pickled' is no replay buffer .* without pickle.*trusted=True"):
        model.load_replay_buffer(tmp_path / "pickled")
    with (tmp_path / "pickled.pkl").open("rb") as file:
        model.load_replay_buffer(file, trusted=True)
    assert model.replay_buffer.pos == 12
    model.load_replay_buffer(tmp_path / "pickled", trusted=True)
    assert type(model.replay_buffer) is buffer_class and model.replay_buffer.pos == 12
    with pytest.raises(ArchiveError, match=r"holds a FrameStackReplayBuffer .* this model has (Her|Dict)ReplayBuffer"):
        model.load_replay_buffer(tmp_path / "dictionaries")


# ---------------------------------------------------------------- the corpus


def changed_model(**members: bytes | None) -> bytes:
    """The example with other members; None: without it."""
    found = {**members_of(examples()["model"]), **{name.replace("__", "."): each for name, each in members.items()}}
    return zip_of({name: content for name, content in found.items() if content is not None})


def changed_data(change: Callable[[dict[str, Any]], Any]) -> Callable[[], bytes]:
    """The example with JSON that ``change`` has changed in place."""

    def build() -> bytes:
        node = json.loads(members_of(examples()["model"])["data"])
        change(node)
        return changed_model(data=json.dumps(node).encode())

    return build


def setting(name: str, value: Any) -> Callable[[], bytes]:
    """A model with another setting, as JSON."""
    return changed_data(lambda node: node["settings"].update({name: value}))


def changed_entry(**changes: Any) -> Callable[[], bytes]:
    """A model whose weights' header lies about the first tensor."""

    def build() -> bytes:
        header, body = parts_of(members_of(examples()["model"])["tensors.safetensors"])
        header[next(iter(header))] |= changes
        return changed_model(tensors__safetensors=safetensors_of(header, body))

    return build


def changed_buffer(change: Callable[[dict[str, Any]], Any]) -> Callable[[], bytes]:
    """A replay buffer with JSON that ``change`` has changed in place."""

    def build() -> bytes:
        header, body = parts_of(examples()["buffer"])
        state = json.loads(header["__metadata__"]["state"])
        change(state)
        header["__metadata__"]["state"] = json.dumps(state)
        return safetensors_of(header, body)

    return build


def torch_bytes(value: Any) -> bytes:
    th.save(value, file := io.BytesIO())
    return file.getvalue()


def raw_zip(members: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, compression)
    return file.getvalue()


def declared_larger() -> bytes:
    """A directory entry that declares 2 GB for the last member."""
    data = examples()["model"]
    at = data.rindex(b"PK\1\2")
    return data[: at + 20] + struct.pack("<LL", 2**31, 2**31) + data[at + 28 :]


def sb3_with(name: str) -> bytes:
    """SB3's format with a payload among the settings."""
    data = {"srl": "rae", "curiosity": None, "policy_class": CuReSAC, name: Payload()}
    save_to_zip_file(file := io.BytesIO(), data=data, params={}, pytorch_variables={})
    return file.getvalue()


def pickled_buffer() -> bytes:
    pickle.dump(example_model().replay_buffer, file := io.BytesIO())
    return file.getvalue()


MODELS: dict[str, Callable[[], bytes]] = {
    # code
    "a pickle": lambda: pickle.dumps(Payload()),
    "a pickle as data": lambda: changed_model(data=pickle.dumps(Payload(), protocol=2)),
    "a pickle as weights": lambda: changed_model(tensors__safetensors=pickle.dumps(Payload(), protocol=2)),
    "torch's weights beside ours": lambda: changed_model(policy__pth=torch_bytes({"w": Payload()}), data=b"{}"),
    "SB3's format, a payload as a setting": lambda: sb3_with("learning_rate"),
    "SB3's format, a payload that nobody needs": lambda: sb3_with("spam"),
    "a function by name": setting("learning_rate", {"!name": "os.system"}),
    "a module to import": setting("policy_class", {"!name": "antigravity.fly"}),
    "an unknown tag": setting("gamma", {"!eval": "1"}),
    "a class of another kind": setting("policy_class", {"!name": "torch.nn.modules.activation.ReLU"}),
    "a method's name": setting("_setup_model", 1),
    # no archive
    "nothing": lambda: b"",
    "half a file": lambda: examples()["model"][: len(examples()["model"]) // 2],
    "a replay buffer": lambda: examples()["buffer"],
    # zip
    "compressed": lambda: raw_zip(list(members_of(examples()["model"]).items()), zipfile.ZIP_DEFLATED),
    "a zip bomb": lambda: raw_zip([("data", b" " * 10**8)], zipfile.ZIP_DEFLATED),
    "a declared size": declared_larger,
    "no data": lambda: changed_model(data=None),
    "no tensors": lambda: changed_model(tensors__safetensors=None),
    # JSON and settings
    "deep JSON": lambda: changed_model(data=b"[" * 100_000 + b"]" * 100_000),
    "no settings": changed_data(lambda node: node.update(settings={})),
    "a placeholder": setting("gamma", {"!not saved": "\x1b[2J" + "x" * 10_000}),
    "an array that is not there": setting("_last_obs", {"!array": "spam"}),
    "a huge discrete space": setting("observation_space", {"!Discrete": {"n": 10**40}}),
    # weights
    "offsets beyond the file": changed_entry(data_offsets=[0, 2**50]),
    "a shape beyond the file": changed_entry(shape=[2**50]),
    "another dtype": changed_entry(dtype="U8"),
    "a parameter missing": changed_data(lambda node: node["parameters"]["policy"].popitem()),
    "a number for weights": changed_data(lambda node: node["parameters"]["policy"].update({"actor.mu.bias": 0.0})),
    "a network missing": changed_data(lambda node: node["parameters"].pop("policy")),
    "variables missing": changed_data(lambda node: node.update(variables={})),
    "an optimiser's other parameters": changed_data(
        lambda node: node["parameters"]["critic.optimizer"]["param_groups"][0].update(params=[0])
    ),
    "a random stream of text": changed_data(lambda node: node["parts"]["mixer"].update(rng="spam")),
}
BUFFERS: dict[str, Callable[[], bytes]] = {
    "a pickle": lambda: pickle.dumps(Payload()),
    "SB3's pickled buffer": pickled_buffer,
    "nothing": lambda: b"",
    "half a file": lambda: examples()["buffer"][: len(examples()["buffer"]) // 2],
    "a model": lambda: examples()["model"],
    "a state": lambda: examples()["state"],
    "other environments": changed_buffer(lambda state: state.update(n_envs=10**9)),
    "another size": changed_buffer(lambda state: state.update(size=31)),
    "a row outside": changed_buffer(lambda state: state["counters"].update(pos=10**6)),
    "full although it is not": changed_buffer(lambda state: state["counters"].update(full=True)),
    "fewer frames": changed_buffer(lambda state: state["counters"].update(counts={"": 3})),
    "rows missing": changed_buffer(lambda state: state["arrays"].pop("rewards")),
    "rows of others": changed_buffer(lambda state: state["arrays"].update(rewards=state["arrays"]["actions"])),
}
CORPUS = [
    pytest.param(kind, build, id=f"{kind}: {name}")
    for kind, files in {"model": MODELS, "buffer": BUFFERS}.items()
    for name, build in files.items()
]


@pytest.mark.parametrize("kind, build", CORPUS)
def test_hostile_files_are_refused(kind: str, build: Callable[[], bytes]) -> None:
    """By an error; no code is run and no file is written."""
    data = build()
    assert outcome(lambda: load(kind, data)) == "refused"
    assert not EXECUTED.exists()


def test_payload_of_the_corpus_works() -> None:
    """The corpus would notice: the same payload, trusted, is run."""
    with watching() as events:
        with pytest.raises(Exception):  # noqa: B017
            CuReSAC.load(io.BytesIO(sb3_with("spam")), trusted=True)
    EXECUTED.unlink()
    assert any(event.startswith("os.system") for event in events)


def test_mutated_files_run_nothing() -> None:
    counts, failures = fuzz(400, seed=1)
    assert failures == []
    outcomes = [name.split(": ")[1] for count in counts.values() for name in count]
    assert {"loaded", "refused"} <= set(outcomes)
