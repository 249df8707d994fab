"""Save and restore all that environments remember, so that a training goes on as if it had never stopped.

Each layer (environment, wrapper, vectorised environment) saves what is its own:

- What has ``state_dict()`` and ``load_state_dict(state)``: what the first returns is given to the second one. It need
  not contain the layers below, nor the generators of its spaces and ``np_random``.
- DeepMind Control environments of shimmy (those of :func:`sb3_cure.envs.make_dmc_env`): MuJoCo's full integration
  state, what the task changed in the model, the task's random stream, the step count.
- All others: the attributes in their ``__dict__``, if these are plain: numbers, strings, arrays, NumPy's generators,
  and lists, tuples, sets, deques and dictionaries of these. Functions, classes and spaces are taken to be the same in
  an environment that is built in the same way. State that lies elsewhere (class attributes, closures) is not seen.
"""

import functools
import inspect
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import PassiveEnvChecker
from gymnasium.wrappers.utils import RunningMeanStd as GymRunningMeanStd
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_cure.envs.physics import integration_state, is_of_the_suite, load_integration_state
from sb3_cure.vec_env import OverlappedVecEnv

# Helpers of wrappers, whose own attributes are saved
_HELPERS = (GymRunningMeanStd, RunningMeanStd, StackedObservations)
# No state of the environment: other layers, how they were built, files of results, the clock
_PASSED_OVER = (
    *("env", "venv", "spec", "_cached_spec", "_saved_kwargs", "metadata", "_metadata", "class_attributes"),
    *("results_writer", "t_start", "episode_start_time", "episode_times", "time_queue", "_sb3_cure_call"),
)
_SPACES = ("action_space", "observation_space")
# Stands among attributes for what a layer tells of itself
_OWN = "state_dict()"
# What renderers draw into, unless it is plain
_RENDERERS = ("clock", "screen", "surf", "viewer", "window")
_COLLECTIONS: dict[str, type] = {"tuple": tuple, "set": set, "frozenset": frozenset}
_PLAIN = (type(None), bool, int, float, str)


class _NotPlain(Exception):
    """Something that cannot be saved; the message names it."""


def vec_env_state(venv: VecEnv) -> dict[str, Any] | None:
    """
    :param venv: Environments between two steps
    :return: All that they remember, as plain data; None where a part cannot be saved (``why_not_restorable`` says
        which)
    :raises RuntimeError: if a step is under way, or if the ``state_dict`` of an environment in a worker fails
    """
    state, _ = _state_or_reason(venv)
    return state


def why_not_restorable(venv: VecEnv) -> str | None:
    """
    :param venv: Environments between two steps
    :return: What cannot be saved and why, as a part of a sentence; None if all can be
    :raises RuntimeError: if a step is under way
    """
    _, reason = _state_or_reason(venv)
    return reason


