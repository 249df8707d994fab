"""Image augmentations: batched, on the batch's device, of any dtype (uint8 stays uint8)."""

import torch as th


def center_crop(images: th.Tensor, size: int) -> th.Tensor:
    """Cut the central square.

    :param images: [B, C, H, W]
    :param size: Side of the square, pixels
    :return: [B, C, size, size]
    """
    top, left = (images.shape[2] - size) // 2, (images.shape[3] - size) // 2
    return images[:, :, top : top + size, left : left + size]


def random_crop(images: th.Tensor, size: int, generator: th.Generator | None = None) -> th.Tensor:
    """Cut a random square from each image, every offset (the last one too) equally likely.

    All channels of one observation, hence all its stacked frames, are cut alike (CURL, section 4.2).

    :param images: [B, C, H, W]
    :param size: Side of the square, pixels
    :param generator: Source of the offsets (default: torch's global one)
    :return: [B, C, size, size]
    """
    batch = len(images)
    # Drawn on the CPU: a CUDA draw would not repeat a CPU run, and two short vectors cost nothing to send.
    top = th.randint(images.shape[2] - size + 1, (batch,), generator=generator).to(images.device)
    left = th.randint(images.shape[3] - size + 1, (batch,), generator=generator).to(images.device)
    windows = images.unfold(2, size, 1).unfold(3, size, 1)
    return windows[th.arange(batch, device=images.device), :, top, left]


def random_shift(images: th.Tensor, pad: int = 4, generator: th.Generator | None = None) -> th.Tensor:
    """Shift each image by up to ``pad`` pixels, the border pixels repeated (DrQ, section 4.1).

    :param images: [B, C, H, W], H = W
    :param pad: Largest shift, pixels
    :param generator: Source of the shifts (default: torch's global one)
    :return: [B, C, H, W]
    """
    size = images.shape[2]
    # Replicate-padding by index, because torch's own has no uint8 kernel.
    clamped = th.arange(-pad, size + pad, device=images.device).clamp(0, size - 1)
    return random_crop(images[:, :, clamped][:, :, :, clamped], size, generator)
