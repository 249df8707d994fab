"""What the encoder sees: each view is a window of the (border-replicated) image, each window equally likely."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import PixelBox, tiny_model
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from updates_for_tests import filled_model, train_once

from sb3_cure.networks.augmentations import Augmentation, RandomCrop, RandomShift, make_augmentation

SIZES = st.integers(2, 9)


def image_space(channels: int, height: int, width: int) -> spaces.Box:
    return spaces.Box(0, 255, (channels, height, width), np.uint8)


def shift(images: th.Tensor, pad: int) -> RandomShift:
    return RandomShift(image_space(*images.shape[1:]), pad)


def crop(images: th.Tensor, size: int | tuple[int, int] | None) -> RandomCrop:
    return RandomCrop(image_space(*images.shape[1:]), size)


def numbered(batch: int, channels: int, height: int, width: int) -> th.Tensor:
    """Images in which every value is unique, so that a window tells where it was cut."""
    return th.arange(batch * channels * height * width).view(batch, channels, height, width)


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


# ---------------------------------------------------------------- windows


@given(st.integers(1, 4), st.integers(1, 4), SIZES, SIZES, st.data(), st.integers(0, 2**31))
@settings(deadline=None, max_examples=60)
def test_crop_is_one_window_of_all_channels(
    batch: int, channels: int, height: int, width: int, data: st.DataObject, seed: int
) -> None:
    """Each image's crop equals the slice at one offset, which all of its channels (stacked frames) share."""
    rows, columns = data.draw(st.integers(1, height - 1)), data.draw(st.integers(1, width - 1))
    images = numbered(batch, channels, height, width)
    augmentation = crop(images, (rows, columns))
    crops = augmentation(images, seeded(seed))
    assert crops.shape == (batch, *augmentation.view_space.shape) == (batch, channels, rows, columns)  # type: ignore[misc]
    for image, view in zip(images.numpy(), crops.numpy(), strict=True):
        top, left = np.argwhere(image[0] == view[0, 0, 0])[0]
        np.testing.assert_array_equal(view, image[:, top : top + rows, left : left + columns])


@given(st.integers(1, 4), st.integers(1, 4), SIZES, SIZES, st.integers(1, 6), st.integers(0, 2**31))
@settings(deadline=None, max_examples=60)
def test_shift_is_a_crop_of_the_replicated_border(
    batch: int, channels: int, height: int, width: int, pad: int, seed: int
) -> None:
    """DrQ's definition: pad by repeating the border, then crop back to the old size."""
    images = numbered(batch, channels, height, width)
    augmentation = shift(images, pad)
    shifted = augmentation(images, seeded(seed))
    assert shifted.shape == images.shape and augmentation.view_space.shape == images.shape[1:]
    for image, result in zip(images.numpy(), shifted.numpy(), strict=True):
        padded = np.pad(image, [(0, 0), (pad, pad), (pad, pad)], mode="edge")
        offsets = range(2 * pad + 1)
        windows = [padded[:, top : top + height, left : left + width] for top in offsets for left in offsets]
        assert any(np.array_equal(result, window) for window in windows)


def assert_equally_likely(offsets: np.ndarray, expected: set[tuple[int, int]]) -> None:
    """Every expected pair occurs, no other does, and each within 5 standard deviations of its mean count."""
    pairs, counts = np.unique(offsets, axis=0, return_counts=True)
    assert set(map(tuple, pairs.tolist())) == expected
    probability = 1 / len(expected)
    deviation = np.sqrt(len(offsets) * probability * (1 - probability))
    assert np.abs(counts - len(offsets) * probability).max() < 5 * deviation


