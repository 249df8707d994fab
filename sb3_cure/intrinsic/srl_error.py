"""The paper's reward: the error of the state representation (section "CuRe")."""

import torch as th

from sb3_cure.buffers import Samples
from sb3_cure.intrinsic.base import IntrinsicReward


class SRLError(IntrinsicReward):
    """r_cure = L_SRL: what the SRL head does badly is worth visiting."""

    needs_srl = True

    def loss(
        self, batch: Samples, latents: th.Tensor | None, next_latents: th.Tensor | None, srl_error: th.Tensor | None
    ) -> tuple[None, th.Tensor]:
        """
        :param batch: Unused
        :param latents: Unused
        :param next_latents: Unused
        :param srl_error: SRL error of the observations, or next observations (``curiosity_target``), [B]
        :return: None, and the error, [B]
        """
        assert srl_error is not None
        return None, srl_error
