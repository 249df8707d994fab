"""The SRL heads: losses against straight-line code, errors per sample, shapes, and a fit on real frames."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, VectorBox, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cure import CuReSAC, make_dmc_env
from sb3_cure.augmentations import center_crop
from sb3_cure.encoders import Encoder, PixelEncoder, VectorEncoder
from sb3_cure.layers import preprocess
from sb3_cure.srl import CURL, RAE, SRLHead, get_srl_class


def image_space(channels: int = 6, height: int = 36, width: int | None = None) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width or height), np.uint8)


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


def noise_images(space: spaces.Box, batch: int = 8, seed: int = 0) -> th.Tensor:
    return th.randint(256, (batch, *space.shape), dtype=th.uint8, generator=seeded(seed))


def batch_of(observations: th.Tensor) -> ReplayBufferSamples:
    """A batch of which a head may read the observations only."""
    return ReplayBufferSamples(observations, None, None, None, None)  # type: ignore[arg-type]


def randomise(module: th.nn.Module, seed: int = 0) -> None:
    """Give all parameters values at which nothing is zero by construction."""
    with th.no_grad():
        for i, parameter in enumerate(module.parameters()):
            parameter.normal_(std=0.2, generator=seeded(seed + i))


def make(head_class: type[SRLHead], space: spaces.Box, **kwargs: Any) -> tuple[Encoder, SRLHead]:
    """A small encoder as the policy would build it, and its head with a momentum encoder that differs."""
    seen, defaults = head_class.configure_encoder(space, **kwargs)
    encoder = PixelEncoder(seen, features_dim=7, n_filters=4, n_layers=2, **defaults)
    head = head_class(encoder, space, **kwargs)
    target = copy.deepcopy(encoder).requires_grad_(False)
    randomise(target)
    head.bind_target_encoder(target)
    return encoder, head


# ---------------------------------------------------------------- the autoencoder's loss


@pytest.mark.parametrize("bits", [1, 3, 5, 8])
def test_dithered_target(bits: int) -> None:
    """Each pixel is cut to its highest bits and moved by uniform noise within that step; scaled to [-0.5, 0.5]."""
    space = image_space()
    _, head = make(RAE, space, bits=bits)
    observations = noise_images(space, 32)
    width = 256 // 2**bits
    steps = np.floor(observations.numpy() / width)
    th.manual_seed(0)
    target = head.target(observations, dither=True)
    assert target.dtype == th.float32
    dither = (target.double().numpy() + 0.5) * 2**bits - steps
    assert dither.min() > -1e-4 and dither.max() < 1 + 1e-4
    # Uniform: mean 1/2, variance 1/12, every tenth equally likely; five standard deviations.
    n = dither.size
    assert abs(dither.mean() - 0.5) < 5 / np.sqrt(12 * n)
    assert dither.var() == pytest.approx(1 / 12, rel=0.01)
    counts, _ = np.histogram(dither, bins=10, range=(0, 1))
    # The noise has 256 levels, of which a tenth of the range holds 25 or 26.
    assert np.abs(counts - n / 10).max() < 0.025 * n / 10 + 5 * np.sqrt(0.09 * n)
    # Independent from pixel to pixel, of the pixel itself, and from draw to draw.
    again = (head.target(observations, dither=True).double().numpy() + 0.5) * 2**bits - steps
    pairs = [(dither[..., 1:], dither[..., :-1]), (dither, observations.numpy()), (dither, again)]
    for first, second in pairs:
        assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 5 / np.sqrt(first.size)


@pytest.mark.parametrize("bits", [1, 5, 8])
def test_undithered_target_is_the_mean_of_the_dithered(bits: int) -> None:
    """(floor(o / width) + 1/2) / 2^bits - 1/2, where the dither would average out."""
    space = image_space()
    _, head = make(RAE, space, bits=bits)
    observations = noise_images(space)
    expected = (np.floor(observations.numpy() / 2.0 ** (8 - bits)) + 0.5) / 2.0**bits - 0.5
    np.testing.assert_allclose(head.target(observations, dither=False).numpy(), expected, rtol=0, atol=1e-6)
    mean = th.stack([head.target(observations, dither=True) for _ in range(400)]).mean(dim=0).numpy()
    # A mean of 400 dithers, at 62000 pixels: six standard deviations.
    assert np.abs(mean - expected).max() < 6 / np.sqrt(12 * 400) / 2**bits


@pytest.mark.parametrize("latent_penalty", [1e-6, 0.3])
def test_rae_loss_against_straight_line_code(latent_penalty: float) -> None:
    """Eq. 2 as meant: mean squared error of each image + lambda_z * mean of half the squared norm of the latents."""
    space = image_space()
    encoder, head = make(RAE, space, latent_penalty=latent_penalty)
    randomise(head)
    batch = batch_of(noise_images(space))
    latents = encoder(head.preprocess(batch.observations))
    th.manual_seed(3)
    target = head.target(batch.observations, dither=True).numpy()
    th.manual_seed(3)
    loss, error = head.loss(batch, latents)
    drawn, z = head.decoder(latents).detach().double().numpy(), latents.detach().double().numpy()
    expected = [np.mean((drawn[i] - target[i]) ** 2) for i in range(8)]
    assert error.shape == (8,)
    assert not error.requires_grad and loss.requires_grad
    np.testing.assert_allclose(error.numpy(), expected, rtol=1e-5)
    penalty = np.mean([0.5 * np.dot(z[i], z[i]) for i in range(8)])
    assert float(loss.detach()) == pytest.approx(np.mean(expected) + latent_penalty * penalty, rel=1e-5)


def test_rae_defaults_are_sac_aes() -> None:
    """5 bits, latent penalty 1e-6, decoder weight decay 1e-7, and 1000 updates after the warm-up."""
    space = image_space()
    encoder, head = make(RAE, space)
    batch = batch_of(noise_images(space))
    latents = encoder(head.preprocess(batch.observations)).detach()
    loss, error = head.loss(batch, latents)
    penalty = 0.5 * float((latents**2).sum(dim=1).mean())
    # The latents of a LayerNorm have a penalty of the order of their number, hence well above rounding.
    assert float((loss - error.mean()).detach()) == pytest.approx(1e-6 * penalty, rel=0.05)
    levels = head.target(th.arange(256, dtype=th.uint8).view(1, 1, 16, 16), dither=False).unique()
    assert len(levels) == 32
    assert get_srl_class("rae").warmup_updates == 1000
    assert get_srl_class("curl").warmup_updates == 0


@pytest.mark.parametrize("weight_decay", [0.0, 0.5])
def test_weight_decay_is_the_decoders_alone(weight_decay: float) -> None:
    """lambda_theta acts through the optimiser of the head: L2 on the decoder's weights, none on the encoder's."""
    kwargs = {"srl_kwargs": {"decoder_weight_decay": weight_decay, "latent_penalty": 0.0}, "curiosity": None}
    policy_kwargs = {"optimizer_class": th.optim.SGD}
    model = tiny_model("CnnPolicy", PixelBox(), learning_rate=0.1, policy_kwargs=policy_kwargs, **kwargs)
    policy = model.policy
    assert policy.srl.optimizer.param_groups[0]["weight_decay"] == weight_decay
    optimizers = [*policy.encoder_optimizer.optimizers.values(), policy.critic.optimizer, policy.actor.optimizer]
    assert all(group["weight_decay"] == 0 for optimizer in optimizers for group in optimizer.param_groups)
    before = [parameter.detach().clone() for parameter in policy.srl.parameters()]
    policy.srl.optimizer.zero_grad()
    batch = batch_of(noise_images(model.observation_space))
    policy.srl.loss(batch, policy.encode(batch.observations)).loss.backward()
    gradients = [parameter.grad.clone() for parameter in policy.srl.parameters()]
    policy.srl.optimizer.step()
    for parameter, old, gradient in zip(policy.srl.parameters(), before, gradients, strict=True):
        th.testing.assert_close(parameter.detach(), old - 0.1 * (gradient + weight_decay * old))


# ---------------------------------------------------------------- the autoencoder's error


class Draw(th.nn.Module):
    """A decoder that draws what it was told to, whatever the latents."""

    def __init__(self, images: th.Tensor):
        super().__init__()
        self.images = images

    def forward(self, latents: th.Tensor) -> th.Tensor:
        return self.images.expand(len(latents), -1, -1, -1)


def test_rae_error_has_no_noise() -> None:
    """A perfect reconstruction scores 0, where the training loss keeps the dither's variance; it repeats."""
    space = image_space()
    _, head = make(RAE, space)
    batch, latents = batch_of(noise_images(space)), th.zeros(8, 7)
    perfect = (th.div(batch.observations, 8, rounding_mode="floor") + 0.5) / 32 - 0.5
    head.decoder = Draw(perfect)
    assert float(head.error(batch, latents).max()) < 1e-12
    assert float(head.loss(batch, latents).error.mean()) == pytest.approx(1 / 12 / 32**2, rel=0.02)
    head.decoder = Draw(perfect + 0.1 * th.arange(8).view(8, 1, 1, 1))
    errors = head.error(batch, latents)
    assert not errors.requires_grad
    np.testing.assert_allclose(errors.numpy(), (0.1 * np.arange(8)) ** 2, atol=1e-6)
    assert th.equal(errors, head.error(batch, latents))


