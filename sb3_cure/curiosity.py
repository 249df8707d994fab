"""From the state-representation error to the intrinsic reward of the curious agent (paper, section "CuRe")."""

import torch as th
from torch import nn


class CuriousReward(nn.Module):
    """r_cure = beta * error, by default of the error divided by its running size.

    The paper uses the bare error. Errors of an autoencoder are of order 1e-3, far below the entropy bonus of SAC
    (temperature times log-probability), so that an un-normalised curious policy stays close to random. Sizes are
    exponential averages over updates, because the error falls by orders of magnitude while the head learns; they are
    buffers, so they are saved and restored with the policy.

    The reward of an agent of its own is centred by the mean *of its batch*: a running mean would lag behind an error
    that falls, and turn nearly all rewards negative. What is divided by is then the running deviation within batches. A
    bonus on a task's reward is not centred, but divided by the running root mean square: it is never negative.

    :param beta: Degree of curiosity, beta in the paper
    :param normalize: Whether to do so; False is the paper's letter
    :param center: Whether to centre the reward (False: a bonus)
    :param clip: Normalised errors are clipped to [-clip, clip]
    :param decay: Weight of the past in the running sizes, per update
    """

    variance: th.Tensor
    mean_square: th.Tensor
    weight: th.Tensor

    def __init__(
        self,
        beta: float = 1.0,
        normalize: bool = True,
        center: bool = True,
        clip: float = 5.0,
        decay: float = 0.99,
    ):
        super().__init__()
        self.beta = beta
        self.normalize = normalize
        self.center = center
        self.clip = clip
        self.decay = decay
        for name in ("variance", "mean_square", "weight"):
            self.register_buffer(name, th.zeros(()))

    @th.no_grad()
    def update(self, error: th.Tensor) -> None:
        """Take a batch into the running sizes.

        :param error: SRL error per sample, [B]
        """
        step = 1.0 - self.decay
        self.variance.lerp_(error.var(correction=0), step)
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
            square = self.mean_square
            if self.center:
                error = error - error.mean()
                # A spread below a thousandth of the errors' size is rounding: errors that are all alike earn nothing.
                square = th.maximum(self.variance, 1e-6 * self.mean_square)
            size = (square / self.weight.clamp(min=1e-8)).sqrt()
            error = (error / (size + 1e-8)).clamp(-self.clip, self.clip)
        return self.beta * error.unsqueeze(1)
