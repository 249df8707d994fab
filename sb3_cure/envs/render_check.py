"""Which OpenGL renders here, how quickly, and whether a GPU lies idle."""

import contextlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th

from sb3_cure.envs.dmc import make_dmc_env
from sb3_cure.envs.rendering import check_gl

#: Names of Mesa's renderers that compute on the CPU
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "lavapipe")
NVIDIA_GL = (
    "install the EGL library of NVIDIA's driver (Debian: `apt-get install libegl-nvidia0`, Ubuntu: `apt-get install "
    "libnvidia-gl-N` with the driver's version for N); in a container set NVIDIA_DRIVER_CAPABILITIES=all"
)
MESA_GL = (
    "install Mesa's drivers (`apt-get install libgl1-mesa-dri`) and let this user open /dev/dri/renderD* (group "
    "render; in a container: --device /dev/dri)"
)
#: Vendors, by their PCI numbers, whose GPUs Mesa draws with
MESA_VENDORS = {"0x1002": "AMD", "0x8086": "Intel"}
#: Where Linux lists graphics devices
DRM = Path("/sys/class/drm")
TIMEOUT_SECONDS = 180


def find_gpus() -> list[str]:
    """Find the GPUs of this machine.

    :return: Names of the GPUs that torch can use, or else of those that NVIDIA's driver knows, and of AMD's and Intel's
    """
    if th.cuda.is_available():
        return [th.cuda.get_device_name(i) for i in range(th.cuda.device_count())]
    names = ["NVIDIA GPU" for _ in Path("/proc/driver/nvidia/gpus").glob("*")]
    for path in sorted(DRM.glob("renderD*/device/vendor")):
        if vendor := MESA_VENDORS.get(path.read_text().strip()):
            names.append(f"{vendor} GPU")
    return names


def is_software_renderer(name: str) -> bool:
    """Check whether a renderer computes on the CPU.

    :param name: What OpenGL calls its renderer
    :return: Whether it does
    """
    return any(software in name.lower() for software in SOFTWARE_RENDERERS)


def judge_renderer(name: str, gpus: Sequence[str]) -> str | None:
    """Warn of frames that the CPU computes although there is a GPU.

    :param name: What OpenGL calls its renderer
    :param gpus: Names of the GPUs of this machine
    :return: The warning, or None
    """
    if not is_software_renderer(name) or not gpus:
        return None
    remedy = MESA_GL if gpus[0].startswith(tuple(MESA_VENDORS.values())) else NVIDIA_GL
    return f"OpenGL renders on the CPU ({name}), although there is a GPU ({gpus[0]}): {remedy}."


def measure_rendering(frames: int = 15) -> dict[str, Any]:
    """Render cartpole at 84 x 84 in this process.

    :param frames: Frames whose median time counts
    :return: ``renderer``, OpenGL's name of it, and by ``"dmc"`` and ``"fast"`` the milliseconds per frame
    :raises GLUnavailableError: If OpenGL is missing
    """
    result: dict[str, Any] = {"renderer": check_gl(), "backend": os.environ.get("MUJOCO_GL", "unset")}
    for renderer in ("dmc", "fast"):
        env = make_dmc_env("cartpole", "swingup", renderer=renderer, seed=0)
        env.reset()  # renders for the first time, which takes longer
        render = env.get_wrapper_attr("frame")
        seconds = []
        for _ in range(frames):
            start = time.perf_counter()
            render()
            seconds.append(time.perf_counter() - start)
        result[renderer] = 1e3 * statistics.median(seconds)
        env.close()
    return result


def try_rendering() -> dict[str, Any]:
    """``measure_rendering`` in a process of its own, as drivers may hang or abort theirs.

    :return: Its result, or ``error``: a sentence
    """
    # Search modules in the same folders as here: the working directory, perhaps with a random.py, must not come first.
    folders = list(map(str, sys.path))  # notebooks add a Path
    program = f"import sys; sys.path[:] = {folders!r}; from sb3_cure.envs import render_check; render_check.main()"
    command = [sys.executable, "-P", "-c", program]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_SECONDS)
    except subprocess.TimeoutExpired:
        return {"error": f"rendering a few frames took longer than {TIMEOUT_SECONDS} s (the driver may hang)"}
    with contextlib.suppress(IndexError, ValueError):
        return json.loads(child.stdout.splitlines()[-1])
    lines = child.stderr.strip().splitlines() or ["it printed nothing"]
    return {"error": f"the process that renders ended with status {child.returncode}: {lines[-1]}"}


def main() -> None:
    """Print the result of ``measure_rendering`` as JSON, in the last line."""
    with contextlib.redirect_stdout(sys.stderr):  # what libraries print must not mix with the answer
        try:
            result = measure_rendering()
        except Exception as error:
            result = {"error": str(error)}
    print(json.dumps(result))
