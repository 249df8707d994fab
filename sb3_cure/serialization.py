"""Nested states in one file without pickle: a zip of a JSON member and one ``.npy`` member for each array.

Reading executes nothing and imports nothing, and allocates nothing that the file's real size does not justify. This is
the lowest layer of what is saved: model archives, replay buffers and checkpoints are made of it.
"""

import contextlib
import json
import math
import os
import struct
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch as th

#: Of the format
VERSION = 1
#: Largest file that is read: three times a replay buffer of a million 84x84 frames
MAX_BYTES = 2**36
#: Most members of an archive, and most bytes of its directory (a name of 256 characters for each)
MAX_MEMBERS = 10_000
MAX_DIRECTORY_BYTES = 4 * 2**20
#: Largest JSON member; parsed it takes some ten times as much
MAX_JSON_BYTES = 4 * 2**20
#: Deepest nesting of containers; their JSON is up to three times as deep
MAX_DEPTH = 32
#: Bytes that are copied at a time
CHUNK_BYTES = 2**20

#: What a state's file has, and an archive of a model instead
STATE_MEMBER = "state.json"
MODEL_MEMBER = "data"
_LARGEST_PLAIN_INT = 2**64
_DTYPE_KINDS = "biufc"
_TENSOR_DTYPES = {
    str(dtype).removeprefix("torch."): dtype for dtype in vars(th).values() if isinstance(dtype, th.dtype)
}
# Types that are written as themselves; everything else is an object with one key, which tells the type.
_PLAIN = (type(None), bool, str)


class ArchiveError(ValueError):
    """A file is not what it should be, in one sentence.

    :param sentence: It may quote the file, whose control characters are left out
    """

    def __init__(self, sentence: str):
        super().__init__("".join(filter(str.isprintable, sentence)))


def write_state(file: str | Path | BinaryIO, state: dict[str, Any]) -> None:
    """Write a state; ``read_state`` gives it back with the same types and bits.

    It may hold None, bool, int, float, str, bytes, list, tuple, dict with str keys, deque, numpy arrays and scalars
    (numbers and bool; a ``np.memmap`` comes back as an array), and dense torch tensors (without their gradients; they
    come back on the CPU, in the same memory order). Arrays are written in chunks, without a copy in memory.

    :param file: Path to write to (not atomically: see ``sb3_cure.files.replacing``), or a binary file
    :param state: What to write
    :raises TypeError: if the state holds anything else, with its path inside the state; the file is not touched then
    """
    encoder = Encoder()
    text = dump_json({"version": VERSION, "state": encoder.encode(state, "state")})
    with open(file, "wb") if isinstance(file, str | Path) else contextlib.nullcontext(file) as stream:
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr(zipfile.ZipInfo(STATE_MEMBER), text)
            write_arrays(archive, encoder.arrays)


def read_state(file: str | Path | BinaryIO) -> dict[str, Any]:
    """Read what ``write_state`` wrote. Everything is checked before it is allocated, and no code of the file runs.

    :param file: Path, or a binary file that can seek
    :return: The state
    :raises ArchiveError: if the file is anything but a whole state, in one sentence
    """
    with open(file, "rb") if isinstance(file, str | Path) else contextlib.nullcontext(file) as stream:
        return decode_state(Archive(stream, "the file" if stream is file else f"'{file}'"))


def decode_state(archive: "Archive", materialize: "Callable[[StoredArray], Any] | None" = None) -> dict[str, Any]:
    """
    :param archive: A state's file, open
    :param materialize: What becomes of an array in it, instead of being read
    :return: The state
    :raises ArchiveError: if it is anything but a whole state
    """
    if MODEL_MEMBER in archive.sizes and STATE_MEMBER not in archive.sizes:
        raise ArchiveError(f"{archive.name} holds a model: give what was written in this place, or read it with load.")
    arrays = archive.arrays()
    node = archive.json(STATE_MEMBER)
    archive.check_all_read()
    if not isinstance(node, dict) or node.keys() != {"version", "state"} or node["version"] != VERSION:
        raise archive.error(f"is no state of version {VERSION}")
    state = Decoder(arrays, materialize).decode_all(node["state"])
    if type(state) is not dict:
        raise archive.error(f"holds a {type(state).__name__} instead of a dictionary")
    return state


