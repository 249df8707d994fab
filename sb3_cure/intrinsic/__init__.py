"""Intrinsic rewards, by name.

``IntrinsicReward`` is the contract; any subclass can be passed as ``intrinsic=``.
"""

from sb3_cure.intrinsic.base import IntrinsicReward, RewardScale
from sb3_cure.intrinsic.dictionary import DictReward
from sb3_cure.intrinsic.reconstruction import Reconstruction
from sb3_cure.intrinsic.srl_error import SRLError

INTRINSIC_REWARDS: dict[str, type[IntrinsicReward]] = {"srl_error": SRLError, "reconstruction": Reconstruction}


def get_intrinsic_class(intrinsic: str | type[IntrinsicReward]) -> type[IntrinsicReward]:
    """
    :param intrinsic: Name of a built-in reward, or a subclass of ``IntrinsicReward``
    :return: The class
    :raises ValueError: if it is neither
    """
    if isinstance(intrinsic, str) and intrinsic in INTRINSIC_REWARDS:
        return INTRINSIC_REWARDS[intrinsic]
    if isinstance(intrinsic, type) and issubclass(intrinsic, IntrinsicReward):
        return intrinsic
    names = ", ".join(map(repr, INTRINSIC_REWARDS))
    raise ValueError(f"intrinsic is {intrinsic!r}: choose one of {names}, or a subclass of IntrinsicReward.")


__all__ = [
    "INTRINSIC_REWARDS",
    "DictReward",
    "IntrinsicReward",
    "Reconstruction",
    "RewardScale",
    "SRLError",
    "get_intrinsic_class",
]
