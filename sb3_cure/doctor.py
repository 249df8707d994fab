"""``sb3-cure doctor``: what this machine has, which choices follow from it, and what to install.

The exit status is 0 where training can work, else 1; what is only slow or optional is a warning or a remark.
"""

import argparse
import contextlib
import json
import os
import platform
import statistics
import subprocess
import sys
import textwrap
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from packaging.requirements import Requirement

from sb3_cure.buffers import FrameStackReplayBuffer
from sb3_cure.precision import resolve_compile, resolve_precision

PACKAGE = "sb3-cure"
#: Extras that users may want, and for what; the remaining ones are for developing sb3_cure
EXTRAS = {
    "demo": "plots, videos, TensorBoard, progress bars",
    "zoo": "training and tuning from YAML files",
    "experiments": "grids of experiments and their report",
    "cluster": "the same on several machines",
    "notebooks": "running the notebooks",
}
#: What Mesa's renderers that compute on the CPU call themselves
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
#: Where Linux lists what can draw
DRM = Path("/sys/class/drm")
RENDERING_TIMEOUT = 180


@dataclass
class Report:
    """What the doctor found.

    :param sections: Lines (label, text) by heading
    :param errors: What keeps training from working, each with its remedy
    :param warnings: What makes it slow, each with its remedy
    """

    sections: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        width = max((len(label) for lines in self.sections.values() for label, _ in lines), default=0)
        text = []
        for heading, lines in self.sections.items():
            text += [heading, *(f"  {label:<{width}}  {value}" for label, value in lines), ""]
        text += [f"ERROR    {error}" for error in self.errors]
        text += [f"WARNING  {warning}" for warning in self.warnings]
        text.append("Training cannot work here yet." if self.errors else "Training can work here.")
        return "\n".join(text)


# ------------------------------------------------------------------- software


def requirements(extra: str = "") -> list[Requirement]:
    """
    :param extra: An extra of sb3-cure; "" for what every installation needs
    :return: What it needs beyond that, other extras of its own unfolded; nothing if sb3-cure is not installed
    """
    try:
        lines = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return []
    found = []
    for requirement in map(Requirement, lines):
        always = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        applies = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        if not applies or (extra and always):
            continue
        if requirement.name == PACKAGE:
            found += [inner for name in sorted(requirement.extras) for inner in requirements(name)]
        else:
            found.append(requirement)
    return found


def unmet(needed: Sequence[Requirement]) -> list[str]:
    """
    :param needed: Requirements
    :return: Those that the installed packages do not meet, in words
    """
    problems = []
    for requirement in needed:
        version = _version(requirement.name)
        if version is None:
            problems.append(f"{requirement.name} is missing")
        elif not requirement.specifier.contains(version, prereleases=True):
            problems.append(f"{requirement.name} is {version}, but needs {requirement.specifier}")
    return problems


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _check_software(report: Report) -> None:
    needed = requirements()
    versions = [(package.name, _version(package.name) or "missing") for package in needed]
    report.sections["Software"] = [
        ("Python", f"{platform.python_version()} ({sys.executable})"),
        (PACKAGE, _version(PACKAGE) or "not installed, run from its sources"),
        *versions,
    ]
    if problems := unmet(needed):
        # By name and range, as sb3-cure itself may come from anywhere.
        install = " ".join(f'"{package}"' for package in needed if unmet([package]))
        report.errors.append(f"{'; '.join(problems)}: pip install {install}")
    report.sections["Extras"] = []
    for extra, purpose in EXTRAS.items():
        needed = requirements(extra)
        problems = unmet(needed)
        state = f'{"; ".join(problems)}: pip install "{PACKAGE}[{extra}]"' if problems else "complete"
        report.sections["Extras"].append((extra, f"{state} ({purpose})"))
        names = sorted({each.name for each in needed})
        # Parted between packages, not before a version.
        installed = [f"{name}\xa0{version}" for name in names if (version := _version(name))]
        lines = textwrap.wrap(", ".join(installed), 100, break_on_hyphens=False)
        report.sections["Extras"] += [("", line.replace("\xa0", " ")) for line in lines]


# ------------------------------------------------------------------- hardware


