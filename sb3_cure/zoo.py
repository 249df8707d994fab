"""rl-zoo3's programs with CuReSAC among its algorithms: ``python -m sb3_cure.zoo train --env ... --conf-file ...``.

``train``, ``enjoy``, ``record`` and ``optimize`` are rl-zoo3's own, with all of its flags (``--help`` shows them). What
differs: the algorithm is ``cure_sac`` and the folder ``logs`` unless given, ``optimize`` means ``train -optimize``, and
what this module's classes say.
"""

import argparse
import importlib
import runpy
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

try:
    import optuna
    import yaml
    from rl_zoo3 import ALGOS, exp_manager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
    from rl_zoo3.utils import get_class_by_name
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        f'sb3_cure.zoo needs {missing.name}, which is not installed: pip install "sb3-cure[zoo]"', name=missing.name
    ) from missing

from sb3_cure.allocator import tune_allocator
from sb3_cure.cure_sac import CuReSAC
from sb3_cure.envs.rendering import is_headless

ALGO = "cure_sac"
PROGRAMS = ("train", "enjoy", "record", "optimize")


class ActingCuReSAC(CuReSAC):
    """What ``enjoy`` and ``record`` load: a CuReSAC that only acts, without the replay buffer of its training."""

    #: What models hold no more of than a placeholder: the head that ``--srl`` names
    objects: ClassVar[dict[str, Any]] = {}

    @classmethod
    def load(cls, *args: Any, **kwargs: Any) -> CuReSAC:  # type: ignore[override]
        """
        :param args: Arguments of ``CuReSAC.load``
        :param kwargs: Its keyword arguments
        :return: The model; its ``replay_buffer`` is None
        """
        # rl-zoo3 asks for a buffer of 1 too, but only for the off-policy algorithms that it knows by name.
        objects = {**(kwargs.pop("custom_objects", None) or {}), **cls.objects}
        kwargs.update(custom_objects=objects, buffer_size=1)
        model = CuReSAC.load(*args, **kwargs)
        model.replay_buffer = None
        return model


class ExperimentManager(exp_manager.ExperimentManager):
    """rl-zoo3's, which reads the YAML and makes environments and model, with these additions:

    - ``env_kwargs`` of the YAML file hold for the evaluation's environments too, and ``record`` finds them again;
    - ``srl: my_package.MyHead`` names a class, as rl-zoo3's ``policy`` and ``callback`` do;
    - ``optimize`` samples only the hyper-parameters that the chosen kind of curiosity uses, and several processes may
      start at once on a database that does not exist yet;
    - ``--trial-id 0`` is the first trial, where rl-zoo3 takes 0 for none;
    - a missing file of settings is explained.
    """

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if self.config.endswith((".yml", ".yaml", ".py")) and not Path(self.config).is_file():
            raise ValueError(
                f"The settings file {self.config} does not exist: give one with --conf-file, such as "
                "zoo_configs/cure_sac_ae.yml of sb3_cure's sources."
            )
        if self.storage and self.study_name and self.trial_id == 0:
            trial = self.load_trial(self.storage, self.study_name, 0)
            self.custom_hyperparams = {**trial, **(self.custom_hyperparams or {})}
        return super().read_hyperparameters()

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple:
        if hyperparams.get("env_kwargs"):
            # What is saved with the run as its command line, which `enjoy` and `record` read.
            self.args.env_kwargs = dict(hyperparams["env_kwargs"])
            if self._eval_env_kwargs_args is None:
                self.eval_env_kwargs = self.args.env_kwargs
        if "." in str(hyperparams.get("srl")):
            hyperparams["srl"] = get_class_by_name(hyperparams["srl"])
        return super()._preprocess_hyperparams(hyperparams)

    def hyperparameters_optimization(self) -> None:
        if self.algo == ALGO:
            curiosity = self._hyperparams.get("curiosity", "separate")
            HYPERPARAMS_SAMPLER[ALGO] = partial(sample_cure_sac_params, curiosity=curiosity)
        if self.storage is not None and not self.storage.endswith(".log"):
            _create_tables(self.storage)
        super().hyperparameters_optimization()


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
    """Reads the settings that rl-zoo3 saves with a run: plain values, tuples and ordered dictionaries, nothing else."""


RunLoader.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: OrderedDict(*loader.construct_sequence(node, deep=True)),
)
RunLoader.add_constructor(
    "tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True))
)


def enjoy() -> None:
    """rl-zoo3's ``enjoy``, on ``sys.argv``."""
    # rl-zoo3 would run what a run's folder names, which may come from anyone.
    with mock.patch.object(yaml, "UnsafeLoader", RunLoader):
        importlib.import_module("rl_zoo3.enjoy").enjoy()


def record() -> None:
    """rl-zoo3's ``record_video``, on ``sys.argv``."""
    # It is a script, without a function to call.
    with mock.patch.object(yaml, "UnsafeLoader", RunLoader):
        runpy.run_module("rl_zoo3.record_video", run_name="__main__")


def run(program: str, arguments: Sequence[str]) -> None:
    """
    :param program: One of ``PROGRAMS``
    :param arguments: Its command line; ``enjoy`` and ``record`` also take ``--srl my_package.MyHead``, the class of a
        head of your own, which a saved model does not hold
    """
    acts = program in ("enjoy", "record")
    # Classes that settings and `--srl` name may lie in the working directory.
    if "" not in sys.path:
        sys.path.append("")
    if acts:
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--srl")
        own, arguments = parser.parse_known_args(arguments)
        ActingCuReSAC.objects = {} if own.srl is None else {"srl": get_class_by_name(own.srl)}
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
        programs[program]()
    finally:
        sys.argv = own_arguments


if __name__ == "__main__":
    from sb3_cure.cli import main

    sys.exit(main())
