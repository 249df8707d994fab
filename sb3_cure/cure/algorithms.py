"""The algorithms that users name: CuRe on SB3's SAC and on sb3-contrib's TQC."""

from typing import ClassVar

from sb3_contrib.tqc import policies as tqc_policies
from sb3_contrib.tqc.tqc import TQC
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.sac.sac import SAC

from sb3_cure.cure import policies
from sb3_cure.cure.critics import TruncatedQuantiles, TwinQ
from sb3_cure.cure.cure import CuRe
from sb3_cure.cure.pretraining import Pretraining
from sb3_cure.persistence import Persistence
from sb3_cure.vec_env.model_environments import ModelEnvironments


class CuReSAC(Pretraining, Persistence, ModelEnvironments, CuRe, SAC):  # type: ignore[misc]
    """Soft actor-critic from pixels, with state representation learning and a policy that seeks what it does badly.

    All arguments are described at ``CuRe``.
    """

    critics = TwinQ
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": policies.MlpPolicy,
        "CnnPolicy": policies.CnnPolicy,
        "MultiInputPolicy": policies.MultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        policies.MlpPolicy: sac_policies.MlpPolicy,
        policies.CnnPolicy: sac_policies.CnnPolicy,
        policies.MultiInputPolicy: sac_policies.MultiInputPolicy,
    }


class QuantileCnnPolicy(policies.CnnPolicy):
    """``CuRePolicy`` for images with critics of quantiles: ``policy_kwargs=dict(n_quantiles=25, n_critics=2)``."""

    critics = TruncatedQuantiles


class QuantileMlpPolicy(policies.MlpPolicy):
    """``CuRePolicy`` for vectors with critics of quantiles."""

    critics = TruncatedQuantiles


class QuantileMultiInputPolicy(policies.MultiInputPolicy):
    """``CuRePolicy`` for dictionaries with critics of quantiles."""

    critics = TruncatedQuantiles


class CuReTQC(Pretraining, Persistence, ModelEnvironments, CuRe, TQC):  # type: ignore[misc]
    """Truncated quantile critics from pixels, with state representation learning and a curious policy.

    All arguments are described at ``CuRe``; ``top_quantiles_to_drop_per_net`` is TQC's.
    """

    critics = TruncatedQuantiles
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": QuantileMlpPolicy,
        "CnnPolicy": QuantileCnnPolicy,
        "MultiInputPolicy": QuantileMultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        QuantileMlpPolicy: tqc_policies.MlpPolicy,
        QuantileCnnPolicy: tqc_policies.CnnPolicy,
        QuantileMultiInputPolicy: tqc_policies.MultiInputPolicy,
    }
