"""Intrinsic rewards, by name.

``IntrinsicReward`` is the contract; any subclass can be passed as ``intrinsic=``.
"""

from sb3_cure.intrinsic.base import IntrinsicReward, OwnGenerator, RewardScale
from sb3_cure.intrinsic.dict_reward import DictReward
from sb3_cure.intrinsic.registry import INTRINSIC_REWARDS, get_intrinsic_class
from sb3_cure.intrinsic.shuffled import Shuffled

INTRINSIC_REWARDS["shuffled"] = Shuffled  # which is made of the others

__all__ = [
    "INTRINSIC_REWARDS",
    "DictReward",
    "IntrinsicReward",
    "OwnGenerator",
    "RewardScale",
    "Shuffled",
    "get_intrinsic_class",
]
