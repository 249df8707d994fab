"""Callbacks for ``learn``: evaluation, videos, pictures and warnings.

All serve any SB3 algorithm (``DiagnosticsCallback``: any off-policy one), but for the SRL errors in them.
"""

import contextlib
import random
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.utils import obs_as_tensor, set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.cure.metrics import newest_frames
from sb3_cure.cure.policies import encoder_of
from sb3_cure.data.buffers import infer_frame_stack, stored_places, transitions
from sb3_cure.data.observations import by_key, image_spaces, len_of, rows_of
from sb3_cure.envs import physics_state, physics_state_names, physics_state_units
from sb3_cure.envs.physics import check_coordinates, telling_coordinates
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation import diagnostics
from sb3_cure.evaluation.result_files import write_csv
from sb3_cure.evaluation.rollouts import Episode, as_trained, evenly_measured, run_episodes, state_probe, trained_actors

__all__ = [
    "CuriosityMapCallback",
    "DiagnosticsCallback",
    "EvalBothCallback",
    "PeriodicCallback",
    "PolicyVideoCallback",
    "ReconstructionCallback",
    "RolloutCallback",
    "StateProbeCallback",
    "untouched_randomness",
]

#: Observations that ``ReconstructionCallback`` keeps where there is no replay buffer: 64 MB of three frames of 84 x 84
LATEST = 1000


class PeriodicCallback(BaseCallback):
    """
    Does something every so many agent steps: subclass it and implement ``on_period``.

    It is due whenever the number of agent steps reaches or passes a multiple of ``every``. The random streams of
    Python, NumPy and PyTorch are set aside meanwhile: watching a training does not change it.

    :param every: Agent steps between two calls (of all environments together)
    :param verbose: Verbosity level
    """

    def __init__(self, every: int, verbose: int = 0):
        super().__init__(verbose)
        self.every = every
        self._last_period = 0

    def _on_training_start(self) -> None:
        self._last_period = self.num_timesteps

    def _on_step(self) -> bool:
        due = self.num_timesteps // self.every > self._last_period // self.every
        self._last_period = self.num_timesteps
        if due:
            with untouched_randomness(self.model.device):
                self.on_period()
        return True

    def on_period(self) -> None:
        """What to do; ``self.model``, ``self.num_timesteps`` and ``self.logger`` are there, as in any callback."""
        raise NotImplementedError(f"{type(self).__name__} must implement on_period()")


@contextlib.contextmanager
def untouched_randomness(device: th.device, seed: int | None = None) -> Iterator[None]:
    """
    Set the random streams of Python, NumPy and PyTorch aside for a while.

    :param device: Device whose stream is meant, besides the CPU's
    :param seed: What they begin with meanwhile; None: they go on from where they are
    """
    python_state, numpy_state = random.getstate(), np.random.get_state()
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        try:
            if seed is not None:
                set_random_seed(seed)
            yield
        finally:
            random.setstate(python_state)
            np.random.set_state(numpy_state)


