"""State of environments, so that an interrupted episode continues bit for bit, or the reason why it cannot.

Each layer (environment, wrapper, vectorized environment) is saved by the first of these that it offers:

1. ``state_dict()`` and ``load_state_dict(state)``. The state need not contain the layers inside, nor the generators of
   spaces and ``np_random``.
2. DeepMind Control tasks of the suite: MuJoCo's integration state, what the task changed in the model, its random
   stream, the step count.
3. Plain attributes: numbers, strings, arrays, NumPy's generators, and containers of these. Functions, classes and
   spaces must be the same in an environment that is built in the same way. State in class attributes, in module
   variables or on the side of a library is not seen.

A layer with any other attribute, or with one object under two names (which would be two after loading), makes its
environment begin a new episode; what the other layers keep, such as running statistics, is restored all the same.
"""

import copy
import inspect
import random
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecMonitor

from sb3_cure.envs.copy_observations import TransparentWrapper
from sb3_cure.envs.physics import integration_state, is_of_the_suite, load_integration_state
from sb3_cure.persistence.encoding import encode

_SPACES = ("action_space", "observation_space")
#: Attributes of known classes that are no state: other layers, constructor arguments, clocks, files
_NO_STATE: dict[type, set[str]] = {
    gym.Wrapper: {"env"},
    RecordConstructorArgs: {"_saved_kwargs"},
    wrappers.RecordEpisodeStatistics: {"episode_start_time", "time_queue"},
    Monitor: {"t_start", "episode_times", "results_writer"},
    VecMonitor: {"t_start", "results_writer"},
    VecEnvWrapper: {"venv", "class_attributes"},
}
#: What Gymnasium's own environments draw into
_RENDERERS = {"clock", "screen", "surf", "window", "window_surface"}


#: Packages whose wrappers share only arrays that they never write into
_KNOWN = ("gymnasium.wrappers.", "stable_baselines3.", "sb3_cure.")


class NotKept(Exception):
    """A state cannot be saved and restored exactly; the message says why."""


def random_streams() -> dict[str, Any]:
    """Get the states of this process's global generators.

    :return: States of Python's, NumPy's and PyTorch's (CPU) generators
    """
    return {"python": random.getstate(), "numpy": np.random.get_state(), "torch": th.get_rng_state()}


def load_random_streams(state: dict[str, Any]) -> None:
    """Set this process's global generators.

    :param state: Result of ``random_streams``
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])


class ResumableEnv(TransparentWrapper):
    """Outermost wrapper of an environment in a worker process, which lets it be resumed exactly.

    ``make_vec_env(make_env, 4, vec_env_cls=SubprocVecEnv, wrapper_class=ResumableEnv)``. SB3's ``SubprocVecEnv`` gives
    no other access to all layers of its environments. The worker's global random streams are kept, too.
    """

    def exact_state(self) -> dict[str, Any]:
        """Get the state of the environment and of this process.

        :return: Values to be sent to another process
        """
        return {"layers": env_state(self.env), "random": random_streams()}

    def load_exact_state(self, state: dict[str, Any]) -> str | ValueError | None:
        """Restore the state.

        :param state: Result of ``exact_state``
        :return: Why the episode cannot be continued, or None; the error itself if the environment was built in another
            way, as an exception would end SB3's worker
        """
        load_random_streams(state["random"])
        try:
            return load_env_state(self.env, state["layers"])
        except ValueError as error:
            return error


def vec_env_state(venv: VecEnv) -> dict[str, Any]:
    """Get the state of vectorized environments between two steps.

    :param venv: Environments
    :return: Values that ``encode`` knows
    """
    *_, base = layers = _layers(venv)
    envs, error = None, None
    try:
        # The environments first: this may find a dead worker, which is then replaced.
        if isinstance(base, DummyVecEnv):
            envs = [{"layers": env_state(env)} for env in base.envs]
        elif isinstance(base, SubprocVecEnv):
            if not all(text.startswith(f"<{ResumableEnv.__name__}<") for text in base.env_method("__str__")):
                raise NotKept(
                    "environments in worker processes need sb3_cure.persistence.ResumableEnv as their outermost "
                    "wrapper (make_vec_env(..., wrapper_class=ResumableEnv))"
                )
            envs = base.env_method("exact_state")
    except (NotKept, OSError, EOFError, RuntimeError) as failure:
        error = str(failure) or type(failure).__name__
    return {"layers": _layer_states(layers), "envs": envs, "error": error}


def restore_error(venv: VecEnv) -> str | None:
    """Get the reason why environments could not continue their episodes from a checkpoint.

    :param venv: Environments between two steps
    :return: A part of a sentence; None if all of their state can be kept
    """
    return saved_error(vec_env_state(venv))


def saved_error(state: dict[str, Any]) -> str | None:
    """Get the first reason why a saved state is incomplete.

    :param state: Result of ``vec_env_state``
    :return: A part of a sentence, or None
    """
    layers = [*state["layers"], *(layer for env in state["envs"] or [] for layer in env["layers"])]
    return state["error"] or next((layer["error"] for layer in layers if layer["error"]), None)


def load_vec_env_state(venv: VecEnv, state: dict[str, Any]) -> str | None:
    """Restore vectorized environments that were built in the same way; they need not have been reset.

    :param venv: Environments
    :param state: Result of ``vec_env_state``
    :return: Why they cannot continue their episodes, so that they must be reset; None if they can
    :raises ValueError: if they were built in another way
    """
    *_, base = layers = _layers(venv)
    _check_fingerprints(layers, state["layers"])
    # The base before its environments, as it may set attributes of theirs.
    errors = [saved_error(state), _load_layers(layers, state["layers"])]
    for index, own in enumerate(state["envs"] or []):
        if isinstance(base, DummyVecEnv):
            errors.append(load_env_state(base.envs[index], own["layers"]))
        elif isinstance(base, SubprocVecEnv):
            [error] = base.env_method("load_exact_state", own, indices=index)
            if isinstance(error, ValueError):
                raise error
            errors.append(error)
    return next(filter(None, errors), None)


def env_state(env: gym.Env) -> list[dict[str, Any]]:
    """Get the state of each layer of an environment.

    :param env: Environment between two steps
    :return: States, the outermost layer's first
    """
    layers = _layers(env)
    return _layer_states(layers)


def load_env_state(env: gym.Env, states: list[dict[str, Any]]) -> str | None:
    """Restore an environment that was built in the same way.

    :param env: Environment
    :param states: Result of ``env_state``
    :return: Why its episode cannot be continued, or None
    :raises ValueError: if it was built in another way
    """
    layers = _layers(env)
    _check_fingerprints(layers, states)
    return _load_layers(layers, states)


def _layers(outermost: Any) -> list[Any]:
    """List an environment's layers, the outermost first."""
    layers = [outermost]
    while isinstance(layers[-1], gym.Wrapper | VecEnvWrapper):
        layers.append(layers[-1].venv if isinstance(layers[-1], VecEnvWrapper) else layers[-1].env)
    return layers


