"""The autoencoder: loss against straight-line code, errors without noise, shapes, and a fit on real frames."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from srl_for_tests import batch_of, encode, image_space, make, noise_images, randomise, seeded
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_cure import make_dmc_env
from sb3_cure.networks.encoders import PixelEncoder, VectorEncoder
from sb3_cure.networks.fast_ops import from_cells, to_cells
from sb3_cure.srl import RAE

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


@pytest.mark.parametrize("latent_penalty", [1e-6, 0.3])
def test_rae_loss_against_straight_line_code(latent_penalty: float) -> None:
    """Eq. 2 as meant: mean squared error of each image + lambda_z * mean of half the squared norm of the latents."""
    space = image_space()
    encoder, head = make(RAE, space, latent_penalty=latent_penalty)
    randomise(head)
    batch = batch_of(noise_images(space))
    latents = encode(encoder, batch.observations)
    th.manual_seed(3)
    target = from_cells(head.target(to_cells(batch.observations), dither=True)).numpy()
    th.manual_seed(3)
    loss, error = head.loss(batch, latents)
    drawn, z = head.decoder(latents).detach().double().numpy(), latents.detach().double().numpy()
    expected = [np.mean((drawn[i] - target[i]) ** 2) for i in range(8)]
    assert error.shape == (8,)
    assert not error.requires_grad and loss.requires_grad
    np.testing.assert_allclose(error.numpy(), expected, rtol=1e-5)
    penalty = np.mean([0.5 * np.dot(z[i], z[i]) for i in range(8)])
    assert float(loss.detach()) == pytest.approx(np.mean(expected) + latent_penalty * penalty, rel=1e-5)


# ---------------------------------------------------------------- the autoencoder's error


class Draw(th.nn.Module):
    """A decoder that draws given images, whatever the latents."""

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
    np.testing.assert_allclose(errors.numpy(), (0.1 * np.arange(8)) ** 2, rtol=3e-5, atol=1e-6)
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


@given(st.integers(1, 5), st.integers(0, 30), st.integers(0, 30), st.integers(1, 6))
@settings(deadline=None, max_examples=30)
def test_decoder_draws_images_of_any_size(n_layers: int, extra_height: int, extra_width: int, channels: int) -> None:
    """From the smallest image that the encoder takes."""
    space = image_space(channels, 4 * n_layers - 1 + extra_height, 4 * n_layers - 1 + extra_width)
    encoder = PixelEncoder(space, features_dim=3, n_filters=2, n_layers=n_layers)
    assert RAE(encoder, space).reconstruct(th.rand(2, 3)).shape == (2, *space.shape)


def test_vector_autoencoder() -> None:
    """Vectors are targets as they are: no bits, no dither."""
    space = spaces.Box(-3, 3, (5,), np.float32)
    encoder = VectorEncoder(space, features_dim=8, hidden_dim=32)
    head = RAE(encoder, space, latent_penalty=0.0)
    observations = th.rand(64, 5, generator=seeded(0)) * 6 - 3
    latents = encoder(observations)
    loss, error = head.loss(batch_of(observations), latents)
    expected = ((head.reconstruct(latents).detach() - observations) ** 2).mean(dim=1)
    th.testing.assert_close(error, expected)
    th.testing.assert_close(loss.detach(), expected.mean())
    assert th.equal(head.error(batch_of(observations), latents), error)


@pytest.mark.parametrize("weight_decay", [1e-7, 0.5])
def test_weight_decay_is_the_decoders_alone(weight_decay: float) -> None:
    """lambda_theta goes to the head's optimizer; its default is SAC-AE's."""
    kwargs: dict[str, Any] = {} if weight_decay == 1e-7 else {"srl_kwargs": {"decoder_weight_decay": weight_decay}}
    policy = tiny_model("CnnPolicy", PixelBox(), curiosity=None, **kwargs).policy
    optimizers = [policy.srl.optimizer, *policy.encoder_update.optimizers.values(), policy.critic.optimizer]
    found = [group["weight_decay"] for optimizer in optimizers for group in optimizer.param_groups]
    assert found == [weight_decay, 0, 0]


@pytest.mark.parametrize("augmentation", ["shift", "crop"])
def test_decoder_draws_the_centred_views(augmentation: str) -> None:
    """Whatever the shift of what the encoder saw: latents need not hold it."""
    kwargs: dict[str, Any] = {"augmentation_kwargs": {"size": 28}} if augmentation == "crop" else {}
    model = tiny_model("CnnPolicy", PixelBox(), augmentation=augmentation, curiosity=None, **kwargs)
    policy = model.policy
    head: Any = policy.srl
    observations = noise_images(model.observation_space, 8)  # type: ignore[arg-type]
    views, centred = policy.augmentation(observations), policy.augmentation.center(observations)
    latents = encode(policy.encoder, views)
    assert head.reconstruct(latents).shape == views.shape == (8, *policy.augmentation.view_space.shape)
    head.decoder = Draw(head.target(centred, dither=False))
    assert float(head.error(batch_of(observations, views), latents).max()) < 1e-12
    assert float(head.error(batch_of(observations.roll(1, 0), views), latents).min()) > 1e-3
    assert float(head.loss(batch_of(observations, views), latents).error.max()) < 1e-3
    head.decoder = Draw(head.target(views, dither=False))
    assert float(head.loss(batch_of(observations, views), latents).error.mean()) > 1e-3


@pytest.mark.parametrize("bits", [0, 9])
def test_bits_of_a_pixel_are_one_to_eight(bits: int) -> None:
    """Otherwise the target would be noise alone, or images that were never seen."""
    with pytest.raises(ValueError, match="bits is"):
        make(RAE, image_space(), bits=bits)


# ---------------------------------------------------------------- real frames


@pytest.fixture(scope="module")
def frames() -> th.Tensor:
    """Single frames of finger-spin under random actions, [240, 3, 36, 36]: 12 short episodes, one after the other."""
    env = make_dmc_env("finger", "spin", image_size=36, frame_stack=1, renderer="fast", seed=0)
    env.action_space.seed(0)
    collected = [env.reset()[0]]
    while len(collected) < 240:
        episode_ends = len(collected) % 20 == 0
        collected.append(env.reset()[0] if episode_ends else env.step(env.action_space.sample())[0])
    env.close()
    return th.as_tensor(np.array(collected))


def test_rae_learns_to_draw_real_frames(frames: th.Tensor) -> None:
    """On frames of episodes that it has not seen its error falls well below that of the mean image.

    A decoder that draws the same background whatever the latents cannot pass: not even if its picture is the mean of
    the very frames on which it is judged.
    """
    train, held_out = frames[:180], frames[180:]
    model = tiny_model(
        "CnnPolicy",
        PixelBox(frame_stack=1),
        srl="rae",
        curiosity=None,
        learning_rate=3e-3,
        batch_size=16,
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
    model.fit_representation(1000)
    assert well_below_the_mean_image(error())