class RolloutCallback(PeriodicCallback):
    """
    Rolls out policies alone in an environment of its own every so many agent steps.

    :param eval_env: One (not vectorised) environment made as the training environment, not that one itself. Where
        SB3's ``VecFrameStack`` stacks frames for training, wrap it in
        ``sb3_cure.envs.StackFrames(env, n, padding="zeros")``
    :param every: Agent steps between two calls
    :param n_episodes: Episodes per policy
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of the first reset each time: all evaluations then start from the same states
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``; by default the policies that the model trains
    :param verbose: Verbosity level
    """

    def __init__(
        self,
        eval_env: gym.Env,
        every: int,
        n_episodes: int = 5,
        deterministic: bool = True,
        seed: int | None = None,
        actors: Sequence[str] | None = None,
        verbose: int = 0,
    ):
        super().__init__(every, verbose)
        self.eval_env, self.n_episodes = eval_env, n_episodes
        self.deterministic, self.seed = deterministic, seed
        self._chosen = actors
        #: Whom it rolls out in the call that runs
        self.actors: list[str] = []

    def _init_callback(self) -> None:
        """Refuse now what would end the training when the callback is due."""
        if isinstance(self.eval_env, VecEnv):
            raise ValueError(
                "eval_env is a VecEnv, but policies are rolled out in one environment: give a gymnasium.Env "
                "(sb3_cure.envs.StackFrames(env, n, padding='zeros') stacks frames as VecFrameStack does)."
            )
        model, space = self.model, self.eval_env.observation_space
        if self.eval_env.action_space != model.action_space or not _same_shapes(space, model.observation_space):
            raise ValueError(
                f"eval_env has {space} and {self.eval_env.action_space}, but the model was made for "
                f"{model.observation_space} and {model.action_space}: make it as the training environment."
            )
        trained = trained_actors(model)
        self.actors = trained if self._chosen is None else list(self._chosen)
        if not set(self.actors) <= {*trained, "random"}:
            raise ValueError(f"actors are {self.actors}, but this model has {', '.join([*trained, 'random'])}.")

    def run(self, actor: str, **kwargs: Any) -> Iterator[Episode]:
        """
        :param actor: Whose actions
        :param kwargs: Further arguments of ``run_episodes``
        :return: Episodes of this policy alone
        """
        arguments = dict(deterministic=self.deterministic, seed=self.seed, **kwargs)
        return run_episodes(self.model, self.eval_env, self.n_episodes, actor, **arguments)

    @property
    def _actions(self) -> str:
        return "deterministic actions" if self.deterministic else "sampled actions"


def _same_shapes(space: spaces.Space, trained: spaces.Space) -> bool:
    """Whether observations have the shapes of those of training, in which SB3 may have moved the channels of images to
    the front."""
    if isinstance(space, spaces.Dict) and isinstance(trained, spaces.Dict):
        same_keys = space.spaces.keys() == trained.spaces.keys()
        return same_keys and all(_same_shapes(space[key], trained[key]) for key in space.spaces)
    shape = space.shape
    return trained.shape in (shape, (shape[2], *shape[:2]) if shape is not None and len(shape) == 3 else shape)


class EvalBothCallback(RolloutCallback):
    """
    Evaluate the task policy and the curious policy in separate rollouts.

    Logs, for each of them, ``eval/<actor>_reward`` (mean return) and ``eval/<actor>_srl_error`` (mean noise-free SRL
    error per step). SB3's ``EvalCallback`` also works; it evaluates the task policy and keeps the best model.

    :param eval_env: One (not vectorised) environment, not the training one
    :param eval_freq: Agent steps between two evaluations
    :param n_episodes: Episodes per policy
    :param kwargs: ``deterministic``, ``seed``, ``actors``, ``verbose`` of ``RolloutCallback``; verbose=1 prints each
        evaluation
    """

    def __init__(self, eval_env: gym.Env, eval_freq: int = 1000, n_episodes: int = 5, **kwargs: Any):
        super().__init__(eval_env, eval_freq, n_episodes, **kwargs)
        #: One row per evaluation: agent steps and the logged values
        self.history: list[dict[str, float]] = []

    def on_period(self) -> None:
        """Evaluate."""
        self.evaluate()

    def evaluate(self) -> dict[str, float]:
        """
        Evaluate now.

        :return: Agent steps and the logged values
        """
        row: dict[str, float] = {}
        for actor in self.actors or ():
            results = [(episode.total_reward, episode.srl_errors) for episode in self.run(actor)]
            row[f"eval/{actor}_reward"] = float(np.mean([reward for reward, _ in results]))
            errors = np.concatenate([errors for _, errors in results])
            if len(errors) > 0:
                row[f"eval/{actor}_srl_error"] = float(errors.mean())
        for key, value in row.items():
            self.logger.record(key, value)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        row = {"timesteps": self.num_timesteps, **row}
        self.history.append(row)
        if self.verbose >= 1:
            print(", ".join(f"{key} {value:.4g}" for key, value in row.items()))
        return row


