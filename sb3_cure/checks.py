"""Wrong arguments of ``CuReSAC``, each in one sentence that names the value, what is expected and the fix."""

import contextlib
import inspect
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.common.type_aliases import GymEnv, TrainFreq
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac import policies as sb3_policies
from torch import nn
from torch.nn.parameter import is_lazy

from sb3_cure.mixers import CuriousMixer
from sb3_cure.policies import CnnPolicy, CuRePolicy, MlpPolicy
from sb3_cure.precision import COMPILE, resolve_precision
from sb3_cure.srl import get_srl_class
from sb3_cure.values import (
    MAX_STATS_WINDOW,
    arguments_of,
    check_folder,
    check_keywords,
    check_optimizer_kwargs,
    is_integer,
    is_number,
    is_one_of,
)

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC

#: What the algorithm itself tells policies and replay buffers
_NOT_THE_USERS = {
    "observation_space", "action_space", "lr_schedule", "srl_class", "srl_kwargs", "curious", "curiosity_kwargs",
    "encoder_sources", "update", "acting", "buffer_size", "device", "n_envs", "optimize_memory_usage", "env", "params",
    "lr",
}  # fmt: skip


def make_env(env: Any, verbose: int, required: bool = False) -> Any:
    """SB3's ``maybe_make_env`` for whatever the user gave.

    :param env: Environment, vectorised environment, Gymnasium id, or None
    :param verbose: Verbosity level
    :param required: Whether None is refused
    :return: The environment; None for None
    :raises ValueError: if it is nothing of these, or there is no such id
    """
    if not isinstance(env, str | gym.Env | VecEnv) and (required or env is not None):
        given = repr(env) if len(repr(env)) < 100 else f"a {type(env).__name__}"
        raise ValueError(
            f"env is {given}, but it must be a Gymnasium environment, a VecEnv or a Gymnasium id: give one of them, "
            "for example make_dmc_env('cartpole', 'swingup')."
        )
    try:
        return maybe_make_env(env, verbose)  # type: ignore[arg-type]
    except gym.error.Error as error:
        raise ValueError(
            f"env is {env!r}, which Gymnasium cannot make ({' '.join(str(error).split())}): give a registered id, such "
            "as 'dmc_pixels/cartpole-swingup-v0', or an environment."
        ) from error


def check_construction(model: "CuReSAC", policy: Any, env: GymEnv | str | None, kwargs: dict[str, Any]) -> None:
    """What SB3's constructor would stumble over.

    :param model: The model, of which nothing is set yet
    :param policy: Policy class or its name
    :param env: What was given as the environment
    :param kwargs: The arguments that are SAC's
    :raises ValueError: for the first that cannot work
    :raises TypeError: for an argument that does not exist
    """
    known = arguments_of(type(model))
    check_keywords("the call", kwargs, known and known - {"_init_setup_model"}, type(model).__name__)
    aliases = model.policy_aliases
    is_class = inspect.isclass(policy) and issubclass(policy, BasePolicy)
    if not is_class and not (isinstance(policy, str) and policy in aliases):
        raise ValueError(
            f"policy is {policy!r}, but it must be one of {', '.join(map(repr, aliases))}, or a class of policies: "
            "choose one."
        )
    if isinstance(env, gym.Env | VecEnv):
        check_action_space(env.action_space)
        if isinstance(env.observation_space, spaces.Dict) and policy in ("CnnPolicy", "MlpPolicy"):
            raise ValueError(_reads_one_entry(env.observation_space))
    for name, whose in ("policy_kwargs", "the policy"), ("replay_buffer_kwargs", "the replay buffer"):
        if kwargs.get(name) is not None:
            check_keywords(name, kwargs[name], None, whose)
    if not isinstance(kwargs.get("verbose", 0), int | np.integer):
        raise ValueError(f"verbose is {kwargs['verbose']!r}, but it must be 0, 1 or 2: choose one.")
    _check_device(kwargs.get("device", "auto"))


