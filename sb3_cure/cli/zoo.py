"""``train`` and ``optimize``: rl-zoo3's programs with CuRe's algorithms."""

import argparse
import os
import sys
from collections import OrderedDict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from pprint import pprint
from typing import Any

import optuna
import rl_zoo3.train
from rl_zoo3 import ALGOS, exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import StoreDict
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.cli.progress import TimeLeft
from sb3_cure.cli.report_ends import ReportEnds
from sb3_cure.cli.usage import UsageError, missing_file, nearest, parse, refusals_in_one_sentence
from sb3_cure.cli.zoo_files import (
    ALGORITHMS,
    DEFAULT_ALGORITHM,
    changed,
    check_environment,
    import_module,
    linear_schedules,
    named_classes,
    named_wrappers,
    zoo_entry,
    zoo_file,
)
from sb3_cure.envs import make_dmc_env

#: The file of settings where ``--conf-file`` is not given
DEFAULT_SETTINGS = "cure_sac_ae"


class ExperimentManager(exp_manager.ExperimentManager):
    """rl-zoo3's manager, which reads the settings and makes environments and model, with additions.

    - ``--conf-file fast/cure_sac_ae`` is one of the package's files;
    - an entry ``dmc_pixels:`` of a YAML file applies to all tasks of this namespace without an entry of their own, and
      ``my_module:My-v0:`` to an environment that ``my_module`` registers;
    - in a file 1e-3 is a number, as in grids; ``curiosity_prob: lin_0.5`` is a schedule, as of the learning rate;
    - ``env_kwargs`` of the file also apply to the environments of evaluations;
    - ``srl: my_module.MyHead`` names a class, as rl-zoo3's ``policy`` and ``callback`` do;
    - statistics in the folder of ``-i``, which are pickled, are loaded only if the settings have ``normalize``;
    - trainings that are started together get a folder each;
    - ``--trial-id 0`` selects the first trial, instead of being taken for no trial;
    - settings that cannot be used are refused in one sentence, and training prints the remaining time;
    - ``optimize`` samples only what the chosen kind of curiosity uses.
    """

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if self.trial_id is not None:
            if not (self.storage and self.study_name):
                raise UsageError("--trial-id names a trial of a study: add --storage and --study-name.")
            trial = self.load_trial(self.storage, self.study_name, self.trial_id)
            self.custom_hyperparams = {**trial, **(self.custom_hyperparams or {})}
            self.trial_id = None
        path = zoo_file(self.config)
        is_yaml = path.suffix in (".yml", ".yaml")
        if not is_yaml or (self.algo not in ALGORITHMS and self.args.conf_file is None):  # rl-zoo3's own settings
            return super().read_hyperparameters()
        entry = zoo_entry(path, self.env_name.gym_id, self.args.gym_packages)
        settings = changed(entry, self.custom_hyperparams or {})
        if self.env_kwargs:
            settings["env_kwargs"] = self.env_kwargs
        saved = OrderedDict(sorted(settings.items()))
        print(f"Loading hyperparameters from: {path}")
        pprint(saved)
        return settings, saved

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        algorithm = ALGOS[self.algo]
        with refusals_in_one_sentence(algorithm, *algorithm.policy_aliases.values(), make_dmc_env):
            experiment = super().setup_experiment()
        self._updates_before = 0 if experiment is None else getattr(experiment[0], "_n_updates", 0)
        return experiment

    def create_log_folder(self) -> None:
        while True:
            try:
                os.makedirs(self.save_path)
                break
            except FileExistsError:  # of a training that was started at the same time
                stem, _, number = self.save_path.rpartition("_")
                self.save_path = f"{stem}_{int(number) + 1}"
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()

    def create_callbacks(self) -> None:
        super().create_callbacks()
        if not (self.show_progress or self.optimize_hyperparameters):
            self.callbacks.append(TimeLeft(self.env_name.gym_id))

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        super().save_trained_model(model)
        path = f"{self.save_path}/{self.env_name}.zip"
        if model.num_timesteps < self.n_timesteps:  # rl-zoo3 catches Ctrl-C
            print(
                f"Stopped at step {model.num_timesteps:,} of {self.n_timesteps:,}: {path} keeps the model, and "
                f"the same command with -i {path} begins a new training from its weights."
            )
        elif isinstance(model, OffPolicyAlgorithm) and model._n_updates == self._updates_before:
            print(f"Nothing was learned: no update is made before step learning_starts={model.learning_starts:,}.")

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple:
        for name in ("policy", "n_timesteps"):
            if name not in hyperparams and not (name == "n_timesteps" and self.n_timesteps > 0):
                raise UsageError(
                    f"{self.config} has no {name!r} for {self.env_name.gym_id}{nearest(name, hyperparams)}"
                )
        hyperparams.setdefault("n_timesteps", self.n_timesteps)  # which rl-zoo3 deletes in any case
        hyperparams.update(named_classes(hyperparams))
        for name in ("env_wrapper", "vec_env_wrapper"):
            list(named_wrappers(hyperparams.get(name)))  # or the nearest names
        arguments, env_wrapper, *others = super()._preprocess_hyperparams(hyperparams)
        if env_wrapper is not None:
            env_wrapper = partial(ReportEnds, wrap=env_wrapper)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        return arguments, env_wrapper, *others

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        ours = linear_schedules(hyperparams)  # rl-zoo3's own class is none that archives know
        rest = {name: value for name, value in hyperparams.items() if name not in ours}
        return {**exp_manager.ExperimentManager._preprocess_schedules(rest), **ours}

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        networks = hyperparams.get("policy_kwargs")  # which rl-zoo3 ignores here, and writes into config.yml
        model = super()._load_pretrained_agent(hyperparams, env)
        own = {name: value for name, value in model.policy_kwargs.items() if name != "use_sde"}  # which SB3 adds
        if self.algo in ALGORITHMS and networks is not None and networks != own:
            raise UsageError(f"{self.trained_agent} has policy_kwargs={own}, which cannot become {networks}.")
        return model

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        return super()._maybe_normalize(env, eval_env) if self.normalize else env

    def hyperparameters_optimization(self) -> None:
        if self.algo in ALGORITHMS:
            curiosity = self._hyperparams.get("curiosity", "separate")
            sampler = partial(sample_params, curiosity=curiosity, quantiles=self.algo == "cure_tqc")
            HYPERPARAMS_SAMPLER[self.algo] = sampler
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):  # Optuna's, where there is no best one to show
                raise
            print("No trial was completed.")


