"""Algorithms and YAML files of the package by name, such as ``fast/cure_sac_ae``."""

import importlib
import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.utils import LinearSchedule

from sb3_cure.cli.usage import UsageError, missing_file, nearest, one_sentence
from sb3_cure.cure.algorithms import CuReSAC, CuReTQC

#: Algorithms by their name for ``--algo`` and in grids
ALGORITHMS: dict[str, Any] = {"cure_sac": CuReSAC, "cure_tqc": CuReTQC}
DEFAULT_ALGORITHM = "cure_sac"
#: Arguments that may name a class of the user's, as ``my_module.MyClass``, which no saved model holds
CLASS_ARGUMENTS = ("srl", "intrinsic")
#: Settings of methods, for ``sb3-cure train --conf-file`` and for grids
ZOO = Path(__file__).parents[1] / "zoo_configs"
#: Grids, for ``sb3-cure experiment``
GRIDS = ZOO / "experiments"


def zoo_file(name: str | Path, folder: Path = ZOO) -> Path:
    """Find a YAML file.

    :param name: A file of the package, by its path in ``folder`` without suffix; or the path of another, with suffix
    :param folder: ``ZOO`` or ``GRIDS``
    :return: Path of the file; one with a suffix is returned as it is, whether it exists or not
    :raises UsageError: with the nearest names, for an unknown one
    """
    path = Path(name)
    if path.suffix:
        return path
    known = packaged_files(folder)
    if path.as_posix() not in known:
        raise UsageError(
            f"{str(name)!r} is neither the path of a YAML file nor a name of the package's, such as "
            f"{next(iter(known))}{nearest(str(name), known)}"
        )
    return known[path.as_posix()]


def packaged_files(folder: Path = ZOO) -> dict[str, Path]:
    """List the package's YAML files.

    :param folder: ``ZOO`` or ``GRIDS``
    :return: Path by name
    """
    files = [*sorted(folder.glob("*.yml")), *sorted(folder.glob("fast/*.yml"))]
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}


class Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-6 and 1e6 as numbers, the latter as a whole one, and refuses a key that is there twice.

    YAML 1.1 reads them as text, and PyYAML keeps the last of equal keys.
    """

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        """Read a mapping.

        :param anchor: As in PyYAML
        :return: Its node
        :raises yaml.YAMLError: If a key is there twice
        """
        node = super().compose_mapping_node(anchor)
        names = [key.value for key, _ in node.value]
        for name in names:
            if names.count(name) > 1:
                raise yaml.YAMLError(f"{name!r} is there twice, in the mapping of line {node.start_mark.line + 1}")
        return node

    def construct_exponential(self, node: yaml.ScalarNode) -> float:
        """Read a number with an exponent.

        :param node: Its node
        :return: An int, such as a buffer's size, if it is whole
        """
        number = float(node.value)
        return int(number) if number.is_integer() else number


Loader.add_implicit_resolver("!exponential", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789"))
Loader.add_constructor("!exponential", Loader.construct_exponential)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the mapping that a YAML file holds.

    :param path: The file
    :return: The mapping
    :raises UsageError: with the nearest names of files if there is none, or if it holds something else
    """
    if not path.exists():
        raise UsageError(missing_file(path, [*packaged_files(GRIDS), *packaged_files()]))
    try:
        content = yaml.load(path.read_text(), Loader)
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(
            f"{path} cannot be read ({one_sentence(error)}): "
            "give the path of a YAML file, or a name of the package's without suffix."
        ) from None
    if not isinstance(content, dict):
        raise UsageError(f"{path} holds {content!r:.60}, but it must be a mapping (key: value).")
    return content


def zoo_entry(path: Path, task: str, modules: Sequence[str] = ()) -> dict[str, Any]:
    """Read a task's settings from a zoo file: the entry of its id, else of its namespace, else ``default``.

    :param path: The file
    :param task: Gymnasium id, or ``my_module:My-v0``
    :param modules: Further modules that register environments, whose ``module:id`` come first
    :return: The entry
    :raises UsageError: if there is none
    """
    entries, own = read_yaml(path), task.rpartition(":")[2]
    for key in (*(f"{module}:{own}" for module in modules), task, own, own.rpartition("/")[0], "default"):
        if isinstance(entries.get(key), dict):
            return entries[key]
    raise UsageError(f"{path} has neither a mapping {task!r} nor 'default'.")


#: Settings that rl-zoo3's programs use, and grids do not
OF_ZOO_ALONE = ("callback", "vec_env_wrapper", "monitor_kwargs", "frame_stack", "normalize")
#: Settings of a zoo file that are not arguments of the model: of training and environments
_NOT_OF_MODEL = ("n_timesteps", "policy", "n_envs", "env_kwargs", "env_wrapper", *OF_ZOO_ALONE)


def recipe(name: str | Path, env_id: str = "default", /, **changes: Any) -> dict[str, Any]:
    """Read the arguments of a model from a zoo file: ``CuReSAC("CnnPolicy", env, **recipe("fast/best", gamma=0.99))``.

    The settings of the environment (``env_kwargs``, ``env_wrapper``, ``frame_stack``, ``normalize`` ...), ``policy``,
    ``n_timesteps`` and ``callback`` are left out. Classes of your own, ``srl: my_heads.MyHead``, are imported.

    :param name: A file of the package, such as ``"fast/best"``, or the path of your own with suffix
    :param env_id: Gymnasium id whose entry is read; by default that for any environment
    :param changes: Arguments that take the place of the file's
    :return: Keyword arguments of ``CuReSAC`` or ``CuReTQC``
    :raises UsageError: if there is no such file or entry
    """
    entry = zoo_entry(zoo_file(name), env_id)
    return changed(model_arguments({key: value for key, value in entry.items() if key not in _NOT_OF_MODEL}), changes)