def _check_device(device: Any) -> None:
    """SB3 trains on the CPU where there is no CUDA, which is said; all else must be there."""
    try:
        found = get_device(device)
        # A tensor there, as torch knows many kinds of devices and most are on no machine.
        th.zeros(1, device=found).cpu()
    except (RuntimeError, TypeError, AssertionError, NotImplementedError) as error:
        raise ValueError(
            f"device is {device!r}, which PyTorch cannot use here: use 'auto', 'cpu', or 'cuda' on a machine with "
            "a GPU."
        ) from error
    if device != "auto" and th.device(device).type != found.type:
        warnings.warn(
            f"device is {str(device)!r}, but PyTorch finds no such device here: the model is on the "
            f"{found.type.upper()}; `sb3-cure doctor` tells what is there.",
            stacklevel=4,
        )


def check_action_space(action_space: spaces.Space) -> None:
    """
    :param action_space: Action space of the environment
    :raises ValueError: if it is a Box, but none of real numbers between finite bounds
    """
    if not isinstance(action_space, spaces.Box):
        return  # SB3 refuses it, in its own words
    with np.errstate(over="ignore", invalid="ignore"):
        is_bounded = np.isfinite(action_space.high - action_space.low).all()  # actions are scaled by these
    if not is_bounded:
        raise ValueError(
            f"the action space is {action_space}, but SAC needs finite bounds: give it some that suit the environment, "
            "such as gymnasium.wrappers.TransformAction(env, lambda action: action, gymnasium.spaces.Box(-1, 1, "
            f"{action_space.shape}))."
        )
    if not np.issubdtype(action_space.dtype, np.floating):
        raise ValueError(
            f"the action space is {action_space} of {action_space.dtype}, but SAC's actions are real, which the "
            "replay buffer would cut off: round in the environment, such as by gymnasium.wrappers.TransformAction(env, "
            f"lambda action: action.round().astype('{action_space.dtype}'), gymnasium.spaces.Box("
            f"{action_space.low.min()}, {action_space.high.max()}, {action_space.shape}))."
        )
    if (action_space.low >= action_space.high).any():
        fixed = tuple(int(place) for place in np.argwhere(action_space.low >= action_space.high)[0])
        raise ValueError(
            f"action {', '.join(map(str, fixed))} of the action space {action_space} has nothing between its bounds "
            f"{action_space.low[fixed]} and {action_space.high[fixed]}: leave it out of the action space, and let the "
            "environment set it."
        )


def check_arguments(model: "CuReSAC") -> None:
    """Everything that can be known to be wrong before anything is built.

    :param model: The model, its arguments set
    :raises ValueError: for the first argument that cannot work
    """
    if not hasattr(model, "observation_space"):
        raise ValueError("env is None, but a new model learns its spaces from an environment: give one as env.")
    if model.srl is not None:
        get_srl_class(model.srl)
    _check_choice("srl_schedule", model.srl_schedule, ("simultaneous", "alternating"))
    _check_choice("curiosity", model.curiosity, ("separate", "bonus", "random", None))
    _check_choice("curiosity_target", model.curiosity_target, ("observation", "next_observation"))
    _check_choice("update", model.update, ("sequential", "joint"))
    _check_choice("on_bad_transition", model.on_bad_transition, ("raise", "skip"))
    resolve_precision(model.precision, model.device)
    _check_choice("compile", model.compile, COMPILE)
    CuriousMixer(model.curiosity_prob)
    _check_numbers(model)
    _check_training_arguments(model)
    _check_objects(model)
    if model.srl is None and model.srl_kwargs:
        raise ValueError(
            f"srl_kwargs={model.srl_kwargs!r} was given with srl=None, but these are the arguments of an SRL head: "
            "choose srl='rae', srl='curl' or a head of your own, or leave srl_kwargs out."
        )
    if model.curiosity is not None and model.srl is None:
        raise ValueError(
            f"curiosity={model.curiosity!r} was given with srl=None, but the curious reward is the SRL error: "
            "choose srl='rae', srl='curl' or a head of your own, or set curiosity=None."
        )
    if not model.task and model.curiosity != "separate":
        raise ValueError(
            f"task=False was given with curiosity={model.curiosity!r}, but an agent without task needs a curious "
            "policy: set curiosity='separate'."
        )
    if model.curiosity == "separate":
        check_curious_agent(model)
    if model.use_sde and not model.is_plain_sac:
        raise ValueError(
            f"use_sde=True was given with srl={model.srl!r} and curiosity={model.curiosity!r}, but gSDE's noise "
            "belongs to one actor on its own features: leave use_sde=False, or set srl=None and curiosity=None."
        )
    if model.n_steps > 1 and model.curiosity is not None:
        raise ValueError(
            f"n_steps={model.n_steps} was given with curiosity={model.curiosity!r}, but the curious reward is known "
            "for single transitions only: set n_steps=1, or curiosity=None."
        )
    check_vec_normalize(model)
    # Dictionaries, for which SB3 asks for 'MultiInputPolicy', are refused for themselves.
    is_dict = isinstance(model.observation_space, spaces.Dict)
    if not (model.is_plain_sac or is_dict or issubclass(model.policy_class, CuRePolicy)):
        policy = f"{model.policy_class.__module__}.{model.policy_class.__name__}"
        raise ValueError(
            f"the policy is {policy}, but SRL and curiosity need a subclass of sb3_cure.policies.CuRePolicy: use "
            "'CnnPolicy' or 'MlpPolicy'."
        )


