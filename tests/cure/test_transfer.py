"""Encoder, head and curious agent of a sibling task's model."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import SensorBox, sensor_model
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from gymnasium import spaces
from stable_baselines3 import SAC
from updates_for_tests import ALGORITHMS

from sb3_cure.intrinsic import IntrinsicReward, rnd
from sb3_cure.persistence import ArchiveError
from sb3_cure.srl import RAE


class Doubtful(RAE):
    """An autoencoder of one's own."""


class Counted(RAE):
    """With a state of its own."""

    n_losses = 0

    def loss(self, *args: Any) -> Any:
        self.n_losses += 1
        return super().loss(*args)

    def get_extra_state(self) -> Any:
        return {"n_losses": th.tensor(self.n_losses)}

    def set_extra_state(self, state: Any) -> None:
        self.n_losses = int(state["n_losses"])


class Norms(RAE):
    """With layers that follow their inputs while they train."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.norm = th.nn.BatchNorm1d(self.encoder.features_dim)

    def loss(self, batch: Any, latents: th.Tensor, next_latents: Any = None) -> Any:
        return super().loss(batch, self.norm(latents))


class Constant(IntrinsicReward):
    """A reward without tensors."""

    def loss(self, inputs: Any) -> Any:
        return None, th.ones(len(inputs.batch.actions))


REPRESENTATION = ("encoder.", "encoder_target.", "srl.")
CROP_33: dict[str, Any] = dict(augmentation="crop", augmentation_kwargs=dict(size=33))
CURIOUS = ("curious.", "intrinsic.", "scale.")


def tensors(model: Any, parts: tuple[str, ...]) -> dict[str, th.Tensor]:
    return {name: t.clone() for name, t in model.policy.state_dict().items() if name.startswith(parts)}


def untrained(algorithm: str = "sac", policy: str = "CnnPolicy", **kwargs: Any) -> Any:
    env = PixelBox() if policy == "CnnPolicy" else VectorBox()
    return tiny_model(policy, env, ALGORITHMS[algorithm], **kwargs)


def saved(path: Path, **kwargs: Any) -> Any:
    model = untrained(**kwargs).learn(16)
    model.save(path)
    return model


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("curiosity", ["separate", None])
def test_parts_are_taken_and_the_task_begins_anew(algorithm: str, curiosity: str | None, tmp_path: Path) -> None:
    source = saved(tmp_path / "model.zip", algorithm=algorithm, curiosity=curiosity)
    model = untrained(algorithm, seed=5)
    before = tensors(model, ("task.", *CURIOUS))
    assert model.transfer_from(tmp_path / "model") is model
    assert differences(tensors(source, REPRESENTATION), tensors(model, REPRESENTATION)) == []
    assert differences({n: t for n, t in before.items() if n.startswith("task.")}, tensors(model, ("task.",))) == []
    curious = tensors(source, CURIOUS) if curiosity else {n: t for n, t in before.items() if n.startswith(CURIOUS)}
    assert differences(curious, tensors(model, CURIOUS)) == []
    if curiosity:
        assert th.equal(model.policy.curious.log_ent_coef, source.policy.curious.log_ent_coef)
        image = np.random.default_rng(0).integers(0, 256, model.observation_space.shape, dtype=np.uint8)
        actions = [each.predict_curious(image, deterministic=True)[0] for each in (source, model)]
        np.testing.assert_array_equal(*actions)
    encoder = tensors(model, ("encoder.",))
    model.learn(16)
    assert differences(encoder, tensors(model, ("encoder.",))) != [], "it is trained on"


def test_state_of_a_head_is_taken(tmp_path: Path) -> None:
    source = saved(tmp_path / "model.zip", srl=Counted)
    model = untrained(srl=Counted).transfer_from(tmp_path / "model")
    assert model.policy.srl.n_losses == source.policy.srl.n_losses > 0


FROZEN: dict[str, Any] = {
    "rae, joint": dict(),
    "rae, sequential": dict(update="sequential"),
    "tqc": dict(algorithm="tqc"),
    "curl": dict(srl="curl", intrinsic="srl_error"),  # whose head measures
    "moving average": dict(srl="spr", intrinsic="srl_error"),
    "batch norm": dict(srl=Norms),
    "vectors": dict(policy="MlpPolicy"),
}


@pytest.mark.parametrize("name", FROZEN)
def test_frozen_representation_stays(name: str, tmp_path: Path) -> None:
    """While all agents learn; also in a model that was saved and loaded; with its statistics and moving averages."""
    kwargs = FROZEN[name]
    source = saved(tmp_path / "model", **kwargs)
    model = untrained(**kwargs, seed=5).transfer_from(tmp_path / "model", freeze=True)
    assert differences(tensors(source, ("encoder.", "srl.")), tensors(model, ("encoder.", "srl."))) == []
    kept, agents = tensors(model, REPRESENTATION), tensors(model, ("task.", "curious."))
    model.learn(16)
    model.save(tmp_path / "frozen")
    objects = {"srl": Norms} if kwargs.get("srl") is Norms else None
    loaded = type(model).load(tmp_path / "frozen", env=model.get_env(), custom_objects=objects)
    loaded.learn(12, reset_num_timesteps=False)
    for each in (model, loaded):
        assert each._n_updates > 0 and differences(kept, tensors(each, REPRESENTATION)) == []
    thawed = type(model).load(
        tmp_path / "frozen", env=model.get_env(), custom_objects=objects, representation_frozen=False
    )
    assert differences(kept, tensors(thawed.learn(12, reset_num_timesteps=False), REPRESENTATION)) != []
    moved = {name.split(".")[1] for name in agents if not th.equal(agents[name], tensors(model, (name,))[name])}
    assert {"actor", "critic", "critic_target"} <= moved
    for call in (model.pretrain, model.fit_representation):
        with pytest.raises(ValueError, match="keeps as it is"):
            call(5)
    model.representation_frozen = False
    assert differences(kept, tensors(model.learn(12, reset_num_timesteps=False), REPRESENTATION)) != []
    model.representation_frozen = True
    kept = tensors(model.learn(12, reset_num_timesteps=False), REPRESENTATION)
    assert differences(kept, tensors(model.learn(12, reset_num_timesteps=False), REPRESENTATION)) == []


def test_model_that_is_saved_when_just_frozen_is_the_same(tmp_path: Path) -> None:
    """Its target encoder, which is the encoder from the next update on, is not yet."""
    model = saved(tmp_path / "model")
    model.representation_frozen = True
    model.save(tmp_path / "frozen")
    loaded = type(model).load(tmp_path / "frozen", env=model.get_env())
    for each in (model, loaded):
        each.learn(12, reset_num_timesteps=False)
        online, target = (tensors(each, (part,)) for part in ("encoder.", "encoder_target."))
        assert all(th.equal(value, target[name.replace(".", "_target.", 1)]) for name, value in online.items())


def test_frozen_representation_of_a_dictionary_stays(tmp_path: Path) -> None:
    """The deviations by which errors of images are compared, and statistics of joints, too."""
    sensor_model(SensorBox()).learn(12).save(tmp_path / "model")
    model = sensor_model(SensorBox(), curiosity_target="next_observation", seed=5)
    kept = tensors(model.transfer_from(tmp_path / "model", freeze=True), REPRESENTATION)
    assert model.learn(16)._n_updates > 0 and differences(kept, tensors(model, REPRESENTATION)) == []


def test_statistics_of_rnd_stay_final(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of another whitening the predictor would know nothing."""
    monkeypatch.setattr(rnd, "ENOUGH", 8)
    source = saved(tmp_path / "model", intrinsic="rnd")
    model = untrained(intrinsic="rnd", seed=5).transfer_from(tmp_path / "model").learn(16)
    for name in ("mean", "variance"):
        assert th.equal(getattr(source.policy.intrinsic, name), getattr(model.policy.intrinsic, name))


