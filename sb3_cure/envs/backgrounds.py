"""What is seen behind a robot in place of sky and floor: distractors, which say nothing about the task.

As in the benchmarks of Zhang et al. (2018), "Natural Environment Benchmarks for Reinforcement Learning", and Stone et
al. (2021), "The Distracting Control Suite". MuJoCo's own segmentation, rendered along with each frame, shows where the
robot is, so that all tasks and cameras are treated alike.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

#: What NumPy's generators take
Seed = int | Sequence[int] | None

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
#: Kinds of geoms that floors and walls are of: planes and height fields (MuJoCo's mjtGeom)
_GROUND = (0, 1)
#: MuJoCo's number of the kind "geom" (mjtObj)
_GEOM = 5


class Background:
    """Replaces the sky and the ground of the world (floor, walls and hills), including the shadows on the ground.

    :param source: ``"noise"``: random pixels, new ones in each frame; or a folder of images, one of which is drawn for
        each episode, cut to a square
    :param physics: The physics of a dm_control environment
    :param size: Height and width of frames in pixels
    :param seed: Seed of the backgrounds, until an episode begins with another one. The task's random numbers are
        separate, and the same with every background
    :raises ValueError: if it is neither ``"noise"`` nor a folder with images
    """

    def __init__(self, source: str, physics: Any, size: int, seed: Seed = None):
        self.rng = np.random.default_rng(seed)
        self.size = size
        self._images: list[Path] | None = None
        if source != "noise":
            folder = Path(source)
            self._images = sorted(path for path in folder.glob("*") if path.suffix.lower() in _SUFFIXES)
            if not self._images:
                raise ValueError(
                    f"background={str(source)!r} is neither 'noise' nor a folder with images ({', '.join(_SUFFIXES)})."
                )
        model = physics.model
        self._ground = np.flatnonzero((model.geom_bodyid == 0) & np.isin(model.geom_type, _GROUND))
        #: Which image the episode has; None: noise
        self.drawn: int | None = None
        self._image = np.zeros((size, size, 3), dtype=np.uint8)

    def begin(self, seed: Seed) -> None:
        """Draw what is seen behind an episode.

        :param seed: As for ``reset``
        """
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        if self._images is not None:
            self._show(int(self.rng.integers(len(self._images))))

    def _show(self, number: int) -> None:
        self.drawn = number
        with Image.open(self._images[number]) as image:  # type: ignore[index]
            fitted = ImageOps.fit(image.convert("RGB"), (self.size, self.size), Image.Resampling.BOX)
        self._image = np.asarray(fitted)

    def mask(self, camera: Any) -> np.ndarray:
        """Find sky and ground by segmentation.

        :param camera: A camera of dm_control
        :return: Where it sees sky or ground, bool [size, size]
        """
        seen = camera.render(segmentation=True)
        numbers, kinds = seen[..., 0], seen[..., 1]
        return (kinds == -1) | (kinds == _GEOM) & np.isin(numbers, self._ground)

    def behind(self, frame: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Put this background behind the robot.

        :param frame: uint8 [size, size, 3]
        :param mask: Result of ``mask`` for the same state
        :return: The frame, with this background where the mask is true
        """
        image = self._image if self._images is not None else self.rng.integers(0, 256, frame.shape, dtype=np.uint8)
        return np.where(mask[..., None], image, frame)

    def state_dict(self) -> dict[str, Any]:
        """Get what the frames to come depend on, for exact resume.

        :return: State of the generator, and the number of the image
        """
        return {"rng": self.rng.bit_generator.state, "drawn": self.drawn}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what the frames to come depend on.

        :param state: Result of ``state_dict``
        """
        self.rng.bit_generator.state = state["rng"]
        if state["drawn"] is not None:
            self._show(state["drawn"])
