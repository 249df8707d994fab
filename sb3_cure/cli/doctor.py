"""``sb3-cure doctor``: show this machine, the choices that follow from it, and what to install.

The exit status is 0 if training can work, else 1; things that are only slow are warnings.
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
from sb3_cure.cli.usage import install_command
from sb3_cure.envs.render_check import find_gpus, is_software_renderer, judge_renderer, try_rendering
from sb3_cure.networks.precision import resolve_precision

PACKAGE = "sb3-cure"
#: Observations for which precision="auto" is shown
IMAGES = spaces.Box(0, 255, (3, 84, 84), np.uint8)
#: Purpose of each extra; the other extras are for developing sb3_cure
EXTRAS = {
    "demo": "plots, videos, TensorBoard, progress bars",
    "zoo": "training and tuning from YAML files",
    "experiments": "grids of experiments and their report",
    "cluster": "the same on several machines",
    "notebooks": "running the notebooks",
}


def needed_packages() -> dict[str, list[str]]:
    """Names of the packages that sb3-cure needs.

    :return: Names by extra; by ``""`` those that every installation needs
    """
    needed = defaultdict(list)
    for line in (metadata.requires(PACKAGE) or []) if installed_version(PACKAGE) else []:  # else run from its sources
        name = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name and name[0] != PACKAGE:
            needed[extra[1] if extra else ""].append(name[0])
    return needed


def installed_version(package: str) -> str | None:
    """Version of a package.

    :param package: Its name
    :return: The version, None if it is not installed
    """
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def check_packages(names: Sequence[str]) -> tuple[str, list[str]]:
    """Look up packages.

    :param names: Names of packages
    :return: The installed ones with their versions, in one line; and the names of the missing ones
    """
    versions = {name: installed_version(name) for name in names}
    line = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    return line, [name for name, version in versions.items() if version is None]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command ``sb3-cure doctor``.

    :param argv: Command line, ``sys.argv[1:]`` by default
    :return: 0 if training can work, else 1
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
        install = f"; missing: {', '.join(missing)} ({install_command(extra)})" if missing else ""
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
