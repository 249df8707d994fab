"""The command line: training, replaying, filming and tuning from a YAML file, and the doctor."""

import os
import re
import subprocess
import sys
import tracemalloc
from collections import OrderedDict
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import pytest
import yaml
from envs_for_tests import PixelBox, tiny_model
from packaging.requirements import Requirement

from sb3_cure import CuReSAC, cli, doctor, zoo
from sb3_cure.checks import check_arguments

TASK = "dmc_pixels/finger-spin-v0"
SETTINGS = {
    "default": {
        "n_timesteps": 24,
        "policy": "CnnPolicy",
        # Episodes of 10 agent steps
        "env_kwargs": {"image_size": 36, "grayscale": True, "renderer": "fast", "action_repeat": 100},
        "learning_starts": 10,
        "warmup_updates": 1,
        "batch_size": 4,
        "policy_kwargs": {"net_arch": [16], "features_extractor_kwargs": {"n_filters": 4}},
    }
}
# A user's own head, in a module of the working directory
HEAD = """
from sb3_cure.srl import RAE

class Gentle(RAE):
    pass
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with ``tiny.yml`` in it."""
    (tmp_path / "tiny.yml").write_text(yaml.safe_dump(SETTINGS))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def start(command: Sequence[str], **environment: str) -> subprocess.Popen[str]:
    """A process in the working directory whose output, of both kinds, can be read."""
    return subprocess.Popen(
        command, env={**os.environ, **environment}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def finish(process: subprocess.Popen[str]) -> str:
    """The output of a process that ends well."""
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    return output


def script() -> str:
    """The installed command."""
    return str(Path(sys.executable).parent / "sb3-cure")


# ---------------------------------------------------------------- commands


def test_without_a_command_it_shows_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    """Usage is printed, and names every command."""
    assert cli.main([]) == 0
    usage = capsys.readouterr().out
    assert all(f"  {command} " in usage for command in cli.COMMANDS)


def test_an_unknown_command_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    """It names the command and those that exist."""
    assert cli.main(["fly", "--env", TASK]) == 2
    error = capsys.readouterr().err
    assert "'fly'" in error and "train, enjoy, record, optimize, experiment, report, doctor" in error


def test_a_missing_extra_is_named() -> None:
    """One sentence with the package and what to install."""
    # None is Python's way to say that there is no such module. In a process of its own, as it spoils what is imported.
    code = """
import sys
from sb3_cure.cli import main

for command, package in ("report", "matplotlib"), ("train", "rl_zoo3"):
    sys.modules[package] = None
    try:
        main([command, "--help"])
    except SystemExit as sentence:
        print(sentence)
"""
    assert finish(start([sys.executable, "-c", code])).splitlines() == [
        'sb3-cure report needs matplotlib, which is not installed: pip install "sb3-cure[experiments]"',
        'sb3-cure train needs rl_zoo3, which is not installed: pip install "sb3-cure[zoo]"',
    ]


def test_rl_zoos_own_algorithms_keep_their_environment(folder: Path) -> None:
    """--env may be left out with them, as in rl-zoo3: CartPole-v1."""
    assert cli.main(["train", "--algo", "dqn", "-n", "8", "--eval-freq", "-1", "--device", "cpu"]) == 0
    assert (folder / "logs" / "dqn" / "CartPole-v1_1" / "CartPole-v1.zip").exists()


def test_a_users_missing_module_is_no_missing_extra(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A head that cannot be imported is named, and nothing is to be installed."""
    command = ["train", "--env", TASK, "--conf-file", "tiny.yml", "-params", "srl:'no_such_heads.Mine'"]
    assert cli.main(command) == 2
    error = capsys.readouterr().err
    assert "srl is 'no_such_heads.Mine'" in error and "pip install" not in error


# ------------------------------------------------------------------- rl-zoo


@pytest.mark.parametrize("program", ["enjoy", "record"])
def test_help_shows_what_rl_zoo_has_not(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([program, "--help"])
    shown = capsys.readouterr().out
    assert "--srl MODULE.CLASS" in shown and "--gym-packages" in shown and "--exp-id" in shown


def test_train_enjoy_record(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A round trip with a user's own head: cure_sac is the algorithm, and the file's env_kwargs hold everywhere."""
    (folder / "my_heads.py").write_text(HEAD)
    settings = {"default": {**SETTINGS["default"], "srl": "my_heads.Gentle"}}
    (folder / "tiny.yml").write_text(yaml.safe_dump(settings))
    train = [script(), "train", "--env", TASK, "--conf-file", "tiny.yml", "--eval-freq", "20", "--eval-episodes", "1"]
    output = finish(start(train))
    assert "Episode length: 10.00" in output  # the evaluation's environment repeats actions too
    run = folder / "logs" / "cure_sac" / "dmc_pixels-finger-spin-v0_1"
    assert (run / "dmc_pixels-finger-spin-v0.zip").is_file() and (run / "best_model.zip").is_file()

    models = []
    load = zoo.ActingCuReSAC.load

    def load_and_keep(*args: Any, **kwargs: Any) -> CuReSAC:
        models.append(load(*args, **kwargs))
        return models[-1]

    monkeypatch.setattr(zoo.ActingCuReSAC, "load", load_and_keep)
    enjoy = ["enjoy", "--env", TASK, "-n", "20", "--no-render"]
    assert cli.main(enjoy) == 2 and "add --srl my_heads.Gentle." in capsys.readouterr().err
    assert cli.main([*enjoy, "--srl", "my_heads.Gentle"]) == 0
    assert "2 Episodes" in capsys.readouterr().out
    (model,) = models
    assert model.replay_buffer is None and type(model.policy.srl).__name__ == "Gentle"

    record = [sys.executable, "-m", "sb3_cure.zoo", "record", "--env", TASK, "-n", "5", "--load-best"]
    record += ["--srl", "my_heads.Gentle"]
    finish(start(record))
    (video,) = run.glob("videos/*.mp4")
    assert video.stat().st_size > 1000


CAMERA = """
import gymnasium as gym
from envs_for_tests import PixelBox
from stable_baselines3.common.buffers import ReplayBuffer

class Camera(PixelBox):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode=None, channels_last=True, **kwargs):
        super().__init__(channels_last=channels_last, episode_length=10, **kwargs)
        self.render_mode = render_mode

    def render(self):
        return self.frames[-1].transpose(1, 2, 0)

gym.register("Camera-v0", Camera)

class Buffer(ReplayBuffer):
    pass
"""


def test_an_environment_of_ones_own(folder: Path) -> None:
    """All programs find what a module of the working directory registers, by either flag; `record` and `enjoy` take the
    latest run that has a model, which `optimize` leaves none in."""
    (folder / "camera_of_mine.py").write_text(CAMERA)
    settings = {key: value for key, value in SETTINGS["default"].items() if key != "env_kwargs"}
    settings["replay_buffer_class"] = "camera_of_mine.Buffer"
    own = {"PYTHONPATH": str(Path(__file__).parent)}
    by_flag, by_name = ["--env", "Camera-v0", "--gym-packages", "camera_of_mine"], ["--env", "camera_of_mine:Camera-v0"]
    entries = {True: "Camera-v0", False: "camera_of_mine:Camera-v0"}
    programs = [(by_flag, "train"), (by_flag, "record")]
    programs += [(by_name, program) for program in ("train", "optimize", "enjoy", "record")]
    for flags, program in programs:
        rest = ["-n", "20", "--no-render"]
        if program in ("train", "optimize"):
            (folder / "tiny.yml").write_text(yaml.safe_dump({entries[flags is by_flag]: settings}))
            rest = ["--conf-file", "tiny.yml", "--n-trials", "1", "--n-evaluations", "1"]
        output = finish(start([script(), program, *flags, *rest], **own))
        if program in ("enjoy", "record"):
            assert f"Loading latest experiment, id={1 if flags is by_flag else 2}" in output
    runs = folder / "logs" / "cure_sac"
    for number in (1, 2):  # so that each can be run again from what it has kept
        kept = yaml.unsafe_load((runs / f"Camera-v0_{number}" / "Camera-v0" / "args.yml").read_text())
        assert (kept["env"], kept["gym_packages"]) == ("Camera-v0", ["camera_of_mine"])
    (video,) = runs.glob("Camera-v0_2/videos/*.mp4")
    assert video.stat().st_size > 1000


def test_classes_in_settings(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file of settings in Python may hold them, and so may -params; the run, of a unique name, can be watched."""
    (folder / "tiny.py").write_text(
        f"from sb3_cure.srl import RAE\nhyperparams = {SETTINGS}\nhyperparams['default']['srl'] = RAE"
    )
    train = ["train", "--env", TASK, "--conf-file", "tiny.py", "--eval-freq", "-1", "--uuid"]
    assert cli.main([*train, "-params", "policy_kwargs:dict(net_arch=[8], activation_fn=th.nn.Tanh)"]) == 0
    enjoy = ["enjoy", "--env", TASK, "-n", "20", "--no-render"]
    assert cli.main(enjoy) == 0
    (run,) = folder.glob("logs/cure_sac/*_1_*")
    output = capsys.readouterr().out
    assert f"id={run.name.partition('-v0_')[2]}\n" in output and "2 Episodes" in output
    assert cli.main([*enjoy, "--load-best"]) == 2 and "its run has the last model" in capsys.readouterr().err


def test_an_environment_that_only_renders_is_wrapped_by_its_settings(folder: Path) -> None:
    """As the README's example does; what was trained so can be filmed."""
    readme = (Path(__file__).parent.parent / "README.md").read_text()
    example = next(block for block in re.findall(r"```yaml\n(.*?)```", readme, re.S) if "env_wrapper" in block)
    settings = {**SETTINGS["default"], **yaml.safe_load(example)["default"]}
    (folder / "tiny.yml").write_text(yaml.safe_dump({"Pendulum-v1": settings}))
    finish(start([script(), "train", "--env", "Pendulum-v1", "--conf-file", "tiny.yml", "-n", "14"]))
    finish(start([script(), "record", "--env", "Pendulum-v1", "-n", "5"]))
    (video,) = folder.glob("logs/cure_sac/Pendulum-v1_1/videos/*.mp4")
    assert video.stat().st_size > 1000


def test_a_model_that_only_acts_has_no_replay_buffer(tmp_path: Path) -> None:
    """Whatever the size of the buffer that it was trained with."""
    tiny_model("CnnPolicy", PixelBox(), buffer_size=10_000).save(tmp_path / "model")
    peaks = {}
    for cls in (CuReSAC, zoo.ActingCuReSAC):
        tracemalloc.start()
        model = cls.load(tmp_path / "model", custom_objects={"learning_rate": 0.0, "lr_schedule": lambda _: 0.0})
        peaks[cls] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert model.replay_buffer is None
    frames = 10_000 * 3 * 36 * 36
    assert peaks[CuReSAC] > frames and peaks[zoo.ActingCuReSAC] < frames / 10
    observation = model.observation_space.sample()
    assert model.predict(observation)[0].shape == (2,)


@pytest.mark.filterwarnings("ignore:.*HumanRendering.*:UserWarning")
def test_a_window_can_show_the_agent() -> None:
    """`enjoy` asks for render_mode="human", which Gymnasium grants to environments that can be filmed."""
    env = gym.make(TASK, render_mode="human", image_size=36, renderer="fast")
    assert env.render_mode == "human"
    assert env.get_wrapper_attr("frame_stack") == 3
    env.close()


def test_two_processes_share_a_study(folder: Path) -> None:
    """Both start at once on a database that does not exist; every trial is there once, and can be trained from."""
    storage = f"sqlite:///{folder}/study.db"
    optimize = [script(), "optimize", "--env", TASK, "--conf-file", "tiny.yml", "-n", "12", "--n-evaluations", "1"]
    optimize += ["--eval-episodes", "1", "--storage", storage, "--study-name", "shared", "--n-trials", "2"]
    optimize += ["--no-optim-plots"]
    for process in [start([*optimize, "--seed", seed]) for seed in "12"]:
        finish(process)
    study = optuna.load_study(study_name="shared", storage=storage)
    assert [trial.state for trial in study.trials] == 4 * [optuna.trial.TrialState.COMPLETE]
    assert len({trial.params["learning_rate"] for trial in study.trials}) == 4

    zoo.register()
    arguments = type("Arguments", (), {})()
    for trial in study.trials[0], study.trials[3]:
        manager = zoo.ExperimentManager(
            arguments, "cure_sac", TASK, str(folder), config="tiny.yml", storage=storage, study_name="shared",
            trial_id=trial.number, eval_freq=-1, verbose=0,
        )  # fmt: skip
        model, _ = manager.setup_experiment()  # type: ignore[misc]
        assert model.batch_size == 2 ** trial.params["batch_size_pow"]
        assert model.curiosity_prob == trial.params["curiosity_prob"]  # type: ignore[attr-defined]
        assert model.policy_kwargs["net_arch"] == [16]  # the file's


@pytest.mark.parametrize(
    ("curiosity", "tuned"),
    [
        ("separate", {"curiosity_prob", "curiosity_beta"}),
        ("random", {"curiosity_prob"}),
        ("bonus", {"curiosity_beta"}),
        (None, set()),
    ],
)
def test_what_is_tuned(curiosity: str | None, tuned: set[str]) -> None:
    """Only what the kind of curiosity uses; Optuna's names and CuReSAC's agree."""
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask()
    arguments = zoo.sample_cure_sac_params(trial, 2, 1, {}, curiosity=curiosity)
    assert {name for name in arguments if "curiosity" in name} == tuned
    assert zoo.convert_cure_sac_params(trial.params) == arguments
    model = tiny_model("CnnPolicy", PixelBox(), curiosity=curiosity, **{**arguments, "buffer_size": 20})
    check_arguments(model)
    assert {name: getattr(model, name) for name in arguments} == arguments


# ------------------------------------------------------------------- doctor


def test_the_doctor_on_a_machine_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    """Versions, choices, and the time of a frame with both renderers; status 0."""
    assert cli.main(["doctor"]) == 0
    report = capsys.readouterr().out
    for text in (
        "torch  ",
        "mujoco  ",
        f"rl_zoo3 {metadata.version('rl_zoo3')}",
        'precision="auto"',
        'compile="auto"',
        '(renderer="fast")',
        "MUJOCO_GL=",
    ):
        assert text in report
    assert "ERROR" not in report and "Training can work here." in report


@pytest.mark.parametrize("broken", [{"MUJOCO_GL": "nonsense"}, {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "nonsense"}])
def test_the_doctor_survives_broken_opengl(
    broken: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rest of the report is there, the error says what to install, and the status is 1."""
    for name, value in broken.items():
        monkeypatch.setenv(name, value)
    assert cli.main(["doctor"]) == 1
    report = capsys.readouterr().out
    assert "torch  " in report and "Traceback" not in report
    assert "ERROR    OpenGL cannot render here" in report and "apt-get install libegl1" in report
    assert "Training cannot work here yet." in report


def test_the_doctor_in_a_folder_of_any_names(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random.py in the working directory is not taken for Python's own; modules may be looked for in a Path."""
    (folder / "random.py").write_text("1 / 0")
    monkeypatch.setattr(sys, "path", [*sys.path, folder / "modules"])
    assert "error" not in doctor.try_rendering()


@pytest.mark.parametrize(
    ("renderer", "gpus", "install"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", ["NVIDIA A100"], "libegl-nvidia0"),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", ["Intel GPU"], "libgl1-mesa-dri"),
        ("llvmpipe (LLVM 15.0.6, 256 bits)", [], None),
        ("NVIDIA A100/PCIe/SSE2", ["NVIDIA A100"], None),
    ],
)
def test_software_rendering_beside_a_gpu_is_warned_of(renderer: str, gpus: list[str], install: str | None) -> None:
    """The warning names both, and what to install; without a GPU there is nothing to warn of."""
    warning = doctor.judge_renderer(renderer, gpus)
    assert (warning is not None) == (install is not None)
    if warning and install:
        assert "llvmpipe" in warning and gpus[0] in warning and install in warning


def test_gpus_that_draw_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of AMD and Intel, which this torch does not compute on; not the display of a server's board (ASPEED)."""
    for number, vendor in enumerate(["0x8086", "0x1002", "0x1a03"]):
        device = tmp_path / f"renderD{128 + number}" / "device"
        device.mkdir(parents=True)
        (device / "vendor").write_text(f"{vendor}\n")
    monkeypatch.setattr(doctor, "DRM", tmp_path)
    monkeypatch.setattr(doctor.th.cuda, "is_available", lambda: False)
    gpus = doctor.find_gpus()
    assert gpus[-2:] == ["Intel GPU", "AMD GPU"]
    report = doctor.Report()
    doctor._check_hardware(report, gpus[-2:])
    assert ("GPU", "Intel GPU, AMD GPU") in report.sections["Hardware"]
    assert not any("CUDA" in warning for warning in report.warnings), "which they do not run"


def test_memory_is_compared_with_the_buffer() -> None:
    """80 000 transitions of three 84 x 84 frames; where they do not fit, the ways out are named."""
    needed = doctor.default_buffer_bytes()
    assert 80_000 * 3 * 84 * 84 < needed < 1.1 * 80_000 * 3 * 84 * 84
    assert doctor.judge_memory(needed + 1, needed) is None
    assert doctor.judge_memory(None, needed) is None
    assert "frames_dir" in str(doctor.judge_memory(needed - 1, needed))


def test_versions_are_compared_with_the_requirements() -> None:
    """Missing and unsuitable packages are told apart; an extra's include those of the extras it builds on."""
    numpy = Requirement("numpy>=999")
    missing = Requirement("no-such-package-of-sb3-cure>=1")
    problems = doctor.unmet([Requirement("numpy>=1"), numpy, missing])
    assert len(problems) == 2 and ">=999" in problems[0] and "is missing" in problems[1]
    assert {"torch", "mujoco", "gymnasium"} <= {requirement.name for requirement in doctor.requirements()}
    extra = {requirement.name for requirement in doctor.requirements("experiments")}
    assert {"rliable", "matplotlib"} <= extra and ("rl_zoo3" in extra or "rl-zoo3" in extra) and "torch" not in extra


def test_a_runs_settings_cannot_run_code(tmp_path: Path) -> None:
    """What rl-zoo3 writes beside a model is read as data, classes as their names; objects are refused."""
    settings = OrderedDict([("env", TASK), ("frames", (1, 2)), ("kwargs", OrderedDict(a=1.5))])
    assert yaml.load(yaml.dump(settings), Loader=zoo.RunLoader) == settings
    assert yaml.load("!!python/name:no_such.module ''", Loader=zoo.RunLoader) == "no_such.module"
    with pytest.raises(yaml.YAMLError, match="could not determine a constructor"):
        yaml.load("!!python/object/apply:os.system ['true']", Loader=zoo.RunLoader)
