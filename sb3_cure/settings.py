"""The settings of models as JSON: values, and the few kinds of objects and names that are allowed among them.

Classes are looked up by name in a fixed table; nothing that a file names is imported.
"""

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import buffers as sb3_buffers
from stable_baselines3.common import torch_layers
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import (
    ConstantSchedule,
    FloatSchedule,
    LinearSchedule,
)
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer
from stable_baselines3.sac import policies as sb3_policies
from torch.nn.modules import activation

from sb3_cure import encoders, policies
from sb3_cure.buffers import FrameStackReplayBuffer, SkippingReplayBuffer
from sb3_cure.mixers import CuriousMixer
from sb3_cure.serialization import ArchiveError, Decoder, Encoder, numeric_dtype
from sb3_cure.srl import SRL_HEADS, SRLHead
from sb3_cure.values import MAX_STATS_WINDOW, is_integer, is_number

#: Most numbers in one observation or action; a space of them takes some 20 bytes each
MAX_SPACE_SIZE = 2**22
#: Most parallel environments, each of which takes a few bytes in a replay buffer
MAX_ENVS = 2**16
#: Most frames in the stacks of all environments together, which a replay buffer numbers before it holds any
MAX_STACKED_FRAMES = 2**20
#: What belongs to a running model alone, and is never a setting: made anew by set-up or ``learn``
NEVER_SAVED = frozenset(
    "policy device env replay_buffer rollout_buffer _vec_normalize_env _logger actor critic critic_target _metrics "
    "_guard _transition_guard _task_agent _curious_agent _overlapped _run _is_pretrained _part "
    "_asks_for_burst _is_burst".split()
)
#: What set-up derives from other settings
DERIVED = frozenset(
    "lr_schedule ent_coef_tensor batch_norm_stats batch_norm_stats_target _computed_precision _compiles".split()
)


# -------------------------------------------------------------- as JSON


def _named() -> dict[str, Any]:
    """What settings may refer to by name."""
    classes: list[type] = [
        policies.CuRePolicy,
        policies.CnnPolicy,
        policies.MlpPolicy,
        sb3_policies.SACPolicy,
        sb3_policies.CnnPolicy,
        sb3_policies.MultiInputPolicy,
        encoders.PixelEncoder,
        encoders.VectorEncoder,
        torch_layers.FlattenExtractor,
        torch_layers.NatureCNN,
        torch_layers.CombinedExtractor,
        FrameStackReplayBuffer,
        SkippingReplayBuffer,
        sb3_buffers.ReplayBuffer,
        sb3_buffers.DictReplayBuffer,
        sb3_buffers.NStepReplayBuffer,
        HerReplayBuffer,
        RMSpropTFLike,
        *SRL_HEADS.values(),
    ]
    for module, base in ((activation, th.nn.Module), (th.optim, th.optim.Optimizer)):
        classes += [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, base)]
    named: dict[str, Any] = {f"{kind.__module__}.{kind.__qualname__}": kind for kind in classes}
    return named | {str(strategy): strategy for strategy in GoalSelectionStrategy}


_NAMED = _named()
_NAMES = {value: name for name, value in _NAMED.items()}
#: Shapes of the simple spaces, by their parts
_SHAPES: dict[str, Callable[..., Any]] = {
    "Box": lambda low, high, shape, dtype: shape,
    "Discrete": lambda n, start, dtype: (),
    "MultiDiscrete": lambda nvec, start, dtype: nvec.shape,
    "MultiBinary": lambda shape: shape,
}


class SettingsEncoder(Encoder):
    """``Encoder``, and what the settings of models are made of besides."""

    def encode_other(self, value: Any, path: str, depth: int) -> Any:
        """
        :param value: Value of a type that plain states do not have
        :param path: Where it is
        :param depth: How many containers it is in
        :return: Its JSON
        :raises TypeError: if it is not of the allow-listed kinds
        """

        def part(item: Any) -> Any:
            return self.encode(item, path, depth + 1)

        if (isinstance(value, type) or type(value) is GoalSelectionStrategy) and value in _NAMES:
            return {"name": _NAMES[value]}
        write = _WRITERS.get(type(value))
        if write is not None:
            return {type(value).__name__: part(write(value))}
        if isinstance(value, PurePath):
            return {"Path": str(value)}
        if callable(value) and hasattr(value, "__qualname__"):
            kind = "class" if isinstance(value, type) else "function"
            raise TypeError(f"{path} is the {kind} {value.__module__}.{value.__qualname__}")
        raise TypeError(f"{path} is of the type {type(value).__module__}.{type(value).__qualname__}")


