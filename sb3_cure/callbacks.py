"""Public names of :mod:`sb3_cure.evaluation.callbacks`, and ``ExactCheckpoint``."""

from sb3_cure.evaluation.callbacks import *  # noqa: F403
from sb3_cure.evaluation.callbacks import __all__ as _callbacks
from sb3_cure.persistence import ExactCheckpoint

__all__ = [*_callbacks, "ExactCheckpoint"]
