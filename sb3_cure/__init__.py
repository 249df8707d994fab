"""Stable-Baselines3 from pixels: SAC and TQC with state representation learning and curiosity about it (CuRe)."""

import contextlib
import importlib

from sb3_cure.cli.zoo_files import recipe
from sb3_cure.cure.algorithms import CuReSAC, CuReTQC
from sb3_cure.envs import make_dmc_env, make_pixel_env, register_dmc_envs

__version__ = "0.4.0.dev0"

register_dmc_envs()

# torch's CUDA builds import triton when the first optimizer is made. From 3.7 on, its LLVM crashes if Mesa, whose
# software renderer has an LLVM of its own, was loaded before, so load triton before anything renders.
with contextlib.suppress(ImportError):
    importlib.import_module("triton")

__all__ = ["CuReSAC", "CuReTQC", "__version__", "make_dmc_env", "make_pixel_env", "recipe"]
