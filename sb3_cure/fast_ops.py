"""The few kernels that are written for speed. Each has its plain twin in ``tests/test_fast_ops.py``."""

import functools
from typing import Any

import torch as th
from torch.nn import functional as F


class _FusedConvReLU(th.autograd.Function):
    """oneDNN's convolution with its bias, which then needs no pass over the images of its own, and a ReLU. Its ReLU is
    not oneDNN's, which makes 0 of what is not a number: guards would not see it."""

    @staticmethod
    def forward(
        ctx: Any, images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: int, transposed: bool
    ) -> th.Tensor:
        kernel, padding = weight, 0
        if transposed:  # a convolution of the padded images with the mirrored kernel
            kernel = weight.transpose(0, 1).flip(2, 3).contiguous(memory_format=th.channels_last)
            padding = len(weight[0, 0]) - 1
        conv = th.ops.mkldnn._convolution_pointwise
        features: th.Tensor = conv(images, kernel, bias, [padding] * 2, [stride] * 2, [1, 1], 1, "none", [], "").relu_()
        ctx.save_for_backward(images, weight, features)
        ctx.stride, ctx.transposed = stride, transposed
        return features

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        images, weight, features = ctx.saved_tensors
        gradient = th.ops.aten.threshold_backward(gradient, features, 0)
        to_images, to_weight, to_bias = ctx.needs_input_grad[:3]
        in_kernel = to_bias and not ctx.transposed  # there it costs as much as the gradient of the weights
        of_images, of_weight, of_bias = th.ops.aten.convolution_backward(
            *(gradient, images, weight, [len(weight)], [ctx.stride] * 2, [0, 0], [1, 1], ctx.transposed, [0, 0], 1),
            (to_images, to_weight, in_kernel),
        )
        if to_bias and not in_kernel:
            of_bias = gradient.permute(0, 2, 3, 1).flatten(1).sum(dim=0).view(-1, gradient.shape[1]).sum(dim=0)
        return of_images, of_weight, of_bias, None, None


def conv_relu(
    images: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: int = 1, transposed: bool = False
) -> th.Tensor:
    """``relu(conv2d(...))`` or ``relu(conv_transpose2d(...))``, within autocast in its number format. On CPUs both
    are one kernel of oneDNN.

    :param images: In NHWC memory order, [B, C, H, W]
    :param weight: [C', C, k, k], or of transposed ones [C, C', k, k]
    :param bias: [C']
    :param stride: Of both axes; 1 for transposed ones
    :param transposed: Whether the convolution is transposed
    :return: [B, C', H', W']
    """
    device = images.device.type
    if th.is_autocast_enabled(device):
        images, weight, bias = (each.to(th.get_autocast_dtype(device)) for each in (images, weight, bias))
    fuses = device == "cpu" and th.backends.mkldnn.is_available() and not _is_traced()
    if fuses and (images.dtype == th.float32 or (images.dtype == th.bfloat16 and _computes_bf16())):
        return _FusedConvReLU.apply(images, weight, bias, stride, transposed)  # type: ignore[no-any-return]
    return F.relu((F.conv_transpose2d if transposed else F.conv2d)(images, weight, bias, stride), inplace=True)


def _is_traced() -> bool:
    """Whether the graph is being recorded, to be compiled or to run elsewhere."""
    return th.compiler.is_compiling() or th.jit.is_tracing()


@functools.cache
def _computes_bf16() -> bool:
    return bool(th.ops.mkldnn._is_mkldnn_bf16_supported())


def add_bias(images: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """``images + bias`` for each channel. Repeated over an image, the bias is added in long runs: torch's own broadcast
    over the few channels of NHWC images costs ten times as much in bf16.

    :param images: In NHWC memory order, [B, C, H, W]
    :param bias: [C]
    :return: [B, C, H, W]
    """
    batch, channels, height, width = images.shape
    flat = images.permute(0, 2, 3, 1).reshape(batch, -1)
    biased = flat + bias.to(images.dtype).repeat(height * width)
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
    return add_bias(F.conv_transpose2d(images, kernel.to(images.dtype)), bias.repeat(4))


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
