"""Typing errors end in one sentence that names what was meant, with status 2, and train nothing."""

import shlex
import sys
from pathlib import Path

import pytest

from sb3_cure.cli import main, zoo

CARTPOLE = "--env dmc_pixels/cartpole-swingup-v0"
TRAIN = f"train {CARTPOLE} --conf-file fast/cure_curl -params buffer_size:10"
GRID = "experiment: mine\nkind: curves\nbudget: 100\nmethods: {a: {config: fast/sac_ae, overrides: {%s}}}\n%s: [%s]"
FILES = {
    "my_module.py": "class Mine: pass",
    "mine.yml": "default: {polcy: CnnPolicy, n_timesteps: 10}",
    "broken.yml": "default: {policy: [",
    "twice.yml": "default: {policy: CnnPolicy, tau: 0.1, tau: 0.2}",
    "key.yml": GRID % ("", "taks", "dmc_pixels/walker-walk-v0"),
    "argument.yml": GRID % ("curiosity_porb: 0.3", "tasks", "dmc_pixels/walker-walk-v0"),
    "task.yml": GRID % ("", "tasks", "dmc_pixels/walker-wlak-v0"),
    "my_results/README.md": "",
}
#: What the sentence must contain, by the command line
TYPOS = {
    f"trian {CARTPOLE}": "did you mean train?",
    "--verison": "did you mean --version?",
    "train --env dmc_pixels/cartpole-swingpu-v0": "did you mean dmc_pixels/cartpole-swingup-v0",
    "train --env cartpole-swingup": "did you mean dmc_pixels/cartpole-swingup-v0",
    "train --env my_modul:My-v0": "did you mean my_module?",
    "train --env gym_pusht/PushT-v0": "as in my_module:gym_pusht/PushT-v0",
    "train --env parking-v0": "as in my_module:parking-v0",  # although CarRacing-v3 is near
    f"train {CARTPOLE} --conf-file fast/cure_sac": "did you mean fast/cure_sac_ae",
    f"train {CARTPOLE} --conf-file fast/curl.yml": "did you mean fast/curl",
    f"train {CARTPOLE} --conf-file mine.yaml": "did you mean mine.yml",
    f"train {CARTPOLE} --conf-file mine.yml": "did you mean polcy?",
    f"train {CARTPOLE} --conf-file broken.yml": "line 1, column",
    f"train {CARTPOLE} --conf-file twice.yml": "'tau' is there twice, in the mapping of line 1",
    f"{TRAIN} curiosity_porb:0.5": "did you mean curiosity_prob",
    f"{TRAIN} net_arch:[8]": "no argument 'net_arch' here, but in CuRePolicy",
    f"{TRAIN} srl:curl": "'curl' is not defined",
    f"{TRAIN} srl:\"'crul'\"": "'curl'",
    f"{TRAIN} srl:\"'my_module.Mien'\"": "did you mean Mine?",
    f"{TRAIN} intrinsic:\"'rdn'\"": "'rnd'",
    f"{TRAIN} policy_kwargs:'dict(net_arhc=[8])'": "did you mean net_arch?",
    f"{TRAIN} env_wrapper:\"[{{'sb3_cure.envs.make_pixel_evn': {{}}}}]\"": "did you mean make_pixel_env",
    "train --conf-file fast/best": "--env must name an environment",
    f"{TRAIN} env_wrapper:\"'gymnasium.wrappers.NormalizeObservation'\"": "evaluations would not share",
    "train --env CartPole-v1 --conf-file fast/best": "actions are Discrete(2)",
    "doctor --env CartPole-v1": "actions are Discrete(2)",
    f"{TRAIN} env_wrapper:\"{{'my_module.Mine': {{}}, 'my_module.Other': {{}}}}\"": "one wrapper with its arguments",
    f"{TRAIN} --env-kwargs image_sise:36": "did you mean image_size?",
    f"{TRAIN} --algo cure_tcq": "'cure_tqc'",
    f"{TRAIN} --sede 1": "unrecognized arguments: --sede",
    f"{TRAIN} -i model.zip": "there is no model.zip",
    f"{TRAIN} -i .": "-i . must be a model, a .zip file",
    f"{TRAIN} --trial-id 0": "--study-name",
    f"enjoy {CARTPOLE} --no-render": "No model found|was not found",
    "record --env dmc_pixels/cartpol-swingup-v0": "did you mean dmc_pixels/cartpole-swingup-v0",
    f"record {CARTPOLE} --sede 1": "did you mean --seed or",
    "experiment fast/curvs": "did you mean fast/curves",
    "experiment curves.yml": "did you mean curves",
    "experiment key.yml": "did you mean tasks?",
    "experiment argument.yml": "did you mean curiosity_prob",
    "experiment task.yml": "did you mean dmc_pixels/walker-walk-v0",
    "experiment fast/curves --tasks cartpole-swingpu": "did you mean cartpole-swingup",
    "experiment fast/curves --methods sac_ea": "did you mean sac_ae?",
    "report my_reslts": "did you mean my_results?",
    "doctor --env dmc_pixels/pendulum-swignup-v0": "did you mean dmc_pixels/pendulum-swingup-v0",
    "doctor --vebrose": "unrecognized arguments: --vebrose",
}


@pytest.mark.parametrize("typed", TYPOS)
def test_typing_error_is_one_sentence(
    typed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(zoo.ExperimentManager, "learn", lambda manager, model: pytest.fail("it trains"))
    for name, text in FILES.items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    try:
        status = main.main(shlex.split(typed))
    except SystemExit as stop:  # argparse's, after its usage
        status = stop.code  # type: ignore[assignment]
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert status == 2
    assert any(text in sentence for text in TYPOS[typed].split("|")), sentence