class SettingsDecoder(Decoder):
    """``Decoder``, and what ``SettingsEncoder`` writes besides."""

    #: Numbers that further spaces may have
    _numbers_left = 2 * MAX_SPACE_SIZE

    def decode_other(self, tag: str, content: Any) -> Any:
        """
        :param tag: Name of the type
        :param content: JSON
        :return: The value
        :raises ArchiveError: if there is no such type or no such name
        """
        if tag == "name" and content in _NAMED:
            return _NAMED[content]
        if tag == "Path" and isinstance(content, str):
            return Path(content)
        if tag not in _READERS:
            return super().decode_other(tag, content)
        parts = self.decode(content)
        if tag in _SHAPES:
            shape = _SHAPES[tag](*parts)
            # The smallest space takes some kilobytes, too.
            self._numbers_left -= max(math.prod(map(whole, shape)), 1000)
            if self._numbers_left < 0:
                raise ArchiveError(
                    f"the archive has spaces of more than {2 * MAX_SPACE_SIZE} numbers (the last one of shape "
                    f"{tuple(shape)!s:.50}), but no observation has so many: it was made to exhaust memory."
                )
        return _READERS[tag](*parts)


def _write_box(space: spaces.Box) -> tuple:
    bounds = [
        bound.flat[0].item() if bound.size and (bound == bound.flat[0]).all() else bound
        for bound in (space.low, space.high)
    ]
    return (*bounds, list(space.shape), space.dtype.str)  # type: ignore[union-attr]


def _read_box(low: Any, high: Any, shape: list[int], dtype: str) -> spaces.Box:
    for bound in (low, high):
        if not isinstance(bound, int | float) and (not isinstance(bound, np.ndarray) or bound.shape != tuple(shape)):
            raise ArchiveError("the archive has a Box whose bounds have another shape than the Box.")
    return spaces.Box(low, high, tuple(shape), _number_type(dtype))


def _number_type(name: Any) -> type:
    return numeric_dtype(name).type


def _read_mixer(n_steps: int, n_curious: int, state: dict[str, Any]) -> CuriousMixer:
    # Its probability is the setting `curiosity_prob`, which set-up gives it.
    mixer = CuriousMixer(0.0)
    mixer.rng.bit_generator.state = state
    mixer.n_steps, mixer.n_curious = whole(n_steps), whole(n_curious)
    return mixer


def whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ArchiveError(f"the archive has the count {value!r:.50}.")
    return value


def _read_ou_noise(
    mean: Any, sigma: Any, theta: float, dt: float, initial: Any, dtype: str, previous: Any
) -> OrnsteinUhlenbeckActionNoise:
    noise = OrnsteinUhlenbeckActionNoise(mean, sigma, theta, dt, initial, _number_type(dtype))
    noise.noise_prev = previous
    return noise


def _read_vectorized_noise(base: ActionNoise, *noises: ActionNoise) -> VectorizedActionNoise:
    if not all(isinstance(part, NormalActionNoise | OrnsteinUhlenbeckActionNoise) for part in (base, *noises)):
        raise ArchiveError("the archive has a VectorizedActionNoise whose parts are not NormalActionNoise or the like.")
    states = [dict(vars(part)) for part in noises]
    noise = VectorizedActionNoise(base, 1)
    noise.n_envs = len(noises)  # given to the constructor, it would make as many copies of the base
    noise.noises = list(noises)  # which resets them
    for part, state in zip(noises, states, strict=True):
        vars(part).update(state)
    return noise


def check_sizes(settings: dict[str, Any]) -> None:
    """What is small in an archive must not become large in a model.

    :param settings: Settings of an archive, each of its type
    :raises ArchiveError: if the noise is larger than the actions that it is for, or there are too many stacks of frames
    """
    noise, space = settings.get("action_noise"), settings.get("action_space")
    parts = [noise.base_noise, *noise.noises] if isinstance(noise, VectorizedActionNoise) else [noise]
    values = [value for part in parts if part is not None for value in vars(part).values()]
    shapes = {np.shape(value) for value in values if not isinstance(value, type)}  # all but the type of numbers
    if space is not None and not all(_broadcasts(shape, space.shape) for shape in shapes):
        raise ArchiveError(
            f"the archive has an action_noise with numbers of shape {max(shapes, key=math.prod)!s:.50}, but actions "
            f"have the shape {space.shape}: it is damaged, or was made to exhaust memory."
        )
    n_envs, frame_stack = settings.get("n_envs", 1), settings.get("replay_buffer_kwargs", {}).get("frame_stack", 1)
    if _is_count(frame_stack) and int(n_envs) * int(frame_stack) > MAX_STACKED_FRAMES:
        raise ArchiveError(
            f"the archive has n_envs={n_envs} and frame_stack={frame_stack}, but together they may be at most "
            f"{MAX_STACKED_FRAMES}: it was made to exhaust memory."
        )


