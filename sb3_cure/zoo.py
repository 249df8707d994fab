"""rl-zoo3's programs with CuReSAC among its algorithms: ``python -m sb3_cure.zoo train --env ... --conf-file ...``.

``train``, ``enjoy``, ``record`` and ``optimize`` are rl-zoo3's own, with all of its flags (``--help`` shows them). What
differs: the algorithm is ``cure_sac``, which needs ``--env``, and the folder ``logs`` unless given, ``optimize`` means
``train -optimize``, and what this module's classes say.
"""

import argparse
import importlib
import importlib.util
import re
import runpy
import shutil
import sys
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor

try:
    import optuna
    import yaml
    from optuna.storages.journal import JournalFileBackend
    from rl_zoo3 import ALGOS, exp_manager, utils
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import StoreDict, get_class_by_name
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        f'sb3_cure.zoo needs {missing.name}, which is not installed: pip install "sb3-cure[zoo]"', name=missing.name
    ) from missing

from sb3_cure.allocator import tune_allocator
from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs.rendering import GLUnavailableError, is_headless
from sb3_cure.persistence import ObjectsMissing
from sb3_cure.values import (
    arguments_of,
    check_folder,
    check_keywords,
    entry_for,
    import_environments,
    is_integer,
    is_number,
)

ALGO = "cure_sac"
PROGRAMS = ("train", "enjoy", "record", "optimize")
#: Keys of rl-zoo3's YAML files that are no arguments of the algorithm
_ZOO_KEYS = {
    "n_timesteps", "n_envs", "env_kwargs", "normalize", "frame_stack", "env_wrapper", "vec_env_wrapper", "callback",
    "monitor_kwargs", "noise_type", "noise_std",
}  # fmt: skip
#: Arguments of the algorithm that rl-zoo3 takes from the command line only
_FLAGS = {"env": "--env", "seed": "--seed", "device": "--device", "verbose": "--verbose", "tensorboard_log": "-tb"}
_NOISES = ("normal", "ornstein-uhlenbeck")
#: The least that flags may be; what rl-zoo3 has as the default is allowed, too
_LEAST = {
    "n_eval_envs": 1, "eval_episodes": 1, "n_envs": 1, "n_trials": 1, "n_evaluations": 1, "max_total_trials": 1,
    "n_startup_trials": 0,
}  # fmt: skip
#: What wrong settings make others raise, where that is raised by one of these packages (and not by a user's own code)
_OF_INPUT = (
    ValueError, TypeError, KeyError, AttributeError, AssertionError, NameError, SyntaxError, ImportError, OSError,
    ZeroDivisionError, gym.error.Error, GLUnavailableError,
)  # fmt: skip
_PACKAGES = ("sb3_cure", "rl_zoo3", "gymnasium", "importlib", "os", "pathlib")
#: Folder of a run: the environment, and its number, with a unique id after it if ``--uuid`` asked for one
_RUN = re.compile(r"(.+)_((\d+)(?:_[0-9a-f-]{36})?)")
_OF_RUN = "give the run's --env, with -f the folder that it was trained into, and perhaps --exp-id"


class SettingsError(ValueError):
    """A command line or a settings file that cannot work; the message is for its author."""


