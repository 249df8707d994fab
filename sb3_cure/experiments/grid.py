"""Experiment grids: a YAML file names tasks, methods and seeds; a cell is one of each."""

import contextlib
import copy
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium as gym
import pydantic
import torch as th
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PositiveInt

from sb3_cure.cli.usage import UsageError, nearest, one_sentence
from sb3_cure.cli.zoo_files import (
    ALGORITHMS,
    GRIDS,
    OF_ZOO_ALONE,
    ZOO,
    changed,
    check_environment,
    model_arguments,
    named_classes,
    named_wrappers,
    read_yaml,
    zoo_entry,
    zoo_file,
)
from sb3_cure.cure.algorithms import CuReSAC
from sb3_cure.envs import make_dmc_env
from sb3_cure.envs.counting import CellInfo, SumRewards, TaskReward
from sb3_cure.envs.rendering import GLUnavailableError
from sb3_cure.evaluation.rollouts import untouched_randomness

#: Empty file of a finished cell
DONE = "DONE"
#: File with the traceback of a failed cell, until it is started again
ERROR = "error.txt"


def short_name(task: str) -> str:
    """Gymnasium id without module, namespace and version: a folder's name.

    :param task: Gymnasium id
    :return: The name
    """
    return re.sub(r"-v\d+$", "", re.split("[:/]", task)[-1])


# ---------------------------------------------------------------- format of the file


def _check_registered(task: str) -> str:
    check_environment(task)  # whose errors are ValueErrors, as pydantic wants them
    return task


_Name = Annotated[str, Field(pattern=r"^[\w.-]*\w[\w.-]*$")]
_Seeds = Annotated[
    list[Annotated[int, Field(ge=0, lt=2**31)]],
    Field(min_length=1),
    BeforeValidator(lambda value: list(range(value)) if type(value) is int else value),
]


# Dataclasses, as `asdict` of a cell describes them, too
@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Pretraining:
    """A phase of representation learning without task reward, before training.

    :param collector: ``"curious"`` or ``"random"``, see ``CuReSAC.pretrain``
    :param budget: Environment steps
    """

    collector: Literal["curious", "random"]
    budget: PositiveInt