def test_rae_reconstructions_are_images() -> None:
    """What is drawn, back in 0-255: a perfect reconstruction is the observation up to its lost bits."""
    space = image_space()
    _, head = make(RAE, space)
    observations = noise_images(space)
    head.decoder = Draw(head.target(observations, dither=False))
    drawn = head.reconstruct(th.zeros(8, 7))
    assert drawn.dtype == th.uint8
    assert int((drawn.int() - observations.int()).abs().max()) <= 4
    head.decoder = Draw(th.tensor([-9.0, 9.0]).view(2, 1, 1, 1).expand(2, *space.shape))
    assert head.reconstruct(th.zeros(2, 7)).flatten(1).unique(dim=1).tolist() == [[0], [255]]


SHAPES = [(size, size) for size in (84, 64, 48, 36, 45)] + [(37, 50)]


@pytest.mark.parametrize("height, width", SHAPES)
@pytest.mark.parametrize("frames", [1, 2, 3, 4])
@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("n_layers", [1, 4])
def test_decoder_draws_what_the_encoder_sees(height: int, width: int, frames: int, colours: int, n_layers: int) -> None:
    """Any size, number of frames, RGB or grey, number of layers: same shape, same number of channels inside."""
    space = image_space(frames * colours, height, width)
    encoder = PixelEncoder(space, features_dim=5, n_filters=3, n_layers=n_layers)
    head = RAE(encoder, space)
    batch = batch_of(noise_images(space, 2))
    latents = encoder(head.preprocess(batch.observations))
    assert head.decoder(latents).shape == (2, *space.shape)
    assert head.reconstruct(latents).shape == (2, *space.shape)
    kernels = [tuple(p.shape) for p in head.decoder.parameters() if p.dim() == 4]
    assert kernels == [(3, 3, 3, 3)] * (n_layers - 1) + [(3, frames * colours, 3, 3)]
    with th.no_grad():
        # Positive throughout, so that no ReLU hides anything: the whole picture depends on the latents.
        for parameter in head.decoder.parameters():
            parameter.uniform_(0, 0.5, generator=seeded(parameter.numel()))
        first, second = head.decoder(th.rand(2, 5, generator=seeded(0)))
    # (As in SAC-AE, the last row and column of an even size are beyond the reach of a stride of 2 from either side.)
    reach = [size - 1 + size % 2 for size in (height, width)]
    assert bool((first != second)[:, : reach[0], : reach[1]].all())


