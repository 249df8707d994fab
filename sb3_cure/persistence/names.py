"""The classes that a file may name. Nothing else that a file names is looked up, and nothing is imported for it."""

from enum import Enum
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common import buffers as sb3_buffers
from stable_baselines3.common import torch_layers
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer
from torch.nn.modules import activation

from sb3_cure import encoders
from sb3_cure.buffers import FrameStackReplayBuffer, SkippingReplayBuffer
from sb3_cure.srl import SRL_HEADS

#: Replay buffers that are written without pickle
BUFFERS: tuple[type[sb3_buffers.ReplayBuffer], ...] = (
    FrameStackReplayBuffer,
    SkippingReplayBuffer,
    sb3_buffers.ReplayBuffer,
    sb3_buffers.DictReplayBuffer,
    sb3_buffers.NStepReplayBuffer,
)
#: Types of the numbers in arrays
NUMBERS: tuple[type[np.generic], ...] = (
    *(np.bool_, np.float16, np.float32, np.float64, np.complex64),
    *(np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64),
)


def _of_module(module: Any, base: type) -> list[type]:
    return [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, base)]


def name_of(value: Any) -> str:
    """
    :param value: A class, or a member of an enumeration
    :return: What files call it
    """
    if value in NUMBERS:
        return f"numpy.{np.dtype(value).name}"  # `bool` or `bool_`, by NumPy's version
    return str(value) if isinstance(value, Enum) else f"{value.__module__}.{value.__qualname__}"


#: Classes and members of enumerations by their names
NAMED: dict[str, Any] = {
    name_of(value): value
    for value in (
        *BUFFERS,
        *NUMBERS,
        HerReplayBuffer,
        encoders.PixelEncoder,
        encoders.VectorEncoder,
        torch_layers.FlattenExtractor,
        torch_layers.NatureCNN,
        torch_layers.CombinedExtractor,
        RMSpropTFLike,
        *SRL_HEADS.values(),
        *_of_module(activation, th.nn.Module),
        *_of_module(th.optim, th.optim.Optimizer),
        *GoalSelectionStrategy,
        *TrainFrequencyUnit,
    )
}


def named_by(model_class: type) -> dict[str, Any]:
    """
    :param model_class: An algorithm
    :return: What its archives may name: ``NAMED``, and the policies that it and its base classes register
    """
    registered = [vars(base).get("policy_aliases", {}).values() for base in model_class.__mro__]
    policies = {base for policies in registered for policy in policies for base in policy.__mro__}
    return NAMED | {name_of(policy): policy for policy in policies if issubclass(policy, BasePolicy)}
