"""Training metrics: tensors while training, Python floats once, when the logger writes them."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.logger import Image, KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import infer_frame_stack
from sb3_cure.data.observations import by_key, image_spaces, rows_of
from sb3_cure.data.samples import Samples

#: Updates between two pictures of reconstructions
RECONSTRUCTION_INTERVAL = 1000


class Metrics(KVWriter):
    """Averages detached tensors between two dumps of SB3's logger.

    Reading a tensor's value waits for the device, so it is done only when there is something to write. The object is
    the logger's first output format: SB3 hands every format the same dictionary, in which it turns tensors to floats.
    """

    def __init__(self) -> None:
        #: The last value of each, which the logger forgets when it is written
        self.latest: dict[str, th.Tensor] = {}
        self._sums: dict[str, th.Tensor] = {}
        self._counts: dict[str, int] = {}
        self._logger: Logger | None = None

    def attach(self, logger: Logger) -> None:
        """
        :param logger: SB3's logger; a new one starts with empty averages, attaching twice changes nothing
        """
        self._logger = logger
        if self not in logger.output_formats:
            # In the place of another model's, which would write averages of its own under the same names.
            others = [output for output in logger.output_formats if not isinstance(output, Metrics)]
            logger.output_formats[:] = [self, *others]
            self._sums.clear()
            self._counts.clear()

    def record(self, values: dict[str, th.Tensor], agent: str = "task") -> None:
        """
        :param values: Scalars by name
        :param agent: Whose they are: SB3's names are the task agent's, the curious one's are marked
        """
        prefix = "train/" if agent == "task" else f"train/{agent}_"
        for name, value in values.items():
            key = prefix + name
            self.latest[key] = value = value.detach()
            self._sums[key] = self._sums[key] + value if key in self._sums else value
            self._counts[key] = self._counts.get(key, 0) + 1
            if self._logger is not None:
                self._logger.record(key, value)

    def log_reconstructions(self, model: OffPolicyAlgorithm, batch: Samples) -> None:
        """After the first update and now and then, for loggers that keep pictures (TensorBoard).

        :param model: The model
        :param batch: The samples that it has just learned from
        """
        keeps = any(isinstance(output, TensorBoardOutputFormat) for output in model.logger.output_formats)
        if keeps and model._n_updates % RECONSTRUCTION_INTERVAL == 1:
            strips = reconstruction_strips(model.policy, batch, infer_frame_stack(model.get_env()))  # type: ignore[arg-type]
            for key, strip in strips.items():
                name = f"srl/reconstructions_{key}" if key else "srl/reconstructions"
                model.logger.record(name, Image(strip, "CHW"), exclude=("stdout", "log", "json", "csv"))

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Called by the logger before the formats that write."""
        for key, value in key_values.items():
            if key in self._sums:
                key_values[key] = float(self._sums.pop(key)) / self._counts.pop(key)
            elif isinstance(value, th.Tensor) and value.numel() == 1:
                key_values[key] = float(value)

    def close(self) -> None:
        """Nothing is open."""

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What was recorded since the last dump
        """
        return {"sums": {key: value.cpu() for key, value in self._sums.items()}, "counts": dict(self._counts)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``state_dict``
        """
        self._sums, self._counts = dict(state["sums"]), dict(state["counts"])


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
