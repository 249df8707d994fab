"""Image augmentations: batched, on the batch's device, of any dtype (uint8 stays uint8)."""

import torch as th


def center_crop(images: th.Tensor, size: int) -> th.Tensor:
    """Cut the central square.

    :param images: [B, C, H, W]
    :param size: Side of the square, pixels
    :return: [B, C, size, size]
    :raises ValueError: if the images are smaller
    """
    _check_size(images, size)
    top, left = (images.shape[2] - size) // 2, (images.shape[3] - size) // 2
    return images[:, :, top : top + size, left : left + size]


def random_crop(images: th.Tensor, size: int, generator: th.Generator | None = None) -> th.Tensor:
    """Cut a random square from each image, every offset (the last one too) equally likely.

    All channels of one observation, hence all its stacked frames, are cut alike (CURL, section 4.2).

    :param images: [B, C, H, W]
    :param size: Side of the square, pixels
    :param generator: Source of the offsets (default: torch's global one)
    :return: [B, C, size, size]
    :raises ValueError: if the images are smaller
    """
    _check_size(images, size)
    batch, _, height, width = images.shape
    # Drawn on the CPU: a CUDA draw would not repeat a CPU run, and two short vectors cost nothing to send.
    top = th.randint(height - size + 1, (batch, 1), generator=generator)
    left = th.randint(width - size + 1, (batch, 1), generator=generator)
    return _windows(images, top + th.arange(size), left + th.arange(size))


def random_shift(images: th.Tensor, pad: int = 4, generator: th.Generator | None = None) -> th.Tensor:
    """Shift each image by up to ``pad`` pixels, the border pixels repeated (DrQ, section 4.1).

    :param images: [B, C, H, W]
    :param pad: Largest shift, pixels
    :param generator: Source of the shifts (default: torch's global one)
    :return: [B, C, H, W]
    """
    batch, _, height, width = images.shape
    down = th.randint(-pad, pad + 1, (batch, 1), generator=generator)
    right = th.randint(-pad, pad + 1, (batch, 1), generator=generator)
    # Rows and columns outside of the image are those of its border.
    rows = (th.arange(height) + down).clamp(0, height - 1)
    columns = (th.arange(width) + right).clamp(0, width - 1)
    return _windows(images, rows, columns)


def _check_size(images: th.Tensor, size: int) -> None:
    if size > min(images.shape[2:]):
        raise ValueError(
            f"size is {size}, but the images are {images.shape[2]} x {images.shape[3]} pixels: take smaller crops, or "
            "larger images."
        )


def _windows(images: th.Tensor, rows: th.Tensor, columns: th.Tensor) -> th.Tensor:
    """images[b, c, rows[b, i], columns[b, j]] for all b, c, i, j, as one gather (the quickest way on uint8)."""
    batch, channels, _, width = images.shape
    rows, columns = rows.to(images.device), columns.to(images.device)
    index = (rows[:, :, None] * width + columns[:, None, :]).view(batch, 1, -1)
    windows = images.flatten(2).gather(2, index.expand(-1, channels, -1))
    return windows.view(batch, channels, rows.shape[1], columns.shape[1])