# ------------------------------------------------------------------- values


class Encoder:
    """Values to JSON, and the arrays in them to a list."""

    def __init__(self) -> None:
        #: The arrays so far; JSON refers to them by their position
        self.arrays: list[np.ndarray] = []

    def encode(self, value: Any, path: str, depth: int = 0) -> Any:
        """
        :param value: Any of the types of ``write_state``, and those of ``encode_other``
        :param path: Where it is, for the message
        :param depth: How many containers it is in
        :return: Its JSON
        :raises TypeError: for any other type
        """
        if depth > MAX_DEPTH:
            raise TypeError(f"{path} is nested deeper than {MAX_DEPTH} containers, which cannot be saved: flatten it.")
        kind = type(value)
        if kind in _PLAIN or (kind is int and abs(value) < _LARGEST_PLAIN_INT):
            return value
        if kind is np.str_:
            return str(value)
        if kind is float:
            return value if math.isfinite(value) else {"float": struct.pack(">d", value).hex()}
        if kind is int:
            return {"int": hex(value)}
        if kind is list and len(value) > 100 and set(map(type, value)) == {float}:
            return {"floats": self._keep(np.array(value, dtype=np.float64))}  # of histories, say
        if kind is list or kind is tuple or kind is deque:
            items = [self.encode(item, f"{path}[{i}]", depth + 1) for i, item in enumerate(value)]
            if kind is deque:
                return {"deque": [value.maxlen, items]}
            return items if kind is list else {"tuple": items}
        if kind is dict:
            for key in value:
                if type(key) is not str:
                    raise TypeError(
                        f"{path} has the key {key!r} ({type(key).__name__}), but only str keys can be saved: "
                        "use strings."
                    )
            return {"dict": {key: self.encode(item, f"{path}[{key!r}]", depth + 1) for key, item in value.items()}}
        if kind is bytes:
            return {"bytes": self._keep(np.frombuffer(value, dtype=np.uint8))}
        if kind in (np.ndarray, np.memmap) and _is_numeric(value.dtype):
            return {"array": self._keep(value)}
        if isinstance(value, np.generic) and _is_numeric(value.dtype):
            return {"scalar": [value.dtype.str, value.tobytes().hex()]}
        if kind is th.Tensor and value.layout is th.strided and not value.is_quantized:
            return {"tensor": self._encode_tensor(value)}
        return self.encode_other(value, path, depth)

    def encode_other(self, value: Any, path: str, depth: int) -> Any:
        """What a subclass can save besides.

        :param value: Value of another type
        :param path: Where it is
        :param depth: How many containers it is in
        :return: Its JSON, an object with one key that no other type has
        :raises TypeError: if it cannot be saved
        """
        kind = type(value)
        details = f" of dtype {value.dtype}" if isinstance(value, np.ndarray | np.generic) else ""
        details += f" of layout {value.layout}" if isinstance(value, th.Tensor) else ""
        raise TypeError(
            f"{path} is a {kind.__module__}.{kind.__qualname__}{details}, which cannot be saved without pickle: save "
            "the numbers, strings, containers, arrays and tensors that it is made of."
        )

    def _keep(self, array: np.ndarray) -> int:
        self.arrays.append(array)
        return len(self.arrays) - 1

    def _encode_tensor(self, tensor: th.Tensor) -> list[Any]:
        tensor = tensor.detach().cpu().resolve_conj().resolve_neg()
        # Written in the order in which it lies in memory, so that it comes back in it (channels last, say).
        order = sorted(range(tensor.dim()), key=tensor.stride, reverse=True)
        # Not `view(-1)`: that keeps odd strides of single elements, which cannot be viewed as bytes.
        flat = tensor.permute(order).contiguous().as_strided((tensor.numel(),), (1,))
        return [
            str(tensor.dtype).removeprefix("torch."),
            list(tensor.shape),
            order,
            self._keep(flat.view(th.uint8).numpy()),
        ]


