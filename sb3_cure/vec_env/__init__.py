"""Vectorised environments: checks, workers that may fail, and updates while workers step."""

from sb3_cure.vec_env.asynchronous import OverlappedVecEnv
from sb3_cure.vec_env.checks import check_environments
from sb3_cure.vec_env.finite_check import BadTransitionError, FiniteCheck
from sb3_cure.vec_env.frame_watch import EnvFaultError, FrameWatch
from sb3_cure.vec_env.workers import FaultTolerantSubprocVecEnv

__all__ = [
    "BadTransitionError",
    "EnvFaultError",
    "FaultTolerantSubprocVecEnv",
    "FiniteCheck",
    "FrameWatch",
    "OverlappedVecEnv",
    "check_environments",
]
