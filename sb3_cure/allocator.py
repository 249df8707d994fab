"""Public names of :mod:`sb3_cure.networks.allocator`."""

from sb3_cure.networks.allocator import tune_allocator

__all__ = ["tune_allocator"]