class Decoder:
    """JSON and arrays back to values.

    :param arrays: The archive's arrays, not read yet; each has to be used once
    :param materialize: Reads one
    """

    def __init__(self, arrays: list["StoredArray"], materialize: "Callable[[StoredArray], Any] | None" = None):
        self._arrays: list[StoredArray | None] = list(arrays)
        self._materialize = materialize or StoredArray.read

    def decode_all(self, node: Any) -> Any:
        """
        :param node: JSON that refers to all arrays
        :return: The value
        :raises ArchiveError: for anything that ``Encoder`` does not write
        """
        try:
            value = self.decode(node)
        except ArchiveError:
            raise
        except Exception as error:  # the few constructors that JSON's values reach refuse them in many ways
            raise ArchiveError(f"the archive's JSON is damaged ({one_line(error)}).") from error
        if any(array is not None for array in self._arrays):
            raise ArchiveError("the archive holds arrays that its JSON does not name: it is damaged.")
        return value

    def decode(self, node: Any) -> Any:
        """
        :param node: JSON
        :return: The value
        """
        if isinstance(node, list):
            return [self.decode(item) for item in node]
        if not isinstance(node, dict):
            return node
        if len(node) != 1:
            raise ArchiveError(f"the archive's JSON has an object of {len(node)} keys where one tells the type.")
        ((tag, content),) = node.items()
        if tag == "dict" and isinstance(content, dict):
            return {key: self.decode(item) for key, item in content.items()}
        if tag == "tuple" and isinstance(content, list):
            return tuple(self.decode(item) for item in content)
        if tag == "deque":
            maxlen, items = content
            items = [self.decode(item) for item in items]
            if maxlen is not None and (type(maxlen) is not int or len(items) > maxlen):
                raise ArchiveError(f"the archive's JSON has a deque of {len(items)} items and maxlen {maxlen!r:.50}.")
            return deque(items, maxlen)
        if tag == "floats":
            stored = self._take(content)
            if stored.dtype != np.float64 or len(stored.shape) != 1:
                raise ArchiveError(f"the archive's JSON has floats of {stored.dtype} and shape {stored.shape}.")
            return stored.read().tolist()
        if tag == "float":
            return struct.unpack(">d", bytes.fromhex(content))[0]
        if tag == "int":
            return int(content, 16)
        if tag == "bytes":
            return self._take_bytes(content).numpy().tobytes()
        if tag == "array":
            return self._materialize(self._take(content))
        if tag == "scalar":
            name, value = content
            (number,) = numbers = np.frombuffer(bytes.fromhex(value), dtype=numeric_dtype(name))
            _check_bools(numbers)
            return number
        if tag == "tensor":
            return self._decode_tensor(*content)
        return self.decode_other(tag, content)

    def decode_other(self, tag: str, content: Any) -> Any:
        """What a subclass knows besides.

        :param tag: Name of the type
        :param content: JSON
        :return: The value
        :raises ArchiveError: if there is no such type
        """
        raise ArchiveError(f"the archive's JSON names the type {tag!r:.50}, which this version does not know.")

    def _take(self, index: Any) -> "StoredArray":
        array = self._arrays[index] if type(index) is int and 0 <= index < len(self._arrays) else None
        if array is None:
            raise ArchiveError(f"the archive's JSON names the array {index!r:.50}, which is missing or used twice.")
        self._arrays[index] = None
        return array

    def _take_bytes(self, index: Any, size: int | None = None) -> th.Tensor:
        array = self._take(index)
        if array.dtype != np.uint8 or len(array.shape) != 1 or size not in (None, array.nbytes):
            raise ArchiveError(
                f"array {index} is {array.dtype} of shape {array.shape}, unlike the archive's JSON says."
            )
        flat = th.empty(array.nbytes, dtype=th.uint8)
        array.read(out=flat.numpy())
        return flat

    def _decode_tensor(self, name: str, shape: list[int], order: list[int], index: int) -> th.Tensor:
        dtype = _TENSOR_DTYPES[name]
        if any(type(length) is not int or length < 0 for length in shape) or sorted(order) != list(range(len(shape))):
            raise ArchiveError(f"the archive's JSON has a tensor of shape {shape!s:.50} in the order {order!s:.50}.")
        flat = self._take_bytes(index, math.prod(shape) * dtype.itemsize)
        if dtype is th.bool:
            _check_bools(flat.numpy().view(np.bool_))
        tensor = flat.view(dtype).view([shape[dim] for dim in order])
        return tensor.permute([order.index(dim) for dim in range(len(shape))])


