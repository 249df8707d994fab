"""Number formats of the networks: which one to use, and how to switch to it."""

import contextlib
from collections.abc import Iterator

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cure.data.observations import image_spaces
from sb3_cure.networks.encoders import ExtractorTrunk
from sb3_cure.networks.layers import MixedPrecision


def has_fast_bf16(device: th.device) -> bool:
    """Check whether a device computes bf16 natively.

    :param device: Device of the networks
    :return: True for GPUs and CPUs with bf16 instructions
    """
    if device.type == "cuda":
        with th.cuda.device(device):
            return th.cuda.is_bf16_supported(including_emulation=False)
    # Without these instructions bf16 on a CPU is emulated and slower than fp32.
    supported = getattr(th.cpu, "_is_avx512_bf16_supported", None)
    return device.type == "cpu" and supported is not None and supported()


def resolve_precision(precision: str, device: th.device, observation_space: spaces.Space) -> str:
    """Replace ``"auto"`` by bf16 for images on devices that compute it natively, else by fp32.

    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``
    :param device: Device of the networks
    :param observation_space: Observation space
    :return: ``"fp32"`` or ``"bf16"``
    """
    if precision == "auto":
        return "bf16" if image_spaces(observation_space) and has_fast_bf16(device) else "fp32"
    return precision


@contextlib.contextmanager
def compute_in(module: nn.Module, precision: str) -> Iterator[None]:
    """Within this context every ``MixedPrecision`` part of a module computes in the given format.

    Outside of it, when acting, measuring and exporting, networks compute in fp32.

    :param module: Usually the whole policy
    :param precision: ``"fp32"`` or ``"bf16"``
    """
    # All parts compute in fp32 by default: then there is nothing to switch.
    parts = list(_mixed_parts(module)) if precision == "bf16" else []
    before = [part.compute_dtype for part in parts]
    for part in parts:
        part.compute_dtype = th.bfloat16
    try:
        yield
    finally:
        for part, dtype in zip(parts, before, strict=True):
            part.compute_dtype = dtype


def _mixed_parts(module: nn.Module) -> Iterator[MixedPrecision]:
    if isinstance(module, MixedPrecision):
        yield module
    # Features extractors of users are left in fp32, whatever they consist of.
    if not isinstance(module, ExtractorTrunk):
        for child in module.children():
            yield from _mixed_parts(child)
