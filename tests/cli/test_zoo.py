"""Training, tuning, watching and filming from a YAML file, with rl-zoo3."""

import copy
import pickle
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from envs_for_tests import PixelBox, VectorBox, tiny_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure import CuReSAC
from sb3_cure.cli import enjoy, zoo
from sb3_cure.cli.main import main
from sb3_cure.srl import RAE

TASK = "tests/Filmed-v0"
RUN = "tests-Filmed-v0"
SETTINGS: dict[str, Any] = {
    "policy": "CnnPolicy",
    "n_timesteps": 20,
    "buffer_size": 50,
    "learning_starts": 10,
    "warmup_updates": 1,
    "batch_size": 4,
    "env_kwargs": {"episode_length": 7},
    "policy_kwargs": {"net_arch": [8], "features_extractor_kwargs": {"n_filters": 2, "n_layers": 2}},
}
#: A module of the user's own, in the working directory
CAMERA = """
import gymnasium as gym
from envs_for_tests import PixelBox
from stable_baselines3.common.buffers import ReplayBuffer
from sb3_cure.srl import RAE

class Head(RAE):
    pass

class Buffer(ReplayBuffer):
    pass

gym.register("Camera-v0", PixelBox, kwargs={"channels_last": True})
"""


class Filmed(PixelBox):
    """It can be filmed, and hence be shown in a window."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None, **kwargs: Any):
        super().__init__(**kwargs)
        self.render_mode = render_mode

    def render(self) -> Any:
        return self.frames[-1].transpose(1, 2, 0)


class Gentle(RAE):
    """A head of the user's own."""


class Buffer(ReplayBuffer):
    """A replay buffer of the user's own."""