@given(st.integers(1, 5), st.integers(0, 30), st.integers(0, 30), st.integers(1, 2))
@settings(deadline=None, max_examples=50)
def test_decoder_shapes(n_layers: int, extra_height: int, extra_width: int, channels: int) -> None:
    """From the smallest image that the encoder takes."""
    space = image_space(channels, 4 * n_layers - 1 + extra_height, 4 * n_layers - 1 + extra_width)
    encoder = PixelEncoder(space, features_dim=3, n_filters=2, n_layers=n_layers)
    latents = encoder(th.rand(1, *space.shape))
    assert RAE(encoder, space).decoder(latents).shape == (1, *space.shape)


def test_vector_autoencoder() -> None:
    """Vectors are drawn as they are: no bits, no dither; error per sample, and a fit that learns them."""
    space = spaces.Box(-3, 3, (5,), np.float32)
    th.manual_seed(0)
    encoder = VectorEncoder(space, features_dim=8, hidden_dim=32)
    head = RAE(encoder, space, latent_penalty=0.0)
    observations = th.rand(64, 5, generator=seeded(0)) * 6 - 3
    batch = batch_of(observations)
    latents = encoder(observations)
    loss, error = head.loss(batch, latents)
    assert error.shape == (64,) and not error.requires_grad
    expected = ((head.decoder(latents).detach() - observations) ** 2).mean(dim=1)
    th.testing.assert_close(error, expected)
    th.testing.assert_close(loss.detach(), expected.mean())
    assert th.equal(head.error(batch, latents), error)
    assert head.reconstruct(latents).shape == (64, 5)
    optimizer = th.optim.Adam([*encoder.parameters(), *head.parameters()], lr=3e-3)
    for _ in range(300):
        optimizer.zero_grad()
        head.loss(batch, encoder(observations)).loss.backward()
        optimizer.step()
    variance = float(((observations - observations.mean(dim=0)) ** 2).mean())
    assert float(head.error(batch, encoder(observations)).mean()) < 0.2 * variance