def _is_numeric(dtype: np.dtype) -> bool:
    return dtype.kind in _DTYPE_KINDS and dtype.fields is None and dtype.subdtype is None


def numeric_dtype(name: Any) -> np.dtype:
    """
    :param name: Of numpy's, from a file
    :return: The dtype
    :raises ArchiveError: if it is not that of numbers or bool
    """
    dtype = np.dtype(name) if isinstance(name, str) and len(name) < 8 else None
    if dtype is None or not _is_numeric(dtype):
        raise ArchiveError(f"the archive has values of the dtype {name!r:.50}, but only numbers and bool are read.")
    return dtype


def _check_bools(values: np.ndarray) -> None:
    """Bytes other than 0 and 1 are no bools, and what they do as such is undefined."""
    if values.dtype == np.bool_ and values.size and values.view(np.uint8).max() > 1:
        raise ArchiveError("the archive has an array of bools with values that are neither 0 nor 1: it is damaged.")


def one_line(error: BaseException, length: int = 200) -> str:
    """
    :param error: Any error
    :param length: At most so many characters
    :return: What it says, as a part of a sentence
    """
    text = " ".join("".join(filter(str.isprintable, str(error).replace("\n", " "))).split())
    return (text or type(error).__name__)[:length].rstrip(".")


@contextlib.contextmanager
def sentences(name: str, smaller: str) -> Iterator[None]:
    """Whatever fails in this context, in which something is built from a file, is told in one sentence.

    :param name: What to call the file
    :param smaller: What to do if there is not enough memory
    """
    try:
        yield
    except ArchiveError:
        raise
    except Exception as error:
        lack = error if isinstance(error, MemoryError) else error.__cause__
        if isinstance(lack, MemoryError):
            raise ArchiveError(f"{name} needs more memory than there is ({one_line(lack)}): {smaller}.") from error
        # What is no ValueError was not written to be read alone.
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ArchiveError(f"{name} cannot be loaded: {kind}{one_line(error, 1000)}.") from error


# --------------------------------------------------------------------- JSON


def dump_json(node: Any) -> str:
    """
    :param node: JSON of ``Encoder``
    :return: Its text
    :raises ValueError: if it is too large to be read again
    """
    text = json.dumps(node, allow_nan=False, separators=(",", ":"))
    if len(text) > MAX_JSON_BYTES:
        raise ValueError(
            f"the state has {len(text)} bytes of JSON, but at most {MAX_JSON_BYTES} are read again: save long lists of "
            "numbers as arrays."
        )
    return text


