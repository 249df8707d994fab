"""Encoder, head and curious agent of a sibling task's model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, tiny_model
from stable_baselines3 import SAC
from updates_for_tests import ALGORITHMS

from sb3_cure.persistence import ArchiveError

both_algorithms = pytest.mark.parametrize("algorithm", list(ALGORITHMS))
REPRESENTATION = ("encoder.", "encoder_target.", "srl.")
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
@pytest.mark.parametrize(("update", "srl"), [("joint", "rae"), ("sequential", "rae"), ("joint", "spr")])
def test_frozen_representation_stays(algorithm: str, update: str, srl: str, tmp_path: Path) -> None:
    """While all agents learn; also in a model that was saved and loaded; with its statistics and moving averages."""
    saved(tmp_path / "model", algorithm, srl=srl)
    model = tiny_model("CnnPolicy", PixelBox(), ALGORITHMS[algorithm], seed=5, update=update, srl=srl)
    model.transfer_from(tmp_path / "model", freeze=True)
    kept, agents = tensors(model, ("encoder.", "srl.")), tensors(model, ("task.", "curious."))
    model.learn(16)
    model.save(tmp_path / "frozen")
    loaded = ALGORITHMS[algorithm].load(tmp_path / "frozen", env=PixelBox()).learn(12, reset_num_timesteps=False)
    for each in (model, loaded):
        assert each._n_updates > 0 and differences(kept, tensors(each, ("encoder.", "srl."))) == []
    moved = {name.split(".")[1] for name in agents if not th.equal(agents[name], tensors(model, (name,))[name])}
    assert {"actor", "critic", "critic_target"} <= moved
    for call in (model.pretrain, model.fit_representation):
        with pytest.raises(ValueError, match="keeps as it is"):
            call(5)


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
