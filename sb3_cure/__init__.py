"""Stable-Baselines3 from pixels: SAC with state representation learning and curiosity about it (CuRe)."""

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs import make_dmc_env, register_dmc_envs

__version__ = "0.1.0"

register_dmc_envs()

__all__ = ["CuReSAC", "__version__", "make_dmc_env"]