def _file(callback: BaseCallback, folder: Path, name: str) -> Path:
    """Where to write; the folder is made when the first file is written."""
    folder.mkdir(parents=True, exist_ok=True)
    if callback.verbose >= 1:
        print(f"{type(callback).__name__}: {folder / name}")
    return folder / name


class PolicyVideoCallback(RolloutCallback):
    """
    Film an episode of each policy: ``<actor>_policy_<steps>_steps.mp4``, steps being agent steps of training.

    Below the camera's picture stand the return so far and, where the model has an SRL head, the SRL error of the
    observation as a number and as a curve. Works with every SB3 algorithm.

    :param eval_env: One (not vectorised) environment made with ``render_mode="rgb_array"``, not the training one
    :param folder: Where to write
    :param every: Agent steps between two videos
    :param fps: Pictures per second, one per agent step; by default as the environment tells, else 30
    :param kwargs: ``actors``, ``deterministic``, ``seed``, ``verbose`` of ``RolloutCallback``; verbose=1 prints the
        name of each video
    :raises ValueError: if the environment does not render RGB frames
    :raises ImportError: if imageio is not installed
    """

    def __init__(self, eval_env: gym.Env, folder: str | Path, every: int = 5000, fps: int | None = None, **kwargs: Any):
        super().__init__(eval_env, every, n_episodes=1, **kwargs)
        if eval_env.render_mode != "rgb_array":
            raise ValueError(f"eval_env has render_mode={eval_env.render_mode!r}: make it with 'rgb_array'.")
        self.folder = Path(folder)
        self.fps = fps or max(round(eval_env.metadata.get("render_fps") or 30), 1)
        from sb3_cure.evaluation import video  # noqa: F401  (fail before training if a package is missing)

    def on_period(self) -> None:
        """Film an episode of each policy."""
        steps, repeat = self.num_timesteps, action_repeat_of(self.eval_env)
        for actor in self.actors or ():
            (episode,) = self.run(actor, render=True)
            path = _file(self, self.folder, f"{actor}_policy_{steps}_steps.mp4")
            title = f"{actor} policy, {self._actions}, after {steps:,} agent steps"
            from sb3_cure.evaluation import video

            video.write_video(path, episode, self.fps, repeat, title)


