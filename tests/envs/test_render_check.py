"""Which OpenGL renders, tried in a process of its own, and GPUs that lie idle beside it."""

import sys
from pathlib import Path

import pytest

from sb3_cure.envs import render_check


def test_folder_with_any_names_spoils_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A random.py in the working directory is not taken for Python's own; modules may be looked for in a Path."""
    (tmp_path / "random.py").write_text("1 / 0")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, tmp_path / "modules"])
    result = render_check.try_rendering()
    assert result.keys() == {"renderer", "backend", "dmc", "fast"} and 0 < result["fast"]


def test_broken_driver_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "nonsense")
    assert "apt-get install libegl1" in render_check.try_rendering()["error"]


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
    warning = render_check.judge_renderer(renderer, gpus)
    assert (warning is not None) == (install is not None)
    if warning and install:
        assert "llvmpipe" in warning and gpus[0] in warning and install in warning


def test_gpus_that_draw_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of AMD and Intel, which this torch does not compute on; not the display of a server's board (ASPEED)."""
    for number, vendor in enumerate(["0x8086", "0x1002", "0x1a03"]):
        device = tmp_path / f"renderD{128 + number}" / "device"
        device.mkdir(parents=True)
        (device / "vendor").write_text(f"{vendor}\n")
    monkeypatch.setattr(render_check, "DRM", tmp_path)
    monkeypatch.setattr(render_check.th.cuda, "is_available", lambda: False)
    assert render_check.find_gpus()[-2:] == ["Intel GPU", "AMD GPU"]
