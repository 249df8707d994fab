"""Files that are written whole or not at all."""

import contextlib
import io
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, cast

import filelock
from stable_baselines3.common.save_util import open_path

PathOrFile: TypeAlias = str | Path | io.BufferedIOBase


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file under another name, and rename it to replace the old one when all of it is on the disk.

    After a kill, a full disk or an exception in between, the old file is as it was.

    :param path: File to write or to replace, in a folder that exists
    :return: Name to write under meanwhile, in the same folder
    """
    path = Path(path)
    # Another name for each thread, process and machine: several may write the same file.
    draft = path.with_name(f".{path.name}.{platform.node()}.{os.getpid()}.{threading.get_ident()}")
    try:
        yield draft
        flush_to_disk(draft)
        draft.replace(path)
        flush_to_disk(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def flush_to_disk(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk.

    :param path: File or folder
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def locked(folder: Path, seconds: float) -> Iterator[None]:
    """Hold a folder's lock, which ends with the process. Where the file system has no locks, a warning says so.

    :param folder: A folder that exists
    :param seconds: How long to wait for another process that holds it; -1: for ever
    :raises filelock.Timeout: (an ``OSError``) if that process still holds it then
    """
    # Where the file system has no locks, do not fall back to a lock file, which a kill would leave behind
    lock = filelock.FileLock(folder / ".lock", fallback_to_soft=False)
    try:
        lock.acquire(timeout=seconds)
    except filelock.Timeout:
        raise
    except (OSError, NotImplementedError) as error:
        warnings.warn(f"{folder} cannot be locked ({error}): make sure that nobody else writes there.", stacklevel=4)
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def writing(path: PathOrFile, suffix: str) -> Iterator[BinaryIO]:
    """Open a file for writing; an old file is replaced once the new one is complete.

    :param path: Path (its folder is made, and the suffix added if it has none), or a binary file
    :param suffix: ``"zip"`` or ``"pkl"``
    :return: The open file
    """
    if not isinstance(path, str | Path):
        yield cast(BinaryIO, open_path(path, "w"))
        return
    path = Path(path) if Path(path).suffix else Path(f"{path}.{suffix}")
    path = path.resolve() if path.is_symlink() else path  # what a link leads to is written, not the link
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft, draft.open("wb") as file:
        yield file
        file.flush()


@contextlib.contextmanager
def reading(path: PathOrFile, suffix: str) -> Iterator[tuple[BinaryIO, str]]:
    """Open a file for reading.

    :param path: Path, with or without its suffix, or a binary file
    :param suffix: ``"zip"`` or ``"pkl"``
    :return: The open file, at its start, and what to call it in messages
    """
    file: Any = open_path(path, "r", suffix=suffix)  # type: ignore[arg-type]
    is_path = isinstance(path, str | Path)
    file.seek(0)
    with file if is_path else contextlib.nullcontext():
        yield file, f"'{path}'" if is_path else "the file"
