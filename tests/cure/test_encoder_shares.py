"""How much of the encoder's gradient is whose: measured at its parameters, before anything is scaled."""

from typing import Any

import pytest
import torch as th
from agents_for_tests import one_update
from envs_for_tests import VectorBox, tiny_model

from sb3_cure import CuReSAC
from sb3_cure.srl import RAE, SRLOutput

both_updates = pytest.mark.parametrize("update", ["sequential", "joint"])


def scaled(factor: float) -> type[RAE]:
    """An autoencoder whose loss is multiplied."""

    class Scaled(RAE):
        def loss(self, batch: Any, latents: th.Tensor) -> SRLOutput:
            output = super().loss(batch, latents)
            return SRLOutput(factor * output.loss, output.error)

    return Scaled


def model_with_transitions(**kwargs: Any) -> CuReSAC:
    return tiny_model("MlpPolicy", VectorBox(), learning_starts=40, **kwargs).learn(40)


def of_sources(logged: dict[str, float], prefix: str) -> dict[str, float]:
    return {key.removeprefix(prefix): value for key, value in logged.items() if key.startswith(prefix)}


@both_updates
def test_a_source_scaled_to_drown_is_shown_drowned(update: str) -> None:
    """A head whose loss is 1e-6 of what it was has about 1e-6 of its share; its step may be as long as ever."""
    shares = {}
    for factor in (1.0, 1e-6):
        logged = one_update(model_with_transitions(srl=scaled(factor), update=update))
        shares[factor] = of_sources(logged, "encoder_share_")
        assert shares[factor].keys() == {"srl", "task", "curious"}
        assert sum(shares[factor].values()) == pytest.approx(1)
    assert shares[1.0]["srl"] > 1e-4
    assert shares[1e-6]["srl"] < 2e-6


def test_joint_and_sequential_measure_the_same() -> None:
    """Where nothing moves, all sources see the same encoder in both."""
    measured = []
    for update in ("sequential", "joint"):
        logged = one_update(model_with_transitions(update=update, learning_rate=0.0))
        measured.append({**of_sources(logged, "encoder_share_"), **of_sources(logged, "encoder_grad_norm_")})
    assert measured[1] == pytest.approx(measured[0], rel=1e-4)


@both_updates
def test_gradient_norms_are_those_at_the_parameters(update: str) -> None:
    """Of the only source: what plain backpropagation of its loss through the encoder gives."""
    model = model_with_transitions(
        srl=None, curiosity=None, gamma=0.0, update=update, learning_rate=0.0,
        policy_kwargs={"share_encoder": True},
    )  # fmt: skip
    batches: list[Any] = []
    sample = model.replay_buffer.sample
    model.replay_buffer.sample = lambda *args, **kwargs: batches.append(sample(*args, **kwargs)) or batches[-1]
    logged = one_update(model)
    batch, encoder = batches[0], model.policy.encoder
    q_values = model.policy.critic(encoder(batch.observations), batch.actions)
    loss = 0.5 * sum((q - batch.rewards).square().mean() for q in q_values.unbind(dim=1))
    gradients = th.autograd.grad(loss, list(encoder.parameters()))
    norm = float(th.cat([gradient.flatten() for gradient in gradients]).norm())
    assert logged["encoder_grad_norm_task"] == pytest.approx(norm, rel=1e-4)
    assert logged["encoder_share_task"] == pytest.approx(1)


@both_updates
def test_shares_are_measured_now_and_then(update: str) -> None:
    """In the first update and every 100th, as it costs a pass per source; in between the last measurement is logged."""
    model = model_with_transitions(update=update)
    shares = [one_update(model, seed=seed)["encoder_share_srl"] for seed in range(101)]
    assert len(set(shares[:100])) == 1
    assert shares[100] != shares[99]


@both_updates
def test_measuring_changes_no_training(update: str) -> None:
    """The 1st update of one model and the 2nd of another, from equal weights: only the first measures."""
    after = []
    for earlier in (0, 1):
        model = model_with_transitions(update=update, actor_update_interval=10**6, target_update_interval=10**6)
        model.policy.encoder_update._n_updates = earlier
        one_update(model)
        after.append([parameter.detach().clone() for parameter in model.policy.encoder.parameters()])
    assert all(th.equal(a, b) for a, b in zip(*after, strict=True))
