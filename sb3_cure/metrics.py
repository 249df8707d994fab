"""Public names of :mod:`sb3_cure.cure.metrics`."""

from sb3_cure.cure.metrics import reconstruction_strip, reconstruction_strips

__all__ = ["reconstruction_strip", "reconstruction_strips"]
