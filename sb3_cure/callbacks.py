"""Callbacks for ``learn``: evaluation, videos, pictures and warnings. All serve any SB3 algorithm (warnings: any
off-policy one), but for the SRL errors in them."""

import contextlib
import importlib
import random
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, maybe_transpose
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, unwrap_vec_wrapper

from sb3_cure import diagnostics
from sb3_cure.buffers import transitions, unmarked
from sb3_cure.checkpoint import ExactCheckpoint as ExactCheckpoint
from sb3_cure.envs import physics_state, physics_state_names, physics_state_units
from sb3_cure.envs.physics import check_coordinates, telling_coordinates
from sb3_cure.envs.wrappers import action_repeat_of, check_frame
from sb3_cure.evaluation import ACTORS, evenly_measured, run_episodes, trained_actors
from sb3_cure.metrics import frame_stack_of, newest_frames
from sb3_cure.policies import encoder_of
from sb3_cure.values import check_folder, is_integer, is_number


class PeriodicCallback(BaseCallback):
    """Does something every so many agent steps: subclass it and implement ``on_period``.

    It is due whenever the number of agent steps reaches or passes a multiple of ``every``. The random streams of
    Python, NumPy and PyTorch are set aside meanwhile: watching a training does not change it.

    :param every: Agent steps between two calls (of all environments together)
    :param verbose: Verbosity level
    :raises ValueError: if ``every`` is below 1
    """

    def __init__(self, every: int, verbose: int = 0):
        super().__init__(verbose)
        if not is_integer(every, 1):
            raise ValueError(
                f"{type(self).__name__} got every={every!r}, but it counts agent steps: give a whole number >= 1."
            )
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
    """Set the random streams of Python, NumPy and PyTorch aside for a while.

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


class EvalBothCallback(PeriodicCallback):
    """Evaluate the task policy and the curious policy in separate rollouts.

    Logs, for each of them, ``eval/<actor>_reward`` (mean return) and ``eval/<actor>_srl_error`` (mean noise-free SRL
    error per step). SB3's ``EvalCallback`` also works; it evaluates the task policy and keeps the best model.

    :param eval_env: One (not vectorised) environment, not the training one
    :param eval_freq: Agent steps between two evaluations
    :param n_episodes: Episodes per policy
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of every evaluation's first reset: all evaluations then start from the same states
    :param verbose: 1 prints each evaluation
    :raises ValueError: if ``eval_freq`` or ``n_episodes`` is below 1
    """

    def __init__(
        self,
        eval_env: gym.Env,
        eval_freq: int = 1000,
        n_episodes: int = 5,
        deterministic: bool = True,
        seed: int | None = None,
        verbose: int = 0,
    ):
        if not (is_integer(eval_freq, 1) and is_integer(n_episodes, 1)):
            raise ValueError(
                f"EvalBothCallback got eval_freq={eval_freq!r} and n_episodes={n_episodes!r}, but each must be at "
                "least 1: give whole numbers >= 1."
            )
        super().__init__(eval_freq, verbose)
        _check_env("EvalBothCallback", eval_env)
        self.eval_env = eval_env
        self.eval_freq = eval_freq
        self.n_episodes = n_episodes
        self.deterministic = deterministic
        self.seed = _check_seed("EvalBothCallback", seed)
        #: One row per evaluation: agent steps and the logged values
        self.history: list[dict[str, float]] = []

    def _init_callback(self) -> None:
        _check_spaces("EvalBothCallback", self.eval_env, self.model)

    def on_period(self) -> None:
        """Evaluate."""
        self.evaluate()

    def evaluate(self) -> dict[str, float]:
        """Evaluate now.

        :return: Agent steps and the logged values
        """
        row: dict[str, float] = {"timesteps": self.num_timesteps}
        for actor in trained_actors(self.model):  # type: ignore[arg-type]
            episodes = run_episodes(
                self.model,  # type: ignore[arg-type]
                self.eval_env,
                self.n_episodes,
                actor,
                deterministic=self.deterministic,
                seed=self.seed,
            )
            results = [(episode.total_reward, episode.srl_errors) for episode in episodes]
            row[f"eval/{actor}_reward"] = float(np.mean([reward for reward, _ in results]))
            errors = np.concatenate([errors for _, errors in results])
            if len(errors) > 0:
                row[f"eval/{actor}_srl_error"] = float(errors.mean())
        self.history.append(row)
        for key, value in row.items():
            if key != "timesteps":
                self.logger.record(key, value)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if self.verbose >= 1:
            print(", ".join(f"{key} {value:.4g}" for key, value in row.items()))
        return row


class _PictureCallback(PeriodicCallback):
    """Writes files into a folder, which is made when the first one is written.

    :param folder: Where to write
    :param every: Agent steps between two files
    :param room: The module of ``sb3_cure.experiments`` that draws, which needs the packages of ``sb3-cure[demo]``
    :param verbose: 1 prints the name of each file
    """

    def __init__(self, folder: str | Path, every: int, room: str, verbose: int):
        super().__init__(every, verbose)
        check_folder("folder", folder)
        self.folder = Path(folder)
        self._import_room(room)

    def _import_room(self, room: str) -> Any:
        """Drawing packages are imported only for drawing; that one is missing is said before training starts."""
        try:
            return importlib.import_module(f"sb3_cure.experiments.{room}")
        except ModuleNotFoundError as missing:
            raise ImportError(
                f"{type(self).__name__} needs the package {missing.name}, which is not installed: run "
                "`pip install 'sb3-cure[demo]'`."
            ) from missing

    def _path(self, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / name
        if self.verbose >= 1:
            print(f"{type(self).__name__}: {path}")
        return path

    def _check_actors(self, actors: Sequence[str] | None) -> list[str]:
        """The actors asked for, or all that are trained, when the model is known."""
        trained = trained_actors(self.model)  # type: ignore[arg-type]
        asked: list[Any] = list(actors or trained) if isinstance(actors, list | tuple | None) else [actors]
        wrong = [actor for actor in asked if actor not in (*trained, "random")]
        if wrong:
            raise ValueError(
                f"{type(self).__name__} got actors={actors!r}, but of {', '.join(map(repr, ACTORS))} this model has "
                f"{', '.join(map(repr, (*trained, 'random')))}: choose of these."
            )
        return asked


def _actions(deterministic: bool) -> str:
    return "deterministic actions" if deterministic else "sampled actions"


def _check_seed(user: str, seed: Any) -> int | None:
    if seed is not None and not is_integer(seed, 0):
        raise ValueError(f"{user} got seed={seed!r}, but it must be None or a whole number >= 0: change seed.")
    return None if seed is None else int(seed)


def _check_spaces(user: str, eval_env: gym.Env, model: BaseAlgorithm) -> None:
    """Else the first evaluation would end the training."""
    observations, actions = eval_env.observation_space, eval_env.action_space
    shape = observations.shape or ()
    # Of images SB3 may have moved the channels to the front.
    moved = (shape[2], *shape[:2]) if len(shape) == 3 else shape
    if actions != model.action_space or (model.observation_space.shape or ()) not in (shape, moved):
        stacked = None if model.env is None else unwrap_vec_wrapper(model.env, VecFrameStack)
        how = f", in sb3_cure.envs.StackFrames(env, {stacked.stacked_obs.n_stack})" if stacked else ""
        raise ValueError(
            f"{user} got an eval_env with observations {observations} and actions {actions}, but the model was made "
            f"for {model.observation_space} and {model.action_space}: make eval_env as the training environment{how}."
        )


def _check_env(user: str, eval_env: gym.Env) -> None:
    if isinstance(eval_env, VecEnv) or not isinstance(eval_env, gym.Env):
        raise ValueError(
            f"{user} got eval_env={eval_env!r}, but it watches one environment at a time: give one gymnasium.Env with "
            "the observations of training."
        )


class PolicyVideoCallback(_PictureCallback):
    """Film an episode of each policy: ``<actor>_policy_<steps>_steps.mp4``, steps being agent steps of training.

    Below the camera's picture stand the return so far and, where the model has an SRL head, the SRL error of the
    observation as a number and as a curve. Works with every SB3 algorithm.

    :param eval_env: One (not vectorised) environment made with ``render_mode="rgb_array"``, not the training one
    :param folder: Where to write
    :param every: Agent steps between two videos
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``; by default the policies that the model trains
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of every reset: all videos then start from the same state
    :param fps: Pictures per second, one per agent step; by default as the environment tells, else 30
    :param verbose: 1 prints the name of each video
    :raises ValueError: if an argument is out of range, or the environment does not render RGB frames
    :raises ImportError: if imageio is not installed
    """

    def __init__(
        self,
        eval_env: gym.Env,
        folder: str | Path,
        every: int = 5000,
        actors: Sequence[str] | None = None,
        deterministic: bool = True,
        seed: int | None = None,
        fps: int | None = None,
        verbose: int = 0,
    ):
        super().__init__(folder, every, "video", verbose)
        _check_env("PolicyVideoCallback", eval_env)
        if eval_env.render_mode != "rgb_array":
            raise ValueError(
                f"PolicyVideoCallback got an environment with render_mode={eval_env.render_mode!r}, which gives no "
                "frames: make it with render_mode='rgb_array'."
            )
        if fps is not None and not is_number(fps, low=1):
            raise ValueError(f"PolicyVideoCallback got fps={fps!r}, but a video needs at least 1: give a number >= 1.")
        self.eval_env = eval_env
        self.actors = actors
        self.deterministic = deterministic
        self.seed = _check_seed("PolicyVideoCallback", seed)
        self.fps = fps or max(round(eval_env.metadata.get("render_fps") or 30), 1)

    def _init_callback(self) -> None:
        self._check_actors(self.actors)
        _check_spaces("PolicyVideoCallback", self.eval_env, self.model)
        with untouched_randomness(self.model.device):
            self.eval_env.reset(seed=self.seed)
            check_frame(self.eval_env.render(), self.eval_env)  # rather than when the first video is due

    def on_period(self) -> None:
        """Film an episode of each policy."""
        video = self._import_room("video")
        env, steps = self.eval_env, self.num_timesteps
        repeat = action_repeat_of(env)
        for actor in self._check_actors(self.actors):
            (episode,) = run_episodes(
                self.model,  # type: ignore[arg-type]
                env,
                1,
                actor,
                deterministic=self.deterministic,
                seed=self.seed,
                render=True,
            )
            path = self._path(f"{actor}_policy_{steps}_steps.mp4")
            title = f"{actor} policy, {_actions(self.deterministic)}, after {steps:,} agent steps"
            video.write_video(path, episode, self.fps, repeat, title)


#: Observations that ``ReconstructionCallback`` keeps where there is no replay buffer: 64 MB of three frames of 84 x 84
LATEST = 1000


class ReconstructionCallback(_PictureCallback):
    """Watch reconstructions become sharp: ``reconstructions.png`` has one row per time, of the same observations.

    For heads that do not draw (contrastive ones, say), and for SB3's own algorithms, a decoder is fitted to the latents
    for each row, anew so that rows can be compared; the agent does not learn from it. It is fitted to what the replay
    buffer holds, or without one (PPO, A2C) to the latest ``LATEST`` observations. The file is rewritten with each row.

    :param folder: Where to write
    :param every: Agent steps between two rows
    :param observations: Images to reconstruct, uint8 [n, C, H, W]; where the head itself draws, the first row is then
        that of the untrained model. By default ``columns`` of those that the decoder would be fitted to, spread over
        the time that they span when the first row is drawn
    :param columns: How many observations to take
    :param frame_stack: Frames per observation, of which the newest is shown; by default as the environment or
        ``VecFrameStack`` tells
    :param probe_updates: Updates of the decoder for heads that do not draw; 0: say once that the head does not draw
    :param max_rows: Where there are more times, rows are left out evenly
    :param verbose: 1 prints the file's name
    :param title: Put before the picture's title, such as the names of task and method
    :raises ValueError: if an argument is out of range, or the model does not learn from images with an encoder
    :raises ImportError: if matplotlib is not installed
    """

    def __init__(
        self,
        folder: str | Path,
        every: int = 5000,
        observations: np.ndarray | None = None,
        columns: int = 8,
        frame_stack: int | None = None,
        probe_updates: int = 500,
        max_rows: int = 12,
        verbose: int = 0,
        title: str = "",
    ):
        super().__init__(folder, every, "plots", verbose)
        if not (is_integer(columns, 1) and is_integer(probe_updates, 0) and is_integer(max_rows, 2)):
            raise ValueError(
                f"ReconstructionCallback got columns={columns!r}, probe_updates={probe_updates!r} and "
                f"max_rows={max_rows!r}, but they must be whole numbers of at least 1, 0 and 2: change them."
            )
        if observations is not None and getattr(observations, "dtype", None) != np.uint8:
            raise ValueError(
                f"ReconstructionCallback got observations of {getattr(observations, 'dtype', type(observations))}, but "
                "it draws images of uint8: give them as the environment returns them, stacked."
            )
        if frame_stack is not None and not is_integer(frame_stack, 1):
            raise ValueError(
                f"ReconstructionCallback got frame_stack={frame_stack!r}, but it counts frames: give a number >= 1."
            )
        self.observations = observations
        self.columns = columns
        self.frame_stack = frame_stack
        self.probe_updates = probe_updates
        self.max_rows = max_rows
        self.title = title
        #: Agent steps and what was drawn then, the newest frames, uint8 [n, C, H, W]
        self.rows: list[tuple[int, np.ndarray]] = []
        self._said = False
        self._latest: deque[np.ndarray] = deque(maxlen=LATEST)

    def _init_callback(self) -> None:
        space = self.model.observation_space
        if encoder_of(self.model.policy) is None or not is_image_space(space):
            raise ValueError(
                f"ReconstructionCallback got a {type(self.model).__name__} that learns from {space} by "
                f"{type(self.model.policy).__name__}, but it draws images of uint8 from an encoder's latents: use it "
                "with 'CnnPolicy', where observations are such images."
            )
        if self.observations is None:
            return
        if self.observations.ndim == 4:
            self.observations = maybe_transpose(self.observations, space)
        if self.observations.shape[1:] != space.shape:
            raise ValueError(
                f"ReconstructionCallback got observations of shape {self.observations.shape}, but the model learns "
                f"from {space.shape}: give them as [n, *{space.shape}]."
            )

    def _on_training_start(self) -> None:
        super()._on_training_start()
        # A resumed training has had its first row, or nothing to fit a decoder to.
        run = getattr(self.model, "_run", None)
        resumed = run is not None and run.resumed is not None
        if self.observations is not None and not self.rows and not resumed:
            with untouched_randomness(self.model.device):
                self.on_period()

    def _on_step(self) -> bool:
        if self._buffer is None and self.probe_updates > 0:
            # Not `new_obs` of the locals: the rollouts of third parties' algorithms may call it otherwise.
            self._latest.extend(np.array(self.model._last_obs))
        return super()._on_step()

    def on_period(self) -> None:
        """Add a row."""
        model: Any = self.model
        model.policy.set_training_mode(False)
        if self.observations is None:
            if not self._has_seen_any():
                return
            self.observations = self._spread(self.columns)
            if self.observations is None:
                return
        observed = th.as_tensor(self.observations, device=model.device)
        head = getattr(model.policy, "srl", None)
        with th.no_grad():
            drawn = None if head is None else head.reconstruct(model.policy.encode(observed))
        title = "Reconstructions over training"
        if drawn is None:
            if self.probe_updates == 0:
                self._say_once_that_nothing_is_drawn()
                return
            if not self._has_seen_any():  # nothing to fit a decoder to before the first steps
                return
            probe = self._import_room("probe")
            decoder = probe.fit_probe(model, self._sample, self.probe_updates)
            observed, drawn = probe.draw_with_probe(model, decoder, observed)
            title = "What a decoder fitted afterwards draws from the latents"
        frame_stack = self.frame_stack or frame_stack_of(self.training_env)
        self.rows.append((self.num_timesteps, newest_frames(drawn, frame_stack).cpu().numpy()))
        shown = np.unique(np.linspace(0, len(self.rows) - 1, min(len(self.rows), self.max_rows)).round().astype(int))
        self._import_room("plots").reconstructions_over_training(
            self._path("reconstructions.png"),
            newest_frames(observed, frame_stack).cpu().numpy(),
            [self.rows[index] for index in shown],
            f"{title}\n{self.title}" if self.title else title,
        )

    def draw(self, model: BaseAlgorithm) -> None:
        """Add a row now, outside of a training.

        :param model: A model that has been trained, or loaded with a replay buffer
        """
        self.init_callback(model)
        self.num_timesteps = model.num_timesteps
        self.on_period()

    @property
    def _buffer(self) -> ReplayBuffer | None:
        return getattr(self.model, "replay_buffer", None)

    def _has_seen_any(self) -> bool:
        return len(self._latest) > 0 if self._buffer is None else self._buffer.size() > 0

    def _sample(self, n: int) -> th.Tensor:
        """Observations that the model has seen, at random, on its device, [n, *shape]."""
        if self._buffer is not None:
            return self._buffer.sample(n).observations
        chosen = np.random.randint(len(self._latest), size=n)
        return th.as_tensor(np.stack([self._latest[index] for index in chosen]), device=self.model.device)

    def _spread(self, n: int) -> np.ndarray | None:
        """Observations that the model has seen, spread over the time that they span, oldest first, [n, *shape]; None if
        none of them was good."""
        if self._buffer is not None:
            return _spread_over(self._buffer, n)
        chosen = np.linspace(0, len(self._latest) - 1, n).round().astype(int)
        return np.stack([self._latest[index] for index in chosen])

    def _say_once_that_nothing_is_drawn(self) -> None:
        if not self._said:
            self._said = True
            head = getattr(self.model.policy, "srl", None)
            who = type(self.model).__name__ if head is None else f"the head {type(head).__name__}"
            warnings.warn(
                f"ReconstructionCallback draws nothing: {who} does not reconstruct and probe_updates is 0; give "
                "probe_updates=500 to fit a decoder to the latents.",
                stacklevel=2,
            )


def _spread_over(buffer: ReplayBuffer, n: int) -> np.ndarray | None:
    """Observations of the first environment with good ones in the replay buffer, spread over the time that they
    span, oldest first, [n, *shape]; None where there is none."""
    latest = (buffer.pos - 1 - np.arange(buffer.size())) % buffer.buffer_size
    for env in range(buffer.n_envs):
        rows = latest[unmarked(buffer, latest, np.full(len(latest), env))]
        if len(rows):
            rows = rows[np.linspace(len(rows) - 1, 0, n).round().astype(int)]
            return transitions(buffer, rows, np.full(n, env)).observations.cpu().numpy()
    return None


class CuriosityMapCallback(_PictureCallback):
    """Map where each policy goes and what SRL error it meets there: ``curiosity_map_<steps>_steps.png``.

    Each policy acts alone for some episodes; the map is drawn over two coordinates of the environment's true state,
    which the agent does not see. Without an SRL head only visits are drawn. CURL's error is measured against an even
    mix of what the policies see (``sb3_cure.evaluation.even_negatives``).

    :param eval_env: One (not vectorised) environment, not the training one
    :param folder: Where to write
    :param every: Agent steps between two maps
    :param coordinates: Names of the two coordinates; by default two that suit the domain, or the first two
    :param state: Function of the environment that returns its true state, [d]; by default that of dm_control:
        positions and velocities of the joints, see ``sb3_cure.envs.physics_state``
    :param names: Names of what ``state`` returns, [d], to be given with it
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``; by default the policies that the model trains
    :param n_episodes: Episodes per policy
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of every map's first reset: all maps then start from the same states
    :param bins: Bins along each axis
    :param verbose: 1 prints the name of each map
    :raises ValueError: if an argument is out of range, a name unknown, or the environment's state is
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
        actors: Sequence[str] | None = None,
        n_episodes: int = 5,
        deterministic: bool = True,
        seed: int | None = None,
        bins: int = 24,
        verbose: int = 0,
    ):
        super().__init__(folder, every, "plots", verbose)
        _check_env("CuriosityMapCallback", eval_env)
        if not (is_integer(n_episodes, 1) and is_integer(bins, 1)):
            raise ValueError(
                f"CuriosityMapCallback got n_episodes={n_episodes!r} and bins={bins!r}, but each must be at least "
                "1: give whole numbers >= 1."
            )
        if (state is None) != (names is None):
            given, missing = ("names", "state") if state is None else ("state", "names")
            raise ValueError(
                f"CuriosityMapCallback got {given} without {missing}, but a state of your own needs both: a function "
                "of the environment and the names of what it returns."
            )
        if state is not None and not callable(state):
            raise ValueError(
                f"CuriosityMapCallback got state={state!r}, but it must be a function of the environment that returns "
                "its true state: give one, or leave it out for tasks of dm_control."
            )
        self.state = state or physics_state
        self.names = list(physics_state_names(eval_env) if names is None else names)
        self.units = physics_state_units(eval_env) if names is None else None
        self.coordinates = coordinates or telling_coordinates(self.names)
        check_coordinates(self.coordinates, self.names)
        self.eval_env = eval_env
        self.actors = actors
        self.n_episodes = n_episodes
        self.deterministic = deterministic
        self.seed = _check_seed("CuriosityMapCallback", seed)
        self.bins = bins
        #: By policy, the states of the last map, [n, d], and their SRL errors, [n]
        self.visits: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def _init_callback(self) -> None:
        self._check_actors(self.actors)
        _check_spaces("CuriosityMapCallback", self.eval_env, self.model)
        with untouched_randomness(self.model.device):
            self.eval_env.reset(seed=self.seed)
            shape = np.shape(self.state(self.eval_env))  # rather than when the first map is due
        if shape != (len(self.names),):
            raise ValueError(
                f"CuriosityMapCallback got {len(self.names)} names for states of shape {shape}: state must return a "
                "vector, and names have one name for each of its values."
            )

    def on_period(self) -> None:
        """Roll out each policy and draw."""
        model: Any = self.model
        self.visits = {}
        with evenly_measured(model, self.eval_env, self.seed):
            for actor in self._check_actors(self.actors):
                episodes = run_episodes(
                    model,
                    self.eval_env,
                    self.n_episodes,
                    actor,
                    deterministic=self.deterministic,
                    seed=self.seed,
                    states=self.state,
                )
                pairs = [(episode.states, episode.srl_errors) for episode in episodes]
                states, errors = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
                self.visits[actor] = self._finite(actor, states, errors)
        if not any(len(states) for states, _ in self.visits.values()):
            return
        steps = self.num_timesteps
        self._import_room("plots").curiosity_map(
            self._path(f"curiosity_map_{steps}_steps.png"),
            self.visits,
            self.names,
            f"Where policies go with {_actions(self.deterministic)} after {steps:,} agent steps",
            coordinates=self.coordinates,
            units=self.units,
            bins=self.bins,
        )

    def _finite(self, actor: str, states: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Without the states that have no place on a map: that is no reason to end a training."""
        finite = np.isfinite(states).all(axis=1)
        if finite.all():
            return states, errors
        names = [name for name, values in zip(self.names, states.T, strict=True) if not np.isfinite(values).all()]
        warnings.warn(
            f"CuriosityMapCallback leaves out {np.count_nonzero(~finite)} of {len(states)} states of the {actor} "
            f"policy, whose {', '.join(names)} is not finite: look at what `state` returns.",
            stacklevel=2,
        )
        return states[finite], errors[finite] if len(errors) else errors


class DiagnosticsCallback(PeriodicCallback):
    """Warns, once each, of what spoils training from pixels without an error.

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
    ``diagnostics/<name>``; what they are and why the thresholds lie where they do stands in ``sb3_cure.diagnostics``.
    A look takes less time than one update with a batch of ``n_samples``.

    :param every: Agent steps between two looks
    :param n_samples: Observations of the replay buffer to look at
    :param min_updates: Updates before networks, temperatures and the curious reward are judged: in the first hundreds
        latents may collapse and come back
    :param autoencoder_updates: Updates before the autoencoder is judged: before a few thousand it is no better than
        the mean image in good runs either
    :param temperature_bounds: Least and greatest temperature that can still weigh entropy against reward
    :param verbose: 1 prints each look
    :raises ValueError: if an argument is out of range, or the algorithm has no replay buffer
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
        if not (is_integer(n_samples, 2) and is_integer(min_updates, 0) and is_integer(autoencoder_updates, 0)):
            raise ValueError(
                f"DiagnosticsCallback got n_samples={n_samples!r}, min_updates={min_updates!r} and autoencoder_updates="
                f"{autoencoder_updates!r}, but they must be at least 2, 0 and 0: change them to whole numbers."
            )
        bounds = np.asarray(temperature_bounds)  # of texts, as YAML reads 1e-4, if they are no numbers
        if bounds.shape != (2,) or bounds.dtype.kind not in "iuf" or not 0 <= bounds[0] < bounds[1]:
            raise ValueError(
                f"DiagnosticsCallback got temperature_bounds={temperature_bounds!r}, but they are the least and the "
                "greatest temperature: give two numbers >= 0 in rising order, such as [0.0001, 100]."
            )
        self.n_samples = n_samples
        self.min_updates = min_updates
        self.autoencoder_updates = autoencoder_updates
        self.temperature_bounds = temperature_bounds
        #: What was warned of
        self.warned: list[str] = []
        self._rendering: diagnostics.Finding | None = None

    def _init_callback(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise ValueError(
                f"DiagnosticsCallback got a {type(self.model).__name__}, but it looks at what a replay buffer holds: "
                "use it with CuReSAC, or another off-policy algorithm."
            )

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._rendering = diagnostics.software_rendering(self.training_env)
        if self._rendering is not None:
            self._report(self._rendering)

    def on_period(self) -> None:
        """Look, log and warn."""
        findings = [] if self._rendering is None else [self._rendering]
        findings += diagnostics.look(
            self.model, self.n_samples, self.min_updates, self.autoencoder_updates, self.temperature_bounds
        )
        for finding in findings:
            self._report(finding)
        if self.verbose >= 1:
            print(", ".join(f"{finding.name} {finding.value:.3g}" for finding in findings))

    def _report(self, finding: diagnostics.Finding) -> None:
        self.logger.record(f"diagnostics/{finding.name}", float(finding.value))
        if finding.problem is not None and finding.name not in self.warned:
            self.warned.append(finding.name)
            warnings.warn(f"After {self.num_timesteps} agent steps: {finding.problem}", stacklevel=2)
