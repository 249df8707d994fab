"""Stable-Baselines3 from pixels: SAC and TQC with state representation learning and curiosity about it (CuRe)."""

from sb3_cure.cli.zoo_files import recipe
from sb3_cure.cure.algorithms import CuReSAC, CuReTQC
from sb3_cure.envs import make_dmc_env, make_pixel_env, register_dmc_envs

__version__ = "0.4.0.dev0"

register_dmc_envs()

__all__ = ["CuReSAC", "CuReTQC", "__version__", "make_dmc_env", "make_pixel_env", "recipe"]
