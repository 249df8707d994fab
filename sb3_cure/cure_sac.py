"""CuReSAC: CuRe on SB3's SAC."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.sac import policies as sac_policies
from stable_baselines3.sac.sac import SAC

from sb3_cure.critics import TwinQ
from sb3_cure.cure import CuRe
from sb3_cure.persistence import Persistence
from sb3_cure.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cure.pretraining import Pretraining
from sb3_cure.vec_env.model import ModelEnvironments


class CuReSAC(Pretraining, Persistence, ModelEnvironments, CuRe, SAC):  # type: ignore[misc]
    """Soft actor-critic from pixels, with state representation learning and a policy that seeks what it does badly.

    All arguments are described at ``CuRe``.
    """

    critics = TwinQ
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    plain_policies: ClassVar[dict[type[BasePolicy], type[BasePolicy]]] = {
        MlpPolicy: sac_policies.MlpPolicy,
        CnnPolicy: sac_policies.CnnPolicy,
        MultiInputPolicy: sac_policies.MultiInputPolicy,
    }
