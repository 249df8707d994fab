"""Replay buffers: one that keeps each frame of stacked images once, and one that never samples marked transitions.

``FrameStackReplayBuffer`` is one ring of frames, and per transition the positions of its frames in that ring;
``DictFrameStackReplayBuffer`` has such a ring for each image of a dictionary.
"""

import itertools
import math
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy import ndarray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_cure.data.observations import image_spaces, rows_of

try:
    import psutil
except ImportError:
    psutil = None  # type: ignore[assignment]

Infos = list[dict[str, Any]]

#: Keys of ``info`` that mark a transition which must never be sampled: ``FaultTolerantSubprocVecEnv`` sets
#: ``env_fault`` where an environment failed, ``on_bad_transition="skip"`` sets ``bad_transition``
MARKS = ("env_fault", "bad_transition")


def is_marked(info: Mapping[str, Any]) -> bool:
    """
    :param info: What an environment told of a transition
    :return: Whether that transition must never be sampled
    """
    return any(info.get(mark) is not None for mark in MARKS)


def unmarked(buffer: ReplayBuffer) -> tuple[ndarray, ndarray, ndarray]:
    """
    :param buffer: A replay buffer
    :return: Rows, environments and ages (in rows) of all transitions that may be sampled, newest first, [n] each
    """
    # SB3's memory-saving variant has overwritten the observation of its oldest row
    n_rows = buffer.size() - int(buffer.optimize_memory_usage and buffer.full)
    ages, env_inds = np.divmod(np.arange(n_rows * buffer.n_envs), buffer.n_envs)
    rows = (buffer.pos - 1 - ages) % buffer.buffer_size
    good = ~buffer.marked[rows, env_inds] if isinstance(buffer, SkipsMarked) else np.ones(len(rows), dtype=bool)
    return rows[good], env_inds[good], ages[good]


def transitions(
    buffer: ReplayBuffer, rows: ndarray, env_inds: ndarray, env: VecNormalize | None = None
) -> ReplayBufferSamples:
    """
    Look up transitions by their place, where ``sample`` draws them.

    :param buffer: SB3's ``ReplayBuffer`` or one of this module
    :param rows: Row positions in [0, buffer_size): the row that ``add`` wrote when ``pos`` had this value, [n]
    :param env_inds: Environment of each, [n]
    :param env: VecEnv to normalize the observations and rewards with
    :return: Batch on the buffer's device
    :raises IndexError: If a row of a ``FrameStackReplayBuffer`` is empty, or its frames have been overwritten
    """
    inds = rows, env_inds
    obs: Any
    next_obs: Any
    if isinstance(buffer, FrameStackReplayBuffer | DictFrameStackReplayBuffer):
        obs, next_obs = buffer.observations_at(rows, env_inds)
    elif buffer.optimize_memory_usage:
        obs, next_obs = buffer.observations[inds], buffer.observations[(rows + 1) % buffer.buffer_size, env_inds]
    else:
        obs, next_obs = rows_of(buffer.observations, inds), rows_of(buffer.next_observations, inds)
    data = (
        buffer._normalize_obs(obs, env),
        buffer.actions[inds],
        buffer._normalize_obs(next_obs, env),
        # Only use dones that are not due to timeouts
        (buffer.dones[inds] * (1 - buffer.timeouts[inds])).reshape(-1, 1),
        buffer._normalize_reward(buffer.rewards[inds].reshape(-1, 1), env),
    )
    kind: Any = DictReplayBufferSamples if isinstance(obs, dict) else ReplayBufferSamples
    return kind(*(_to_torch(buffer, array) for array in data))


def _to_torch(buffer: ReplayBuffer, array: Any) -> Any:
    """Fresh arrays, or a dictionary of such, which need no copy, on the buffer's device."""
    if isinstance(array, dict):
        return {key: _to_torch(buffer, part) for key, part in array.items()}
    return buffer.to_torch(array, copy=False)