def _check_numbers(model: "CuReSAC") -> None:
    for name in ("gamma", "curiosity_gamma", "tau", "encoder_tau"):
        _check_range(name, getattr(model, name), 0.0, 1.0)
    for name in ("curiosity_beta", "ent_coef_lr_factor", "learning_starts"):
        _check_range(name, getattr(model, name), 0.0, np.inf)
    flags = ("task", "overlap", "normalize_curiosity", "curiosity_encoder_grad", "curiosity_episodic")
    for name in (*flags, "optimize_memory_usage", "use_sde", "use_sde_at_warmup"):
        if not isinstance(getattr(model, name), bool):
            raise ValueError(f"{name} is {getattr(model, name)!r}, but it must be True or False: change {name}.")
    for name in (
        "batch_size",
        "buffer_size",
        "srl_period",
        "actor_update_interval",
        "target_update_interval",
        "n_steps",
    ):
        _check_integer(name, getattr(model, name), 1)
    _check_integer("stats_window_size", model._stats_window_size, 1)
    if model._stats_window_size > MAX_STATS_WINDOW:
        raise ValueError(
            f"stats_window_size is {model._stats_window_size}, but it must be {MAX_STATS_WINDOW} episodes at most: "
            "change stats_window_size."
        )
    _check_integer("sde_sample_freq", model.sde_sample_freq, -1)
    if model.warmup_updates is not None:
        _check_integer("warmup_updates", model.warmup_updates, 0)
    if not is_integer(model.gradient_steps, -1):
        raise ValueError(
            f"gradient_steps is {model.gradient_steps!r}, but it must be a whole number of at least 0, or -1 for as "
            "many updates as agent steps: change gradient_steps."
        )
    if model.seed is not None and not (is_integer(model.seed, 0) and model.seed < 2**32):
        raise ValueError(
            f"seed is {model.seed!r}, but it must be None or a whole number from 0 to 2**32 - 1: change seed."
        )


