"""Files that run no code when loaded, and trainings that continue where they were killed."""

from sb3_cure.persistence.checkpoints import ExactCheckpoint
from sb3_cure.persistence.encoding import ArchiveError, read_state, write_state
from sb3_cure.persistence.env_state import ResumableEnv
from sb3_cure.persistence.generations import CheckpointError
from sb3_cure.persistence.mixin import Persistence

__all__ = [
    "ArchiveError",
    "CheckpointError",
    "ExactCheckpoint",
    "Persistence",
    "ResumableEnv",
    "read_state",
    "write_state",
]
