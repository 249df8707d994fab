"""The contrastive head: InfoNCE against straight-line code, and an error that does not depend on the batch."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces
from srl_for_tests import batch_of, encode, image_space, make, noise_images, randomise, seeded

from sb3_cure.networks.encoders import Encoder
from sb3_cure.srl import CURL

# ---------------------------------------------------------------- the contrastive loss


@pytest.mark.parametrize("size", [None, 28], ids=["shift", "crop"])
def test_infonce_against_straight_line_code(size: int | None) -> None:
    """Cross-entropy of q^T W k over all keys of the batch with the own one on the diagonal, in plain loops."""
    space = image_space(3)
    encoder, head = make(CURL, space, size)
    with th.no_grad():
        head.W.normal_(generator=seeded(5))
    batch = batch_of(noise_images(space, 6))
    latents = encode(encoder, head.augment(batch.observations))
    th.manual_seed(4)
    loss, error = head.loss(batch, latents)
    th.manual_seed(4)
    keys = head.target_encoder(head.augment(batch.observations).float() / 255).double().numpy()
    q, w = latents.detach().double().numpy(), head.W.detach().double().numpy()
    expected = []
    for i in range(6):
        scores = [sum(q[i, a] * w[a, b] * keys[j, b] for a in range(7) for b in range(7)) for j in range(6)]
        expected.append(np.log(sum(np.exp(score - scores[i]) for score in scores)))
    assert error.shape == (6,)
    assert not error.requires_grad
    np.testing.assert_allclose(error.numpy(), expected, rtol=1e-3, atol=1e-4)
    assert float(loss.detach()) == pytest.approx(np.mean(expected), rel=1e-3)
    assert th.equal(loss.detach(), error.mean())


def test_keys_come_from_the_momentum_encoder_without_gradient() -> None:
    """The loss changes with the momentum encoder's weights; neither encoder gets a gradient through the keys."""
    space = image_space()
    encoder, head = make(CURL, space)
    target = head.target_encoder.requires_grad_(True)
    batch = batch_of(noise_images(space))
    latents = encode(encoder, batch.observations).detach().requires_grad_()
    losses = []
    for seed in (1, 2):
        randomise(target, seed)
        th.manual_seed(0)
        loss = head.loss(batch, latents).loss
        loss.backward()
        losses.append(float(loss.detach()))
    assert losses[0] != losses[1]
    assert latents.grad is not None and head.W.grad is not None
    assert all(parameter.grad is None for parameter in [*encoder.parameters(), *target.parameters()])


# ---------------------------------------------------------------- the contrastive error


def trained_curl(**kwargs: Any) -> tuple[Encoder, Any, spaces.Box]:
    """A head that has seen two training batches."""
    space = image_space()
    th.manual_seed(0)
    encoder, head = make(CURL, space, **kwargs)
    for seed in (1, 2):
        batch = batch_of(noise_images(space, 6, seed))
        head.loss(batch, encode(encoder, head.augment(batch.observations)))
    return encoder, head, space


@pytest.mark.parametrize("size", [None, 28], ids=["shift", "crop"])
def test_measured_error_is_of_one_observation(size: int | None) -> None:
    """Positive for a batch of one, whose InfoNCE would be 0; independent of the rest of a batch; draws nothing."""
    encoder, head, space = trained_curl(size=size)
    observations = noise_images(space, 5, seed=9)
    latents = encode(encoder, head.augment.center(observations))
    before = th.get_rng_state()
    errors = head.error(batch_of(observations), latents)
    assert th.equal(th.get_rng_state(), before) and not errors.requires_grad
    assert float(errors.min()) > 0 and len(errors.unique()) == 5
    order = [3, 1]
    th.testing.assert_close(head.error(batch_of(observations[order]), latents[order]), errors[order])


