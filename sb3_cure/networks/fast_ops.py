"""Kernels written for speed. Each is compared with its plain twin in ``tests/networks/test_fast_ops.py``."""

from typing import Any

import torch as th
from torch.nn import functional as F

#: With at most this many channels, a transposed convolution is faster as a convolution of the padded images: in bf16
#: oneDNN needs 1.5 times as long for the former
FEW_CHANNELS = 16
#: The bits of minus infinity in bf16, as an integer. All negative numbers are below it, NaNs are not
MINUS_INFINITY = -128


def _convolve(images: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, stride: int, transposed: bool) -> th.Tensor:
    if not transposed:
        return F.conv2d(images, weight, bias, stride)
    if images.device.type != "cpu" or images.shape[1] > FEW_CHANNELS:
        return F.conv_transpose2d(images, weight, bias)
    border = weight.shape[-1] - 1
    # Padded beforehand: with conv2d's `padding`, oneDNN is as slow as for the transposed convolution.
    return F.conv2d(F.pad(images, (border,) * 4), weight.flip(2, 3).transpose(0, 1), bias)


def _as_integers(images: th.Tensor) -> th.Tensor:
    """View bf16 as integers, which a CPU compares several times as fast; return other formats unchanged."""
    return images.view(th.int16) if images.dtype == th.bfloat16 and images.device.type == "cpu" else images


def relu_(images: th.Tensor) -> th.Tensor:
    """Apply a ReLU in place; NaNs stay NaNs.

    :param images: Any shape
    :return: The same tensor
    """
    bits = _as_integers(images)
    th.threshold_(bits, 0 if bits is images else MINUS_INFINITY, 0)
    return images


def relu_backward(gradient: th.Tensor, result: th.Tensor) -> th.Tensor:
    """Compute the gradient of ``relu_``.

    :param gradient: Gradient of the result, in its number format
    :param result: Result of ``relu_``
    :return: Gradient of the input
    """
    bits = th.ops.aten.threshold_backward(_as_integers(gradient), _as_integers(result), 0)
    return bits.view(gradient.dtype)