@contextmanager
def _refusing() -> Iterator[None]:
    """What the package's own checks find wrong is for the author of the settings."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise SettingsError(str(error)) from error


class ActingCuReSAC(CuReSAC):
    """What ``enjoy`` and ``record`` load: a CuReSAC that only acts, without the replay buffer of its training."""

    #: What models hold no more of than a placeholder: the head that ``--srl`` names
    objects: ClassVar[dict[str, Any]] = {}

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> "ActingCuReSAC":
        """
        :param args: Arguments of ``CuReSAC.load``
        :param kwargs: Its keyword arguments
        :return: The model; its ``replay_buffer`` is None
        :raises SettingsError: if it cannot be loaded
        """
        # rl-zoo3 asks for a buffer of 1 too, but only for the off-policy algorithms that it knows by name.
        # Its class may be one of the user's, which archives do not hold.
        objects = {**(kwargs.pop("custom_objects", None) or {}), **cls.objects}
        objects.update(replay_buffer_class=None, replay_buffer_kwargs={})
        kwargs.update(custom_objects=objects, buffer_size=1)
        try:
            model = super().load(*args, **kwargs)
        except ValueError as error:
            raise SettingsError(f"{_explained(error, 'add --srl {}')}.") from error
        model.replay_buffer = None
        return model

    def predict(self, observation: np.ndarray | dict[str, np.ndarray], *args: Any, **kwargs: Any) -> Any:
        """
        :param observation: Observations of rl-zoo3's environment, which ``enjoy`` does not compare with the model's
        :param args: Further arguments of ``CuReSAC.predict``
        :param kwargs: Its keyword arguments
        :return: What it returns
        :raises SettingsError: if the observations are of another shape than those of the training
        """
        try:
            return super().predict(observation, *args, **kwargs)
        except ValueError as error:
            if "Unexpected observation shape" not in str(error):
                raise
            given = (
                {key: value.shape for key, value in observation.items()}
                if isinstance(observation, dict)
                else observation.shape
            )
            raise SettingsError(
                f"the model was trained with the observations {self.observation_space}, but the environment has others "
                f"({given}): correct --env-kwargs (images: the same image_size, grayscale, frame_stack)."
            ) from error


class _Steps(BaseCallback):
    """Counts the steps of one call of ``learn``."""

    def _on_step(self) -> bool:
        return True


class ExperimentManager(exp_manager.ExperimentManager):
    """rl-zoo3's, which reads the YAML and makes environments and model, with these additions:

    - ``env_kwargs`` of the YAML file hold for the evaluation's environments too, and ``record`` finds them again;
    - an entry ``dmc_pixels:`` of the YAML file holds for all tasks of this namespace that have none of their own;
    - ``srl: my_package.MyHead`` names a class, as rl-zoo3's ``policy`` and ``callback`` do;
    - ``optimize`` samples only the hyper-parameters that the chosen kind of curiosity uses, and several processes may
      start at once on a database that does not exist yet;
    - ``--trial-id 0`` is the first trial, where rl-zoo3 takes 0 for none;
    - settings that cannot work are one sentence, and leave no folder behind.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        save_path = Path(self.save_path)
        self._fresh = [path for path in (save_path, *save_path.parents) if not path.exists()]
        #: What flags of the command line set instead of the file, by its names
        self._flags: dict[str, dict[str, Any]] = {
            "-params": self.custom_hyperparams or {},
            "--env-kwargs": {"env_kwargs": self.env_kwargs} if self.env_kwargs else {},
            "--eval-env-kwargs": {"env_kwargs": self._eval_env_kwargs_args} if self._eval_env_kwargs_args else {},
            "--device": {"device": self.device} if self.device != "auto" else {},
        }

    def setup_experiment(self) -> tuple[Any, dict[str, Any]] | None:
        try:
            if self.optimize_hyperparameters and self.storage is not None:
                self._open_storage(self.storage)
            return super().setup_experiment()
        except Exception as error:
            self._refuse(error)
            raise

    def _refuse(self, error: Exception) -> None:
        """The run cannot begin: it is removed, and what the settings are to blame for is explained."""
        self._remove_run()
        if not isinstance(error, SettingsError) and _is_about_input(error):
            sentence = _explained(error)
            if self.normalize and "VecNormalize with norm_obs=False" in sentence:
                raise SettingsError(
                    f"normalize in {self._source('normalize')} asks for observations to be normalised, but images are "
                    "taken as they are: leave it out, or normalise rewards alone, as normalize: {norm_obs: false} "
                    '(-params "normalize:dict(norm_obs=False)").'
                ) from error
            if self.normalize and "VecNormalize lies around" in sentence:
                raise SettingsError(
                    f"normalize in {self._source('normalize')} lies within what rl-zoo3 stacks frames or moves "
                    "channels with, but must lie around it, as SB3 stores what it sees: leave frame_stack out, and "
                    "give of vec_env_wrapper: [stable_baselines3.common.vec_env.VecTransposeImage, "
                    "{stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 3}}] what the images need."
                ) from error
            raise SettingsError(f"{sentence} (settings: {self._sources(sentence)}).") from error

    def _remove_run(self) -> None:
        """Remove the folder of a run that cannot begin, unless it was there before."""
        if self._fresh[:1] != [Path(self.save_path)] or any(Path(self.save_path).rglob("*.zip")):
            return
        shutil.rmtree(self.save_path, ignore_errors=True)
        for folder in self._fresh[1:]:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def _source(self, name: str) -> str:
        """Where a setting was given."""
        return next((flag for flag, given in self._flags.items() if name in given), self.config)

    def _sources(self, sentence: str) -> str:
        """The file, and which of the settings that a sentence speaks of were given elsewhere."""
        words = {*re.findall(r"\w+", sentence)}
        elsewhere = [
            f"{name} from {flag}"
            for flag, given in self._flags.items()
            for name, value in given.items()
            if words & {name, *(value if isinstance(value, dict) else ())}
        ]
        return self.config + (f", but {' and '.join(elsewhere)}" if elsewhere else "")

    def learn(self, model: Any) -> None:
        if self.log_interval == 0:  # the constructor's own default, by which SB3 divides
            self.log_interval = -1
        self.callbacks.append(steps := _Steps())
        try:
            super().learn(model)
        except gym.error.DependencyNotInstalled:  # as for a window, which is opened by the first reset
            if steps.n_calls <= 1:
                self._remove_run()
            raise
        except (ValueError, OSError) as error:  # as of a callback, when training begins
            if steps.n_calls <= 1:
                self._refuse(error)
            raise

    def _open_storage(self, storage: str) -> None:
        journal = Path(storage) if storage.endswith(".log") else None
        if journal is not None and not journal.exists():  # rl-zoo3 makes it, and its folder
            with _refusing():
                check_folder("the folder of --storage", journal.parent)
            return
        try:
            if journal is None:
                _create_tables(storage)
            else:
                optuna.storages.JournalStorage(JournalFileBackend(storage))
        except Exception as error:  # of Optuna or of the database's driver, whichever that is
            raise SettingsError(
                f"--storage is {storage!r}, which cannot be opened ({_one_line(error)}): give a database such as "
                "sqlite:///study.db."
            ) from error

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        entry = self._check_file()
        if self.trial_id is not None:
            trial = self._trial()
            self.trial_id = None
            self.custom_hyperparams = {**trial, **(self.custom_hyperparams or {})}
        asked = self.env_name
        if entry is not None:
            self.env_name = type(asked)(entry)  # by which rl-zoo3 looks it up
        try:
            hyperparams, saved = super().read_hyperparameters()
        finally:
            self.env_name = asked
        if self.algo == ALGO:
            self._check_values(hyperparams)
        return hyperparams, saved

    def _trial(self) -> dict[str, Any]:
        """Arguments of the trial that the command line names."""
        if not self.storage or not self.study_name:
            raise SettingsError(f"--trial-id is {self.trial_id}, but of no study: add --storage and --study-name.")
        storage: Any = self.storage
        file = Path(storage.removeprefix("sqlite:///").partition("?")[0])
        if storage.startswith("sqlite:///") or storage.endswith(".log"):
            if not file.is_file():  # Optuna would make it
                raise SettingsError(
                    f"--storage is {storage!r}, but there is no such file: name one that `sb3-cure optimize` wrote."
                )
        try:
            if storage.endswith(".log"):
                storage = optuna.storages.JournalStorage(JournalFileBackend(storage))
            studies = optuna.get_all_study_names(storage)
            known = self.study_name in studies
            n_trials = len(optuna.load_study(study_name=self.study_name, storage=storage).trials) if known else 0
            if self.trial_id in range(n_trials):
                return self.load_trial(self.storage, self.study_name, self.trial_id)
        except KeyError as error:
            raise SettingsError(
                f"--trial-id {self.trial_id} of --study-name {self.study_name!r} has no {_one_line(error)!r}: name a "
                f"trial that was finished, of a study that was made with --algo {self.algo}."
            ) from error
        except Exception as error:  # of Optuna or of the database's driver, whichever that is
            raise SettingsError(
                f"--trial-id {self.trial_id} of --study-name {self.study_name!r} in --storage {self.storage!r} cannot "
                f"be read ({_one_line(error)}): name a trial that is there."
            ) from error
        if not known:
            raise SettingsError(
                f"--study-name is {self.study_name!r}, but --storage {self.storage!r} has the studies "
                f"{', '.join(studies) or '(none)'}: name one of them."
            )
        raise SettingsError(
            f"--trial-id is {self.trial_id}, but --study-name {self.study_name!r} has {n_trials} trials, the first of "
            "which is 0: name one of them."
        )

    def _check_file(self) -> str | None:
        """The entry of a YAML file that holds for the environment."""
        path = Path(self.config)
        if (self.config.endswith((".yml", ".yaml", ".py")) and not path.is_file()) or path.is_dir():
            given = f"the settings file {path} is no file"
            if "rl_zoo3" in path.parts:  # where rl-zoo3 has those of its own algorithms
                given = "cure_sac needs a settings file"
            raise SettingsError(
                f"{given}: give one with --conf-file, such as zoo_configs/cure_sac_ae.yml of sb3_cure's sources."
            )
        if not self.config.endswith((".yml", ".yaml")):
            return None
        try:
            entries = yaml.safe_load(path.read_text())
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise SettingsError(f"{path} is no YAML ({_one_line(error)}): correct it.") from error
        if not isinstance(entries, dict):
            raise SettingsError(f"{path} holds {entries!r}, but it must map environments to settings: correct it.")
        task = self.env_name.gym_id
        with_module = (f"{module}:{task}" for module in getattr(self.args, "gym_packages", ()))
        name = next((name for name in with_module if name in entries), entry_for(task, entries))
        if name in (None, "default") and self._is_atari and "atari" in entries:
            name = "atari"  # as rl-zoo3's own files have it
        if name is None:
            raise SettingsError(f"{path} has neither {task!r} nor 'default': add one of them.")
        if not isinstance(entries[name], dict):
            raise SettingsError(f"the settings of {name!r} in {path} are no mapping (key: value): correct them.")
        return name

    def _check_values(self, hyperparams: dict[str, Any]) -> None:
        known = arguments_of(ALGOS[ALGO])
        for name, value in hyperparams.items():
            if name in _FLAGS:
                raise SettingsError(
                    f"{self._source(name)} has {name}: {value!r}, but the command line says that: remove it, and add "
                    f"{_FLAGS[name]} {value}."
                )
            with _refusing():
                check_keywords(self._source(name), {name: value}, known and known | _ZOO_KEYS, CuReSAC.__name__)
        if not is_number(hyperparams.get("n_timesteps"), low=1):
            raise SettingsError(
                f"n_timesteps in {self._source('n_timesteps')} is {hyperparams.get('n_timesteps')!r}, but it must be a "
                "number of agent steps of at least 1: write for example n_timesteps: 12500."
            )
        if not is_integer(hyperparams.get("n_envs", 1), 1):
            raise SettingsError(
                f"n_envs in {self._source('n_envs')} is {hyperparams['n_envs']!r}, but it must be a whole number of at "
                "least 1: change n_envs."
            )
        # Texts are Python, for rl-zoo3, of a monitor's arguments only.
        for name, kinds in (("env_kwargs", dict), ("monitor_kwargs", dict | str)):
            if not isinstance(hyperparams.get(name) or {}, kinds):
                raise SettingsError(
                    f"{name} in {self._source(name)} is {hyperparams[name]!r}, but it must be a mapping (key: value): "
                    f"change {name}."
                )
        frame_stack = hyperparams.get("frame_stack")
        if frame_stack is not None and not is_integer(frame_stack, 1):
            raise SettingsError(
                f"frame_stack in {self._source('frame_stack')} is {frame_stack!r}, but it must be a whole number of "
                "frames of at least 1: change it, or leave it out."
            )
        normalize = hyperparams.get("normalize") or False
        if not isinstance(normalize, bool | dict) and not re.match(r"\s*(dict\s*\(|{)", str(normalize)):
            raise SettingsError(
                f"normalize in {self._source('normalize')} is {normalize!r}, but it must be true, false, or arguments "
                "of SB3's VecNormalize: write for example normalize: {norm_obs: false}."
            )
        self._check_noise(hyperparams)
        kwargs = hyperparams.get("monitor_kwargs") or {}
        if isinstance(kwargs, dict):
            with _refusing():
                where = f"monitor_kwargs in {self._source('monitor_kwargs')}"
                check_keywords(where, kwargs, arguments_of(Monitor), "SB3's Monitor")
        if hyperparams.get("policy") is None:
            raise SettingsError(f"{self.config} has no policy: add policy: CnnPolicy, or MlpPolicy for vectors.")
        rate = hyperparams.get("learning_rate", 0.0)
        if isinstance(rate, str) and not re.fullmatch(r"lin_\d*\.?\d+(e-?\d+)?", rate):
            raise SettingsError(
                f"learning_rate in {self._source('learning_rate')} is {rate!r}, but it must be a number, or "
                "'lin_<number>' for one that falls to 0: write for example lin_0.001 (YAML reads 1e-3 as text, 1.0e-3 "
                "as a number)."
            )

    def _check_noise(self, hyperparams: dict[str, Any]) -> None:
        kind = hyperparams.get("noise_type")
        if kind is None:
            return
        if not isinstance(kind, str) or kind not in _NOISES:
            raise SettingsError(
                f"noise_type in {self._source('noise_type')} is {kind!r}, but it must be one of "
                f"{', '.join(map(repr, _NOISES))}: choose one."
            )
        if not is_number(hyperparams.get("noise_std"), low=0):
            raise SettingsError(
                f"noise_std in {self._source('noise_std')} is {hyperparams.get('noise_std')!r}, but noise_type needs a "
                "standard deviation of at least 0, of actions in [-1, 1]: write for example noise_std: 0.1."
            )

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple:
        if hyperparams.get("env_kwargs"):
            # What is saved with the run as its command line, which `enjoy` and `record` read.
            self.args.env_kwargs = dict(hyperparams["env_kwargs"])
            if self._eval_env_kwargs_args is None:
                self.eval_env_kwargs = self.args.env_kwargs
        if isinstance(kwargs := hyperparams.get("monitor_kwargs"), dict):  # the Monitor adds tuples, which YAML has not
            lists = {name: tuple(value) for name, value in kwargs.items() if isinstance(value, list)}
            hyperparams["monitor_kwargs"] = {**kwargs, **lists}
        srl = hyperparams.get("srl")
        if isinstance(srl, str) and "." in srl:  # else a class, which a Python file may hold
            hyperparams["srl"] = _head("srl", srl)
        buffer = hyperparams.get("replay_buffer_class")
        if isinstance(buffer, str) and re.fullmatch(r"\w+(\.\w+)+", buffer):  # else it is Python, for rl-zoo3
            hyperparams["replay_buffer_class"] = _imported("replay_buffer_class", buffer)
        return super()._preprocess_hyperparams(hyperparams)

    def hyperparameters_optimization(self) -> None:
        if self.algo == ALGO:
            curiosity = self._hyperparams.get("curiosity", "separate")
            HYPERPARAMS_SAMPLER[ALGO] = partial(sample_cure_sac_params, curiosity=curiosity)
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "same parameter name" in str(error):  # of Optuna's distributions
                raise SettingsError(
                    f"--study-name is {self.study_name!r}, but this study in --storage {self.storage!r} was made with "
                    f"other parameters ({_one_line(error)}): choose a --study-name of its own."
                ) from error
            if "No trials are completed" not in str(error):
                raise
            raise SettingsError(
                "no trial was finished (all were interrupted or pruned, or have failed, as told above), so that there "
                "is no best one: start again; with --storage and --study-name it goes on with what was tried."
            ) from error