@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Coverage:
    """Cells of the true state to count, and when, in ``coverage.csv``.

    :param widths: Width of a cell along each coordinate, by the names of ``physics_state_names``; they should
        differ from the widths that an arm is rewarded by
    :param at: Environment steps after which they are counted
    """

    widths: dict[str, Annotated[float, Field(gt=0)]]
    at: Annotated[list[PositiveInt], Field(min_length=1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Evaluation(_Part):
    """When and how each cell is evaluated.

    :param every: Environment steps between two evaluations
    :param episodes: Episodes of an evaluation, of each policy
    :param curious: ``"end"``: evaluate the curious policy in the last evaluation only; None: in each
    """

    every: PositiveInt = 10_000
    episodes: PositiveInt = 10
    curious: Literal["end"] | None = None


#: Settings that are merged with an override key by key
_MERGED = ("env_kwargs", "policy_kwargs")


class Method(_Part):
    """An arm of the comparison.

    :param config: Zoo file: by name, such as ``fast/cure_sac_ae``, or by its path relative to the grid's
    :param overrides: Changes to the file's entry; ``env_kwargs`` and ``policy_kwargs`` are changed key by key
    :param algo: A key of ``ALGORITHMS``
    :param pretrain: The phase before training, if any
    :param keep_replay_buffer: Whether the task learns from what pretraining has collected, too
    :param train: Whether the task is learned at all
    :param baseline: Method to compare it with, instead of the grid's baseline
    """

    config: str
    overrides: dict[str, Any] = {}
    algo: Literal["cure_sac", "cure_tqc"] = "cure_sac"
    pretrain: Pretraining | None = None
    keep_replay_buffer: bool = False
    train: bool = True
    baseline: str | None = None


class GridFile(_Part):
    """A grid's YAML file.

    :param experiment: Its name, the folder of its results
    :param kind: Decides what the report shows
    :param budget: Environment steps of training; 0: pretraining alone
    :param tasks: Gymnasium ids
    :param methods: The arms by name
    :param seeds: How many, or which
    :param evaluation: When and how to evaluate
    :param baseline: The arm with which the others are compared, by default the first
    :param coverage: Cells of the true state to count, if any
    """

    experiment: _Name
    kind: Literal["curves", "visitation"]
    budget: Annotated[int, Field(ge=0)]
    tasks: Annotated[list[Annotated[str, AfterValidator(_check_registered)]], Field(min_length=1)]
    methods: Annotated[dict[_Name, Method], Field(min_length=1)]
    seeds: _Seeds = [0]
    evaluation: Evaluation = Evaluation()
    baseline: str = ""
    coverage: Coverage | None = None

    @pydantic.model_validator(mode="after")
    def _check_names(self) -> "GridFile":
        self.baseline = self.baseline or next(iter(self.methods))
        if len({short_name(task) for task in self.tasks}) < len(self.tasks):
            raise ValueError("two tasks would share a folder: write a grid for each, named differently")
        for name, method in self.methods.items():
            if method.pretrain is None and not (method.train and self.budget):
                raise ValueError(f"method {name!r} neither trains nor pretrains: add pretrain, or train it")
        if self.coverage is not None and max(self.coverage.at) > self.budget:
            raise ValueError(f"coverage.at has {max(self.coverage.at)}, after the end of a training of {self.budget}")
        for name in [self.baseline, *(method.baseline or self.baseline for method in self.methods.values())]:
            if name not in self.methods:
                raise ValueError(f"baseline is {name!r}, but the methods are {', '.join(self.methods)}")
        return self


# ---------------------------------------------------------------- cells


@dataclass(frozen=True)
class Cell:
    """One training run.

    :param experiment: Name of the grid
    :param kind: Of the grid
    :param task: Gymnasium id
    :param method: Name of the arm
    :param seed: Seed of weights, warm-up, environment; the arms of a seed share them
    :param budget: Environment steps of training; 0 for pretraining alone
    :param eval_every: Environment steps between two evaluations
    :param eval_episodes: Episodes of an evaluation
    :param n_envs: Environments side by side
    :param env_kwargs: Arguments of ``gymnasium.make``
    :param arguments: Arguments of the algorithm but for environment and seed
    :param pretrain: The phase before training, if any
    :param keep_replay_buffer: Whether the task learns from what pretraining has collected, too
    :param algo: A key of ``ALGORITHMS``
    :param coverage: Cells of the true state to count, if any
    :param eval_curious: ``"end"``: evaluate the curious policy in the last evaluation only
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
    keep_replay_buffer: bool = False
    algo: str = "cure_sac"
    coverage: Coverage | None = None
    eval_curious: Literal["end"] | None = None

    @property
    def folder(self) -> Path:
        """Its folder below the folder of results."""
        return Path(self.experiment, short_name(self.task), self.method, f"seed{self.seed}")

    def build_arguments(self) -> dict[str, Any]:
        """Copy ``arguments``, as SB3 writes into some, and import the classes that they name."""
        arguments = copy.deepcopy(self.arguments)
        arguments.pop("env_wrapper", None)
        return model_arguments(arguments)

    def make_env(self) -> gym.Env:
        """Make an environment to train in, with the wrappers of ``env_wrapper``, as in rl-zoo's files.

        :return: The environment, which also reports the task's reward
        """
        env = self._task_reward(pays=False)
        return env if self.coverage is None else CellInfo(env, self.coverage.widths)

    def make_eval_env(self, **env_kwargs: Any) -> gym.Env:
        """Make an environment to measure policies in: the same, but its steps return the task's reward.

        :param env_kwargs: Arguments of ``gymnasium.make`` instead of its own
        :return: The environment
        """
        return self._task_reward(pays=True, **env_kwargs)

    def _task_reward(self, pays: bool, **env_kwargs: Any) -> gym.Env:
        env = task = SumRewards(gym.make(self.task, **{**self.env_kwargs, **env_kwargs}))
        for wrap, kwargs in named_wrappers(self.arguments.get("env_wrapper")):
            env = wrap(env, **kwargs)
        return TaskReward(env, task, pays)

    def custom_objects(self) -> dict[str, Any]:
        """Import the user's classes that the arguments name; a model's archive needs them to be loaded."""
        return named_classes(self.arguments)

    def make_model(self, env: Any, **changes: Any) -> CuReSAC:
        """Make its model.

        :param env: Its environment, or several as a ``VecEnv``
        :param changes: Arguments instead of its own
        :return: The model before training
        """
        return ALGORITHMS[self.algo](env=env, seed=self.seed, **{**self.build_arguments(), **changes})

    def load_model(self, path: Path) -> CuReSAC:
        """Load one of its models, to act and to measure: its replay buffer has room for one transition.

        :param path: The model's archive
        :return: The model
        """
        return ALGORITHMS[self.algo].load(path, custom_objects={**self.custom_objects(), "buffer_size": 1})

    def is_done(self, results: Path) -> bool:
        """Whether it has been run.

        :param results: Folder of all results
        :return: Whether it is marked as ``DONE``
        """
        return (results / self.folder / DONE).exists()


#: Fields of a cell that must be equal before results are mixed
SETTINGS = tuple(each.name for each in fields(Cell) if each.name not in ("experiment", "method", "seed"))


#: What a cell did whose version did not have these settings, nor write them
_DEFAULTS = {each.name: each.default for each in fields(Cell) if each.default is not MISSING}


def first_difference(
    before: Mapping[str, Any], now: Mapping[str, Any], keys: Iterable[str]
) -> tuple[str, Any, Any] | None:
    """Find a setting that differs.

    :param before: Settings, as in a JSON file
    :param now: Others
    :param keys: Names of the settings to compare; one without a default that either lacks is not compared
    :return: Name of the first that differs, and both values; None if there is none
    """
    before, now = {**_DEFAULTS, **before}, {**_DEFAULTS, **now}
    differ = (key for key in keys if key in before and key in now and before[key] != now[key])
    return next(((key, before[key], now[key]) for key in differ), None)


@dataclass(frozen=True)
class Grid:
    """All cells of an experiment.

    :param experiment: Its name, the folder of its results
    :param kind: Decides what the report shows
    :param cells: The chosen cells, seed by seed, so that whole comparisons are finished early
    :param arms: A cell of each method on each task of the file
    :param description: The whole file, whatever was chosen of it: the content of ``grid.json``
    """

    experiment: str
    kind: str
    cells: tuple[Cell, ...]
    arms: tuple[Cell, ...]
    description: dict[str, Any]

    def with_seeds_in(self, results: Path) -> list[Cell]:
        """All arms with the chosen seeds, and with further seeds that are found in the folder.

        :param results: Folder of all results
        :return: The cells
        """
        found = (seed_of(folder) for arm in self.arms for folder in (results / arm.folder.parent).glob("seed*"))
        seeds = {cell.seed for cell in self.cells} | {seed for seed in found if seed is not None}
        return [replace(arm, seed=seed) for seed in sorted(seeds) for arm in self.arms]


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file in the folder of results.

    :param path: The file
    :return: Its content
    :raises UsageError: if it is missing or damaged
    """
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{path} cannot be read ({error}): restore it, or remove {path.parent} and run the grid again."
        ) from None


def seed_of(folder: Path) -> int | None:
    """Seed of a cell's folder.

    :param folder: In that of an arm
    :return: The seed; None if it is no cell's
    """
    number = folder.name.removeprefix("seed")
    return int(number) if folder.is_dir() and number.isdecimal() else None


# ---------------------------------------------------------------- reading


def load_grid(
    path: str | Path,
    *,
    seeds: int | Sequence[int] | None = None,
    tasks: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    budget: int | None = None,
) -> Grid:
    """Read a grid and the zoo files it names.

    A file's budget of 0 means pretraining alone, which ``budget`` cannot change.

    :param path: YAML file, or the name of one of the package's grids, such as ``fast/curves``
    :param seeds: Instead of the file's: a number of seeds (the first of the file's list, else from 0), or a list
    :param tasks: Only these: ids, or ids without namespace and version
    :param methods: Only these arms
    :param budget: Environment steps, instead of the file's; those of pretraining change in proportion (at least 1)
    :return: The grid
    :raises UsageError: with one sentence about what is wrong
    """
    path = zoo_file(path, GRIDS)
    content = read_yaml(path)
    file = _validated(path, content)
    if budget is not None and budget != file.budget:
        _scale(file, budget, path)
    if isinstance(seeds, int) and isinstance(content.get("seeds"), list):
        if not 1 <= seeds <= len(file.seeds):
            raise UsageError(f"--seeds is {seeds}, but {path} lists {len(file.seeds)}: say which (0,3,4).")
        seeds = file.seeds[:seeds]
    chosen = file.seeds if seeds is None else _validated(path, {**content, "seeds": seeds}).seeds
    file.seeds = sorted({*file.seeds, *chosen})
    of_tasks = _choose(
        tasks, {short_name(task): task for task in file.tasks} | {task: task for task in file.tasks}, path
    )
    of_arms = _choose(methods, {name: name for name in file.methods}, path)
    arms = tuple(arm_cell(file, path, task, name) for task in file.tasks for name in file.methods)
    if file.kind == "visitation":
        _check_pixels(arms, path)
    of_seed = [arm for arm in arms if arm.task in of_tasks and arm.method in of_arms]
    cells = tuple(replace(arm, seed=seed) for seed in sorted(set(chosen)) for arm in of_seed)
    return Grid(file.experiment, file.kind, cells, arms, file.model_dump(exclude_none=True))


def _validated(path: Path, content: Any) -> GridFile:
    try:
        return GridFile.model_validate(content)
    except pydantic.ValidationError as error:
        wrong = "; ".join(_validation_message(each) for each in error.errors())
        raise UsageError(f"{path} is no grid: {wrong}.") from None


def _validation_message(error: Any) -> str:
    """Message of one of pydantic's errors, with the nearest keys if a key is unknown."""
    keys = [str(key) for key in error["loc"]]
    if error["type"] == "extra_forbidden":
        known = {name for part in (GridFile, Method, Evaluation) for name in part.model_fields}
        return f"{'.'.join(keys)} is no key of a grid{nearest(keys[-1], known)}".rstrip(".")
    text = f"{'.'.join(keys) or 'it'}: {error['msg'].removeprefix('Value error, ').rstrip('.')}"
    return text + (f" (got {error['input']!r:.60})" if keys else "")


def _scale(file: GridFile, budget: int, path: Path) -> None:
    """Change the budget; pretraining's budget and the steps at which cells are counted change in proportion."""
    if file.budget == 0:
        raise UsageError(f"budget in {path} is 0 (pretraining alone), which cannot be scaled.")

    def scaled(steps: int) -> int:
        return max(round(steps * budget / file.budget), 1)

    for method in file.methods.values():
        if method.pretrain is not None:
            method.pretrain = replace(method.pretrain, budget=scaled(method.pretrain.budget))
    if file.coverage is not None:
        file.coverage = replace(file.coverage, at=sorted(set(map(scaled, file.coverage.at))))
    file.budget = budget


def arm_cell(file: GridFile, path: Path, task: str, name: str) -> Cell:
    """Make the cell of an arm on a task, with the zoo file's entry and the grid's overrides.

    :param file: The grid
    :param path: Its file, to which a method's ``config`` may be relative
    :param task: Gymnasium id
    :param name: Name of the method
    :return: The cell, with the file's first seed
    :raises UsageError: if there is no such zoo file or entry
    """
    method = file.methods[name]
    entry = {"policy": "CnnPolicy", **zoo_entry(path.parent / zoo_file(method.config, ZOO), task)}
    overrides = {
        key: _merged(entry.get(key), value) if key in _MERGED else value for key, value in method.overrides.items()
    }
    entry = changed(entry, overrides)
    if "n_timesteps" in overrides:
        raise UsageError(f"method {name!r} of {path} overrides n_timesteps: the grid's budget says how long it trains.")
    entry.pop("n_timesteps", None)
    if foreign := [setting for setting in OF_ZOO_ALONE if setting in entry]:
        raise UsageError(
            f"method {name!r} of {path} has {foreign[0]}, which `train` knows and grids do not: env_wrapper stacks "
            "frames (sb3_cure.envs.StackFrames) and wraps environments."
        )
    return Cell(
        experiment=file.experiment,
        kind=file.kind,
        task=task,
        method=name,
        seed=file.seeds[0],
        budget=file.budget if method.train else 0,
        eval_every=file.evaluation.every,
        eval_episodes=file.evaluation.episodes,
        n_envs=entry.pop("n_envs", 1),
        env_kwargs=entry.pop("env_kwargs", {}),
        arguments=entry,
        pretrain=method.pretrain,
        keep_replay_buffer=method.keep_replay_buffer,
        algo=method.algo,
        coverage=file.coverage,
        eval_curious=file.evaluation.curious,
    )


def _merged(mapping: Any, overrides: Any) -> Any:
    if not (isinstance(mapping, dict) and isinstance(overrides, dict)):
        return overrides
    return {**mapping, **{key: _merged(mapping.get(key), value) for key, value in overrides.items()}}


def _check_pixels(arms: Sequence[Cell], path: Path) -> None:
    """Refuse arms of a task with different ``env_kwargs``: common heads judge all of them on the same pixels."""
    first: dict[str, dict[str, Any]] = {}
    for cell in arms:
        if first.setdefault(cell.task, cell.env_kwargs) != cell.env_kwargs:
            raise UsageError(
                f"methods in {path} differ in env_kwargs on {cell.task}, but common heads judge all alike: give them "
                "the same, or write a grid for each."
            )


def _choose(names: Sequence[str] | None, known: dict[str, str], path: Path) -> set[str]:
    for name in names or ():
        if name not in known:
            raise UsageError(f"{name!r} is not in {path}, which has {', '.join(known)}{nearest(name, known)}")
    return {known[name] for name in (known if names is None else names)}


def check_arms(cells: Iterable[Cell]) -> None:
    """Build the model of each arm on each task once, before the first of them is trained.

    They are built on the CPU, as the cells may run on another machine, and with the smallest replay buffer, as the
    cells' own may fill the memory.

    :param cells: Cells that are to be run
    :raises UsageError: for the first that cannot be built
    """
    for cell in {(cell.task, cell.method): cell for cell in cells}.values():
        try:
            with contextlib.closing(cell.make_env()) as env, untouched_randomness(th.device("cpu")):
                if cell.kind == "visitation" and isinstance(env.observation_space, gym.spaces.Dict):
                    raise ValueError("visitation compares errors of one image or vector, but this is a dictionary.")
                cell.make_model(env, device="cpu", buffer_size=1)
        except GLUnavailableError:  # another machine may have OpenGL
            return
        except Exception as error:
            reason = f"{type(error).__name__}: {one_sentence(error, ALGORITHMS[cell.algo], make_dmc_env)}"
            raise UsageError(f"method {cell.method!r} on {cell.task} cannot be built: {reason}") from error