def test_every_crop_offset_is_equally_likely() -> None:
    """The last row and column too (the reference code of CURL never reaches them), for each image of one batch."""
    images = numbered(1, 1, 5, 6).expand(3000, -1, -1, -1)
    corners = crop(images, 3)(images, seeded(0))[:, 0, 0, 0].numpy()
    offsets = np.stack([corners // 6, corners % 6], axis=1)
    assert_equally_likely(offsets, {(top, left) for top in range(3) for left in range(4)})


def test_every_shift_is_equally_likely() -> None:
    """From -pad to +pad in both directions, both ends included, for each image of one batch."""
    images = numbered(1, 1, 9, 11).expand(5000, -1, -1, -1)
    centers = shift(images, 2)(images, seeded(0))[:, 0, 4, 5].numpy()
    offsets = np.stack([centers // 11 - 4, centers % 11 - 5], axis=1)
    shifts = range(-2, 3)
    assert_equally_likely(offsets, {(down, right) for down in shifts for right in shifts})


@given(st.integers(1, 3), st.integers(1, 4), SIZES, SIZES, st.data())
@settings(deadline=None, max_examples=60)
def test_centre_view_of_crops_leaves_equal_margins(
    batch: int, channels: int, height: int, width: int, data: st.DataObject
) -> None:
    """Opposite margins differ by at most the one pixel that cannot be halved."""
    rows, columns = data.draw(st.integers(1, height - 1)), data.draw(st.integers(1, width - 1))
    images = numbered(batch, channels, height, width)
    crops = crop(images, (rows, columns)).center(images).numpy()
    top, left = np.argwhere(images[0, 0].numpy() == crops[0, 0, 0, 0])[0]
    np.testing.assert_array_equal(crops, images.numpy()[:, :, top : top + rows, left : left + columns])
    assert abs(height - rows - 2 * top) <= 1
    assert abs(width - columns - 2 * left) <= 1


@pytest.mark.parametrize("size, expected", [((100, 100), (84, 84)), ((240, 320), (202, 269)), ((96, 50), (81, 42))])
def test_crops_have_curls_proportion(size: tuple[int, int], expected: tuple[int, int]) -> None:
    """Of images of any size, so that large ones are not reduced to their middle."""
    images = th.zeros(2, 3, *size, dtype=th.uint8)
    augmentation = crop(images, None)
    assert augmentation(images).shape[2:] == augmentation.center(images).shape[2:] == expected


def test_centre_view_is_the_observation_without_crops() -> None:
    images = numbered(2, 3, 8, 8)
    assert th.equal(shift(images, 4).center(images), images)
    plain = Augmentation(image_space(3, 8, 8))
    assert th.equal(plain.center(images), images) and th.equal(plain(images), images)


# ---------------------------------------------------------------- types and random numbers


VIEWS: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "centre": lambda images: crop(images, 5).center(images),
    "crop": lambda images: crop(images, 5)(images, seeded(0)),
    "shift": lambda images: shift(images, 2)(images, seeded(0)),
}


@pytest.mark.parametrize("dtype", [th.uint8, th.float32, th.bfloat16])
@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
def test_type_and_input_are_kept(view: str, dtype: th.dtype, memory_format: th.memory_format) -> None:
    """Any type passes through unchanged, however it lies in memory, and the input is not written to."""
    augment = VIEWS[view]
    images = th.randint(256, (4, 3, 8, 8), generator=seeded(1)).to(dtype)
    copy = images.clone()
    augmented = augment(images.contiguous(memory_format=memory_format))
    assert augmented.dtype == dtype
    th.testing.assert_close(augmented.double(), augment(images.double()), rtol=0, atol=0)
    augmented = augmented.clone() + 1
    assert th.equal(augment(copy), augmented - 1)
    assert th.equal(images, copy)


@pytest.mark.parametrize("kind", ["crop", "shift"])
def test_generator_repeats_and_leaves_the_global_one_alone(kind: str) -> None:
    """Equal seeds give equal windows, other seeds others; torch's global generator is used only without one."""
    images = numbered(8, 1, 32, 32)
    augment = crop(images, 20) if kind == "crop" else shift(images, 4)
    before = th.get_rng_state()
    assert th.equal(augment(images, seeded(1)), augment(images, seeded(1)))
    assert not th.equal(augment(images, seeded(1)), augment(images, seeded(2)))
    assert th.equal(th.get_rng_state(), before)
    th.manual_seed(1)
    first = augment(images)
    assert not th.equal(first, augment(images))
    th.manual_seed(1)
    assert th.equal(first, augment(images))


# ---------------------------------------------------------------- what the policy does with it


def test_unusable_augmentations_are_refused() -> None:
    """Of vectors, and crops that are not smaller than the images in each direction."""
    for name in ("shift", "crop"):
        with pytest.raises(ValueError, match=f"augmentation='{name}' needs images"):
            make_augmentation(name, spaces.Box(-1, 1, (3,)))
    for size in (0, 36, 40, (30, 40), (36, 30)):
        with pytest.raises(ValueError, match="augmentation='crop' cannot cut"):
            make_augmentation("crop", image_space(3, 36, 40), size=size)


@pytest.mark.parametrize(
    "srl, augmentation, size, expected",
    [
        ("rae", "auto", 36, Augmentation),
        ("curl", "auto", 36, RandomShift),
        ("curl", "auto", 120, RandomCrop),
        (None, "auto", 36, Augmentation),
        (None, "shift", 36, RandomShift),
        ("rae", "shift", 36, RandomShift),
        ("rae", None, 36, Augmentation),
    ],
)
def test_auto_is_chosen_by_the_head(srl: str | None, augmentation: str | None, size: int, expected: type) -> None:
    """The policy owns one, which its head shares; without a head augmentation alone is DrQ's idea."""
    arguments: dict[str, Any] = dict(srl=srl, augmentation=augmentation, buffer_size=40, curiosity=None)
    model = tiny_model("CnnPolicy", PixelBox(size=size), **arguments)
    policy = model.policy
    assert type(policy.augmentation) is expected
    assert policy.encoder.view_space == policy.augmentation.view_space
    assert policy.encoder.view_space.shape[1] == (round(0.84 * size) if expected is RandomCrop else size)
    assert policy.srl is None or policy.srl.augment is policy.augmentation


def test_arguments_reach_the_augmentation() -> None:
    policy = tiny_model("CnnPolicy", PixelBox(), augmentation="shift", augmentation_kwargs={"pad": 2}).policy
    assert policy.augmentation.pad == 2
    assert isinstance(make_augmentation("crop", image_space(3, 9, 9), size=4), RandomCrop)


@pytest.mark.parametrize("augmentation, size, n_steps", [("shift", 36, 1), ("crop", 30, 1), ("shift", 36, 3)])
def test_training_sees_views_acting_the_centre(augmentation: str, size: int, n_steps: int) -> None:
    """Observations and those after n steps are viewed anew in each update; `predict` never draws a view."""
    kwargs: dict[str, Any] = {"augmentation_kwargs": {"size": 30}} if augmentation == "crop" else {}
    kwargs |= dict(curiosity=None, n_steps=n_steps)
    model = filled_model(pixels=True, augmentation=augmentation, learning_rate=0.0, **kwargs)
    policy = model.policy
    seen: list[th.Tensor] = []
    policy.encoder.trunk.register_forward_hook(lambda module, args, out: seen.append(args[0].detach()))
    drawn: list[tuple[th.Tensor, th.Tensor]] = []
    augment = policy.augmentation.__class__.__call__
    original = policy.augmentation

    class Spy(type(original)):  # type: ignore[misc]
        def __call__(self, observations: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
            views = augment(self, observations, generator)
            drawn.append((observations, views))
            return views

    original.__class__ = Spy
    train_once(model)
    assert len(drawn) == 2 and not th.equal(drawn[0][0], drawn[1][0])
    assert th.equal(drawn[1][0], model.replay_buffer.n_step(n_steps, model.gamma).next_observations)
    assert drawn[0][1].shape[2:] == (size, size)
    for (_, views), inputs in zip(drawn, seen, strict=True):
        assert th.equal(inputs, views)
    seen.clear()
    observation = PixelBox().reset(seed=0)[0]
    before = th.get_rng_state()
    model.predict(observation, deterministic=True)
    assert th.equal(th.get_rng_state(), before) and len(drawn) == 2
    assert th.equal(seen[0], original.center(th.as_tensor(observation)[None]))
