"""State of environments, so that an interrupted episode continues bit for bit, or the reason why it cannot.

Each layer (environment, wrapper, vectorized environment) is saved by the first of these that it offers:

1. ``state_dict()`` and ``load_state_dict(state)``. The state need not contain the layers inside, nor the generators of
   spaces and ``np_random``.
2. DeepMind Control tasks of the suite: MuJoCo's integration state, what the task changed in the model, its random
   stream, the step count.
3. Layers of Gymnasium, SB3, rl-zoo3 and this package: their plain attributes (numbers, strings, arrays, NumPy's
   generators, and containers of these). Classes, spaces and stateless functions are taken from the new
   environment.
4. Other wrappers without attributes of their own: nothing needs to be saved.

Any other layer makes its environment begin a new episode, because its attributes may not be all of its state; what
the other layers keep, such as running statistics, is restored all the same. Layers are compared by their classes and
the environment's id, not by their arguments.
"""

import copy
import inspect
import random
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
#: Attributes of a wrapper that keeps nothing
_BARE = {*vars(gym.Wrapper(gym.Env())), "_saved_kwargs"}
#: Packages whose layers keep their state in plain attributes
_KNOWN = ("gymnasium.", "stable_baselines3.", "sb3_contrib.", "rl_zoo3.", "sb3_cure.")


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
        layers = _layers(self.env)
        return {"built": _describe(layers), "layers": _layer_states(layers), "random": random_streams()}

    def load_exact_state(self, state: dict[str, Any]) -> str | None:
        """Restore the state.

        :param state: Result of ``exact_state``
        :return: Why the episode cannot be continued, or None
        """
        load_random_streams(state["random"])
        return _load_layers(_layers(self.env), state["layers"])

    def describe(self) -> str:
        """Name the layers of the environment.

        :return: Their classes, the outermost first, and the environment's id
        """
        return _describe(_layers(self.env))


def vec_env_state(venv: VecEnv) -> dict[str, Any]:
    """Get the state of vectorized environments between two steps.

    :param venv: Environments
    :return: Values that ``encode`` knows
    """
    layers = _layers(venv)
    state: dict[str, Any] = {"built": [_describe(layers)], "envs": [], "error": None}
    try:
        # The environments first: this may find a dead worker, which is then replaced.
        state["envs"] = _call_each(venv, "exact_state")
        state["built"] += [each.pop("built") for each in state["envs"]]
    except (NotKept, OSError, EOFError, RuntimeError) as failure:
        state["error"] = str(failure) or type(failure).__name__
    return {**state, "layers": _layer_states(layers)}


def saved_error(state: dict[str, Any]) -> str | None:
    """Get the first reason why a saved state is incomplete.

    :param state: Result of ``vec_env_state``
    :return: A part of a sentence, or None
    """
    layers = [*state["layers"], *(layer for env in state["envs"] for layer in env["layers"])]
    return state["error"] or next((layer["error"] for layer in layers if layer["error"]), None)


def load_vec_env_state(venv: VecEnv, state: dict[str, Any]) -> str | None:
    """Restore vectorized environments with the same layers; they need not have been reset.

    :param venv: Environments
    :param state: Result of ``vec_env_state``
    :return: Why they cannot continue their episodes, so that they must be reset; None if they can
    :raises ValueError: if they have other layers or another id
    """
    layers = _layers(venv)
    error = saved_error(state)
    built = [_describe(layers)]
    try:
        built += _call_each(venv, "describe") if state["envs"] else []
    except NotKept as failure:
        error, state = str(failure), {**state, "envs": [], "built": state["built"][:1]}
    for saved, own in zip(state["built"], built, strict=True):
        if saved != own:
            raise ValueError(
                f"the saved state is of {saved}, and here is {own}: build the environments as they were when it was "
                "saved."
            )
    # The base before its environments, as it may set attributes of theirs.
    errors = [error, _load_layers(layers, state["layers"]), *_call_each(venv, "load_exact_state", state["envs"])]
    return next(filter(None, errors), None)


def _call_each(venv: VecEnv, method: str, arguments: list[Any] | None = None) -> list[Any]:
    """Call a method of ``ResumableEnv`` for each environment."""
    base = venv.unwrapped
    given = [()] * venv.num_envs if arguments is None else [(each,) for each in arguments]
    if isinstance(base, DummyVecEnv):
        return [getattr(ResumableEnv(env), method)(*own) for env, own in zip(base.envs, given, strict=False)]
    if not isinstance(base, SubprocVecEnv) or not given:
        return []
    if not all(text.startswith(f"<{ResumableEnv.__name__}<") for text in base.env_method("__str__")):
        raise NotKept(
            "environments in worker processes need sb3_cure.persistence.ResumableEnv as their outermost wrapper "
            "(make_vec_env(..., wrapper_class=ResumableEnv))"
        )
    return [base.env_method(method, *own, indices=index)[0] for index, own in enumerate(given)]


# --------------------------------------------------------------------- layers


