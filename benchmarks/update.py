"""Time of one update: ours by mode, precision and head, beside plain SAC-AE and SB3's SAC on the same batches."""

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import torch as th
from stable_baselines3 import SAC

from benchmarks.harness import BATCH_SIZE, PRECISIONS, interleaved, make_model, median_ratio, summary
from benchmarks.sac_ae import PlainSacAe

#: Of the paper, which rewards the curious agent for the head's own error
METHODS: dict[str, dict[str, Any]] = {head: dict(srl=head, intrinsic="srl_error") for head in ("rae", "curl")}
YARDSTICK, SB3_SAC = "plain SAC-AE, fp32", "SB3 SAC (NatureCNN, 1024)"


def _train_call(model: Any) -> Callable[[], object]:
    return lambda: model.train(gradient_steps=1, batch_size=BATCH_SIZE)


def _yardstick_call() -> Callable[[], object]:
    buffer = make_model().replay_buffer
    agent = PlainSacAe(actions=1, device=buffer.device)
    return lambda: agent.update(buffer.sample(BATCH_SIZE))


def measure(repeats: int = 7, precisions: tuple[str, ...] = PRECISIONS) -> dict[str, Any]:
    """Time updates by mode, precision and head.

    :param repeats: Rounds
    :param precisions: Number formats to measure
    :return: Times by variant, and the ratios that matter
    """
    variants = {
        YARDSTICK: _yardstick_call(),
        SB3_SAC: _train_call(make_model(SAC, policy_kwargs=dict(net_arch=[1024, 1024]))),
    }
    default = "joint"
    arms: list[tuple[str, str, str, str | None]] = [
        (head, mode, precision, "separate")
        for head in METHODS
        for mode in ("joint", "sequential")
        for precision in precisions
    ]
    arms += [("rae", default, precision, None) for precision in precisions]
    for head, mode, precision, curiosity in arms:
        model = make_model(**METHODS[head], update=mode, precision=precision, curiosity=curiosity, warmup_updates=0)
        variants[_name(head, mode, precision, curiosity)] = _train_call(model)
    times = interleaved(variants, repeats)
    ratios = {}
    for precision in precisions:
        ours = _name("rae", default, precision, "separate")
        ratios[f"plain SAC-AE fp32 / CuRe-RAE {precision}"] = median_ratio(times, YARDSTICK, ours)
        ratios[f"SB3 SAC / CuRe-RAE {precision}"] = median_ratio(times, SB3_SAC, ours)
        without = _name("rae", default, precision, None)
        ratios[f"curiosity on / off, {precision}"] = median_ratio(times, ours, without)
    return {
        "default_mode": default,
        "times": {name: summary(values) for name, values in times.items()},
        "ratios": {name: round(value, 2) for name, value in ratios.items()},
    }


def _name(head: str, mode: str, precision: str, curiosity: str | None) -> str:
    return f"CuRe-{head.upper()}, {mode}, {precision}" + ("" if curiosity else ", no curiosity")


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