class ReconstructionCallback(PeriodicCallback):
    """
    Watch reconstructions become sharp: ``reconstructions.png`` has one row per time, of the same observations. Each
    image of dictionaries has a picture ``reconstructions_<key>.png``.

    Where neither head nor intrinsic reward draws, and for SB3's own algorithms, a decoder is fitted to the latents
    for each row, anew so that rows can be compared; the agent does not learn from it. It is fitted to what the replay
    buffer holds, or without one (PPO, A2C) to the latest ``LATEST`` observations. The file is rewritten with each row.

    :param folder: Where to write
    :param every: Agent steps between two rows
    :param observations: Images to reconstruct, uint8 [n, C, H, W], or dictionaries with such, by key; where the head
        itself draws, the first row is then that of the untrained model. By default ``columns`` of those that the
        decoder would be fitted to, spread over the time that they span when the first row is drawn
    :param columns: How many observations to take
    :param frame_stack: Frames per observation, of which the newest is shown; by default as the environment or
        ``VecFrameStack`` tells
    :param decoder_updates: Updates of the decoder for heads that do not draw; 0: only warn that the head does not draw
    :param max_rows: Where there are more times, rows are left out evenly
    :param verbose: 1 prints the file's name
    :param title: Put before the picture's title, such as the names of task and method
    :raises ValueError: if the model does not learn from images with an encoder, or from other images
    :raises ImportError: if matplotlib is not installed
    """

    def __init__(
        self,
        folder: str | Path,
        every: int = 5000,
        observations: np.ndarray | dict[str, np.ndarray] | None = None,
        columns: int = 8,
        frame_stack: int | None = None,
        decoder_updates: int = 500,
        max_rows: int = 12,
        verbose: int = 0,
        title: str = "",
    ):
        super().__init__(every, verbose)
        self.folder, self.observations, self.columns = Path(folder), observations, columns
        self.frame_stack, self.decoder_updates, self.max_rows = frame_stack, decoder_updates, max_rows
        self.title = title
        #: Agent steps and what was drawn then, the newest frames, uint8 [n, C, H, W], or such by key
        self.rows: list[tuple[int, Any]] = []
        self._latest: deque[np.ndarray] = deque(maxlen=LATEST)
        from sb3_cure.evaluation import plots  # noqa: F401  (fail before training if a package is missing)

    def _init_callback(self) -> None:
        space = self.model.observation_space
        if encoder_of(self.model.policy) is None or not image_spaces(space):
            raise ValueError(
                "ReconstructionCallback needs a policy of images of uint8, or of dictionaries with such: it draws from "
                "their latents."
            )
        if self.observations is not None:
            if isinstance(self.observations, np.ndarray) and self.observations.shape[1:] != space.shape:
                self.observations = maybe_transpose(self.observations, space)
            if not all(space.contains(rows_of(self.observations, i)) for i in range(len_of(self.observations))):
                raise ValueError(f"observations must be n of {space}, as the model learns from them.")

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.observations is not None and not self.rows and self.num_timesteps == 0:
            with untouched_randomness(self.model.device):
                self.on_period()

    def _on_step(self) -> bool:
        if self._buffer is None and self.decoder_updates > 0:
            # Not `new_obs` of the locals: the rollouts of third parties' algorithms may call it otherwise
            self._latest.extend(np.array(self.model._last_obs))
        return super()._on_step()

    def on_period(self) -> None:
        """Add a row."""
        model: Any = self.model
        model.policy.set_training_mode(False)
        if self.observations is None:
            self.observations = self._spread(self.columns)
        if len_of(self.observations) == 0:  # nothing good has been seen so far
            self.observations = None
            return
        observed = obs_as_tensor(as_trained(model, self.observations), model.device)
        keys = list(image_spaces(model.observation_space))
        title = "What the agent sees, and what its latents hold of it"
        reconstruct = getattr(model.policy, "reconstruct", lambda observations: None)
        with th.no_grad():
            pair = reconstruct(observed)
        if pair is None:
            if self.decoder_updates == 0:
                head = getattr(model.policy, "srl", None)
                warnings.warn(f"{type(head).__name__} does not reconstruct: give decoder_updates=500.", stacklevel=2)
            if self.decoder_updates == 0 or len_of(self._spread(1)) == 0:
                return
            title = "What a decoder fitted afterwards draws from the latents"
            from sb3_cure.evaluation import decoding

            decoders = [decoding.fit_decoder(model, self._sample, self.decoder_updates, key) for key in keys]
            pairs = [decoding.draw_latents(model, *each) for each in zip(decoders, repeat(observed), keys)]
            pair = tuple(dict(zip(keys, images, strict=True)) for images in zip(*pairs, strict=True))
        frame_stack = self.frame_stack or infer_frame_stack(self.training_env)
        seen, drawn = (
            {key: newest_frames(image, frame_stack).cpu().numpy() for key, image in images.items()}
            for images in map(by_key, pair)
        )
        self.rows.append((self.num_timesteps, drawn.get("", drawn)))
        shown = np.unique(np.linspace(0, len(self.rows) - 1, min(len(self.rows), self.max_rows)).round().astype(int))
        for key, images in seen.items():
            from sb3_cure.evaluation import plots

            plots.reconstructions_over_training(
                _file(self, self.folder, f"reconstructions_{key}.png" if key else "reconstructions.png"),
                images,
                [(steps, row[key] if key else row) for steps, row in (self.rows[index] for index in shown)],
                "\n".join(filter(None, (f"{title}: {key}" if key else title, self.title))),
            )

    def draw(self, model: BaseAlgorithm) -> None:
        """Add a row now, outside of a training.

        :param model: A model that has been trained, or loaded with a replay buffer
        """
        self.init_callback(model)
        self.num_timesteps = model.num_timesteps
        self.on_period()

    @property
    def _buffer(self) -> Any:
        return getattr(self.model, "replay_buffer", None)

    def _sample(self, n: int) -> Any:
        """Observations that the model has seen, at random, on its device, [n, *shape] or such by key."""
        if self._buffer is not None:
            return self._buffer.sample(n, env=self.model.get_vec_normalize_env()).observations
        chosen = np.random.randint(len(self._latest), size=n)
        return th.as_tensor(np.stack([self._latest[index] for index in chosen]), device=self.model.device)

    def _spread(self, n: int) -> Any:
        """Observations that the model has seen, spread over the time that they span, oldest first, [n, *shape] or such
        by key; [0] if it has seen none."""
        if self._buffer is None:
            kept = np.array(self._latest)
            return kept[np.linspace(0, len(kept) - 1, n if len(kept) else 0).round().astype(int)]
        rows, env_inds, _ = stored_places(self._buffer)
        chosen = np.linspace(len(rows) - 1, 0, n if len(rows) else 0).round().astype(int)
        found: Any = transitions(self._buffer, rows[chosen], env_inds[chosen]).observations
        return {k: v.cpu().numpy() for k, v in found.items()} if isinstance(found, dict) else found.cpu().numpy()


