"""``sb3-cure doctor``: what is shown, and when the exit status says that training cannot work."""

from importlib import metadata

import pytest

from sb3_cure.cli import doctor
from sb3_cure.cli.main import main

WORKS = {"renderer": "llvmpipe (LLVM 15.0.6, 256 bits)", "backend": "egl", "dmc": 13.0, "fast": 2.0}


def test_doctor_on_a_machine_that_works(capsys: pytest.CaptureFixture[str]) -> None:
    """System, versions, choices, and the time of a frame with both renderers; status 0."""
    assert main(["doctor"]) == 0
    report = capsys.readouterr().out
    versions = [f"{name} {metadata.version(name)}" for name in ("torch", "mujoco", "rl_zoo3", "scipy")]
    choices = ['precision="auto": ']
    for text in ["Python version: ", *versions, *choices, '(renderer="fast")', "MUJOCO_GL=", "Training can work here."]:
        assert text in report
    assert "ERROR" not in report


def test_doctor_survives_broken_opengl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The rest of the report is there, the error says what to install, and the status is 1."""
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    assert main(["doctor"]) == 1
    report = capsys.readouterr().out
    assert "torch " in report and "Traceback" not in report
    assert "ERROR    OpenGL cannot render here" in report and "apt-get install libegl1" in report


@pytest.mark.parametrize(("extra", "status"), [("", 1), ("zoo", 0)])
def test_doctor_names_missing_packages(
    extra: str, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An error only where every installation needs it."""
    marker = f'; extra == "{extra}"' if extra else ""
    lines = [*(metadata.requires("sb3-cure") or []), f"no-such-package>=1,<2{marker}"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda package: lines)
    monkeypatch.setattr(doctor, "try_rendering", lambda: WORKS)
    assert main(["doctor"]) == status
    report = capsys.readouterr().out
    assert "no-such-package" in report and ("ERROR" in report) == bool(status)
    assert ("pip install -e '.[zoo]'" in report) == (extra == "zoo")


def test_doctor_warns_of_unused_gpus(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Of torch without CUDA, and of frames that the CPU computes; training can work all the same."""
    monkeypatch.setattr(doctor.th.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor, "find_gpus", lambda: ["NVIDIA GPU"])
    monkeypatch.setattr(doctor, "try_rendering", lambda: WORKS)
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.count("WARNING") == 2
