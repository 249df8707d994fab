"""Settings files, grids and command lines that cannot work: one sentence, the status 2, and nothing left behind."""

import copy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from envs_for_tests import PixelBox, tiny_model
from gymnasium.envs.registration import EnvSpec
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from test_bad_input import files_in, is_one_sentence

from sb3_cure import CuReSAC, cli, zoo
from sb3_cure.srl import RAE

TASK = "tests/PixelBox-v0"
SETTINGS: dict[str, Any] = {
    "default": {
        "policy": "CnnPolicy",
        "n_timesteps": 20,
        "buffer_size": 50,
        "policy_kwargs": {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2, "n_layers": 2}},
    }
}


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The working directory, and the tiny task under an id."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    gym.register(TASK, PixelBox)
    yield
    del gym.registry[TASK]


def refusal(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command line says that must change nothing."""
    before = files_in(Path.cwd())
    try:
        status = cli.main(command.split())
    except SystemExit as stop:  # as argparse does
        status = stop.code if isinstance(stop.code, int) else 1
    usage_and_sentence = capsys.readouterr().err
    assert status in (1, 2) and files_in(Path.cwd()) == before
    assert "Traceback" not in usage_and_sentence
    said = usage_and_sentence.splitlines()[-1]
    assert is_one_sentence(said)
    return said


TRAIN = f"train --env {TASK} --conf-file settings.yml"
OF_NORMALIZING = (
    "asks for observations to be normalised, but images are taken as they are: leave it out, or normalise rewards "
    'alone, as normalize: {norm_obs: false} (-params "normalize:dict(norm_obs=False)").'
)
VEC_ENV_WRAPPER = (
    "[stable_baselines3.common.vec_env.VecTransposeImage, "
    "{stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 3}}]"
)
OF_STACKS = (
    "lies within what rl-zoo3 stacks frames or moves channels with, but must lie around it, as SB3 stores what it "
    f"sees: leave frame_stack out, and give of vec_env_wrapper: {VEC_ENV_WRAPPER} what the images need."
)
#: what is wrong -> (settings that differ, or the file's text; the whole sentence)
ZOO: dict[str, tuple[dict[str, Any] | str, str]] = {
    "no YAML": (
        "default: [1",
        'sb3-cure train: settings.yml is no YAML (while parsing a flow sequence in "<unicode '
        "string>\", line 1, column 10: default: [1 ^ expected ',' or ']', but got '<stream "
        'end>\' in "<unicode string>", line 1, column 12: default: [1 ^): correct it.',
    ),
    "a list": (
        "- default",
        "sb3-cure train: settings.yml holds ['default'], but it must map environments to settings: correct it.",
    ),
    "nothing": ("", "sb3-cure train: settings.yml holds None, but it must map environments to settings: correct it."),
    "another task": (
        "other: {policy: CnnPolicy}",
        "sb3-cure train: settings.yml has neither 'tests/PixelBox-v0' nor 'default': add one of them.",
    ),
    "a list of settings": (
        "default: [1]",
        "sb3-cure train: the settings of 'default' in settings.yml are no mapping (key: value): correct them.",
    ),
    "a misspelt argument": (
        {"curiousity": None},
        "sb3-cure train: settings.yml has 'curiousity', but CuReSAC has no such argument: write 'curiosity'.",
    ),
    "normalised images": (
        {"normalize": True},
        f"sb3-cure train: normalize in settings.yml {OF_NORMALIZING}",
    ),
    "normalised rewards within stacks": (
        {"normalize": {"norm_obs": False}, "frame_stack": 3},
        f"sb3-cure train: normalize in settings.yml {OF_STACKS}",
    ),
    "normalised rewards within moved channels": (
        {"normalize": "dict(norm_obs=False)", "env_kwargs": {"channels_last": True}},
        f"sb3-cure train: normalize in settings.yml {OF_STACKS}",
    ),
    "no policy": (
        {"policy": None},
        "sb3-cure train: settings.yml has no policy: add policy: CnnPolicy, or MlpPolicy for vectors.",
    ),
    "a monitor's arguments in a list": (
        {"monitor_kwargs": ["is_success"]},
        "sb3-cure train: monitor_kwargs in settings.yml is ['is_success'], but it must be a mapping (key: value): "
        "change monitor_kwargs.",
    ),
    "normalising in words": (
        {"normalize": "True"},
        "sb3-cure train: normalize in settings.yml is 'True', but it must be true, false, or arguments of SB3's "
        "VecNormalize: write for example normalize: {norm_obs: false}.",
    ),
    "frames in words": (
        {"frame_stack": "3"},
        "sb3-cure train: frame_stack in settings.yml is '3', but it must be a whole number of frames of at least "
        "1: change it, or leave it out.",
    ),
    "a number as text": (
        {"batch_size": "8"},
        "sb3-cure train: batch_size is '8', but it must be a whole number of at least 1: "
        "change batch_size (settings: settings.yml).",
    ),
    "no length": (
        {"n_timesteps": None},
        "sb3-cure train: n_timesteps in settings.yml is None, but it must be a number of "
        "agent steps of at least 1: write for example n_timesteps: 12500.",
    ),
    "a length in words": (
        {"n_timesteps": "long"},
        "sb3-cure train: n_timesteps in settings.yml is 'long', but it must be a number of "
        "agent steps of at least 1: write for example n_timesteps: 12500.",
    ),
    "a negative length": (
        {"n_timesteps": -5},
        "sb3-cure train: n_timesteps in settings.yml is -5, but it must be a number of agent "
        "steps of at least 1: write for example n_timesteps: 12500.",
    ),
    "no environments": (
        {"n_envs": 0},
        "sb3-cure train: n_envs in settings.yml is 0, but it must be a whole number of at least 1: change n_envs.",
    ),
    "environments in words": (
        {"n_envs": "two"},
        "sb3-cure train: n_envs in settings.yml is 'two', but it must be a whole number of at least 1: change n_envs.",
    ),
    "an unknown policy": (
        {"policy": "Cnn"},
        "sb3-cure train: policy is 'Cnn', but it must be one of 'MlpPolicy', 'CnnPolicy', "
        "'MultiInputPolicy', or a class of policies: choose one (settings: settings.yml).",
    ),
    "a learning rate in words": (
        {"learning_rate": "lin"},
        "sb3-cure train: learning_rate in settings.yml is 'lin', but it must be a number, or "
        "'lin_<number>' for one that falls to 0: write for example lin_0.001 (YAML reads "
        "1e-3 as text, 1.0e-3 as a number).",
    ),
    "a negative learning rate": (
        {"learning_rate": -1.0},
        "sb3-cure train: learning_rate is -1.0, but it must be a float of at least 0, or a "
        "schedule of the remaining progress: change learning_rate (settings: settings.yml).",
    ),
    "a list for the environment": (
        {"env_kwargs": [1]},
        "sb3-cure train: env_kwargs in settings.yml is [1], but it must be a mapping (key: value): change env_kwargs.",
    ),
    "an argument that the environment does not take": (
        {"env_kwargs": {"imagesize": 36}},
        "sb3-cure train: env_kwargs has 'imagesize', but PixelBox has no such argument: correct or remove it "
        "(settings: settings.yml).",
    ),
    "a misspelt argument of the policy": (
        {"policy_kwargs": {"net_ach": [8]}},
        "sb3-cure train: policy_kwargs has 'net_ach', but CnnPolicy has no such argument: "
        "write 'net_arch' (settings: settings.yml).",
    ),
    "a setting that is a flag": (
        {"seed": 3},
        "sb3-cure train: settings.yml has seed: 3, but the command line says that: remove it, and add --seed 3.",
    ),
    "an unknown kind of noise": (
        {"noise_type": "gauss", "noise_std": 0.1},
        "sb3-cure train: noise_type in settings.yml is 'gauss', but it must be one of 'normal', "
        "'ornstein-uhlenbeck': choose one.",
    ),
    "noise in words": (
        {"noise_type": "normal", "noise_std": "x"},
        "sb3-cure train: noise_std in settings.yml is 'x', but noise_type needs a standard deviation of at least 0, of "
        "actions in [-1, 1]: write for example noise_std: 0.1.",
    ),
    "a misspelt argument of Monitor": (
        {"monitor_kwargs": {"info_keyword": ["x"]}},
        "sb3-cure train: monitor_kwargs in settings.yml has 'info_keyword', but SB3's Monitor has no such argument: "
        "write 'info_keywords'.",
    ),
    "no such buffer": (
        {"replay_buffer_class": "sb3_cure.buffers.FrameBuffer"},
        "sb3-cure train: replay_buffer_class is 'sb3_cure.buffers.FrameBuffer', which cannot be imported (module "
        "'sb3_cure.buffers' has no attribute 'FrameBuffer'): name a class as module.Class, in a module of the working "
        "directory or an installed one.",
    ),
    "text that is no Python": (
        {"policy_kwargs": "dict(net_arch=["},
        "sb3-cure train: a text that is to be evaluated is no Python ('[' was never closed "
        "(<string>, line 1)): correct it; text in it needs quotes of its own, such as "
        "-params \"srl:'curl'\" (settings: settings.yml).",
    ),
    "an unknown head": (
        {"srl": "vae"},
        "sb3-cure train: srl is 'vae', but it must be one of 'rae', 'curl', None, or a "
        "subclass of sb3_cure.srl.SRLHead (the class itself, not an instance) (settings: "
        "settings.yml).",
    ),
    "a head of no module": (
        {"srl": "no_such_heads.Mine"},
        "sb3-cure train: srl is 'no_such_heads.Mine', which cannot be imported (No module "
        "named 'no_such_heads'): name a class as module.Class, in a module of the working "
        "directory or an installed one.",
    ),
    "a module as head": (
        {"srl": "os.path"},
        "sb3-cure train: srl is <module 'posixpath' (frozen)>, but it must be one of 'rae', "
        "'curl', None, or a subclass of sb3_cure.srl.SRLHead (the class itself, not an "
        "instance) (settings: settings.yml).",
    ),
    "a wrapper of no module": (
        {"env_wrapper": "no_such_wrappers.Mine"},
        "sb3-cure train: what is named cannot be imported (No module named "
        "'no_such_wrappers'): correct the name, or install it (settings: settings.yml).",
    ),
    "an unknown unit": (
        {"train_freq": [1, "steps"]},
        "sb3-cure train: train_freq is (1, 'steps'), but it must be a whole number of steps "
        "of at least 1, or a pair such as (1, 'episode') or (4, 'step'): change train_freq "
        "(settings: settings.yml).",
    ),
}


@pytest.mark.parametrize("name", ZOO)
def test_settings(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """``sb3-cure train``."""
    changes, sentence = ZOO[name]
    settings = copy.deepcopy(SETTINGS)
    settings["default"].update(changes if isinstance(changes, dict) else {})
    Path("settings.yml").write_text(changes if isinstance(changes, str) else yaml.safe_dump(settings))
    assert refusal(TRAIN, capsys) == sentence


#: command line -> the whole sentence
COMMANDS: dict[str, str] = {
    "fly": ("sb3-cure has no command 'fly'; it has train, enjoy, record, optimize, experiment, report, doctor."),
    f"train --env {TASK}": (
        "sb3-cure train: cure_sac needs a settings file: give one with --conf-file, such as "
        "zoo_configs/cure_sac_ae.yml of sb3_cure's sources."
    ),
    f"train --env {TASK} --conf-file .": (
        "sb3-cure train: the settings file . is no file: give one with --conf-file, such as "
        "zoo_configs/cure_sac_ae.yml of sb3_cure's sources."
    ),
    f"train --env {TASK} --conf-file no.yml": (
        "sb3-cure train: the settings file no.yml is no file: give one with --conf-file, "
        "such as zoo_configs/cure_sac_ae.yml of sb3_cure's sources."
    ),
    **{
        command: (
            f"sb3-cure {command.split()[0]}: --env is missing: add the id of an environment, such as --env "
            "dmc_pixels/finger-spin-v0."
        )
        for command in ("train --conf-file settings.yml", "optimize --conf-file settings.yml", "enjoy", "record")
    },
    "train --env tests/PixelBo-v0 --conf-file settings.yml": (
        "sb3-cure train: tests/PixelBo-v0 not found in gym registry, you maybe meant "
        "tests/PixelBox-v0: correct the command line."
    ),
    f"{TRAIN} -params srl:vae": (
        "sb3-cure train: -params has 'srl:vae', but it takes name:value, with a value of Python (name 'vae' is not "
        "defined): write for example batch_size:128; text needs quotes of its own, as in \"srl:'curl'\"."
    ),
    f"{TRAIN} -params batch_size:8 curiosity_prob=0.2": (
        "sb3-cure train: -params has 'curiosity_prob=0.2', but it takes name:value, with a value of Python (invalid "
        "syntax): write for example batch_size:128; text needs quotes of its own, as in \"srl:'curl'\"."
    ),
    f"enjoy --env {TASK} --env-kwargs size:1/0": (
        "sb3-cure enjoy: --env-kwargs has 'size:1/0', but it takes name:value, with a value of Python (division by "
        "zero): write for example batch_size:128; text needs quotes of its own, as in \"srl:'curl'\"."
    ),
    **{
        f"{TRAIN} {flag} {value}": (
            f"sb3-cure train: {flag} is {value}, but it must be at least {least}: change it, or leave it out."
        )
        for flag, value, least in (
            ("--n-eval-envs", 0, 1),
            ("--eval-episodes", 0, 1),
            ("--eval-episodes", -1, 1),
            ("--n-trials", -2, 1),
            ("--n-evaluations", 0, 1),
            ("--max-total-trials", 0, 1),
            ("--n-startup-trials", -1, 0),
        )
    },
    f"{TRAIN} -params normalize:True": f"sb3-cure train: normalize in -params {OF_NORMALIZING}",
    f"{TRAIN} -params normalize:dict(norm_reward=False)": f"sb3-cure train: normalize in -params {OF_NORMALIZING}",
    **{
        f"{command} --seed {seed}": (
            f"sb3-cure {command.split()[0]}: --seed is {seed}, but it must be from 0 to 2**32 - 1: change it, or leave "
            "it out."
        )
        for command, seed in (
            (TRAIN, 2**32),
            (TRAIN.replace("train", "optimize", 1), 2**32),
            (f"enjoy --env {TASK} --no-render", -1),
            (f"record --env {TASK}", 2**32),
        )
    },
    **{
        f"optimize --env {TASK} --conf-file settings.yml --n-jobs {number}": (
            f"sb3-cure optimize: --n-jobs is {number}, but it must be at least 1, or -1 for as many as there are "
            "cores: change it, or leave it out."
        )
        for number in (0, -2)
    },
    f"record --env {TASK} --n-envs 0": (
        "sb3-cure record: --n-envs is 0, but it must be at least 1: change it, or leave it out."
    ),
    **{
        f"{program} --env No-v0": (
            f"sb3-cure {program}: --env is 'No-v0', which is not registered with Gymnasium: correct it, or name the "
            "module that registers it (--gym-packages my_module, or --env my_module:No-v0)."
        )
        for program in ("enjoy", "record")
    },
    "record --env my_cameras:No-v0": (
        "sb3-cure record: --env names the module 'my_cameras', which cannot be imported (No module named "
        "'my_cameras'): name one of the working directory or an installed one."
    ),
    "record --env No-v0 --gym-packages my_cameras": (
        "sb3-cure record: --gym-packages names the module 'my_cameras', which cannot be imported (No module named "
        "'my_cameras'): name one of the working directory or an installed one."
    ),
    f"{TRAIN} -tb settings.yml": (
        "sb3-cure train: --tensorboard-log is 'settings.yml', but {folder}/settings.yml is a file: name a folder, or "
        "remove the file."
    ),
    f"{TRAIN} --device gpu": (
        "sb3-cure train: device is 'gpu', which PyTorch cannot use here: use 'auto', 'cpu', "
        "or 'cuda' on a machine with a GPU (settings: settings.yml, but device from --device)."
    ),
    f"{TRAIN} --seed one": "sb3-cure train: error: argument --seed: invalid int value: 'one'",
    **{
        f"{TRAIN} -i {path}": (
            f"sb3-cure train: -i/--trained-agent is '{path}', but it must be a .zip file that is there: give the path "
            "of a saved model, or leave it out."
        )
        for path in ("no.zip", "settings.yml")
    },
    **{
        f"{command} -n {number}": (
            f"sb3-cure {command.split()[0]}: -n/--n-timesteps is {number}, but it must be a number of agent steps of "
            "at least 1: give one, or leave it out."
        )
        for command, number in ((TRAIN, 0), (TRAIN, -7), (f"optimize --env {TASK}", 0), (f"enjoy --env {TASK}", 0))
    },
    f"optimize --env {TASK} --sampler auto": (
        "sb3-cure optimize: --sampler auto needs optunahub, which is not installed: pip install optunahub, or choose "
        "--sampler tpe."
    ),
    f"{TRAIN} --track": (
        "sb3-cure train: --track needs wandb, which is not installed: pip install wandb, or leave --track out."
    ),
    **{
        f"{command} settings.yml/new": (
            f"sb3-cure {command.split()[0]}: {command.split()[-1]} is 'settings.yml/new', but {{folder}}/settings.yml "
            "is a file: name a folder, or remove the file."
        )
        for command in (
            f"enjoy --env {TASK} --reward-log",
            f"optimize --env {TASK} --conf-file settings.yml --optimization-log-path",
        )
    },
    f"{TRAIN} -f settings.yml": (
        "sb3-cure train: --log-folder is 'settings.yml', but {folder}/settings.yml is a file: name a folder, or remove "
        "the file."
    ),
    f"{TRAIN} --gym-packages no_such_envs": (
        "sb3-cure train: --gym-packages names the module 'no_such_envs', which cannot be imported (No module named "
        "'no_such_envs'): name one of the working directory or an installed one."
    ),
    f"{TRAIN} --storage sqlite:///no.db --study-name mine --trial-id 3": (
        "sb3-cure train: --storage is 'sqlite:///no.db', but there is no such file: name one "
        "that `sb3-cure optimize` wrote."
    ),
    f"{TRAIN} --storage no.log --study-name mine --trial-id 3": (
        "sb3-cure train: --storage is 'no.log', but there is no such file: name one that `sb3-cure optimize` wrote."
    ),
    f"{TRAIN} --trial-id 3": "sb3-cure train: --trial-id is 3, but of no study: add --storage and --study-name.",
    f"{TRAIN} --storage study.log --study-name min --trial-id 0": (
        "sb3-cure train: --study-name is 'min', but --storage 'study.log' has the studies "
        "mine, yours: name one of them."
    ),
    f"{TRAIN} --storage study.log --study-name mine --trial-id 1": (
        "sb3-cure train: --trial-id is 1, but --study-name 'mine' has 1 trials, the first of "
        "which is 0: name one of them."
    ),
    f"{TRAIN} --storage study.log --study-name mine --trial-id 0": (
        "sb3-cure train: --trial-id 0 of --study-name 'mine' has no 'batch_size_pow': name a trial that was finished, "
        "of a study that was made with --algo cure_sac."
    ),
    f"{TRAIN} --storage no-study.log --study-name mine --trial-id 0": (
        "sb3-cure train: --trial-id 0 of --study-name 'mine' in --storage 'no-study.log' "
        "cannot be read (Expecting value: line 1 column 1 (char 0)): name a trial that is there."
    ),
    f"{TRAIN} -params curiosity_prb:0.5": (
        "sb3-cure train: -params has 'curiosity_prb', but CuReSAC has no such argument: write 'curiosity_prob'."
    ),
    f"{TRAIN} -params curiosity_prob:2 batch_size:8": (
        "sb3-cure train: curiosity_prob is 2 (progress remaining 1.00), but it is the "
        "probability p_c with which the curious actor acts: give a number, or a schedule, "
        "within [0, 1] (settings: settings.yml, but curiosity_prob from -params)."
    ),
    f"{TRAIN} -params n_envs:0": (
        "sb3-cure train: n_envs in -params is 0, but it must be a whole number of at least 1: change n_envs."
    ),
    f"{TRAIN} --env-kwargs imagesize:36": (
        "sb3-cure train: env_kwargs has 'imagesize', but PixelBox has no such argument: correct or remove it "
        "(settings: settings.yml, but env_kwargs from --env-kwargs)."
    ),
    "train --env dmc_pixels/finger-spin-v0 --conf-file settings.yml --env-kwargs image_sise:36": (
        "sb3-cure train: env_kwargs has 'image_sise', but make_dmc_env has no such argument: write 'image_size' "
        "(settings: settings.yml, but env_kwargs from --env-kwargs)."
    ),
    f"optimize --env {TASK} --conf-file settings.yml --storage nosql:///no --study-name mine": (
        "sb3-cure optimize: --storage is 'nosql:///no', which cannot be opened (Can't load "
        "plugin: sqlalchemy.dialects:nosql): give a database such as sqlite:///study.db."
    ),
    f"optimize --env {TASK} --conf-file settings.yml --storage settings.yml/new/study.log --study-name mine": (
        "sb3-cure optimize: the folder of --storage is 'settings.yml/new', but {folder}/settings.yml is a file: name a "
        "folder, or remove the file."
    ),
    f"optimize --env {TASK} --conf-file settings.yml --storage no-study.log --study-name mine": (
        "sb3-cure optimize: --storage is 'no-study.log', which cannot be opened (Expecting value: line 1 column 1 "
        "(char 0)): give a database such as sqlite:///study.db."
    ),
    f"enjoy --env {TASK} --no-render": (
        "sb3-cure enjoy: The logs/cure_sac folder was not found: give the run's --env, with "
        "-f the folder that it was trained into, and perhaps --exp-id."
    ),
    f"enjoy --env {TASK} --no-render -f nowhere --exp-id 4": (
        "sb3-cure enjoy: The nowhere/cure_sac/tests-PixelBox-v0_4 folder was not found: give "
        "the run's --env, with -f the folder that it was trained into, and perhaps --exp-id."
    ),
    f"record --env {TASK}": (
        "sb3-cure record: The logs/cure_sac folder was not found: give the run's --env, with "
        "-f the folder that it was trained into, and perhaps --exp-id."
    ),
    "doctor --fast": "sb3-cure doctor: error: unrecognized arguments: --fast",
    "report nowhere": ("sb3-cure report: nowhere is no folder: give the one that `sb3-cure experiment` wrote."),
    "report .": (
        "sb3-cure report: . holds no experiment (no grid.json in it, nor anywhere below it): "
        "give the folder that `sb3-cure experiment` wrote."
    ),
    "report . --thresholds many": (
        "sb3-cure report: error: argument --thresholds: 'many' is no list of returns such as 250,500,750"
    ),
    "train --env .cameras:No-v0 --conf-file settings.yml": (
        "sb3-cure train: --env names the module '.cameras', which cannot be imported (the 'package' argument is "
        "required to perform a relative import for '.cameras'): name one of the working directory or an installed one."
    ),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_command_lines(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    Path("no-study.log").write_text(yaml.safe_dump(SETTINGS))
    storage = JournalStorage(JournalFileBackend("study.log"))
    for name in ("mine", "yours"):
        optuna.create_study(study_name=name, storage=storage).ask()
    assert refusal(command, capsys) == COMMANDS[command].replace("{folder}", str(tmp_path))


def test_what_is_refused_by_the_first_step_leaves_no_run(capsys: pytest.CaptureFixture[str]) -> None:
    """A callback refuses when training begins: the checkpoints of another training are in its folder."""
    settings = copy.deepcopy(SETTINGS)
    checkpoint = {"sb3_cure.callbacks.ExactCheckpoint": {"save_freq": 10, "path": "checkpoints"}}
    settings["default"]["callback"] = [checkpoint]
    Path("settings.yml").write_text(yaml.safe_dump(settings))
    assert cli.main(TRAIN.split()) == 0
    said = refusal(TRAIN, capsys)
    assert said.startswith("sb3-cure train: checkpoints holds checkpoints of another training")
    assert said.endswith("(settings: settings.yml).")


class Breaks(PixelBox):
    """Its camera does, at the 30th step."""

    def observe(self, first: bool = False) -> np.ndarray:
        self.seen = getattr(self, "seen", 0) + 1
        if self.seen > 30:
            raise ValueError("the camera is broken")
        return super().observe(first)


class TellsSuccess(PixelBox):
    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], {"is_success": True}


def test_a_monitors_keywords_may_be_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    """YAML has no tuples, which SB3's Monitor asks for."""
    monkeypatch.setitem(gym.registry, TASK, EnvSpec(TASK, TellsSuccess, kwargs={"episode_length": 5}))
    settings = {**SETTINGS["default"], "monitor_kwargs": {"info_keywords": ["is_success"]}}
    Path("settings.yml").write_text(yaml.safe_dump({"default": settings}))
    assert cli.main(TRAIN.split()) == 0
    assert Path(f"{RUN}_1/0.monitor.csv").read_text().splitlines()[1] == "r,l,t,is_success"


def test_the_way_to_normalised_rewards_of_stacks_works() -> None:
    changes = {
        "env_kwargs": {"channels_last": True, "frame_stack": 1},
        "normalize": {"norm_obs": False},
        "vec_env_wrapper": yaml.safe_load(VEC_ENV_WRAPPER),
    }
    Path("settings.yml").write_text(yaml.safe_dump({"default": {**SETTINGS["default"], **changes}}))
    assert cli.main(TRAIN.split()) == 0
    assert CuReSAC.load(f"{RUN}_1/tests-PixelBox-v0.zip").observation_space.shape == (9, 36, 36)


@pytest.mark.filterwarnings("ignore:.*Monitor.*:UserWarning")
def test_a_run_that_breaks_later_keeps_its_checkpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one that goes on with a model that has seen more steps than it makes."""
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    assert cli.main([*TRAIN.split(), "-n", "60"]) == 0
    monkeypatch.setitem(gym.registry, TASK, EnvSpec(TASK, Breaks))
    with pytest.raises(ValueError, match="the camera is broken"):
        cli.main([*TRAIN.split(), "-n", "60", "-i", f"{RUN}_1/tests-PixelBox-v0.zip", "--save-freq", "10"])
    assert Path(f"{RUN}_2/rl_model_10_steps.zip").is_file()


def test_a_study_without_a_trial_that_was_finished(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end is told, as rl-zoo3 asks the study for the best trial."""
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))

    def interrupted(*args: Any, **kwargs: Any) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(zoo.ExperimentManager, "objective", interrupted)
    assert cli.main([*TRAIN.replace("train", "optimize", 1).split(), "--n-trials", "1"]) == 2
    assert "no trial was finished" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("storage", ["study.log", "sqlite:///study.db"])