def load_json(text: bytes) -> Any:
    """
    :param text: JSON from a file
    :return: Parsed, no deeper than ``MAX_DEPTH`` containers and without two equal keys
    :raises ArchiveError: if it is anything else
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ArchiveError("the archive's JSON has an object with two equal keys.")
        return found

    def refuse(constant: str) -> None:
        raise ArchiveError(f"the archive's JSON has the number {constant}, which JSON does not know.")

    try:
        node = json.loads(text.decode(), object_pairs_hook=unique, parse_constant=refuse)
    except ArchiveError:
        raise
    except (ValueError, RecursionError) as error:
        raise ArchiveError(f"the archive's JSON cannot be read ({one_line(error)}).") from error
    # One level at a time: a recursion is what is to be limited.
    level, depth = [node], 0
    while level:
        depth += 1
        if depth > 3 * MAX_DEPTH + 10:
            raise ArchiveError(f"the archive's JSON is nested deeper than {3 * MAX_DEPTH + 10} containers.")
        level = [
            item
            for container in level
            if isinstance(container, dict | list)
            for item in (container.values() if isinstance(container, dict) else container)
        ]
    return node


# ----------------------------------------------------------------- zip files


def write_arrays(archive: zipfile.ZipFile, arrays: list[np.ndarray]) -> None:
    """
    :param archive: Zip file that is being written
    :param arrays: Arrays of an ``Encoder``: each becomes a member, in chunks
    """
    if len(arrays) > MAX_MEMBERS - 100:
        raise ValueError(
            f"the state has {len(arrays)} arrays, but at most {MAX_MEMBERS - 100} are read again: join them."
        )
    for i, array in enumerate(arrays):
        info = zipfile.ZipInfo(_array_member(i))
        with archive.open(info, "w", force_zip64=array.nbytes > 2**30) as member:
            # As numpy.lib.format.write_array does, in smaller chunks.
            header = np.lib.format.header_data_from_array_1_0(array)
            np.lib.format.write_array_header_1_0(member, header)
            for chunk in np.nditer(
                array,
                ["external_loop", "buffered", "zerosize_ok"],
                buffersize=max(CHUNK_BYTES // array.itemsize, 1),
                order="F" if header["fortran_order"] else "C",
            ):
                member.write(chunk.tobytes())  # type: ignore[attr-defined]


def _array_member(index: int) -> str:
    return f"arrays/{index}.npy"


class StoredArray:
    """An array in an archive, its header checked against the size of its member, its numbers not read yet.

    :param archive: The archive, which must stay open
    :param name: Its member
    """

    def __init__(self, archive: "Archive", name: str):
        self._archive = archive
        self._name = name
        with archive.open(name) as member:
            try:
                if np.lib.format.read_magic(member) != (1, 0):
                    raise ValueError("another version of the format")
                header = np.lib.format.read_array_header_1_0(member, max_header_size=1000)
                self.shape, self.fortran_order, self.dtype = header
            except Exception as error:  # numpy evaluates a literal, which fails in many ways
                raise archive.error(f"has a member {name!r} without a header of numpy ({one_line(error)})") from error
            self._start = member.tell()
        if not _is_numeric(self.dtype):
            raise archive.error(
                f"has a member {name!r} of dtype {self.dtype!s:.50}, but only numbers and bool are read"
            )
        if any(type(length) is not int or length < 0 for length in self.shape):
            raise archive.error(f"has a member {name!r} of the impossible shape {self.shape!s:.50}")
        #: Size of the numbers
        self.nbytes = math.prod(self.shape) * self.dtype.itemsize
        if self.nbytes != archive.sizes[name] - self._start:
            raise archive.error(
                f"has a member {name!r} of {archive.sizes[name] - self._start} bytes for {self.dtype} of shape "
                f"{self.shape!s:.50}"
            )

    def read(self, out: np.ndarray | None = None) -> np.ndarray:
        """
        :param out: Array of this shape and dtype to read into, C-contiguous; None: a new one
        :return: The array
        """
        if out is None:
            out = np.empty(self.shape, self.dtype, order="F" if self.fortran_order else "C")
        elif out.shape != self.shape or out.dtype != self.dtype or self.fortran_order or not out.flags.c_contiguous:
            raise ArchiveError(
                f"the archive has {self.dtype} of shape {self.shape} for {out.dtype} of shape {out.shape}."
            )
        target = (out.T if self.fortran_order else out).reshape(-1).view(np.uint8)
        with self._archive.open(self._name) as member:
            member.read(self._start)
            for start in range(0, self.nbytes, CHUNK_BYTES):
                chunk = member.read(min(CHUNK_BYTES, self.nbytes - start))
                target[start : start + CHUNK_BYTES] = np.frombuffer(chunk, dtype=np.uint8)
        _check_bools(out)
        return out


class Archive:
    """A zip file whose directory was checked: few members, stored as they are, no larger together than the file.

    :param stream: Binary file that can seek
    :param name: What to call it
    :raises ArchiveError: if it is no such zip file
    """

    def __init__(self, stream: BinaryIO, name: str):
        self.name = name
        self._read: set[str] = set()
        size = stream.seek(0, os.SEEK_END)
        if size > MAX_BYTES:
            raise self.error(f"has {size} bytes, but at most {MAX_BYTES} are read")
        self._check_end(stream, size)
        try:
            self._zip = zipfile.ZipFile(stream)
            members = self._zip.infolist()
        except Exception as error:  # zipfile has no common error for broken files
            raise self.error(f"is a damaged zip file ({one_line(error)})") from error
        #: Size of each member
        self.sizes: dict[str, int] = {}
        for member in members:
            self._check_member(member)
            self.sizes[member.filename] = member.file_size
        if sum(self.sizes.values()) > size:
            raise self.error(f"declares members of {sum(self.sizes.values())} bytes together in a file of {size} bytes")

    def _check_end(self, stream: BinaryIO, size: int) -> None:
        """The directory's size, before zipfile reads it: its objects take ten times as much."""
        tail_size = min(size, 98)
        stream.seek(size - tail_size)
        tail = stream.read(tail_size)
        end = tail[-22:]
        if len(end) < 22 or end[:4] != b"PK\5\6" or end[-2:] != b"\0\0":
            raise self.error("is no zip file, or the end of it is missing")
        n_members, directory = struct.unpack("<HL", end[10:16])
        if tail[-42:-38] == b"PK\6\7":
            (offset,) = struct.unpack("<Q", tail[-34:-26])
            if len(tail) < 98 or tail[:4] != b"PK\6\6" or offset != size - 98:
                raise self.error("is a damaged zip file (its directory cannot be found)")
            n_members, directory = struct.unpack("<QQ", tail[32:48])
        if n_members > MAX_MEMBERS or directory > MAX_DIRECTORY_BYTES:
            raise self.error(f"has {n_members} members, but at most {MAX_MEMBERS} with short names are read")

    def _check_member(self, member: zipfile.ZipInfo) -> None:
        name = member.orig_filename
        parts = name.replace("\\", "/").split("/")
        if name != member.filename or not name.isprintable() or "" in parts or ".." in parts or ":" in parts[0]:
            raise self.error(f"has a member with the name {name!r:.100}, which no archive of this package has")
        if name in self.sizes:
            raise self.error(f"has two members with the name {name!r:.100}")
        if (
            member.compress_type != zipfile.ZIP_STORED
            or member.flag_bits & 0x61
            or (member.file_size != member.compress_size)
        ):
            raise self.error(f"has a compressed or encrypted member {name!r:.100}, but only stored ones are read")

    def error(self, sentence: str) -> ArchiveError:
        """
        :param sentence: What is wrong, without the subject
        :return: The error to raise
        """
        return ArchiveError(f"{self.name} {sentence}: it was not written by this package, or was damaged since.")

    @contextlib.contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        """
        :param name: Name of a member
        :return: It, to read from; a wrong checksum is an error where its last byte is read
        """
        if name not in self.sizes:
            raise self.error(f"has no member {name!r}")
        self._read.add(name)
        try:
            with self._zip.open(name) as member:
                yield member  # type: ignore[misc]
        except ArchiveError:
            raise
        except (zipfile.BadZipFile, EOFError, OSError, RuntimeError, struct.error, ValueError) as error:
            raise self.error(f"has a damaged member {name!r} ({one_line(error)})") from error

    def bytes(self, name: str, max_bytes: int) -> bytes:
        """
        :param name: Name of a member
        :param max_bytes: Largest size to read
        :return: All of it
        """
        if self.sizes.get(name, 0) > max_bytes:
            raise self.error(f"has a member {name!r} of {self.sizes[name]} bytes, but at most {max_bytes} are read")
        with self.open(name) as member:
            return member.read()

    def json(self, name: str) -> Any:
        """
        :param name: Name of a member
        :return: Parsed JSON
        """
        return load_json(self.bytes(name, MAX_JSON_BYTES))

    def arrays(self) -> list[StoredArray]:
        """
        :return: What ``write_arrays`` wrote, all headers checked, no numbers read
        """
        names: list[str] = []
        while (name := _array_member(len(names))) in self.sizes:
            names.append(name)
        return [StoredArray(self, name) for name in names]

    def check_all_read(self) -> None:
        """
        :raises ArchiveError: if there are members that nobody asked for
        """
        unknown = sorted(self.sizes.keys() - self._read)
        if unknown:
            raise self.error(f"has {len(unknown)} unknown members, the first of them {unknown[0]!r:.100}")