def _head(where: str, name: Any) -> Any:
    """The class of a user's own head."""
    if not str(name).rpartition(".")[0]:
        raise SettingsError(
            f"{where} is {name!r}, but it must be a head of your own as module.Class: write that, or leave {where} out "
            "for 'rae' and 'curl', which models are saved with."
        )
    return _imported(where, name)


def _imported(where: str, name: str) -> type:
    """A class that settings name."""
    try:
        return get_class_by_name(name)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:  # ValueError: no module
        raise SettingsError(
            f"{where} is {name!r}, which cannot be imported ({_one_line(error)}): name a class as module.Class, in a "
            "module of the working directory or an installed one."
        ) from error


def _one_line(error: Exception) -> str:
    """What an error says, without the full stop or question mark at its end."""
    text = error.args[0] if isinstance(error, KeyError) and error.args else error
    return " ".join(str(text).split()).rstrip(".?")


def _explained(error: Exception, add_head: str = "add srl: {} to the settings") -> str:
    """The same, with what to do where Python, or a program's sentence, does not say it."""
    if isinstance(error, ObjectsMissing) and error.missing.keys() == {"srl"}:
        head = error.missing["srl"].rpartition(" ")[2]
        return f"{error.name} was saved with the head {head}, which no archive holds: {add_head.format(head)}"
    if isinstance(error, NameError | SyntaxError):
        return (
            f"a text that is to be evaluated is no Python ({_one_line(error)}): correct it; text in it needs quotes "
            """of its own, such as -params "srl:'curl'\""""
        )
    if isinstance(error, ImportError):
        return f"what is named cannot be imported ({_one_line(error)}): correct the name, or install it"
    if isinstance(error, OSError):
        return f"{error.filename} cannot be used ({error.strerror}): name another folder or file"
    if unknown := re.search(r"unexpected keyword argument '(\w+)' was raised from .* for (\S+) with", str(error)):
        return _not_of_environment(*unknown.groups())
    if missing := re.match(r"No (?:model|checkpoint) found for .+, path: (.+)", str(error)):
        return _not_of_run(Path(missing[1]))
    return _one_line(error)


