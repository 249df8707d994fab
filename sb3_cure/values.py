"""What a value must be, and names that were misspelt: the checks that are the same wherever a user types."""

import difflib
import importlib
import inspect
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

#: Most episodes that logged means are over
MAX_STATS_WINDOW = 10**6


def is_integer(value: Any, low: int) -> bool:
    """
    :param value: What the user gave
    :param low: The least that is allowed
    :return: Whether it is a whole number (no boolean, no 3.0) of at least ``low``
    """
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= low)


def is_number(value: Any, low: float = -np.inf, high: float = np.inf) -> bool:
    """
    :param value: What the user gave
    :param low: The least that is allowed
    :param high: The most that is allowed
    :return: Whether it is a finite number (no boolean) within these bounds
    """
    numeric = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return numeric and bool(low <= value <= high and np.isfinite(value))


def is_one_of(value: Any, choices: Iterable[Any]) -> bool:
    """
    :param value: What the user gave, hashable or not
    :param choices: Strings, booleans, None
    :return: Whether it is one of them; 1 is not True
    """
    return any(isinstance(value, type(choice)) and value == choice for choice in choices)


def check_keywords(where: str, given: Any, known: Iterable[str] | None, whose: str) -> None:
    """
    :param where: What the user gave them as, such as ``"policy_kwargs"``
    :param given: What the user gave
    :param known: Names of the arguments there are, or None if that is unknown
    :param whose: Whose arguments they are
    :raises ValueError: if it is no mapping
    :raises TypeError: if one is unknown
    """
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"{where} is {given!r}, but it must be a dictionary of arguments of {whose} by their names: write "
            f"{where}=dict(name=value)."
        )
    for name in given if known is not None else ():
        if name not in (names := sorted(known or ())):
            close = difflib.get_close_matches(name, names, n=1)
            there = ", ".join(names) if len(names) <= 12 else f"what help({whose}) lists"
            fix = f"write {close[0]!r}" if close else f"remove it, or choose of {there}"
            raise TypeError(f"{where} has {name!r}, but {whose} has no such argument: {fix}.")


def check_optimizer_kwargs(where: str, given: Any) -> None:
    """
    :param where: What the user gave them as
    :param given: What the user gave
    :raises TypeError: if a learning rate is among them
    """
    if isinstance(given, Mapping) and "lr" in given:
        raise TypeError(
            f"{where} has lr={given['lr']!r}, but everything learns at learning_rate: remove it, and change "
            "learning_rate."
        )


def arguments_of(function: Any) -> set[str] | None:
    """
    :param function: A class, of whose constructor the arguments are asked, or a function
    :return: What it takes by name; None if that cannot be told, as where other code takes any name
    """
    names: set[str] = set()
    classes = inspect.getmro(function) if inspect.isclass(function) else ()
    constructors = [vars(cls)["__init__"] for cls in classes if "__init__" in vars(cls)]
    for constructor in constructors or [function]:
        try:
            parameters = list(inspect.signature(constructor).parameters.values())
        except ValueError:  # of some functions written in C
            return None
        names |= {p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)} - {"self"}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            return names
        # Only of our own and SB3's classes it is known that they hand on the rest.
        if not str(constructor.__module__).startswith(("sb3_cure.", "stable_baselines3.")):
            return None
    return None


def import_environments(module: str, where: str) -> None:
    """Import a module that registers environments with Gymnasium.

    :param module: Its name
    :param where: Where the user gave it
    :raises ValueError: if it cannot be imported
    """
    try:
        importlib.import_module(module)
    except (ImportError, TypeError, ValueError) as error:  # TypeError: of a relative name
        raise ValueError(
            f"{where} names the module {module!r}, which cannot be imported ({' '.join(str(error).split())}): name one "
            "of the working directory or an installed one."
        ) from error


def check_folder(name: str, folder: Any) -> None:
    """Whether files can be written to a folder, which is not made yet.

    :param name: What the user gave it as
    :param folder: A path
    :raises ValueError: if it is no path, or a file or a folder without permission to write is in the way
    """
    if not isinstance(folder, str | os.PathLike):
        raise ValueError(f"{name} is {folder!r}, but it must be the path of a folder: give one.")
    there = Path(folder).absolute()
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise ValueError(f"{name} is {str(folder)!r}, but {there} is a file: name a folder, or remove the file.")
    if not os.access(there, os.W_OK | os.X_OK) or _is_read_only(there):
        raise ValueError(
            f"{name} is {str(folder)!r}, but {there} cannot be written to: name another folder, or change its "
            "permissions."
        )


def _is_read_only(folder: Path) -> bool:
    """Of a file system: root may write where others may not, but not there."""
    return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)


def entry_for(task: str, entries: Collection[str]) -> str | None:
    """Which entry of a YAML file of settings holds for a task.

    :param task: Id of the environment, such as ``"dmc_pixels/walker-walk-v0"``, perhaps with the module that registers
        it (``"my_module:My-v0"``)
    :param entries: The file's keys
    :return: Its own, else that of its namespace (``"dmc_pixels"``), else ``"default"``; None if there is none of these
    """
    name = task.rpartition(":")[2]
    return next((each for each in (task, name, name.rpartition("/")[0], "default") if each and each in entries), None)