def test_rae_shifts() -> None:
    """With shifts the encoder sees moved images, the decoder is to draw the unmoved ones; acting sees these."""
    space = image_space()
    observations = noise_images(space)
    _, plain = make(RAE, space)
    assert th.equal(plain.augment(observations), observations)
    encoder, head = make(RAE, space, augmentation="shift", pad=2)
    assert encoder._observation_space.shape == space.shape
    shifted = head.augment(observations)
    inner = observations[:, :, 2:-2, 2:-2]
    found = [
        [(dy, dx) for dy in range(5) for dx in range(5) if th.equal(image[:, dy : dy + 32, dx : dx + 32], centre)]
        for image, centre in zip(shifted, inner, strict=True)
    ]
    assert all(len(places) == 1 for places in found)
    assert len({places[0] for places in found}) > 1
    assert th.equal(head.center(observations), observations)
    th.testing.assert_close(head.target(observations, dither=False), plain.target(observations, dither=False))


# ---------------------------------------------------------------- the contrastive loss


@pytest.mark.parametrize("kwargs, size", [({}, 36), ({"crop_size": 28}, 36)], ids=["shift", "crop"])
def test_infonce_against_straight_line_code(kwargs: dict[str, Any], size: int) -> None:
    """Cross-entropy of q^T W k over all keys of the batch with the own one on the diagonal, in plain loops."""
    space = image_space(3, size)
    encoder, head = make(CURL, space, **kwargs)
    with th.no_grad():
        head.W.normal_(generator=seeded(5))
    batch = batch_of(noise_images(space, 6))
    latents = encoder(head.preprocess(head.augment(batch.observations)))
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


class Lookup(Encoder):
    """An encoder that gives each image the row of a table that its first pixel names."""

    def __init__(self, space: spaces.Box, table: th.Tensor):
        super().__init__(space, table.shape[1], table.shape[1])
        self.table = table

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.table[(observations[:, 0, 0, 0] * 255).round().long()]


@pytest.mark.parametrize("batch_size", [2, 16, 128])
def test_infonce_of_a_perfect_and_of_a_constant_encoder(batch_size: int) -> None:
    """Keys that only their anchor resembles: 0; keys all alike: log B, what guessing scores."""
    space = image_space(1, 8)
    observations = th.arange(batch_size, dtype=th.uint8).view(-1, 1, 1, 1).expand(-1, 1, 8, 8)
    for table, expected in [(th.eye(batch_size), 0.0), (th.ones(batch_size, 4), np.log(batch_size))]:
        encoder = Lookup(space, table)
        head = CURL(encoder, space)
        previous = np.inf
        for scale in (1.0, 5.0, 50.0):
            with th.no_grad():
                head.W.copy_(scale * th.eye(table.shape[1]))
            latents = encoder(head.preprocess(observations))
            loss = float(head.loss(batch_of(observations), latents).loss.detach())
            assert expected <= loss + 1e-5 and loss <= previous + 1e-5
            previous = loss
        assert loss == pytest.approx(expected, abs=1e-4)


def test_keys_come_from_the_momentum_encoder_without_gradient() -> None:
    """The loss changes with the momentum encoder's weights; neither encoder gets a gradient through the keys."""
    space = image_space()
    encoder, head = make(CURL, space)
    target = head.target_encoder.requires_grad_(True)
    batch = batch_of(noise_images(space))
    latents = encoder(head.preprocess(batch.observations)).detach().requires_grad_()
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


def test_w_starts_uniform() -> None:
    """CURL's W is drawn uniformly from [0, 1)."""
    th.manual_seed(0)
    space = image_space()
    w = CURL(PixelEncoder(space, n_filters=2), space).W.detach()
    assert w.shape == (50, 50)
    assert 0 <= float(w.min()) < 0.01 and 0.99 < float(w.max()) < 1
    assert float(w.mean()) == pytest.approx(0.5, abs=5 / np.sqrt(12 * 2500))


# ---------------------------------------------------------------- the contrastive error


