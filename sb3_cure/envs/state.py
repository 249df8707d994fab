"""Save and restore all that environments remember, so that a training goes on as if it had never stopped.

What is saved is plain: numbers, strings, arrays, and lists and dictionaries of these. Each layer (environment, wrapper,
vectorised environment) saves what is its own:

- DeepMind Control environments of shimmy (those of :func:`sb3_cure.envs.make_dmc_env`): MuJoCo's full integration
  state, what the task changed in the model, the task's random stream, the step count.
- Wrappers of Gymnasium and Stable-Baselines3 whose state is known (:data:`ATTRIBUTES`).
- Anything else that has ``state_dict()`` and ``load_state_dict(state)``: what the first returns (plain, as above) is
  given to the second one. It need not contain the layers below, nor the generators ``np_random`` of environment and
  spaces, which are saved for every environment. Without state, it may be ``{}``.
"""

import copy
import functools
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import wrappers
from gymnasium.wrappers.utils import RunningMeanStd as GymRunningMeanStd
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_cure.envs.dmc import DMCPixels
from sb3_cure.envs.fault_tolerant import FaultTolerantSubprocVecEnv
from sb3_cure.envs.wrappers import ActionRepeat, NormalizeActions, PixelObservation, StackFrames
from sb3_cure.overlap import OverlappedVecEnv

_STATELESS: tuple[type, ...] = (
    ActionRepeat,
    DMCPixels,
    NormalizeActions,
    PixelObservation,
    wrappers.AddRenderObservation,
    wrappers.AddWhiteNoise,
    wrappers.ClipAction,
    wrappers.ClipReward,
    wrappers.DiscretizeAction,
    wrappers.DiscretizeObservation,
    wrappers.DtypeObservation,
    wrappers.FilterObservation,
    wrappers.FlattenObservation,
    wrappers.GrayscaleObservation,
    wrappers.ObstructView,
    wrappers.PassiveEnvChecker,
    wrappers.RepeatAction,
    wrappers.RescaleAction,
    wrappers.RescaleObservation,
    wrappers.ReshapeObservation,
    wrappers.ResizeObservation,
    wrappers.TransformAction,
    wrappers.TransformObservation,
    wrappers.TransformReward,
    VecCheckNan,
    VecExtractDictObs,
    VecTransposeImage,
)


def _class_of(kind: type) -> type:
    """The class itself, or Gymnasium's where rl-zoo has put a subclass of its own in its place (``TimeLimit``)."""
    return kind.__mro__[1] if kind.__module__ == "rl_zoo3.gym_patches" else kind


# By class (not its subclasses, which may remember more): the attributes that change. Times of the clock are left out.
ATTRIBUTES: dict[type, tuple[str, ...]] = {
    **dict.fromkeys(_STATELESS, ()),
    StackFrames: ("_frames",),
    wrappers.DelayObservation: ("observation_queue",),
    wrappers.FrameStackObservation: ("obs_queue",),
    # Where an episode ends within a skip, what is left of the one before counts, too.
    wrappers.MaxAndSkipObservation: ("_obs_buffer",),
    wrappers.NormalizeObservation: ("obs_rms",),
    wrappers.NormalizeReward: ("return_rms", "discounted_reward"),
    wrappers.OrderEnforcing: ("_has_reset",),
    wrappers.RecordEpisodeStatistics: (
        "episode_count",
        "episode_returns",
        "episode_lengths",
        "return_queue",
        "length_queue",
    ),
    wrappers.StickyAction: ("last_action", "is_sticky_actions", "num_repeats", "repeats_taken"),
    wrappers.TimeAwareObservation: ("timesteps",),
    _class_of(wrappers.TimeLimit): ("_elapsed_steps",),
    Monitor: ("rewards", "needs_reset", "episode_returns", "episode_lengths", "total_steps", "current_reset_info"),
    # The buffers of DummyVecEnv are overwritten by every step.
    DummyVecEnv: ("_seeds", "_options"),
    SubprocVecEnv: ("_seeds", "_options"),
    VecFrameStack: ("stacked_obs",),
    VecMonitor: ("episode_count", "episode_returns", "episode_lengths"),
    VecNormalize: ("obs_rms", "ret_rms", "returns", "old_obs", "old_reward"),
    # Parts of the above.
    GymRunningMeanStd: ("mean", "var", "count"),
    RunningMeanStd: ("mean", "var", "count"),
    StackedObservations: ("stacked_obs", "sub_stacked_observations"),
}

# Arguments of wrappers that change neither observations nor rewards nor the end of episodes
_HARMLESS = ("buffer_length", "stats_key", "disable_render_order_enforcing")

