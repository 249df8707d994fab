"""Experiment grids: a YAML file names tasks, methods and seeds; a cell is one of each."""

import copy
import inspect
import json
import math
import pkgutil
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
import yaml

from sb3_cure.checks import check_arguments, check_curious_agent, check_parts, check_shared_encoder_space
from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs.rendering import GLUnavailableError
from sb3_cure.persistence.buffers import can_be_kept
from sb3_cure.values import arguments_of, entry_for, import_environments, is_integer

#: The file that tells that a cell is finished
DONE = "DONE"
KINDS = ("curves", "visitation", "pretraining")
COLLECTORS = ("curious", "random")
_GRID_KEYS = {"experiment", "kind", "budget", "seeds", "evaluation", "tasks", "methods", "baseline"}
_METHOD_KEYS = {"config", "overrides", "pretrain", "train", "baseline"}
# Of a zoo entry: what is no argument of CuReSAC. `n_timesteps` is rl-zoo's; here the grid's budget says how long.
_ENTRY_KEYS = {"n_timesteps", "env_kwargs", "n_envs"}
# What a string with a dot names: a class of one's own.
_CLASSES = ("srl", "replay_buffer_class")
_ARGUMENTS = (arguments_of(CuReSAC) or set()) - {"env", "seed", "_init_setup_model"}


class GridError(ValueError):
    """A grid file or a choice from it that cannot be run; the message is for its author."""


@dataclass(frozen=True)
class Pretraining:
    """A phase of representation learning without task reward, before training.

    :param collector: ``"curious"`` or ``"random"``, see ``CuReSAC.pretrain``
    :param budget: Environment steps
    """

    collector: str
    budget: int


@dataclass(frozen=True)
class Cell:
    """One training run.

    :param experiment: Name of the grid
    :param kind: One of ``KINDS``
    :param task: Gymnasium id
    :param method: Name of the arm
    :param seed: Seed of weights, warm-up, environment; the arms of a seed share them
    :param budget: Environment steps of training; 0 for pretraining alone
    :param eval_every: Environment steps between two evaluations
    :param eval_episodes: Episodes of an evaluation
    :param n_envs: Environments side by side
    :param env_kwargs: Arguments of ``gymnasium.make``
    :param arguments: Arguments of ``CuReSAC`` but for environment and seed
    :param pretrain: The phase before training, if any
    """

    experiment: str
    kind: str
    task: str
    method: str
    seed: int
    budget: int
    eval_every: int
    eval_episodes: int
    n_envs: int
    env_kwargs: dict[str, Any]
    arguments: dict[str, Any]
    pretrain: Pretraining | None = None

    @property
    def folder(self) -> Path:
        """Where it lies below the folder of results."""
        return Path(self.experiment, short_name(self.task), self.method, f"seed{self.seed}")

    def build_arguments(self) -> dict[str, Any]:
        """A copy of ``arguments``, as SB3 writes into some, with the classes that are named by their modules."""
        arguments = copy.deepcopy(self.arguments)
        if isinstance(arguments.get("train_freq"), list):  # as rl-zoo does: YAML knows no pairs
            arguments["train_freq"] = tuple(arguments["train_freq"])
        for name in _CLASSES:
            if "." in str(arguments.get(name)):
                arguments[name] = pkgutil.resolve_name(arguments[name])
        return arguments

    def custom_objects(self) -> dict[str, Any]:
        """What ``CuReSAC.load`` needs besides the archive: classes that are named by their modules."""
        arguments = self.build_arguments()
        return {name: arguments[name] for name in _CLASSES if name in arguments}

    def is_done(self, results: Path) -> bool:
        """
        :param results: Folder of all results
        :return: Whether it has been run
        """
        return (results / self.folder / DONE).exists()

    def config(self) -> dict[str, Any]:
        """What its ``config.json`` holds: with the values of the arguments that are not given, which may change."""
        parameters = inspect.signature(CuReSAC.__init__).parameters.values()
        names = _ARGUMENTS - self.arguments.keys()
        defaults = {
            each.name: each.default for each in parameters if each.name in names and each.default is not each.empty
        }
        return {**asdict(self), "defaults": defaults}


