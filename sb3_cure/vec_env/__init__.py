"""Vectorised environments: workers that may fail, a check of all numbers, updates beside the environments."""

from sb3_cure.vec_env.asynchronous import OverlappedVecEnv
from sb3_cure.vec_env.finite_check import BadTransitionError, FiniteCheck
from sb3_cure.vec_env.frame_watch import FrameWatch
from sb3_cure.vec_env.workers import EnvFaultError, FaultTolerantSubprocVecEnv

__all__ = [
    "BadTransitionError",
    "EnvFaultError",
    "FaultTolerantSubprocVecEnv",
    "FiniteCheck",
    "FrameWatch",
    "OverlappedVecEnv",
]
