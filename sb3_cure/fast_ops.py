"""The few kernels that are written for speed. Each has its plain twin in ``tests/test_fast_ops.py``."""

from typing import Any

import torch as th
from torch.nn import functional as F

#: Up to so many channels a transposed convolution is faster as a plain one of the padded images
FEW_CHANNELS = 16


def _convolve(images: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, transposed: bool) -> th.Tensor:
    if not transposed:
        return F.conv2d(images, weight, bias)
    if images.device.type != "cpu" or images.shape[1] > FEW_CHANNELS:
        return F.conv_transpose2d(images, weight, bias)
    border = weight.shape[-1] - 1
    # Padded here and not by the convolution, which would take as long as a transposed one
    return F.conv2d(F.pad(images, (border,) * 4), weight.flip(2, 3).transpose(0, 1), bias)


class Convolution(th.autograd.Function):
    """Convolution of stride 1, or its transpose: the gradient of the images is the respective other one. oneDNN takes
    half as long again for the transposed one in bf16, if channels are few."""

    @staticmethod
    def forward(ctx: Any, images: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, transposed: bool) -> th.Tensor:
        """
        :param images: In NHWC memory order, [B, C, H, W]
        :param weight: Square kernels in the images' number format; [C', C, k, k], transposed [C, C', k, k]
        :param bias: [C']
        :param transposed: Whether it is the transpose
        :return: [B, C', H', W']
        """
        ctx.save_for_backward(images, weight)
        ctx.transposed, ctx.bias = transposed, bias is not None
        return _convolve(images, weight, bias, transposed)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        """
        :param gradient: [B, C', H', W']
        :return: Gradients of images, weight and bias
        """
        images, weight = ctx.saved_tensors
        of_images = _convolve(gradient, weight, None, not ctx.transposed) if ctx.needs_input_grad[0] else None
        _, of_weight, of_bias = th.ops.aten.convolution_backward(
            *(gradient, images, weight, weight.shape[:1], [1, 1], [0, 0], [1, 1], ctx.transposed, [0, 0], 1),
            [False, True, ctx.bias],
        )
        return of_images, of_weight, of_bias, None


def convolve(
    images: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None, transposed: bool = False
) -> th.Tensor:
    """
    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: Square kernels, [C', C, k, k], transposed [C, C', k, k]
    :param bias: [C']
    :param transposed: Whether it is the transpose
    :return: ``conv2d``, or ``conv_transpose2d``, within autocast in its number format, [B, C', H', W']
    """
    device = images.device.type
    dtype = th.get_autocast_dtype(device) if th.is_autocast_enabled(device) else images.dtype
    bias = None if bias is None else bias.to(dtype)
    return Convolution.apply(images.to(dtype), weight.to(dtype), bias, transposed)  # type: ignore[no-any-return]


def add_bias(images: th.Tensor, bias: th.Tensor, relu: bool = False) -> th.Tensor:
    """``images + bias`` for each channel. Repeated over an image, the bias is added in long runs: torch's own broadcast
    over the few channels of NHWC images costs ten times as much in bf16.

    :param images: In NHWC memory order, [B, C, H, W]
    :param bias: [C]
    :param relu: Whether a ReLU follows
    :return: [B, C, H, W]
    """
    batch, channels, height, width = images.shape
    flat = images.permute(0, 2, 3, 1).reshape(batch, -1)
    biased = flat + bias.to(images.dtype).repeat(height * width)
    biased = biased.relu_() if relu else biased
    return biased.view(batch, height, width, channels).permute(0, 3, 1, 2)


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
    return add_bias(convolve(images, kernel, transposed=True), bias.repeat(4))


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
