"""CuReTQC: CuRe on sb3-contrib's TQC."""

from typing import ClassVar

from sb3_contrib.tqc import policies as tqc_policies
from sb3_contrib.tqc.tqc import TQC
from stable_baselines3.common.policies import BasePolicy

from sb3_cure import policies
from sb3_cure.critics import TruncatedQuantiles
from sb3_cure.cure import CuRe
from sb3_cure.persistence import Persistence
from sb3_cure.pretraining import Pretraining
from sb3_cure.vec_env.model import ModelEnvironments


class CnnPolicy(policies.CnnPolicy):
    """``CuRePolicy`` for images with critics of quantiles: ``policy_kwargs=dict(n_quantiles=25, n_critics=2)``."""

    critics = TruncatedQuantiles


class MlpPolicy(policies.MlpPolicy):
    """``CuRePolicy`` for vectors with critics of quantiles."""

    critics = TruncatedQuantiles


class MultiInputPolicy(policies.MultiInputPolicy):
    """``CuRePolicy`` for dictionaries with critics of quantiles."""

    critics = TruncatedQuantiles


class CuReTQC(Pretraining, Persistence, ModelEnvironments, CuRe, TQC):  # type: ignore[misc]
    """Truncated quantile critics from pixels, with state representation learning and a curious policy.

    All arguments are described at ``CuRe``; ``top_quantiles_to_drop_per_net`` is TQC's.
    """

    critics = TruncatedQuantiles
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        MlpPolicy: tqc_policies.MlpPolicy,
        CnnPolicy: tqc_policies.CnnPolicy,
        MultiInputPolicy: tqc_policies.MultiInputPolicy,
    }
