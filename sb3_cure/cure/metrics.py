"""Training metrics, kept as tensors until ``train`` ends and then averaged, and pictures of reconstructions."""

import torch as th
from stable_baselines3.common.logger import Image, TensorBoardOutputFormat
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.cure.reconstructions import reconstruction_strips
from sb3_cure.data.samples import Samples

#: Detached scalars of one update, by name
Metrics = dict[str, th.Tensor]

#: Prefixes of the metrics of each agent: SB3's names are the task's
PREFIXES = {"task": "", "curious": "curious_"}

#: Updates between two pictures of reconstructions
RECONSTRUCTION_INTERVAL = 1000


def means(updates: list[Metrics]) -> dict[str, float]:
    """Average metrics over updates: one transfer from a GPU for all of them.

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
    """Log pictures after the first update and then every ``RECONSTRUCTION_INTERVAL``, if a logger keeps them.

    :param model: The model
    :param batch: The samples of the latest update
    :param n_updates: Updates since the last call
    """
    keeps = any(isinstance(output, TensorBoardOutputFormat) for output in model.logger.output_formats)
    if keeps and (model._n_updates - 1) % RECONSTRUCTION_INTERVAL < n_updates:
        # The environments cannot be asked for the frame stack: overlapped updates run while they step.
        strips = reconstruction_strips(model.policy, batch, model._frame_stack)  # type: ignore[arg-type, attr-defined]
        for key, strip in strips.items():
            name = f"srl/reconstructions_{key}" if key else "srl/reconstructions"
            model.logger.record(name, Image(strip, "CHW"), exclude=("stdout", "log", "json", "csv"))
