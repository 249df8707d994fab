"""Public names of :mod:`sb3_cure.evaluation.deployment`."""

from sb3_cure.evaluation.deployment import DeterministicActor

__all__ = ["DeterministicActor"]