def _not_of_environment(name: str, task: str) -> str:
    """What to do about one of its ``env_kwargs``, with the name that it is close to, if that can be told."""
    entry = gym.spec(task).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else entry
    whose = getattr(creator, "__name__", task)
    try:
        check_keywords("env_kwargs", {name: None}, arguments_of(creator), whose)
    except TypeError as error:
        return _one_line(error)
    return f"env_kwargs has {name!r}, but {whose} has no such argument: correct or remove it"


def _not_of_run(missing: Path) -> str:
    """What to do about a model that is not there, with those that are."""
    if missing.suffix != ".zip":
        missing /= "rl_model_*_steps.zip"
    run = missing.parent
    name = _RUN.fullmatch(run.name)
    steps = sorted(int(file.stem.split("_")[-2]) for file in run.glob("rl_model_*_steps.zip"))
    shown = map(str, steps if len(steps) < 10 else [*steps[:4], "...", *steps[-4:]])
    models = {
        "the last model (without --load flags)": (run / f"{name[1] if name else run.name}.zip").is_file(),
        "the best one (--load-best)": (run / "best_model.zip").is_file(),
        f"checkpoints at {', '.join(shown)} (--load-checkpoint)": bool(steps),
    }
    there = " and ".join(model for model, exists in models.items() if exists)
    return f"there is no {missing}{f', but its run has {there}: choose one of these, or' if there else ':'} {_OF_RUN}"


