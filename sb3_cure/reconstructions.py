"""Public names of :mod:`sb3_cure.cure.reconstructions`."""

from sb3_cure.cure.reconstructions import reconstruction_strips

__all__ = ["reconstruction_strips"]
