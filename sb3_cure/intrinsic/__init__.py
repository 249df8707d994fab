"""Intrinsic rewards, by name.

``IntrinsicReward`` is the contract; any subclass can be passed as ``intrinsic=``.
"""

from sb3_cure.intrinsic.base import IntrinsicReward, OwnGenerator, RewardInputs, RewardScale
from sb3_cure.intrinsic.dict_reward import DictReward, make_reward
from sb3_cure.intrinsic.registry import INTRINSIC_REWARDS, get_intrinsic_class
from sb3_cure.intrinsic.shuffled import Shuffled

INTRINSIC_REWARDS["shuffled"] = Shuffled  # wraps any of the others, by their names

__all__ = [
    "INTRINSIC_REWARDS",
    "DictReward",
    "IntrinsicReward",
    "OwnGenerator",
    "RewardInputs",
    "RewardScale",
    "Shuffled",
    "get_intrinsic_class",
    "make_reward",
]