def _layer_states(layers: list[Any]) -> list[dict[str, Any]]:
    states: list[dict[str, Any]] = [{"fingerprint": _fingerprint(layer), "error": None} for layer in layers]
    kept: list[Any] = []  # of foreign layers, as one may hold what belongs to another
    for layer, state in zip(layers, states, strict=True):
        try:
            state |= _layer_state(layer, layers, kept)
        except (NotKept, TypeError) as error:  # TypeError: of a type that files do not hold
            state["error"] = str(error)
        except Exception as error:
            state["error"] = f"{type(layer).__name__}.state_dict() raised {error!r}"
    return states


def _layer_state(layer: Any, layers: list[Any], kept: list[Any]) -> dict[str, Any]:
    name, own, attributes = type(layer).__name__, None, vars(layer)
    if _has_state_dict(layer):
        own, attributes = layer.state_dict(), {"_np_random": attributes.get("_np_random")}
    elif _is_dmc(layer):
        if not is_of_the_suite(layer._env):
            raise NotKept(f"the task {type(layer._env.task).__name__} is not one of dm_control.suite")
        own, attributes = integration_state(layer._env), {}
    elif isinstance(layer, DummyVecEnv | SubprocVecEnv):
        attributes = {"_seeds": layer._seeds, "_options": layer._options}
    elif isinstance(layer, wrappers.PassiveEnvChecker):
        # It compares the first observations and infos, which need not be plain, and is done with that when resumed.
        attributes = dict.fromkeys(("checked_reset", "checked_step", "checked_data_reuse"), True)
    elif not isinstance(layer, gym.Env | VecEnvWrapper):
        raise NotKept(f"{name} has no state_dict() and load_state_dict(state)")
    no_state = set().union(*(names for kind, names in _NO_STATE.items() if isinstance(layer, kind)))
    no_state |= _RENDERERS if type(layer).__module__.startswith("gymnasium.envs.") else set()
    functions, values = {}, {}
    for key, value in attributes.items():
        if key in no_state or isinstance(value, EnvSpec | gym.Space) or any(value is other for other in layers):
            continue
        if function := _stateless_name(value):
            functions[key] = function
        else:
            encode(value, f"{name}.{key}", {})
            values[key] = value
    if not type(layer).__module__.startswith(_KNOWN) and own is None:
        kept += values.values()
        check_sharing(kept, name)
    spaces = {key: value for key, value in vars(layer).items() if isinstance(value, gym.Space)}
    spaces |= {key: getattr(layer, key) for key in _SPACES}
    drawn = {key: [part._np_random for part in _parts(space)] for key, space in spaces.items()}
    encode(own, f"{name}.state_dict()", {})
    # A copy, as the environment may write into its own
    return copy.deepcopy({"own": own, "attributes": values, "functions": functions, "spaces": drawn})


