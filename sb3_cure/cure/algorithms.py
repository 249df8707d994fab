"""The algorithms that users name: CuRe on SB3's SAC and on sb3-contrib's TQC."""

from typing import Any, ClassVar

from sb3_contrib.tqc.tqc import TQC
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.sac.sac import SAC

from sb3_cure.cure.critics import QuantileCritic, TwinCritic
from sb3_cure.cure.cure import CuRe
from sb3_cure.cure.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_cure.cure.pretraining import Pretraining
from sb3_cure.persistence import Persistence

POLICIES: dict[str, type[BasePolicy]] = {
    "MlpPolicy": MlpPolicy,
    "CnnPolicy": CnnPolicy,
    "MultiInputPolicy": MultiInputPolicy,
}


# Persistence comes before CuRe, which in a resumed `learn` must see that the step count is not reset.
class CuReSAC(Pretraining, Persistence, CuRe, SAC):  # type: ignore[misc]
    """SAC from pixels, with state representation learning and a curious policy that seeks badly represented states.

    All arguments are described at ``CuReBase``.
    """

    critic_class = TwinCritic
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = POLICIES


class CuReTQC(Pretraining, Persistence, CuRe, TQC):  # type: ignore[misc]
    """Truncated quantile critics from pixels, with state representation learning and a curious policy.

    All arguments are described at ``CuReBase``; ``top_quantiles_to_drop_per_net`` is TQC's; ``n_quantiles`` is one of
    ``policy_kwargs``.
    """

    critic_class = QuantileCritic
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = POLICIES

    def _policy_settings(self) -> dict[str, Any]:
        dropped = {"top_quantiles_to_drop_per_net": self.top_quantiles_to_drop_per_net}
        return super()._policy_settings() | dropped
