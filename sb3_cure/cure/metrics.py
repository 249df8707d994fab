"""Training metrics: tensors while training, Python floats once, when ``train`` ends; pictures of reconstructions."""

import numpy as np
import torch as th
from stable_baselines3.common.logger import Image, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import infer_frame_stack
from sb3_cure.data.observations import by_key, image_spaces, rows_of
from sb3_cure.data.samples import Samples

#: Detached scalars of one update, by name
Metrics = dict[str, th.Tensor]

#: Prefixes of the metrics of each agent: SB3's names are the task's
PREFIXES = {"task": "", "curious": "curious_"}

#: Updates between two pictures of reconstructions
RECONSTRUCTION_INTERVAL = 1000


def means(updates: list[Metrics]) -> dict[str, float]:
    """Average metrics over updates; the only place where a GPU is waited for.

    :param updates: Metrics of each update
    :return: Means by name, over the updates that have the name
    """
    named = [item for metrics in updates for item in metrics.items()]
    values: dict[str, list[float]] = {}
    floats = th.stack([value.float() for _, value in named]).tolist() if named else []
    for (name, _), value in zip(named, floats, strict=True):
        values.setdefault(name, []).append(value)
    return {name: sum(each) / len(each) for name, each in values.items()}


def log_reconstructions(model: OffPolicyAlgorithm, batch: Samples, n_updates: int) -> None:
    """Log pictures after the first update and now and then, for loggers that keep them (TensorBoard).

    :param model: The model
    :param batch: The samples of the latest update
    :param n_updates: Updates since the last call
    """
    keeps = any(isinstance(output, TensorBoardOutputFormat) for output in model.logger.output_formats)
    if keeps and (model._n_updates - 1) % RECONSTRUCTION_INTERVAL < n_updates:
        strips = reconstruction_strips(model.policy, batch, infer_frame_stack(model.get_env()))  # type: ignore[arg-type]
        for key, strip in strips.items():
            name = f"srl/reconstructions_{key}" if key else "srl/reconstructions"
            model.logger.record(name, Image(strip, "CHW"), exclude=("stdout", "log", "json", "csv"))


@th.no_grad()
def reconstruction_strips(
    policy: CuRePolicy, batch: Samples, frame_stack: int, columns: int = 8
) -> dict[str, np.ndarray]:
    """Newest frames of a few observations above their reconstructions.

    :param policy: The policy
    :param batch: Samples
    :param frame_stack: Frames per observation
    :param columns: How many observations
    :return: For each image that is drawn, by its key (``""`` where observations are images), an image uint8
        (C, 2 * H, columns * W) with C = 1 or 3
    """
    if not image_spaces(policy.sensed_space):
        return {}
    pair = policy.reconstruct(rows_of(batch.observations, slice(columns))) or ({}, {})
    seen, drawn = map(by_key, pair)
    strips = {}
    for key in drawn:
        rows = [th.cat(list(newest_frames(images[key], frame_stack)), dim=2) for images in (seen, drawn)]
        strips[key] = th.cat(rows, dim=1).cpu().numpy()
    return strips


def reconstruction_strip(policy: CuRePolicy, batch: Samples, frame_stack: int, columns: int = 8) -> np.ndarray | None:
    """
    :param policy: The policy
    :param batch: Samples
    :param frame_stack: Frames per observation
    :param columns: How many observations
    :return: The (first) image of ``reconstruction_strips``, or None if there is none
    """
    return next(iter(reconstruction_strips(policy, batch, frame_stack, columns).values()), None)


def newest_frames(images: th.Tensor, frame_stack: int) -> th.Tensor:
    """
    :param images: Stacks of frames, oldest first, 0-255, [B, C, H, W]
    :param frame_stack: Frames per stack
    :return: The newest frame of each, grey or in colour, uint8 [B, C', H, W] with C' = 1 or 3
    """
    channels = images.shape[1] // frame_stack
    if channels not in (1, 3):
        channels = 1
    return images[:, -channels:].to(th.uint8)
