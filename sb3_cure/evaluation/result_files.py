"""Files of results, written whole or not at all, and the versions, machine and commit that made them."""

import csv
import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch as th

import sb3_cure
from sb3_cure.persistence.files import replacing

Row = dict[str, Any]
#: Packages that decide what is computed: algorithms, physics, pixels
_DEPENDENCIES = ("stable_baselines3", "sb3_contrib", "torch", "numpy", "gymnasium", "shimmy", "dm_control", "mujoco")


def describe_run() -> dict[str, Any]:
    """Describe the conditions under which a result is made.

    :return: Versions, machine, GPU and commit
    """
    return {
        "versions": {
            "python": platform.python_version(),
            "sb3_cure": sb3_cure.__version__,
            **{name: version(name) for name in _DEPENDENCIES},
        },
        "machine": f"{processor()}, {th.get_num_threads()} threads, {th.backends.cpu.get_cpu_capability()}",
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
        "commit": _COMMIT,
    }


def cpu_info() -> dict[str, str]:
    """Read Linux's description of the first processor.

    :return: Values by field; empty on other systems
    """
    info = Path("/proc/cpuinfo")
    lines = info.read_text().split("\n\n")[0].splitlines() if info.exists() else []
    return {name.strip(): value.strip() for name, value in (line.split(":", 1) for line in lines)}


def processor() -> str:
    """Name the processor, with its family and model: several generations may have one name.

    :return: The name
    """
    info = cpu_info()
    if "model name" not in info:
        return platform.machine()
    numbers = [f"{field.removeprefix('cpu ')} {info[field]}" for field in ("cpu family", "model") if field in info]
    return ", ".join([info["model name"], *numbers])


def code_commit() -> str | None:
    """Find the commit of the running code.

    :return: Commit of the package's checkout, marked if it has changes; None if it is none
    """
    return checkout_commit(Path(sb3_cure.__file__).parent.parent)


def checkout_commit(folder: Path) -> str | None:
    """Find the commit of a checkout.

    :param folder: Its uppermost folder
    :return: Its commit, marked if it has changes; None if it is no checkout
    """
    if not (folder / ".git").exists():  # git would look in the folders above
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


# At import, as the checkout may be updated later
_COMMIT = code_commit()


def read_rows(path: Path) -> list[Row]:
    """Read a CSV file.

    :param path: The file
    :return: Its rows; numbers as int or float, missing values as ``""``
    """
    with path.open(newline="") as file:
        return [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(file)]


def _number(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    :param path: File to write
    :param text: Its content
    """
    with replacing(path) as draft:
        draft.write_text(text)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all.

    :param path: File to write
    :param content: Its content; values unknown to JSON are written as strings
    """
    write_text(path, json.dumps(content, indent=2, default=str) + "\n")


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    """Write a CSV file, whole or not at all.

    :param path: File to write
    :param columns: The header, and the order of the values
    :param rows: Mappings that have all columns
    """
    lines = [columns, *([row[column] for column in columns] for row in rows)]
    with replacing(path) as draft, draft.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