def _check_training_arguments(model: "CuReSAC") -> None:
    learning_rate = model.learning_rate
    if callable(learning_rate):
        if not is_number(first := learning_rate(1.0), low=0):
            raise ValueError(
                f"learning_rate is a schedule that starts with {first!r}, but it must give numbers of at least 0: "
                "change the schedule."
            )
    elif not (isinstance(learning_rate, int | float) and is_number(learning_rate, low=0)):
        raise ValueError(
            f"learning_rate is {learning_rate!r}, but it must be a float of at least 0, or a schedule of the remaining "
            "progress: change learning_rate."
        )
    given: Any = model.train_freq
    if isinstance(given, TrainFreq):  # a loaded model's, perhaps with other environments
        given = (given.frequency, given.unit.value)
    frequency, unit = given if isinstance(given, tuple) and len(given) == 2 else (given, "step")
    if not (isinstance(frequency, int) and is_integer(frequency, 1) and is_one_of(unit, ("step", "episode"))):
        raise ValueError(
            f"train_freq is {given!r}, but it must be a whole number of steps of at least 1, or a pair such as "
            "(1, 'episode') or (4, 'step'): change train_freq."
        )
    if unit == "episode" and model.env is not None and model.n_envs > 1:
        raise ValueError(
            f"train_freq is {given!r} with {model.n_envs} environments, but episodes are counted in a single one: give "
            "train_freq in steps, or one environment."
        )
    _check_ent_coef(model.ent_coef)
    if model.target_entropy != "auto" and not is_number(model.target_entropy):
        raise ValueError(
            f"target_entropy is {model.target_entropy!r}, but it must be 'auto' or a number: change target_entropy."
        )


def _check_objects(model: "CuReSAC") -> None:
    noise = model.action_noise
    if noise is not None and not isinstance(noise, ActionNoise):
        raise ValueError(
            f"action_noise is {noise!r}, but it must be None or an ActionNoise: give one, for example "
            "NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)) for two actions."
        )
    shape = np.shape(getattr(noise, "_mu", 0.0))
    if shape not in ((), (1,), model.action_space.shape):
        raise ValueError(
            f"action_noise is for actions of shape {shape}, but the environment's are of shape "
            f"{model.action_space.shape}: make the noise with a mean of that shape."
        )
    if not isinstance(model.tensorboard_log, str | Path | None):
        raise ValueError(
            f"tensorboard_log is {model.tensorboard_log!r}, but it must be None or the path of a folder: give one."
        )


def _check_networks(model: "CuReSAC") -> None:
    """What the keywords of policy and head are, and the values that torch would stumble over."""
    if model.srl is not None:
        head = get_srl_class(model.srl)
        known = arguments_of(head)
        check_keywords(
            "srl_kwargs", model.srl_kwargs, known and known - {"encoder", "observation_space"}, head.__name__
        )
    given, policy_class = model.policy_kwargs, model.policy_class
    known = arguments_of(policy_class)
    # `share_encoder` asks for our policies where nothing else does.
    known = known and (known | {"use_sde", "share_encoder"}) - _NOT_THE_USERS
    if known and "share_features_extractor" in given and "share_features_extractor" not in known:
        raise TypeError(
            f"policy_kwargs has 'share_features_extractor', but actors and critics of {policy_class.__name__} share "
            "the encoder in any case, and critics train it: remove it."
        )
    check_keywords("policy_kwargs", given, known, policy_class.__name__)
    _check_net_arch(given.get("net_arch"))
    if "n_critics" in given:
        _check_integer("n_critics of policy_kwargs", given["n_critics"], 1)
    _check_class("activation_fn", given.get("activation_fn"), th.nn.Module)
    for part, kind in ("features_extractor", BaseFeaturesExtractor), ("optimizer", th.optim.Optimizer):
        chosen = given.get(f"{part}_class") or _default(policy_class, f"{part}_class")
        _check_class(f"{part}_class", chosen, kind)
        if chosen is NatureCNN and len(model.observation_space.shape or ()) != 3:
            raise ValueError(_reads_images(model.observation_space))
        if given.get(f"{part}_kwargs") is not None:
            known = None if chosen is None else arguments_of(chosen)
            whose = getattr(chosen, "__name__", kind.__name__)
            arguments = given[f"{part}_kwargs"]
            if part == "optimizer":
                check_optimizer_kwargs("optimizer_kwargs of policy_kwargs", arguments)
            check_keywords(f"{part}_kwargs of policy_kwargs", arguments, known and known - _NOT_THE_USERS, whose)
            if "features_dim" in arguments:
                _check_integer("features_dim of features_extractor_kwargs", arguments["features_dim"], 1)