def _broadcasts(shape: tuple[int, ...], to: tuple[int, ...]) -> bool:
    try:
        return np.broadcast_shapes(shape, to) == to
    except ValueError:
        return False


#: Each type's parts, of which the function of the same name in ``_READERS`` makes it again
_WRITERS: dict[type, Callable[[Any], Any]] = {
    spaces.Box: _write_box,
    spaces.Discrete: lambda space: (int(space.n), int(space.start), space.dtype.str),
    spaces.MultiDiscrete: lambda space: (space.nvec, space.start, space.dtype.str),
    spaces.MultiBinary: lambda space: (list(space.shape),),
    spaces.Dict: lambda space: tuple(space.spaces.items()),
    spaces.Tuple: lambda space: tuple(space.spaces),
    OrderedDict: lambda items: tuple(items.items()),
    ConstantSchedule: lambda schedule: (schedule.val,),
    FloatSchedule: lambda schedule: (schedule.value_schedule,),
    LinearSchedule: lambda schedule: (schedule.start, schedule.end, schedule.end_fraction),
    TrainFreq: lambda freq: (freq.frequency, freq.unit.value),
    NormalActionNoise: lambda noise: (noise._mu, noise._sigma, np.dtype(noise._dtype).str),
    OrnsteinUhlenbeckActionNoise: lambda noise: (
        *(noise._mu, noise._sigma, noise._theta, noise._dt, noise.initial_noise),
        *(np.dtype(noise._dtype).str, noise.noise_prev),
    ),
    VectorizedActionNoise: lambda noise: (noise.base_noise, *noise.noises),
    CuriousMixer: lambda mixer: (mixer.n_steps, mixer.n_curious, mixer.rng.bit_generator.state),
}
_READERS: dict[str, Callable[..., Any]] = {
    "Box": _read_box,
    "Discrete": lambda n, start, dtype: spaces.Discrete(n, start=start, dtype=_number_type(dtype)),
    "MultiDiscrete": lambda nvec, start, dtype: spaces.MultiDiscrete(nvec, dtype=_number_type(dtype), start=start),
    "MultiBinary": lambda shape: spaces.MultiBinary(shape[0] if len(shape) == 1 else shape),
    "Dict": lambda *items: spaces.Dict(OrderedDict(items)),  # in this order, where a dict would be sorted
    "Tuple": lambda *parts: spaces.Tuple(parts),
    "OrderedDict": lambda *items: OrderedDict(items),
    "ConstantSchedule": ConstantSchedule,
    "FloatSchedule": FloatSchedule,
    "LinearSchedule": LinearSchedule,
    "TrainFreq": lambda frequency, unit: TrainFreq(whole(frequency), TrainFrequencyUnit(unit)),
    "NormalActionNoise": lambda mean, sigma, dtype: NormalActionNoise(mean, sigma, _number_type(dtype)),
    "OrnsteinUhlenbeckActionNoise": _read_ou_noise,
    "VectorizedActionNoise": _read_vectorized_noise,
    "CuriousMixer": _read_mixer,
}


# --------------------------------------------------------------- schema


def plain_arguments(arguments: dict[str, Any]) -> dict[str, Any]:
    """
    :param arguments: Of ``CuReSAC``
    :return: The same as SB3 takes them and archives hold them; of dictionaries copies, as SB3 writes into one
    """
    plain = dict(arguments)
    for name, value in arguments.items():
        if isinstance(value, Mapping) and name.endswith("_kwargs"):
            plain[name] = dict(value)
            if isinstance(value.get("net_arch"), tuple):
                plain[name]["net_arch"] = list(value["net_arch"])
        elif isinstance(value, bool | np.integer) and name in ("verbose", "seed", "stats_window_size"):
            plain[name] = int(value)
    return plain


def _is_integer(value: Any) -> bool:
    return is_integer(value, -(2**63)) and int(value) < 2**63


def _is_count(value: Any) -> bool:
    return _is_integer(value) and value >= 0