def test_a_study_of_other_parameters(storage: str, capsys: pytest.CaptureFixture[str]) -> None:
    """As of another algorithm: Optuna says so in the middle of the first trial."""
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    opened = JournalStorage(JournalFileBackend(storage)) if storage.endswith(".log") else storage
    study = optuna.create_study(study_name="mine", storage=opened, direction="maximize")
    study.tell(study.ask({"learning_rate": optuna.distributions.FloatDistribution(1e-5, 1e-3)}), 1.0)
    flags = ["--n-trials", "1", "--storage", storage, "--study-name", "mine"]
    assert cli.main([*TRAIN.replace("train", "optimize", 1).split(), *flags]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        f"sb3-cure optimize: --study-name is 'mine', but this study in --storage '{storage}' was made with other "
        "parameters (Cannot set different log configuration to the same parameter name): choose a --study-name of its "
        "own."
    )


def test_the_length_of_the_file_can_be_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Its -1, and only that, is rl-zoo3's word for it."""
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    assert cli.main([*TRAIN.split(), "-n", "-1", "--save-freq", "20"]) == 0
    assert "Overwriting n_timesteps" not in capsys.readouterr().out
    assert Path(f"{RUN}_1/rl_model_20_steps.zip").is_file()


class Drawn(PixelBox):
    """It can be filmed, and hence be shown in a window."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, **kwargs: Any):
        super().__init__(**kwargs)
        self.render_mode = render_mode

    def render(self) -> Any:
        return self.background.transpose(1, 2, 0)


#: As if it were a class of the module ``my_heads``, which cannot be imported
Denoising = type("Denoising", (RAE,), {"__module__": "my_heads"})
RUN = "logs/cure_sac/tests-PixelBox-v0"
ENJOY = f"enjoy --env {TASK} --no-render"
OF_RUN = "give the run's --env, with -f the folder that it was trained into, and perhaps --exp-id."
#: command line -> the whole sentence; the run 1 is of that head, 2 was damaged, 3 is whole and has checkpoints, 4 is of
#: DMC and has many of these; the settings of 5 to 7 were damaged
MODELS: dict[str, str] = {
    f"{ENJOY} --exp-id 1": (
        f"sb3-cure enjoy: '{RUN}_1/tests-PixelBox-v0.zip' was saved with the head "
        "my_heads.Denoising, which no archive holds: add --srl my_heads.Denoising."
    ),
    f"record --env {TASK} --exp-id 1": (
        f"sb3-cure record: '{RUN}_1/tests-PixelBox-v0.zip' was saved with the head "
        "my_heads.Denoising, which no archive holds: add --srl my_heads.Denoising."
    ),
    f"{TRAIN} -i {RUN}_1/tests-PixelBox-v0.zip": (
        f"sb3-cure train: '{RUN}_1/tests-PixelBox-v0.zip' was saved with the head "
        "my_heads.Denoising, which no archive holds: add srl: my_heads.Denoising to the "
        "settings (settings: settings.yml)."
    ),
    f"{ENJOY} --srl my_head.Denoising": (
        "sb3-cure enjoy: --srl is 'my_head.Denoising', which cannot be imported (No module "
        "named 'my_head'): name a class as module.Class, in a module of the working "
        "directory or an installed one."
    ),
    f"record --env {TASK} --srl Denoising": (
        "sb3-cure record: --srl is 'Denoising', but it must be a head of your own as module.Class: write that, or "
        "leave --srl out for 'rae' and 'curl', which models are saved with."
    ),
    f"{ENJOY} --exp-id 3 --srl rae": (
        "sb3-cure enjoy: --srl is 'rae', but it must be a head of your own as module.Class: write that, or leave --srl "
        "out for 'rae' and 'curl', which models are saved with."
    ),
    f"record --env {TASK} --exp-id 3 -o settings.yml/new": (
        "sb3-cure record: --output-folder is 'settings.yml/new', but {folder}/settings.yml is a file: name a folder, "
        "or remove the file."
    ),
    f"{ENJOY} --exp-id 1 --load-best": (
        f"sb3-cure enjoy: there is no {RUN}_1/best_model.zip, but its run has the last model (without --load flags): "
        f"choose one of these, or {OF_RUN}"
    ),
    f"record --env {TASK} --exp-id 3 --load-checkpoint 151": (
        f"sb3-cure record: there is no {RUN}_3/rl_model_151_steps.zip, but its run has the last model (without --load "
        "flags) and the best one (--load-best) and checkpoints at 50, 100 (--load-checkpoint): choose one of these, or "
        f"{OF_RUN}"
    ),
    "enjoy --env dmc_pixels/finger-spin-v0 --no-render --exp-id 4 --load-best": (
        "sb3-cure enjoy: there is no logs/cure_sac/dmc_pixels-finger-spin-v0_4/best_model.zip, but its run has "
        "the last model (without --load flags) and checkpoints at 1, 2, 3, 4, ..., 8, 9, 10, 11 (--load-checkpoint): "
        f"choose one of these, or {OF_RUN}"
    ),
    f"{ENJOY} --exp-id 5 --load-last-checkpoint": (
        f"sb3-cure enjoy: there is no {RUN}_5/rl_model_*_steps.zip, but its run has the last model (without --load "
        f"flags): choose one of these, or {OF_RUN}"
    ),
    f"{ENJOY} --exp-id 8": f"sb3-cure enjoy: there is no {RUN}_8/tests-PixelBox-v0.zip: {OF_RUN}",
    f"{ENJOY} --exp-id 5": (
        f"sb3-cure enjoy: {RUN}_5/tests-PixelBox-v0/config.yml is no YAML (while parsing a flow node expected the node "
        f"content, but found '<stream end>' in \"{RUN}_5/tests-PixelBox-v0/config.yml\", line 1, column 2), but it "
        "must hold the settings of a run: restore it, or choose another with --exp-id."
    ),
    f"record --env {TASK} --exp-id 6": (
        f"sb3-cure record: {RUN}_6/tests-PixelBox-v0/config.yml is no YAML ('utf-8' codec can't decode byte 0xff in "
        "position 0: invalid start byte), but it must hold the settings of a run: restore it, or choose another with "
        "--exp-id."
    ),
    f"{ENJOY} --exp-id 7": (
        f"sb3-cure enjoy: {RUN}_7/tests-PixelBox-v0/config.yml holds None, but it must hold the settings of a run: "
        "restore it, or choose another with --exp-id."
    ),
    f"{ENJOY} --srl sb3_cure.srl.Denoising": (
        "sb3-cure enjoy: --srl is 'sb3_cure.srl.Denoising', which cannot be imported (module "
        "'sb3_cure.srl' has no attribute 'Denoising'): name a class as module.Class, in a "
        "module of the working directory or an installed one."
    ),
    f"{ENJOY} --exp-id 1 --srl os.path": (
        f"sb3-cure enjoy: '{RUN}_1/tests-PixelBox-v0.zip' cannot be loaded: srl is <module "
        "'posixpath' (frozen)>, but it must be one of 'rae', 'curl', None, or a subclass of "
        "sb3_cure.srl.SRLHead (the class itself, not an instance)."
    ),
    f"{ENJOY} --exp-id 2": (
        f"sb3-cure enjoy: '{RUN}_2/tests-PixelBox-v0.zip' is no zip file, or the end of it "
        "is missing: it was not written by this package, or was damaged since."
    ),
    f"record --env {TASK} --exp-id 2": (
        f"sb3-cure record: '{RUN}_2/tests-PixelBox-v0.zip' is no zip file, or the end of it "
        "is missing: it was not written by this package, or was damaged since."
    ),
    f"record --env {TASK} --exp-id 3 --env-kwargs size:40": (
        f"sb3-cure record: '{RUN}_3/tests-PixelBox-v0.zip' was trained with the observations "
        "Box(0, 255, (6, 36, 36), uint8), but the environment has Box(0, 255, (6, 40, 40), "
        "uint8): make it as for that training (images: the same image_size, grayscale, "
        "frame_stack), or train anew."
    ),
    f"{ENJOY} --exp-id 3 --env-kwargs size:40": (
        "sb3-cure enjoy: the model was trained with the observations Box(0, 255, (6, 36, 36), uint8), but the "
        "environment has others ((1, 6, 40, 40)): correct --env-kwargs (images: the same image_size, grayscale, "
        "frame_stack)."
    ),
    f"{TRAIN} -i {RUN}_3/tests-PixelBox-v0.zip --env-kwargs frame_stack:1": (
        f"sb3-cure train: '{RUN}_3/tests-PixelBox-v0.zip' was trained with the observations "
        "Box(0, 255, (6, 36, 36), uint8), but the environment has Box(0, 255, (3, 36, 36), "
        "uint8): make it as for that training (images: the same image_size, grayscale, "
        "frame_stack), or train anew (settings: settings.yml, but env_kwargs from "
        "--env-kwargs)."
    ),
    f"record --env {TASK} --exp-id 3 --env-kwargs imagesize:36": (
        "sb3-cure record: env_kwargs has 'imagesize', but Drawn has no such argument: correct or remove it in "
        "--env-kwargs."
    ),
    "enjoy --env dmc_pixels/finger-spin-v0 --no-render --exp-id 4 --env-kwargs image_size:-1": (
        "sb3-cure enjoy: image_size=-1 is not an integer of at least 1; use image_size=84, "
        "for example: correct --env-kwargs."
    ),
    f"{TRAIN} --env-kwargs render_mode:'human'": (
        'sb3-cure train: pygame is not installed, run `pip install "gymnasium[classic-control]"`, '
        "or, to open no window, leave render_mode='human' out."
    ),
    f"{ENJOY} --exp-id 3 --env-kwargs render_mode:'human'": (
        'sb3-cure enjoy: pygame is not installed, run `pip install "gymnasium[classic-control]"`, '
        "or, to open no window, leave render_mode='human' out."
    ),
    f"enjoy --env {TASK} --exp-id 3": (
        'sb3-cure enjoy: pygame is not installed, run `pip install "gymnasium[classic-control]"`, '
        "or, to open no window, add --no-render."
    ),
}


@pytest.mark.filterwarnings("ignore:.*HumanRendering.*:UserWarning")
@pytest.mark.parametrize("command", MODELS)
def test_models(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Those that are loaded, and the windows that show them."""
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    for number, head in enumerate((Denoising, RAE, RAE), 1):
        Path(f"{RUN}_{number}").mkdir(parents=True)
        tiny_model("CnnPolicy", PixelBox(), srl=head, buffer_size=50).save(f"{RUN}_{number}/tests-PixelBox-v0")
    other = Path("logs/cure_sac/dmc_pixels-finger-spin-v0_4/dmc_pixels-finger-spin-v0.zip")
    other.parent.mkdir()
    other.touch()
    for name in ("best_model", "rl_model_100_steps", "rl_model_50_steps"):
        Path(f"{RUN}_3/{name}.zip").touch()
    for steps in range(1, 12):
        (other.parent / f"rl_model_{steps}_steps.zip").touch()
    for number, text in enumerate((b"{", b"\xff", b""), 5):
        Path(f"{RUN}_{number}/tests-PixelBox-v0").mkdir(parents=True)
        Path(f"{RUN}_{number}/tests-PixelBox-v0.zip").touch()
        Path(f"{RUN}_{number}/tests-PixelBox-v0/config.yml").write_bytes(text)
    Path(f"{RUN}_8").mkdir()
    damaged = Path(f"{RUN}_2/tests-PixelBox-v0.zip")
    damaged.write_bytes(damaged.read_bytes()[:3000])
    gym.registry[TASK] = EnvSpec(TASK, Drawn)
    monkeypatch.setitem(sys.modules, "pygame", None)  # as if it were not installed
    monkeypatch.setenv("DISPLAY", ":0")
    assert refusal(command, capsys) == MODELS[command].replace("{folder}", str(tmp_path))