class SkipsMarked(ReplayBuffer):
    """
    Base of replay buffers that never sample marked transitions (see ``MARKS``), and remember the rows they drew.

    A row holds the transitions of all environments at one time, so a marked one keeps its place. Where it is drawn,
    another one is drawn from all unmarked ones: sampling stays uniform, and without marks the random numbers are SB3's.
    """

    marked: ndarray  # bool [buffer_size, n_envs]
    #: Rows that were ever added
    n_added: int = 0
    #: Rows and environments of the latest batch, [batch_size] each
    last_sampled: tuple[ndarray, ndarray] | None = None

    def _mark(self, infos: Infos) -> ndarray:
        """
        Mark what ``infos`` say of the row at ``pos`` and of rows before it.

        :param infos: One dictionary per environment; ``env_fault_steps`` tells how many of its latest transitions,
            this one included, are marked (default: 1)
        :return: Which transitions of this row are marked, bool [n_envs]
        """
        self.n_added += 1
        self.marked[self.pos] = marks = np.array([is_marked(info) for info in infos])
        for i in np.flatnonzero(marks):
            n_steps = min(infos[i].get("env_fault_steps", 1), self.buffer_size)
            self.marked[(self.pos - np.arange(n_steps)) % self.buffer_size, i] = True
        return marks

    def _draw_rows(self, batch_size: int) -> ndarray:
        """Positions drawn uniformly, with replacement, from the latest ``size()`` rows, [batch_size]."""
        n_rows = self.size()
        rows = np.random.randint(0, n_rows, size=batch_size)
        if n_rows < (self.buffer_size if self.full else self.pos):
            # Rows were lost: count from the oldest one that is left. Else rows are positions, as in SB3.
            rows = (rows + self.pos - n_rows) % self.buffer_size
        return rows

    def _get_samples(self, batch_inds: ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Transitions of the given rows, each of a random environment; others where these are marked.

        :param batch_inds: Row positions, [batch_size]
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``
        :raises ValueError: If all transitions are marked
        """
        rows, env_inds = batch_inds, np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        bad = self.marked[rows, env_inds]
        if bad.any():
            stored = (self.pos - 1 - np.arange(self.size())) % self.buffer_size
            good_rows, good_envs = np.nonzero(~self.marked[stored])
            if len(good_rows) == 0:
                raise ValueError("All transitions in the replay buffer are marked as faulty: mend the environments.")
            drawn = np.random.randint(0, len(good_rows), size=int(bad.sum()))
            rows[bad], env_inds[bad] = stored[good_rows[drawn]], good_envs[drawn]
        self.last_sampled = rows, env_inds
        return transitions(self, rows, env_inds, env)

    def look_ahead(self, n_steps: int, gamma: float, env: VecNormalize | None = None) -> dict[str, th.Tensor]:
        """
        The n-step returns of the batch that was sampled last: the numbers of SB3's ``NStepReplayBuffer``.

        A sum ends with the episode and with the newest row, as SB3's does; it also ends before a marked transition, and
        where the stored stream breaks without an end (another ``learn()``, ``set_env``). It goes on to newer rows only,
        so that rows that were given up are in none.

        :param n_steps: Rewards per sum, at most
        :param gamma: Discount factor
        :param env: VecEnv to normalize the observations and rewards with
        :return: The fields ``n_step_*`` of ``Samples``, on ``device``
        """
        assert self.last_sampled is not None
        rows, env_inds = self.last_sampled
        steps = np.arange(n_steps, dtype=np.float32)
        window, envs = (rows[:, None] + np.arange(n_steps)) % self.buffer_size, env_inds[:, None]
        ends = (self.dones[window, envs] > 0) | (window == (self.pos - 1) % self.buffer_size)
        ends[:, :-1] |= self.marked[window[:, 1:], envs] | ~self._goes_on(window[:, :-1], window[:, 1:], envs)
        ends[:, -1] = True
        last = ends.argmax(axis=1)
        counted = steps <= last[:, None]
        rewards = self._normalize_reward(self.rewards[window, envs], env) * gamma**steps * counted
        final = (rows + last) % self.buffer_size, env_inds
        next_obs = self._normalize_obs(self._next_observations_at(*final), env)
        return {
            "n_step_rewards": self.to_torch(rewards.sum(axis=1, keepdims=True)),
            "n_step_next_observations": _to_torch(self, next_obs),
            "n_step_dones": self.to_torch((self.dones[final] * (1 - self.timeouts[final])).reshape(-1, 1)),
            "n_step_discounts": self.to_torch(gamma ** counted.sum(axis=1, keepdims=True).astype(np.float32)),
        }

    def _next_observations_at(self, rows: ndarray, env_inds: ndarray) -> Any:
        """The successors alone, of which a gather costs half of both, [n, *shape] or such by key."""
        return self.next_observations[rows, env_inds]

    def _goes_on(self, rows: ndarray, next_rows: ndarray, env_inds: ndarray) -> ndarray:
        """
        :param rows: Row positions, [B, n]
        :param next_rows: The rows after these, [B, n]
        :param env_inds: Environments, [B, 1]
        :return: Whether the next row begins with the observation that this one led to, bool [B, n]
        """
        same = self.next_observations[rows, env_inds] == self.observations[next_rows, env_inds]
        return same.reshape(*rows.shape, -1).all(axis=2)


class SkippingReplayBuffer(SkipsMarked):
    """
    SB3's ``ReplayBuffer``, which never samples marked transitions (see ``MARKS``).

    For SB3's algorithms on a ``FaultTolerantSubprocVecEnv``: ``SAC(..., replay_buffer_class=SkippingReplayBuffer)``.
    Without marks it returns the same batches as ``ReplayBuffer``, bit for bit.

    :param args: As of ``ReplayBuffer``
    :param kwargs: As of ``ReplayBuffer``
    :raises ValueError: If ``optimize_memory_usage`` is set
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage=True stores an observation as the next one of another transition, so none can "
                "be skipped: leave it False."
            )
        self.marked = np.zeros((self.buffer_size, self.n_envs), dtype=bool)

    def add(
        self, obs: ndarray, next_obs: ndarray, action: ndarray, reward: ndarray, done: ndarray, infos: Infos
    ) -> None:
        """
        Store one transition per environment; of a marked one nothing but the mark.

        :param obs: Observations, [n_envs, ...]
        :param next_obs: Successors, of the same shape
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment
        """
        row, marks = self.pos, self._mark(infos)
        super().add(obs, next_obs, action, reward, done, infos)
        for array in (self.observations, self.next_observations, self.actions, self.rewards):
            array[row, marks] = 0


