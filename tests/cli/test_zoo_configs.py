"""rl-zoo3 trains from each of the package's YAML files, and grids read their entries."""

import re
from pathlib import Path

import gymnasium as gym
import pytest
import yaml

from sb3_cure import recipe
from sb3_cure.cli.main import main
from sb3_cure.experiments.grid import load_grid

FOLDER = Path(__file__).parents[2] / "zoo_configs"
TASK = "dmc_pixels/cartpole-swingup-v0"
METHODS = sorted(path.stem for path in FOLDER.glob("*.yml"))
# Networks of the files' own sizes take a second to initialise.
SMALL = "policy_kwargs:dict(net_arch=[16],features_extractor_kwargs=dict(n_filters=4))"


def train(file: str, folder: Path, capfd: pytest.CaptureFixture[str], *settings: str, algo: str = "cure_sac") -> int:
    """Train for an episode of 30 steps, the first 20 random, and return the number of updates that is logged at last.

    Frames are those of the fast renderer: the other one would take half of the time.
    """
    env_kwargs = yaml.safe_load((FOLDER / f"{file}.yml").read_text())[TASK].get("env_kwargs", {})
    env = f"env_kwargs:dict({env_kwargs}, renderer='fast', max_episode_steps=30)"
    flags = ["--eval-freq", "-1", "--log-interval", "1", "--device", "cpu", "-n", "35", "-f", str(folder)]
    params = ["-params", "learning_starts:20", "warmup_updates:5", "batch_size:4", "buffer_size:200", env, *settings]
    assert main(["train", "--algo", algo, "--env", TASK, "--conf-file", file, *flags, *params]) == 0
    return int(re.findall(r"n_updates +\| (\d+)", capfd.readouterr().out)[-1])


@pytest.mark.parametrize("method", METHODS)
def test_each_fast_file_trains(method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """With its own networks; the log shows the burst and the updates after it."""
    file = f"fast/{method}"
    assert train(file, tmp_path, capfd) == 5 + 9 // recipe(file).get("train_freq", 1)


@pytest.mark.parametrize(("algo", "method"), [*(("cure_sac", method) for method in METHODS), ("cure_tqc", "cure_curl")])
def test_each_file_trains(algo: str, method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert train(method, tmp_path, capfd, SMALL, algo=algo) == 5 + 9 // recipe(method).get("train_freq", 1)


def test_tasks_of_all_files_are_registered() -> None:
    for path in (*FOLDER.glob("*.yml"), *FOLDER.glob("fast/*.yml")):
        tasks = {name for name in yaml.safe_load(path.read_text()) if "/" in name}
        assert tasks <= gym.registry.keys()


def test_grids_read_the_entry_of_the_namespace() -> None:
    """As ``train`` does: a task without an entry of its own has that of ``dmc_pixels``, not the default."""
    cells = load_grid(FOLDER / "experiments" / "fast" / "visitation.yml", tasks=["reacher-easy"], seeds=1).cells
    assert [cell.env_kwargs for cell in cells] == [{"image_size": 48, "renderer": "fast"}] * 4
