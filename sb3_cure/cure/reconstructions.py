"""Strips of observations above their reconstructions, for logs and notebooks."""

from collections.abc import Mapping

import numpy as np
import torch as th

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import stacks_by_key
from sb3_cure.data.observations import by_key, image_spaces, rows_of
from sb3_cure.data.samples import Samples


@th.no_grad()
def reconstruction_strips(
    policy: CuRePolicy, batch: Samples, frame_stack: int | Mapping[str, int], columns: int = 8
) -> dict[str, np.ndarray]:
    """Newest frames of a few observations above their reconstructions.

    :param policy: The policy
    :param batch: Samples
    :param frame_stack: Frames per observation, as for ``FrameStackReplayBuffer``
    :param columns: How many observations
    :return: For each reconstructed image, by its key (``""`` if observations are images), an image uint8
        (C, 2 * H, columns * W) with C = 1 or 3
    """
    if not image_spaces(policy.sensed_space):
        return {}
    pair = policy.reconstruct(rows_of(batch.observations, slice(columns)))
    if pair is None:
        return {}
    seen, drawn = map(by_key, pair)
    stacks, strips = stacks_by_key(policy.sensed_space, frame_stack), {}
    for key in drawn:
        rows = [th.cat(list(newest_frames(images[key], stacks[key])), dim=2) for images in (seen, drawn)]
        strips[key] = th.cat(rows, dim=1).cpu().numpy()
    return strips


def newest_frames(images: th.Tensor, frame_stack: int) -> th.Tensor:
    """Newest frame of each stack.

    :param images: Stacks of frames, oldest first, 0-255, [B, C, H, W]
    :param frame_stack: Frames per stack
    :return: The newest frames, grey or in colour, uint8 [B, C', H, W] with C' = 1 or 3
    """
    channels = images.shape[1] // frame_stack
    if channels not in (1, 3):
        channels = 1
    return images[:, -channels:].to(th.uint8)