def trained_curl(**kwargs: Any) -> tuple[Encoder, SRLHead, spaces.Box]:
    """A head that has seen two training batches."""
    space = image_space()
    th.manual_seed(0)
    encoder, head = make(CURL, space, **kwargs)
    for seed in (1, 2):
        batch = batch_of(noise_images(space, 6, seed))
        head.loss(batch, encoder(head.preprocess(head.augment(batch.observations))))
    return encoder, head, space


@pytest.mark.parametrize("kwargs", [{}, {"crop_size": 28}], ids=["shift", "crop"])
def test_curl_error_of_one_observation(kwargs: dict[str, Any]) -> None:
    """Positive for a batch of one, whose InfoNCE would be 0; independent of the rest of a batch; repeatable."""
    encoder, head, space = trained_curl(**kwargs)
    observations = noise_images(space, 5, seed=9)
    latents = encoder(head.preprocess(head.center(observations)))
    before = th.get_rng_state()
    errors = head.error(batch_of(observations), latents)
    assert th.equal(th.get_rng_state(), before)
    assert errors.shape == (5,)
    assert not errors.requires_grad
    assert float(errors.min()) > 0
    assert len(errors.unique()) == 5
    th.manual_seed(123)
    assert th.equal(errors, head.error(batch_of(observations), latents))
    for i in range(5):
        single = head.error(batch_of(observations[i : i + 1]), latents[i : i + 1])
        th.testing.assert_close(single, errors[i : i + 1], rtol=1e-5, atol=1e-6)
    order = th.tensor([3, 1, 4, 0, 2])
    th.testing.assert_close(head.error(batch_of(observations[order]), latents[order]), errors[order])
    single = batch_of(observations[:1])
    assert float(head.loss(single, latents[:1]).error) == 0


def test_curl_error_against_straight_line_code() -> None:
    """Cross-entropy of the own key against the bank's, where the views are known: images that a shift leaves alone."""
    space = image_space(1, 36)
    th.manual_seed(0)
    encoder, head = make(CURL, space, bank_size=10)
    flat = th.arange(0, 250, 25, dtype=th.uint8).view(-1, 1, 1, 1).expand(-1, 1, 36, 36)
    batch = batch_of(flat)
    latents = encoder(head.preprocess(flat)).detach()
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


def test_bank_is_filled_once_from_the_first_batches() -> None:
    """In order, as stored (uint8, not augmented), up to its size; later batches do not change it."""
    space = image_space()
    encoder, head = make(CURL, space, bank_size=8)
    seen = [noise_images(space, 3, seed) for seed in range(4)]
    assert int(head.bank_filled) == 0
    for n, observations in enumerate(seen):
        head.loss(batch_of(observations), encoder(head.preprocess(observations)))
        assert int(head.bank_filled) == min(3 * (n + 1), 8)
        filled = int(head.bank_filled)
        assert th.equal(head.bank[:filled], th.cat(seen)[:filled])
    # Measuring does not fill it.
    fresh_encoder, fresh = make(CURL, space)
    fresh.error(batch_of(seen[0]), fresh_encoder(fresh.preprocess(seen[0])))
    assert int(fresh.bank_filled) == 0


def test_set_bank_chooses_the_negatives() -> None:
    """They replace those of training, none of the old ones counts any more; nonsense is one sentence."""
    encoder, head, space = trained_curl(bank_size=16)
    chosen = noise_images(space, 5, seed=11)
    head.set_bank(chosen)
    assert int(head.bank_filled) == 5 and th.equal(head.bank[:5], chosen)
    _, fresh = make(CURL, space, bank_size=16)
    fresh.load_state_dict({**head.state_dict(), "bank": th.cat([chosen, th.zeros_like(head.bank[5:])])})
    observations = noise_images(space, 4, seed=9)
    latents = encoder(head.preprocess(observations))
    assert th.equal(fresh.error(batch_of(observations), latents), head.error(batch_of(observations), latents))
    for wrong in (noise_images(space, 17), chosen[:0], chosen[:, :1]):
        with pytest.raises(ValueError, match=r"set_bank got observations of shape .* the bank holds 1 to 16"):
            head.set_bank(wrong)


