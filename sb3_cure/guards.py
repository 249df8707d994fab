"""What is not finite reaches no parameter, and its source is named: ``Guard`` stands before each optimiser's step."""

import contextlib
import copy
import inspect
import json
import math
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.sac.sac import SAC

from sb3_cure.buffers import transitions

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC

#: Gradients with a larger norm overflow float32 where Adam squares them
LARGEST_NORM = math.sqrt(np.finfo(np.float32).max)
#: How many of the latest batches have their indices remembered until the flag is read, where it is not read at once
BATCHES_REMEMBERED = 4096


class _WithPostMortem(ValueError):
    """An error of which more than a sentence may have been written down."""

    #: Where that is
    post_mortem = ""

    @property
    def _look(self) -> str:
        return f"look at {self.post_mortem}, then " if self.post_mortem else ""


class NonFiniteError(_WithPostMortem):
    """A loss or a gradient was not finite; the step was not taken. ``post_mortem`` says where more is written.

    :param source: What it was, say ``"task critic's loss"`` or ``"gradient of the SRL loss"``
    :param value: Its value
    :param update: Number of the update
    """

    def __init__(self, source: str, value: float, update: int):
        super().__init__(source, value, update)
        self.source = source
        self.value = value
        self.update = update

    def __str__(self) -> str:
        return (
            f"the {self.source} was {self.value:g} in update {self.update}, but losses and gradients (their squares, "
            f"too) must be finite: the parameters did not take it; {self._look}lower the learning rate, or fix the SRL "
            "head or the rewards."
        )


class Check(NamedTuple):
    """One look at a loss and its gradients.

    :param update: Number of the update
    :param order: Number of the check within the update
    :param loss: The loss
    :param norm: Norm of the gradients
    """

    update: float
    order: float
    loss: float
    norm: float

    @property
    def is_sound(self) -> bool:
        """Whether all of it may go into an optimiser."""
        return math.isfinite(self.loss) and self.norm <= LARGEST_NORM


class Draw(NamedTuple):
    """Where a batch came from.

    :param update: Number of the update
    :param timestep: Agent steps at that time
    :param rows: Rows of the replay buffer, [B], if they are known
    :param env_inds: Environment of each, [B], if they are known
    """

    update: int
    timestep: int
    rows: np.ndarray | None
    env_inds: np.ndarray | None