def load_vec_env_state(venv: VecEnv, state: dict[str, Any]) -> None:
    """Go on from where other environments were, which were built in the same way.

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
        _load_layer(base, base_state)
        _in_envs(base, _load_env_state, state["envs"])
        for layer, layer_state in zip(outer, outer_states, strict=True):
            _load_layer(layer, layer_state)
    except Exception as error:
        raise ValueError(
            f"The saved state does not fit these environments, build them as they were built when it was saved: {error}"
        ) from error


def statistics_state(venv: VecEnv, answers: bool) -> dict[str, list[Any]]:
    """
    :param venv: Environments that cannot tell all that they remember
    :param answers: Whether they can be asked at all
    :return: What each ``VecNormalize`` around them has learned, the outermost first; and the running means of wrappers
        such as Gymnasium's ``NormalizeReward`` in each of them
    """
    outer = [_layer_state(layer, [layer]) for layer in _normalizers(venv)]
    try:
        envs = _in_envs(_layers(venv)[-1], _env_statistics, [None] * venv.num_envs) if answers else []
    except _NotPlain:
        envs = []
    return {"layers": outer, "envs": envs}


def load_statistics(venv: VecEnv, state: dict[str, list[Any]]) -> None:
    """
    :param venv: Environments, which are to be reset after this
    :param state: Of ``statistics_state``
    """
    for layer, layer_state in zip(_normalizers(venv), state["layers"], strict=True):
        _load_layer(layer, layer_state)
    if state["envs"]:
        _in_envs(_layers(venv)[-1], _load_env_statistics, state["envs"])


def _env_statistics(env: gym.Env, _: Any) -> list[dict[str, Any]]:
    return [
        {key: _encoded(value, {}) for key, value in vars(layer).items() if type(value) in _HELPERS}
        for layer in _layers(env)
    ]


def _load_env_statistics(env: gym.Env, states: list[dict[str, Any]]) -> None:
    for layer, saved in zip(_layers(env), states, strict=True):
        for key, value in saved.items():
            _decoded(value, vars(layer)[key], {})


def _normalizers(venv: Any) -> Iterator[VecNormalize]:
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, VecNormalize):
            yield venv
        venv = venv.venv


def _state_or_reason(venv: VecEnv) -> tuple[dict[str, Any] | None, str | None]:
    *_, base = layers = _layers(venv)
    try:
        # The environments first: asking them may find a worker dead, which is then replaced.
        envs = _in_envs(base, _env_state, [None] * base.num_envs)
        reason = next((each for each in envs if isinstance(each, str)), None)
        state = {"layers": [_layer_state(layer, layers) for layer in layers], "envs": envs}
    except _NotPlain as error:
        return None, str(error)
    return (None, reason) if reason else (state, None)


class _Reach:
    """Stands for a wrapper's class in ``env_is_wrapped``, which is the one question that a worker process of SB3 hands
    its environment to: asked whether the outermost wrapper is of this class, it says yes, and gives the wrapper a
    method that calls any function with it."""

    def __instancecheck__(self, env: gym.Env) -> bool:
        env._sb3_cure_call = functools.partial(_call, env)  # type: ignore[attr-defined]
        return True


def _call(env: gym.Env, function: Callable[..., Any], argument: Any) -> tuple[Any, str | None]:
    """Result, or what went wrong: an exception would end the worker."""
    try:
        return function(env, argument), None
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"


def _in_envs(venv: VecEnv, function: Callable[[gym.Env, Any], Any], arguments: Sequence[Any]) -> list[Any]:
    """Call a function with each environment, wherever that lives, and an argument of its own."""
    if isinstance(venv, DummyVecEnv):
        return [function(env, argument) for env, argument in zip(venv.envs, arguments, strict=True)]
    if not isinstance(venv, SubprocVecEnv):
        return [None] * venv.num_envs  # a VecEnv with a state_dict of its own, environments included
    if not all(venv.env_is_wrapped(_Reach())):  # type: ignore[arg-type]
        raise _NotPlain(
            "an environment in a worker process can only be reached through a wrapper, such as Monitor, and has none"
        )
    results = []
    for index, argument in enumerate(arguments):
        [(result, error)] = venv.env_method("_sb3_cure_call", function, argument, indices=index)
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


def _env_state(env: gym.Env, _: Any) -> list[dict[str, Any]] | str:
    layers = _layers(env)
    try:
        return [_layer_state(layer, layers) for layer in layers]
    except _NotPlain as error:
        return str(error)


def _load_env_state(env: gym.Env, states: list[dict[str, Any]]) -> None:
    layers = _layers(env)
    _check_layers(layers, states)
    # The base first: loading an outer layer may look at what it wraps.
    for layer, state in zip(reversed(layers), reversed(states), strict=True):
        _load_layer(layer, state)


def _check_layers(layers: list[Any], states: list[dict[str, Any]]) -> None:
    found, saved = [_name(layer) for layer in layers], [state["layer"] for state in states]
    if found != saved:
        raise ValueError(f"it is of {' around '.join(saved)}, and here is {' around '.join(found)}")
    for layer, state in zip(layers, states, strict=True):
        here, there = _how_built(layer), state["built"]
        for name in sorted(here.keys() & there.keys()):
            if here[name] != there[name]:
                raise ValueError(f"it is of {state['layer']} with {name}={there[name]}, and here it is {here[name]}")


def _name(layer: Any) -> str:
    # rl-zoo puts a class of its own in the place of Gymnasium's TimeLimit.
    return type(layer).__name__.removeprefix("Patched")


def _how_built(layer: Any) -> dict[str, str]:
    """Plain arguments of the constructor, as far as Gymnasium knows them, and the id of an environment."""
    arguments = getattr(layer, "_saved_kwargs", None) or {}
    if isinstance(layer, gym.Env) and not isinstance(layer, gym.Wrapper) and layer.spec is not None:
        arguments = {"id": layer.spec.id}
    # With Python's own numbers instead of NumPy's, of which others may be equal
    arguments = {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in arguments.items()}
    return {name: repr(value) for name, value in arguments.items() if isinstance(value, (*_PLAIN, list, tuple))}


def _has_state_dict(layer: Any) -> bool:
    # Of the class: an instance of VecEnvWrapper also shows what it wraps.
    return hasattr(type(layer), "state_dict") and hasattr(type(layer), "load_state_dict")


def _is_dmc(layer: Any) -> bool:
    return type(layer).__module__ == "shimmy.dm_control_compatibility"  # which is not imported, as it needs OpenGL


def _layer_state(layer: Any, layers: list[Any]) -> dict[str, Any]:
    name, own, attributes = _name(layer), None, vars(layer)
    if _has_state_dict(layer):
        own = layer.state_dict()
        attributes = {name: value for name, value in attributes.items() if name in ("_np_random", "_np_random_seed")}
    elif _is_dmc(layer):
        if not is_of_the_suite(layer._env):
            raise _NotPlain(f"the task {type(layer._env.task).__name__} is not one of dm_control.suite")
        own, attributes = integration_state(layer._env), {}
    elif isinstance(layer, PassiveEnvChecker):
        # It looks at the first steps alone, and until then keeps a whole one. To a resumed environment they are over.
        attributes = {key: True for key in attributes if key.startswith("checked_")}
    elif isinstance(layer, DummyVecEnv | SubprocVecEnv):
        attributes = {"_seeds": layer._seeds, "_options": layer._options}
    elif isinstance(layer, VecEnv) and not isinstance(layer, VecEnvWrapper):
        raise _NotPlain(f"{name} has no state_dict() and load_state_dict(state)")
    memo: dict[int, int] = {}
    encoded = {}
    for key, value in {_OWN: own, **{space: getattr(layer, space) for space in _SPACES}, **attributes}.items():
        if key in _PASSED_OVER or any(value is other for other in layers) or (key in _RENDERERS and value is None):
            continue
        try:
            encoded[key] = _encoded(value, memo, as_built=key != _OWN)
        except _NotPlain as error:
            if key not in _RENDERERS:
                raise _NotPlain(
                    f"{name} keeps in {key} a {error}, which cannot be saved (give it state_dict() and "
                    "load_state_dict(state) of plain data)"
                ) from None
    return {"layer": name, "built": _how_built(layer), "attributes": encoded}


def _load_layer(layer: Any, state: dict[str, Any]) -> None:
    memo: dict[int, np.random.Generator] = {}
    for key, saved in state["attributes"].items():
        if key in _SPACES:
            _decoded(saved, getattr(layer, key), memo)
        elif key != _OWN:
            vars(layer)[key] = _decoded(saved, vars(layer).get(key), memo)
        elif _has_state_dict(layer):
            layer.load_state_dict(_decoded(saved, None, memo))
        elif _is_dmc(layer):
            load_integration_state(layer._env, _decoded(saved, None, memo))


def _encoded(value: Any, memo: dict[int, int], as_built: bool = True) -> Any:
    """Numbers, strings, arrays, lists and dictionaries of one key, which tells what other things its value stands for.

    :param value: Anything
    :param memo: Numbers of the generators so far, by their ``id``, as two attributes may share one
    :param as_built: Whether functions and classes can be those that are there when the state is loaded
    :raises _NotPlain: if it cannot be saved
    """
    encoded = functools.partial(_encoded, memo=memo, as_built=as_built)
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is np.ndarray and value.dtype.kind in "biuf":
        return value.copy()
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return {"number": np.asarray(value)}
    if kind is list:
        return list(map(encoded, value))
    if kind in (dict, OrderedDict):
        return {"dict": [[encoded(key), encoded(part)] for key, part in value.items()]}
    if kind is deque:
        return {"deque": [value.maxlen, list(map(encoded, value))]}
    if kind.__name__ in _COLLECTIONS:
        return {kind.__name__: list(map(encoded, value))}
    if kind is np.random.Generator:
        return {"generator": [memo.setdefault(id(value), len(memo)), encoded(value.bit_generator.state)]}
    if kind is np.random.RandomState:
        return {"random_state": encoded(value.get_state(legacy=False))}
    if isinstance(value, gym.Space) and as_built:
        return {"space": [encoded(space._np_random) for space in _parts(value)]}
    if kind in _HELPERS and as_built:
        return {"helper": {key: encoded(part) for key, part in vars(value).items()}}
    if as_built and (inspect.isroutine(value) or inspect.isclass(value) or kind in (functools.partial, np.ufunc)):
        return {"as built": None}
    raise _NotPlain(kind.__name__)


def _decoded(saved: Any, current: Any, memo: dict[int, np.random.Generator]) -> Any:
    """
    :param saved: Result of ``_encoded``
    :param current: What there is now in its place
    :param memo: The generators so far, by number
    :return: What was saved
    """
    if isinstance(saved, list):
        there = current if isinstance(current, list) else []
        return [_decoded(part, there[i] if i < len(there) else None, memo) for i, part in enumerate(saved)]
    if not isinstance(saved, dict):
        return saved.copy() if isinstance(saved, np.ndarray) else saved
    [(kind, value)] = saved.items()
    if kind == "number":
        return value[()]
    if kind == "dict":
        entries = current if isinstance(current, dict) else {}
        pairs = [(_decoded(key, None, memo), part) for key, part in value]
        return {key: _decoded(part, entries.get(key), memo) for key, part in pairs}
    if kind == "deque":
        return deque(_decoded(value[1], None, memo), value[0])
    if kind in _COLLECTIONS:
        return _COLLECTIONS[kind](_decoded(value, None if current is None else list(current), memo))
    if kind == "generator":
        number, state = value
        if number not in memo:
            memo[number] = _generator(_decoded(state, None, memo), current, memo)
        return memo[number]
    if kind == "random_state":
        current = current if isinstance(current, np.random.RandomState) else np.random.RandomState()
        current.set_state(_decoded(value, None, memo))
    elif kind == "space":
        for space, generator in zip(_parts(current), value, strict=True):
            space._np_random = _decoded(generator, space._np_random, memo)
    elif kind == "helper":
        for key, part in value.items():
            vars(current)[key] = _decoded(part, vars(current).get(key), memo)
    return current


def _generator(state: dict[str, Any], current: Any, memo: dict[int, np.random.Generator]) -> np.random.Generator:
    """The current generator if it can take the state, as others may hold it, too."""
    kind = getattr(np.random, state["bit_generator"])
    is_free = isinstance(current, np.random.Generator) and all(current is not other for other in memo.values())
    if not (is_free and type(current.bit_generator) is kind):
        current = np.random.Generator(kind())
    current.bit_generator.state = state
    return current


def _parts(space: gym.Space) -> list[Any]:
    """A space and all that it is composed of: each draws from a generator of its own."""
    spaces = [space]
    for each in spaces:  # grows meanwhile
        for value in vars(each).values():
            parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else [value]
            spaces += [part for part in parts if isinstance(part, gym.Space)]
    return spaces
