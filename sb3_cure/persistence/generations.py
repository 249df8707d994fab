"""Folder of checkpoints, of which a kill, a full disk or a damaged file costs the last one at most.

Layout::

    path/
        generation-000003/     one checkpoint: its own files, and SHA256SUMS, which lists all files that it needs
        generation-000004/
        segments/              files that several generations share and that are never changed

A generation is written under another name, flushed to the disk file by file, and renamed when all of it is there. It is
whole if its files have the checksums of ``SHA256SUMS`` (which ``sha256sum -c`` understands).
"""

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sb3_cure.persistence.encoding import ArchiveError
from sb3_cure.persistence.files import flush_to_disk

_NAME = re.compile(r"generation-(\d{6,})")
_SUM = re.compile(r"([0-9a-f]{64})  (\S+)")
_SUMS = "SHA256SUMS"
_SEGMENT = "../segments/"


class CheckpointError(ArchiveError):
    """A checkpoint cannot be written or read; the message says what to do."""


class Generation(NamedTuple):
    """A checkpoint and its checksums.

    :param folder: Where its own files lie
    :param sums: SHA-256 of each file that it needs, by path from there
    """

    folder: Path
    sums: dict[str, str]

    def damaged(self) -> list[Path]:
        """List the files that are not as they were written.

        :return: Their paths
        """
        return [self.folder / name for name, digest in self.sums.items() if _digest(self.folder / name) != digest]


class Generations:
    """The checkpoints in a folder.

    :param path: The folder
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.segments = self.path / "segments"
        self._newest = max(self.numbers(), default=-1)

    def numbers(self) -> list[int]:
        """List the generations that were finished, whole or damaged since.

        :return: Their numbers, oldest first
        """
        if not self.path.is_dir():
            return []
        matches = [_NAME.fullmatch(path.name) for path in self.path.iterdir()]
        return sorted(int(match[1]) for match in matches if match)

    def folder(self, number: int) -> Path:
        """Get the folder of a generation.

        :param number: Number of the generation
        :return: Its path
        """
        return self.path / f"generation-{number:06d}"

    def read(self, number: int) -> Generation:
        """Read the checksums of a generation.

        :param number: Number of the generation
        :return: Generation, its files unread
        :raises CheckpointError: if its checksums are missing or damaged
        """
        path = self.folder(number) / _SUMS
        try:
            lines = path.read_text().removesuffix("\n").split("\n")
        except (OSError, UnicodeError) as error:
            raise CheckpointError(f"{path} cannot be read ({type(error).__name__})") from error
        matches = [_SUM.fullmatch(line) for line in lines]
        sums = {match[2]: match[1] for match in matches if match}
        own = {entry.name for entry in path.parent.iterdir()} - {_SUMS}
        # The own files come last: where they are there, no line is missing.
        if not all(matches) or not own <= sums.keys() or not own:
            raise CheckpointError(f"{path} is damaged")
        return Generation(path.parent, sums)

    def write(self, fill: Callable[[Path, int], dict[str, str]], keep: int) -> Generation:
        """Write the next generation, then remove what is no longer needed.

        :param fill: Writes files into the folder that it gets, and segments with the number that it gets in their
            names; returns the checksums of the segments that it needs, by name
        :param keep: Number of latest generations to keep
        :return: What was written
        :raises OSError: if it could not be written; the generations are then as before
        :raises CheckpointError: if another training has written here since
        """
        if max(self.numbers(), default=-1) != self._newest:
            raise CheckpointError(
                f"another training writes checkpoints to {self.path}: end it, or choose another path."
            )
        number = self._newest + 1
        draft = self.path / f".unfinished-{number}-{os.getpid()}"
        shutil.rmtree(draft, ignore_errors=True)
        try:
            self.segments.mkdir(exist_ok=True)
            draft.mkdir()
            segments = fill(draft, number)
            own = sorted(draft.iterdir())
            sums = {f"{_SEGMENT}{name}": digest for name, digest in segments.items()}
            sums |= {path.name: str(_digest(path)) for path in own}
            (draft / _SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()))
            for path in (*own, draft / _SUMS, draft, self.segments):
                flush_to_disk(path)
            draft.rename(self.folder(number))
            self._newest = number
            flush_to_disk(self.path)
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            self._remove_all_but(keep)
            raise
        self._remove_all_but(keep)
        return Generation(self.folder(number), sums)

    def _remove_all_but(self, keep: int) -> None:
        """Remove older generations and what no generation needs; what could not be removed is removed the next time."""
        # Where the checksums of one cannot be read, it is not known which segments it needs.
        with contextlib.suppress(OSError, CheckpointError):
            numbers = self.numbers()
            for number in numbers[:-keep]:
                # Renamed first, so that what is half removed does not look like a damaged generation.
                gone = self.path / f".removed-{number}"
                shutil.rmtree(gone, ignore_errors=True)
                self.folder(number).rename(gone)
            for leftover in (*self.path.glob(".removed-*"), *self.path.glob(".unfinished-*")):
                shutil.rmtree(leftover, ignore_errors=True)
            needed = {name for number in numbers[-keep:] for name in self.read(number).sums}
            for path in self.segments.iterdir():
                if f"{_SEGMENT}{path.name}" not in needed:
                    path.unlink(missing_ok=True)


def _digest(path: Path) -> str | None:
    """SHA-256 in hexadecimal digits; None if the file cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