def _is_about_input(error: BaseException) -> bool:
    """Whether it was raised where settings are read, by rl-zoo3 or by us, and not in somebody's own code."""
    frame = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    if frame is None or not isinstance(error, _OF_INPUT):
        return False
    package = str(frame.tb_frame.f_globals.get("__name__")).partition(".")[0]
    # What rl-zoo3 evaluates of the file or of the command line is of no package.
    return package in _PACKAGES or frame.tb_frame.f_code.co_filename == "<string>" or isinstance(error, SyntaxError)


def _create_tables(storage: str, attempts: int = 5) -> None:
    """Optuna makes the tables of a new database when it opens it, and fails where another process is just doing so."""
    for attempt in range(attempts):
        try:
            optuna.storages.RDBStorage(storage)
            return
        except Exception:  # of the database's driver, whichever that is
            if attempt + 1 == attempts:
                raise
            time.sleep(1)


def sample_cure_sac_params(
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    curiosity: str | None = "separate",
) -> dict[str, Any]:
    """What ``optimize`` varies; all else, such as the head and the networks, stays as in the YAML file.

    :param trial: Optuna's trial
    :param n_actions: Unused (rl-zoo3's signature)
    :param n_envs: Unused (rl-zoo3's signature)
    :param additional_args: Unused (rl-zoo3's signature)
    :param curiosity: As in ``CuReSAC``; decides which of the curious agent's parameters matter
    :return: Arguments of ``CuReSAC``
    """
    sampled: dict[str, Any] = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 2e-3, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 9),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.005, 0.05, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.05, log=True),
        "encoder_tau": trial.suggest_float("encoder_tau", 0.01, 0.1, log=True),
        "initial_temperature": trial.suggest_float("initial_temperature", 0.01, 1.0, log=True),
    }
    if curiosity in ("separate", "random"):
        sampled["curiosity_prob"] = trial.suggest_float("curiosity_prob", 0.0, 0.5)
    if curiosity in ("separate", "bonus"):
        sampled["curiosity_beta"] = trial.suggest_float("curiosity_beta", 0.1, 10.0, log=True)
    converted = convert_cure_sac_params(sampled)
    for name in ("batch_size", "gamma", "ent_coef"):  # Optuna's reports then show the values themselves
        trial.set_user_attr(name, converted[name])
    return converted


