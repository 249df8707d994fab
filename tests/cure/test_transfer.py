"""Encoder, head and curious agent of a sibling task's model."""

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


both_algorithms = pytest.mark.parametrize("algorithm", list(ALGORITHMS))
REPRESENTATION = ("encoder.", "encoder_target.", "srl.")
CROP_33: dict[str, Any] = dict(augmentation="crop", augmentation_kwargs=dict(size=33))
CURIOUS = ("curious.", "intrinsic.", "scale.")


def tensors(model: Any, parts: tuple[str, ...]) -> dict[str, th.Tensor]:
    return {name: t.clone() for name, t in model.policy.state_dict().items() if name.startswith(parts)}


def saved(path: Path, algorithm: str = "sac", **kwargs: Any) -> Any:
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], **kwargs).learn(16)
    model.save(path)
    return model


@both_algorithms
@pytest.mark.parametrize("curiosity", ["separate", None])
def test_parts_are_taken_and_the_task_begins_anew(algorithm: str, curiosity: str | None, tmp_path: Path) -> None:
    source = saved(tmp_path / "model.zip", algorithm, curiosity=curiosity)
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], seed=5)
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


@both_algorithms
@pytest.mark.parametrize(
    ("update", "srl"), [("joint", "rae"), ("sequential", "rae"), ("joint", "spr"), ("joint", "curl"), ("joint", Norms)]
)
def test_frozen_representation_stays(algorithm: str, update: str, srl: Any, tmp_path: Path) -> None:
    """While all agents learn; also in a model that was saved and loaded; with its statistics and moving averages."""
    saved(tmp_path / "model", algorithm, srl=srl)
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], seed=5, update=update, srl=srl)
    source = tensors(model.transfer_from(tmp_path / "model", freeze=True), ("encoder.", "srl."))
    kept, agents = tensors(model, REPRESENTATION), tensors(model, ("task.", "curious."))
    model.learn(16)
    model.save(tmp_path / "frozen")
    objects = {"srl": srl} if srl is Norms else None
    loaded = ALGORITHMS[algorithm].load(tmp_path / "frozen", env=PixelBox(), custom_objects=objects)
    loaded.learn(12, reset_num_timesteps=False)
    for each in (model, loaded):
        assert each._n_updates > 0 and differences(kept, tensors(each, REPRESENTATION)) == []
        assert differences(source, tensors(each, ("encoder.", "srl."))) == []
    moved = {name.split(".")[1] for name in agents if not th.equal(agents[name], tensors(model, (name,))[name])}
    assert {"actor", "critic", "critic_target"} <= moved
    for call in (model.pretrain, model.fit_representation):
        with pytest.raises(ValueError, match="keeps as it is"):
            call(5)


def test_frozen_representation_of_a_dictionary_stays(tmp_path: Path) -> None:
    """The deviations by which errors of images are compared, too."""
    sensor_model(SensorBox(("front", "wrist"))).learn(12).save(tmp_path / "model")
    model = sensor_model(SensorBox(("front", "wrist")), curiosity_target="next_observation", seed=5)
    kept = tensors(model.transfer_from(tmp_path / "model", freeze=True), REPRESENTATION)
    assert model.learn(16)._n_updates > 0 and differences(kept, tensors(model, REPRESENTATION)) == []