class Guard:
    """Looks at losses and gradients before they are stepped along.

    On a CPU it looks at once and raises before the step. Reading a value from a GPU would wait for it: there
    (``deferred``) a flag on the device turns the bad step and the rest of its update into nothing, later updates go on,
    and ``report``, called where values are read anyway, raises for the first source.

    :param deferred: Whether to look later
    """

    def __init__(self, deferred: bool = False):
        self.deferred = deferred
        self._update = 0
        self._order = 0
        # By name, the latest check; while deferred a tensor [4], kept since the first update that went bad
        self._checks: dict[str, Check | th.Tensor] = {}
        # While deferred, 1.0 on the device if something in this update, or in an earlier one, was bad
        self._bad: th.Tensor | None = None
        self._was_bad: th.Tensor | None = None
        self._draws: deque[Draw] = deque(maxlen=BATCHES_REMEMBERED)

    def check(
        self,
        name: str,
        loss: th.Tensor | None,
        optimizer: th.optim.Optimizer | None = None,
        gradients: Sequence[th.Tensor] = (),
    ) -> None:
        """
        :param name: What is looked at, with its article left out
        :param loss: Scalar; None: only its gradients are known
        :param optimizer: Whose parameters' gradients are looked at
        :param gradients: Further gradients
        :raises NonFiniteError: if something is not finite, unless that is to be found out later
        """
        found = list(gradients)
        if optimizer is not None:
            found += [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = th.linalg.vector_norm(th.stack(th._foreach_norm(found))) if found else None
        loss = None if loss is None else loss.detach()
        self._order += 1
        if self.deferred:
            self._check_later(name, loss, norm)
            return
        check = Check(
            self._update, self._order, 0.0 if loss is None else float(loss), 0.0 if norm is None else float(norm)
        )
        self._checks[name] = check
        if not check.is_sound:
            raise _error(name, check)

    def _check_later(self, name: str, loss: th.Tensor | None, norm: th.Tensor | None) -> None:
        device = next(value.device for value in (loss, norm) if value is not None)
        zero = th.zeros((), device=device)
        loss = zero if loss is None else loss.float().reshape(())
        norm = zero if norm is None else norm.float()
        bad = (~(loss.isfinite() & (norm <= LARGEST_NORM))).float()
        self._bad = bad if self._bad is None else th.maximum(self._bad, bad)
        now = th.stack([th.full_like(zero, self._update), th.full_like(zero, self._order), loss, norm])
        before = self._checks.get(name)
        if self._was_bad is not None and isinstance(before, th.Tensor):
            now = th.where(self._was_bad > 0, before, now)
        self._checks[name] = now

    def step(self, optimizer: th.optim.Optimizer) -> None:
        """
        :param optimizer: Makes its step, unless a check in this update has found something bad
        """
        if self._bad is None:
            optimizer.step()
        elif _is_fused_adam(optimizer):
            # What torch's GradScaler does: the kernel itself looks at the flag.
            optimizer.found_inf = self._bad  # type: ignore[attr-defined]
            try:
                optimizer.step()
            finally:
                del optimizer.found_inf  # type: ignore[attr-defined]
        elif not self._bad:
            # Other optimisers know no flag: the device is waited for.
            optimizer.step()

    def choose(self, value: th.Tensor, otherwise: th.Tensor) -> th.Tensor:
        """
        :param value: What the update brings
        :param otherwise: What there is instead if something in this update was bad
        :return: One of them
        """
        return value if self._bad is None else th.where(self._bad > 0, otherwise, value)

    def rate(self, rate: float) -> float | th.Tensor:
        """
        :param rate: Rate of a moving average
        :return: The same, or a tensor that is 0 if something in this update was bad
        """
        return rate if self._bad is None else rate * (1 - self._bad)

    @contextlib.contextmanager
    def update(self, model: "CuReSAC", batch: ReplayBufferSamples, random_state: dict[str, Any]) -> Iterator[None]:
        """Within this context an update is made, which is bad as a whole if something in it is.

        :param model: The model
        :param batch: Its samples
        :param random_state: NumPy's random state before they were drawn
        :raises NonFiniteError: with a post-mortem; running statistics are then what they were
        """
        self._start(model._n_updates)
        # What forward passes write: running statistics of the curious reward, of normalisation layers, of heads
        statistics = [(buffer, buffer.clone()) for buffer in model.policy.buffers() if buffer.is_floating_point()]
        if self.deferred:
            self._draws.append(_draw(model, len(batch.rewards), random_state))
        try:
            yield
        except NonFiniteError as error:
            for buffer, before in statistics:
                buffer.copy_(before)
            draw = _draw(model, len(batch.rewards), random_state)
            self._post_mortem(model, error, draw, batch, "as it was sampled")
            raise
        finally:  # also where it was interrupted: what pulled is no part of the next update
            model.policy.encoder_optimizer.discard()
        for buffer, before in statistics:
            if self._bad is not None:
                buffer.copy_(self.choose(buffer, before))

    def _start(self, update: int) -> None:
        if self._bad is not None:
            self._was_bad = self._bad if self._was_bad is None else th.maximum(self._was_bad, self._bad)
        self._bad = None
        self._update, self._order = update, 0
        if not self.deferred:
            self._checks = {}

    def report(self, model: "CuReSAC") -> None:
        """Read the flag, where values are read anyway.

        :param model: The model
        :raises NonFiniteError: with a post-mortem, for the first source since the last report, if there is one
        """
        if not self.deferred:
            return
        self._start(self._update)
        was_bad, self._was_bad = self._was_bad, None
        draws, self._draws = self._draws, deque(maxlen=BATCHES_REMEMBERED)
        if was_bad is None or not was_bad:
            return
        latest = {name: Check(*check.tolist()) for name, check in self._checks.items() if isinstance(check, th.Tensor)}
        name, first = min(((n, c) for n, c in latest.items() if not c.is_sound), key=lambda item: item[1][:2])
        self._checks = {name: check for name, check in latest.items() if check.update == first.update}
        error = _error(name, first)
        draw = next((draw for draw in draws if draw.update == error.update), None)
        draw = draw or Draw(error.update, model.num_timesteps, None, None)
        self._post_mortem(model, error, draw, *_batch_of(model, draw))
        self._checks = {}
        raise error

    def _post_mortem(
        self, model: "CuReSAC", error: NonFiniteError, draw: Draw, batch: ReplayBufferSamples | None, origin: str
    ) -> None:
        """Write down batch, losses and settings, and let the error say where."""
        losses = {
            name: {"loss": _plain(check.loss), "gradient_norm": _plain(check.norm)}
            for name, check in self._checks.items()
            if isinstance(check, Check)
        }
        report = {
            "source": error.source,
            "value": _plain(error.value),
            "update": error.update,
            "agent_steps": draw.timestep,
            "losses": losses,
            "rows": None if draw.rows is None else draw.rows.tolist(),
            "environments": None if draw.env_inds is None else draw.env_inds.tolist(),
            "batch": origin,
        }
        batch_arrays = {} if batch is None else batch._asdict()
        arrays = {name: value.cpu().numpy() for name, value in batch_arrays.items() if isinstance(value, th.Tensor)}
        error.post_mortem = _write_post_mortem(model, str(error.update), report, "batch.npz", arrays)


@contextlib.contextmanager
def looking_before_steps(model: "CuReSAC", optimizers: Mapping[str, th.optim.Optimizer | None]) -> Iterator[None]:
    """Within this context no optimiser steps along gradients that are not finite, whoever calls it.

    The value is read at once, which on a GPU waits for it. The post-mortem knows the gradients, and the batch if the
    replay buffer remembers it. (Not for good, as copies of an optimiser have no hooks.)

    :param model: The model
    :param optimizers: Optimisers by the name of what they train; None is left out
    """
    guard = Guard()

    def look(name: str, optimizer: th.optim.Optimizer, *_: Any) -> None:
        guard._start(model._n_updates)
        try:
            guard.check(f"{name} loss", None, optimizer)
        except NonFiniteError as error:
            rows, env_inds = getattr(model.replay_buffer, "last_sampled", None) or (None, None)
            draw = Draw(error.update, model.num_timesteps, rows, env_inds)
            guard._post_mortem(model, error, draw, *_batch_of(model, draw))
            raise

    with contextlib.ExitStack() as hooks:
        for name, optimizer in optimizers.items():
            if optimizer is not None:
                hooks.callback(optimizer.register_step_pre_hook(partial(look, name)).remove)
        yield


def _write_post_mortem(
    model: "CuReSAC", name: str, report: dict[str, Any], archive: str, arrays: dict[str, np.ndarray]
) -> str:
    """Beside the logs, or among temporary files; without pickle.

    :return: Where it lies
    """
    versions = {"sb3_cure": version("sb3_cure"), **get_system_info(print_info=False)[0]}
    logger = getattr(model, "_logger", None)  # a model that has not learned has none
    directory = None if logger is None or logger.dir is None or not Path(logger.dir).is_dir() else logger.dir
    try:
        folder = Path(tempfile.mkdtemp(prefix=f"post_mortem_{name}_", dir=directory))
        report = {**report, "config": _settings(model), "versions": versions}
        (folder / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False))
        if arrays:
            np.savez_compressed(folder / archive, **arrays)  # type: ignore[arg-type]
    except OSError as failure:
        return f"the logs (a post-mortem could not be written: {failure})"
    return str(folder)


