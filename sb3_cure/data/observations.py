"""Observations of one sensor, or dictionaries of several: which parts are images, and how vectors become one."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space

#: [B, *shape], or these by key
Observations = th.Tensor | dict[str, th.Tensor]


def image_spaces(space: spaces.Space) -> dict[str, spaces.Box]:
    """Find the images in a space of observations.

    :param space: Space of observations
    :return: Spaces of the images among them by key; an observation that is itself an image has the key ``""``
    """
    return {key: part for key, part in by_key(space).items() if is_image_space(part)}  # type: ignore[misc]


def images_of(observations: Any, space: spaces.Space) -> dict[str, Any]:
    """Pick the images out of observations.

    :param observations: Arrays or tensors, or dictionaries of them
    :param space: Their space
    :return: The images among them, by the keys of ``image_spaces``
    """
    return {key: observations[key] if isinstance(observations, dict) else observations for key in image_spaces(space)}


def check_images(observations: Any, space: spaces.Space) -> None:
    """Refuse images that are not uint8: networks would not scale them like those of the replay buffer.

    :param observations: Tensor, or a dictionary of tensors
    :param space: Their space
    :raises ValueError: If an image is not uint8
    """
    for image in images_of(observations, space).values():
        if image.dtype != th.uint8:
            raise ValueError(f"images must be uint8, not {image.dtype}: do not divide them by 255.")


def by_key(value: Any) -> dict[str, Any]:
    """Return an observation, its space, or anything that is kept for each of its parts, as a dictionary by key.

    :param value: Anything, or a dictionary, also of spaces
    :return: The dictionary; anything else has the key ``""``, as in ``image_spaces``
    """
    return dict(value) if isinstance(value, Mapping) else {"": value}


def stacked(observations: Sequence[Any]) -> Any:
    """Stack observations along a new first axis.

    :param observations: n observations
    :return: [n, *shape], or a dictionary of these
    """
    first = observations[0]
    if isinstance(first, dict):
        return {key: np.stack([each[key] for each in observations]) for key in first}
    return np.stack(observations)


def rows_of(observations: Any, rows: Any) -> Any:
    """Index observations along their first axis.

    :param observations: [n, *shape], or a dictionary of these
    :param rows: An index, a slice or a mask
    :return: These rows, as a dictionary if the observations are one
    """
    if isinstance(observations, Mapping):
        return {key: rows_of(part, rows) for key, part in observations.items()}
    return observations[rows]


def first_not_finite(observations: Any) -> tuple[int, str, float] | None:
    """Find the first number that is not finite in float32, in which numbers are stored and networks compute.

    :param observations: [n, *shape], or a dictionary of these
    :return: Its place along the first axis, its key or ``""``, and the number; None if all are finite
    """
    for key, part in by_key(observations).items():
        if np.issubdtype(part.dtype, np.floating):
            with np.errstate(over="ignore"):
                finite = np.isfinite(part.astype(np.float32, copy=False))
            if not finite.all():
                where = tuple(np.argwhere(~finite)[0])
                return int(where[0]), key, float(part[where])
    return None


def sensed_space(space: spaces.Space) -> spaces.Space:
    """Space of observations as encoder, head and rewards get them: a dictionary without images is one vector.

    :param space: Space of observations as they are stored
    :return: The space
    """
    if not isinstance(space, spaces.Dict) or image_spaces(space):
        return space
    return spaces.Box(-np.inf, np.inf, (get_flattened_obs_dim(space),), np.float32)
