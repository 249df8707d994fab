"""Algorithms and YAML files of the package by name, such as ``fast/cure_sac_ae``."""

from pathlib import Path
from typing import Any

from sb3_cure.cure.algorithms import CuReSAC, CuReTQC

#: Algorithms by their name for ``--algo`` and in grids
ALGORITHMS: dict[str, Any] = {"cure_sac": CuReSAC, "cure_tqc": CuReTQC}
#: Settings of methods, for ``sb3-cure train --conf-file`` and for grids
ZOO = Path(__file__).parents[1] / "zoo_configs"
#: Grids, for ``sb3-cure experiment``
GRIDS = ZOO / "experiments"


def zoo_file(name: str | Path, folder: Path = ZOO) -> Path:
    """Find a YAML file.

    :param name: A file of the package by its path in ``folder`` without suffix, or the path of any other with suffix
    :param folder: ``ZOO`` or ``GRIDS``
    :return: Path of the file; one with a suffix is returned as it is, whether it exists or not
    :raises ValueError: with the known names, for an unknown one
    """
    path = Path(name)
    if path.suffix:
        return path
    files = [*sorted(folder.glob("*.yml")), *sorted(folder.glob("fast/*.yml"))]
    known = {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}
    if path.as_posix() not in known:
        raise ValueError(
            f"{str(name)!r} is neither the path of a YAML file nor one of the package's: {', '.join(known)}."
        )
    return known[path.as_posix()]
