"""Kernels written for speed against their plain twins: values, and the gradients of all that they read."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from sb3_cure.networks import fast_ops
from sb3_cure.networks.fast_ops import (
    SquaredError,
    conv_transpose_cells,
    convolve,
    from_cells,
    random_bytes_like,
    relu_,
    relu_backward,
    to_cells,
)
from sb3_cure.networks.layers import Conv2dReLU, ConvTranspose2dReLU

sizes = st.integers(1, 9)


def tensor(*shape: int, seed: int = 0, dtype: th.dtype = th.float64) -> th.Tensor:
    """Normal numbers; images in NHWC memory order."""
    drawn = th.randn(shape, generator=th.Generator().manual_seed(seed), dtype=th.float64).to(dtype)
    return drawn.contiguous(memory_format=th.channels_last) if len(shape) == 4 else drawn


def agree(fast: Callable[..., th.Tensor], plain: Callable[..., th.Tensor], *inputs: th.Tensor) -> None:
    """Same values, same gradients."""
    results = []
    for function in (fast, plain):
        own = [each.clone().requires_grad_() for each in inputs]
        value = function(*own)
        (value * tensor(*value.shape, seed=9)).sum().backward()
        results.append([value.detach(), *(each.grad for each in own)])
    for mine, theirs in zip(*results, strict=True):
        th.testing.assert_close(mine, theirs)


@given(batch=sizes, channels=sizes, height=sizes, width=sizes)
@settings(max_examples=30, deadline=None)
def test_cells_are_pixels_in_another_order(batch: int, channels: int, height: int, width: int) -> None:
    images = tensor(batch, channels, 2 * height, 2 * width)
    cells = to_cells(images)
    assert cells.shape == (batch, 4 * channels, height, width)
    assert th.equal(from_cells(cells), images)
    for row in (0, 1):
        for column in (0, 1):
            first = (2 * row + column) * channels
            assert th.equal(cells[:, first : first + channels], images[:, :, row::2, column::2])


@given(batch=sizes, channels=sizes, drawn=sizes, height=sizes, width=sizes, k=st.integers(1, 3), relu=st.booleans())
@pytest.mark.parametrize("few", [1, 4])
@pytest.mark.parametrize(("stride", "transposed"), [(1, False), (2, False), (1, True)])
@settings(max_examples=20, deadline=None)
def test_convolution(
    stride: int,
    transposed: bool,
    few: int,
    batch: int,
    channels: int,
    drawn: int,
    height: int,
    width: int,
    k: int,
    relu: bool,
) -> None:
    def plain(*args: th.Tensor) -> th.Tensor:
        result = (F.conv_transpose2d if transposed else F.conv2d)(*args, stride=stride)
        return result.relu() if relu else result

    images = tensor(batch, channels, height + 2, width + 2)
    weight = tensor(*((channels, drawn) if transposed else (drawn, channels)), k, k, seed=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fast_ops, "FEW_CHANNELS", few)
        fast = partial(convolve, stride=stride, transposed=transposed, relu=relu)
        agree(fast, plain, images, weight, tensor(drawn, seed=2))
        agree(fast, plain, images, weight)


def test_relu_of_bf16_equals_torchs() -> None:
    """For every bf16 number, with its gradient; NaNs of either sign stay NaNs."""
    every = th.arange(-(2**15), 2**15).to(th.int16).view(th.bfloat16)
    theirs = every.clone().requires_grad_()
    expected = theirs.relu()
    found = relu_(every.clone())
    th.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    gradient = tensor(*every.shape, dtype=th.bfloat16)
    expected.backward(gradient)
    numbers = ~every.isnan()
    assert th.equal(relu_backward(gradient, found)[numbers], theirs.grad[numbers])


@given(batch=sizes, channels=sizes, drawn=sizes, height=sizes, width=sizes)
@settings(max_examples=30, deadline=None)
def test_transposed_convolution_by_cells(batch: int, channels: int, drawn: int, height: int, width: int) -> None:
    def plain(images: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        return F.conv_transpose2d(images, weight, bias, stride=2, output_padding=1)

    inputs = tensor(batch, channels, height, width), tensor(channels, drawn, 3, 3, seed=1), tensor(drawn, seed=2)
    agree(lambda *args: from_cells(conv_transpose_cells(*args)), plain, *inputs)


@pytest.mark.parametrize("kind", [Conv2dReLU, ConvTranspose2dReLU])
@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_layers_compute_in_the_format_of_the_images(kind: Any, dtype: th.dtype) -> None:
    """With fp32 weights and gradients; a NaN stays visible after the ReLU."""
    layer = kind(4, 5, 3)
    plain = F.conv2d if kind is Conv2dReLU else F.conv_transpose2d
    images = tensor(2, 4, 9, 9, dtype=dtype)
    result = layer(images)
    assert result.dtype == dtype and result.is_contiguous(memory_format=th.channels_last)
    expected = plain(images, layer.weight.to(dtype), layer.bias.to(dtype)).relu()
    th.testing.assert_close(result, expected, rtol=0.02, atol=0.02)
    result.float().sum().backward()
    assert layer.weight.grad.dtype == layer.bias.grad.dtype == th.float32
    layer.bias.data[0] = th.nan
    assert layer(images).isnan().any()


@pytest.mark.parametrize("dtype", [th.float32, th.bfloat16])
def test_squared_error(dtype: th.dtype) -> None:
    """In fp32, of images in bf16, too, as is their difference."""
    drawn, target = tensor(3, 2, 4, 6, dtype=dtype).requires_grad_(), tensor(3, 2, 4, 6, seed=1, dtype=th.float32)
    same = drawn.detach().clone().requires_grad_()
    expected = (same.float() - target).square().flatten(1).mean(dim=1)
    error: Any = SquaredError.apply(drawn, target.clone(memory_format=th.preserve_format))
    assert error.dtype == th.float32
    th.testing.assert_close(error, expected)
    for value in (error, expected):
        (value * th.tensor([1.0, -2.0, 3.0])).sum().backward()
    th.testing.assert_close(drawn.grad, same.grad, rtol=1e-2 if dtype == th.bfloat16 else 1e-6, atol=1e-6)


@pytest.mark.parametrize("memory_format", [th.contiguous_format, th.channels_last])
def test_random_bytes(memory_format: th.memory_format) -> None:
    """Every value is equally likely (chi-square, 255 degrees of freedom), in the images' memory order."""
    th.manual_seed(0)
    images = th.zeros(7, 3, 33, 35, dtype=th.uint8).contiguous(memory_format=memory_format)
    drawn = th.cat([random_bytes_like(images).flatten() for _ in range(10)])
    assert random_bytes_like(images).stride() == images.stride()
    expected = len(drawn) / 256
    counts = th.bincount(drawn.int(), minlength=256).double()
    assert 170 < float(((counts - expected) ** 2 / expected).sum()) < 350
