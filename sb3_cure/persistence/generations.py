"""Folder of checkpoints: a kill, a full disk or a damaged file costs the last one at most.

Layout::

    path/
        generation-000003/     one checkpoint: its own files, and SHA256SUMS, which lists all files that it needs
        generation-000004/
        segments/              files that several generations share and that are never changed
        .lock                  held while one is written

A generation is written under another name, flushed to the disk file by file, and renamed when all of it is there. It is
whole if its files have the checksums of ``SHA256SUMS`` (which ``sha256sum -c`` understands).
"""

import contextlib
import hashlib
import re
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sb3_cure.persistence.encoding import ArchiveError
from sb3_cure.persistence.files import flush_to_disk

_NAME = re.compile(r"generation-(\d{6,})")
_SUM = re.compile(r"([0-9a-f]{64})  (\S+)")
_SUMS = "SHA256SUMS"


class CheckpointError(ArchiveError):
    """A checkpoint cannot be written or read; the message says what to do."""


class Draft(NamedTuple):
    """A generation that is being written.

    :param number: Its number
    :param folder: Where to write its own files
    :param sums: Takes the checksums of the segments that it needs, by path from the folder
    """

    number: int
    folder: Path
    sums: dict[str, str]


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

    def newest_whole(self) -> Path:
        """Find the newest generation whose files are as they were written, with a warning if others are newer.

        :return: Its folder
        :raises CheckpointError: if there is none
        """
        reasons: list[str] = []
        for number in reversed(self.numbers()):
            folder = self.folder(number)
            try:
                damaged = [name for name, digest in _read_sums(folder).items() if _digest(folder / name) != digest]
            except CheckpointError as error:
                reasons.append(str(error))
                continue
            if not damaged:
                if reasons:
                    warnings.warn(f"{'; '.join(reasons)}. Resuming from {folder.name} instead.", stacklevel=3)
                return folder
            reasons += [f"{folder / name} is damaged or missing" for name in damaged]
        if not reasons:
            raise CheckpointError(f"there is no checkpoint in {self.path}: give the folder of an ExactCheckpoint.")
        raise CheckpointError(f"no checkpoint in {self.path} is whole ({'; '.join(reasons)}): start anew.")

    @contextlib.contextmanager
    def writing(self, keep: int) -> Iterator[Draft]:
        """Write the next generation, then remove what is no longer needed.

        :param keep: Number of latest generations to keep
        :return: What to fill
        :raises OSError: if it could not be written; the generations are then as before
        :raises CheckpointError: if another training has written here since
        """
        numbers = self.numbers()
        if numbers and numbers[-1] != self._newest:  # none: they have been removed
            raise CheckpointError(
                f"another training writes checkpoints to {self.path}: end it, or choose another path."
            )
        draft = Draft(self._newest + 1, self.path / f".unfinished-{self._newest + 1}", {})
        try:
            shutil.rmtree(draft.folder, ignore_errors=True)
            self.segments.mkdir(exist_ok=True)
            draft.folder.mkdir()
            yield draft
            own = sorted(draft.folder.iterdir())
            sums = {**draft.sums, **{path.name: _digest(path) for path in own}}
            (draft.folder / _SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()))
            for path in (*own, draft.folder / _SUMS, draft.folder, self.segments):
                flush_to_disk(path)
            draft.folder.rename(self.folder(draft.number))
            self._newest = draft.number
            flush_to_disk(self.path)
        finally:
            # If writing failed, no generation is removed: the newest one may be damaged.
            self._remove_all_but(keep if self._newest == draft.number else len(self.numbers()))

    def _remove_all_but(self, keep: int) -> None:
        """Remove older generations and what no generation needs; what could not be removed is removed the next time."""
        # If the checksums of a generation cannot be read, no segment is removed: which ones it needs is unknown.
        with contextlib.suppress(OSError, CheckpointError):
            numbers = self.numbers()
            for folder in (*map(self.folder, numbers[:-keep]), *self.path.glob(".unfinished-*")):
                shutil.rmtree(folder, ignore_errors=True)
            needed = {Path(name).name for number in numbers[-keep:] for name in _read_sums(self.folder(number))}
            for path in self.segments.iterdir():
                if path.name not in needed:
                    path.unlink(missing_ok=True)


def _read_sums(folder: Path) -> dict[str, str]:
    """Read the checksums of a generation.

    :param folder: Its folder
    :return: SHA-256 of each file that it needs, by path from there
    :raises CheckpointError: if they are missing or damaged
    """
    path = folder / _SUMS
    try:
        lines = path.read_text().removesuffix("\n").split("\n")
    except (OSError, UnicodeError) as error:
        raise CheckpointError(f"{path} cannot be read ({type(error).__name__})") from error
    matches = [_SUM.fullmatch(line) for line in lines]
    sums = {match[2]: match[1] for match in matches if match}
    own = {entry.name for entry in folder.iterdir()} - {_SUMS}
    # A generation's own files are listed last: if they are there, no line is missing.
    if not all(matches) or not own <= sums.keys() or not own:
        raise CheckpointError(f"{path} is damaged")
    return sums


def _digest(path: Path) -> str | None:
    """SHA-256 in hexadecimal digits; None if the file cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