def _layers(outermost: Any) -> list[Any]:
    """List an environment's layers, the outermost first."""
    layers = [outermost]
    while isinstance(layers[-1], gym.Wrapper | VecEnvWrapper):
        layers.append(layers[-1].venv if isinstance(layers[-1], VecEnvWrapper) else layers[-1].env)
    return layers


def _describe(layers: list[Any]) -> str:
    spec = layers[-1].spec if isinstance(layers[-1], gym.Env) else None
    return " around ".join(type(layer).__name__ for layer in layers) + (f" ({spec.id})" if spec else "")


def _layer_states(layers: list[Any]) -> list[dict[str, Any]]:
    states: list[dict[str, Any]] = []
    for layer in layers:
        state: dict[str, Any] = {"error": None}
        try:
            state |= _layer_state(layer, layers)
        except (NotKept, TypeError) as error:  # TypeError: of a type that files do not hold
            state["error"] = str(error)
        except Exception as error:
            state["error"] = f"{type(layer).__name__}.state_dict() raised {error!r}"
        states.append(state)
    return states


def _layer_state(layer: Any, layers: list[Any]) -> dict[str, Any]:
    name, own, attributes = type(layer).__name__, None, vars(layer)
    if has_state_dict(layer):
        own, attributes = layer.state_dict(), {"_np_random": attributes.get("_np_random")}
    elif _is_dmc(layer):
        if not is_of_the_suite(layer._env):
            raise NotKept(f"the task {type(layer._env.task).__name__} is not one of dm_control.suite")
        own, attributes = integration_state(layer._env), {}
    elif isinstance(layer, DummyVecEnv | SubprocVecEnv):
        attributes = {"_seeds": layer._seeds, "_options": layer._options}
    elif isinstance(layer, wrappers.PassiveEnvChecker):
        # It compares the first observations and infos, which may not be plain data; a resumed one has done so already.
        attributes = dict.fromkeys(("checked_reset", "checked_step", "checked_data_reuse"), True)
    elif not (_is_known(layer) or (isinstance(layer, gym.Wrapper) and attributes.keys() <= _BARE)):
        raise NotKept(f"{name} has no state_dict() and load_state_dict(state)")
    no_state = set().union(*(names for kind, names in _NO_STATE.items() if isinstance(layer, kind)))
    no_state |= _RENDERERS if type(layer).__module__.startswith("gymnasium.envs.") else set()
    values, arguments = {}, vars(layer).get("_saved_kwargs", ())  # the new environment has its own
    for key, value in attributes.items():
        is_built = isinstance(value, EnvSpec | gym.Space | np.dtype | np.ufunc) or _keeps_nothing(value)
        if key not in no_state and not is_built and not any(value is other for other in layers):
            encode(value, f"{name}.{key}", {})
            if key.removeprefix("_") not in arguments:
                values[key] = value
    encode(own, f"{name}.state_dict()", {})
    drawn = {key: [part._np_random for part in _parts(space)] for key, space in _spaces(layer).items()}
    # A copy, as the environment may write into its own
    return copy.deepcopy({"own": own, "attributes": values, "spaces": drawn})


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
    for key, generators in state["spaces"].items():
        for space, generator in zip(_parts(getattr(layer, key)), generators, strict=True):
            space._np_random = generator
    vars(layer).update(state["attributes"])
    if has_state_dict(layer):
        layer.load_state_dict(state["own"])
    elif _is_dmc(layer):
        load_integration_state(layer._env, state["own"])


def has_state_dict(layer: Any) -> bool:
    # Asks the class: an instance of VecEnvWrapper also shows the attributes of what it wraps.
    return hasattr(type(layer), "state_dict") and hasattr(type(layer), "load_state_dict")


def _is_known(layer: Any) -> bool:
    return isinstance(layer, gym.Env | VecEnvWrapper) and type(layer).__module__.startswith(_KNOWN)


def _keeps_nothing(value: Any) -> bool:
    """Whether a value is a class, or a function without an object or a closure that could hold state."""
    if not inspect.isroutine(value):
        return inspect.isclass(value)
    # Functions that known layers make themselves hold nothing but constructor arguments.
    is_known = (getattr(value, "__module__", None) or "").startswith(_KNOWN)
    holder = getattr(value, "__closure__", None) or getattr(value, "__self__", None)
    return is_known or holder is None or inspect.ismodule(holder)


def _is_dmc(layer: Any) -> bool:
    return type(layer).__module__ == "shimmy.dm_control_compatibility"  # which is not imported, as it needs OpenGL


def _spaces(layer: Any) -> dict[str, gym.Space]:
    own = {key: value for key, value in vars(layer).items() if isinstance(value, gym.Space)}
    return {**own, "action_space": layer.action_space, "observation_space": layer.observation_space}


def _parts(space: gym.Space) -> list[Any]:
    """List a space and all that it is composed of: each draws from a generator of its own."""
    inside = getattr(space, "spaces", ())
    parts = inside.values() if isinstance(inside, dict) else inside
    return [space, *(part for each in parts for part in _parts(each))]
