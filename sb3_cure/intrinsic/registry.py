"""Names of the intrinsic rewards, one line each."""

from sb3_cure.intrinsic.base import IntrinsicReward
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

INTRINSIC_REWARDS: dict[str, type[IntrinsicReward]] = {
    "srl_error": SRLError,
    "reconstruction": Reconstruction,
    "rnd": RND,
    "icm": ICM,
    "impact": Impact,
    "disagreement": Disagreement,
    "particle": Particle,
}


def get_intrinsic_class(
    intrinsic: str | type[IntrinsicReward], head: SRLHead | type[SRLHead] | None
) -> type[IntrinsicReward]:
    """Return the class of an intrinsic reward.

    :param intrinsic: Name of a built-in reward, a subclass of ``IntrinsicReward``, or ``"auto"``: the SRL error of a
        head whose error tells novelty, else ``"rnd"``
    :param head: The agent's SRL head, its class, or None; ``"auto"`` depends on it
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
