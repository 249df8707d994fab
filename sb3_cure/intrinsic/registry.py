"""Names of the intrinsic rewards, one line each, and the control that wraps any of them."""

from typing import Any

import torch as th

from sb3_cure.intrinsic.base import IntrinsicReward, OwnGenerator, RewardInputs
from sb3_cure.intrinsic.dict_reward import make_reward
from sb3_cure.intrinsic.disagreement import Disagreement
from sb3_cure.intrinsic.icm import ICM
from sb3_cure.intrinsic.impact import Impact
from sb3_cure.intrinsic.particle import Particle
from sb3_cure.intrinsic.reconstruction import Reconstruction
from sb3_cure.intrinsic.rnd import RND
from sb3_cure.intrinsic.srl_error import SRLError
from sb3_cure.srl import SRLHead

#: Reward of ``"auto"`` where the head's error does not tell novelty: it explored as far as the error of an autoencoder
#: (results/curiosity.md), needs no head that draws, and costs little
AUTO_WITHOUT_NOVELTY = "rnd"


def get_intrinsic_class(
    intrinsic: str | type[IntrinsicReward], head: SRLHead | type[SRLHead] | None
) -> type[IntrinsicReward]:
    """Return the class of an intrinsic reward.

    :param intrinsic: Name of a built-in reward, a subclass of ``IntrinsicReward``, or ``"auto"``: the SRL error of a
        head whose error tells novelty, else ``"rnd"``
    :param head: The agent's SRL head, its class, or None; ``"auto"`` asks it
    :return: The class
    :raises ValueError: if it is none of these
    """
    if intrinsic == "auto":
        intrinsic = "srl_error" if head is not None and head.error_tells_novelty else AUTO_WITHOUT_NOVELTY
    if isinstance(intrinsic, str) and intrinsic in INTRINSIC_REWARDS:
        return INTRINSIC_REWARDS[intrinsic]
    if isinstance(intrinsic, type) and issubclass(intrinsic, IntrinsicReward):
        return intrinsic
    names = ", ".join(map(repr, ["auto", *INTRINSIC_REWARDS]))
    # A module's own repr takes many lines.
    given = f"an instance of {type(intrinsic).__name__}" if isinstance(intrinsic, IntrinsicReward) else repr(intrinsic)
    raise ValueError(
        f"intrinsic is {given}: choose one of {names}, or a subclass of sb3_cure.intrinsic.IntrinsicReward (the class "
        "itself, not an instance)."
    )


class Shuffled(IntrinsicReward):
    """Another reward's numbers, given to the wrong samples: the same networks, gradients, mean and spread.

    :param args: As of ``IntrinsicReward``
    :param settings: As of ``make_reward``
    :param of: Name or class of the other reward; ``"auto"``: the one that ``intrinsic="auto"`` takes with this head
    :param kwargs: Its arguments
    """

    def __init__(self, *args: Any, settings: dict[str, Any], of: str | type[IntrinsicReward] = "auto", **kwargs: Any):
        super().__init__(*args)
        reward_class = get_intrinsic_class(of, settings.get("srl"))
        spaces_of = self.observation_space, self.action_space
        self.of = make_reward(reward_class, *spaces_of, self.features_dim, settings, kwargs)
        self.random = OwnGenerator(stream=1)
        for name in ("needs_srl", "trains_encoder", "measures"):
            setattr(self, name, getattr(self.of, name))

    def loss(self, inputs: RewardInputs) -> tuple[th.Tensor | None, th.Tensor]:
        """Shuffle the other reward's numbers.

        :param inputs: For the other reward
        :return: The other reward's loss, and its reward in a random order, [B]
        """
        loss, reward = self.of.loss(inputs)
        return loss, reward[th.randperm(len(reward), generator=self.random.generator).to(reward.device)]

    def error(self, observations: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """Return the other reward's error: policies are measured by it as it is."""
        return self.of.error(observations, latents)

    def reconstruct(self, latents: th.Tensor) -> th.Tensor | None:
        """Draw observations as the other reward does."""
        return self.of.reconstruct(latents)

    def forget(self) -> None:
        """Let the other reward forget what refers to the replay buffer."""
        self.of.forget()


INTRINSIC_REWARDS: dict[str, type[IntrinsicReward]] = {
    "srl_error": SRLError,
    "reconstruction": Reconstruction,
    "rnd": RND,
    "icm": ICM,
    "impact": Impact,
    "disagreement": Disagreement,
    "particle": Particle,
    "shuffled": Shuffled,
}
