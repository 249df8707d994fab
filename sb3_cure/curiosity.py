"""From the state-representation error to the intrinsic reward of the curious agent (paper, section "CuRe")."""

import torch as th
from torch import nn


class CuriousReward(nn.Module):
    """r_cure = beta * error, by default of the error standardised by its running mean and deviation.

    The paper uses the bare error. Errors of an autoencoder are of order 1e-3, far below the entropy bonus of SAC
    (temperature times log-probability), so that an un-normalised curious policy stays close to random. The running
    statistics are exponential averages over updates, because the error falls by orders of magnitude while the head
    learns; they are buffers, so they are saved and restored with the policy.

    :param beta: Degree of curiosity, beta in the paper
    :param normalize: Whether to standardise; False is the paper's letter
    :param clip: Standardised errors are clipped to [-clip, clip]
    :param decay: Weight of the past in the running statistics, per update
    """

    mean: th.Tensor
    mean_square: th.Tensor
    weight: th.Tensor

    def __init__(self, beta: float = 1.0, normalize: bool = True, clip: float = 5.0, decay: float = 0.99):
        super().__init__()
        self.beta = beta
        self.normalize = normalize
        self.clip = clip
        self.decay = decay
        for name in ("mean", "mean_square", "weight"):
            self.register_buffer(name, th.zeros(()))

    @th.no_grad()
    def update(self, error: th.Tensor) -> None:
        """Take a batch into the running statistics.

        :param error: SRL error per sample, [B]
        """
        step = 1.0 - self.decay
        self.mean.lerp_(error.mean(), step)
        self.mean_square.lerp_(error.square().mean(), step)
        # The averages start at zero: their total weight undoes that bias, as Adam does for its moments.
        self.weight.lerp_(th.ones_like(self.weight), step)

    @th.no_grad()
    def forward(self, error: th.Tensor) -> th.Tensor:
        """
        :param error: SRL error per sample, [B]
        :return: Curious reward, [B, 1]
        """
        if self.normalize:
            weight = self.weight.clamp(min=1e-8)
            mean = self.mean / weight
            mean_square = self.mean_square / weight
            # A spread below a thousandth of the errors' size is rounding: errors that are all alike earn nothing.
            std = th.maximum(mean_square - mean.square(), 1e-6 * mean_square).sqrt()
            error = ((error - mean) / (std + 1e-8)).clamp(-self.clip, self.clip)
        return self.beta * error.unsqueeze(1)