@pytest.mark.parametrize("trained_before", [False, True])
def test_bank_travels_in_the_state_dict(trained_before: bool) -> None:
    """A restored head gives the same errors and goes on filling where the other stopped."""
    encoder, head, space = trained_curl(bank_size=16)
    assert int(head.bank_filled) == 12
    _, other = make(CURL, space, bank_size=16)
    if trained_before:
        full = noise_images(space, 16, seed=5)
        other.loss(batch_of(full), encoder(head.preprocess(full)))
    other.load_state_dict(head.state_dict())
    observations = noise_images(space, 4, seed=9)
    latents = encoder(head.preprocess(observations))
    assert th.equal(other.error(batch_of(observations), latents), head.error(batch_of(observations), latents))
    more = noise_images(space, 6, seed=7)
    for each in (head, other):
        each.loss(batch_of(more), encoder(head.preprocess(more)))
    assert int(other.bank_filled) == 16
    assert th.equal(other.bank, head.bank)
    assert th.equal(other.bank[12:], more[:4])


# ---------------------------------------------------------------- what the encoder sees


def small_model(env: Any, srl: str, **kwargs: Any) -> CuReSAC:
    return tiny_model("CnnPolicy", env, srl=srl, buffer_size=40, **kwargs)


def test_curl_on_100_pixels_crops() -> None:
    """CURL's setting: random crops of 84 in training, the central one to act, and latents without tanh."""
    env = PixelBox(size=100)
    policy = small_model(env, "curl").policy
    assert policy.encoder_space.shape == (6, 84, 84)
    assert policy.observation_space.shape == (6, 100, 100)
    assert policy.encoder.projection.tanh is False
    assert policy.actor.features_extractor.tanh is False
    observation = env.reset(seed=0)[0]
    observations = th.as_tensor(observation)[None]
    augmented = policy.srl.augment(observations.expand(16, -1, -1, -1))
    windows = observations[0].unfold(1, 84, 1).unfold(2, 84, 1)
    places = [
        (windows == crop[:, None, None]).flatten(3).all(dim=3).all(dim=0).nonzero().tolist() for crop in augmented
    ]
    assert all(places)
    assert len({str(place) for place in places}) > 8
    central = observations[:, :, 8:92, 8:92]
    assert th.equal(policy.srl.center(observations), central)
    assert th.equal(center_crop(observations, 84), central)
    # Acting sees the centre alone: what is painted around it does not matter, what is painted within does.
    around, within = observation.copy(), observation.copy()
    around[:, :8] = around[:, 92:] = around[:, :, :8] = around[:, :, 92:] = 77
    within[:, 8:20, 8:92] = 77
    actions = [policy.predict(image, deterministic=True)[0] for image in (observation, around, within)]
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.array_equal(actions[0], actions[2])


def test_curl_on_84_pixels_shifts() -> None:
    """Up to the crops' size observations are padded and shifted instead, and latents keep their tanh."""
    env = PixelBox(size=84)
    policy = small_model(env, "curl").policy
    assert policy.encoder_space.shape == (6, 84, 84)
    assert policy.encoder.projection.tanh is True
    observations = th.as_tensor(env.reset(seed=0)[0])[None].expand(16, -1, -1, -1)
    shifted = policy.srl.augment(observations)
    assert shifted.shape == observations.shape
    assert len(shifted.flatten(1).unique(dim=0)) > 8
    assert th.equal(policy.srl.center(observations), observations)


@pytest.mark.parametrize(
    "srl_kwargs, seen, tanh",
    [
        ({"augmentation": "shift"}, 100, True),
        ({"augmentation": "crop"}, 84, False),
        ({"augmentation": "crop", "crop_size": 64}, 64, False),
    ],
    ids=str,
)
def test_curl_augmentation_can_be_chosen(srl_kwargs: dict[str, Any], seen: int, tanh: bool) -> None:
    policy = small_model(PixelBox(size=100), "curl", srl_kwargs=srl_kwargs).policy
    assert policy.encoder_space.shape == (6, seen, seen)
    assert policy.encoder.projection.tanh is tanh


def test_the_users_encoder_arguments_win() -> None:
    """What the head asks of the encoder are defaults."""
    kwargs = {"features_extractor_kwargs": {"tanh": True, "n_filters": 2}}
    assert small_model(PixelBox(size=100), "curl", policy_kwargs=kwargs).policy.encoder.projection.tanh is True


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_training_loss_and_error_are_what_the_head_says(srl: str) -> None:
    """The head is given the latents of what ``augment`` returns and the batch as stored, and its values are logged."""
    model = small_model(PixelBox(), srl)
    head = model.policy.srl
    original = head.loss
    outputs = []

    def spy(batch: ReplayBufferSamples, latents: th.Tensor) -> Any:
        assert batch.observations.dtype == th.uint8
        assert batch.observations.shape == (8, *model.observation_space.shape)
        assert latents.shape == (8, 50)
        outputs.append(original(batch, latents))
        return outputs[-1]

    head.loss = spy
    model.learn(11, log_interval=10**9)
    (output,) = outputs
    assert float(model.logger.name_to_value["train/srl_loss"]) == float(output.loss.detach())
    assert float(model.logger.name_to_value["train/curious_reward_raw_mean"]) == float(output.error.mean())