def _default(policy_class: type, name: str) -> Any:
    """What a policy takes where the user gives nothing, as far as its constructors tell."""
    for cls in policy_class.__mro__:
        if "__init__" in vars(cls) and name in (parameters := inspect.signature(cls).parameters):
            return parameters[name].default
    return None


def _check_class(name: str, value: Any, kind: type) -> None:
    # Functions that make one serve too.
    if value is not None and not (callable(value) and (not inspect.isclass(value) or issubclass(value, kind))):
        raise ValueError(
            f"{name} of policy_kwargs is {value!r}, but it must be a class, a kind of {kind.__name__}: give the class "
            "itself, not its name."
        )


def _check_net_arch(net_arch: Any) -> None:
    parts = net_arch.values() if isinstance(net_arch, Mapping) else [net_arch]
    is_complete = not isinstance(net_arch, Mapping) or net_arch.keys() == {"pi", "qf"}
    layers = [part for part in parts if isinstance(part, list | tuple) and all(is_integer(size, 1) for size in part)]
    if net_arch is not None and not (is_complete and len(layers) == len(parts)):
        raise ValueError(
            f"net_arch of policy_kwargs is {net_arch!r}, but it must be a list of the widths of the hidden layers, or "
            "such lists for actors and critics: write for example [256, 256] or dict(pi=[256], qf=[256, 256])."
        )


def check_parts(model: "CuReSAC") -> None:
    """Classes and arguments of the networks and of the replay buffer.

    :param model: The model, before any of them is made
    :raises ValueError: if a class cannot be what it is given as, or cannot read these observations
    :raises TypeError: if an argument is unknown
    """
    _check_networks(model)
    _check_replay_buffer(model)


@contextlib.contextmanager
def explaining_memory(model: "CuReSAC") -> Iterator[None]:
    """While the replay buffer is made.

    :param model: The model
    :raises ValueError: if there is not enough memory for it
    """
    try:
        yield
    except MemoryError as error:
        is_image = len(model.observation_space.shape or ()) == 3
        images = "images smaller (make_pixel_env does), or " if is_image else ""
        disk = ", or keep frames on a disk with make_pixel_env and replay_buffer_kwargs=dict(frames_dir='/some/disk')"
        raise ValueError(
            f"a replay buffer of buffer_size={model.buffer_size} observations {model.observation_space} does not fit "
            f"into memory ({error}): make {images}buffer_size smaller{disk if is_image else ''}."
        ) from error


def _check_replay_buffer(model: "CuReSAC") -> None:
    chosen, space = model.replay_buffer_class, model.observation_space
    if chosen is not None and not (inspect.isclass(chosen) and issubclass(chosen, ReplayBuffer)):
        raise ValueError(
            f"replay_buffer_class is {chosen!r}, but it must be None or a kind of SB3's ReplayBuffer: give the class "
            "itself, not its name."
        )
    if chosen is not None and issubclass(chosen, DictReplayBuffer) and not isinstance(space, spaces.Dict):
        raise ValueError(
            f"replay_buffer_class is {chosen.__name__}, which stores dictionaries, but observations are {space}: leave "
            "replay_buffer_class out."
        )
    if isinstance(space, spaces.Dict) and chosen is None and model.n_steps > 1:
        raise ValueError(
            f"n_steps={model.n_steps} was given for observations that are dictionaries, of which SB3 replays single "
            "steps only: set n_steps=1."
        )
    usual = DictReplayBuffer if isinstance(space, spaces.Dict) else ReplayBuffer
    chosen = chosen or (NStepReplayBuffer if model.n_steps > 1 else usual)
    known = arguments_of(chosen)
    check_keywords(
        "replay_buffer_kwargs", model.replay_buffer_kwargs, known and known - _NOT_THE_USERS, chosen.__name__
    )