def changed(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Change settings; another head, reward or augmentation does not inherit the arguments of the former one.

    :param settings: As read from a file
    :param changes: Settings that take their place
    :return: Both, without the ``..._kwargs`` of parts that changed
    """
    parts = [part for part in ("srl", "intrinsic", "augmentation") if part in changes]
    defaults = inspect.signature(CuReSAC).parameters
    stale = {f"{part}_kwargs" for part in parts if changes[part] != settings.get(part, defaults[part].default)}
    return {**{key: value for key, value in settings.items() if key not in stale}, **changes}


def model_arguments(read: Mapping[str, Any]) -> dict[str, Any]:
    """Convert arguments of a model that YAML cannot write: pairs to tuples, names to the user's classes, schedules.

    :param read: Arguments as read from a file
    :return: Arguments as the model takes them
    :raises UsageError: as ``find_class``, or for text instead of a mapping
    """
    if isinstance(read.get("policy_kwargs"), str):  # which rl-zoo's commands evaluate, as any code
        raise UsageError(
            f"policy_kwargs is the text {read['policy_kwargs']!r:.60}: write a mapping, such as {{net_arch: [256]}}."
        )
    arguments = {**read, **named_classes(read), **linear_schedules(read)}
    if isinstance(arguments.get("train_freq"), list):  # as rl-zoo does
        arguments["train_freq"] = tuple(arguments["train_freq"])
    return arguments


def linear_schedules(arguments: Mapping[str, Any]) -> dict[str, LinearSchedule]:
    """Make the schedules that arguments of a model write as in rl-zoo3's files, ``lin_1e-3``: from there to 0.

    :param arguments: Arguments by name
    :return: The schedules, which archives of models keep, by argument
    """
    given = {name: arguments.get(name) for name in ("learning_rate", "curiosity_prob")}
    texts = {name: text for name, text in given.items() if isinstance(text, str) and text.startswith("lin_")}
    return {name: LinearSchedule(float(text.removeprefix("lin_")), 0.0, 1.0) for name, text in texts.items()}


def check_environment(task: str) -> None:
    """Refuse an unknown environment.

    :param task: Gymnasium id, or ``my_module:My-v0`` with the module that registers it
    :raises UsageError: with the nearest names
    """
    module, _, name = task.rpartition(":")
    if module:
        import_module(module)
    if name not in gym.registry:
        is_foreign = not module and not name.startswith("dmc_pixels/")
        hint = f" (name the module that registers it, too, as in my_module:{name})" if is_foreign else ""
        raise UsageError(f"there is no environment {name!r}{hint}{nearest(name, gym.registry)}")


def import_module(name: str) -> Any:
    """Import a module that the user names.

    :param name: Its name
    :return: The module
    :raises UsageError: with the nearest names in the working directory, if there is no such module
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):  # one that the module itself imports
            raise
        here = [path.stem for path in Path().glob("*.py")]
        raise UsageError(f"there is no module {error.name!r}{nearest(error.name, here)}") from None


def named_classes(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Import the user's classes that arguments of an algorithm name.

    :param arguments: Arguments by name
    :return: The classes by argument
    :raises UsageError: as ``find_class``
    """
    given = {name: arguments.get(name) for name in (*CLASS_ARGUMENTS, "replay_buffer_class")}
    return {name: find_class(value) for name, value in given.items() if isinstance(value, str) and "." in value}


def named_wrappers(named: Any) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Import the wrappers that settings name.

    :param named: As for rl-zoo3's ``env_wrapper``: None, a name or class, alone or with its arguments, or a list
    :return: Wrappers and their arguments, innermost first
    :raises UsageError: as ``find_class``, for several in one mapping, or for statistics that evaluations lack
    """
    for each in named if isinstance(named, list) else [named] if named else []:
        parts = list(each.items()) if isinstance(each, dict) else [(each, {})]
        if len(parts) != 1:
            raise UsageError(f"{each} must be one wrapper with its arguments: give several as a list.")
        ((name, kwargs),) = parts
        wrapper = name if isinstance(name, type) else find_class(name)
        if wrapper is gym.wrappers.NormalizeObservation:
            raise UsageError(
                "evaluations would not share NormalizeObservation's statistics: leave it out, as encoders standardise "
                "vectors themselves."
            )
        yield wrapper, kwargs


def find_class(name: str) -> Any:
    """Import a class that the user names.

    :param name: Such as ``my_module.MyClass``
    :return: The class
    :raises UsageError: with the nearest names, if there is no such class or module
    """
    module_name, _, class_name = name.rpartition(".")
    if not module_name:
        raise UsageError(f"{name!r} must name a class with its module, such as my_module.MyClass.")
    module = import_module(module_name)
    if not hasattr(module, class_name):
        raise UsageError(f"{module_name} has no {class_name!r}{nearest(class_name, vars(module))}")
    return getattr(module, class_name)