def test_statistics_of_rnd_stay_final(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of another whitening the predictor would know nothing."""
    monkeypatch.setattr(rnd, "ENOUGH", 8)
    source = saved(tmp_path / "model", intrinsic="rnd")
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic="rnd", seed=5).transfer_from(tmp_path / "model").learn(16)
    for name in ("mean", "variance"):
        assert th.equal(getattr(source.policy.intrinsic, name), getattr(model.policy.intrinsic, name))


def test_encoder_goes_to_a_model_without_head(tmp_path: Path) -> None:
    source = saved(tmp_path / "model")
    model = tiny_model(
        "CnnPolicy", PixelBox(), srl=None, curiosity=None, policy_kwargs=dict(share_encoder=True), seed=5
    )
    model.transfer_from(tmp_path / "model", freeze=True).learn(16)
    assert differences(tensors(source, ("encoder.",)), tensors(model, ("encoder.",))) == []


@pytest.mark.parametrize(
    ("kwargs", "env", "name"),
    [
        (dict(policy_kwargs=dict(features_extractor_kwargs=dict(n_filters=5, n_layers=2))), PixelBox, "encoder."),
        (dict(srl="curl"), PixelBox, "srl."),
        (dict(), lambda: PixelBox(3), "encoder."),
        (dict(intrinsic="reconstruction"), PixelBox, "intrinsic."),
        (dict(srl=None, curiosity=None), PixelBox, "encoder."),
    ],
    ids=["encoder", "head", "image", "reward", "everything off"],
)
def test_other_networks_are_refused_in_one_sentence(
    kwargs: dict[str, Any], env: Any, name: str, tmp_path: Path
) -> None:
    saved(tmp_path / "model")
    model = tiny_model("CnnPolicy", env(), **kwargs)
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match=f"has {name}.* of shape .*: transfer needs equal images"):
        model.transfer_from(tmp_path / "model")
    assert differences(before, dict(model.policy.state_dict())) == []


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


@pytest.mark.parametrize(
    ("make", "there", "here", "sentence"),
    [
        (
            sensor_model,
            dict(env=Sensors("left", "right")),
            dict(env=Sensors("right", "left")),
            r"observations=\['left: image .*and this model \['right: image",
        ),
        (
            sensor_model,
            dict(env=Sensors("left", "mode")),
            dict(env=Sensors("left", "mode", mode=spaces.Box(-1, 1, (3,)))),
            r"observations=.*'mode: Discrete .*'mode: Box",
        ),
        (
            tiny_model,
            CROP_33,
            dict(augmentation="crop", augmentation_kwargs=dict(size=34)),
            r"views='image \(6, 33, 33\)', and this model 'image \(6, 34, 34\)'",
        ),
        (
            tiny_model,
            dict(srl="curl", **CROP_33),
            dict(srl=None, curiosity=None, policy_kwargs=dict(share_encoder=True), **CROP_33),
            "tanh=False, and this model True",
        ),
        (tiny_model, dict(), dict(srl=Doubtful), "srl='RAE'.* 'Doubtful'"),
        (tiny_model, dict(), dict(intrinsic=Constant), "intrinsic='SRLError', and this model 'Constant'"),
    ],
    ids=["cameras", "number", "crop", "tanh", "head", "reward"],
)
def test_what_would_mean_something_else_is_refused(
    make: Any, there: dict[str, Any], here: dict[str, Any], sentence: str, tmp_path: Path
) -> None:
    """All shapes are equal."""
    pixels = () if make is sensor_model else ("CnnPolicy", PixelBox())
    make(*pixels, **there).save(tmp_path / "model")
    model = make(*pixels, **here)
    before = tensors(model, ("",))
    with pytest.raises(ValueError, match=f"{sentence}.*: of equal shapes.*here.$"):
        model.transfer_from(tmp_path / "model")
    assert differences(before, tensors(model, ("",))) == []


def test_other_augmentations_are_taken(tmp_path: Path) -> None:
    """An encoder that has learned from shifted images sees the same to act."""
    source = saved(tmp_path / "model", augmentation="shift")
    model = tiny_model("CnnPolicy", PixelBox(), seed=5).transfer_from(tmp_path / "model")
    assert differences(tensors(source, REPRESENTATION), tensors(model, REPRESENTATION)) == []


def test_pickles_are_refused(tmp_path: Path) -> None:
    SAC("MlpPolicy", VectorBox(), buffer_size=10).save(tmp_path / "sb3")
    with pytest.raises(ArchiveError, match="was pickled by SB3's save"):
        tiny_model("MlpPolicy", VectorBox()).transfer_from(tmp_path / "sb3")


def test_memories_of_another_replay_buffer_stay_behind(tmp_path: Path) -> None:
    """What a reward remembers of its model's transitions is not that of this one."""
    saved(tmp_path / "model", intrinsic="particle")
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic="particle", seed=5).transfer_from(tmp_path / "model")
    assert (model.policy.intrinsic.places == -1).all()  # type: ignore[union-attr]
    assert model.learn(16)._n_updates > 0