@dataclass(frozen=True)
class Grid:
    """All cells of an experiment.

    :param experiment: Its name, the folder of its results
    :param kind: One of ``KINDS``
    :param baseline: The arm with which those are compared that name no ``baseline`` of their own
    :param cells: What was chosen, seed by seed, so that whole comparisons are finished early
    :param complete: All that the file (or an earlier choice of seeds) makes of it
    :param description: The whole file, whatever was chosen of it: what ``grid.json`` holds
    """

    experiment: str
    kind: str
    baseline: str
    cells: tuple[Cell, ...]
    complete: tuple[Cell, ...]
    description: dict[str, Any]

    def with_seeds_in(self, results: Path) -> list[Cell]:
        """
        :param results: Folder of all results
        :return: All that the file makes of it, and of the further seeds that other calls have run there
        """
        arms = [cell for cell in self.complete if cell.seed == self.complete[0].seed]
        run = (seed_of(folder) for arm in arms for folder in (results / arm.folder.parent).glob("seed*"))
        seeds = {cell.seed for cell in self.complete} | {seed for seed in run if seed is not None}
        return [replace(arm, seed=seed) for seed in sorted(seeds) for arm in arms]


def comparable(key: str, one: Any, other: Any) -> tuple[Any, Any]:
    """
    :param key: A key of ``config.json``
    :param one: Its value in one file, None if it has none
    :param other: Its value in another
    :return: Both, as they are to be compared: of defaults those that both name, as versions differ in what arguments
        there are, and once kept none
    """
    if key != "defaults":
        return one, other
    shared = [name for name in one or {} if name in (other or {})]
    return {name: one[name] for name in shared}, {name: other[name] for name in shared}


def read_kept(path: Path, *keys: str) -> dict[str, Any]:
    """
    :param path: A JSON file in the folder of results
    :param keys: What it must have
    :return: Its content
    :raises GridError: if it is damaged
    """
    try:
        content = json.loads(path.read_text())
        if not isinstance(content, dict) or not all(key in content for key in keys):
            raise ValueError
    except (OSError, ValueError):
        remove = path if path.name == "grid.json" else path.parent
        raise GridError(f"{path} is damaged: put it back, or remove {remove}, which is then made anew.") from None
    return content


def short_name(task: str) -> str:
    """
    :param task: Gymnasium id
    :return: The id without module, namespace and version: a folder's name
    """
    return re.sub(r"-v\d+$", "", re.split("[:/]", task)[-1])


def seed_of(folder: Path) -> int | None:
    """
    :param folder: In that of an arm
    :return: The seed whose cell it holds; None if it is no cell's
    """
    number = folder.name.removeprefix("seed")
    return int(number) if folder.is_dir() and number.isdecimal() else None