def check_learning(model: "CuReSAC", total_timesteps: Any, callback: Any, log_interval: Any) -> None:
    """The arguments of ``learn`` and ``pretrain``, before anything is done.

    :param model: The model that is to learn
    :param total_timesteps: Agent steps
    :param callback: SB3 callback(s)
    :param log_interval: Episodes between two dumps of the logger
    :raises ValueError: for the first that cannot work
    """
    if model.env is None:
        raise ValueError("learn was called on a model without environment, but it needs one: call set_env(env) first.")
    check_vec_normalize(model)  # `set_env` may have brought it
    # As in SB3, 1e6 counts as a whole number, and 0 steps are none.
    if not is_number(total_timesteps, low=0) or total_timesteps != int(total_timesteps):
        raise ValueError(
            f"total_timesteps is {total_timesteps!r}, but it must be a whole number of agent steps: change "
            "total_timesteps."
        )
    if log_interval is not None:
        _check_integer("log_interval", log_interval, 1)
    for each in callback if isinstance(callback, list) else [callback]:
        usable = isinstance(each, BaseCallback) or (callable(each) and not isinstance(callback, list))
        if each is not None and (not usable or inspect.isclass(each)):
            raise ValueError(
                f"callback is {callback!r}, but it must be a callback, a list of callbacks or a function of locals and "
                "globals: give an instance, not its class or name."
            )
    if model.tensorboard_log is not None:
        _check_tensorboard(Path(model.tensorboard_log))


def _check_tensorboard(folder: Path) -> None:
    try:
        import tensorboard  # noqa: F401
    except ModuleNotFoundError:
        raise ValueError(
            f"tensorboard_log is {str(folder)!r}, but tensorboard is not installed: run "
            "`pip install 'sb3-cure[demo]'`, or leave tensorboard_log out."
        ) from None
    check_folder("tensorboard_log", folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)  # as SB3 is about to do
    except OSError as error:
        raise ValueError(
            f"tensorboard_log is {str(folder)!r}, which cannot be made ({error.strerror}): name another folder."
        ) from error


def check_curious_agent(model: "CuReSAC") -> None:
    """What a second actor-critic cannot learn from.

    :param model: The model, its arguments set
    :raises ValueError: if the curious reward would not depend on the action, or is unknown
    """
    if model.curiosity_gamma == 0 and model.curiosity_target == "observation":
        raise ValueError(
            "curiosity_gamma=0 was given with curiosity_target='observation', but the error of the observation "
            "itself does not depend on the action, so that there is nothing to learn: set "
            "curiosity_target='next_observation', or a curiosity_gamma > 0."
        )
    if model.n_steps > 1:
        raise ValueError(
            f"n_steps={model.n_steps} was given with a curious policy to train, but the curious reward is known "
            "for single transitions only: set n_steps=1."
        )


def check_vec_normalize(model: "CuReSAC") -> None:
    """
    :param model: The model, its arguments and environments set
    :raises ValueError: if bad transitions are to be left out, but ``VecNormalize`` takes them before; or if it lies
        inside of what changes observations' shape, as the replay buffer gets them as it saw them
    """
    venv = model.get_vec_normalize_env()
    if venv is None:
        return
    if model.on_bad_transition == "skip":
        raise ValueError(
            "on_bad_transition='skip' was given with VecNormalize, but its running averages take a bad value before it "
            "can be left out: leave on_bad_transition='raise', or use environments without VecNormalize."
        )
    inner, outer = venv.observation_space.shape, model.observation_space.shape
    if inner != outer:
        raise ValueError(
            f"VecNormalize lies around observations of shape {inner}, but the agent sees {outer}, and SB3 stores what "
            "VecNormalize has seen: put it around the other wrappers, for images with the channels last as "
            "VecNormalize(VecTransposeImage(venv), norm_obs=False)."
        )


