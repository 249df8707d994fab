"""What the latents do not hold of the image: the reward ``"reconstruction"``."""

from pathlib import Path
from typing import Any

import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, differences, samples_of, state_of, tiny_model
from updates_for_tests import filled_model, groups, moved, train_once

from sb3_cure import CuReSAC

HEADS = pytest.mark.parametrize("srl, augmentation", [("rae", None), ("curl", "shift"), (None, None)])


@HEADS
@pytest.mark.parametrize("pixels", [True, False])
def test_reward_is_the_error_of_where_the_step_leads(srl: str | None, augmentation: str | None, pixels: bool) -> None:
    """Mean over pixels of the squared difference from the stored next observation; one number per sample."""
    if not pixels and srl == "curl":
        srl, augmentation = "rae", None
    model = filled_model(
        pixels=pixels, srl=srl, augmentation=augmentation, intrinsic="reconstruction", learning_rate=0.0
    )
    reward: Any = model.policy.intrinsic
    given: list[Any] = []
    loss_of = reward.loss
    reward.loss = lambda *args: given.append((args, loss_of(*args))) or given[-1][1]
    train_once(model)
    (batch, latents, next_latents, _), (loss, error) = given[0]
    assert latents is None and not next_latents.requires_grad and not error.requires_grad
    with th.no_grad():
        seen = batch.next_observations.float() / 255 - 0.5 if pixels else batch.next_observations
        drawn = reward.decoder(model.policy.encode(batch.next_observations).float())
        expected = (drawn - seen).square().flatten(1).mean(dim=1)
    th.testing.assert_close(error, expected)
    th.testing.assert_close(loss.detach(), expected.mean())


def test_decoder_learns_and_the_encoder_does_not() -> None:
    """Of detached latents, by an optimiser of its own; the error of a batch falls."""
    alone = dict(srl=None, task=False, curiosity_encoder_grad=False)
    model = filled_model(pixels=True, intrinsic="reconstruction", **alone)
    before, batch = groups(model), samples_of(model, 8)
    reward: Any = model.policy.intrinsic

    def error() -> float:
        return float(reward.error(batch.observations, model.policy.encode(batch.observations)).mean())

    first = error()
    for _ in range(3):
        train_once(model, actors=False)
    assert moved(before, groups(model)) == {"reward", "curious critic"}
    assert error() < first


def test_pictures_are_what_the_decoder_draws() -> None:
    """Bytes of the observations' shape, whose error is the reward's but for rounding."""
    model = tiny_model("CnnPolicy", PixelBox(), srl="curl", augmentation="shift", intrinsic="reconstruction").learn(30)
    observations = samples_of(model, 8).observations
    latents = model.policy.encode(observations)
    reward: Any = model.policy.intrinsic
    drawn = reward.reconstruct(latents)
    assert drawn.dtype == th.uint8 and drawn.shape == observations.shape
    error = ((drawn.float() - observations.float()) / 255).square().flatten(1).mean(dim=1)
    th.testing.assert_close(error, reward.error(observations, latents), rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("curiosity", ["separate", "bonus"])
def test_saved_and_loaded(curiosity: str, tmp_path: Path) -> None:
    """Decoder and optimiser, too: every part is what it was."""
    arguments: dict[str, Any] = dict(srl="curl", augmentation="shift", intrinsic="reconstruction", curiosity=curiosity)
    model = tiny_model("CnnPolicy", PixelBox(), intrinsic_kwargs=dict(n_filters=8), **arguments).learn(30)
    model.save(tmp_path / "model")
    loaded = CuReSAC.load(tmp_path / "model")
    assert loaded.intrinsic == "reconstruction" and loaded.intrinsic_kwargs == {"n_filters": 8}
    assert any("intrinsic" in name for name in state_of(model)["policy"])
    assert differences(state_of(model), state_of(loaded)) == []


def test_small_images_have_fewer_layers() -> None:
    model = tiny_model(
        "CnnPolicy",
        PixelBox(size=12),
        srl=None,
        intrinsic="reconstruction",
        policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=2)),
    ).learn(30)
    assert th.isfinite(model.policy.scale.variance)


def test_vectors_are_drawn_in_fp32() -> None:
    model = tiny_model("MlpPolicy", VectorBox(), srl=None, intrinsic="reconstruction", precision="bf16").learn(30)
    reward: Any = model.policy.intrinsic
    observations = samples_of(model, 8).observations
    with model._autocast():
        error = reward.error(observations, model.policy.encode(observations))
    exact = reward.error(observations, model.policy.encode(observations))
    assert error.dtype == th.float32
    th.testing.assert_close(error, exact)