def load_grid(
    path: str | Path,
    *,
    seeds: int | Sequence[int] | None = None,
    tasks: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    budget: int | None = None,
) -> Grid:
    """Read a grid and the zoo files it names.

    A file's budget of 0 means pretraining alone: nothing is trained after it. No other budget is in proportion to that,
    so that one can be asked for only where no method pretrains.

    :param path: YAML file
    :param seeds: Instead of the file's: how many (the first of those that it lists, else from 0), or which
    :param tasks: Only these: ids, or ids without namespace and version
    :param methods: Only these arms
    :param budget: Environment steps, instead of the file's; those of pretraining change in proportion (at least 1)
    :return: The grid
    :raises GridError: with one sentence about what is wrong
    """
    path = Path(path)
    content = _read_yaml(path)
    _check_keys(content, _GRID_KEYS, {"experiment", "kind", "budget", "tasks", "methods"}, f"{path}")
    if content["kind"] not in KINDS:
        raise GridError(f"kind in {path} is {content['kind']!r}, but it must be one of {', '.join(KINDS)}: change it.")
    _check_name("experiment", content["experiment"], path)
    own_budget = _whole_number("budget", content["budget"], path, least=0)
    budget = own_budget if budget is None else _whole_number("budget", budget, path, least=0)
    evaluation = _mapping("evaluation", content.get("evaluation", {}), path)
    _check_keys(evaluation, {"every", "episodes"}, set(), f"evaluation in {path}")
    every = _whole_number("evaluation.every", evaluation.get("every", 10_000), path, least=1)
    episodes = _whole_number("evaluation.episodes", evaluation.get("episodes", 10), path, least=1)
    all_seeds = _seeds(content.get("seeds", 1), f"seeds in {path}")
    chosen_seeds = all_seeds if seeds is None else _seeds(seeds, "--seeds")
    if isinstance(seeds, int) and isinstance(content.get("seeds"), list):
        if seeds > len(all_seeds):
            raise GridError(
                f"--seeds asks for {seeds}, but seeds in {path} lists {len(all_seeds)}: ask for fewer, or say which "
                "(0,3,4)."
            )
        chosen_seeds = all_seeds[:seeds]
    all_tasks = _tasks(content["tasks"], path)
    chosen_tasks = _choose(tasks, all_tasks, "task", path)
    arms = _mapping("methods", content["methods"], path)
    if not arms:
        raise GridError(f"methods in {path} are none, but a grid compares at least one: name some.")
    for arm in arms:
        _check_name("a method", arm, path)
    chosen_arms = _choose(methods, {name: name for name in arms}, "method", path)
    baseline = content.get("baseline", next(iter(arms)))
    if not isinstance(baseline, str) or baseline not in arms:
        raise GridError(f"baseline in {path} is {baseline!r}, but the methods are {', '.join(arms)}: name one of them.")

    resolved = {
        (task, arm): _resolve(path, task, arm, _mapping(f"methods.{arm}", arms[arm], path))
        for task in dict.fromkeys(all_tasks.values())
        for arm in arms
    }
    for arm, method in arms.items():
        others = [name for name in arms if name != arm]
        if "baseline" in method and method["baseline"] not in others:
            raise GridError(
                f"baseline of methods.{arm} in {path} is {method['baseline']!r}, but a method is compared with another "
                f"one ({', '.join(others) or 'there is none'}): name one, or remove it."
            )
    if budget != own_budget:
        for (_, arm), settings in resolved.items():
            if settings["pretrain"] is not None:
                settings["pretrain"] = _scale(settings["pretrain"], own_budget, budget, path)
                arms[arm] = {**arms[arm], "pretrain": asdict(settings["pretrain"])}
    every_seed = sorted({*all_seeds, *chosen_seeds})
    complete = tuple(
        Cell(
            experiment=content["experiment"],
            kind=content["kind"],
            task=task,
            method=arm,
            seed=seed,
            eval_every=every,
            eval_episodes=episodes,
            budget=budget if resolved[task, arm]["train"] else 0,
            **{key: value for key, value in resolved[task, arm].items() if key != "train"},
        )
        for seed in every_seed
        for task in dict.fromkeys(all_tasks.values())
        for arm in arms
    )
    cells = tuple(
        cell
        for cell in complete
        if cell.seed in chosen_seeds and cell.task in chosen_tasks and cell.method in chosen_arms
    )
    description = {
        "experiment": content["experiment"],
        "kind": content["kind"],
        "budget": budget,
        "seeds": every_seed,
        "tasks": list(dict.fromkeys(all_tasks.values())),
        "methods": arms,
        "baseline": baseline,
        "evaluation": {"every": every, "episodes": episodes},
    }
    return Grid(content["experiment"], content["kind"], baseline, cells, complete, description)


def check_arms(cells: Iterable[Cell]) -> None:
    """Whether environments and arguments of the arms can work, before the first of them is trained.

    :param cells: Cells that are to be run; of a grid of kind ``"visitation"`` all that common heads are made of
    :raises GridError: for the first that cannot be
    """
    envs: dict[tuple[str, str], gym.Env] = {}
    first: dict[str, tuple[str, Any]] = {}
    built: set[str] = set()
    try:
        for task, arm, cell in {(cell.task, cell.method): (cell.task, cell.method, cell) for cell in cells}.values():
            try:
                key = task, str(cell.env_kwargs)
                if key not in envs:
                    envs[key] = _make(task, cell.env_kwargs)
                model = CuReSAC(env=envs[key], _init_setup_model=False, **cell.build_arguments())
                check_arguments(model)
                if not model.is_plain_sac:
                    check_shared_encoder_space(model.observation_space, model.policy_class)
                    model._choose_replay_buffer()
                check_parts(model)
                _check_cell(cell, model)
                networks = f"{model.observation_space} {cell.arguments}"
                if networks not in built:
                    _build_networks(model)
                    built.add(networks)
            except GLUnavailableError:  # with Ray other machines may have what this one has not
                return
            except GridError:
                raise
            except Exception as error:
                known = isinstance(error, ValueError | TypeError | gym.error.Error)
                reason = f"{'' if known else type(error).__name__ + ': '}{' '.join(str(error).split())}"
                raise GridError(f"method {arm!r} on {task} cannot work: {reason}") from error
            shape = model.observation_space.shape
            other, others = first.setdefault(task, (arm, shape))
            if cell.kind == "visitation" and shape != others:
                raise GridError(
                    f"methods {other!r} and {arm!r} see {task} in observations of shape {others} and {shape}, but "
                    "common heads judge all methods alike: give them the same env_kwargs, or write a grid for each."
                )
        limits = ("_max_episode_steps", "max_episode_steps", "physics")  # those of dm_control end by themselves
        unlimited = [task for (task, _), env in envs.items() if not any(map(env.has_wrapper_attr, limits))]
        for task in dict.fromkeys(unlimited):
            print(
                f"{task} tells no time limit: if its episodes do not end by themselves, its first evaluation never "
                "ends; then register it with max_episode_steps=1000, for example."
            )
    finally:
        for env in envs.values():
            env.close()


