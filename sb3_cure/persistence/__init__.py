"""Files that can be loaded from strangers, and trainings that go on where they were killed."""

from sb3_cure.persistence.archive import ObjectsMissing, is_pickled_model
from sb3_cure.persistence.checkpoints import ExactCheckpoint
from sb3_cure.persistence.encoding import ArchiveError, read_state, write_state
from sb3_cure.persistence.generations import CheckpointError
from sb3_cure.persistence.mixin import Persistence

__all__ = [
    "ArchiveError",
    "CheckpointError",
    "ExactCheckpoint",
    "ObjectsMissing",
    "Persistence",
    "is_pickled_model",
    "read_state",
    "write_state",
]
