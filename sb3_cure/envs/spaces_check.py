"""Refuse spaces that would silently be read as something else, such as images as vectors."""

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

#: Sides of fewer pixels are taken for those of tables and grids.
MIN_SIDE = 8
#: And in two dimensions, other than uint8, for those of matrices.
MIN_MATRIX_SIDE = 32
#: MuJoCo's mjMAXVAL: dm_control gives it as the bound of an actuator that has none.
UNBOUNDED = 1e10


def check_observation_space(space: spaces.Space, policy: str | type | None = None) -> None:
    """Refuse spaces that would be read as something else than meant.

    An image is a ``Box`` of dtype uint8 with three dimensions and bounds 0 and 255. All other boxes are vectors.
    Refused are nested dictionaries, texts, boxes that look like images but would be read as vectors, boxes without
    dimensions or entries, and ``"MultiInputPolicy"`` for one image.

    :param space: Space of observations
    :param policy: Name or class of the policy; None: do not check that it fits
    :raises ValueError: If a part of the space is refused; the message names its key
    """
    name = policy if isinstance(policy, str) or policy is None else policy.__name__
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            _check_part(part, f"the observation {key!r}", is_image=True)
        return
    if name is not None and name.endswith("MultiInputPolicy") and is_image_space(space):
        raise ValueError(f"MultiInputPolicy is for dictionaries, but observations are one {space}: use 'CnnPolicy'.")
    _check_part(space, "the observation", is_image=name is not None and name.endswith("CnnPolicy"))


def check_action_space(space: spaces.Space) -> None:
    """Refuse integers, as replay buffers would cut the policy's numbers in [-1, 1] to -1, 0 and 1, and useless bounds.

    :param space: Space of actions
    :raises ValueError: If it is no box of floats, or SB3's policies would scale to numbers that are not finite (between
        equal bounds), or to the bounds of an actuator that has none
    """
    if not (isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)):
        raise ValueError(
            f"actions are {space}, but policies output real numbers: wrap the environment in an ActionWrapper that "
            "maps a Box of floats to these actions."
        )
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    if not ((low > -UNBOUNDED) & (high < UNBOUNDED) & (low < high)).all():
        raise ValueError(
            f"actions are {space}, where some lack a bound, or have only one value: wrap the environment in "
            "NormalizeActions of sb3_cure.envs, which chooses bounds for the former, and holds the latter."
        )


def _check_part(space: spaces.Space, name: str, is_image: bool) -> None:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        raise ValueError(
            f"{name} is a {type(space).__name__}, which replay buffers cannot store: flatten it in an "
            "ObservationWrapper to one Dict, whose parts have keys such as 'pixels_top' for ['pixels']['top']."
        )
    if space.shape is None:
        raise ValueError(
            f"{name} is a {type(space).__name__}, which is no array: leave it out, as by "
            "gymnasium.wrappers.FilterObservation with the other keys."
        )
    if isinstance(space, spaces.Box) and (space.shape == () or 0 in space.shape):
        raise ValueError(
            f"{name} has the shape {space.shape}: return a number as [1], and leave out what is empty, as by "
            "gymnasium.wrappers.FilterObservation with the other keys."
        )
    if not isinstance(space, spaces.Box) or len(space.shape) < 2 or sorted(space.shape)[-2] < MIN_SIDE:
        return
    rank = len(space.shape)
    reads = (
        f"{name} is {space.dtype} of shape {space.shape}, which would be read as a vector of {space.low.size} numbers"
    )
    if space.dtype == np.uint8 and space.low.min() == 0 and space.high.max() == 255 and is_image:
        if rank == 2:
            raise ValueError(f"{reads}: if it is an image, return it as [H, W, 1], else flatten it.")
        if rank == 4:
            raise ValueError(
                f"{reads}: if it is an image, return the newest as [H, W, C] (StackFrames of sb3_cure.envs stacks "
                "them), else flatten it."
            )
    is_matrix_image = rank == 2 and min(space.shape) >= MIN_MATRIX_SIDE and is_image
    if is_matrix_image or (rank == 3 and not is_image_space(space)):
        raise ValueError(
            f"{reads}: if it is an image, return it as uint8 from 0 to 255, [H, W, C], else flatten it (images are "
            "normalised inside of the networks: VecNormalize with norm_obs=False, or norm_obs_keys of vectors alone)."
        )