def _true_state(
    eval_env: gym.Env, state: Callable[[gym.Env], np.ndarray] | None, names: Sequence[str] | None
) -> tuple[Callable[[gym.Env], np.ndarray], list[str], list[str] | None]:
    """What tells the true state, its names and its units: what was given, or else dm_control's."""
    if (state is None) != (names is None):
        raise ValueError("state and names belong together: a function of the environment, and what it returns.")
    if state is None or names is None:
        return physics_state, physics_state_names(eval_env), physics_state_units(eval_env)
    return state, list(names), None


class CuriosityMapCallback(RolloutCallback):
    """
    Map where each policy goes and what SRL error it meets there: ``curiosity_map_<steps>_steps.png``.

    Each policy acts alone for some episodes; the map is drawn over two coordinates of the environment's true state,
    which the agent does not see. Without an SRL head only visits are drawn. CURL's error is measured against an even
    mix of what the policies see (``sb3_cure.evaluation.rollouts.even_negatives``).

    :param eval_env: One (not vectorised) environment, not the training one
    :param folder: Where to write
    :param every: Agent steps between two maps
    :param coordinates: Names of the two coordinates; by default two that suit the domain, or the first two
    :param state: Function of the environment that returns its true state, [d]; by default that of dm_control:
        positions and velocities of the joints, see ``sb3_cure.envs.physics_state``
    :param names: Names of what ``state`` returns, [d], to be given with it
    :param bins: Bins along each axis
    :param kwargs: ``actors``, ``n_episodes``, ``deterministic``, ``seed``, ``verbose`` of ``RolloutCallback``;
        verbose=1 prints the name of each map
    :raises ValueError: if a name is unknown, or the environment's state is
    :raises ImportError: if matplotlib is not installed
    """

    def __init__(
        self,
        eval_env: gym.Env,
        folder: str | Path,
        every: int = 5000,
        coordinates: tuple[str, str] | None = None,
        state: Callable[[gym.Env], np.ndarray] | None = None,
        names: Sequence[str] | None = None,
        bins: int = 24,
        **kwargs: Any,
    ):
        super().__init__(eval_env, every, **kwargs)
        self.folder, self.bins = Path(folder), bins
        self.state, self.names, self.units = _true_state(eval_env, state, names)
        self.coordinates = coordinates or telling_coordinates(self.names)
        check_coordinates(self.coordinates, self.names)
        #: By policy, the states of the last map, [n, d], and their SRL errors, [n]
        self.visits: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        from sb3_cure.evaluation import plots  # noqa: F401  (fail before training if a package is missing)

    def on_period(self) -> None:
        """Roll out each policy and draw."""
        self.visits = {}
        with evenly_measured(self.model, self.eval_env, self.seed):
            for actor in self.actors or ():
                pairs = [(episode.states, episode.srl_errors) for episode in self.run(actor, states=self.state)]
                states, errors = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
                self.visits[actor] = self._finite(actor, states, errors)
        if not any(len(states) for states, _ in self.visits.values()):
            return
        steps = self.num_timesteps
        from sb3_cure.evaluation import plots

        plots.curiosity_map(
            _file(self, self.folder, f"curiosity_map_{steps}_steps.png"),
            self.visits,
            self.names,
            f"Where policies go with {self._actions} after {steps:,} agent steps",
            coordinates=self.coordinates,
            units=self.units,
            bins=self.bins,
        )

    def _finite(self, actor: str, states: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Without the states that have no place on a map: that is no reason to end a training."""
        good = np.isfinite(states).all(axis=1)
        if not good.all():
            left_out = f"{np.count_nonzero(~good)} of {len(states)} states of the {actor} policy"
            warnings.warn(f"CuriosityMapCallback leaves out {left_out}, which are not finite.", stacklevel=2)
        return states[good], errors[good] if len(errors) else errors


class StateProbeCallback(RolloutCallback):
    """
    Measure what the latents tell of the true state, which the agent does not see: R² of each coordinate by a linear map
    (``sb3_cure.evaluation.rollouts.state_probe``).

    Logs ``probe/<name>`` and their mean ``probe/mean``, and writes ``state_probe.csv``, a row per time, and
    ``state_probe.png``, bars of the first and of the latest time. In a new training the first row is that of the
    untrained encoder. By default all rows are of the same episodes of random actions, so that they can be compared.

    :param eval_env: One (not vectorised) environment, not the training one
    :param folder: Where to write
    :param every: Agent steps between two rows
    :param n_episodes: Episodes per policy, two at least
    :param state: Function of the environment that returns its true state, [d]; by default that of dm_control:
        positions and velocities of the joints, see ``sb3_cure.envs.physics_state``
    :param names: Names of what ``state`` returns, [d], to be given with it; none of it is then taken for an angle
    :param seed: Seed of the first reset and of the random actions each time
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``, whose episodes are read together
    :param kwargs: ``deterministic``, ``verbose`` of ``RolloutCallback``; verbose=1 prints the names of the files
    :raises ValueError: if the environment's state is unknown, or ``state`` comes without ``names``
    :raises ImportError: if matplotlib is not installed
    """

    def __init__(
        self,
        eval_env: gym.Env,
        folder: str | Path,
        every: int = 5000,
        n_episodes: int = 10,
        state: Callable[[gym.Env], np.ndarray] | None = None,
        names: Sequence[str] | None = None,
        seed: int | None = 0,
        actors: Sequence[str] = ("random",),
        **kwargs: Any,
    ):
        super().__init__(eval_env, every, n_episodes, seed=seed, actors=actors, **kwargs)
        self.folder = Path(folder)
        self.state, self.names, self.units = _true_state(eval_env, state, names)
        #: One row per time: agent steps and R² by name
        self.rows: list[dict[str, float]] = []
        from sb3_cure.evaluation import plots  # noqa: F401  (fail before training if a package is missing)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if not self.rows and self.num_timesteps == 0:
            with untouched_randomness(self.model.device):
                self.on_period()

    def on_period(self) -> None:
        """Measure, log and draw."""
        episodes = (episode for actor in self.actors or () for episode in self.run(actor, states=self.state))
        found = state_probe(self.model, episodes, self.names, self.units)
        for name, value in {**found, "mean": float(np.nanmean(list(found.values())))}.items():
            self.logger.record(f"probe/{name}", value)
        self.rows.append({"timesteps": self.num_timesteps, **found})
        write_csv(_file(self, self.folder, "state_probe.csv"), list(self.rows[0]), self.rows)
        shown = {f"{row['timesteps']:,} agent steps": row for row in (self.rows[0], self.rows[-1])}
        from sb3_cure.evaluation import plots

        plots.state_probe_bars(
            _file(self, self.folder, "state_probe.png"),
            {label: {name: row[name] for name in self.names} for label, row in shown.items()},
            "What a linear map reads of the true state in the latents",
        )


class DiagnosticsCallback(PeriodicCallback):
    """
    Warns, once each, of what spoils training from pixels without an error.

    ========================  ============================================================================
    ``constant_image``        All recent observations of an environment are equal
    ``dead_units``            90 % of the ReLUs of a layer of the encoder never fire
    ``collapsed_latents``     The encoder's latents differ by less than 1 % of their size
    ``autoencoder``           Explains less than 1 % of the pixels' variance: no better than the mean image
    ``temperature``           Outside of its bounds, while the policy's entropy misses its target
    ``curious_reward``        Varies by less than 1 % of the entropy term
    ``software_rendering``    The CPU draws the frames although there is a GPU
    ========================  ============================================================================

    Works with every off-policy algorithm of SB3; what does not apply is left out. Each number is logged as
    ``diagnostics/<name>``; what they are and why the thresholds lie where they do: see
    ``sb3_cure.evaluation.diagnostics``.
    A look takes less time than one update with a batch of ``n_samples``.

    :param every: Agent steps between two looks
    :param n_samples: Observations of the replay buffer to look at
    :param min_updates: Updates before networks, temperatures and the curious reward are judged: in the first hundreds
        latents may collapse and come back
    :param autoencoder_updates: Updates before the autoencoder is judged: before a few thousand it is no better than
        the mean image in good runs either
    :param temperature_bounds: Least and greatest temperature that can still weigh entropy against reward
    :param verbose: 1 prints each look
    """

    def __init__(
        self,
        every: int = 1000,
        n_samples: int = 128,
        min_updates: int = 2000,
        autoencoder_updates: int = 5000,
        temperature_bounds: Sequence[float] = (1e-4, 1e2),
        verbose: int = 0,
    ):
        super().__init__(every, verbose)
        low, high = map(float, temperature_bounds)  # of texts, too, as YAML reads 1e-4
        self._arguments = n_samples, min_updates, autoencoder_updates, (low, high)
        #: What was warned of
        self.warned: list[str] = []
        self._rendering: list[diagnostics.Finding] = []

    def _on_training_start(self) -> None:
        super()._on_training_start()
        rendering = diagnostics.software_rendering(self.training_env)
        self._rendering = [] if rendering is None else [rendering]
        self._report(self._rendering)

    def on_period(self) -> None:
        """Look, log and warn."""
        findings = list(self._rendering)
        for finding in diagnostics.look(self.model, *self._arguments):
            if finding is not None:
                findings.append(finding)
                if finding.problem:
                    break
        self._report(findings)
        if self.verbose >= 1:
            print(", ".join(f"{finding.name} {finding.value:.3g}" for finding in findings))

    def _report(self, findings: Sequence[diagnostics.Finding]) -> None:
        for name, value, problem in findings:
            self.logger.record(f"diagnostics/{name}", float(value))
            if problem is not None and name not in self.warned:
                self.warned.append(name)
                warnings.warn(f"After {self.num_timesteps} agent steps: {problem}", stacklevel=2)
