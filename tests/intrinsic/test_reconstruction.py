"""What the latents do not hold of the image: the reward ``"reconstruction"``."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import PixelBox, samples_of, tiny_model
from updates_for_tests import filled_model, groups, moved, sampled, train_once

ALONE: dict[str, Any] = dict(srl=None, task=False, curiosity_encoder_grad=False, intrinsic="reconstruction")


@pytest.mark.parametrize("pixels", [True, False])
def test_reward_is_the_error_of_where_the_step_leads(pixels: bool) -> None:
    """Mean over pixels (standardised entries) of the squared difference from the stored next observation.

    The decoder alone learns it.
    """
    model = filled_model(pixels=pixels, learning_rate=0.1 if pixels else 0.01, **ALONE)
    reward: Any = model.policy.intrinsic
    found: list[th.Tensor] = []
    model.policy.scale.register_forward_pre_hook(lambda _, args: found.append(args[0].clone()))
    batch, before = sampled(model), groups(model)
    with th.no_grad():
        seen = batch.next_observations.float()
        seen = seen / 255 - 0.5 if pixels else (seen - seen.mean(dim=0)) / seen.std(dim=0, correction=0)
        drawn = reward.decoder(model.policy.encode(batch.next_observations))
        expected = (drawn - seen).square().flatten(1).mean(dim=1)
    for _ in range(3):
        train_once(model, actors=False)
    th.testing.assert_close(found[0], expected)
    assert moved(before, groups(model)) == {"reward", "curious critic"}
    assert float(found[-1].mean()) < float(expected.mean())


@pytest.mark.parametrize("size, n_layers", [(36, 2), (12, 2)])
def test_pictures_are_what_the_decoder_draws(size: int, n_layers: int) -> None:
    """Bytes of the observations' shape, also of small images, whose error is the reward's but for rounding."""
    kwargs: dict[str, Any] = dict(policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=n_layers)))
    model = tiny_model("CnnPolicy", PixelBox(size=size), **ALONE, **kwargs).learn(30)
    observations = samples_of(model, 8).observations
    latents = model.policy.encode(observations)
    reward: Any = model.policy.intrinsic
    drawn = reward.reconstruct(latents)
    assert drawn.dtype == th.uint8 and drawn.shape == observations.shape
    error = ((drawn.float() - observations.float()) / 255).square().flatten(1).mean(dim=1)
    th.testing.assert_close(error, reward.error(observations, latents), rtol=0.05, atol=1e-3)
    reward.decoder.forward = lambda latents: th.linspace(-0.6, 0.6, observations.numel()).view(observations.shape)
    assert [int(end) for end in th.aminmax(reward.reconstruct(latents))] == [0, 255]  # black and white are drawn, too
