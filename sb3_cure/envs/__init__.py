"""Environments that are observed through pixels: DeepMind Control tasks, and any other that can render itself.

Importing this package and registering its ids needs neither OpenGL nor dm_control, which are loaded when the first
DeepMind Control environment is made; what checks OpenGL is in :mod:`sb3_cure.envs.rendering`.
"""

from sb3_cure.envs.copy_observations import CopyObservations
from sb3_cure.envs.dmc import make_dmc_env
from sb3_cure.envs.physics import physics_state, physics_state_names, physics_state_units
from sb3_cure.envs.registration import DMC_TASKS, register_dmc_envs
from sb3_cure.envs.spaces_check import check_observation_space
from sb3_cure.envs.wrappers import (
    ActionRepeat,
    NormalizeActions,
    PixelObservation,
    ResizeImages,
    StackFrames,
    make_pixel_env,
)

__all__ = [
    "DMC_TASKS",
    "ActionRepeat",
    "CopyObservations",
    "NormalizeActions",
    "PixelObservation",
    "ResizeImages",
    "StackFrames",
    "check_observation_space",
    "make_dmc_env",
    "make_pixel_env",
    "physics_state",
    "physics_state_names",
    "physics_state_units",
    "register_dmc_envs",
]
