"""Grids and command lines of experiments that cannot work: one sentence, and nothing left behind."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import yaml
from envs_for_tests import PixelBox
from test_bad_input import files_in, is_one_sentence

from sb3_cure.cli.main import main

TASK = "tests/PixelBox-v0"
SETTINGS: dict[str, Any] = {
    "default": {
        "policy": "CnnPolicy",
        "n_timesteps": 20,
        "buffer_size": 50,
        "policy_kwargs": {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2, "n_layers": 2}},
    }
}
GRID: dict[str, Any] = {
    "experiment": "tiny",
    "kind": "curves",
    "budget": 40,
    "tasks": [TASK],
    "methods": {"cure": {"config": "settings.yml"}},
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
        status = main(command.split())
    except SystemExit as stop:  # as argparse does
        status = stop.code if isinstance(stop.code, int) else 1
    usage_and_sentence = capsys.readouterr().err
    assert status in (1, 2) and files_in(Path.cwd()) == before
    assert "Traceback" not in usage_and_sentence
    said = usage_and_sentence.splitlines()[-1]
    assert is_one_sentence(said)
    return said


#: command line -> the whole sentence
COMMANDS: dict[str, str] = {
    "report nowhere": ("sb3-cure report: nowhere is no folder: give the one that `sb3-cure experiment` wrote."),
    "report .": (
        "sb3-cure report: . holds no experiment (no grid.json in it, nor anywhere below it): "
        "give the folder that `sb3-cure experiment` wrote."
    ),
    "report . --thresholds many": (
        "sb3-cure report: error: argument --thresholds: 'many' is no list of returns such as 250,500,750"
    ),
    "experiment no.yml": (
        "sb3-cure experiment: error: no.yml cannot be read (No such file or directory): give the path of a YAML file."
    ),
    "experiment .": ("sb3-cure experiment: error: . cannot be read (Is a directory): give the path of a YAML file."),
    "experiment settings.yml": (
        "sb3-cure experiment: error: 'default' in settings.yml is unknown, but the keys are "
        "baseline, budget, evaluation, experiment, kind, methods, seeds, tasks: correct it."
    ),
    "experiment grid.yml --tasks finger": (
        "sb3-cure experiment: error: task 'finger' is not in grid.yml, which has PixelBox, "
        "tests/PixelBox-v0: choose among these."
    ),
    "experiment grid.yml --methods none": (
        "sb3-cure experiment: error: method 'none' is not in grid.yml, which has cure: choose among these."
    ),
    "experiment grid.yml --budget 10m": (
        "sb3-cure experiment: error: argument --budget: '10m' is no number of steps: write "
        "for example 100000, 100k or 1M"
    ),
    "experiment grid.yml --seeds x": (
        "sb3-cure experiment: error: argument --seeds: 'x' names no seeds: write how many (5), or which (0,3,4)"
    ),
    "experiment grid.yml --seeds 0": (
        "sb3-cure experiment: error: --seeds is 0, but it must be how many (1 or more) or "
        "which, each from 0 to 2**31 - 1: change it."
    ),
    "experiment grid.yml --retries 1": "sb3-cure experiment: error: --retries is of Ray: add --engine ray.",
    "experiment grid.yml --engine ray --cpus-per-cell -1": (
        "sb3-cure experiment: error: --cpus-per-cell is -1.0, but it must be a number of at least 0: change it."
    ),
    "experiment grid.yml --engine ray --retries -3": (
        "sb3-cure experiment: error: --retries is -3, but it must be at least 0, or -1 for no limit: change it."
    ),
    "experiment grid.yml --checkpoint-minutes nan": (
        "sb3-cure experiment: error: --checkpoint-minutes is nan, but it must be a number of at least 0: change it."
    ),
    "experiment grid.yml --out grid.yml": (
        "sb3-cure experiment: error: --out is '{folder}/grid.yml', but {folder}/grid.yml is a file: name a folder, or "
        "remove the file."
    ),
    "experiment grid.yml --dry-run --out grid.yml/results": (
        "sb3-cure experiment: error: --out is 'grid.yml/results', but {folder}/grid.yml is a file: name a folder, or "
        "remove the file."
    ),
    "experiment grid.yml --engine ray --gpus-per-cell 1.5": (
        "sb3-cure experiment: error: --gpus-per-cell is 1.5, but Ray shares one card only: give 1 or less, or a whole "
        "number."
    ),
    "experiment grid.yml --out grid.yml/results": (
        "sb3-cure experiment: error: --out is '{folder}/grid.yml/results', but "
        "{folder}/grid.yml is a file: name a folder, or remove the file."
    ),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_command_lines(command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    Path("grid.yml").write_text(yaml.safe_dump(GRID))
    assert refusal(command, capsys) == COMMANDS[command].replace("{folder}", str(tmp_path))


def arm(**method: Any) -> dict[str, Any]:
    return {"methods": {"a": {"config": "settings.yml", **method}}}


#: what is wrong -> (what differs in the grid, the whole sentence)
GRIDS: dict[str, tuple[dict[str, Any], str]] = {
    "kind": (
        {"kind": ["curves"]},
        "sb3-cure experiment: error: kind in grid.yml is ['curves'], but it must be one of "
        "curves, visitation, pretraining: change it.",
    ),
    "experiment": (
        {"experiment": "../elsewhere"},
        "sb3-cure experiment: error: experiment in grid.yml is '../elsewhere', but it names "
        "a folder: use letters, digits, '-', '_' and '.' only.",
    ),
    "budget in words": (
        {"budget": "100k"},
        "sb3-cure experiment: error: budget in grid.yml is '100k', but it must be a whole "
        "number, 0 or more: change it.",
    ),
    "a key": (
        {"budgets": 3},
        "sb3-cure experiment: error: 'budgets' in grid.yml is unknown, but the keys are "
        "baseline, budget, evaluation, experiment, kind, methods, seeds, tasks: correct it.",
    ),
    "no seeds": (
        {"seeds": 0},
        "sb3-cure experiment: error: seeds in grid.yml is 0, but it must be how many (1 or more) or "
        "which, each from 0 to 2**31 - 1: change it.",
    ),
    "a negative seed": (
        {"seeds": [1, -2]},
        "sb3-cure experiment: error: seeds in grid.yml is [1, -2], but it must be how many "
        "(1 or more) or which, each from 0 to 2**31 - 1: change it.",
    ),
    "a seed that is too large": (
        {"seeds": [2**31]},
        "sb3-cure experiment: error: seeds in grid.yml is [2147483648], but it must be how "
        "many (1 or more) or which, each from 0 to 2**31 - 1: change it.",
    ),
    "no list of tasks": (
        {"tasks": "all"},
        "sb3-cure experiment: error: tasks in grid.yml is 'all', but it must be a list of Gymnasium ids: write some.",
    ),
    "an unknown task": (
        {"tasks": ["dmc_pixels/cartpole-swing-v0"]},
        "sb3-cure experiment: error: task 'dmc_pixels/cartpole-swing-v0' in grid.yml is not "
        "registered with Gymnasium: correct it (sb3_cure registers "
        "dmc_pixels/<domain>-<task>-v0; one of your own is my_module:My-v0, with the module that registers it).",
    ),
    "a list of methods": (
        {"methods": ["a"]},
        "sb3-cure experiment: error: methods in grid.yml is ['a'], but it must be a mapping (key: value): change it.",
    ),
    "two tasks of one name": (
        {"tasks": ["CartPole-v0", "CartPole-v1"]},
        "sb3-cure experiment: error: tasks in grid.yml has both 'CartPole-v0' and 'CartPole-v1', whose results would "
        "share the folder 'CartPole': write a grid for each, with another name of the experiment.",
    ),
    "no methods": (
        {"methods": {}},
        "sb3-cure experiment: error: methods in grid.yml are none, but a grid compares at least one: name some.",
    ),
    "a method that is no folder": (
        {"methods": {"a/b": {"config": "settings.yml"}}},
        "sb3-cure experiment: error: a method in grid.yml is 'a/b', but it names a folder: "
        "use letters, digits, '-', '_' and '.' only.",
    ),
    "a file that is missing": (
        {"methods": {"a": {"config": "no.yml"}}},
        "sb3-cure experiment: error: no.yml cannot be read (No such file or directory): give the path of a YAML file.",
    ),
    "no file": (
        {"methods": {"a": {}}},
        "sb3-cure experiment: error: methods.a in grid.yml has no 'config', which it needs: add it.",
    ),
    "a key of a method": (
        arm(override={}),
        "sb3-cure experiment: error: 'override' in methods.a in grid.yml is unknown, but the "
        "keys are baseline, config, overrides, pretrain, train: correct it.",
    ),
    "an argument": (
        arm(overrides={"prob": 1}),
        "sb3-cure experiment: error: 'prob' in settings.yml or the overrides of methods.a in "
        "grid.yml is no argument of CuReSAC: correct or remove it (grids know n_envs and "
        "env_kwargs besides, but no other key of rl-zoo).",
    ),
    "a list of overrides": (
        arm(overrides=[1]),
        "sb3-cure experiment: error: overrides in grid.yml is [1], but it must be a mapping (key: value): change it.",
    ),
    "an argument that is a text": (
        arm(overrides={"policy_kwargs": "dict(net_arch=[1])"}),
        "sb3-cure experiment: error: policy_kwargs in settings.yml is 'dict(net_arch=[1])', "
        "but grids evaluate no strings: write a YAML mapping.",
    ),
    "a number as text": (
        arm(overrides={"batch_size": "8"}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: batch_size "
        "is '8', but it must be a whole number of at least 1: change batch_size.",
    ),
    "a policy for other observations": (
        arm(overrides={"policy": "MlpPolicy"}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: 'MlpPolicy' got "
        "images of shape (6, 36, 36), but it reads vectors: use 'CnnPolicy'.",
    ),
    "more layers than the images have pixels for": (
        arm(overrides={"policy_kwargs": {"features_extractor_kwargs": {"n_layers": 12, "n_filters": 2}}}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: observations of 36x36 pixels are too "
        "small for 12 convolutions of 3x3 (the first with stride 2), which need at least 47x47: use a larger "
        "image_size, or fewer layers through policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=...)).",
    ),
    "a crop that is larger than the images": (
        arm(overrides={"srl": "curl", "srl_kwargs": {"augmentation": "crop", "crop_size": 84}}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: srl_kwargs got augmentation='crop' "
        "with crop_size=84 for observations of 36 pixels, but crops must have at least 1 pixel and be smaller than the "
        "observation: render larger (CURL: image_size=100), set another crop_size, or use augmentation='shift'.",
    ),
    "neither training nor pretraining": (
        arm(train=False),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: it neither trains nor pretrains: add "
        "pretrain, or give a budget of at least 1 without train: false.",
    ),
    "pretraining without a head": (
        arm(
            pretrain={"collector": "random", "budget": 8},
            overrides={"srl": None, "curiosity": None, "warmup_updates": None},
        ),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: it pretrains the representation, but "
        "srl is None: choose srl: rae, curl or a head of your own, or remove pretrain.",
    ),
    "observations that common heads cannot judge alike": (
        {
            "kind": "visitation",
            "methods": {
                name: {"config": "settings.yml", "overrides": {"env_kwargs": {"frame_stack": frames}}}
                for name, frames in (("a", 2), ("b", 3))
            },
        },
        "sb3-cure experiment: error: methods 'a' and 'b' see tests/PixelBox-v0 in observations of shape (6, 36, 36) "
        "and (9, 36, 36), but common heads judge all methods alike: give them the same env_kwargs, or write a grid "
        "for each.",
    ),
    "an unknown head": (
        arm(overrides={"srl": "vae"}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: srl is "
        "'vae', but it must be one of 'rae', 'curl', None, or a subclass of "
        "sb3_cure.srl.SRLHead (the class itself, not an instance).",
    ),
    "a head of no module": (
        arm(overrides={"srl": "no_such_heads.Mine"}),
        "sb3-cure experiment: error: srl of methods.a in grid.yml is 'no_such_heads.Mine', "
        "which cannot be imported (No module named 'no_such_heads'): name a class as "
        "module.Class, in a module of the working directory or an installed one.",
    ),
    "a misspelt argument of the head": (
        arm(overrides={"srl_kwargs": {"pd": 1}}),
        "sb3-cure experiment: error: method 'a' on tests/PixelBox-v0 cannot work: srl_kwargs "
        "has 'pd', but RAE has no such argument: write 'pad'.",
    ),
    "an argument that the environment does not take": (
        arm(overrides={"env_kwargs": {"imagesize": 36}}),
        "sb3-cure experiment: error: env_kwargs of tests/PixelBox-v0 are {'imagesize': 36}, "
        "which it does not take (VectorBox.__init__() got an unexpected keyword argument "
        "'imagesize' was raised from the environment creator for tests/PixelBox-v0 with "
        "kwargs ({'imagesize': 36})): correct them.",
    ),
    "a collector": (
        arm(pretrain={"collector": "task", "budget": 8}),
        "sb3-cure experiment: error: pretrain.collector of methods.a in grid.yml is 'task', "
        "but it must be 'curious' or 'random': choose one of them.",
    ),
    "no pretraining": (
        arm(pretrain={"collector": "random", "budget": 0}),
        "sb3-cure experiment: error: pretrain.budget in grid.yml is 0, but it must be a "
        "whole number, 1 or more: change it.",
    ),
    "train": (
        arm(train="yes"),
        "sb3-cure experiment: error: train of methods.a in grid.yml is 'yes', but it must be true or false: change it.",
    ),
    "baseline": (
        {"baseline": ["cure"]},
        "sb3-cure experiment: error: baseline in grid.yml is ['cure'], but the methods are cure: name one of them.",
    ),
    "a method's baseline": (
        arm(baseline="a"),
        "sb3-cure experiment: error: baseline of methods.a in grid.yml is 'a', but a method is compared with another "
        "one (there is none): name one, or remove it.",
    ),
    "evaluation": (
        {"evaluation": {"every": 0}},
        "sb3-cure experiment: error: evaluation.every in grid.yml is 0, but it must be a "
        "whole number, 1 or more: change it.",
    ),
}


@pytest.mark.parametrize("name", GRIDS)
def test_grids(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """``sb3-cure experiment``: before the first cell of any arm is begun."""
    changes, sentence = GRIDS[name]
    Path("settings.yml").write_text(yaml.safe_dump(SETTINGS))
    Path("grid.yml").write_text(yaml.safe_dump({**GRID, **changes}))
    assert refusal("experiment grid.yml", capsys) == sentence
