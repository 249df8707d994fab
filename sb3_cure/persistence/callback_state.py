"""State of callbacks: their own ``state_dict()``, or the plain attributes that have changed since they were set up.

An object that a callback keeps under two names becomes two objects.
"""

import hashlib
import inspect
import io
from functools import partial
from typing import Any

from gymnasium import Env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.persistence.encoding import write_state
from sb3_cure.persistence.env_state import has_state_dict

#: Attribute with the contents of a callback's attributes when its first ``learn`` began
_INITIAL = "_sb3_cure_initial"
_OF_THE_RUN = ("parent", "locals", "globals", "num_timesteps", "verbose", _INITIAL)


def nested_callbacks(callback: BaseCallback) -> list[BaseCallback]:
    """List a callback and those inside it.

    :param callback: A callback
    :return: All callbacks, each once, in a fixed order
    """
    found: dict[int, BaseCallback] = {}

    def visit(each: BaseCallback) -> None:
        if id(each) in found:
            return
        found[id(each)] = each
        for name, value in vars(each).items():
            for child in _callbacks_in(value) if name != "parent" else []:
                visit(child)

    visit(callback)
    return list(found.values())


def note_contents(callback: BaseCallback) -> None:
    """Note what the attributes are before training; a callback may serve several calls of ``learn``.

    :param callback: Callback, without those inside it
    """
    vars(callback).setdefault(_INITIAL, {name: _content(value) for name, value in _attributes(callback).items()})


def callback_state(callback: BaseCallback) -> dict[str, Any]:
    """Get the state of a callback.

    :param callback: Callback, without those inside it
    :return: Values that ``encode`` knows; ``"missing"`` names the attributes that cannot be kept
    """
    state: dict[str, Any] = {"class": type(callback).__name__, "missing": []}
    if has_state_dict(callback):
        own = callback.state_dict()  # type: ignore[attr-defined]
        if _content(own) is None:
            return {**state, "changed": {}, "missing": [f"{state['class']}.state_dict()"]}
        return {**state, "own": own}
    attributes, initial = _attributes(callback), getattr(callback, _INITIAL)
    contents = {name: _content(value) for name, value in attributes.items()}
    changed = [name for name, content in contents.items() if content is not None and content != initial.get(name)]
    state["changed"] = {name: attributes[name] for name in changed}
    if not type(callback).__module__.startswith("stable_baselines3."):  # progress bars and the like are no state
        state["missing"] = [f"{state['class']}.{name}" for name, content in contents.items() if content is None]
    return state


def load_callback_state(callback: BaseCallback, state: dict[str, Any]) -> None:
    """Restore a callback; attributes that had not changed are left as the callback has them now.

    :param callback: Callback of the same class
    :param state: Result of ``callback_state``
    """
    if "own" in state:
        callback.load_state_dict(state["own"])  # type: ignore[attr-defined]
    else:
        vars(callback).update(state["changed"])


def _attributes(callback: BaseCallback) -> dict[str, Any]:
    """Select attributes that may be state: not those of the run, and neither environments, functions nor callbacks."""
    kinds = (BaseAlgorithm, BaseCallback, Env, Logger, VecEnv)
    attributes = {name: value for name, value in vars(callback).items() if name not in _OF_THE_RUN}
    return {
        name: value
        for name, value in attributes.items()
        if not (isinstance(value, (*kinds, type, partial)) or inspect.isroutine(value) or _callbacks_in(value))
    }


def _callbacks_in(value: Any) -> list[BaseCallback]:
    inside = value if isinstance(value, list | tuple) else [value]
    return [each for each in inside if isinstance(each, BaseCallback)]


def _content(value: Any) -> bytes | None:
    """Digest of a value in a file; None if its type cannot be written, it is too large, or it contains itself."""
    try:
        write_state(file := io.BytesIO(), {"value": value})
    except (TypeError, OSError, RecursionError):
        return None
    return hashlib.sha256(file.getbuffer()).digest()