class Convolution(th.autograd.Function):
    """Convolution, or its transpose with stride 1, followed by an optional ReLU."""

    @staticmethod
    def forward(
        ctx: Any,
        images: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor | None,
        stride: int,
        transposed: bool,
        relu: bool,
    ) -> th.Tensor:
        """Compute the result; parameters are those of ``convolve``, all in one number format."""
        result = _convolve(images, weight, bias, stride, transposed)
        if relu:
            relu_(result)
        ctx.save_for_backward(images, weight, result if relu else None)
        ctx.stride, ctx.transposed = stride, transposed
        return result

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Compute the gradients of images, weight and bias.

        :param gradient: Gradient of the result, [B, C', H', W']
        :return: One gradient or None for each argument of ``forward``
        """
        images, weight, result = ctx.saved_tensors
        if result is not None:
            gradient = relu_backward(gradient, result)
        needs_images, needs_weight, needs_bias, *_ = ctx.needs_input_grad
        sizes = [ctx.stride] * 2, [0, 0], [1, 1], ctx.transposed, [0, 0], 1
        images_grad, weight_grad, _ = th.ops.aten.convolution_backward(
            gradient, images, weight, None, *sizes, [needs_images, needs_weight, False]
        )
        # Inside convolution_backward the bias's gradient would cost as much as that of the weights.
        return images_grad, weight_grad, gradient.sum((0, 2, 3)) if needs_bias else None, None, None, None


def convolve(
    images: th.Tensor,
    weight: th.Tensor,
    bias: th.Tensor | None = None,
    stride: int = 1,
    transposed: bool = False,
    relu: bool = False,
) -> th.Tensor:
    """Compute ``conv2d`` or ``conv_transpose2d`` in the number format of the images.

    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: Square kernels, [C', C, k, k], transposed [C, C', k, k]
    :param bias: [C']
    :param stride: Stride; 1 if transposed
    :param transposed: Whether to compute the transposed convolution
    :param relu: Whether to apply a ReLU to the result
    :return: [B, C', H', W']
    """
    weight, bias = weight.to(images.dtype), None if bias is None else bias.to(images.dtype)
    if th.is_grad_enabled():
        return Convolution.apply(images, weight, bias, stride, transposed, relu)  # type: ignore[no-any-return]
    # ONNX export cannot follow an autograd.Function.
    result = _convolve(images, weight, bias, stride, transposed)
    return relu_(result) if relu else result


def to_cells(images: th.Tensor) -> th.Tensor:
    """Turn each cell of 2x2 pixels into channels.

    :param images: In NHWC memory order, height and width even, [B, C, H, W]
    :return: In NHWC memory order, [B, 4 C, H / 2, W / 2]
    """
    batch, channels, height, width = images.shape
    rows = images.permute(0, 2, 3, 1).reshape(batch, height // 2, 2, width // 2, 2 * channels)
    # Three times as fast as a permutation.
    return th.cat((rows[:, :, 0], rows[:, :, 1]), dim=3).permute(0, 3, 1, 2)


def from_cells(cells: th.Tensor) -> th.Tensor:
    """Invert ``to_cells``.

    :param cells: [B, 4 C, h, w]
    :return: Images, [B, C, 2 h, 2 w]
    """
    batch, channels, height, width = cells.shape
    pixels = cells.permute(0, 2, 3, 1).reshape(batch, height, width, 2, 2, channels // 4)
    return pixels.permute(0, 1, 3, 2, 4, 5).reshape(batch, 2 * height, 2 * width, -1).permute(0, 3, 1, 2)


def conv_transpose_cells(images: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """Compute a transposed 3x3 convolution of stride 2 as cells of 2x2 pixels.

    It is a transposed 2x2 convolution of stride 1 into four times as many channels, which is several times as fast.
    Pixels of even rows get the kernel's row 0 of one input and row 2 of the input before; those of odd rows get row 1.

    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: Weight of the ``nn.ConvTranspose2d``, [C, C', 3, 3]
    :param bias: [C']
    :return: ``to_cells`` of ``conv_transpose2d(..., stride=2, output_padding=1)``, [B, 4 C', H + 1, W + 1]
    """
    taps = th.tensor([[0, 2], [1, 3]], device=weight.device)  # by pixel of the cell and input; row 3 is zero
    kernel = F.pad(weight, (0, 1, 0, 1))[:, :, taps[:, None, :, None], taps[None, :, None, :]]
    kernel = kernel.permute(0, 2, 3, 1, 4, 5).flatten(1, 3)
    return convolve(images, kernel, bias.repeat(4), transposed=True)


class SquaredError(th.autograd.Function):
    """Mean squared error of each image, [B], with as few passes over the images as possible."""

    @staticmethod
    def forward(ctx: Any, drawn: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Compute the errors.

        :param drawn: Images, [B, C, H, W]; only they get a gradient
        :param target: Images to compare with, fp32, of the same shape; overwritten
        :return: [B]
        """
        difference = th.sub(drawn, target, out=target) if target.stride() == drawn.stride() else drawn - target
        ctx.save_for_backward(difference.to(drawn.dtype))
        flat = difference.permute(0, 2, 3, 1).reshape(len(difference), -1)  # a view where kernels write NHWC
        return th.linalg.vector_norm(flat, dim=1).square() / flat.shape[1]

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        """Compute the gradient of ``drawn``.

        :param gradient: Gradient of the errors, [B]
        :return: [B, C, H, W], and None for the target
        """
        (difference,) = ctx.saved_tensors
        return difference * (gradient * (2 / difference[0].numel())).view(-1, 1, 1, 1).to(difference.dtype), None


def random_bytes_like(images: th.Tensor) -> th.Tensor:
    """Draw uniform random bytes, eight per draw of the generator: single draws cost as much as the encoder.

    :param images: uint8, dense
    :return: uint8 of the same shape and memory order
    """
    draws = th.empty(-(-images.numel() // 8), dtype=th.int64, device=images.device).random_(-(2**63), None)
    return draws.view(th.uint8)[: images.numel()].as_strided(images.shape, images.stride())