@pytest.mark.parametrize("kwargs", [dict(srl=None, curiosity=None), dict(augmentation="shift")])
def test_other_settings_are_taken(kwargs: dict[str, Any], tmp_path: Path) -> None:
    """A model without a head, and one that learns from other views: to act, all see the centred one."""
    source = saved(tmp_path / "model")
    model = untrained(**kwargs, seed=5).transfer_from(tmp_path / "model", freeze=True).learn(16)
    assert differences(tensors(source, ("encoder.",)), tensors(model, ("encoder.",))) == []


def check_refused(model: Any, path: Path, sentence: str) -> None:
    """Nothing of a model that refuses has changed."""
    before = tensors(model, ("",))
    with pytest.raises(ValueError, match=sentence):
        model.transfer_from(path)
    assert differences(before, tensors(model, ("",))) == []


@pytest.mark.parametrize(
    ("kwargs", "frames", "name"),
    [
        (dict(policy_kwargs=dict(features_extractor_kwargs=dict(n_filters=5, n_layers=2))), 2, "encoder."),
        (dict(srl="curl"), 2, "srl."),
        (dict(), 3, "encoder."),
        (dict(intrinsic="reconstruction"), 2, "intrinsic."),
    ],
    ids=["encoder", "head", "image", "reward"],
)
def test_other_networks_are_refused(kwargs: dict[str, Any], frames: int, name: str, tmp_path: Path) -> None:
    saved(tmp_path / "model")
    check_refused(tiny_model("CnnPolicy", PixelBox(frames), **kwargs), tmp_path / "model", f"has {name}.* of shape")


