"""Updates by setting: the paper's, and the small images and networks that people without a GPU train.

The floor of an update is the time of its matrix products and convolutions alone, each at its own shape and in the
fastest number format: no update of these layers can be faster with torch's kernels.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import torch as th
from stable_baselines3 import SAC
from torch.nn import functional as F

from benchmarks.harness import BATCH_SIZE, PRECISIONS, interleaved, make_model, median_ratio, summary
from benchmarks.sac_ae import FEATURES, PlainSacAe
from sb3_cure.networks.fast_ops import conv_transpose_cells, convolve
from sb3_cure.networks.layers import conv_sizes


class Setting(NamedTuple):
    """Images and networks.

    :param size: Height and width of the images, pixels
    :param grayscale: Whether they are grey
    :param filters: Channels of the convolutions
    :param hidden: Hidden units of actors and critics
    :param threads: Threads
    """

    size: int
    grayscale: bool
    filters: int
    hidden: int
    threads: int

    @property
    def channels(self) -> int:
        """Of stacks of three frames."""
        return 3 if self.grayscale else 9

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """For ``make_dmc_env``."""
        return {"image_size": self.size, "grayscale": self.grayscale}

    @property
    def policy_kwargs(self) -> dict[str, Any]:
        """For ``CuReSAC``."""
        return {"net_arch": [self.hidden] * 2, "features_extractor_kwargs": {"n_filters": self.filters}}

    def __str__(self) -> str:
        color, s = ("grey" if self.grayscale else "colour"), "s" if self.threads > 1 else ""
        return f"{self.size} px {color}, {self.filters} filters, hidden {self.hidden}, {self.threads} thread{s}"


SETTINGS = (
    Setting(36, True, 16, 256, 1),
    Setting(36, True, 16, 256, 2),
    Setting(48, False, 16, 256, 1),
    Setting(84, False, 32, 1024, 2),
)
#: Updates per round, as actors are updated in every second one
BLOCK = 10


def measure(repeats: int = 7, settings: tuple[Setting, ...] = SETTINGS) -> dict[str, Any]:
    """Time updates of ours and of plain SAC-AE in each setting.

    :param repeats: Rounds that count
    :param settings: What to measure
    :return: By setting: milliseconds per update, ratios, and the floor
    """
    threads = th.get_num_threads()
    try:
        return {str(setting): _measure(setting, repeats) for setting in settings}
    finally:
        th.set_num_threads(threads)


def _measure(setting: Setting, repeats: int) -> dict[str, Any]:
    th.set_num_threads(setting.threads)
    own: dict[str, Any] = dict(warmup_updates=0, policy_kwargs=setting.policy_kwargs)
    env = setting.env_kwargs
    curl: dict[str, Any] = dict(srl="curl", augmentation="shift")
    arms: dict[str, dict[str, Any]] = {
        "CuRe-RAE": {},
        "CuRe-RAE, fp32": dict(precision="fp32"),
        "CuRe-RAE, sequential": dict(update="sequential"),
        "CuRe-RAE, no curiosity": dict(curiosity=None),
        "CuRe-CURL": dict(intrinsic="srl_error", **curl),  # the paper's
        "CuRe-CURL, reconstruction": dict(intrinsic="reconstruction", **curl),
    }
    models = {name: make_model(env_kwargs=env, **own, **kwargs) for name, kwargs in arms.items()}
    models["SB3 SAC"] = make_model(SAC, env_kwargs=env, policy_kwargs=dict(net_arch=[setting.hidden] * 2))
    buffer = models["CuRe-RAE"].replay_buffer
    plain = PlainSacAe(setting.channels, hidden=setting.hidden, size=setting.size, filters=setting.filters)

    def plain_block() -> None:
        for _ in range(BLOCK):
            plain.update(buffer.sample(BATCH_SIZE))

    calls: dict[str, Callable[[], object]] = {"plain SAC-AE, fp32": plain_block}
    calls |= {name: _block(model) for name, model in models.items()}
    times = {name: [each / BLOCK for each in values] for name, values in interleaved(calls, repeats, 1).items()}
    floor = 1e3 * sum(_floor(setting))
    pairs = {
        "plain SAC-AE / CuRe-RAE": ("plain SAC-AE, fp32", "CuRe-RAE"),
        "plain SAC-AE / CuRe-RAE, fp32": ("plain SAC-AE, fp32", "CuRe-RAE, fp32"),
        "plain SAC-AE / CuRe-CURL": ("plain SAC-AE, fp32", "CuRe-CURL"),
        "SB3 SAC / CuRe-RAE": ("SB3 SAC", "CuRe-RAE"),
        "curiosity on / off": ("CuRe-RAE", "CuRe-RAE, no curiosity"),
    }
    ratios = {name: round(median_ratio(times, *pair), 2) for name, pair in pairs.items()}
    share = floor / (1e3 * statistics.median(times["CuRe-RAE"]))
    return {
        "times": {name: summary(values) for name, values in times.items()},
        "ratios": {**ratios, "floor_ms": round(floor, 2), "floor / CuRe-RAE": round(share, 2)},
    }


def added_costs(
    models: Mapping[str, Any], threads: int, beside: Callable[[str], str], repeats: int
) -> dict[str, dict[str, float]]:
    """Time that variants add to an update.

    :param models: Models by name
    :param threads: Threads, also of what follows in this process
    :param beside: Name of the model that another one's update is compared with
    :param repeats: Rounds that count
    :return: By name: milliseconds of an update, and how many more these are
    """
    th.set_num_threads(threads)
    times = interleaved({name: _block(model) for name, model in models.items()}, repeats, 1)
    median = {name: 1e3 * statistics.median(values) / BLOCK for name, values in times.items()}
    return {
        name: {"update_ms": round(each, 2), "added_ms": round(each - median[beside(name)], 2)}
        for name, each in median.items()
    }


def _block(model: Any) -> Callable[[], object]:
    return lambda: model.train(gradient_steps=BLOCK, batch_size=BATCH_SIZE)


def _floor(setting: Setting) -> Iterator[float]:
    """Seconds of each kind of product in an update of CuRe-RAE with curiosity, times how often it is needed."""
    sizes, filters, bias = conv_sizes(setting.size, setting.size, 4), setting.filters, th.zeros(setting.channels)
    for layer, ((before, _), (after, _)) in enumerate(pairwise(sizes)):
        channels, stride = (setting.channels, 2) if layer == 0 else (filters, 1)
        weight = (filters, channels, 3, 3)
        # Observations, next observations, and those through the target encoder; the first layer's inputs need no
        # gradient. The decoder runs the same shapes backwards.
        large, small = (channels, before, before), (filters, after, after)
        forward = _best(lambda x, w, g, s=stride: F.conv2d(x, w, None, s), large, weight, small)
        to_inputs = _best(lambda x, w, g, s=stride: _backward(g, x, w, s, True), large, weight, small)
        ours = (lambda x, w, g: conv_transpose_cells(g, w, bias.to(w.dtype))) if layer == 0 else _transposed
        to_inputs = min(to_inputs, _best(ours, large, weight, small))
        to_weights = _best(lambda x, w, g, s=stride: _backward(g, x, w, s, False), large, weight, small)
        yield 3 * forward + to_weights + (to_inputs if layer > 0 else 0)
        yield to_inputs + forward + to_weights
    trunk, hidden, agents, twins = filters * sizes[-1][0] ** 2, setting.hidden, 2, 2
    # Actors act on next observations, and in every second update on observations, with a backward pass (twice as much).
    actor, critic = 1 + 3 / 2, twins * (1 + 3 + 3 / 2)
    product = {shape: _product(*shape) for shape in ((trunk, FEATURES), (FEATURES, hidden), (hidden, hidden))}
    # Projections of the encoder, its target and of the actors; the decoder's linear map.
    yield product[trunk, FEATURES] * (3 + 1 + agents * actor + 3)
    yield agents * (actor + critic) * (product[FEATURES, hidden] + product[hidden, hidden])


def _backward(gradient: th.Tensor, inputs: th.Tensor, weight: th.Tensor, stride: int, to_inputs: bool) -> object:
    mask = [to_inputs, not to_inputs, False]
    return th.ops.aten.convolution_backward(
        gradient, inputs, weight, None, [stride] * 2, [0, 0], [1, 1], False, [0, 0], 1, mask
    )


def _transposed(inputs: th.Tensor, weight: th.Tensor, gradient: th.Tensor) -> th.Tensor:
    return convolve(gradient, weight, transposed=True)


def _product(inputs: int, outputs: int) -> float:
    return _best(lambda x, w, g: x @ w, (inputs,), (inputs, outputs), (outputs,))


def _best(
    call: Callable[..., object], inputs: tuple[int, ...], weight: tuple[int, ...], outputs: tuple[int, ...]
) -> float:
    """Least seconds of a call, of the number formats that the machine computes natively."""
    seconds = []
    for dtype in (th.float32, th.bfloat16) if "bf16" in PRECISIONS else (th.float32,):
        made = [th.randn(shape).to(dtype) for shape in ((BATCH_SIZE, *inputs), weight, (BATCH_SIZE, *outputs))]
        made = [each.contiguous(memory_format=th.channels_last) if each.dim() == 4 else each for each in made]
        for _ in range(20):
            start = time.perf_counter()
            call(*made)
            seconds.append(time.perf_counter() - start)
    return min(seconds)