def check_shared_encoder_space(observation_space: spaces.Space, policy_class: type) -> None:
    """Whether the shared encoder can read these observations.

    :param observation_space: Observation space of the environment
    :param policy_class: The policy that is to read it
    :raises ValueError: if it cannot
    """
    if isinstance(observation_space, spaces.Dict | spaces.Tuple):
        raise ValueError(_reads_one_entry(observation_space))
    image_like = isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 3
    if image_like and (
        observation_space.dtype != np.uint8
        or np.any(observation_space.low != 0)  # type: ignore[attr-defined]
        or np.any(observation_space.high != 255)  # type: ignore[attr-defined]
    ):
        raise ValueError(
            f"images arrive as {observation_space.dtype} in [{observation_space.low.min()}, "  # type: ignore[attr-defined]
            f"{observation_space.high.max()}], but the encoder and the replay buffer take uint8 in [0, 255]: give "  # type: ignore[attr-defined]
            "the environment's images as they are rendered (scaled ones as (255 * image).astype(numpy.uint8)), and "
            "VecNormalize with norm_obs=False."
        )
    if issubclass(policy_class, MlpPolicy) and image_like:
        raise ValueError(
            f"'MlpPolicy' got images of shape {observation_space.shape}, but it reads vectors: use 'CnnPolicy'."
        )
    if issubclass(policy_class, CnnPolicy) and not image_like:
        raise ValueError(_reads_images(observation_space))


def _reads_one_entry(observation_space: spaces.Dict | spaces.Tuple) -> str:
    parts = observation_space.spaces
    named = list(parts.items()) if isinstance(parts, Mapping) else list(enumerate(parts))
    images = [name for name, part in named if len(part.shape or ()) == 3]
    entry = repr((images or [name for name, _ in named])[0])
    return (
        f"observations are {observation_space}, but the shared encoder reads one image or one vector: keep one entry "
        f"with gymnasium.wrappers.TransformObservation(env, lambda seen: seen[{entry}], "
        f"env.observation_space[{entry}]), or use 'MultiInputPolicy' with srl=None and curiosity=None, which is SB3's "
        "own SAC."
    )


def _reads_images(observation_space: spaces.Space) -> str:
    shape = observation_space.shape or ()
    remedy = "use 'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels"
    if len(shape) == 2 and min(shape) > 1:
        remedy = f"add the axis of channels with gymnasium.wrappers.ReshapeObservation(env, {(1, *shape)})"
    elif len(shape) == 4:
        remedy = "stack single images with sb3_cure.envs.StackFrames or SB3's VecFrameStack instead"
    return (
        f"'CnnPolicy' got observations of shape {observation_space.shape}, but it reads images (channels, height, "
        f"width): {remedy}."
    )


def check_sb3s_images(policy_class: type, observation_space: spaces.Space, policy_kwargs: Mapping[str, Any]) -> None:
    """What SB3's encoder says in the words of a convolution.

    :param policy_class: SB3's policy
    :param observation_space: Observation space of the environment, images with the channels first
    :param policy_kwargs: Arguments of SB3's policy
    :raises ValueError: if there are images that its NatureCNN cannot read
    """
    reads_images = issubclass(policy_class, sb3_policies.CnnPolicy | sb3_policies.MultiInputPolicy)
    if not reads_images or policy_kwargs.get("features_extractor_class", NatureCNN) is not NatureCNN:
        return
    parts = observation_space.values() if isinstance(observation_space, spaces.Dict) else [observation_space]
    for part in parts:
        if is_image_space(part) and min(part.shape[1:]) < 36:  # type: ignore[index]
            raise ValueError(
                f"NatureCNN, SB3's encoder of images, cannot read those of shape {part.shape}, as it needs 36 x 36 "
                "pixels: use a larger image_size, another policy_kwargs=dict(features_extractor_class=...), or for a "
                "single image this package's encoder, policy_kwargs=dict(share_encoder=True)."
            )


def check_srl_head(head: nn.Module) -> None:
    """
    :param head: An SRL head, as it was made
    :raises ValueError: if an archive of it could not be loaded again
    """
    name = type(head).__name__
    if any(is_lazy(parameter) for parameter in [*head.parameters(), *head.buffers()]):
        raise ValueError(
            f"{name} has layers that take their sizes from the first batch, without which no archive of it can be "
            "loaded: give the sizes (encoder.features_dim is at hand in __init__)."
        )
    extra = [key for key, value in head.state_dict().items() if not isinstance(value, th.Tensor)]
    if extra:
        raise ValueError(
            f"{name} has {extra[0]} in its state_dict(), which is no tensor, but archives hold tensors only: keep it "
            "in buffers (register_buffer)."
        )