def _build_networks(model: CuReSAC) -> None:
    """On the CPU, as the cells may run on another machine, and without a replay buffer, which may fill the memory."""
    model.device, model.compile = th.device("cpu"), False
    model.replay_buffer = object()  # type: ignore[assignment]  # else SB3 would make one
    with th.random.fork_rng(devices=[]):
        model._setup_model()


def _check_cell(cell: Cell, model: CuReSAC) -> None:
    buffer = model.replay_buffer_class
    if buffer is not None and not can_be_kept(buffer):
        raise ValueError(
            f"replay_buffer_class is {buffer.__name__}, which checkpoints of cells cannot hold without pickle: leave "
            "it out, or name FrameStackReplayBuffer or one of SB3's (but HerReplayBuffer)."
        )
    if cell.pretrain is None and cell.budget == 0:
        raise ValueError(
            "it neither trains nor pretrains: add pretrain, or give a budget of at least 1 without train: false."
        )
    if cell.pretrain is not None and model.srl is None:
        raise ValueError(
            "it pretrains the representation, but srl is None: choose srl: rae, curl or a head of your own, or remove "
            "pretrain."
        )
    if cell.pretrain is not None and cell.pretrain.collector == "curious":
        check_curious_agent(model)


def _make(task: str, env_kwargs: dict[str, Any]) -> gym.Env:
    try:
        return gym.make(task, **env_kwargs)
    except (ValueError, TypeError) as error:
        reason = " ".join(str(error).split()).removesuffix(".")
        raise GridError(
            f"env_kwargs of {task} are {env_kwargs}, which it does not take ({reason}): correct them."
        ) from error


def _resolve(path: Path, task: str, arm: str, method: dict[str, Any]) -> dict[str, Any]:
    """What an arm means on a task: the zoo file's entry with the grid's overrides."""
    where = f"methods.{arm} in {path}"
    _check_keys(method, _METHOD_KEYS, {"config"}, where)
    config_path = path.parent / str(method["config"])
    entries = _read_yaml(config_path)
    name = entry_for(task, entries)
    if name is None:
        raise GridError(f"{config_path} has neither {task!r} nor 'default', but {where} needs one: add one of them.")
    entry = _mapping(name, entries[name], config_path)
    entry = {**entry, **_mapping("overrides", method.get("overrides", {}), path)}
    unknown = sorted(set(entry) - _ENTRY_KEYS - _ARGUMENTS)
    if unknown:
        raise GridError(
            f"{unknown[0]!r} in {config_path} or the overrides of {where} is no argument of CuReSAC: correct or "
            "remove it (grids know n_envs and env_kwargs besides, but no other key of rl-zoo)."
        )
    arguments = {key: value for key, value in entry.items() if key not in _ENTRY_KEYS}
    for key, value in arguments.items():
        if key.endswith("_kwargs") and not isinstance(value, dict):
            raise GridError(
                f"{key} in {config_path} is {value!r}, but grids evaluate no strings: write a YAML mapping."
            )
    for key in _CLASSES:
        if "." not in str(arguments.get(key)):
            continue
        try:
            pkgutil.resolve_name(arguments[key])
        except (ImportError, AttributeError, ValueError) as error:
            raise GridError(
                f"{key} of {where} is {arguments[key]!r}, which cannot be imported ({error}): name a class as "
                "module.Class, in a module of the working directory or an installed one."
            ) from None
    pretrain = None
    if "pretrain" in method:
        phase = _mapping("pretrain", method["pretrain"], path)
        _check_keys(phase, {"collector", "budget"}, {"collector", "budget"}, f"pretrain of {where}")
        if phase["collector"] not in COLLECTORS:
            raise GridError(
                f"pretrain.collector of {where} is {phase['collector']!r}, but it must be 'curious' or 'random': "
                "choose one of them."
            )
        pretrain = Pretraining(phase["collector"], _whole_number("pretrain.budget", phase["budget"], path, least=1))
    trains = method.get("train", True)
    if not isinstance(trains, bool):
        raise GridError(f"train of {where} is {trains!r}, but it must be true or false: change it.")
    return {
        "n_envs": _whole_number("n_envs", entry.get("n_envs", 1), config_path, least=1),
        "env_kwargs": _mapping("env_kwargs", entry.get("env_kwargs", {}), config_path),
        "arguments": {"policy": "CnnPolicy", **arguments},
        "pretrain": pretrain,
        "train": trains,
    }