def _is_schedule(value: Any) -> bool:
    """A number, or one of SB3's schedules that gives numbers at both ends."""
    if not isinstance(value, ConstantSchedule | FloatSchedule | LinearSchedule):
        return is_number(value)
    return all(is_number(value(progress)) for progress in (1.0, 0.0))


def _is_class(base: type) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, type) and issubclass(value, base)


def _is_a(*kinds: type) -> Callable[[Any], bool]:
    return lambda value: type(value) in kinds


def _or_none(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or check(value)


def _is_observation(value: Any) -> bool:
    parts = list(value.values()) if isinstance(value, dict) else [value]
    return all(isinstance(part, np.ndarray) for part in parts)


#: What each setting of an archive has to be, in words and as a check; what an argument may be beyond its type is
#: checked by set-up, as for a new model. Of a subclass's own settings nothing is known; the base class has no others.
SCHEMA: dict[str, tuple[str, Callable[[Any], bool]]] = {
    name: entry
    for names, entry in {
        "num_timesteps _num_timesteps_at_start _episode_num _n_updates": (
            "a whole number >= 0",
            _is_count,
        ),
        # 1e5 where it was saved as it was given
        "_total_timesteps": ("a whole number >= 0", lambda value: is_number(value, low=0) and value == int(value)),
        "start_time": ("a number", is_number),
        "verbose gradient_steps sde_sample_freq": ("a whole number", _is_integer),
        "n_steps srl_period actor_update_interval target_update_interval _action_repeat _frame_stack batch_size "
        "buffer_size": ("a whole number >= 1", lambda value: _is_count(value) and value >= 1),
        "n_envs": (f"a whole number from 1 to {MAX_ENVS}", lambda value: _is_count(value) and 1 <= value <= MAX_ENVS),
        "_stats_window_size": (
            f"a whole number from 1 to {MAX_STATS_WINDOW}",
            lambda value: _is_count(value) and 1 <= value <= MAX_STATS_WINDOW,
        ),
        "seed warmup_updates": ("a whole number >= 0 or None", _or_none(_is_count)),
        "learning_starts tau gamma curiosity_beta curiosity_gamma encoder_tau ent_coef_lr_factor "
        "_current_progress_remaining": (
            "a finite number",
            is_number,
        ),
        "learning_rate curiosity_prob": ("a number or one of SB3's schedules", _is_schedule),
        "ent_coef target_entropy": (
            "a finite number or a string",
            lambda value: type(value) is str or is_number(value),
        ),
        "use_sde use_sde_at_warmup optimize_memory_usage normalize_curiosity curiosity_encoder_grad curiosity_episodic "
        "task overlap _warmed_up _custom_logger": ("True or False", _is_a(bool)),
        "compile": ("True, False or a string", _is_a(bool, str)),
        "srl_schedule curiosity_target update precision on_bad_transition": ("a string", _is_a(str)),
        "curiosity _collector": ("a string or None", _or_none(_is_a(str))),
        "tensorboard_log": ("a path or None", _or_none(lambda value: isinstance(value, str | PurePath))),
        "policy_kwargs replay_buffer_kwargs srl_kwargs": ("a dictionary", _is_a(dict)),
        "policy_class": ("a policy", _is_class(BasePolicy)),
        "replay_buffer_class": ("a replay buffer's class or None", _or_none(_is_class(sb3_buffers.ReplayBuffer))),
        "srl": (
            "a name, a head's class or None",
            _or_none(lambda value: type(value) is str or _is_class(SRLHead)(value)),
        ),
        "observation_space": ("a space", lambda value: isinstance(value, spaces.Space)),
        "action_space": ("a Box", lambda value: isinstance(value, spaces.Box)),
        "train_freq": ("a frequency", _is_a(TrainFreq, int, tuple)),
        "action_noise": ("an action noise or None", _or_none(lambda value: isinstance(value, ActionNoise))),
        "_mixer": ("a mixer or None", _or_none(_is_a(CuriousMixer))),
        "_last_obs _last_original_obs": ("observations or None", _or_none(_is_observation)),
        "_last_episode_starts": ("an array or None", _or_none(_is_a(np.ndarray))),
        "ep_info_buffer ep_success_buffer": ("a deque or None", _or_none(lambda value: hasattr(value, "maxlen"))),
        "log_ent_coef ent_coef_optimizer curious_log_ent_coef curious_ent_coef_optimizer": (
            "None",
            lambda value: value is None,
        ),
    }.items()
    for name in names.split()
}