_SHIMMY = "shimmy.dm_control_compatibility"
_SUITE = "dm_control.suite."
_NUMBERS = (bool, int, float, np.generic, np.ndarray)
# What the tasks of the suite change in MuJoCo's model at reset: targets, obstacles, gains, terrain.
_MODEL_ARRAYS = (
    "body_pos",
    "body_quat",
    "dof_damping",
    "geom_pos",
    "geom_rgba",
    "geom_size",
    "hfield_data",
    "light_pos",
    "site_pos",
    "site_rgba",
    "site_size",
    "wrap_prm",
)
_BIT_GENERATORS: dict[str, type[np.random.BitGenerator]] = {
    kind.__name__: kind
    for kind in (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64)
}


def vec_env_state(venv: VecEnv) -> dict[str, Any] | None:
    """
    :param venv: Environments between two steps
    :return: All that they remember, or None where a part cannot be saved (``why_not_restorable`` says which)
    :raises RuntimeError: if a step is under way, or if the ``state_dict`` of an environment in a worker fails
    """
    if why_not_restorable(venv) is not None:
        return None
    *_, base = layers = _layers(venv)
    # The environments first: asking them may find a worker dead, which is then replaced.
    env_states = _in_envs(base, _env_state, [()] * base.num_envs)
    return {"layers": [_layer_state(layer) for layer in layers], "envs": env_states}


def load_vec_env_state(venv: VecEnv, state: dict[str, Any]) -> None:
    """Go on from where other environments were, which were built in the same way; arguments that differ are warned of.

    :param venv: Environments to change; they need not have been reset
    :param state: What ``vec_env_state`` gave; it is not changed
    :raises ValueError: if the state is of environments that were built in another way; they may then be changed in part
    :raises RuntimeError: if a step is under way
    """
    *outer, base = layers = _layers(venv)
    try:
        if len(state["envs"]) != base.num_envs:
            raise ValueError(f"it is of {len(state['envs'])} environments, and here are {base.num_envs}")
        _check_layers(layers, state["layers"])
        *outer_states, base_state = state["layers"]
        # Before the environments: it sets attributes again that may have changed in them since.
        _load_layer_state(base, base_state)
        differences = _in_envs(base, _load_env_state, [(env_state,) for env_state in state["envs"]])
        for layer, layer_state in zip(outer, outer_states, strict=True):
            _load_layer_state(layer, layer_state)
    except Exception as error:
        raise ValueError(
            f"The saved state does not fit these environments, build them as they were built when it was saved: {error}"
        ) from error
    told = "; ".join(dict.fromkeys(sentence for each in differences for sentence in each or []))
    if told:
        warnings.warn(
            f"The environments were built otherwise when their state was saved: {told}. Training goes on with them as "
            "they are now; build them as they were if that was not meant.",
            stacklevel=2,
        )


def why_not_restorable(venv: VecEnv) -> str | None:
    """
    :param venv: Environments between two steps
    :return: What cannot be saved and why, as a part of a sentence; None if all can be
    :raises RuntimeError: if a step is under way
    """
    *_, base = layers = _layers(venv)
    for layer in layers:
        why = _why_not(layer)
        if why is not None:
            return why
    if isinstance(base, SubprocVecEnv) and not all(base.env_is_wrapped(_Reach())):  # type: ignore[arg-type]
        return "an environment in a worker process can only be reached through a wrapper, such as Monitor, and has none"
    return next((why for why in _in_envs(base, _why_not_env, [()] * base.num_envs) if why is not None), None)


class _Reach:
    """Stands for a wrapper's class in ``env_is_wrapped``, which is the one question that a worker process of SB3 hands
    its environment to: asked whether the outermost wrapper is of this class, it says yes, and gives the wrapper a
    method that calls any function with it."""

    def __instancecheck__(self, env: gym.Env) -> bool:
        env._sb3_cure_call = functools.partial(_call, env)  # type: ignore[attr-defined]
        return True


def _call(env: gym.Env, function: Callable[..., Any], *arguments: Any) -> tuple[Any, str | None]:
    """Result, or what went wrong: an exception would end the worker."""
    try:
        return function(env, *arguments), None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"


