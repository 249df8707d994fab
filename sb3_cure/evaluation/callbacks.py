"""Callbacks for ``learn``: evaluation, videos, pictures and warnings.

All work with any SB3 algorithm (``DiagnosticsCallback``, ``ReconstructionCallback``: any off-policy one); SRL errors
are those of the head or of a reward that reconstructs; without either there are none.
"""

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import check_for_correct_spaces, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.cure.reconstructions import newest_frames
from sb3_cure.data.buffers import frame_stacks, stored_places, transitions
from sb3_cure.data.observations import by_key, image_spaces
from sb3_cure.envs import physics_state, physics_state_names, physics_state_units
from sb3_cure.envs.physics import map_coordinates
from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.evaluation import decoding, diagnostics
from sb3_cure.evaluation.encoders import encoder_of
from sb3_cure.evaluation.probe import state_probe
from sb3_cure.evaluation.rollouts import (
    Episode,
    as_arrays,
    as_trained,
    balanced_negatives,
    returns_and_errors,
    run_episodes,
    states_and_errors,
    trained_actors,
    untouched_randomness,
)

__all__ = [
    "CuriosityMapCallback",
    "DiagnosticsCallback",
    "EvalBothCallback",
    "PeriodicCallback",
    "PolicyVideoCallback",
    "ReconstructionCallback",
    "RolloutCallback",
    "StateProbeCallback",
]

#: Longest name that SB3 prints in full; it refuses to print two names that are equal when truncated
PRINTED_NAME = 33
#: Most rows of a picture of reconstructions; if there are more, rows are left out evenly
MAX_ROWS = 12


class PeriodicCallback(BaseCallback):
    """Base class for callbacks that do something every so many agent steps: implement ``on_period``.

    It is due whenever the number of agent steps reaches or passes a multiple of ``every``. The random number generators
    of Python, NumPy and PyTorch are restored afterwards, so that training is the same with and without the callback.

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
        """Do the work; ``self.model``, ``self.num_timesteps`` and ``self.logger`` are there, as in any callback."""
        raise NotImplementedError(f"{type(self).__name__} must implement on_period()")

    def _path(self, folder: Path, name: str) -> Path:
        """Path of a file to write, in a folder that is made with the first file."""
        folder.mkdir(parents=True, exist_ok=True)
        if self.verbose >= 1:
            print(f"{type(self).__name__}: {folder / name}")
        return folder / name


class RolloutCallback(PeriodicCallback):
    """Base class for callbacks that roll out policies alone, in an environment of its own, every so many agent steps.

    :param eval_env: One (not vectorised) environment made as the training environment, but not that one itself. If
        SB3's ``VecFrameStack`` stacks frames for training, wrap it in
        ``sb3_cure.envs.StackFrames(env, n, padding="zeros")``
    :param every: Agent steps between two calls
    :param n_episodes: Episodes per policy
    :param deterministic: Whether policies act by their mean
    :param seed: Seed of the first reset each time: all evaluations then start from the same states
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``; by default the policies that the model trains, or
        ``"random"`` where it trains none
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
        #: Policies that are rolled out in the current call of ``learn``
        self.actors: list[str] = []

    def _init_callback(self) -> None:
        model = self.model
        if isinstance(self.eval_env, VecEnv):
            raise ValueError(
                "eval_env must be one gymnasium.Env, not a VecEnv "
                "(sb3_cure.envs.StackFrames(env, n, padding='zeros') stacks images as VecFrameStack does; if you stack "
                "those of a dictionary with vectors, use it in training, too, as it leaves vectors alone)."
            )
        # As SB3 wraps training environments: images channels first
        wrapped = model._wrap_env(self.eval_env, monitor_wrapper=False)
        check_for_correct_spaces(wrapped, model.observation_space, model.action_space)
        trained = trained_actors(model)
        self.actors = (trained or ["random"]) if self._chosen is None else list(self._chosen)
        if not set(self.actors) <= {*trained, "random"}:
            raise ValueError(f"actors must be of {', '.join([*trained, 'random'])} for this model, not {self.actors}.")

    def run(self, actor: str, **kwargs: Any) -> Iterator[Episode]:
        """Roll out one policy.

        :param actor: Who acts
        :param kwargs: Further arguments of ``run_episodes``
        :return: Its episodes
        """
        arguments = dict(deterministic=self.deterministic, seed=self.seed, **kwargs)
        return run_episodes(self.model, self.eval_env, self.n_episodes, actor, **arguments)

    def _log(self, values: dict[str, float]) -> None:
        """Log what was measured in a row of its own, because SB3 writes no row between two episodes."""
        for name, value in values.items():
            is_long = len(name.partition("/")[2]) > PRINTED_NAME
            self.logger.record(name, value, exclude=("stdout", "log") if is_long else ())
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    @property
    def _actions(self) -> str:
        return "deterministic actions" if self.deterministic else "sampled actions"