def convert_cure_sac_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Parameters of a trial, by the names that Optuna knows them by
    :return: Arguments of ``CuReSAC``
    """
    arguments = dict(sampled_params)
    arguments["batch_size"] = 2 ** arguments.pop("batch_size_pow")
    arguments["gamma"] = 1 - arguments.pop("one_minus_gamma")
    arguments["ent_coef"] = f"auto_{arguments.pop('initial_temperature')}"
    return arguments


def register(algorithm: type[CuReSAC] = CuReSAC) -> None:
    """Make ``cure_sac`` known to rl-zoo3: its programs, its ``ExperimentManager`` and its samplers.

    :param algorithm: The class that trains or is loaded under this name
    """
    ALGOS[ALGO] = algorithm
    HYPERPARAMS_SAMPLER[ALGO] = sample_cure_sac_params
    HYPERPARAMS_CONVERTER[ALGO] = convert_cure_sac_params


def train() -> None:
    """rl-zoo3's ``train``, on ``sys.argv``."""
    program = importlib.import_module("rl_zoo3.train")
    program.ExperimentManager = ExperimentManager  # type: ignore[attr-defined]
    program.train()


class RunLoader(yaml.SafeLoader):
    """Reads the settings that rl-zoo3 saves with a run: plain values, tuples and ordered dictionaries, nothing else.

    Of classes and functions, such as an ``activation_fn``, the names are read, and nothing is imported.
    """


RunLoader.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: OrderedDict(*loader.construct_sequence(node, deep=True)),
)
RunLoader.add_constructor(
    "tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True))
)
RunLoader.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, name, node: name)