def find_gpus() -> list[str]:
    """
    :return: Names of the GPUs that torch can use, or else of those that NVIDIA's driver knows, and of AMD's and Intel's
    """
    if th.cuda.is_available():
        return [th.cuda.get_device_name(i) for i in range(th.cuda.device_count())]
    names = []
    for path in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        fields = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
        names.append(fields.get("Model", "NVIDIA GPU").strip())
    for path in sorted(DRM.glob("renderD*/device/vendor")):
        if vendor := MESA_VENDORS.get(path.read_text().strip()):
            names.append(f"{vendor} GPU")
    return names


def _is_mesas(gpu: str) -> bool:
    return gpu.startswith(tuple(MESA_VENDORS.values()))


def cpu_features() -> dict[str, bool]:
    """
    :return: Whether the CPU has what counts for the speed of the networks
    """

    def has(name: str) -> bool:
        probe = getattr(th.cpu, name, None)  # private in torch, hence perhaps gone one day
        return probe is not None and bool(probe())

    return {
        "AVX512": has("_is_avx512_supported"),
        "AVX512-bf16": has("_is_avx512_bf16_supported"),
        "AMX": has("_is_amx_tile_supported"),
    }


def explain_precision(precision: str, device: th.device) -> str:
    """
    :param precision: What ``"auto"`` became: ``"fp32"`` or ``"bf16"``
    :param device: On this device
    :return: The choice and its reason
    """
    what = "GPU" if device.type == "cuda" else "CPU"
    reason = f"this {what} computes it natively" if precision == "bf16" else f"this {what} would emulate bf16, slowly"
    return f"{precision} ({reason})"


def available_memory() -> int | None:
    """
    :return: Bytes that this process may still take, as far as the system says
    """
    limits = []
    with contextlib.suppress(OSError, ValueError):
        meminfo = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        limits.append(1024 * int(meminfo["MemAvailable"].split()[0]))
    with contextlib.suppress(OSError, ValueError):  # a container may have less than its machine
        group = Path("/sys/fs/cgroup")
        used = int((group / "memory.current").read_text())
        limits.append(int((group / "memory.max").read_text()) - used)
    return min(limits) if limits else None


def default_buffer_bytes() -> int:
    """
    :return: Bytes of the default replay buffer, full: 80 000 transitions of three frames of 84 x 84
    """
    with warnings.catch_warnings():  # it warns itself where memory is short
        warnings.simplefilter("ignore")
        observations, actions = spaces.Box(0, 255, (9, 84, 84), np.uint8), spaces.Box(-1, 1, (6,), np.float32)
        return FrameStackReplayBuffer(80_000, observations, actions, frame_stack=3).nbytes


def judge_memory(available: int | None, needed: int) -> str | None:
    """
    :param available: Bytes that are available, None if unknown
    :param needed: Bytes of the default replay buffer
    :return: A warning, or None if it fits
    """
    if available is None or available > needed:
        return None
    return (
        f"the default replay buffer needs {needed / 1e9:.1f} GB, but {available / 1e9:.1f} GB are available: make "
        'buffer_size smaller, or keep its frames on a disk (replay_buffer_kwargs=dict(frames_dir="/some/disk")).'
    )


def _check_hardware(report: Report, gpus: Sequence[str]) -> None:
    device = th.device("cuda" if th.cuda.is_available() else "cpu")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    features = ", ".join(name if has else f"no {name}" for name, has in cpu_features().items())
    available, needed = available_memory(), default_buffer_bytes()
    memory = "unknown" if available is None else f"{available / 1e9:.1f} GB available"
    report.sections["Hardware"] = [
        ("device", str(device)),
        ("GPU", ", ".join(gpus) or "none found"),
        ("CPU", f"{cores} cores, torch uses {th.get_num_threads()} threads; {features}"),
        (
            "memory",
            f"{memory}; the default replay buffer takes up to {needed / 1e9:.1f} GB (80 000 transitions, 84 px)",
        ),
    ]
    report.sections["Choices"] = [
        ('precision="auto"', explain_precision(resolve_precision("auto", device), device)),
        ('compile="auto"', resolve_compile("auto", device)[1]),
    ]
    unused = [gpu for gpu in gpus if not _is_mesas(gpu)]
    if unused and device.type == "cpu":
        report.warnings.append(
            f"there is a GPU ({unused[0]}), but torch {th.__version__} cannot use it: install torch's CUDA build, as "
            "https://pytorch.org/get-started says for this machine."
        )
    if warning := judge_memory(available, needed):
        report.warnings.append(warning)