def _scale(phase: Pretraining, own_budget: int, budget: int, path: Path) -> Pretraining:
    """A phase as long in proportion to another budget as it is to the file's."""
    if own_budget == 0:
        raise GridError(
            f"budget in {path} is 0 (pretraining alone), but {budget} was asked for, to which pretraining cannot be "
            "scaled: change the budgets in the file instead."
        )
    return Pretraining(phase.collector, max(round(phase.budget * budget / own_budget), 1))


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise GridError(f"{path} cannot be read ({error.strerror}): give the path of a YAML file.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise GridError(f"{path} is no YAML ({' '.join(str(error).split())}): correct it.") from None
    return _mapping("the content", content, path)


def _mapping(name: str, value: Any, path: Path) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise GridError(f"{name} in {path} is {value!r}, but it must be a mapping (key: value): change it.")
    return dict(value)


def _check_keys(mapping: dict[str, Any], known: set[str], needed: set[str], where: str) -> None:
    for key in mapping:
        if key not in known:
            raise GridError(f"{key!r} in {where} is unknown, but the keys are {', '.join(sorted(known))}: correct it.")
    for key in sorted(needed - set(mapping)):
        raise GridError(f"{where} has no {key!r}, which it needs: add it.")


def _check_name(key: str, value: Any, path: Path) -> None:
    if not isinstance(value, str) or not re.fullmatch(r"[\w.-]*\w[\w.-]*", value):
        raise GridError(
            f"{key} in {path} is {value!r}, but it names a folder: use letters, digits, '-', '_' and '.' only."
        )


def _whole_number(key: str, value: Any, path: Path, least: int) -> int:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or value != int(value) or value < least:
        raise GridError(f"{key} in {path} is {value!r}, but it must be a whole number, {least} or more: change it.")
    return int(value)


def _seeds(value: Any, name: str) -> list[int]:
    numbers = list(range(value)) if isinstance(value, int) and not isinstance(value, bool) else value
    valid = isinstance(numbers, Sequence) and not isinstance(numbers, str) and len(numbers) > 0
    if not valid or not all(is_integer(number, 0) and number < 2**31 for number in numbers):
        raise GridError(
            f"{name} is {value!r}, but it must be how many (1 or more) or which, each from 0 to 2**31 - 1: change it."
        )
    return list(dict.fromkeys(numbers))


def _tasks(value: Any, path: Path) -> dict[str, str]:
    """By both their names."""
    if not isinstance(value, list) or not value:
        raise GridError(f"tasks in {path} is {value!r}, but it must be a list of Gymnasium ids: write some.")
    for task in value:
        module, _, name = task.rpartition(":") if isinstance(task, str) else ("", "", task)
        if module:
            try:
                import_environments(module, f"task {task!r} in {path}")
            except ValueError as error:
                raise GridError(str(error)) from error
        if not isinstance(name, str) or name not in gym.registry:
            raise GridError(
                f"task {task!r} in {path} is not registered with Gymnasium: correct it (sb3_cure registers "
                "dmc_pixels/<domain>-<task>-v0; one of your own is my_module:My-v0, with the module that registers it)."
            )
    by_name: dict[str, str] = {}
    for task in value:
        other = by_name.setdefault(short_name(task), task)
        if other != task:
            raise GridError(
                f"tasks in {path} has both {other!r} and {task!r}, whose results would share the folder "
                f"{short_name(task)!r}: write a grid for each, with another name of the experiment."
            )
    return {**by_name, **{task: task for task in value}}


def _choose(names: Sequence[str] | None, known: dict[str, str], what: str, path: Path) -> list[str]:
    """In the file's order; known: by each of its names."""
    for name in names or ():
        if name not in known:
            raise GridError(f"{what} {name!r} is not in {path}, which has {', '.join(known)}: choose among these.")
    chosen = known.values() if names is None else {known[name] for name in names}
    return [name for name in dict.fromkeys(known.values()) if name in set(chosen)]