def _load_run(load: Callable[..., Any], stream: Any, Loader: Any) -> Any:
    """For ``yaml.load``, where rl-zoo3 reads what it saved with a run."""
    if Loader is not RunLoader:
        return load(stream, Loader)
    try:
        settings = load(stream, Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        wrong = f"is no YAML ({_one_line(error)})"
    else:
        if isinstance(settings, dict):
            return settings
        wrong = f"holds {settings!r}"
    raise SettingsError(
        f"{stream.name} {wrong}, but it must hold the settings of a run: restore it, or choose another with --exp-id."
    )


@contextmanager
def _reading_runs() -> Iterator[None]:
    """rl-zoo3 would run what a run's folder names, which may come from anyone, and choose runs without a model."""
    latest = partial(_latest_run, utils.get_latest_run_id)
    with mock.patch.multiple(yaml, UnsafeLoader=RunLoader, load=partial(_load_run, yaml.load)):
        with mock.patch.object(utils, "get_latest_run_id", latest):
            yield


class _RunId(int):
    """The number of a run, which reads as the end of its folder's name: ``--uuid`` adds to the number there."""

    text: str

    def __str__(self) -> str:
        return self.text


def _latest_run(latest: Callable[..., int], log_path: str, env_name: str) -> int:
    """For ``get_latest_run_id``: the latest run that holds a model, which `optimize` and failed runs do not."""
    runs = []
    for run in Path(log_path).glob("*"):
        name, models = _RUN.fullmatch(run.name), [*run.glob("*.zip")]
        if name and name[1] == env_name and models:
            runs.append((int(name[3]), max(model.stat().st_mtime for model in models), name[2]))
    if not runs:
        return latest(log_path, env_name)
    number, _, text = max(runs)
    run_id = _RunId(number)
    run_id.text = text
    return run_id


def enjoy() -> None:
    """rl-zoo3's ``enjoy``, on ``sys.argv``."""
    with _reading_runs():
        importlib.import_module("rl_zoo3.enjoy").enjoy()


def record() -> None:
    """rl-zoo3's ``record_video``, on ``sys.argv``."""
    # It is a script, without a function to call.
    with _reading_runs():
        runpy.run_module("rl_zoo3.record_video", run_name="__main__")


_parse_args, _store = argparse.ArgumentParser.parse_args, StoreDict.__call__


def _parse_flags(
    parser: argparse.ArgumentParser, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
) -> argparse.Namespace:
    """For ``ArgumentParser.parse_args``: what rl-zoo3 finds wrong never, late, or without naming the flag."""
    if parser.get_default("algo") is None:  # of another program
        return _parse_args(parser, args, namespace)
    acts = parser.get_default("no_render") is not None  # `enjoy` and `record`
    if acts:
        parser.add_argument("--srl", metavar="MODULE.CLASS", help="Head of your own, which a saved model does not hold")
        if parser.get_default("gym_packages") is None:  # `record`
            parser.add_argument("--gym-packages", nargs="+", default=[], help="Modules that register environments")
    # Its own --env is CartPole-v1, which suits its own algorithms.
    with mock.patch.object(StoreDict, "__call__", _store_each):
        given = _parse_args(parser, args, argparse.Namespace(env=None))
    flags = vars(given)
    if acts:
        ActingCuReSAC.objects = {} if given.srl is None else {"srl": _head("--srl", given.srl)}
    if given.env is None:
        if given.algo == ALGO:
            example = "dmc_pixels/finger-spin-v0"
            raise SettingsError(f"--env is missing: add the id of an environment, such as --env {example}.")
        given.env = parser.get_default("env")
    _import_environment(given, acts)
    for name, low in _LEAST.items():
        value = flags.get(name)
        if value is not None and value != parser.get_default(name) and value < low:
            flag = f"--{name.replace('_', '-')}"
            raise SettingsError(f"{flag} is {value}, but it must be at least {low}: change it, or leave it out.")
    lowest = 0 if acts else -np.inf  # negative: `train` draws one
    if not lowest <= given.seed < 2**32:
        raise SettingsError(f"--seed is {given.seed}, but it must be from 0 to 2**32 - 1: change it, or leave it out.")
    if flags.get("n_jobs", 1) < 1 and given.n_jobs != -1:
        raise SettingsError(
            f"--n-jobs is {given.n_jobs}, but it must be at least 1, or -1 for as many as there are cores: change it, "
            "or leave it out."
        )
    if given.n_timesteps < 1 and given.n_timesteps != parser.get_default("n_timesteps"):
        raise SettingsError(
            f"-n/--n-timesteps is {given.n_timesteps}, but it must be a number of agent steps of at least 1: give one, "
            "or leave it out."
        )
    if (agent := flags.get("trained_agent")) and not (agent.endswith(".zip") and Path(agent).is_file()):
        raise SettingsError(
            f"-i/--trained-agent is {agent!r}, but it must be a .zip file that is there: give the path of a saved "
            "model, or leave it out."
        )
    if flags.get("track") and importlib.util.find_spec("wandb") is None:
        raise SettingsError("--track needs wandb, which is not installed: pip install wandb, or leave --track out.")
    if flags.get("sampler") == "auto" and importlib.util.find_spec("optunahub") is None:
        raise SettingsError(
            "--sampler auto needs optunahub, which is not installed: pip install optunahub, or choose --sampler tpe."
        )
    for name in ("output_folder", "optimization_log_path", "reward_log", "log_folder", "tensorboard_log"):
        if flags.get(name):
            with _refusing():
                check_folder(f"--{name.replace('_', '-')}", flags[name])
    return given


def _import_environment(given: argparse.Namespace, acts: bool) -> None:
    """Import what registers the environment: the modules of ``--gym-packages``, and that of ``--env module:id``."""
    packages = given.gym_packages
    module, _, task = getattr(given.env, "gym_id", given.env).rpartition(":")
    with _refusing():
        for name in packages:
            import_environments(name, "--gym-packages")
        if module:
            import_environments(module, "--env")
            given.gym_packages = [*packages, module]  # with which the run is saved
    given.env = type(given.env)(task)
    if acts and task not in gym.registry:  # `train` says so itself
        raise SettingsError(
            f"--env is {task!r}, which is not registered with Gymnasium: correct it, or name the module that registers "
            f"it (--gym-packages my_module, or --env my_module:{task})."
        )


def _store_each(
    action: StoreDict, parser: Any, namespace: argparse.Namespace, values: Sequence[str], option: str | None = None
) -> None:
    """For ``StoreDict``, which evaluates ``name:value``: which of them is wrong."""
    settings: dict[str, Any] = {}
    for text in values:
        try:
            _store(action, parser, namespace, [text], option)
        except Exception as error:  # of any Python
            reason = error.msg if isinstance(error, SyntaxError) else _one_line(error)
            raise SettingsError(
                f"{option} has {text!r}, but it takes name:value, with a value of Python ({reason}): write for example "
                "batch_size:128; text needs quotes of its own, as in \"srl:'curl'\"."
            ) from error
        settings |= getattr(namespace, action.dest)
    setattr(namespace, action.dest, settings)


def run(program: str, arguments: Sequence[str]) -> None:
    """
    :param program: One of ``PROGRAMS``
    :param arguments: Its command line; ``enjoy`` and ``record`` also take ``--srl my_package.MyHead``, the class of a
        head of your own, which a saved model does not hold. All programs take ``--env my_module:Env-v0``, too
    """
    acts = program in ("enjoy", "record")
    # Classes that settings and `--srl` name may lie in the working directory.
    if "" not in sys.path:
        sys.path.append("")
    register(ActingCuReSAC if acts else CuReSAC)
    # argparse takes the last of repeated flags, so that these are defaults.
    defaults = ["--algo", ALGO] + (["--folder", "logs"] if acts else [])
    if program == "optimize":
        defaults.append("-optimize")
    if program == "enjoy" and is_headless() and not {"--no-render", "-h", "--help"} & {*arguments}:
        print("There is no display to show the agent on (as with --no-render); `record` writes a video.")
        defaults.append("--no-render")
    if not acts:
        tune_allocator()
    programs: dict[str, Callable[[], None]] = {"train": train, "enjoy": enjoy, "record": record, "optimize": train}
    own_arguments = sys.argv
    sys.argv = [f"sb3-cure {program}", *defaults, *arguments]
    try:
        with mock.patch.object(argparse.ArgumentParser, "parse_args", _parse_flags):
            programs[program]()
    except gym.error.DependencyNotInstalled as error:
        asked = program != "enjoy" or "--no-render" in sys.argv
        window = "leave render_mode='human' out" if asked else "add --no-render"
        raise SettingsError(f"{_one_line(error)}, or, to open no window, {window}.") from error
    except _OF_INPUT as error:
        if isinstance(error, SettingsError) or (fix := _fix(error, acts)) is None:
            raise
        raise SettingsError(f"{_explained(error)}{fix}.") from error
    finally:
        sys.argv = own_arguments


def _fix(error: BaseException, acts: bool) -> str | None:
    """What to do, where rl-zoo3 itself complains about the command line; None if what it runs does."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    if not _is_about_input(error):
        return None
    if any(frame.f_code.co_name == "create_test_env" for frame in frames):  # of `enjoy` and `record`
        if isinstance(error, TypeError) and "environment creator" in str(error):
            return " in --env-kwargs"
        return ": correct --env-kwargs" if isinstance(error, ValueError | TypeError) else ""
    packages = [str(frame.f_globals.get("__name__")).partition(".")[0] for frame in frames]
    if "stable_baselines3" in packages or packages[-1] == "sb3_cure":
        return None
    if isinstance(error, AssertionError | ValueError):
        if acts:
            return "" if ", path: " in str(error) else f": {_OF_RUN}"  # which `_explained` has said
        return ": correct the command line"
    return "" if isinstance(error, NameError | SyntaxError | ImportError) else None


if __name__ == "__main__":
    from sb3_cure.cli import main

    sys.exit(main())