class EvalBothCallback(RolloutCallback):
    """Evaluate the task policy and the curious policy in separate rollouts.

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
        """Evaluate now.

        :return: Agent steps and the logged values
        """
        row: dict[str, float] = {}
        for actor in self.actors:
            returns, errors = returns_and_errors(self.run(actor))
            row[f"eval/{actor}_reward"] = float(returns.mean())
            if len(errors) > 0:
                row[f"eval/{actor}_srl_error"] = float(errors.mean())
        self._log(row)
        row = {"timesteps": self.num_timesteps, **row}
        self.history.append(row)
        if self.verbose >= 1:
            print(", ".join(f"{key} {value:.4g}" for key, value in row.items()))
        return row


class PolicyVideoCallback(RolloutCallback):
    """Film an episode of each policy: ``<actor>_policy_<steps>_steps.mp4``, steps being agent steps of training.

    Below the camera's picture are the return so far and, if the model measures one, the SRL error of the
    observation as a number and as a curve.

    :param eval_env: One (not vectorised) environment made with ``render_mode="rgb_array"``, not the training one
    :param folder: Where to write
    :param every: Agent steps between two videos
    :param kwargs: ``actors``, ``deterministic``, ``seed``, ``verbose`` of ``RolloutCallback``; verbose=1 prints the
        name of each video
    :raises ValueError: if the environment does not render RGB frames
    :raises ImportError: if imageio is not installed
    """

    def __init__(self, eval_env: gym.Env, folder: str | Path, every: int = 5000, **kwargs: Any):
        super().__init__(eval_env, every, n_episodes=1, **kwargs)
        if eval_env.render_mode != "rgb_array":
            raise ValueError(f"eval_env must have render_mode='rgb_array', not {eval_env.render_mode!r}.")
        self.folder = Path(folder)
        from sb3_cure.evaluation import video  # noqa: F401  (fail before training if a package is missing)

    def on_period(self) -> None:
        """Film an episode of each policy."""
        from sb3_cure.evaluation import video

        steps, repeat = self.num_timesteps, action_repeat_of(self.eval_env)
        for actor in self.actors:
            (episode,) = self.run(actor, render=True)
            path = self._path(self.folder, f"{actor}_policy_{steps}_steps.mp4")
            title = f"{actor} policy, {self._actions}, after {steps:,} agent steps"
            video.write_video(path, {title: episode}, video.frame_rate(self.eval_env), repeat)


class ReconstructionCallback(PeriodicCallback):
    """Draw reconstructions of the same observations over training: ``reconstructions.png``, one row per time.

    Each image of dictionaries has a picture ``reconstructions_<key>.png``. If neither head nor intrinsic reward
    reconstructs, and for SB3's own off-policy algorithms, a new decoder is fitted to latents of the replay buffer for
    each row; the agent does not learn from it. The file is rewritten with each row.

    :param folder: Where to write
    :param every: Agent steps between two rows
    :param columns: Number of observations to draw, spread evenly over the replay buffer at the time of the first row
    :param decoder_updates: Updates of the decoder; 0: no picture for heads that do not reconstruct
    :param verbose: 1 prints the file's name
    :param title: Added to the picture's title, such as the names of task and method
    :raises ValueError: if the model has no replay buffer, or does not learn from images with an encoder
    :raises ImportError: if matplotlib is not installed
    """

    def __init__(
        self,
        folder: str | Path,
        every: int = 5000,
        columns: int = 8,
        decoder_updates: int = 500,
        verbose: int = 0,
        title: str = "",
    ):
        super().__init__(every, verbose)
        self.folder, self.columns, self.decoder_updates, self.title = Path(folder), columns, decoder_updates, title
        #: What is drawn, [n, C, H, W] or by key; None before the first row
        self.observations: Any = None
        #: Agent steps and the reconstructions then, their newest frames by key, uint8 [n, C, H, W]
        self.rows: list[tuple[int, dict[str, np.ndarray]]] = []
        from sb3_cure.evaluation import plots  # noqa: F401  (fail before training if a package is missing)

    def _init_callback(self) -> None:
        if encoder_of(self.model.policy) is None or not image_spaces(self.model.observation_space):
            raise ValueError("ReconstructionCallback needs a policy with an encoder of uint8 images, which it draws.")
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise ValueError("ReconstructionCallback needs a replay buffer, to which decoders are fitted.")

    def on_period(self) -> None:
        """Add a row."""
        from sb3_cure.evaluation import plots

        self.model.policy.set_training_mode(False)
        if self.observations is None:
            self.observations = self._spread()
        drawn = None if self.observations is None else self._reconstruct(self.observations)
        if drawn is None:
            return
        title, *pair = drawn
        stacks = frame_stacks(self.model)  # type: ignore[arg-type]
        seen, row = (
            {key: np.array(as_arrays(newest_frames(each[key], stacks[key]))) for key in pair[1]} for each in pair
        )
        self.rows.append((self.num_timesteps, row))
        shown = np.unique(np.linspace(0, len(self.rows) - 1, min(len(self.rows), MAX_ROWS)).round().astype(int))
        for key, images in seen.items():
            # Keys such as dm_control's "walker/egocentric_camera"
            name = re.sub(r"[^\w.-]", "_", f"reconstructions_{key}" if key else "reconstructions")
            plots.reconstructions_over_training(
                self._path(self.folder, f"{name}.png"),
                images,
                [(steps, row[key]) for steps, row in (self.rows[index] for index in shown)],
                "\n".join(filter(None, (f"{title}: {key}" if key else title, self.title))),
            )

    def draw(self, model: BaseAlgorithm) -> None:
        """Add a row now, outside of training.

        :param model: A trained model, or one loaded with a replay buffer
        """
        self.init_callback(model)
        self.num_timesteps = model.num_timesteps
        self.on_period()

    def _reconstruct(self, observations: Any) -> tuple[str, dict[str, th.Tensor], dict[str, th.Tensor]] | None:
        """Title, images and reconstructions by key; None if there is nothing that reconstructs."""
        model: Any = self.model
        observed = obs_as_tensor(as_trained(model, observations), model.device)
        if hasattr(model.policy, "reconstruct"):
            with th.no_grad():
                pair = model.policy.reconstruct(observed)
            if pair is not None:
                return "What the agent sees, and what its latents hold of it", by_key(pair[0]), by_key(pair[1])
        if self.decoder_updates == 0 or model.replay_buffer.size() == 0:
            return None
        seen, drawn = {}, {}
        for key in image_spaces(model.observation_space):
            decoder = decoding.fit_decoder(model, self._sample, self.decoder_updates, key)
            seen[key], drawn[key] = decoding.draw_latents(model, decoder, observed, key)
        return "What a decoder fitted afterwards draws from the latents", seen, drawn

    def _sample(self, n: int) -> Any:
        """Draw random observations of the replay buffer, [n, *shape] or these by key, normalized."""
        buffer: Any = self.model.replay_buffer  # type: ignore[attr-defined]
        return buffer.sample(n, env=self.model.get_vec_normalize_env()).observations

    def _spread(self) -> Any:
        """Choose observations of the replay buffer, evenly over their time, oldest first; None if there are none."""
        buffer: Any = self.model.replay_buffer  # type: ignore[attr-defined]
        rows, env_inds, _ = stored_places(buffer)
        if len(rows) == 0:
            return None
        chosen = np.linspace(len(rows) - 1, 0, self.columns).round().astype(int)
        return as_arrays(transitions(buffer, rows[chosen], env_inds[chosen]).observations)


def _true_state(
    eval_env: gym.Env, state: Callable[[gym.Env], np.ndarray] | None, names: Sequence[str] | None
) -> tuple[Callable[[gym.Env], np.ndarray], list[str], list[str] | None]:
    """State function, names and units: those given, or dm_control's."""
    if (state is None) != (names is None):
        raise ValueError("state and names belong together: a function of the environment, and what it returns.")
    if state is None or names is None:
        return physics_state, physics_state_names(eval_env), physics_state_units(eval_env)
    return state, list(names), None