class FrameStackReplayBuffer(SkipsMarked):
    """
    SB3's ``ReplayBuffer`` for stacks of uint8 images, in about a sixth of its memory (three stacked frames).

    Consecutive observations share all their frames but one, and so do an observation and its successor. The buffer
    keeps one ring of frames for all environments, and per transition the positions of its ``2 * frame_stack`` frames in
    that ring; stacks are rebuilt when they are sampled. With equal seeds and an equal stream it returns the same
    batches as ``ReplayBuffer``, bit for bit.

    Nothing is assumed about the stream: where an observation does not continue the stored one (after a reset,
    another ``learn()``, ``set_env`` or ``load``), its frames are stored anew. The ring has room for 4 % more frames
    than transitions, enough for episodes of 25 steps and more. Where streams break more often than that, the oldest
    rows (one row: the transitions of all environments at one time) are given up: they are never sampled, and
    ``size()`` does not count them.

    Marked transitions (see ``MARKS``) are never sampled, and nothing of them is kept.

    :param buffer_size: Max number of transitions, over all environments
    :param observation_space: uint8 ``Box`` of shape (frame_stack * c, height, width), oldest frame first
    :param action_space: Action space
    :param device: PyTorch device of the sampled tensors
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Ignored: frames are shared in any case
    :param handle_timeout_termination: Handle timeout termination (due to timelimit) separately and treat the task
        as an infinite horizon task
    :param frame_stack: Number of frames in one observation, which its number of channels cannot tell
    :param frames_dir: Keep the frames in an unnamed file in this directory, mapped into memory, instead of in memory:
        a million transitions of 84x84 take 22 GB. The last directory of the path is created if it is missing. The
        first ``add`` reserves the room on the disk (``OSError`` if there is too little)
    :raises ValueError: If the observation space is not made of ``frame_stack`` uint8 images, channels first
    """

    # Room for the one frame that an episode has more than steps. With the table of positions and the action this stays
    # below 1.05 frames per transition for images of 84x84.
    SPARE_FRAMES = 0.04
    # What has one entry per row: only the used part of these is pickled.
    _ROW_ARRAYS = ("frame_slots", "oldest_frame", "actions", "rewards", "dones", "timeouts", "marked")

    #: A new object with each sequence of frame numbers, which ``reset`` and every new buffer begin at 0
    frame_numbers: object

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        frame_stack: int,
        frames_dir: str | Path | None = None,
    ):
        # As SB3's DictReplayBuffer does: ReplayBuffer's constructor would allocate what this class avoids
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        _check_images(observation_space, frame_stack)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.frame_stack, self.frames_dir = frame_stack, frames_dir
        self.frame_shape = (self.obs_shape[0] // frame_stack, *self.obs_shape[1:])  # c, height, width
        # What one `add` may write: two whole stacks per environment. Before it does, rows are given up for that many
        # frames; so the ring has room for as many more, and for the row that it writes and the stack before it.
        self._max_frames_per_add = 2 * frame_stack * n_envs
        n_frames = math.ceil((1 + self.SPARE_FRAMES) * self.buffer_size * n_envs)
        self.frame_capacity = n_frames + 2 * self._max_frames_per_add + frame_stack * n_envs

        # Fresh zeros take no memory until they are written to. A file is reserved by the first `add`, so that a model
        # that is loaded to act needs none.
        rows = (self.buffer_size, n_envs)
        self.frames = np.zeros((self.frame_capacity if frames_dir is None else 0, *self.frame_shape), dtype=np.uint8)
        self.frame_slots = np.zeros((*rows, 2, frame_stack), dtype=np.int32)  # positions in `frames`; obs, next_obs
        self.oldest_frame = np.zeros(self.buffer_size, dtype=np.int64)  # number of the oldest frame that the row needs
        self.actions = np.zeros((*rows, self.action_dim), dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rewards, self.dones, self.timeouts = (np.zeros(rows, dtype=np.float32) for _ in range(3))
        self.marked = np.zeros(rows, dtype=bool)
        self._tails = np.zeros((n_envs, frame_stack), dtype=np.int64)
        self.reset()

        _warn_of_memory(self.nbytes)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays of the full buffer; the system commits them as they fill."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, ndarray))

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.frame_numbers = object()
        self._n_valid = 0  # rows that can be sampled: the latest ones before `pos`
        self._n_frames = 0  # frames ever stored; frame number i lies at `frames[i % frame_capacity]`
        # Per environment, the numbers of the frames of its last `next_obs`; -frame_capacity: none yet
        self._tails.fill(-self.frame_capacity)

    def size(self) -> int:
        """
        :return: Number of rows that can be sampled. Below SB3's value only where streams broke so often that the
            frames of the oldest rows had to be overwritten.
        """
        return self._n_valid

    def add(
        self, obs: ndarray, next_obs: ndarray, action: ndarray, reward: ndarray, done: ndarray, infos: Infos
    ) -> None:
        """
        Store one transition per environment. All inputs are copied.

        :param obs: Observations, uint8 [n_envs, frame_stack * c, height, width]
        :param next_obs: Successors of the same shape; of an episode's last step the terminal observation
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment; ``TimeLimit.truncated`` and marks are used
        :raises ValueError: If observations have another dtype or shape
        """
        self.reserve_frames()
        stacks, next_stacks = self._split(obs), self._split(next_obs)
        # The row at `pos` goes, and the oldest ones whose frames may be overwritten. Frame numbers never fall from row
        # to row, so those come first.
        self._n_valid = min(self._n_valid, self.buffer_size - 1)
        first_kept = self._n_frames + self._max_frames_per_add - self.frame_capacity
        while self._n_valid and self.oldest_frame[(self.pos - self._n_valid) % self.buffer_size] < first_kept:
            self._n_valid -= 1
        if self._n_valid < 0.9 * ((self.buffer_size if self.full else self.pos) - 1):
            warnings.warn(
                f"observations of shape {self.obs_shape} are seldom {self.frame_stack} frames of which the last "
                f"{self.frame_stack - 1} come again, so that frames fill their room before the replay buffer has "
                f"{self.buffer_size * self.n_envs} transitions, and older ones are lost: tell their number in "
                "replay_buffer_kwargs=dict(frame_stack=...), of dictionaries by key.",
                stacklevel=2,
            )

        oldest_frame, marks = self._n_frames, self._mark(infos)
        for i, (stack, next_stack) in enumerate(zip(stacks, next_stacks, strict=True)):
            if marks[i]:
                # What follows must not need older frames than this row, or it would outlive them
                self._tails[i] = -self.frame_capacity
                continue
            tail = self._tails[i]
            continues = tail[0] >= first_kept and np.array_equal(self.frames[tail % self.frame_capacity], stack)
            numbers = tail if continues else self._store_stack(stack)
            if np.array_equal(next_stack[:-1], stack[1:]):
                next_numbers = np.append(numbers[1:], self._store_frame(next_stack[-1]))
            else:
                next_numbers = self._store_stack(next_stack)
            self.frame_slots[self.pos, i] = np.stack((numbers, next_numbers)) % self.frame_capacity
            oldest_frame = min(oldest_frame, int(numbers[0]))
            self._tails[i] = next_numbers
        self.oldest_frame[self.pos] = oldest_frame

        self.actions[self.pos] = np.asarray(action).reshape((self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.actions[self.pos, marks] = self.rewards[self.pos, marks] = 0
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = [info.get("TimeLimit.truncated", False) for info in infos]

        self._n_valid += 1
        self.pos = (self.pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Sample uniformly, with replacement, from the valid rows and the environments.

        :param batch_size: Number of transitions to sample
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``, observations uint8 (unless ``env`` normalizes them)
        """
        return self._get_samples(self._draw_rows(batch_size), env=env)

    def observations_at(self, rows: ndarray, env_inds: ndarray) -> tuple[ndarray, ndarray]:
        """
        :param rows: Row positions, [n]
        :param env_inds: Environment of each, [n]
        :return: Observations, and their successors, [n, *shape] each
        :raises IndexError: If a row is empty, or its frames have been overwritten
        """
        both = self._gather(self.slots(rows, env_inds))  # at once
        return both[: len(rows)], both[len(rows) :]

    def _next_observations_at(self, rows: ndarray, env_inds: ndarray) -> ndarray:
        return self._gather(self.slots(rows, env_inds)[len(rows) * self.frame_stack :])

    def _gather(self, slots: th.Tensor) -> ndarray:
        """Stacks of the frames at these positions. `index_select` is threaded, unlike the fancy indexing of NumPy."""
        gathered: ndarray = th.from_numpy(self.frames).index_select(0, slots).view(-1, *self.obs_shape).numpy()
        return gathered

    def _goes_on(self, rows: ndarray, next_rows: ndarray, env_inds: ndarray) -> ndarray:
        # A stack that continues the stored one has its very frames.
        return (self.frame_slots[rows, env_inds, 1] == self.frame_slots[next_rows, env_inds, 0]).all(axis=2)

    def slots(self, rows: ndarray, env_inds: ndarray) -> th.Tensor:
        """
        :param rows: Row positions, [n]
        :param env_inds: Environment of each, [n]
        :return: Positions in ``frames``: of all observations, then of their successors, [2 * n * frame_stack]
        :raises IndexError: If a row is empty, or its frames have been overwritten
        """
        if np.any((self.pos - 1 - rows) % self.buffer_size >= self._n_valid):
            raise IndexError(f"Only the {self._n_valid} rows before pos={self.pos} hold transitions: use sample().")
        return th.from_numpy(self.frame_slots[rows, env_inds].swapaxes(0, 1).ravel())

    def reserve_frames(self) -> None:
        """Make the unnamed file for the frames, which ends with the array, if there is to be one and there is none."""
        if len(self.frames) > 0:
            return
        assert self.frames_dir is not None
        shape = (self.frame_capacity, *self.frame_shape)
        Path(self.frames_dir).mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=self.frames_dir) as file:
            # Reserved, because writing to a mapped file on a full disk kills the process
            if hasattr(os, "posix_fallocate"):  # not on macOS and Windows
                os.posix_fallocate(file.fileno(), 0, math.prod(shape))
            self.frames = np.memmap(file, dtype=np.uint8, mode="w+", shape=shape)

    def _split(self, obs: ndarray) -> ndarray:
        """Observations of all environments as single frames: uint8 [n_envs, frame_stack, c, height, width]."""
        obs = np.ascontiguousarray(obs)
        if obs.dtype != np.uint8 or obs.shape != (self.n_envs, *self.obs_shape):
            raise ValueError(
                f"Observations are {obs.dtype} of shape {obs.shape}, but this buffer stores uint8 of shape "
                f"{(self.n_envs, *self.obs_shape)}: pass those of all environments, unscaled."
            )
        return obs.reshape((self.n_envs, self.frame_stack, *self.frame_shape))

    def _store_stack(self, stack: ndarray) -> ndarray:
        """Store a stack that continues nothing, repeated frames (the first after a reset) once; returns numbers."""
        numbers = [self._store_frame(stack[0])]
        for previous, frame in itertools.pairwise(stack):
            numbers.append(numbers[-1] if np.array_equal(previous, frame) else self._store_frame(frame))
        return np.array(numbers, dtype=np.int64)

    def _store_frame(self, frame: ndarray) -> int:
        """Store one frame in place of the oldest one; returns its number."""
        self.frames[self._n_frames % self.frame_capacity] = frame
        self._n_frames += 1
        return self._n_frames - 1

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what has not been written to: a saved buffer is as large as its contents."""
        state = {name: value for name, value in vars(self).items() if name != "last_sampled"}
        n_rows = self.buffer_size if self.full else self.pos
        state |= {name: state[name][:n_rows] for name in self._ROW_ARRAYS}
        return {**state, "frames": np.asarray(self.frames[: self._n_frames])}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the full size of every array."""
        self.__dict__.update(state, frame_numbers=object())
        for name in self._ROW_ARRAYS:
            setattr(self, name, _grown(state[name], self.buffer_size))
        if self.frames_dir is None:
            self.frames = _grown(state["frames"], self.frame_capacity)
        elif len(state["frames"]) > 0:
            self.frames = state["frames"][:0]
            self.reserve_frames()
            self.frames[: len(state["frames"])] = state["frames"]


class DictFrameStackReplayBuffer(SkipsMarked):
    """
    SB3's ``DictReplayBuffer`` for images and vectors, in which a ``FrameStackReplayBuffer`` keeps the frames of each
    image once. With equal seeds and an equal stream it returns the same batches, bit for bit.

    Vectors are kept as SB3 does. Where the streams of an image break so often that its ring has to give up rows, these
    rows are given up for all keys. Marked transitions (see ``MARKS``) are never sampled.

    :param buffer_size: Max number of transitions, over all environments
    :param observation_space: Dictionary of which images are uint8 of shape (frames * c, height, width), oldest first
    :param action_space: Action space
    :param device: PyTorch device of the sampled tensors
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Ignored: frames are shared in any case
    :param handle_timeout_termination: Handle timeout termination (due to timelimit) separately and treat the task
        as an infinite horizon task
    :param frame_stack: Number of frames in an observation of each image: by key (of those that are not there: 1), or
        one number for all (1 where it does not divide the channels). Without stacks an image is stored once instead of
        twice
    :param frames_dir: As of ``FrameStackReplayBuffer``
    """

    observation_space: spaces.Dict
    observations: dict[str, ndarray]  # type: ignore[assignment]  # of the vectors
    next_observations: dict[str, ndarray]  # type: ignore[assignment]
    #: What all keys share: one entry per row
    _ROW_ARRAYS = ("actions", "rewards", "dones", "timeouts", "marked")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        *,
        frame_stack: int | Mapping[str, int] = 1,
        frames_dir: str | Path | None = None,
    ):
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        #: Frames of each image, by key
        self.images: dict[str, FrameStackReplayBuffer] = {}
        settings: dict[str, Any] = dict(handle_timeout_termination=handle_timeout_termination, frames_dir=frames_dir)
        for key, stack in stacks_by_key(observation_space, frame_stack).items():
            self.images[key] = FrameStackReplayBuffer(
                buffer_size, observation_space[key], action_space, device, n_envs, frame_stack=stack, **settings
            )
        rows = (self.buffer_size, n_envs)
        shapes: Any = self.obs_shape
        self.observations, self.next_observations = (
            {
                key: np.zeros((*rows, *shapes[key]), dtype=space.dtype)
                for key, space in observation_space.spaces.items()
                if key not in self.images
            }
            for _ in range(2)
        )
        self.actions = np.zeros((*rows, self.action_dim), dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rewards, self.dones, self.timeouts = (np.zeros(rows, dtype=np.float32) for _ in range(3))
        self.marked = np.zeros(rows, dtype=bool)
        self._share_rows()
        _warn_of_memory(self.nbytes)

    def _share_rows(self) -> None:
        """Actions and the like are there once, not once per image."""
        for image in self.images.values():
            vars(image).update({name: getattr(self, name) for name in self._ROW_ARRAYS})

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays of the full buffer; the system commits them as they fill."""
        shared = sum(getattr(self, name).nbytes for name in self._ROW_ARRAYS)
        vectors = [*self.observations.values(), *self.next_observations.values()]
        return sum(array.nbytes for array in vectors) + shared + sum(i.nbytes - shared for i in self.images.values())

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        for image in self.images.values():
            image.reset()

    def size(self) -> int:
        """
        :return: Number of rows that can be sampled
        """
        return min((image.size() for image in self.images.values()), default=super().size())

    def add(  # type: ignore[override]
        self,
        obs: dict[str, ndarray],
        next_obs: dict[str, ndarray],
        action: ndarray,
        reward: ndarray,
        done: ndarray,
        infos: Infos,
    ) -> None:
        """
        Store one transition per environment; of a marked one nothing but the mark. All inputs are copied.

        :param obs: Observations by key, [n_envs, ...] each
        :param next_obs: Successors of the same shapes; of an episode's last step the terminal observation
        :param action: Actions, [n_envs, ...]
        :param reward: Rewards, [n_envs]
        :param done: Whether the episode ended, [n_envs]
        :param infos: One dictionary per environment; ``TimeLimit.truncated`` and marks are used
        :raises ValueError: If images have another dtype or shape
        """
        row, marks = self.pos, self._mark(infos)
        for key, image in self.images.items():
            image.add(obs[key], next_obs[key], action, reward, done, infos)
        for arrays, new in ((self.observations, obs), (self.next_observations, next_obs)):
            for key, array in arrays.items():
                array[row] = np.asarray(new[key]).reshape(array[row].shape)
                array[row, marks] = 0
        self.actions[row] = np.asarray(action).reshape((self.n_envs, self.action_dim))
        self.rewards[row], self.dones[row] = reward, done
        self.actions[row, marks] = self.rewards[row, marks] = 0
        if self.handle_timeout_termination:
            self.timeouts[row] = [info.get("TimeLimit.truncated", False) for info in infos]
        self.pos = (self.pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples:
        """
        Sample uniformly, with replacement, from the valid rows and the environments.

        :param batch_size: Number of transitions to sample
        :param env: VecEnv to normalize the observations and rewards with
        :return: Batch on ``device``
        """
        return self._get_samples(self._draw_rows(batch_size), env=env)  # type: ignore[return-value]

    def observations_at(self, rows: ndarray, env_inds: ndarray) -> tuple[dict[str, ndarray], dict[str, ndarray]]:
        """
        :param rows: Row positions, [n]
        :param env_inds: Environment of each, [n]
        :return: Observations, and their successors, by key, [n, *shape] each
        :raises IndexError: If a row of an image is empty, or its frames have been overwritten
        """
        images = {key: image.observations_at(rows, env_inds) for key, image in self.images.items()}
        found: list[dict[str, ndarray]] = []
        for i, vectors in enumerate((self.observations, self.next_observations)):
            keys = self.observation_space.spaces
            found.append({k: images[k][i] if k in images else vectors[k][rows, env_inds] for k in keys})
        return found[0], found[1]

    def _next_observations_at(self, rows: ndarray, env_inds: ndarray) -> dict[str, ndarray]:
        images = {key: image._next_observations_at(rows, env_inds) for key, image in self.images.items()}
        vectors = {key: array[rows, env_inds] for key, array in self.next_observations.items()}
        return {key: (images if key in images else vectors)[key] for key in self.observation_space.spaces}

    def _goes_on(self, rows: ndarray, next_rows: ndarray, env_inds: ndarray) -> ndarray:
        goes_on = np.ones(rows.shape, dtype=bool)
        for image in self.images.values():
            goes_on &= image._goes_on(rows, next_rows, env_inds)
        for key, vectors in self.observations.items():
            same = self.next_observations[key][rows, env_inds] == vectors[next_rows, env_inds]
            goes_on &= same.reshape(*rows.shape, -1).all(axis=2)
        return goes_on

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what has not been written to: a saved buffer is as large as its contents."""
        state = {name: value for name, value in vars(self).items() if name != "last_sampled"}
        n_rows = self.buffer_size if self.full else self.pos
        state |= {name: state[name][:n_rows] for name in self._ROW_ARRAYS}
        return state | {name: rows_of(state[name], slice(n_rows)) for name in ("observations", "next_observations")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the full size of every array."""
        self.__dict__.update(state)
        for name in self._ROW_ARRAYS:
            setattr(self, name, _grown(state[name], self.buffer_size))
        for name in ("observations", "next_observations"):
            setattr(self, name, {key: _grown(array, self.buffer_size) for key, array in state[name].items()})
        self._share_rows()


def _warn_of_memory(nbytes: int) -> None:
    if psutil is not None and nbytes > (available := psutil.virtual_memory().available):
        warnings.warn(
            f"The full replay buffer needs {nbytes / 1e9:.2f} GB of memory, but {available / 1e9:.2f} GB are "
            "available: make buffer_size smaller, or keep the frames on a disk (frames_dir).",
            stacklevel=3,
        )


def _grown(array: ndarray, length: int) -> ndarray:
    """The array itself where it has the length, else a copy that is filled up with zeros."""
    if len(array) == length:
        return array
    grown = np.zeros((length, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown


def stacks_by_key(space: spaces.Dict, frame_stack: int | Mapping[str, int]) -> dict[str, int]:
    """
    :param space: Observations by key
    :param frame_stack: Frames in an observation of each image: by key (of those that are not there: 1), or one number
        for all (1 where it does not divide the channels)
    :return: The same by key, for each image
    """
    images = image_spaces(space)
    if isinstance(frame_stack, Mapping):
        return {key: frame_stack.get(key, 1) for key in images}
    return {key: 1 if image.shape[0] % frame_stack else frame_stack for key, image in images.items()}


def _check_images(space: spaces.Space, frame_stack: int) -> None:
    """Refuse observations whose frames would be cut wrongly, without an error."""
    if space.dtype != np.uint8 or len(space.shape or ()) != 3:
        problem = "use SB3's ReplayBuffer or DictReplayBuffer for anything else"
    elif space.shape[2] < min(space.shape[:2]):  # type: ignore[index]
        problem = "its channels come last, so wrap the environment in VecTransposeImage"
    elif space.shape[0] % frame_stack != 0:  # type: ignore[index]
        problem = f"frame_stack={frame_stack} does not divide its channels"
    else:
        return
    raise ValueError(
        f"FrameStackReplayBuffer stores uint8 images (frame_stack * c, height, width), not {space}: {problem}."
    )


def choose_replay_buffer(
    env: VecEnv | None, observation_space: spaces.Space, kwargs: dict[str, Any], plain: bool, skips: bool
) -> tuple[type[ReplayBuffer] | None, dict[str, Any]]:
    """The replay buffer where the user names none: of images one that keeps each frame once. Images that do not tell of
    how many frames they are count as one frame each.

    :param env: Environments, or None
    :param observation_space: Their observations, channels first
    :param kwargs: Arguments of the replay buffer that the user gave
    :param plain: Whether to keep to SB3's choice unless transitions may be marked
    :param skips: Whether transitions that are not finite will be marked
    :return: Class of the replay buffer (None: SB3's choice), and its arguments
    """
    may_be_marked = skips or restarts_workers(env)
    if isinstance(observation_space, spaces.Dict):
        if plain and not may_be_marked:
            return None, kwargs
        return DictFrameStackReplayBuffer, {"frame_stack": _stack_of(env) or 1, **kwargs}
    is_box = isinstance(observation_space, spaces.Box)
    if is_box and not plain and observation_space.dtype == np.uint8 and len(observation_space.shape) == 3:  # type: ignore[arg-type]
        return FrameStackReplayBuffer, {"frame_stack": _stack_of(env) or 1, **kwargs}
    return (SkippingReplayBuffer if may_be_marked or not plain else None), kwargs


def restarts_workers(env: VecEnv | None) -> bool:
    """
    :param env: Environments, or None
    :return: Whether they are worker processes that mark a transition in which one was restarted
    """
    return env is not None and getattr(env.unwrapped, "on_env_fault", None) == "restart"


def _stack_of(env: VecEnv | None) -> int | None:
    stacked = None if env is None else unwrap_vec_wrapper(env, VecFrameStack)
    if stacked is not None:
        return stacked.stacked_obs.n_stack  # its stacks slide, whatever the environments in it stack
    return None if env is None else told_frame_stack(env)


def told_frame_stack(env: VecEnv) -> int | None:
    """
    :param env: Environments, channels first
    :return: Frames per observation, as the environments tell in ``frame_stack`` (those of this package do); None where
        that cannot be meant
    """
    told: Any = env.get_attr("frame_stack")[0] if env.has_attr("frame_stack") else None
    shape = env.observation_space.shape or ()
    return int(told) if isinstance(told, int) and told > 0 and (len(shape) != 3 or shape[0] % told == 0) else None


def frame_stack_of(env: VecEnv) -> int:
    """
    :param env: Environments
    :return: Frames per observation, as they and SB3's ``VecFrameStack`` around them tell; 1 where nothing tells
    """
    stacked = unwrap_vec_wrapper(env, VecFrameStack)
    return (told_frame_stack(env) or 1) * (1 if stacked is None else stacked.stacked_obs.n_stack)