@pytest.mark.parametrize("augmentation", ["none", "shift"])
def test_encoder_sees_augmented_images_scaled_to_one(augmentation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every latent that a head is trained on is the encoder's, of what its own ``augment`` returned, divided by 255."""
    model = small_model(PixelBox(), "rae", srl_kwargs={"augmentation": augmentation}, learning_rate=0.0)
    head, encoder = model.policy.srl, model.policy.encoder
    augmented, latents = [], []
    augment, loss = head.augment, head.loss
    monkeypatch.setattr(head, "augment", lambda obs: augmented.append(augment(obs)) or augmented[-1])
    monkeypatch.setattr(head, "loss", lambda batch, z: latents.append(z.detach()) or loss(batch, z))
    model.learn(11)
    # Observations first, next observations second.
    assert len(augmented) == 2
    th.testing.assert_close(latents[0], encoder(augmented[0].float() / 255).detach())


@pytest.mark.parametrize("srl", ["rae", "curl"])
def test_the_head_does_not_own_the_encoder(srl: str) -> None:
    """Its parameters and its state are its own: nothing is trained or saved twice."""
    policy = small_model(PixelBox(), srl).policy
    encoders = {id(p) for module in (policy.encoder, policy.encoder_target) for p in module.parameters()}
    assert not encoders & {id(p) for p in policy.srl.parameters()}
    assert not any("encoder" in key for key in policy.srl.state_dict())
    assert policy.srl.encoder is policy.encoder
    assert policy.srl.target_encoder is policy.encoder_target


@pytest.mark.parametrize("update", ["joint", "sequential"])
def test_a_head_that_holds_the_encoder_trains_it_no_more_than_others(update: str, tmp_path: Path) -> None:
    """Kept as attributes usually are; the archive can be loaded."""

    class Plain(RAE):
        pass

    class Holder(RAE):
        def __init__(self, encoder: Any, observation_space: spaces.Space, **kwargs: Any):
            super().__init__(encoder, observation_space, **kwargs)
            self.encoder = encoder
            self.parts = th.nn.ModuleList([encoder.projection])

    models = [tiny_model("CnnPolicy", PixelBox(), srl=kind, update=update).learn(14) for kind in (Plain, Holder)]
    ours, theirs = (dict(model.policy.encoder.named_parameters()) for model in models)
    assert all(th.equal(ours[name], theirs[name]) for name in ours)
    models[1].save(tmp_path / "model.zip")
    loaded = CuReSAC.load(tmp_path / "model.zip", custom_objects={"srl": Holder})
    assert all(th.equal(value, theirs[name]) for name, value in loaded.policy.encoder.named_parameters())


class Lazy(RAE):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.out = th.nn.LazyLinear(3)


class Extra(RAE):
    def get_extra_state(self) -> dict[str, int]:
        return {"n": 1}

    def set_extra_state(self, state: Any) -> None:
        pass


@pytest.mark.parametrize(
    ("head", "message"),
    [(Lazy, "Lazy has layers that take their sizes from the first batch"), (Extra, "Extra has _extra_state in its")],
)
def test_heads_that_no_archive_could_give_back_are_refused(head: type[SRLHead], message: str) -> None:
    """Before they are trained."""
    with pytest.raises(ValueError, match=message):
        tiny_model("CnnPolicy", PixelBox(), srl=head)


def test_a_head_has_no_learning_rate_of_its_own() -> None:
    class Slow(RAE):
        def __init__(self, *args: Any, **kwargs: Any):
            super().__init__(*args, **kwargs)
            self.optimizer_kwargs["lr"] = 1e-4

    sentence = r"^Slow.optimizer_kwargs has lr=0.0001, but everything learns at learning_rate: remove it, and change"
    with pytest.raises(TypeError, match=sentence):
        tiny_model("CnnPolicy", PixelBox(), srl=Slow)


@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize("channels", [1, 3])
def test_preprocessing_leaves_its_input_alone(channels: int, memory_format: th.memory_format) -> None:
    space = spaces.Box(0, 255, (channels, 20, 20), np.uint8)
    images = th.full((2, channels, 20, 20), 200.0).contiguous(memory_format=memory_format)
    scaled = preprocess(images, space)
    assert (images == 200).all() and scaled.max() == th.tensor(200.0) / 255


def test_a_seeds_networks_begin_alike_under_every_head() -> None:
    """So that arms with different heads are paired: whatever a head draws, the others' weights are the seed's."""

    class Greedy(RAE):
        """Draws many random numbers."""

        def __init__(self, *arguments: Any, **settings: Any):
            super().__init__(*arguments, **settings)
            th.rand(1000)

    env, settings = PixelBox(size=36), dict(curiosity="separate", seed=3)
    heads: list[Any] = ["rae", "curl", Greedy]
    weights = [tiny_model("CnnPolicy", env, srl=head, **settings).policy.state_dict() for head in heads]
    others = {name for name in weights[0] if not name.startswith("srl.")}
    assert {name.split(".")[0] for name in others} >= {"encoder", "actor", "critic", "curious_actor", "curious_critic"}
    for policy in weights[1:]:
        assert all(th.equal(weights[0][name], policy[name]) for name in others)
    another = tiny_model("CnnPolicy", env, srl="rae", **{**settings, "seed": 4}).policy.state_dict()
    drawn = [name for name in weights[0] if name.startswith("srl.decoder") and name.endswith("weight")]
    assert drawn and not any(th.equal(weights[0][name], another[name]) for name in drawn), "heads have a seed, too"


def test_vector_rae_trains_in_the_agent() -> None:
    """``MlpPolicy`` trains the vector autoencoder like any head."""
    model = tiny_model("MlpPolicy", VectorBox())
    before = copy.deepcopy(model.policy.srl.state_dict())
    model.learn(13)
    after = model.policy.srl.state_dict()
    assert all(not th.equal(before[key], after[key]) for key in before)


# ---------------------------------------------------------------- real frames


@pytest.fixture(scope="module")
def frames() -> th.Tensor:
    """Single frames of finger-spin under random actions, [400, 3, 36, 36]: 20 short episodes, one after the other."""
    env = make_dmc_env("finger", "spin", image_size=36, frame_stack=1, seed=0)
    env.action_space.seed(0)
    collected = [env.reset()[0]]
    while len(collected) < 400:
        episode_ends = len(collected) % 20 == 0
        collected.append(env.reset()[0] if episode_ends else env.step(env.action_space.sample())[0])
    env.close()
    return th.as_tensor(np.array(collected))


def test_rae_learns_to_draw_real_frames(frames: th.Tensor) -> None:
    """On frames of episodes that it has not seen its error falls well below that of the mean image.

    A decoder that draws the same background whatever the latents cannot pass: not even if its picture is the mean of
    the very frames on which it is judged.
    """
    train, held_out = frames[:300], frames[300:]
    model = tiny_model(
        "CnnPolicy",
        PixelBox(frame_stack=1),
        srl="rae",
        curiosity=None,
        srl_schedule="alternating",
        srl_period=10**9,
        learning_rate=3e-3,
        policy_kwargs={"features_extractor_kwargs": {"n_filters": 16}},
        buffer_size=len(train),
        replay_buffer_class=ReplayBuffer,
    )
    model.learn(10)
    model.replay_buffer.reset()
    for frame in train.numpy():
        model.replay_buffer.add(frame, frame, np.zeros(2), np.zeros(1), np.zeros(1), [{}])
    assert model.replay_buffer.full
    head = model.policy.srl

    @th.no_grad()
    def error() -> float:
        return float(head.error(batch_of(held_out), model.policy.encode(held_out)).mean())

    own, errors = head.decoder, {}
    background, mean = train.median(dim=0).values[None], head.target(train, dither=False).mean(dim=0)
    best = head.target(held_out, dither=False).mean(dim=0)
    pictures = {"mean": mean, "background": head.target(background, dither=False), "held-out mean": best}
    for name, picture in pictures.items():
        head.decoder = Draw(picture)
        errors[name] = error()
    head.decoder = own

    def well_below_the_mean_image(value: float) -> bool:
        return value < 0.6 * errors["mean"]

    assert not any(well_below_the_mean_image(value) for value in errors.values())
    assert not well_below_the_mean_image(error())
    model.train(600, batch_size=16)
    assert well_below_the_mean_image(error())