def _in_envs(venv: VecEnv, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Call a function with each environment, wherever that lives, and arguments of its own."""
    if isinstance(venv, DummyVecEnv):
        return [function(env, *own) for env, own in zip(venv.envs, arguments, strict=True)]
    if not isinstance(venv, SubprocVecEnv):
        return [None] * venv.num_envs  # a VecEnv with a state_dict of its own, environments included
    venv.env_is_wrapped(_Reach())  # type: ignore[arg-type]
    results = []
    for index, own in enumerate(arguments):
        [(result, error)] = venv.env_method("_sb3_cure_call", function, *own, indices=index)
        if error is not None:
            raise RuntimeError(f"The worker of environment {index} could not save or load its state: {error}")
        results.append(result)
    return results


def _layers(outermost: Any) -> list[Any]:
    """All layers, the outermost first; without that of overlapped updates, which is put on in ``learn``."""
    layers = [outermost]
    while isinstance(layers[-1], gym.Wrapper | VecEnvWrapper):
        layers.append(layers[-1].venv if isinstance(layers[-1], VecEnvWrapper) else layers[-1].env)
    if getattr(layers[-1], "waiting", False) and isinstance(layers[-1], SubprocVecEnv):
        raise RuntimeError("A step of the environments is under way: call step_wait() before their state is touched.")
    return [layer for layer in layers if not isinstance(layer, OverlappedVecEnv)]


def _has_state_dict(layer: Any) -> bool:
    # Of the class: an instance of VecEnvWrapper also shows what it wraps.
    return hasattr(type(layer), "state_dict") and hasattr(type(layer), "load_state_dict")


def _is_dmc(layer: Any) -> bool:
    return type(layer).__module__ == _SHIMMY  # without importing shimmy, which needs OpenGL


def is_plain(value: Any) -> bool:
    """
    :param value: Anything
    :return: Whether it can be saved: numbers, strings, arrays, and lists and dictionaries of these
    """
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and is_plain(each) for key, each in value.items())
    is_array = isinstance(value, th.Tensor) or (isinstance(value, np.ndarray) and value.dtype.kind in "biuf")
    return value is None or is_array or isinstance(value, bool | int | float | str | np.number | np.bool_)


def _why_not(layer: Any) -> str | None:
    name = type(layer).__name__
    if isinstance(layer, FaultTolerantSubprocVecEnv):
        for given in (*layer._attributes, *layer._options, *layer._last_options):
            for key, value in given.items():
                if not is_plain(value):
                    return (
                        f"{name} was given {key} of type {type(value).__name__} (set_attr, set_options), not plain data"
                    )
    if _has_state_dict(layer) or _class_of(type(layer)) in ATTRIBUTES:
        return None
    if _is_dmc(layer):
        from dm_control.rl.control import Environment

        task = type(getattr(layer._env, "task", None))
        if type(layer._env) is Environment and task.__module__.startswith(_SUITE):
            return None
        return f"dm_control's {type(layer._env).__name__} of the task {task.__name__} is not one of dm_control.suite"
    if isinstance(layer, gym.Wrapper | VecEnvWrapper):
        return f"the wrapper {name} may keep a state of its own and has no state_dict() and load_state_dict(state)"
    return f"the environment {name} has no state_dict() and load_state_dict(state)"


def _why_not_env(env: gym.Env) -> str | None:
    return next((why for why in map(_why_not, _layers(env)) if why is not None), None)


def _env_state(env: gym.Env) -> list[dict[str, Any]]:
    return [_layer_state(layer) for layer in _layers(env)]


def _load_env_state(env: gym.Env, states: list[dict[str, Any]]) -> list[str]:
    """
    :return: Where the environment was built otherwise
    """
    layers = _layers(env)
    _check_layers(layers, states)
    # The base first: loading an outer layer may look at what it wraps.
    for layer, state in zip(reversed(layers), reversed(states), strict=True):
        _load_layer_state(layer, state)
    return [told for layer, state in zip(layers, states, strict=True) for told in _built_otherwise(layer, state)]


def _check_layers(layers: list[Any], states: list[dict[str, Any]]) -> None:
    found, saved = [_class_of(type(layer)).__name__ for layer in layers], [state["layer"] for state in states]
    if found != saved:
        raise ValueError(f"it is of {' around '.join(saved)}, and here is {' around '.join(found)}")


def _built_otherwise(layer: Any, state: dict[str, Any]) -> Iterator[str]:
    here, there = _how_built(layer), state.get("built", {})
    for name in sorted(here.keys() & there.keys()):
        if here[name] != there[name]:
            yield f"{state['layer']} with {name}={there[name]!r}, now {here[name]!r}"


def _how_built(layer: Any) -> dict[str, Any]:
    """Plain arguments of the constructor, as far as Gymnasium knows them, and the id of an environment."""
    arguments = getattr(layer, "_saved_kwargs", None) or {}
    if isinstance(layer, gym.Env) and not isinstance(layer, gym.Wrapper) and layer.spec is not None:
        arguments = {"id": layer.spec.id}
    return {name: _builtin(value) for name, value in arguments.items() if is_plain(value) and name not in _HARMLESS}


def _builtin(value: Any) -> Any:
    """With lists and Python's own numbers instead of tuples and numpy's, of which others may be equal."""
    if isinstance(value, list | tuple):
        return [_builtin(part) for part in value]
    if isinstance(value, dict):
        return {key: _builtin(part) for key, part in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic | th.Tensor) else value


def _layer_state(layer: Any) -> dict[str, Any]:
    if _has_state_dict(layer):
        own = copy.deepcopy(layer.state_dict())
    elif _is_dmc(layer):
        own = _dmc_state(layer)
    else:
        own = _plain(layer)
    state = {"layer": _class_of(type(layer)).__name__, "built": _how_built(layer), "own": own}
    state["spaces"] = [_generator_state(space._np_random) for space in _spaces(layer)]
    if isinstance(layer, gym.Env) and not isinstance(layer, gym.Wrapper):
        state["np_random"] = _generator_state(layer._np_random)
        state["np_random_seed"] = layer._np_random_seed
    return state


def _load_layer_state(layer: Any, state: dict[str, Any]) -> None:
    if _has_state_dict(layer):
        layer.load_state_dict(copy.deepcopy(state["own"]))
    elif _is_dmc(layer):
        _load_dmc_state(layer, state["own"])
    else:
        _restored(layer, state["own"])
    if type(layer) is wrappers.PassiveEnvChecker:
        # In an episode's first two steps this compares with data of the step before, which are not saved.
        layer.checked_step = layer.checked_data_reuse = True
    for space, generator in zip(_spaces(layer), state["spaces"], strict=True):
        space._np_random = _generator(generator)  # type: ignore[assignment]
    if state.get("np_random") is not None:
        layer._np_random = _generator(state["np_random"])
        layer._np_random_seed = state["np_random_seed"]


def _plain(value: Any) -> Any:
    """A copy of what is to be saved of a value."""
    if _class_of(type(value)) in ATTRIBUTES:
        own = vars(value)
        return {name: _plain(own[name]) for name in ATTRIBUTES[_class_of(type(value))] if name in own}
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, deque) else copy.deepcopy(value)


def _restored(current: Any, saved: Any) -> Any:
    """The saved value, in the object that holds such values now where it is one of those above."""
    if _class_of(type(current)) in ATTRIBUTES:
        for name in ATTRIBUTES[_class_of(type(current))]:
            if name in saved:
                setattr(current, name, _restored(vars(current).get(name), saved[name]))
        return current
    if isinstance(current, dict) and isinstance(saved, dict):
        return {key: _restored(current.get(key), part) for key, part in saved.items()}
    saved = copy.deepcopy(saved)
    return deque(saved, current.maxlen) if isinstance(current, deque) else saved


def _spaces(layer: Any) -> list[gym.Space]:
    """Both spaces of a layer and all that they are composed of: each draws from a generator of its own."""
    spaces = [layer.action_space, layer.observation_space]
    for space in spaces:  # grows meanwhile
        for value in vars(space).values():
            parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else [value]
            spaces += [part for part in parts if isinstance(part, gym.Space)]
    return spaces


def _generator_state(generator: Any) -> dict[str, Any] | None:
    return copy.deepcopy(dict(generator.bit_generator.state)) if isinstance(generator, np.random.Generator) else None


def _generator(state: dict[str, Any] | None) -> np.random.Generator | None:
    if state is None:
        return None
    bits = _BIT_GENERATORS[state["bit_generator"]]()
    bits.state = copy.deepcopy(state)
    return np.random.Generator(bits)


def _integration_state() -> int:
    import mujoco

    return int(mujoco.mjtState.mjSTATE_INTEGRATION)


def _dmc_state(env: Any) -> dict[str, Any]:
    control = env._env
    physics, task = control.physics, control.task
    return {
        "physics": physics.get_state(_integration_state()),
        "sensors": np.array(physics.data.sensordata),
        "model": {name: np.array(getattr(physics.model, name)) for name in _MODEL_ARRAYS},
        # Such as heights and weights that it measured at reset.
        "task": {name: copy.copy(value) for name, value in vars(task).items() if isinstance(value, _NUMBERS)},
        "random": task.random.get_state(legacy=False),
        "step_count": control._step_count,
        "reset_next_step": control._reset_next_step,
    }


def _load_dmc_state(env: Any, state: dict[str, Any]) -> None:
    import mujoco

    control = env._env
    physics, task = control.physics, control.task
    for name in _MODEL_ARRAYS:
        getattr(physics.model, name)[:] = state["model"][name]
    for hfield in range(physics.model.nhfield):
        with physics.contexts.gl.make_current() as context:
            context.call(mujoco.mjr_uploadHField, physics.model.ptr, physics.contexts.mujoco.ptr, hfield)
    physics.set_state(state["physics"], _integration_state())
    # dm_control ends a step with this, and the next begins in the middle of one; it leaves the warm start alone.
    mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
    physics.data.sensordata[:] = state["sensors"]  # those of forces are measured in the other half
    vars(task).update(copy.deepcopy(state["task"]))
    task.random.set_state(state["random"])
    control._step_count = state["step_count"]
    control._reset_next_step = state["reset_next_step"]
