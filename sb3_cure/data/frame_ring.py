"""Memory for the frames of stacked images, each kept once."""

import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch as th
from numpy import ndarray

#: Share of frames beyond one per transition: an episode has one frame more than steps. With all else that a row holds,
#: a transition of 84x84 images takes the memory of less than 1.05 frames.
SPARE_FRAMES = 0.04

#: Size of the pieces in which frames are written to files and read, unless a frame is larger
PIECE_BYTES = 2**22


class FrameRing:
    """Memory for the frames of one image, each kept once; the newest frame replaces the oldest one.

    Frame number i, counted from the first one, lies in slot ``i % capacity``. A stack is given by the slots of its
    frames. The ring does not know how many frames it holds: its buffer keeps that count.

    :param shape: Shape of a stack, (frame_stack * c, height, width)
    :param frame_stack: Frames per stack
    :param n_rows: Rows of the replay buffer
    :param n_envs: Number of environments
    :param frames_dir: Directory for an unnamed file that holds the frames; None: memory
    """

    def __init__(
        self, shape: tuple[int, ...], frame_stack: int, n_rows: int, n_envs: int, frames_dir: str | Path | None = None
    ):
        if shape[0] % frame_stack:
            raise ValueError(f"frame_stack={frame_stack} does not divide the {shape[0]} channels of images {shape}.")
        self.shape, self.frame_stack, self.frames_dir = shape, frame_stack, frames_dir
        self.frame_shape = (shape[0] // frame_stack, *shape[1:])
        #: Frames that one ``add`` stores at most: two whole stacks per environment
        self.max_new = 2 * frame_stack * n_envs
        n_frames = math.ceil((1 + SPARE_FRAMES) * n_rows * n_envs)
        self.capacity = n_frames + 2 * self.max_new + frame_stack * n_envs
        # Zeros take no memory until they are written to. A file is made by the first `add`: acting needs none.
        self.frames = np.zeros((self.capacity if frames_dir is None else 0, *self.frame_shape), np.uint8)

    @property
    def nbytes(self) -> int:
        """Bytes of all frames of the full ring."""
        return self.capacity * math.prod(self.frame_shape)

    def reserve(self) -> None:
        """Make the file for the frames, if there is to be one; it is gone when the ring is."""
        if len(self.frames) > 0:
            return
        assert self.frames_dir is not None
        Path(self.frames_dir).mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=self.frames_dir) as file:
            if hasattr(os, "posix_fallocate"):  # writing to a mapped file on a full disk would kill the process
                os.posix_fallocate(file.fileno(), 0, self.nbytes)
            self.frames = np.memmap(file, np.uint8, "w+", shape=(self.capacity, *self.frame_shape))

    def store(self, obs: ndarray, next_obs: ndarray, tails: ndarray | None, count: int) -> tuple[ndarray, ndarray, int]:
        """Store what is new in the stacks of one row, in slots that no row reads.

        :param obs: Stacks, uint8 [n_envs, *shape]
        :param next_obs: Their successors
        :param tails: Slots of the successors in the row before, [n_envs, frame_stack]; None: there is no such row
        :param count: Frames stored before
        :return: Slots of stacks and successors, [n_envs, 2, frame_stack]; whether each stack is the successor in the
            row before, [n_envs]; frames stored after
        """
        self.reserve()
        stacks, successors = (
            np.ascontiguousarray(each).reshape(-1, self.frame_stack, *self.frame_shape) for each in (obs, next_obs)
        )
        slots = np.zeros((len(stacks), 2, self.frame_stack), np.int32)
        continues = np.zeros(len(stacks), bool)
        for i, (stack, successor) in enumerate(zip(stacks, successors, strict=True)):
            same = tails is not None and np.array_equal(self.frames[tails[i]], stack)
            # A shared frame must outlive this `add` and the next one.
            if same and self._age(tails[i, 0], count) < self.capacity - 2 * self.max_new:  # type: ignore[index]
                slots[i, 0] = tails[i]  # type: ignore[index]
            else:
                slots[i, 0], count = self._put(stack, count)
            continues[i] = same
            if np.array_equal(successor[:-1], stack[1:]):
                slots[i, 1, :-1] = slots[i, 0, 1:]
                slots[i, 1, -1:], count = self._put(successor[-1:], count)
            else:
                slots[i, 1], count = self._put(successor, count)
        return slots, continues, count

    def _put(self, frames: ndarray, count: int) -> tuple[list[int], int]:
        """Store frames; one that repeats the frame before it (as after a reset) is not stored again."""
        slots: list[int] = []
        for i, frame in enumerate(frames):
            if i == 0 or not np.array_equal(frame, frames[i - 1]):
                self.frames[count % self.capacity] = frame
                count += 1
            slots.append((count - 1) % self.capacity)
        return slots, count

    def _age(self, slot: int, count: int) -> int:
        """Number of frames stored after the one in the slot."""
        return (count - 1 - int(slot)) % self.capacity

    def is_lost(self, slots: ndarray, count: int) -> bool:
        """Whether the next ``add`` may overwrite a frame of a row.

        :param slots: Slots of the row, [n_envs, 2, frame_stack]
        :param count: Frames stored so far
        :return: Whether it may
        """
        return max(self._age(slot, count) for slot in slots[:, 0, 0]) >= self.capacity - self.max_new

    def stacks(self, slots: ndarray) -> ndarray:
        """Stacks by the slots of their frames.

        :param slots: [..., frame_stack]
        :return: uint8 [..., *shape]
        """
        # `index_select` is threaded, unlike the fancy indexing of NumPy.
        frames = th.from_numpy(self.frames).index_select(0, th.from_numpy(slots.ravel()))
        return frames.view(*slots.shape[:-1], *self.shape).numpy()

    def pieces(self, first: int, last: int) -> Iterator[memoryview]:
        """Memory of the frames with the numbers ``first`` to ``last - 1``, to be read or written.

        :param first: Number of the first frame
        :param last: Number after the last frame
        :return: Contiguous bytes
        """
        self.reserve()
        at_once = max(PIECE_BYTES // math.prod(self.frame_shape), 1)
        while first < last:
            start = first % self.capacity
            piece = self.frames[start : min(start + min(last - first, at_once), self.capacity)]
            yield piece.reshape(-1).data
            first += len(piece)
