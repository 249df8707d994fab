"""The few kernels that are written for speed. Each has its plain twin in ``tests/test_fast_ops.py``."""

from typing import Any

import torch as th
from torch.nn import functional as F

#: Up to so many channels a transposed convolution is faster as a plain one of the padded images
FEW_CHANNELS = 16
#: The bits of minus infinity in bf16, as an integer. Those of all negative numbers are below, those of NaNs are not
MINUS_INFINITY = -128


def _convolve(images: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, stride: int, transposed: bool) -> th.Tensor:
    if not transposed:
        return F.conv2d(images, weight, bias, stride)
    if images.device.type != "cpu" or images.shape[1] > FEW_CHANNELS:
        return F.conv_transpose2d(images, weight, bias)
    border = weight.shape[-1] - 1
    # With the argument `padding` oneDNN would be as slow as for the transposed one.
    return F.conv2d(F.pad(images, (border,) * 4), weight.flip(2, 3).transpose(0, 1), bias)


def _as_integers(images: th.Tensor) -> th.Tensor:
    """The bits of bf16, which a CPU compares as integers several times as fast; other formats as they are."""
    is_slow = images.dtype == th.bfloat16 and images.device.type == "cpu" and not th.compiler.is_compiling()
    return images.view(th.int16) if is_slow else images


def relu_(images: th.Tensor) -> th.Tensor:
    """ReLU in place; what is not a number stays so.

    :param images: Any shape
    :return: The same tensor
    """
    bits = _as_integers(images)
    th.threshold_(bits, 0 if bits is images else MINUS_INFINITY, 0)
    return images


def relu_backward(gradient: th.Tensor, images: th.Tensor) -> th.Tensor:
    """
    :param gradient: Of the result, in its number format
    :param images: Result of ``relu_``
    :return: Gradient of what it was given
    """
    bits = th.ops.aten.threshold_backward(_as_integers(gradient), _as_integers(images), 0)
    return bits.view(gradient.dtype)


class Convolution(th.autograd.Function):
    """Convolution or, of stride 1, its transpose, with a ReLU or without: the gradient at the images of either is the
    other one. oneDNN takes half as long again for the transposed one in bf16, if channels are few."""

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
        """Parameters as of ``convolve``, all in one number format."""
        result = _convolve(images, weight, bias, stride, transposed)
        if relu:
            relu_(result)
        ctx.save_for_backward(images, weight, result if relu else None)
        ctx.stride, ctx.transposed = stride, transposed
        return result

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """
        :param gradient: [B, C', H', W']
        :return: Gradients of images, weight and bias
        """
        images, weight, result = ctx.saved_tensors
        if result is not None:
            gradient = relu_backward(gradient, result)
        by_images, by_weight, by_bias, *_ = ctx.needs_input_grad
        sizes = [ctx.stride] * 2, [0, 0], [1, 1], ctx.transposed, [0, 0], 1
        of_images, of_weight, _ = th.ops.aten.convolution_backward(
            gradient, images, weight, None, *sizes, [by_images and ctx.stride > 1, by_weight, False]
        )
        if by_images and ctx.stride == 1:
            of_images = _convolve(gradient, weight, None, 1, not ctx.transposed)
        # Inside of the transposed one, the bias's gradient costs as much as that of the weights.
        return of_images, of_weight, gradient.sum((0, 2, 3)) if by_bias else None, None, None, None


def convolve(
    images: th.Tensor,
    weight: th.Tensor,
    bias: th.Tensor | None = None,
    stride: int = 1,
    transposed: bool = False,
    relu: bool = False,
) -> th.Tensor:
    """
    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: Square kernels, [C', C, k, k], transposed [C, C', k, k]
    :param bias: [C']
    :param stride: 1 if transposed
    :param transposed: Whether it is the transpose
    :param relu: Whether a ReLU follows
    :return: ``conv2d``, or ``conv_transpose2d``, within autocast in its number format, [B, C', H', W']
    """
    device = images.device.type
    if th.is_autocast_enabled(device):
        dtype = th.get_autocast_dtype(device)
        cast = [each if each is None or each.dtype != th.float32 else each.to(dtype) for each in (images, weight, bias)]
        images, weight, bias = cast  # type: ignore[assignment]
    if th.is_grad_enabled():
        return Convolution.apply(images, weight, bias, stride, transposed, relu)  # type: ignore[no-any-return]
    # Exports can follow these, but no function with a gradient of its own.
    result = _convolve(images, weight, bias, stride, transposed)
    return relu_(result) if relu else result


