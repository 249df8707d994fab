"""Time of an update, phase by phase."""

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import torch as th

from benchmarks.harness import BATCH_SIZE, make_model

#: Of the paper, which rewards the curious agent for the head's own error
METHODS: dict[str, dict[str, Any]] = {head: dict(srl=head, intrinsic="srl_error") for head in ("rae", "curl")}


class PhaseTimer:
    """Seconds that each method takes itself, without the other timed methods that it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def wrap(self, owner: Any, method: str, phase: str) -> None:
        """Time a method.

        :param owner: Object whose method is timed from now on
        :param method: Name of the method
        :param phase: Name under which its time is counted
        """
        function = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.phase(phase):
                return function(*args, **kwargs)

        setattr(owner, method, timed)

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time a phase.

        :param name: What happens within
        """
        self._inner.append(0.0)
        start = time.perf_counter()
        yield
        if th.cuda.is_available():
            th.cuda.synchronize()
        elapsed = time.perf_counter() - start
        self.seconds[name] += elapsed - self._inner.pop()
        if self._inner:
            self._inner[-1] += elapsed


def breakdown(updates: int = 20, **kwargs: Any) -> dict[str, float]:
    """Time the phases of an update.

    :param updates: Updates to average over
    :param kwargs: For ``CuReSAC``
    :return: Milliseconds per update by phase
    """
    model = make_model(warmup_updates=0, **kwargs)
    model.train(4, BATCH_SIZE)
    timer = PhaseTimer()
    timer.wrap(model, "_sample_batch", "sample and augment")
    timer.wrap(model.policy.encoder_target, "forward", "target encoder")
    for method in ("latents", "features"):
        timer.wrap(model.policy.encoder_update, method, "encoder forward")
    for method in ("_srl_loss", "_update_srl"):
        timer.wrap(model, method, "SRL head")
    timer.wrap(model, "_update_actor_critic", "critics")
    timer.wrap(model, "_update_actor", "actors")
    timer.wrap(model.policy.encoder_update, "finish", "encoder backward and step")
    timer.wrap(model, "_update_targets", "Polyak")
    agents = model.policy.agents.values()
    for owner in (model.policy.srl, *(part for agent in agents for part in (agent.actor, agent.critic))):
        if owner is not None and owner.optimizer is not None:
            timer.wrap(owner.optimizer, "step", "Adam of heads and agents")
    with timer.phase("rest"):
        model.train(updates, BATCH_SIZE)
    return {name: round(1e3 * value / updates, 2) for name, value in timer.seconds.items()}


def breakdowns() -> dict[str, Any]:
    """Time the phases of an update for each head.

    :return: Result of ``breakdown`` by head, in the default mode
    """
    return {head: breakdown(**method) for head, method in METHODS.items()}
