"""What is not finite reaches no parameter, and its source is named: the look before every step of an optimiser."""

import contextlib
import json
import math
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

#: Gradients with a larger norm overflow float32 where Adam squares them
LARGEST_NORM = math.sqrt(np.finfo(np.float32).max)


class NonFiniteError(ValueError):
    """A loss or a gradient was not finite; the step was not taken.

    :param source: What it was, say ``"task critic"``
    :param loss: Value of the loss
    :param norm: Norm of its gradient
    :param update: Number of the update
    """

    def __init__(self, source: str, loss: float, norm: float, update: int):
        super().__init__(source, loss, norm, update)
        self.source = source
        self.loss = loss
        self.norm = norm
        self.update = update
        #: Folder with the batch and the values, or ""
        self.crash_report = ""

    def __str__(self) -> str:
        look = f" The batch lies in {self.crash_report}." if self.crash_report else ""
        return (
            f"the {self.source} loss was {self.loss:g} with a gradient of norm {self.norm:g} in update {self.update}: "
            "the parameters did not take it. Lower the learning rate, or look at the rewards and the SRL head." + look
        )


class Guard:
    """Looks at losses and gradients before they are stepped along.

    On a CPU it raises before the step. Reading a value from a GPU would wait for it: there (``deferred``) a flag on the
    device turns the bad step and the rest of its update into nothing, and ``report`` raises where values are read
    anyway.

    :param deferred: Whether to look later
    """

    def __init__(self, deferred: bool = False):
        self.deferred = deferred
        self._update = 0
        #: While deferred, 1 on the device if something in this update was bad
        self._bad: th.Tensor | None = None
        # Loss, norm and update where a loss was bad first (update < 0: never), by name, in the order of an update
        self._first: dict[str, th.Tensor] = {}

    def begin(self, update: int) -> None:
        """
        :param update: Number of the update that begins
        """
        self._update = update
        self._bad = None

    def step(
        self, name: str, loss: th.Tensor, optimizer: th.optim.Optimizer | None, tensors: Iterable[th.Tensor]
    ) -> None:
        """Step, unless the loss or a gradient is not finite.

        :param name: Name of the loss
        :param loss: Scalar, of which the gradients have been computed
        :param optimizer: Makes the step; None: there is none to make
        :param tensors: What the loss has gradients of
        :raises NonFiniteError: if something is not finite, unless that is found out later
        """
        gradients = [tensor.grad for tensor in tensors if tensor.grad is not None]
        loss = loss.detach().float()
        norm = th.stack(th._foreach_norm(gradients)).norm() if gradients else th.zeros_like(loss)
        if self.deferred:
            self._look_later(name, loss, norm)
        elif not (math.isfinite(loss) and norm <= LARGEST_NORM):
            raise NonFiniteError(name, float(loss), float(norm), self._update)
        if optimizer is None:
            return
        if self._bad is None:
            optimizer.step()
        elif all(group.get("fused") for group in optimizer.param_groups):
            # What torch's GradScaler does: the kernel itself looks at the flag.
            optimizer.found_inf = self._bad  # type: ignore[attr-defined]
            try:
                optimizer.step()
            finally:
                del optimizer.found_inf  # type: ignore[attr-defined]
        elif not self._bad:  # other optimisers know no flag: the device is waited for
            optimizer.step()

    def _look_later(self, name: str, loss: th.Tensor, norm: th.Tensor) -> None:
        bad = ~(loss.isfinite() & (norm <= LARGEST_NORM))
        now = th.stack([loss, norm, th.full_like(loss, self._update)])
        first = self._first.get(name, th.full_like(now, -1))
        self._first[name] = th.where(bad & (first[2] < 0), now, first)
        self._bad = bad.float() if self._bad is None else th.maximum(self._bad, bad.float())

    def rate(self, rate: float) -> float | th.Tensor:
        """
        :param rate: Rate of a moving average
        :return: The same, or a tensor that is 0 if something in this update was bad
        """
        return rate if self._bad is None else rate * (1 - self._bad)

    def report(self) -> None:
        """Read what was found while deferred.

        :raises NonFiniteError: for the first loss that was not finite
        """
        found = {name: first.tolist() for name, first in self._first.items()}
        self._first = {}
        bad = [(update, name, loss, norm) for name, (loss, norm, update) in found.items() if update >= 0]
        if bad:
            update, name, loss, norm = min(bad, key=lambda each: each[0])
            raise NonFiniteError(name, loss, norm, int(update))


@contextlib.contextmanager
def crash_report(model: OffPolicyAlgorithm, batch: Any) -> Iterator[None]:
    """Write the batch of a ``NonFiniteError`` beside the logs, or among temporary files, and let the error say where.

    :param model: The model
    :param batch: Samples that it learns from within this context
    :raises NonFiniteError: the one that was raised within
    """
    try:
        yield
    except NonFiniteError as error:
        folder = model.logger.dir if model.logger.dir and Path(model.logger.dir).is_dir() else None
        path = Path(tempfile.mkdtemp(prefix=f"crash_report_{error.update}_", dir=folder))
        rows, envs = getattr(model.replay_buffer, "last_sampled", None) or ([], [])
        about = {
            "source": error.source,
            "loss": error.loss,
            "gradient_norm": error.norm,
            "update": error.update,
            "agent_steps": model.num_timesteps,
            "rows": list(map(int, rows)),
            "environments": list(map(int, envs)),
        }
        (path / "report.json").write_text(json.dumps(about, indent=2))
        parts: dict[str, Any] = {}
        for name, value in batch._asdict().items():
            by_key = value if isinstance(value, dict) else {"": value}
            parts |= {f"{name}.{key}" if key else name: part for key, part in by_key.items()}
        arrays = {name: value.cpu().numpy() for name, value in parts.items() if isinstance(value, th.Tensor)}
        np.savez_compressed(path / "batch.npz", **arrays)  # type: ignore[arg-type]
        error.crash_report = str(path)
        raise
