"""The YAML files hold the paper's settings, or the demo's, and rl-zoo3 trains from each of them."""

import copy
import inspect
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from envs_for_tests import PixelBox

from sb3_cure import CuReSAC
from sb3_cure.cli import zoo
from sb3_cure.cli.main import main
from sb3_cure.experiments.grid import load_grid

FOLDER = Path(__file__).parents[2] / "zoo_configs"
METHODS = {
    "sac_ae": {"srl": "rae", "curiosity": None},
    "curl": {"srl": "curl", "curiosity": None},
    "vae": {"srl": "vae", "curiosity": None},
    "spr": {"srl": "spr", "curiosity": None},
    "drq_single_view": {"srl": None, "curiosity": None},
    "cure_sac_ae": {"srl": "rae", "curiosity": "separate"},
    "cure_curl": {"srl": "curl", "curiosity": "separate"},
    **{
        name: {"srl": "rae", "curiosity": "separate", "intrinsic": name}
        for name in ("rnd", "icm", "disagreement", "particle")
    },
}
# Task: action repeat
SIX_TASKS = {
    "dmc_pixels/cartpole-swingup-v0": 8,
    "dmc_pixels/finger-spin-v0": 2,
    "dmc_pixels/finger-turn_easy-v0": 2,
    "dmc_pixels/reacher-easy-v0": 4,
    "dmc_pixels/reacher-hard-v0": 4,
    "dmc_pixels/ball_in_cup-catch-v0": 4,
}
# A task that no file names
ANY_OTHER = "dmc_pixels/cheetah-run-v0"
# What a file says nothing of
CURE_DEFAULTS = {name: each.default for name, each in inspect.signature(CuReSAC).parameters.items()}
# Networks of the files' own sizes take a second to initialise.
SMALL = {"net_arch": [16], "features_extractor_kwargs": {"n_filters": 4}}


class Dots(PixelBox):
    """Images that are not as those of DeepMind Control."""

    def __init__(self, **kwargs: Any):
        super().__init__(frame_stack=1, size=52, channels_last=True, tells_frame_stack=False, **kwargs)


def entries(folder: Path) -> list[tuple[str, str]]:
    """Method and task of every entry for DeepMind Control of the files in a folder, and a task that has none."""
    found = [(path.stem, name) for path in sorted(folder.glob("*.yml")) for name in yaml.safe_load(path.read_text())]
    methods = sorted({method for method, _ in found})
    return [*(each for each in found if "/" in each[1]), *((method, ANY_OTHER) for method in methods)]


def entry_of(path: Path, task: str) -> dict[str, Any]:
    """What the file says about a task."""
    content = yaml.safe_load(path.read_text())
    return content.get(task, content.get("dmc_pixels", content["default"]))


def set_up(
    config: Path, task: str, log_folder: Path, algorithm: str = "cure_sac", **changes: Any
) -> tuple[CuReSAC, zoo.ExperimentManager]:
    """The model and the manager of a training from this file, as ``sb3-cure train`` makes them."""
    zoo.register()
    changes = copy.deepcopy(changes)  # SB3 adds to policy_kwargs
    arguments = type("Arguments", (), {"gym_packages": []})()
    n_timesteps = changes.pop("n_timesteps", 0)
    manager = zoo.ExperimentManager(
        arguments, algorithm, task, str(log_folder), n_timesteps=n_timesteps, config=str(config),
        hyperparams=changes, eval_freq=-1, log_interval=-1, device="cpu", verbose=0,
    )  # fmt: skip
    model, _ = manager.setup_experiment()  # type: ignore[misc]
    return model, manager  # type: ignore[return-value]


#: What tells that something was learned: with a head, without one
LOSS_OF = ("train/srl_loss", "train/critic_loss")
TRAINED += [(algorithm, "cure_sac_ae.yml") for algorithm in zoo.ALGORITHMS if algorithm != "cure_sac"]


@pytest.mark.parametrize("method", METHODS)
def test_each_fast_file_trains_from_the_command_line(
    method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By its name and with its own networks, as users type it; the log shows the burst and the updates after it."""
    small = ["learning_starts:100", "warmup_updates:20", "batch_size:16"]
    arguments = ["train", "--env", "dmc_pixels/cartpole-swingup-v0", "--conf-file", f"fast/{method}"]
    arguments += ["-n", "300", "-params", *small, "--eval-freq", "-1", "--log-interval", "1", "-f", str(tmp_path)]
    assert main([*arguments, "--device", "cpu"]) == 0
    printed = re.findall(r"n_updates +\| (\d+)", capfd.readouterr().out)
    assert int(printed[-1]) == 20 + 149  # up to the last step of two episodes of 125


def test_grids_read_the_entry_of_the_namespace() -> None:
    """As ``train`` does: a task without an entry of its own has that of ``dmc_pixels``, not the default."""
    cells = load_grid(FOLDER / "experiments" / "fast" / "visitation.yml", tasks=["reacher-easy"], seeds=1).cells
    assert [cell.env_kwargs for cell in cells] == [{"image_size": 48, "renderer": "fast"}] * 4
