"""Files that are written whole or not at all, whatever happens meanwhile, and SB3's conventions for their names."""

import contextlib
import errno
import io
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, BinaryIO, TypeAlias

from stable_baselines3.common.save_util import open_path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PathOrFile: TypeAlias = str | Path | io.BufferedIOBase


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file beside another, which it replaces in one go when all of it is on the disk.

    Killed, out of disk space or with an exception in between, the old file stays as it was.

    :param path: File to write or to replace, in a folder that exists
    :return: Name to write under meanwhile, in the same folder
    """
    path = Path(path)
    # Another name for each thread, process and machine: several may write the same file.
    beside = path.with_name(f".{path.name}.{platform.node()}.{os.getpid()}.{threading.get_ident()}")
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


def lock(file: IO[Any], shared: bool = False) -> None:
    """Lock a file, which the end of the process unlocks, however it ends.

    :param file: The open file
    :param shared: Whether others may share the lock
    :raises BlockingIOError: if another process holds it
    :raises OSError: where there are no locks
    """
    if fcntl is None:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
    fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


@contextlib.contextmanager
def writing(path: PathOrFile, suffix: str) -> Iterator[Any]:
    """A file to write to, by SB3's conventions; one at a path is replaced when it is whole.

    :param path: Path, whose folder is made and which gets the suffix if it has none, or a binary file
    :param suffix: ``"zip"`` or ``"pkl"``
    :return: Path to write under meanwhile, or the file
    :raises ValueError: if it is neither
    :raises OSError: if the folder cannot be one
    """
    if not isinstance(path, str | Path):
        yield open_path(_binary_file(path), "w")
        return
    path = Path(path)
    if path.suffix == "":
        path = Path(f"{path}.{suffix}")
    if path.is_dir():
        warnings.warn(f"Path '{path}' is a folder. Will save instead to {path}_2", stacklevel=4)
        path = Path(f"{path}_2")
    path = path.resolve() if path.is_symlink() else path  # what a link leads to is written, not the link
    if not path.parent.exists():
        warnings.warn(f"Path '{path.parent}' does not exist. Will create it.", stacklevel=4)
        path.parent.mkdir(parents=True, exist_ok=True)
    if not path.parent.is_dir():
        raise NotADirectoryError(f"cannot write '{path}', as '{path.parent}' is a file: choose another path.")
    with replacing(path) as beside:
        yield beside


@contextlib.contextmanager
def reading(path: PathOrFile, suffix: str) -> Iterator[tuple[BinaryIO, str]]:
    """
    :param path: Path, with or without its suffix, or a binary file
    :param suffix: ``"zip"`` or ``"pkl"``
    :return: The open file, at its start, and what to call it
    :raises ValueError: if it is neither
    :raises OSError: if there is no such file
    """
    if not isinstance(path, str | Path):
        _binary_file(path)
    elif not any(map(os.path.exists, (path, f"{path}.{suffix}"))):
        raise FileNotFoundError(
            f"there is neither a file '{path}' nor '{path}.{suffix}': give the path that it was saved to."
        )
    elif os.path.isdir(path):
        raise IsADirectoryError(f"'{path}' is a folder: give the path of a file in it.")
    file = open_path(path, "r", suffix=suffix)
    try:
        file.seek(0)
        yield file, f"'{path}'" if isinstance(path, str | Path) else "the file"  # type: ignore[misc]
    finally:
        if isinstance(path, str | Path):
            file.close()


def _binary_file(file: Any) -> io.BufferedIOBase:
    if not isinstance(file, io.BufferedWriter | io.BufferedReader | io.BytesIO | io.BufferedRandom):
        raise ValueError(f"got {file!r:.100} for a file, but expected a path, or a file that is open in binary mode.")
    return file
