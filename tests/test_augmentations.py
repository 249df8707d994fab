"""Crops and shifts: each result is a window of the (border-replicated) image, each window equally likely."""

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_cure.augmentations import center_crop, random_crop, random_shift

SIZES = st.integers(1, 9)


def numbered(batch: int, channels: int, height: int, width: int) -> th.Tensor:
    """Images in which every value is unique, so that a window tells where it was cut."""
    return th.arange(batch * channels * height * width).view(batch, channels, height, width)


def seeded(seed: int) -> th.Generator:
    return th.Generator().manual_seed(seed)


@given(st.integers(1, 4), st.integers(1, 4), SIZES, SIZES, st.data(), st.integers(0, 2**31))
@settings(deadline=None)
def test_a_crop_is_one_window_of_all_channels(
    batch: int, channels: int, height: int, width: int, data: st.DataObject, seed: int
) -> None:
    """Each image's crop equals the slice at one offset, which all of its channels (stacked frames) share."""
    size = data.draw(st.integers(1, min(height, width)))
    images = numbered(batch, channels, height, width)
    crops = random_crop(images, size, seeded(seed))
    assert crops.shape == (batch, channels, size, size)
    for image, crop in zip(images.numpy(), crops.numpy(), strict=True):
        top, left = np.argwhere(image[0] == crop[0, 0, 0])[0]
        np.testing.assert_array_equal(crop, image[:, top : top + size, left : left + size])


@given(st.integers(1, 4), st.integers(1, 4), SIZES, SIZES, st.integers(1, 6), st.integers(0, 2**31))
@settings(deadline=None)
def test_a_shift_is_a_crop_of_the_replicated_border(
    batch: int, channels: int, height: int, width: int, pad: int, seed: int
) -> None:
    """DrQ's definition: pad by repeating the border, then crop back to the old size."""
    images = numbered(batch, channels, height, width)
    shifted = random_shift(images, pad, seeded(seed))
    assert shifted.shape == images.shape
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
    corners = random_crop(images, 3, seeded(0))[:, 0, 0, 0].numpy()
    offsets = np.stack([corners // 6, corners % 6], axis=1)
    assert_equally_likely(offsets, {(top, left) for top in range(3) for left in range(4)})


def test_every_shift_is_equally_likely() -> None:
    """From -pad to +pad in both directions, both ends included, for each image of one batch."""
    images = numbered(1, 1, 9, 11).expand(5000, -1, -1, -1)
    centers = random_shift(images, 2, seeded(0))[:, 0, 4, 5].numpy()
    offsets = np.stack([centers // 11 - 4, centers % 11 - 5], axis=1)
    shifts = range(-2, 3)
    assert_equally_likely(offsets, {(down, right) for down in shifts for right in shifts})


@given(st.integers(1, 3), st.integers(1, 4), SIZES, SIZES, st.data())
@settings(deadline=None)
def test_the_center_crop_leaves_equal_margins(
    batch: int, channels: int, height: int, width: int, data: st.DataObject
) -> None:
    """It is a window whose opposite margins differ by at most the one pixel that cannot be halved."""
    size = data.draw(st.integers(1, min(height, width)))
    images = numbered(batch, channels, height, width).numpy()
    crops = center_crop(th.as_tensor(images), size).numpy()
    assert crops.shape == (batch, channels, size, size)
    top, left = np.argwhere(images[0, 0] == crops[0, 0, 0, 0])[0]
    np.testing.assert_array_equal(crops, images[:, :, top : top + size, left : left + size])
    assert abs(height - size - 2 * top) <= 1
    assert abs(width - size - 2 * left) <= 1


@pytest.mark.parametrize("dtype", [th.uint8, th.float32, th.bfloat16])
@pytest.mark.parametrize(
    "augment",
    [
        lambda images: center_crop(images, 5),
        lambda images: random_crop(images, 5, seeded(0)),
        lambda images: random_shift(images, 2, seeded(0)),
    ],
    ids=["center", "crop", "shift"],
)
@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
def test_type_and_input_are_kept(augment, dtype: th.dtype, memory_format: th.memory_format) -> None:
    """Any type passes through unchanged, however it lies in memory, and the input is not written to."""
    images = th.randint(256, (4, 3, 8, 8), generator=seeded(1)).to(dtype)
    copy = images.clone()
    augmented = augment(images.contiguous(memory_format=memory_format))
    assert augmented.dtype == dtype
    th.testing.assert_close(augmented.double(), augment(images.double()), rtol=0, atol=0)
    augmented += 1
    assert th.equal(augment(copy), augmented - 1)


@pytest.mark.parametrize("augment", [lambda x, g: random_crop(x, 20, g), lambda x, g: random_shift(x, 4, g)])
def test_a_generator_repeats_and_leaves_the_global_one_alone(augment) -> None:
    """Equal seeds give equal windows, other seeds others; torch's global generator is used only without one."""
    images = numbered(8, 1, 32, 32)
    before = th.get_rng_state()
    assert th.equal(augment(images, seeded(1)), augment(images, seeded(1)))
    assert not th.equal(augment(images, seeded(1)), augment(images, seeded(2)))
    assert th.equal(th.get_rng_state(), before)
    th.manual_seed(1)
    first = augment(images, None)
    assert not th.equal(first, augment(images, None))
    th.manual_seed(1)
    assert th.equal(first, augment(images, None))


@pytest.mark.parametrize("crop", [center_crop, random_crop])
def test_crops_are_no_larger_than_images(crop) -> None:
    with pytest.raises(ValueError, match="size is 36, but the images are 40 x 20 pixels"):
        crop(th.zeros(1, 3, 40, 20), 36)