class CuriosityMapCallback(RolloutCallback):
    """Map where each policy goes and its SRL error there: ``curiosity_map_<steps>_steps.png``.

    Each policy acts alone for some episodes; the map is drawn over two coordinates of the environment's true state,
    which the agent does not see. Without an SRL error only visits are drawn. CURL's error is measured against an even
    mix of what the policies see (``sb3_cure.evaluation.rollouts.balanced_negatives``).

    :param eval_env: One (not vectorised) environment, not the training one
    :param folder: Where to write
    :param every: Agent steps between two maps
    :param coordinates: Names of the two coordinates; by default two that suit the domain, or the first two
    :param state: Function of the environment that returns its true state, [d]; by default that of dm_control:
        positions and velocities of the joints, see ``sb3_cure.envs.physics_state``
    :param names: Names of what ``state`` returns, [d], required with it
    :param bins: Bins along each axis
    :param kwargs: ``actors``, ``n_episodes``, ``deterministic``, ``seed``, ``verbose`` of ``RolloutCallback``;
        verbose=1 prints the name of each map
    :raises ValueError: if the name of a coordinate or the environment's state is unknown
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
        self.coordinates = map_coordinates(self.names, coordinates)
        #: By policy, the states of the last map, [n, d], and their SRL errors, [n]
        self.visits: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        from sb3_cure.evaluation import plots  # noqa: F401  (fail before training if a package is missing)

    def on_period(self) -> None:
        """Roll out each policy and draw."""
        from sb3_cure.evaluation import plots

        self.visits = {}
        with balanced_negatives(self.model, self.eval_env, self.seed):
            for actor in self.actors:
                self.visits[actor] = states_and_errors(self.run(actor, states=self.state))
        plots.curiosity_map(
            self._path(self.folder, f"curiosity_map_{self.num_timesteps}_steps.png"),
            self.visits,
            self.names,
            f"Where policies go with {self._actions} after {self.num_timesteps:,} agent steps",
            coordinates=self.coordinates,
            units=self.units,
            bins=self.bins,
        )


class StateProbeCallback(RolloutCallback):
    """Measure how well a linear map of the latents predicts the true state, which the agent does not see.

    Logs R² of each coordinate, ``probe/<name>`` (``sb3_cure.evaluation.rollouts.state_probe``), and their mean,
    ``probe/mean``; long names are not printed. In a new training the first row is that of the untrained encoder. By
    default all rows are of the same episodes of random actions, so that they can be compared.

    :param eval_env: One (not vectorised) environment, not the training one
    :param every: Agent steps between two rows
    :param n_episodes: Episodes per policy, two at least
    :param state: Function of the environment that returns its true state, [d]; by default that of dm_control:
        positions and velocities of the joints, see ``sb3_cure.envs.physics_state``
    :param names: Names of what ``state`` returns, [d], required with it; none of them counts as an angle
    :param seed: Seed of the first reset and of the random actions each time
    :param actors: Of ``"task"``, ``"curious"`` and ``"random"``; their episodes are taken together
    :param kwargs: ``deterministic``, ``verbose`` of ``RolloutCallback``
    :raises ValueError: if the environment's state is unknown, or ``state`` comes without ``names``
    """

    def __init__(
        self,
        eval_env: gym.Env,
        every: int = 5000,
        n_episodes: int = 10,
        state: Callable[[gym.Env], np.ndarray] | None = None,
        names: Sequence[str] | None = None,
        seed: int | None = 0,
        actors: Sequence[str] = ("random",),
        **kwargs: Any,
    ):
        super().__init__(eval_env, every, n_episodes, seed=seed, actors=actors, **kwargs)
        self.state, self.names, self.units = _true_state(eval_env, state, names)
        #: One row per time: agent steps and R² by name
        self.rows: list[dict[str, float]] = []

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if not self.rows and self.num_timesteps == 0:
            with untouched_randomness(self.model.device):
                self.on_period()

    def on_period(self) -> None:
        """Measure and log."""
        episodes = (episode for actor in self.actors for episode in self.run(actor, states=self.state))
        found = state_probe(self.model, episodes, self.names, self.units)
        logged = {**found, "mean": float(np.nanmean(list(found.values())))}
        self._log({f"probe/{name}": value for name, value in logged.items()})
        self.rows.append({"timesteps": self.num_timesteps, **found})


class DiagnosticsCallback(PeriodicCallback):
    """Warn, once each, of problems that spoil training from pixels without an error.

    ========================  ============================================================================
    ``constant_image``        All recent observations of an environment are equal
    ``collapsed_latents``     The encoder's latents differ by less than 1 % of their size
    ``autoencoder``           Explains less than 1 % of the pixels' variance: no better than the mean image
    ``temperature``           Outside of its bounds, while the policy's entropy misses its target
    ``curious_reward``        Varies by less than 1 % of the entropy term
    ========================  ============================================================================

    Works with every off-policy algorithm of SB3; checks that do not apply are left out. Each number is logged as
    ``diagnostics/<name>``; ``sb3_cure.evaluation.diagnostics`` defines them and the thresholds, with reasons.
    All checks together take less time than one update with a batch of as many observations.

    :param every: Agent steps between two rounds of checks
    :param verbose: 1 prints each number
    """

    def __init__(self, every: int = 1000, verbose: int = 0):
        super().__init__(every, verbose)
        #: Names of the problems that were warned of
        self.warned: list[str] = []
        self._reward_std: Any = None

    def _on_step(self) -> bool:
        # At each step, as the logger forgets what it has written
        self._reward_std = self.logger.name_to_value.get("train/curious_reward_std", self._reward_std)
        return super()._on_step()

    def on_period(self) -> None:
        """Check, log and warn; stop after a problem, as it may explain those that follow."""
        for name, value, problem in filter(None, diagnostics.run_checks(self.model, self._reward_std)):
            self.logger.record(f"diagnostics/{name}", float(value))
            if self.verbose >= 1:
                print(f"{name} {value:.3g}")
            if problem is not None:
                if name not in self.warned:
                    self.warned.append(name)
                    warnings.warn(f"After {self.num_timesteps} agent steps: {problem}", stacklevel=2)
                return