def to_cells(images: th.Tensor) -> th.Tensor:
    """The 2x2 pixels of each cell as channels.

    :param images: In NHWC memory order, height and width even, [B, C, H, W]
    :return: In NHWC memory order, [B, 4 C, H / 2, W / 2]
    """
    batch, channels, height, width = images.shape
    rows = images.permute(0, 2, 3, 1).reshape(batch, height // 2, 2, width // 2, 2 * channels)
    # Three times as fast as a permutation
    return th.cat((rows[:, :, 0], rows[:, :, 1]), dim=3).permute(0, 3, 1, 2)


def from_cells(cells: th.Tensor) -> th.Tensor:
    """
    :param cells: As of ``to_cells``, [B, 4 C, h, w]
    :return: The images, [B, C, 2 h, 2 w]
    """
    batch, channels, height, width = cells.shape
    pixels = cells.permute(0, 2, 3, 1).reshape(batch, height, width, 2, 2, channels // 4)
    return pixels.permute(0, 1, 3, 2, 4, 5).reshape(batch, 2 * height, 2 * width, -1).permute(0, 3, 1, 2)


def conv_transpose_cells(images: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """A transposed 3x3 convolution of stride 2 into few channels, drawn by cells of 2x2 pixels: of a transposed 2x2
    convolution of stride 1, which is several times as fast.

    Pixels of even rows get the kernel's row 0 of one input and row 2 of the one before, those of odd rows get row 1.

    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: As ``nn.ConvTranspose2d`` has it, [C, C', 3, 3]
    :param bias: [C']
    :return: ``to_cells`` of ``conv_transpose2d(..., stride=2, output_padding=1)``, [B, 4 C', H + 1, W + 1]
    """
    taps = th.tensor([[0, 2], [1, 3]], device=weight.device)  # by pixel of the cell and input; row 3 is empty
    kernel = F.pad(weight, (0, 1, 0, 1))[:, :, taps[:, None, :, None], taps[None, :, None, :]]
    kernel = kernel.permute(0, 2, 3, 1, 4, 5).flatten(1, 3)
    return convolve(images, kernel, bias.repeat(4), transposed=True)


class SquaredError(th.autograd.Function):
    """Mean squared error of each image, [B]: as few passes over the images as there can be, forward and backward."""

    @staticmethod
    def forward(ctx: Any, drawn: th.Tensor, target: th.Tensor) -> th.Tensor:
        """
        :param drawn: Images, [B, C, H, W]; their gradient is all that is computed
        :param target: The same in fp32; it is overwritten
        :return: [B]
        """
        difference = th.sub(drawn, target, out=target) if target.stride() == drawn.stride() else drawn - target
        ctx.save_for_backward(difference.to(drawn.dtype))
        flat = difference.permute(0, 2, 3, 1).reshape(len(difference), -1)  # a view where kernels write NHWC
        return th.linalg.vector_norm(flat, dim=1).square() / flat.shape[1]

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        """
        :param gradient: [B]
        :return: Gradient of ``drawn``
        """
        (difference,) = ctx.saved_tensors
        return difference * (gradient * (2 / difference[0].numel())).view(-1, 1, 1, 1).to(difference.dtype), None


def random_bytes_like(images: th.Tensor) -> th.Tensor:
    """Uniform random bytes, eight per draw of the generator: drawn singly they would cost as much as the encoder.

    :param images: uint8, dense
    :return: uint8 of the same shape and memory order
    """
    draws = th.empty(-(-images.numel() // 8), dtype=th.int64, device=images.device).random_(-(2**63), None)
    return draws.view(th.uint8)[: images.numel()].as_strided(images.shape, images.stride())
