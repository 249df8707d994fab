"""Check losses and gradients for NaN and inf, and write a report of the batch in which one was found."""

import contextlib
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.observations import by_key

#: Gradients with a larger norm overflow float32 where Adam squares them
LARGEST_NORM = math.sqrt(np.finfo(np.float32).max)


class NonFiniteError(ValueError):
    """A loss or a gradient was not finite.

    :param source: Name of the step, e.g. ``"task critic"``
    :param loss: Value of the loss; 0 for the encoder, whose step follows several losses
    :param norm: Norm of its gradient
    :param update: Number of the update
    """

    def __init__(self, source: str, loss: float, norm: float, update: int):
        super().__init__(source, loss, norm, update)
        self.source, self.loss, self.norm, self.update = source, loss, norm, update
        #: Folder with the batch and the values, or ""
        self.crash_report = ""

    def __str__(self) -> str:
        report = f" The batch is in {self.crash_report}." if self.crash_report else ""
        return (
            f"the {self.source} loss was {self.loss:g} with a gradient of norm {self.norm:g} in update {self.update}. "
            "Lower the learning rate, or check the rewards and the SRL head." + report
        )


class FiniteGuard:
    """Checks the loss and the gradient of each step.

    On a CPU it raises before the step. On a GPU each reading would synchronise: there the values are kept, and read
    once, in ``report``. Parameters may have taken the bad step by then, so that the model must not be saved.

    :param deferred: Whether to read the values later
    """

    def __init__(self, deferred: bool = False):
        self.deferred = deferred
        self.update = 0
        self._seen: list[tuple[str, int, th.Tensor]] = []
        self._found: NonFiniteError | None = None

    def check(self, name: str, gradients: list[th.Tensor], loss: th.Tensor | None = None) -> None:
        """Check one step.

        :param name: Name of the step
        :param gradients: Gradients that the step follows
        :param loss: Scalar
        :raises NonFiniteError: if something is not finite, unless the check is deferred
        """
        value = th.zeros(()) if loss is None else loss.detach().float()
        norm = th.stack(th._foreach_norm(gradients)).norm().float() if gradients else th.zeros_like(value)
        if self.deferred:
            self._seen.append((name, self.update, th.stack([value.to(norm.device), norm])))
        elif not (math.isfinite(value) and norm <= LARGEST_NORM):
            raise NonFiniteError(name, float(value), float(norm), self.update)

    def report(self) -> None:
        """Read what was kept.

        :raises NonFiniteError: for the first step that was not finite, now and in every later call
        """
        seen, self._seen = self._seen, []
        values = th.stack([pair for _, _, pair in seen]).tolist() if seen else []
        for (name, update, _), (loss, norm) in zip(seen, values, strict=True):
            if self._found is None and not (math.isfinite(loss) and norm <= LARGEST_NORM):
                self._found = NonFiniteError(name, loss, norm, update)
        if self._found is not None:
            raise self._found


@contextlib.contextmanager
def crash_report(model: OffPolicyAlgorithm, batch: Any) -> Iterator[None]:
    """On a ``NonFiniteError``, write the batch into a folder, and name that folder in the error.

    The folder lies next to the logs or, without logs, among temporary files.

    :param model: The model
    :param batch: Samples that it learns from within this context
    :raises NonFiniteError: the error that was raised within this context
    """
    try:
        yield
    except NonFiniteError as error:
        folder = model.logger.dir if model.logger.dir and Path(model.logger.dir).is_dir() else None
        path = Path(tempfile.mkdtemp(prefix=f"crash_report_{error.update}_", dir=folder))
        rows, envs = getattr(model.replay_buffer, "last_sampled", None) or ([], [])
        report = {
            "source": error.source,
            "loss": error.loss,
            "gradient_norm": error.norm,
            "update": error.update,
            "agent_steps": model.num_timesteps,
            "rows": list(map(int, rows)),
            "environments": list(map(int, envs)),
        }
        (path / "report.json").write_text(json.dumps(report, indent=2))
        parts = {f"{name}.{key}" if key else name: part for name, value in batch._asdict().items()
                 for key, part in by_key(value).items()}  # fmt: skip
        arrays = {name: value.cpu().numpy() for name, value in parts.items() if isinstance(value, th.Tensor)}
        np.savez_compressed(path / "batch.npz", **arrays)  # type: ignore[arg-type]
        error.crash_report = str(path)
        raise
