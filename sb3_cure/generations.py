"""A folder of checkpoints that a kill, a full disk or a damaged file cannot cost more than the last one of.

Layout::

    path/
        generation-000003/     one checkpoint: its own files, and manifest.json, which lists all it needs
        generation-000004/
        segments/              files that several generations share and that are never changed
        .lock                  held while a process writes

A generation is written under another name, flushed to the disk file by file, and renamed when all of it is there.
The manifest has the size and the SHA-256 of every file; a generation is whole if they agree.
"""

import contextlib
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sb3_cure.files import flush_to_disk, lock
from sb3_cure.serialization import ArchiveError

#: Bytes that are read or written at once
CHUNK = 2**22
#: A manifest lists some dozens of files; what is larger is no manifest
MAX_MANIFEST = 2**24
T = TypeVar("T")
_NAME = re.compile(r"generation-(\d{6,})")
_MEMBER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


class CheckpointError(ArchiveError):
    """A checkpoint cannot be written or read; the message says what to do."""


class Entry(NamedTuple):
    """A file of a generation: its name, its size in bytes, and its SHA-256 as hexadecimal digits."""

    name: str
    size: int
    sha256: str


class Generation(NamedTuple):
    """A checkpoint as its manifest describes it.

    :param number: Its number; later ones have higher numbers
    :param folder: Where its own files lie
    :param files: Its own files
    :param segments: Files that it shares, in ``segments/``
    :param about: What the writer noted
    """

    number: int
    folder: Path
    files: list[Entry]
    segments: list[Entry]
    about: dict[str, Any]


class Generations:
    """The checkpoints in a folder.

    :param path: The folder
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.segments = self.path / "segments"

    # ---------------------------------------------------------------- reading

    def numbers(self) -> list[int]:
        """
        :return: Numbers of the generations that were finished, whole or damaged since, oldest first
        """
        if not self.path.is_dir():
            return []
        matches = [_NAME.fullmatch(path.name) for path in self.path.iterdir()]
        return sorted(int(match[1]) for match in matches if match)

    def folder(self, number: int) -> Path:
        """
        :param number: Number of a generation
        :return: Its folder
        """
        return self.path / f"generation-{number:06d}"

    def read(self, number: int) -> Generation:
        """Read a manifest, without looking at the files that it lists.

        :param number: Number of a generation
        :return: What the manifest says
        :raises CheckpointError: if there is no manifest, or it is damaged
        """
        folder = self.folder(number)
        path = folder / "manifest.json"
        try:
            if path.stat().st_size > MAX_MANIFEST:
                raise CheckpointError(f"{path} has {path.stat().st_size} bytes, more than a manifest can have")
            signed = json.loads(path.read_bytes())
            content = signed["manifest"]
            if signed["sha256"] != _sha256_of(content):
                raise CheckpointError(f"{path} is damaged")
            files, segments = ([Entry(*entry) for entry in content[key]] for key in ("files", "segments"))
            about = dict(content["about"])
        except CheckpointError:
            raise
        except OSError as error:
            raise CheckpointError(f"{path} cannot be read ({error.strerror})") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise CheckpointError(f"{path} is damaged") from error
        for entry in (*files, *segments):
            if not (isinstance(entry.name, str) and _MEMBER.fullmatch(entry.name)):
                raise CheckpointError(f"{path} lists a file named {entry.name!r}, outside its folder")
        return Generation(number, folder, files, segments, about)

    def damaged(self, generation: Generation) -> list[tuple[Path, str]]:
        """Read every file that a generation needs.

        :param generation: A generation
        :return: The files that are not as they were written, each with what is wrong
        """
        places = [(generation.folder, generation.files), (self.segments, generation.segments)]
        faults = []
        for folder, entries in places:
            for entry in entries:
                fault = _fault(folder / entry.name, entry)
                if fault is not None:
                    faults.append((folder / entry.name, fault))
        return faults

    # ---------------------------------------------------------------- writing

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Nobody else writes meanwhile; the lock goes with the process, however that ends.

        :raises CheckpointError: if another process writes here
        """
        with (self.path / ".lock").open("w") as file:
            try:
                lock(file)
            except BlockingIOError:
                raise CheckpointError(
                    f"another process writes checkpoints to {self.path}: wait for it, or choose another path."
                ) from None
            except OSError:
                pass  # a system without locks
            yield

    def write(self, fill: Callable[["Draft"], dict[str, Any]], keep: int) -> Generation:
        """Write the next generation, then remove what is no longer needed.

        :param fill: Writes the files through the draft that it gets, and returns what to note in the manifest
        :param keep: Number of latest generations to keep
        :return: What was written
        :raises OSError: if it could not be written; everything is then as before
        """
        numbers = self.numbers()
        number = numbers[-1] + 1 if numbers else 0
        self.segments.mkdir(exist_ok=True)
        with ThreadPoolExecutor(max_workers=1) as background:
            draft = Draft(self, number, background)
            try:
                about = fill(draft)
                files = [draft.seal(path) for path in sorted(draft.folder.iterdir())]
                content = {"files": files, "segments": draft.segments, "about": about}
                manifest = draft.folder / "manifest.json"
                manifest.write_text(json.dumps({"manifest": content, "sha256": _sha256_of(content)}))
                for path in (manifest, draft.folder, self.segments):
                    flush_to_disk(path)
                draft.folder.rename(self.folder(number))
                try:
                    flush_to_disk(self.path)
                except BaseException:
                    self.folder(number).rename(draft.folder)
                    raise
            except BaseException:
                background.shutdown(cancel_futures=True)
                draft.discard()
                raise
        with contextlib.suppress(OSError):  # what could not be removed now is removed after the next one
            self._prune(keep)
        return Generation(number, self.folder(number), files, draft.segments, about)

    def _prune(self, keep: int) -> None:
        """Remove all but the latest generations, then the segments that none of those needs."""
        numbers = self.numbers()
        for number in numbers[:-keep]:
            # Renamed first, so that what is half removed does not look like a damaged generation.
            gone = self.path / f".removed-{number}"
            shutil.rmtree(gone, ignore_errors=True)
            self.folder(number).rename(gone)
        for leftover in (*self.path.glob(".removed-*"), *self.path.glob(".unfinished-*")):
            shutil.rmtree(leftover, ignore_errors=True)
        needed: set[str] = set()
        for number in numbers[-keep:]:
            try:
                needed.update(entry.name for entry in self.read(number).segments)
            except CheckpointError:
                continue  # it cannot be used
        for path in self.segments.iterdir():
            if path.name not in needed:
                path.unlink(missing_ok=True)


