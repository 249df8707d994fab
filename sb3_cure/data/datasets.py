"""Episodes on disk, recorded from an expert, from another agent, or from a robot that was steered by hand.

An episode of T steps is one ``.npz`` file of five arrays, named and shaped as Minari's ``EpisodeData``:
``observations`` [T + 1, ...] (one array per key of a dictionary, ``observations/<key>``), ``actions`` [T, ...],
``rewards``, ``terminations`` and ``truncations`` [T]. Observations and actions are those of the environment that the
agent is given: images unscaled, channels first or last. No file is unpickled.
"""

import copy
import itertools
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import maybe_transpose

from sb3_cure.data.observations import by_key, first_not_finite, rows_of, stacked

#: One array, or one for each key of a dictionary
Arrays = Any


class RecordedEpisode(NamedTuple):
    """An episode of T steps; anything with these attributes is read as well, such as Minari's ``EpisodeData``.

    :param observations: [T + 1, ...], or a dictionary of these
    :param actions: In the bounds of the action space, [T, ...]
    :param rewards: [T]
    :param terminations: [T]
    :param truncations: [T]
    """

    observations: Arrays
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray


def save_episode(path: str | Path, episode: RecordedEpisode) -> None:
    """Write an episode to a file, which appears only once it is complete.

    :param path: The ``.npz`` file to write
    :param episode: The episode
    """
    arrays = episode._asdict()
    if isinstance(episode.observations, dict):
        arrays |= {f"observations/{key}": array for key, array in arrays.pop("observations").items()}
    path = Path(path if str(path).endswith(".npz") else f"{path}.npz")  # as NumPy does
    draft = path.with_suffix(".part")
    with draft.open("wb") as file:
        np.savez_compressed(file, **arrays)
    draft.replace(path)


def load_episode(path: str | Path) -> RecordedEpisode:
    """Read an episode from a file.

    :param path: A ``.npz`` file
    :return: The episode
    """
    with np.load(path, allow_pickle=False) as file:
        parts = {name.partition("/")[2]: file[name] for name in file.files if name.startswith("observations/")}
        names = RecordedEpisode._fields[1:]
        return RecordedEpisode(parts or file["observations"], *(file[name] for name in names))


def episodes_of(source: str | Path | Iterable[Any]) -> Iterator[Any]:
    """Read episodes one after the other.

    :param source: A folder of ``.npz`` files, read in the order of their names, one such file, or episodes
    :return: The episodes
    :raises ValueError: If the folder has no such files
    """
    if not isinstance(source, str | Path):
        yield from source
        return
    paths = sorted(Path(source).glob("*.npz")) if Path(source).is_dir() else [Path(source)]
    if not paths:
        raise ValueError(f"{source} has no .npz files: write episodes with RecordEpisodes or save_episode.")
    yield from map(load_episode, paths)


