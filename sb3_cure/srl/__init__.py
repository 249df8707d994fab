"""State-representation-learning heads, by name.

``SRLHead`` is the contract, ``SRL_HEADS`` has the names of what is built in; any subclass can be passed as ``srl=``.
"""

from sb3_cure.networks.decoders import PixelDecoder
from sb3_cure.srl.autoencoder import RAE
from sb3_cure.srl.base import SRLHead, SRLOutput
from sb3_cure.srl.contrastive import CURL
from sb3_cure.srl.dict_head import DictHead, heads_by_key
from sb3_cure.srl.dynamics import Forward, Inverse
from sb3_cure.srl.self_prediction import SPR
from sb3_cure.srl.variational import VAE

SRL_HEADS: dict[str, type[SRLHead]] = {
    "rae": RAE,
    "curl": CURL,
    "vae": VAE,
    "spr": SPR,
    "forward": Forward,
    "inverse": Inverse,
}


def get_srl_class(srl: str | type[SRLHead]) -> type[SRLHead]:
    """Return the class of an SRL head.

    :param srl: Name of a built-in head, or a subclass of ``SRLHead``
    :return: The class
    :raises ValueError: if it is neither
    """
    if isinstance(srl, str) and srl in SRL_HEADS:
        return SRL_HEADS[srl]
    if isinstance(srl, type) and issubclass(srl, SRLHead):
        return srl
    # A module's own repr takes many lines.
    given = f"an instance of {type(srl).__name__}" if isinstance(srl, SRLHead) else repr(srl)
    raise ValueError(
        f"srl is {given}, but it must be one of {', '.join(map(repr, SRL_HEADS))}, None, or a subclass of "
        "sb3_cure.srl.SRLHead (the class itself, not an instance)."
    )


__all__ = [
    "CURL",
    "RAE",
    "SPR",
    "SRL_HEADS",
    "VAE",
    "DictHead",
    "Forward",
    "Inverse",
    "PixelDecoder",
    "SRLHead",
    "SRLOutput",
    "get_srl_class",
    "heads_by_key",
]
