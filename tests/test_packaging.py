"""The wheel alone, in an empty environment and an empty folder, trains from the settings that it holds."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.version import Version
from stable_baselines3.common.envs import FakeImageEnv

from sb3_cure import CuReSAC, __version__, recipe
from sb3_cure.cli.usage import UsageError
from sb3_cure.cli.zoo_files import GRIDS, ZOO, zoo_file
from sb3_cure.srl import VAE

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The source archive, of a copy of what it is made from, and the wheel made from it."""
    project = tmp_path_factory.mktemp("project")
    for folder in ("sb3_cure", "zoo_configs"):
        shutil.copytree(ROOT / folder, project / folder, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, project)
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", "dist"], project)
    return project / f"dist/sb3_cure-{__version__}.tar.gz", project / f"dist/sb3_cure-{__version__}-py3-none-any.whl"


def run(command: list, folder: Path) -> str:
    """What it prints, in a folder and without the path of modules of these tests."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=environment, timeout=300,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


def test_wheel_and_source_archive_hold_all_files(archives: tuple[Path, Path]) -> None:
    """Every module, template and YAML file."""
    with tarfile.open(archives[0]) as source, zipfile.ZipFile(archives[1]) as wheel:
        in_source = {name.partition("/")[2] for name in source.getnames()}
        in_wheel = {name for name in wheel.namelist() if "dist-info" not in name}
    files = [path for path in (ROOT / "sb3_cure").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    files += ZOO.rglob("*.yml")
    assert in_wheel == {path.relative_to(ROOT).as_posix() for path in files}
    assert in_wheel | {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md"} <= in_source
    assert not any(name.startswith("tests") for name in in_source)


def test_wheel_trains_by_the_name_of_its_settings(archives: tuple[Path, Path], tmp_path: Path) -> None:
    """In an environment of its own, which sees the dependencies of this one, but not the package installed there."""
    venv.create(tmp_path / "venv", symlinks=True)
    python = tmp_path / "venv" / "bin" / "python"
    installed = Path(run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], tmp_path).strip())
    run([sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", archives[1]], tmp_path)
    # A folder that a .pth file names is searched, but its own .pth files, such as the checkout's, are not read.
    (installed / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    empty = tmp_path / "empty"
    empty.mkdir()
    small = ["learning_starts:100", "warmup_updates:2", "batch_size:16"]
    train = ["train", "--env", "dmc_pixels/cartpole-swingup-v0", "--conf-file", "fast/cure_sac_ae", "-n", "150"]
    train += ["-params", *small, "--eval-freq", "-1", "--log-interval", "1", "--device", "cpu"]
    printed = run([python.with_name("sb3-cure"), *train], empty)
    assert f"Loading hyperparameters from: {installed / 'sb3_cure/zoo_configs/fast/cure_sac_ae.yml'}" in printed
    assert re.findall(r"n_updates +\| (\d+)", printed) == ["26"]  # the burst, and up to the end of an episode of 125
    (model,) = empty.rglob("*.zip")
    assert model.name == "dmc_pixels-cartpole-swingup-v0.zip"


def test_files_are_found_by_name_or_path(tmp_path: Path) -> None:
    for folder, name in ((ZOO, "sac_ae"), (ZOO, "fast/sac_ae"), (GRIDS, "curves"), (GRIDS, "fast/curves")):
        assert zoo_file(name, folder) == folder / f"{name}.yml"
        assert zoo_file(name, folder).is_file()
    assert zoo_file("mine/sac_ae.yml") == Path("mine/sac_ae.yml")
    with pytest.raises(ValueError, match=r"^'fast/sac' is neither .*; did you mean fast/sac_ae"):
        zoo_file("fast/sac")
    with pytest.raises(ValueError, match=r"; did you mean .*curves_curl"):
        zoo_file("curve_curl", GRIDS)


def test_recipe_gives_the_model_what_the_zoo_file_says(tmp_path: Path) -> None:
    own = tmp_path / "mine.yml"
    entry = {"n_timesteps": 9, "policy": "CnnPolicy", "n_envs": 4, "env_kwargs": {"image_size": 48}, "srl": None}
    own.write_text(yaml.safe_dump({"default": {**entry, "gamma": 0.9}, "dmc_pixels": {**entry, "gamma": 0.8}}))
    assert recipe(own) == {"srl": None, "gamma": 0.9}
    assert recipe(own, "dmc_pixels/walker-walk-v0") == {"srl": None, "gamma": 0.8}
    assert recipe(own, gamma=0.7, task=False) == {"srl": None, "gamma": 0.7, "task": False}
    zoo = {"srl": "sb3_cure.srl.VAE", "train_freq": [1, "episode"], "frame_stack": 3, "normalize": True}
    own.write_text(yaml.safe_dump({"default": zoo}))
    assert recipe(own) == {"srl": VAE, "train_freq": (1, "episode")}
    own.write_text("default: {srl_kwargs: {bits: 8}}")
    assert recipe(own, srl="rae") == {"srl": "rae", "srl_kwargs": {"bits": 8}}, "the default head, named"
    assert recipe(own, srl="vae") == {"srl": "vae"}
    own.write_text("default: {learning_rate: lin_1e-3, curiosity_prob: lin_0.5, srl: null}")
    falling = CuReSAC(
        "CnnPolicy", FakeImageEnv(screen_height=32, screen_width=32, discrete=False), **recipe(own, buffer_size=10)
    )
    assert (falling.lr_schedule(0.5), falling.curiosity_prob(0.5)) == (5e-4, 0.25)
    own.write_text("default: {policy_kwargs: 'dict(net_arch=[8])'}")
    with pytest.raises(UsageError, match=r"policy_kwargs is the text 'dict\(net_arch=\[8\]\)': write a mapping"):
        recipe(own)
    env = FakeImageEnv(n_channels=3, screen_height=32, screen_width=32, discrete=False, channel_first=True)
    for augmentation in (None, "crop"):  # which does not take the ``pad`` of the file's shift
        CuReSAC("CnnPolicy", env, **recipe("fast/drq_single_view", buffer_size=10, augmentation=augmentation))
    model = CuReSAC("CnnPolicy", env, **recipe("fast/drq_single_view", buffer_size=10))
    assert (model.srl, model.curiosity, model.gamma) == (None, None, 0.98)
    with pytest.raises(ValueError, match=r"did you mean fast/curl"):
        recipe("fast/crul")


def test_changelog_and_citation_name_the_version() -> None:
    """The last one that was released; what has changed since is of the next one."""
    released = re.search(r"^## \[(.*)\] - (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert released and released.groups() == (citation["version"], citation["date-released"])
    has_changed = "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text()
    now, then = Version(__version__), Version(citation["version"])
    assert now.is_prerelease and now > then if has_changed else now == then