class Sensors(SensorBox):
    """Two cameras of one size and a number, in the order of the keys that are given."""

    def __init__(self, *keys: str, mode: Any = None):
        super().__init__(("front", "mode"))
        kinds = {"left": self.observation_space["front"], "right": self.observation_space["front"]}
        kinds["mode"] = self.observation_space["mode"] if mode is None else mode
        self.keys, self.observation_space = keys, spaces.Dict([(key, kinds[key]) for key in keys])

    def observe(self, first: bool = False) -> Any:
        image = PixelBox.observe(self, first)
        return {key: self.observation_space[key].sample() if key == "mode" else image for key in self.keys}


MEANINGS: dict[str, tuple[Any, dict[str, Any], dict[str, Any]]] = {
    "observations": (sensor_model, dict(env=Sensors("left", "right")), dict(env=Sensors("right", "left"))),
    "mode: Box": (
        sensor_model,
        dict(env=Sensors("left", "mode")),
        dict(env=Sensors("left", "mode", mode=spaces.Box(-1, 1, (3,)))),
    ),
    "views": (untrained, CROP_33, dict(augmentation="crop", augmentation_kwargs=dict(size=34))),
    "tanh": (untrained, dict(srl="curl", **CROP_33), dict(srl=None, curiosity=None, **CROP_33)),
    "srl": (untrained, dict(), dict(srl=Doubtful)),
    "intrinsic": (untrained, dict(), dict(intrinsic=Constant)),
    "activation": (untrained, dict(), dict(policy_kwargs=dict(activation_fn=th.nn.Tanh))),
}


@pytest.mark.parametrize("name", MEANINGS)
def test_equal_shapes_of_other_meaning_are_refused(name: str, tmp_path: Path) -> None:
    make, there, here = MEANINGS[name]
    make(**there).save(tmp_path / "model")
    check_refused(make(**here), tmp_path / "model", f"{name}.*with equal shapes")


def test_activation_without_a_name_is_told_from_others(tmp_path: Path) -> None:
    make = partial(untrained, policy="MlpPolicy")
    make(policy_kwargs=dict(activation_fn=partial(th.nn.LeakyReLU, 0.1))).save(tmp_path / "model")
    make(policy_kwargs=dict(activation_fn=partial(th.nn.LeakyReLU, 0.1))).transfer_from(tmp_path / "model")
    other = make(policy_kwargs=dict(activation_fn=partial(th.nn.LeakyReLU, 0.2)))
    check_refused(other, tmp_path / "model", "activation.*with equal shapes")


def test_pickles_are_refused(tmp_path: Path) -> None:
    SAC("MlpPolicy", VectorBox(), buffer_size=10).save(tmp_path / "sb3")
    with pytest.raises(ArchiveError, match="was pickled by SB3's save"):
        tiny_model("MlpPolicy", VectorBox()).transfer_from(tmp_path / "sb3")


def test_memories_of_another_replay_buffer_stay_behind(tmp_path: Path) -> None:
    """What a reward remembers of its model's transitions is not that of this one."""
    saved(tmp_path / "model", intrinsic="particle")
    model = untrained(intrinsic="particle", seed=5).transfer_from(tmp_path / "model")
    assert (model.policy.intrinsic.places == -1).all()  # type: ignore[union-attr]
    assert model.learn(16)._n_updates > 0