@pytest.fixture(scope="module", autouse=True)
def _modules() -> Iterator[None]:
    """The tasks under their ids, and the module ``heads_of_mine``."""
    module = ModuleType("heads_of_mine")
    vars(module)["Gentle"] = Gentle
    vars(module)["Buffer"] = Buffer
    Gentle.__module__ = Buffer.__module__ = "heads_of_mine"
    sys.modules["heads_of_mine"] = module
    gym.register(TASK, Filmed)
    gym.register("tests/Vector-v0", VectorBox)
    yield
    del gym.registry[TASK], gym.registry["tests/Vector-v0"], sys.modules["heads_of_mine"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def write(entries: dict[str, Any], name: str = "settings.yml") -> str:
    """A settings file in the working directory."""
    Path(name).write_text(yaml.safe_dump(copy.deepcopy(entries)))
    return name


def train(*arguments: str, task: str = TASK, status: int = 0, **changes: Any) -> None:
    config = write({"default": {**SETTINGS, **changes}})
    assert main(["train", "--env", task, "--conf-file", config, "--device", "cpu", *arguments]) == status


@pytest.fixture
def set_up(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[CuReSAC, zoo.ExperimentManager]]:
    """Function that trains as ``train`` does, but returns the model and the manager before the first step."""

    def begin(*arguments: str, task: str = TASK, **changes: Any) -> tuple[CuReSAC, zoo.ExperimentManager]:
        begun = []
        monkeypatch.setattr(zoo.ExperimentManager, "learn", lambda manager, model: begun.append((model, manager)))
        monkeypatch.setattr(zoo.ExperimentManager, "save_trained_model", lambda manager, model: None)
        train("--eval-freq", "-1", *arguments, task=task, **changes)
        return begun[0]

    return begin


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run with evaluations, checkpoints and a head of the user's own; read only."""
    with pytest.MonkeyPatch.context() as context:
        context.chdir(tmp_path_factory.mktemp("run"))
        train("--eval-freq", "8", "--eval-episodes", "1", "--save-freq", "8", srl="heads_of_mine.Gentle")
        return Path("logs/cure_sac", f"{RUN}_1").absolute()


# ------------------------------------------------------------------ training


def test_episodes_end_where_a_wrapper_ends_them(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """rl-zoo3's Monitor is inside of the wrapper, and does not see this end."""
    limit = {"gymnasium.wrappers.TimeLimit": {"max_episode_steps": 3}}
    train("--eval-freq", "8", "--eval-episodes", "1", env_wrapper=[limit])
    folder = Path("logs/cure_sac", f"{RUN}_1")
    assert set(np.load(folder / "evaluations.npz")["ep_lengths"].flat) == {3}
    lengths = np.loadtxt(folder / "0.monitor.csv", delimiter=",", skiprows=2)[:, 1]
    assert lengths.tolist() == [3] * 6
    capsys.readouterr()
    assert replay("enjoy", folder, "--trusted") == 0
    assert "4 Episodes" in capsys.readouterr().out  # of 14 steps


def test_env_kwargs_of_the_file_hold_for_the_evaluation(run: Path) -> None:
    assert (run / f"{RUN}.zip").is_file() and (run / "best_model.zip").is_file()
    assert set(np.load(run / "evaluations.npz")["ep_lengths"].flat) == {7}


def test_flags_override_the_file(set_up: Callable[..., Any]) -> None:
    overrides = ["curiosity_prob:0.5", "n_envs:2", "srl:'curl'", "augmentation_kwargs:dict(pad=1)"]
    kwargs = ["--env-kwargs", "size:40", "--eval-env-kwargs", "size:44"]
    model, manager = set_up("-params", *overrides, *kwargs, "--seed", "3", srl="rae")
    assert (model.curiosity_prob, model.n_envs, model.srl, model.seed) == (0.5, 2, "curl", 3)
    assert model.observation_space.shape == (6, 40, 40)
    assert manager.create_envs(1, eval_env=True).observation_space.shape == (6, 44, 44)


def test_rate_and_curiosity_may_fall(folder: Path) -> None:
    """As rl-zoo3 writes schedules, and the saved model has them."""
    train("--eval-freq", "-1", learning_rate="lin_1e-3", curiosity_prob="lin_0.5")
    model = CuReSAC.load(f"logs/cure_sac/{RUN}_1/{RUN}.zip", device="cpu")
    assert (model.lr_schedule(0.5), model.curiosity_prob(0.5)) == (5e-4, 0.25)  # type: ignore[operator]


def test_file_says_numbers_as_people_write_them(folder: Path) -> None:
    """1e-3 is a number here as in grids, 5e1 a whole one; the flag -n stands in for the file's ``n_timesteps``."""
    settings = {name: value for name, value in SETTINGS.items() if name != "n_timesteps"}
    text = yaml.safe_dump({"default": {**settings, "learning_rate": "RATE", "buffer_size": "SIZE"}})
    Path("settings.yml").write_text(text.replace("RATE", "1e-3").replace("SIZE", "5e1"))
    flags = ["--conf-file", "settings.yml", "--device", "cpu", "--eval-freq", "-1", "-n", "14"]
    assert main(["train", "--env", TASK, *flags]) == 0
    model = CuReSAC.load(f"logs/cure_sac/{RUN}_1/{RUN}.zip", device="cpu")
    assert (model.lr_schedule(1), model.num_timesteps, model.buffer_size) == (1e-3, 14, 50)
    assert yaml.safe_load("1e-3") == "1e-3", "that of others is as it was"


@pytest.mark.parametrize("logs", ["logs", "logs[lr=1e-3]"])  # rl-zoo3 finds no folder in the second
def test_trainings_started_together_have_a_folder_each(
    folder: Path, monkeypatch: pytest.MonkeyPatch, logs: str
) -> None:
    """Both count the folders before either makes its own."""
    read = zoo.ExperimentManager.read_hyperparameters

    def read_while_others_start(manager: zoo.ExperimentManager) -> Any:
        Path(manager.save_path).mkdir(parents=True)
        return read(manager)

    monkeypatch.setattr(zoo.ExperimentManager, "read_hyperparameters", read_while_others_start)
    train("--eval-freq", "-1", "-f", logs)
    theirs, ours = sorted(Path(logs, "cure_sac").iterdir())
    assert not list(theirs.iterdir())
    assert {f"{RUN}.zip", "0.monitor.csv", RUN} <= {path.name for path in ours.iterdir()}


def test_statistics_beside_a_trained_agent_stay_unread(set_up: Callable[..., Any], run: Path, folder: Path) -> None:
    """They are pickled, and their run's settings did not ask for them."""
    copied = hostile(run, folder, "vecnormalize.pkl", "cos\nmkdir\n(S'pwned'\ntR.")
    model, _ = set_up("-i", str(copied / f"{RUN}.zip"), srl="heads_of_mine.Gentle")
    assert model.get_vec_normalize_env() is None and not Path("pwned").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"normalize": True},
        {"normalize": {"norm_obs": False}, "frame_stack": 3},
        {"normalize": "dict(norm_obs=False)", "env_kwargs": {"channels_last": True}},
    ],
)
def test_normalizing_what_is_stored_otherwise_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any]
) -> None:
    """Images in floats; rewards normalised within what stacks frames or moves channels, where the buffer looks."""
    train("--eval-freq", "-1", status=2, **changes)
    assert re.search(r"VecNormalize|this buffer stores", capsys.readouterr().err)


