"""bf16 may round what enters as bytes of an image; vectors, actions and latents enter their first layer in fp32."""

from typing import Any

import numpy as np
import pytest
import torch as th
from agents_for_tests import actor_critic, q_values
from envs_for_tests import PixelBox, VectorBox, samples_of, tiny_model

from sb3_cure import CuReSAC

WIDE: dict[str, Any] = {"net_arch": [64, 64]}
OF_VECTORS = {**WIDE, "features_extractor_kwargs": {"features_dim": 50, "hidden_dim": 256}}
#: As updates with precision="bf16" compute
as_in_training = th.autocast("cpu", th.bfloat16)


def vector_model(**kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), precision="bf16", policy_kwargs=OF_VECTORS, **kwargs)


@pytest.fixture(scope="module", params=["vectors", "pixels"])
def model(request: pytest.FixtureRequest) -> CuReSAC:
    if request.param == "vectors":
        return vector_model()
    return tiny_model("CnnPolicy", PixelBox(), precision="bf16", policy_kwargs=WIDE)


def error_of_bf16(compute: Any, first: th.Tensor, second: th.Tensor) -> float:
    """How far the difference between two outputs in mixed precision is from that in fp32, relative to the latter."""
    with th.no_grad():
        exact = compute(second) - compute(first)
        with as_in_training:
            rounded = compute(second).float() - compute(first).float()
    return float((rounded - exact).norm() / exact.norm())


def test_close_vectors_have_different_latents() -> None:
    """1.000 and 1.003 are one number in bf16; what they differ by is to arrive, not only that they do."""
    encoder = vector_model().policy.encoder
    assert error_of_bf16(encoder, th.tensor([[1.0, 0.5]]), th.tensor([[1.003, 0.5]])) < 1e-3


def test_close_vectors_reach_the_actors_first_layer() -> None:
    """Through the trunk that it shares and the projection that it owns."""
    model = vector_model()
    for name in ("task", "curious"):
        actor: Any = actor_critic(model, name).actor
        seen: list[th.Tensor] = []
        first_layer = actor.latent_pi[0]
        handle = first_layer.register_forward_hook(lambda _, inputs, output, seen=seen: seen.append(output))

        def layer(vectors: th.Tensor, actor: Any = actor, seen: list[th.Tensor] = seen) -> th.Tensor:
            actor.action_log_prob(model.policy.encoder.trunk(vectors))
            return seen[-1]

        assert error_of_bf16(layer, th.tensor([[1.0, 0.5]]), th.tensor([[1.003, 0.5]])) < 1e-3
        handle.remove()


@pytest.mark.parametrize("name", ["task", "curious"])
def test_close_actions_have_different_values(model: CuReSAC, name: str) -> None:
    """Actions .500 and .501, which are one number in bf16; in the critics of pixel agents, too."""
    n = 64
    latents = th.rand((n, model.policy.encoder.features_dim), generator=th.Generator().manual_seed(0)) - 0.5
    actions = th.full((n, 2), 0.5)
    with th.no_grad(), as_in_training:
        low = q_values(model, name, latents, actions)
        high = q_values(model, name, latents, actions + 0.001)
    assert (low != high).float().mean() > 0.9


@pytest.mark.parametrize("name", ["task", "curious"])
def test_actions_reach_the_critics_first_layer(model: CuReSAC, name: str) -> None:
    """In fp32: the first layer's output differs by what its weights make of the difference."""
    critic: Any = actor_critic(model, name).critic
    seen: list[th.Tensor] = []
    handle = critic.ensemble[0].register_forward_hook(lambda _, inputs, output: seen.append(output))
    latents = th.full((1, model.policy.encoder.features_dim), 0.7)

    def layer(actions: th.Tensor) -> th.Tensor:
        q_values(model, name, latents, actions)
        return seen[-1]

    assert error_of_bf16(layer, th.tensor([[0.5, 0.5]]), th.tensor([[0.501, 0.5]])) < 1e-3
    handle.remove()


def test_decoder_of_vectors_draws_in_fp32() -> None:
    """Targets of vectors are no bytes: a decoder in bf16 could not draw them to better than 0.4 %."""
    model = vector_model(learning_starts=40).learn(40)
    batch = samples_of(model, 32)
    with th.no_grad():
        latents = model.policy.encode(batch.observations)
        exact = model.policy.srl.loss(batch, latents).error
        with as_in_training:
            error = model.policy.srl.loss(batch, latents).error
    th.testing.assert_close(error, exact, rtol=1e-5, atol=0)


def test_updates_in_bf16_tell_close_vectors_apart() -> None:
    """An update on observations that are one number in bf16 logs the latents' variance, as fp32 does."""
    variances = []
    for precision in ("fp32", "bf16"):
        model = tiny_model("MlpPolicy", VectorBox(), learning_starts=40, precision=precision, policy_kwargs=OF_VECTORS)
        model.learn(40)
        observations = model.replay_buffer.observations
        observations[:] = 1.0
        observations[::2, ..., 0] = 1.003
        np.random.seed(0)
        model.train(1, batch_size=32)
        variances.append(float(model.logger.name_to_value["train/latent_variance"]))
    assert variances[1] == pytest.approx(variances[0], rel=1e-2)