def test_curl_error_against_straight_line_code() -> None:
    """Cross-entropy of the own key against the bank's, where the views are known: images that a shift leaves alone."""
    space = image_space(1, 36)
    th.manual_seed(0)
    encoder, head = make(CURL, space, bank_size=10)
    flat = th.arange(0, 250, 25, dtype=th.uint8).view(-1, 1, 1, 1).expand(-1, 1, 36, 36)
    batch = batch_of(flat)
    latents = encode(encoder, flat).detach()
    # Fourteen are seen in training, but the bank holds ten.
    head.loss(batch_of(flat[:7]), latents[:7])
    head.loss(batch_of(flat[3:]), latents[3:])
    bank = th.cat([flat[:7], flat[3:6]])
    assert th.equal(head.bank, bank)
    keys = head.target_encoder(bank.float() / 255)
    own = head.target_encoder(flat.float() / 255)
    q, w = latents, head.W.detach()
    expected = []
    for i in range(10):
        positive = float(q[i] @ w @ own[i])
        negatives = [float(q[i] @ w @ keys[j]) for j in range(10)]
        expected.append(np.log(1 + sum(np.exp(negative - positive) for negative in negatives)))
    np.testing.assert_allclose(head.error(batch, latents).numpy(), expected, rtol=1e-3, atol=1e-4)


def test_set_bank_chooses_the_negatives() -> None:
    """They replace those of training, none of the old ones counts any more; nonsense is one sentence."""
    encoder, head, space = trained_curl(bank_size=16)
    chosen = noise_images(space, 5, seed=11)
    head.set_bank(chosen)
    assert head.n_banked == 5 and th.equal(head.bank[:5], chosen)
    _, fresh = make(CURL, space, bank_size=16)
    fresh.load_state_dict({**head.state_dict(), "bank": th.cat([chosen, th.zeros_like(head.bank[5:])])})
    observations = noise_images(space, 4, seed=9)
    latents = encode(encoder, observations)
    assert th.equal(fresh.error(batch_of(observations), latents), head.error(batch_of(observations), latents))
    for wrong in (noise_images(space, 17), chosen[:0], chosen[:, :1]):
        with pytest.raises(ValueError, match=r"set_bank got observations of shape .* the bank holds 1 to 16"):
            head.set_bank(wrong)


@pytest.mark.parametrize("trained_before", [False, True])
def test_bank_travels_in_the_state_dict(trained_before: bool) -> None:
    """A restored head gives the same errors and goes on filling where the other stopped."""
    encoder, head, space = trained_curl(bank_size=16)
    assert head.n_banked == 12
    _, other = make(CURL, space, bank_size=16)
    if trained_before:
        full = noise_images(space, 16, seed=5)
        other.loss(batch_of(full), encode(encoder, full))
    other.load_state_dict(head.state_dict())
    observations = noise_images(space, 4, seed=9)
    latents = encode(encoder, observations)
    assert th.equal(other.error(batch_of(observations), latents), head.error(batch_of(observations), latents))
    more = noise_images(space, 6, seed=7)
    for each in (head, other):
        each.loss(batch_of(more), encode(encoder, more))
    assert other.n_banked == 16
    assert th.equal(other.bank, head.bank)
    assert th.equal(other.bank[12:], more[:4])


# ---------------------------------------------------------------- what the encoder sees


@pytest.mark.parametrize(
    "size, kwargs, seen, tanh",
    [
        (84, {}, 84, True),
        (100, {"augmentation": "shift"}, 100, True),
        (100, {"augmentation_kwargs": {"size": 64}}, 64, False),
        (100, {"policy_kwargs": {"features_extractor_kwargs": {"tanh": True, "n_filters": 2}}}, 84, True),
    ],
    ids=str,
)
def test_augmentation_of_curl_can_be_chosen(size: int, kwargs: dict[str, Any], seen: int, tanh: bool) -> None:
    """By default shifts up to 84 pixels, beyond that crops; arguments of the user win."""
    policy = tiny_model("CnnPolicy", PixelBox(size=size), srl="curl", buffer_size=40, **kwargs).policy
    assert policy.encoder.view_space.shape == (6, seen, seen)
    assert policy.encoder.projection.tanh is tanh