def test_interrupted_training_keeps_its_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C at the first update; the sentence names a file from which training begins again."""

    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(CuReSAC, "train", interrupted)
        train("--eval-freq", "-1")
    (path,) = re.findall(r"Stopped at step \d+ of 20: (\S+\.zip) keeps the model", capsys.readouterr().out)
    train("--eval-freq", "-1", "-i", path)
    assert "Stopped" not in (said := capsys.readouterr().out) and "Nothing was learned" not in said
    train("--eval-freq", "-1", "-i", path, "-n", "2")  # less than the warm-up, which is made again
    assert "Nothing was learned" in capsys.readouterr().out


def test_trained_agent_keeps_its_networks(folder: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """rl-zoo3 drops others, and writes them into ``config.yml``."""
    agent = ["-i", str(run / f"{RUN}.zip"), "--eval-freq", "-1"]
    train(*agent, status=2, srl="heads_of_mine.Gentle", policy_kwargs={"net_arch": [9]})
    assert "cannot become {'net_arch': [9]}" in capsys.readouterr().err
    train(*agent, srl="heads_of_mine.Gentle")


# -------------------------------------------------------------------- tuning


def test_trials_are_kept_and_trained_from(set_up: Callable[..., Any], folder: Path) -> None:
    """Two calls add to one study; the first trial's values, number 0, reach the model, and -params beat them."""
    study = ["--storage", "studies/study.log", "--study-name", "mine"]
    config = write({"default": SETTINGS})
    optimize = ["optimize", "--env", TASK, "--conf-file", config, *study, "--n-trials", "1", "--n-evaluations", "1"]
    for seed in "12":
        assert main([*optimize, "--eval-episodes", "1", "--no-optim-plots", "--seed", seed]) == 0
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend("studies/study.log"))
    trials = optuna.load_study(study_name="mine", storage=storage).trials
    assert [trial.state for trial in trials] == 2 * [optuna.trial.TrialState.COMPLETE]
    model, _ = set_up(*study, "--trial-id", "0", "-params", "curiosity_beta:2.5")
    assert model.batch_size == 2 ** trials[0].params["batch_size_pow"]
    assert model.curiosity_prob == trials[0].params["curiosity_prob"] != trials[1].params["curiosity_prob"]
    assert model.curiosity_beta == 2.5 and model.policy_kwargs["net_arch"] == [8]  # the latter is the file's


@pytest.mark.parametrize(
    ("curiosity", "tuned"),
    [
        ("separate", {"curiosity_prob", "curiosity_beta"}),
        ("random", {"curiosity_prob"}),
        ("bonus", {"curiosity_beta"}),
        (None, set()),
    ],
)
def test_only_what_the_agent_uses_is_tuned(curiosity: str | None, tuned: set[str], folder: Path) -> None:
    """The sampler is the one of the file's kind of curiosity; its names are arguments of the algorithm."""
    zoo.register()
    config = write({"default": {**SETTINGS, "curiosity": curiosity}})
    asked = []

    def sample(trial: optuna.Trial) -> float:
        asked.append(zoo.HYPERPARAMS_SAMPLER["cure_sac"](trial, 2, 1, {}))
        return 0.0

    arguments = type("Arguments", (), {"gym_packages": [], "conf_file": None})()
    manager = zoo.ExperimentManager(
        arguments, "cure_sac", TASK, "logs", config=config, optimize_hyperparameters=True, sampler="random",
        no_optim_plots=True, eval_freq=-1,
    )  # fmt: skip
    assert manager.setup_experiment() is None
    manager.objective = sample  # type: ignore[method-assign]
    manager.hyperparameters_optimization()
    assert {name for name in asked[0] if "curiosity" in name} == tuned
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity, **{**asked[0], "buffer_size": 20})
    assert {name: getattr(model, name) for name in asked[0]} == asked[0]


