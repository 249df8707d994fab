"""In which number format the networks compute."""

import torch as th

PRECISIONS = ("auto", "fp32", "bf16")


def _has_fast_bf16(device: th.device) -> bool:
    if device.type == "cuda":
        return th.cuda.is_bf16_supported(including_emulation=False)
    # Without these instructions bf16 on a CPU is emulated and slower than fp32.
    supported = getattr(th.cpu, "_is_avx512_bf16_supported", None)
    return device.type == "cpu" and supported is not None and supported()


def resolve_precision(precision: str, device: th.device) -> str:
    """
    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``
    :param device: Device of the networks
    :return: ``"fp32"`` or ``"bf16"``; auto chooses bf16 where the device computes it natively
    :raises ValueError: if the name is unknown
    """
    if precision not in PRECISIONS:
        raise ValueError(
            f"precision is {precision!r}, but it must be one of {', '.join(map(repr, PRECISIONS))}: choose one of them."
        )
    if precision == "auto":
        return "bf16" if _has_fast_bf16(device) else "fp32"
    return precision


def autocast_context(precision: str, device: th.device) -> th.autocast:
    """
    :param precision: ``"fp32"`` or ``"bf16"``
    :param device: Device of the networks
    :return: Context in which convolutions and linear maps use that format; weights stay fp32
    """
    return th.autocast(device.type, th.bfloat16, enabled=precision == "bf16")