def _load_layers(layers: list[Any], states: list[dict[str, Any]]) -> str | None:
    """Restore the innermost layer first, as others may look at what they wrap."""
    error = None
    for layer, state in reversed(list(zip(layers, copy.deepcopy(states), strict=True))):
        try:
            if state["error"] is None:
                _load_layer(layer, state)
        except Exception as failure:  # in a user's load_state_dict, or of attributes that differ
            error = f"the state of {type(layer).__name__} cannot be restored ({failure!r})"
    return error


def _load_layer(layer: Any, state: dict[str, Any]) -> None:
    for key, function in state["functions"].items():
        if _stateless_name(vars(layer).get(key)) != function:
            raise NotKept(f"{key} was {function}")
    for key, generators in state["spaces"].items():
        for space, generator in zip(_parts(getattr(layer, key)), generators, strict=True):
            space._np_random = generator
    vars(layer).update(state["attributes"])
    if _has_state_dict(layer):
        layer.load_state_dict(state["own"])
    elif _is_dmc(layer):
        load_integration_state(layer._env, state["own"])


def check_sharing(values: Iterable[Any], name: str) -> None:
    """Refuse objects and memory that are met twice, as they would be two after loading.

    :param values: Plain values
    :param name: What holds them
    :raises NotKept: if an object is met twice, or an array is in the memory of another object
    """
    found = Counter(identity for value in values for identity in _identities(value))
    if any(count > 1 for count in found.values()):
        raise NotKept(f"{name} keeps one object or memory under two names")


def _identities(value: Any) -> Iterator[int]:
    """Identities of mutable objects and of memory."""
    if isinstance(value, type(None) | bool | int | float | str | bytes | np.generic | Path):
        return
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biu" and not value.flags.c_contiguous:
            raise NotKept("sums over an array depend on its order in memory, which is not C's")
        while isinstance(value.base, np.ndarray):
            value = value.base
        if value.base is not None and value.flags.writeable:
            raise NotKept("an array is in the memory of another object")
    if isinstance(value, th.Tensor):
        value = value.untyped_storage()
    if not isinstance(value, tuple):
        yield value.data_ptr() if isinstance(value, th.UntypedStorage) else id(value)
    for part in [*_inside(value), *getattr(value, "__dict__", {}).values()]:
        yield from _identities(part)


def _inside(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return [*value, *value.values()]
    return value if isinstance(value, list | tuple | set | deque) else ()


def _stateless_name(value: Any) -> str:
    """Name of a function or class that keeps nothing; empty for all else."""
    if isinstance(value, np.ufunc | np.dtype) or inspect.isclass(value):
        return str(value)
    module = getattr(value, "__module__", None) or ""
    owner = getattr(value, "__self__", None)
    is_free = getattr(value, "__closure__", None) is None and (owner is None or inspect.ismodule(owner))
    # Functions that Gymnasium's wrappers make hold their constructor's arguments alone.
    is_stateless = inspect.isroutine(value) and (is_free or module.startswith("gymnasium."))
    return f"{module}.{value.__qualname__}" if is_stateless else ""


def _parts(space: gym.Space) -> list[Any]:
    """List a space and all that it is composed of: each draws from a generator of its own."""
    spaces = [space]
    for each in spaces:  # grows meanwhile
        values = [part for value in vars(each).values() for part in (value, *_inside(value))]
        spaces += [part for part in values if isinstance(part, gym.Space)]
    return spaces


def _has_state_dict(layer: Any) -> bool:
    # Of the class: an instance of VecEnvWrapper also shows what it wraps.
    return hasattr(type(layer), "state_dict") and hasattr(type(layer), "load_state_dict")


def _is_dmc(layer: Any) -> bool:
    return type(layer).__module__ == "shimmy.dm_control_compatibility"  # which is not imported, as it needs OpenGL


def _fingerprint(layer: Any) -> dict[str, str]:
    """Describe how a layer was built: class, id, and plain arguments as far as Gymnasium knows them."""
    spec = layer.spec if isinstance(layer, gym.Env) and not isinstance(layer, gym.Wrapper) else None
    arguments = {} if spec is None else {"id": spec.id}
    if isinstance(layer, RecordConstructorArgs):
        arguments |= layer._saved_kwargs
    # Python's numbers in the place of NumPy's, so that equal ones look alike
    arguments = {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in arguments.items()}
    plain = (bool, int, float, str, list, tuple, type(None))
    known = {name: repr(value) for name, value in arguments.items() if isinstance(value, plain)}
    return {"class": type(layer).__name__, **known}


def _check_fingerprints(layers: list[Any], states: list[dict[str, Any]]) -> None:
    here, there = [_fingerprint(layer) for layer in layers], [state["fingerprint"] for state in states]
    what, own = (" around ".join(layer["class"] for layer in each) for each in (there, here))
    if what == own and here != there:
        saved, new = next((s, n) for s, n in zip(there, here, strict=True) if s != n)
        name = next(name for name in sorted(saved | new) if saved.get(name) != new.get(name))
        what, own = f"{saved['class']} with {name}={saved.get(name)}", f"{name}={new.get(name)}"
    if what != own:
        raise ValueError(
            f"the saved state is of {what}, and here is {own}: build the environments as they were when it was saved."
        )