# ------------------------------------------------------------------ rendering


def is_software_renderer(name: str) -> bool:
    """
    :param name: What OpenGL calls its renderer
    :return: Whether it computes on the CPU
    """
    return any(software in name.lower() for software in SOFTWARE_RENDERERS)


def judge_renderer(name: str, gpus: Sequence[str]) -> str | None:
    """
    :param name: What OpenGL calls its renderer
    :param gpus: Names of the GPUs of this machine
    :return: A warning if frames are computed by the CPU although there is a GPU, else None
    """
    if not is_software_renderer(name) or not gpus:
        return None
    remedy = MESA_GL if _is_mesas(gpus[0]) else NVIDIA_GL
    return f"OpenGL renders on the CPU ({name}), although there is a GPU ({gpus[0]}): {remedy}."


def measure_rendering(frames: int = 15) -> dict[str, Any]:
    """Render cartpole at 84 x 84 in this process.

    :param frames: Frames whose median time counts
    :return: ``renderer``, OpenGL's name of it, and by ``"dmc"`` and ``"fast"`` the milliseconds per frame
    :raises GLUnavailableError: If OpenGL is missing
    """
    from sb3_cure.envs import make_dmc_env
    from sb3_cure.envs.rendering import check_gl

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
    # Where modules are found is as here: the working directory, with a random.py perhaps, is not to come first.
    folders = list(map(str, sys.path))  # notebooks add a Path
    program = f"import sys; sys.path[:] = {folders!r}; from sb3_cure import doctor; doctor.main(['--render'])"
    command = [sys.executable, "-P", "-c", program]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=RENDERING_TIMEOUT)
    except subprocess.TimeoutExpired:
        return {"error": f"rendering a few frames took longer than {RENDERING_TIMEOUT} s (the driver may hang)"}
    with contextlib.suppress(IndexError, ValueError):
        return json.loads(child.stdout.splitlines()[-1])
    lines = child.stderr.strip().splitlines() or ["it printed nothing"]
    return {"error": f"the process that renders ended with status {child.returncode}: {lines[-1]}"}


def _check_rendering(report: Report, gpus: Sequence[str]) -> None:
    result = try_rendering()
    if "error" in result:
        report.sections["Rendering"] = [("OpenGL", "does not work, see below")]
        report.errors.append(result["error"])
        return
    name = result["renderer"]
    kind = "on the CPU" if is_software_renderer(name) else "on the GPU"
    times = f'{result["dmc"]:.1f} (renderer="dmc"), {result["fast"]:.1f} (renderer="fast")'
    report.sections["Rendering"] = [
        ("OpenGL", f"{name}, {kind} (MUJOCO_GL={result['backend']})"),
        ("ms per frame", f"{times}; cartpole, 84 px"),
    ]
    if warning := judge_renderer(name, gpus):
        report.warnings.append(warning)


# ---------------------------------------------------------------- command line


def examine() -> Report:
    """
    :return: Everything that the doctor looks at; takes some seconds
    """
    report = Report()
    gpus = find_gpus()
    _check_software(report)
    _check_hardware(report, gpus)
    _check_rendering(report, gpus)
    return report


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Command line, ``sys.argv[1:]`` by default
    :return: 0 where training can work, else 1
    """
    parser = argparse.ArgumentParser("sb3-cure doctor", description=__doc__)
    parser.add_argument("--render", action="store_true", help=argparse.SUPPRESS)
    if parser.parse_args(argv).render:
        with contextlib.redirect_stdout(sys.stderr):  # what libraries print must not mix with the answer
            try:
                result = measure_rendering()
            except Exception as error:
                result = {"error": str(error)}
        print(json.dumps(result))
        return 0
    report = examine()
    print(report)
    return 1 if report.errors else 0


if __name__ == "__main__":
    sys.exit(main())