class RecordEpisodes(gym.Wrapper, RecordConstructorArgs):
    """Write each episode of an environment into a folder, when it ends, or when the environment is reset or closed.

    :param env: The environment as the agent sees it
    :param folder: Folder for the files; it is made if it is missing
    """

    def __init__(self, env: gym.Env, folder: str | Path):
        RecordConstructorArgs.__init__(self, folder=str(folder))
        super().__init__(env)
        self.folder = str(folder)
        Path(folder).mkdir(parents=True, exist_ok=True)
        self._observations: list[Any] = []
        self._steps: list[Any] = []
        # Names sort in the order of recording, and differ between environments. A resumed run overwrites
        # the episodes that it plays again.
        self._number, self._token = len(list(Path(folder).glob("*.npz"))), uuid.uuid4().hex[:8]

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and write the episode before.

        :param kwargs: As in Gymnasium
        :return: The first observation and the info
        """
        self._write()
        observation, info = self.env.reset(**kwargs)
        self._observations = [copy.deepcopy(observation)]
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and record the step.

        :param action: The action
        :return: Observation, reward, terminated, truncated and info of the environment
        """
        taken = np.array(action)  # the environment may change it
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(copy.deepcopy(observation))
        self._steps.append([taken, float(reward), bool(terminated), bool(truncated)])
        if terminated or truncated:
            self._write()
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Write an unfinished episode and close the environment."""
        self._write()
        super().close()

    def _write(self) -> None:
        if self._steps:
            path = Path(self.folder, f"{self._number:06d}-{self._token}.npz")
            columns = map(np.array, zip(*self._steps, strict=True))
            save_episode(path, RecordedEpisode(stacked(self._observations), *columns))
            self._number += 1
        self._observations, self._steps = [], []


def fill(
    buffer: ReplayBuffer, source: str | Path | Iterable[Any], scale_action: Callable[[np.ndarray], np.ndarray]
) -> int:
    """Add episodes to a replay buffer as if its environments had collected them, side by side.

    An environment for which no episode is left repeats the first episodes until the others have finished theirs.

    :param buffer: A replay buffer
    :param source: As for ``episodes_of``
    :param scale_action: Scales actions to [-1, 1], as they are stored
    :return: Number of transitions in the episodes
    :raises ValueError: If episodes do not fit the spaces
    """
    if isinstance(source, Iterator) and buffer.n_envs > 1:
        source = list(source)
    left, again = episodes_of(source), itertools.chain.from_iterable(episodes_of(source) for _ in itertools.count())
    n_added, n_rows = 0, 0
    # Each environment takes the next episode that is left.
    lanes = [_transitions(left, buffer, scale_action) for _ in range(buffer.n_envs)]
    fillers = [_transitions(again, buffer, scale_action) for _ in range(buffer.n_envs)]
    for row in itertools.zip_longest(*lanes):
        n_rows, n_added = n_rows + 1, n_added + sum(each is not None for each in row)
        whole = [each or next(filler) for each, filler in zip(row, fillers, strict=True)]
        obs, next_obs, actions, rewards, dones, infos = zip(*whole, strict=True)
        columns: Any = (stacked(obs), stacked(next_obs), *map(np.array, (actions, rewards, dones)), list(infos))
        buffer.add(*columns)
    if n_rows > buffer.buffer_size:
        side_by_side = f" (those of {buffer.n_envs} environments side by side)" if buffer.n_envs > 1 else ""
        warnings.warn(
            f"the episodes have {n_added} transitions in {n_rows} rows{side_by_side}, but the replay buffer keeps the "
            f"last {buffer.buffer_size} rows: make buffer_size larger.",
            stacklevel=3,
        )
    return n_added


def _transitions(source: Iterator[Any], buffer: ReplayBuffer, scale_action: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Transitions of the remaining episodes, as ``add`` takes them; an episode without an end is truncated."""
    for episode in source:
        observations = _as_stored(episode.observations, buffer.observation_space)
        lengths = {name: len(getattr(episode, name)) for name in RecordedEpisode._fields[1:]}
        lengths |= {name or "observations": len(each) - 1 for name, each in by_key(observations).items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(
                "an episode of T steps has T actions, rewards, terminations and truncations, and T + 1 observations, "
                f"but in one T is {', '.join(f'{length} ({name})' for name, length in lengths.items())}."
            )
        if np.logical_or(episode.terminations, episode.truncations)[:-1].any():
            raise ValueError("an episode ends before its last step: split the recording, or values cross the boundary.")
        actions = scale_action(np.asarray(episode.actions))
        if actions.shape[1:] != buffer.action_space.shape or not (np.abs(actions) <= 1 + 1e-6).all():
            raise ValueError(
                f"actions of an episode, of shape {actions.shape[1:]}, are not within {buffer.action_space}: "
                "record them as the environment takes them."
            )
        if first_not_finite(observations) or first_not_finite(np.asarray(episode.rewards, np.float64)):
            raise ValueError("an episode has observations or rewards that are not finite in float32: leave it out.")
        for t, reward in enumerate(episode.rewards):
            terminated = bool(episode.terminations[t])
            done = terminated or bool(episode.truncations[t]) or t + 1 == len(actions)
            info = {"TimeLimit.truncated": done and not terminated}
            yield rows_of(observations, t), rows_of(observations, t + 1), actions[t], float(reward), done, info


def _as_stored(observations: Arrays, space: spaces.Space) -> Arrays:
    """Observations with their channels first; refuse those of another space."""
    if isinstance(space, spaces.Dict):
        return {key: _as_stored(observations[key], part) for key, part in space.spaces.items()}
    array = np.asarray(observations)
    array = maybe_transpose(array, space) if array.ndim == 1 + len(space.shape or ()) else array
    if array.shape[1:] != space.shape or (space.dtype == np.uint8) != (array.dtype == np.uint8):
        raise ValueError(
            f"observations of an episode are {array.dtype} of shape {array.shape[1:]}, but the model sees {space}: "
            "record them from an environment in the same wrappers."
        )
    return array
