"""How the networks compute: in which number format, and whether through torch.compile."""

import functools
import time
import warnings
from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn
from torch._functorch import config as functorch_config

from sb3_cure.data.observations import image_spaces

#: Why ``compile="auto"`` is eager
NOT_COMPILED = "compiled updates were slower on the CPU they were measured on, and not measured on a GPU yet"


def has_fast_bf16(device: th.device) -> bool:
    """
    :param device: Device of the networks
    :return: Whether it computes bf16 natively
    """
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    # Without these instructions bf16 on a CPU is emulated and slower than fp32.
    supported = getattr(th.cpu, "_is_avx512_bf16_supported", None)
    return device.type == "cpu" and supported is not None and supported()


def resolve_precision(precision: str, device: th.device, observation_space: spaces.Space) -> str:
    """
    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``
    :param device: Device of the networks
    :param observation_space: Observation space
    :return: ``"fp32"`` or ``"bf16"``; auto chooses bf16 for images, where the device computes it natively
    """
    if precision == "auto":
        return "bf16" if image_spaces(observation_space) and has_fast_bf16(device) else "fp32"
    return precision


@functools.cache
def _why_not_compiled(device_type: str) -> str | None:
    """What keeps torch.compile from working here, or None. Only trying tells: it needs a C++ compiler, for GPUs Triton,
    headers, a Python that it knows."""
    # A number that makes the function new: results of a compiler that is gone may lie in the cache on disk.
    now = time.time()
    try:
        th.compile(lambda x: x.sin() * now)(th.zeros(8, device=device_type))
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return None


def resolve_compile(compile: str | bool, device: th.device) -> tuple[bool, str]:
    """
    :param compile: ``"auto"``, True or False
    :param device: Device of the networks
    :return: Whether updates run the networks through torch.compile, and a sentence that says so; with True, but where
        torch.compile does not work, they do not, and a warning says why
    """
    if compile == "auto":
        return False, f"Networks run eagerly (compile='auto': {NOT_COMPILED})"
    if not compile:
        return False, "Networks run eagerly (compile=False)"
    failure = _why_not_compiled(device.type)
    if failure is not None:
        sentence = f"Networks run eagerly: compile=True, but torch.compile does not work here ({failure})"
        warnings.warn(f"{sentence}; install what is missing, or leave compile='auto'.", stacklevel=2)
        return False, sentence
    return True, "Networks are compiled in the first updates (compile=True)"


def compile_while_training(module: nn.Module, owner: nn.Module) -> None:
    """Run a module through torch.compile, in place, whenever its owner is in training mode.

    Otherwise it stays eager: acting and measuring see batches of many sizes, each of which would be compiled anew.
    Names and values of the parameters stay what they are; copies and pickles of the module are eager.

    :param module: The module, called as ``module(...)``
    :param owner: Whose ``training`` is asked
    """

    def call(*args: Any, **kwargs: Any) -> Any:
        return module._call_impl(*args, **kwargs)

    # Graphs are gone through once for each source to measure its share of the encoder's gradient (EncoderUpdate).
    functorch_config.donated_buffer = False
    # A function of ours, as torch.compile passes over frames of torch.nn itself, such as that of nn.Sequential; with a
    # code object of its own, by which compiled graphs are kept and counted.
    call.__code__ = call.__code__.replace()
    compiled = th.compile(call)

    def dispatch(*args: Any, **kwargs: Any) -> Any:
        return (compiled if owner.training else module._call_impl)(*args, **kwargs)

    # Where nn.Module.compile keeps its result, too.
    module._compiled_call_impl = dispatch