def _error(name: str, check: Check) -> NonFiniteError:
    if math.isfinite(check.loss):
        return NonFiniteError(f"gradient of the {name}", check.norm, int(check.update))
    return NonFiniteError(name, check.loss, int(check.update))


def _is_fused_adam(optimizer: th.optim.Optimizer) -> bool:
    return type(optimizer) in (th.optim.Adam, th.optim.AdamW) and all(g.get("fused") for g in optimizer.param_groups)


def _draw(model: "CuReSAC", batch_size: int, random_state: dict[str, Any]) -> Draw:
    """Rows and environments of the batch that was just sampled."""
    buffer: ReplayBuffer = model.replay_buffer  # type: ignore[assignment]
    drawn = getattr(buffer, "last_sampled", None)
    if drawn is None:
        # SB3's buffers do not remember: draw again, but stop at the rows. The environments are drawn next.
        now = np.random.get_state()
        np.random.set_state(random_state)
        try:
            again = copy.copy(buffer)
            again._get_samples = lambda rows, env=None: rows  # type: ignore[method-assign, assignment, return-value, misc]
            rows: Any = again.sample(batch_size)
            if isinstance(rows, np.ndarray):
                drawn = rows, np.random.randint(0, high=buffer.n_envs, size=(len(rows),))
        finally:
            np.random.set_state(now)
    rows, env_inds = drawn or (None, None)
    return Draw(model._n_updates, model.num_timesteps, rows, env_inds)


def _batch_of(model: "CuReSAC", draw: Draw) -> tuple[ReplayBufferSamples | None, str]:
    """The batch, as the replay buffer has it now, and where it comes from."""
    if draw.rows is not None and draw.env_inds is not None:
        with contextlib.suppress(IndexError):
            batch = transitions(model.replay_buffer, draw.rows, draw.env_inds, model._vec_normalize_env)  # type: ignore[arg-type]
            return batch, "read again from the replay buffer; transitions may have been replaced since the update"
    return None, "not known"


def _settings(model: "CuReSAC") -> dict[str, Any]:
    """Arguments of the constructor: plain ones as they are, others as they print."""
    names = [*inspect.signature(type(model).__init__).parameters, *inspect.signature(SAC.__init__).parameters]
    found = {name: getattr(model, name) for name in names if name != "env" and hasattr(model, name)}
    found["policy"] = f"{model.policy_class.__module__}.{model.policy_class.__qualname__}"
    return {name: _plain(value) for name, value in found.items()}


def _plain(value: Any) -> Any:
    """What strict JSON can hold."""
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    return repr(value)