def sample_params(
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    curiosity: str | None = "separate",
    quantiles: bool = False,
) -> dict[str, Any]:
    """Sample the parameters that ``optimize`` varies; all others stay as in the YAML file.

    :param trial: Optuna's trial
    :param n_actions: Unused (rl-zoo3's signature)
    :param n_envs: Unused (rl-zoo3's signature)
    :param additional_args: Unused (rl-zoo3's signature)
    :param curiosity: As in ``CuReSAC``; decides which of the curious agent's parameters matter
    :param quantiles: Whether the critics are TQC's
    :return: Arguments of the algorithm
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
    if quantiles:
        sampled["top_quantiles_to_drop_per_net"] = trial.suggest_int("top_quantiles_to_drop_per_net", 0, 5)
    converted = convert_params(sampled)
    for name in ("batch_size", "gamma", "ent_coef"):  # Optuna's reports then show the values themselves
        trial.set_user_attr(name, converted[name])
    return converted


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """Convert parameters of a trial.

    :param sampled_params: Parameters by their names in Optuna
    :return: Arguments of the algorithm
    """
    arguments = dict(sampled_params)
    arguments["batch_size"] = 2 ** arguments.pop("batch_size_pow")
    arguments["gamma"] = 1 - arguments.pop("one_minus_gamma")
    arguments["ent_coef"] = f"auto_{arguments.pop('initial_temperature')}"
    return arguments


def register() -> None:
    """Register ``cure_sac`` and ``cure_tqc`` with rl-zoo3's programs, and this experiment manager."""
    ALGOS.update(ALGORITHMS)
    for name in ALGORITHMS:
        HYPERPARAMS_CONVERTER[name] = convert_params
    rl_zoo3.train.ExperimentManager = ExperimentManager  # type: ignore[misc, attr-defined]


def train(arguments: Sequence[str]) -> None:
    """Run rl-zoo3's ``train``.

    :param arguments: Its command line; unless given, ``--algo`` is ``cure_sac`` and ``--conf-file`` ``cure_sac_ae``.
        ``--env`` may be ``my_module:My-v0``, with the module that registers it
    """
    register()
    given = _parse_train(arguments)
    for package in given.gym_packages:
        import_module(package)
    # Of repeated flags argparse takes the last.
    before = ["--algo", given.algo, *(["--conf-file", DEFAULT_SETTINGS] if given.algo in ALGORITHMS else [])]
    after = []
    if given.env is None and not given.help:
        raise UsageError("--env must name an environment, such as dmc_pixels/cartpole-swingup-v0.")
    if given.env is not None:
        check_environment(given.env)
        module, _, task = given.env.rpartition(":")
        after = ["--env", task, *(["--gym-packages", *given.gym_packages, module] if module else [])]
    own_arguments = sys.argv
    sys.argv = ["sb3-cure train", *before, *arguments, *after]
    try:
        rl_zoo3.train.train()
    finally:
        sys.argv = own_arguments


def _parse_train(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the flags that are changed or checked here; refuse values that would make rl-zoo3 end in a traceback."""
    parser = argparse.ArgumentParser("sb3-cure train", add_help=False, allow_abbrev=False)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--algo", default=DEFAULT_ALGORITHM)
    for flags in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        parser.add_argument(*flags, nargs="+", action=StoreDict)
    parser.add_argument("-i", "--trained-agent", type=Path)
    given, _ = parse(parser, arguments)
    agent = given.trained_agent
    if agent is not None and not (agent.suffix == ".zip" and agent.is_file()):
        raise UsageError(missing_file(agent) if agent.suffix == ".zip" else f"-i {agent} must be a model, a .zip file.")
    return given


def optimize(arguments: Sequence[str]) -> None:
    """Search hyper-parameters with rl-zoo3's ``train -optimize``.

    :param arguments: As for ``train``
    """
    train(["-optimize", *arguments])
