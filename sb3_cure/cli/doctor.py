"""``sb3-cure doctor``: what this machine has, which choices follow from it, and what to install.

The exit status is 0 where training can work, else 1; what is only slow is a warning.
"""

import argparse
import re
from collections import defaultdict
from collections.abc import Sequence
from importlib import metadata

import numpy as np
import torch as th
from gymnasium import spaces
from torch.utils import collect_env

from sb3_cure import __version__
from sb3_cure.envs.render_check import find_gpus, is_software_renderer, judge_renderer, try_rendering
from sb3_cure.networks.precision import resolve_precision

PACKAGE = "sb3-cure"
#: What networks compute in bf16 where they can
IMAGES = spaces.Box(0, 255, (3, 84, 84), np.uint8)
#: Extras that users may want, and for what; the remaining ones are for developing sb3_cure
EXTRAS = {
    "demo": "plots, videos, TensorBoard, progress bars",
    "zoo": "training and tuning from YAML files",
    "experiments": "grids of experiments and their report",
    "cluster": "the same on several machines",
    "notebooks": "running the notebooks",
}


def needed_packages() -> dict[str, list[str]]:
    """
    :return: Names of the packages that sb3-cure needs, by extra; by ``""`` those that every installation needs
    """
    needed = defaultdict(list)
    lines = metadata.requires(PACKAGE) if installed_version(PACKAGE) else None  # None: run from its sources
    for line in lines or []:
        name = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name and name[0] != PACKAGE:
            needed[extra[1] if extra else ""].append(name[0])
    return needed


def installed_version(package: str) -> str | None:
    """
    :param package: Name of a package
    :return: Its version, None if it is not installed
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def check_packages(names: Sequence[str]) -> tuple[str, list[str]]:
    """
    :param names: Names of packages
    :return: Those that are installed, with their versions, in one line; and the names of those that are missing
    """
    versions = {name: installed_version(name) for name in names}
    line = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return line, [name for name, version in versions.items() if version is None]


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Command line, ``sys.argv[1:]`` by default
    :return: 0 where training can work, else 1
    """
    argparse.ArgumentParser("sb3-cure doctor", description=__doc__).parse_args(argv)
    errors, warnings = [], []
    print(collect_env.get_pretty_env_info())

    needed = needed_packages()
    line, missing = check_packages(needed[""])
    print(f"\n{PACKAGE} {__version__} with {line}")
    if missing:
        errors.append(f"missing: {', '.join(missing)}; pip install {' '.join(missing)}")
    for extra, purpose in EXTRAS.items():
        line, missing = check_packages(needed[extra])
        install = f'; missing: {", ".join(missing)} (pip install "{PACKAGE}[{extra}]")' if missing else ""
        print(f"{extra} ({purpose}): {line}{install}")

    device = th.device("cuda" if th.cuda.is_available() else "cpu")
    gpus = find_gpus()
    print(f"\nGPUs: {', '.join(gpus) or 'none'}; torch computes on {device} with {th.get_num_threads()} threads")
    print(f'precision="auto": {resolve_precision("auto", device, IMAGES)}')
    if device.type == "cpu" and any(gpu.startswith("NVIDIA") for gpu in gpus):
        warnings.append("torch cannot use the GPU: install its CUDA build, see https://pytorch.org/get-started")

    rendering = try_rendering()
    if "error" in rendering:
        errors.append(rendering["error"])
    else:
        name = rendering["renderer"]
        print(f"OpenGL: {name}, on the {'CPU' if is_software_renderer(name) else 'GPU'}", end="")
        print(f" (MUJOCO_GL={rendering['backend']})")
        print(f'Milliseconds per frame of 84 x 84: {rendering["dmc"]:.1f} (renderer="dmc"), ', end="")
        print(f'{rendering["fast"]:.1f} (renderer="fast")')
        if warning := judge_renderer(name, gpus):
            warnings.append(warning)

    print("", *(f"ERROR    {error}" for error in errors), *(f"WARNING  {warning}" for warning in warnings), sep="\n")
    print("Training cannot work here yet." if errors else "Training can work here.")
    return 1 if errors else 0
