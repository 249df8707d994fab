"""Files that are written whole or not at all, whatever happens meanwhile."""

import contextlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file beside another, which it replaces in one go when all of it is on the disk.

    Killed, out of disk space or with an exception in between, the old file stays as it was.

    :param path: File to write or to replace, in a folder that exists
    :return: Name to write under meanwhile, in the same folder
    """
    path = Path(path)
    # Another name for each process and machine: several may write the same file.
    beside = path.with_name(f".{path.name}.{platform.node()}.{os.getpid()}")
    try:
        yield beside
        flush_to_disk(beside)
        beside.replace(path)
        flush_to_disk(path.parent)
    finally:
        beside.unlink(missing_ok=True)


def flush_to_disk(path: Path) -> None:
    """
    :param path: File or folder: what was written to it is on the disk after this call
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