# ----------------------------------------------------------------- replaying


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[OffPolicyAlgorithm]:
    """The models that are replayed."""
    models = []
    play = enjoy._play

    def keep(model: OffPolicyAlgorithm, *args: Any) -> Any:
        models.append(model)
        return play(model, *args)

    monkeypatch.setattr(enjoy, "_play", keep)
    return models


def replay(program: str, run: Path, *arguments: str, task: str = TASK) -> int:
    rest = ["--no-render"] if program == "enjoy" else []
    flags = ["--env", task, "-f", str(run.parent.parent), "-n", "14", "--device", "cpu"]
    return main([program, *flags, *rest, *arguments])


def test_enjoy_plays_the_run(run: Path, played: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    """With the class of its head, in its own environment, or in one that flags change."""
    assert replay("enjoy", run) == 2
    assert "add --srl heads_of_mine.Gentle" in capsys.readouterr().err
    assert replay("enjoy", run, "--srl", "heads_of_mine.Gentle") == 0
    assert "2 Episodes" in capsys.readouterr().out  # of 7 steps each
    assert type(played[0].policy.srl) is Gentle
    assert replay("enjoy", run, "--srl", "heads_of_mine.Gentle", "--env-kwargs", "episode_length:2") == 0
    assert "7 Episodes" in capsys.readouterr().out
    assert replay("enjoy", run, "--srl", "heads_of_mine.Gentle", "--env-kwargs", "size:40") == 2
    assert "Observation spaces do not match" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changes",
    [
        {"replay_buffer_kwargs": {"frame_stack": 1}},
        {"replay_buffer_class": "heads_of_mine.Buffer"},
        {"n_steps": 3},
        {"optimize_memory_usage": True},
    ],
)
def test_agent_plays_whatever_buffer_it_had(changes: dict[str, Any], folder: Path) -> None:
    """Its reward reads the newest frame, whose size is the buffer's to say; returns of n steps are not needed."""
    train("--eval-freq", "-1", intrinsic="rnd", **changes)
    assert replay("enjoy", Path(f"logs/cure_sac/{RUN}_1")) == 0


def test_record_writes_a_video(run: Path, tmp_path: Path) -> None:
    assert replay("record", run, "--srl", "heads_of_mine.Gentle", "--load-best", "-o", str(tmp_path)) == 0
    (video,) = tmp_path.glob("best_model-*.mp4")
    assert video.stat().st_size > 1000