class Draft:
    """A generation that is being written. What has been written is hashed in the background meanwhile.

    :param generations: Where
    :param number: Its number
    :param background: Where to hash
    """

    def __init__(self, generations: Generations, number: int, background: ThreadPoolExecutor):
        self.number = number
        self.folder = generations.path / f".unfinished-{number}"
        self._segments_folder = generations.segments
        #: The files in ``segments/`` that it needs: older ones are to be appended, ``new_segment`` appends its own
        self.segments: list[Entry] = []
        self._new: list[Path] = []
        self._background: ThreadPoolExecutor | None = background
        self._digests: dict[Path, Future[tuple[str, int]]] = {}
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[Path]:
        """
        :param name: Name of a file of this generation
        :return: Where to write it, inside the ``with`` block
        """
        path = self.folder / name
        yield path
        self._digests[path] = self._hash(_digest, path)

    def new_segment(self, name: str, chunks: Iterable[memoryview]) -> Entry:
        """Write a file that later generations may share.

        :param name: Its name, without a suffix
        :param chunks: Its content
        :return: Its entry
        """
        path = self._segments_folder / f"{name}-{self.number:06d}.bin"
        self._new.append(path)
        digest, size = hashlib.sha256(), 0
        hashed = []
        with path.open("wb") as file:
            for chunk in chunks:
                hashed.append(self._hash(digest.update, chunk))
                file.write(chunk)
                size += chunk.nbytes
        flush_to_disk(path)
        for chunk_hashed in hashed:
            chunk_hashed.result()
        entry = Entry(path.name, size, digest.hexdigest())
        self.segments.append(entry)
        return entry

    def seal(self, path: Path) -> Entry:
        """
        :param path: A file that has been written
        :return: Its entry, when all of it is on the disk
        """
        flush_to_disk(path)
        digest, size = self._digests[path].result() if path in self._digests else _digest(path)
        return Entry(path.name, size, digest)

    def _hash(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Call a function in the background; at once where there can be no thread, as when the main one has ended."""
        if self._background is not None:
            try:
                return self._background.submit(function, *arguments)
            except RuntimeError:
                self._background = None
        done: Future[T] = Future()
        done.set_result(function(*arguments))
        return done

    def discard(self) -> None:
        """Remove what was written, as far as that works."""
        shutil.rmtree(self.folder, ignore_errors=True)
        for path in self._new:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def _sha256_of(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _digest(path: Path) -> tuple[str, int]:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
            size += len(chunk)
    return digest.hexdigest(), size


def _fault(path: Path, entry: Entry) -> str | None:
    try:
        size = path.stat().st_size
        if size != entry.size:
            return f"it has {size} bytes instead of {entry.size}"
        digest, _ = _digest(path)
    except OSError as error:
        return f"it cannot be read: {error.strerror}"
    return None if digest == entry.sha256 else "its content has changed"