def check_srl_output(head: nn.Module, output: Any, trains: bool) -> None:
    """
    :param head: An SRL head
    :param output: What its ``loss`` returned
    :param trains: Whether the loss is to be trained on
    :raises ValueError: if it is not a loss and an error, or if nothing can be trained on the loss
    """
    name = type(head).__name__
    parts = output if isinstance(output, tuple | list) else [output]
    if len(parts) != 2 or not all(isinstance(part, th.Tensor) for part in parts):
        kinds = ", ".join(type(part).__name__ for part in parts)
        raise ValueError(
            f"{name}.loss returned ({kinds}), but it must return two tensors, the loss to minimise and the error of "
            "each sample: return SRLOutput(loss, error)."
        )
    loss = output[0]
    if loss.numel() != 1 or (trains and not loss.requires_grad):
        kind = f"of shape {tuple(loss.shape)}" if loss.numel() != 1 else "without a gradient"
        raise ValueError(
            f"{name}.loss returned a loss {kind}, but it must be one number that depends on the latents or on the "
            "head's parameters: average over the batch, and detach the error only."
        )
    if output[1].dtype in (th.bfloat16, th.float16):
        raise ValueError(
            f"{name}.loss returned an error in {output[1].dtype}, too few digits for the curious reward to "
            "be made of: compute it within sb3_cure.layers.full_precision(latents), or set mixed_precision = False."
        )


def check_srl_error(error: th.Tensor, batch_size: int, look: bool) -> None:
    """
    :param error: ``SRLOutput.error`` of a head
    :param batch_size: Number of samples it was computed for
    :param look: Whether to look at the values too, for which a GPU has to stop
    :raises ValueError: if it is not one finite number >= 0 per sample
    """
    if error.shape != (batch_size,) or error.requires_grad:
        kind = f"of shape {tuple(error.shape)}" + (" with a gradient" if error.requires_grad else "")
        raise ValueError(
            f"the SRL head returned an error {kind} for {batch_size} samples, but SRLOutput.error is one detached "
            f"number per sample, shape ({batch_size},): average over all other dimensions, and detach()."
        )
    if look and not (th.isfinite(error).all() and (error >= 0).all()):
        raise ValueError(
            f"the SRL head returned errors from {float(error.min())} to {float(error.max())}, but SRLOutput.error must "
            "be finite and >= 0: fix the head's loss()."
        )


def _check_choice(name: str, value: object, choices: tuple[object, ...]) -> None:
    if not is_one_of(value, choices):
        raise ValueError(f"{name} is {value!r}, but it must be one of {', '.join(map(repr, choices))}: choose one.")


def _check_range(name: str, value: Any, low: float, high: float) -> None:
    if not is_number(value, low, high):
        bounds = f"within [{low:g}, {high:g}]" if np.isfinite(high) else f"of at least {low:g}"
        raise ValueError(f"{name} is {value!r}, but it must be a number {bounds}: change {name}.")


def _check_integer(name: str, value: Any, low: int) -> None:
    if not is_integer(value, low):
        raise ValueError(f"{name} is {value!r}, but it must be a whole number of at least {low}: change {name}.")


def _check_ent_coef(ent_coef: Any) -> None:
    works = is_number(ent_coef, low=0)
    if isinstance(ent_coef, str):
        # Python reads "0.1_2" as 0.12, and SB3 as 0.1.
        mode, *initial = ent_coef.split("_")
        works = mode == "auto" and len(initial) <= 1 and all(_is_positive(number) for number in initial)
    if not works:
        raise ValueError(
            f"ent_coef is {ent_coef!r}, but it must be 'auto', 'auto_<initial temperature > 0>' (say 'auto_0.1'), or a "
            "fixed number >= 0: change ent_coef."
        )


def _is_positive(text: str) -> bool:
    try:
        return 0 < float(text) < np.inf
    except ValueError:
        return False