@pytest.mark.parametrize(
    ("flags", "model"),
    [
        ([], f"{RUN}_12/{RUN}.zip"),
        (["--exp-id", "3"], f"{RUN}_3/{RUN}.zip"),
        (["--exp-id", "3", "--load-best"], f"{RUN}_3/best_model.zip"),
        (["--exp-id", "3", "--load-checkpoint", "50"], f"{RUN}_3/rl_model_50_steps.zip"),
        (["--exp-id", "3", "--load-last-checkpoint"], f"{RUN}_3/rl_model_100_steps.zip"),
        (["--load-best"], None),  # rather than that of an older run
        (["--exp-id", "3", "--load-checkpoint", "5"], None),
        (["--exp-id", "4"], None),
        (["--algo", "cure_sac", "--env", "tests/Vector-v0"], None),
    ],
)
def test_model_is_the_one_that_flags_name(
    flags: list[str],
    model: str | None,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Found(Exception):
        pass

    runs = Path("logs/cure_sac")
    files = [f"{RUN}_3/{name}" for name in ("best_model", "rl_model_50_steps", "rl_model_100_steps", RUN)]
    files += [f"{RUN}_12/{RUN}", f"tests-Filmed-v01_14/{RUN}"]
    for file in files:
        (runs / file).parent.mkdir(parents=True, exist_ok=True)
        (runs / f"{file}.zip").touch()
    (runs / f"{RUN}_15" / RUN).mkdir(parents=True)  # as a training leaves it that fails before its first step

    def load(path: Path, *args: Any, **kwargs: Any) -> None:
        raise Found(str(path))

    monkeypatch.setattr(CuReSAC, "load", load)
    arguments = ["enjoy", "--env", TASK, "--no-render", *flags]
    if model is None:
        assert main(arguments) == 2
        assert f", {RUN}_12, {RUN}_3." in capsys.readouterr().err
    else:
        with pytest.raises(Found, match=f"^{runs / model}$"):
            main(arguments)


def hostile(run: Path, folder: Path, file: str, text: str) -> Path:
    """A copy of the run with another settings file."""
    copied = folder / "logs" / "cure_sac" / run.name
    shutil.copytree(run, copied)
    (copied / RUN / file).write_text(text)
    return copied


@pytest.mark.parametrize("program", ["enjoy", "record"])
@pytest.mark.parametrize("file", ["config.yml", "args.yml"])
@pytest.mark.parametrize("tag", ["object/apply:os.mkdir [pwned]", "object/new:os.mkdir [pwned]", "module:antigravity"])
def test_settings_of_a_run_execute_nothing(program: str, file: str, tag: str, run: Path, folder: Path) -> None:
    copied = hostile(run, folder, file, f"env_kwargs: !!python/{tag}")
    with pytest.raises(yaml.YAMLError):
        replay(program, copied, "--srl", "heads_of_mine.Gentle")
    assert not Path("pwned").exists() and "antigravity" not in sys.modules


@pytest.mark.parametrize(
    "setting",
    [
        "normalize: \"__import__('os').mkdir('pwned')\"",
        "env_wrapper: [{antigravity.Wrapper: {}}]",
        "vec_env_wrapper: antigravity.Wrapper",
    ],
)
def test_settings_that_name_code_need_trust(setting: str, run: Path, folder: Path) -> None:
    copied = hostile(run, folder, "config.yml", setting)
    assert replay("enjoy", copied, "--srl", "heads_of_mine.Gentle") == 2
    assert not Path("pwned").exists() and "antigravity" not in sys.modules


def test_statistics_of_a_run_need_trust(folder: Path, played: list[Any]) -> None:
    """They are pickled; with trust the agent sees the observations normalised as in training."""
    train(
        *("--eval-freq", "-1"), task="tests/Vector-v0", policy="MlpPolicy", normalize=True, srl=None, curiosity=None,
        policy_kwargs={"net_arch": [8]}, warmup_updates=None, env_kwargs={},
    )  # fmt: skip
    run = folder / "logs" / "cure_sac" / "tests-Vector-v0_1"
    assert replay("enjoy", run, task="tests/Vector-v0") == 2
    assert replay("enjoy", run, "--trusted", task="tests/Vector-v0") == 0
    (model,) = played
    statistics = model.get_vec_normalize_env()
    with open(run / "tests-Vector-v0" / "vecnormalize.pkl", "rb") as file:
        trained = pickle.load(file)
    assert not statistics.training and not statistics.norm_reward
    np.testing.assert_array_equal(statistics.obs_rms.mean, trained.obs_rms.mean)


def test_environment_that_only_renders_is_wrapped_by_the_guides_command(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It can be filmed, though so few steps are told to have taught nothing."""
    guide = (Path(__file__).parents[2] / "docs" / "guide" / "environments.md").read_text()
    command = next(block for block in re.findall(r"```bash\n(.*?)```", guide, re.S) if "env_wrapper" in block)
    arguments = command.replace("my_module:My-v0", "Pendulum-v1").replace("-n 5000", "-n 14 --eval-freq -1")
    assert main(shlex.split(arguments.replace("\\\n", ""))[1:]) == 0
    assert "Nothing was learned: no update is made before step learning_starts=500." in capsys.readouterr().out
    assert replay("record", Path("logs/cure_sac/Pendulum-v1_1"), "--trusted", task="Pendulum-v1") == 0
    (video,) = Path("logs/cure_sac/Pendulum-v1_1/videos").glob("*.mp4")
    assert video.stat().st_size > 1000
