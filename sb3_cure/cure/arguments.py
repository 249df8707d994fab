"""CuRe's own arguments: types, ranges and choices as one table, and combinations that are refused.

SB3 checks its own arguments.
"""

from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_cure.cure.policies import CuRePolicy
from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.intrinsic import IntrinsicReward, get_intrinsic_class
from sb3_cure.intrinsic.srl_error import SRLError
from sb3_cure.srl import get_srl_class

Rate = Annotated[float, Field(ge=0, le=1)]
Factor = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
# A schedule of the remaining progress
Schedule = Callable[[float], float]


class CuReArguments(BaseModel):
    """Types, ranges and choices of the arguments; their defaults are in ``CuReBase``'s constructor."""

    model_config = ConfigDict(from_attributes=True, arbitrary_types_allowed=True)

    srl_kwargs: dict[str, Any]
    srl_schedule: Literal["simultaneous", "alternating"]
    srl_period: Count
    srl_interval: Count
    intrinsic_kwargs: dict[str, Any]
    curiosity: Literal["separate", "bonus", "random"] | None
    curiosity_prob: Rate | Schedule
    curiosity_bout: Annotated[float, Field(ge=1)] | Literal["episode"]
    curiosity_beta: Factor
    curiosity_gamma: Rate
    curiosity_ent_coef: str | Factor | None
    curiosity_episodic: StrictBool
    normalize_curiosity: StrictBool
    curiosity_target: Literal["observation", "next_observation"]
    curiosity_encoder_grad: StrictBool
    curious_interval: Count
    task: StrictBool
    augmentation: Literal["auto", "shift", "crop"] | None
    augmentation_kwargs: dict[str, Any]
    warmup_updates: Annotated[int, Field(ge=0)] | None
    actor_update_interval: Count
    encoder_tau: Rate
    ent_coef_lr_factor: Factor
    update: Literal["joint", "sequential"]
    precision: Literal["auto", "fp32", "bf16"]
    overlap: StrictBool


def check_arguments(model: Any) -> None:
    """Refuse arguments out of their range, and combinations that would silently train something else.

    :param model: A CuRe model, its arguments set
    :raises ValueError: for the first argument or combination that cannot work, in one sentence
    """
    choose_intrinsic(model)  # refuses names and classes that are neither heads nor rewards
    try:
        checked = CuReArguments.model_validate(model)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        or_none = " or None" if type(None) in get_args(CuReArguments.model_fields[name].annotation) else ""
        raise ValueError(f"{name}={first['input']!r} is not valid: {first['msg'].lower()}{or_none}.") from None
    for name, value in checked:
        if isinstance(value, int | float):  # YAML may give 1e3 or "0.1" as strings
            setattr(model, name, value)
    for sentence in _conflicts(model):
        raise ValueError(sentence)


def choose_intrinsic(model: Any) -> type[IntrinsicReward]:
    """Choose the class of the intrinsic reward; with ``"auto"`` it depends on the head.

    :param model: A CuRe model, its arguments set
    :return: Class of the reward
    """
    return get_intrinsic_class(model.intrinsic, None if model.srl is None else get_srl_class(model.srl))


def _depends_on_observation_alone(model: Any) -> bool:
    """Whether the intrinsic reward of a transition (s, a, s') depends on s alone."""
    if model.srl is None or not issubclass(choose_intrinsic(model), SRLError):
        return False
    head = get_srl_class(model.srl)
    return model.curiosity_target == "observation" and not (head.models_transitions or head.needs_next_latents)


def _conflicts(model: Any) -> Iterator[str]:
    """Describe each combination that is refused, and what to do instead."""
    buffer: type = model.replay_buffer_class or FrameStackReplayBuffer
    ours = issubclass(buffer, FrameStackReplayBuffer)
    separate = model.curiosity == "separate"
    if model.srl is None and model.srl_kwargs:
        yield f"srl_kwargs is {model.srl_kwargs!r}, but srl=None has no arguments: choose a head."
    if not model.task and not separate and (model.curiosity != "random" or model.srl is None):
        yield (
            f"task=False leaves nothing to learn with curiosity={model.curiosity!r} and srl={model.srl!r}: use "
            "curiosity='separate'."
        )
    if separate and model.curiosity_gamma == 0 and _depends_on_observation_alone(model):
        yield (
            "with curiosity_gamma=0 the curious agent learns nothing from the error of the observation itself, which "
            "does not depend on the action: set curiosity_target='next_observation', or a curiosity_gamma > 0."
        )
    if model.n_steps > 1 and model.curiosity == "bonus":
        yield (
            f"n_steps={model.n_steps} sums the task's rewards over steps, but curiosity='bonus' rewards single steps: "
            "set n_steps=1, or curiosity='separate'."
        )
    if issubclass(buffer, NStepReplayBuffer) or (model.n_steps > 1 and not ours):
        yield (
            f"{buffer.__name__} cannot return n-step returns together with the observation one step later, which "
            "heads and rewards need: leave replay_buffer_class out, and set n_steps."
        )
    if model.overlap and issubclass(buffer, HerReplayBuffer):
        yield (
            "overlap=True makes updates while the environments step, and HerReplayBuffer cannot ask them for rewards "
            "then: use overlap=False."
        )
    if model.optimize_memory_usage and not ours and issubclass(buffer, ReplayBuffer):
        yield (
            f"optimize_memory_usage=True makes {buffer.__name__} return the next episode's first observation at the "
            "end of an episode: leave replay_buffer_class out, as the default buffer keeps each frame once anyway."
        )
    if not issubclass(model.policy_class, CuRePolicy):
        yield (
            f"the policy is {model.policy_class.__name__}, which has no shared encoder: use 'CnnPolicy', 'MlpPolicy' "
            "or 'MultiInputPolicy'."
        )
    if model.use_sde:
        yield (
            "use_sde=True explores with noise on the features of one actor, which change whenever the shared encoder "
            "learns: leave it out."
        )
