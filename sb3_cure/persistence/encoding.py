"""Values as JSON, with the arrays and tensors in them set apart, and files of both without pickle.

What JSON can express stays as it is; any other value is an object with one key, which begins with ``!`` and names the
type. Reading runs no code of a file and imports nothing that it names: tensors are read by safetensors, objects are
those of ``_KINDS``, classes those of ``NAMED`` and the policies that a model registers.
"""

import contextlib
import json
import math
import struct
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers.utils import RunningMeanStd as GymRunningMeanStd
from safetensors import safe_open
from safetensors.torch import load as load_tensors
from stable_baselines3.common import torch_layers
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations
from stable_baselines3.her import GoalSelectionStrategy, HerReplayBuffer
from torch.nn.modules import activation

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.intrinsic import INTRINSIC_REWARDS
from sb3_cure.networks import encoders
from sb3_cure.srl import SRL_HEADS

#: Version of the file format
VERSION = 6
_DTYPES = {
    **{th.bool: "BOOL", th.float16: "F16", th.bfloat16: "BF16", th.float32: "F32", th.float64: "F64"},
    **{th.int8: "I8", th.int16: "I16", th.int32: "I32", th.int64: "I64"},
    **{th.uint8: "U8", th.uint16: "U16", th.uint32: "U32", th.uint64: "U64"},
}


class ArchiveError(ValueError):
    """A file cannot be read, or does not fit; the message is one sentence.

    :param sentence: The message; it may quote the file, so control characters are left out
    """

    def __init__(self, sentence: str):
        super().__init__("".join(filter(str.isprintable, sentence)))


@contextlib.contextmanager
def refusing(name: str) -> Iterator[None]:
    """Turn any error of reading a file into an ``ArchiveError``.

    :param name: What to call the file
    """
    try:
        yield
    except ArchiveError:
        raise
    except Exception as error:  # hostile bytes fail in many ways
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}".rstrip(".")
        raise ArchiveError(f"{name} is damaged, or was not written by this package ({reason}).") from error


def check_version(version: Any, name: str) -> None:
    """Refuse files of other versions of this package.

    :param version: Format of the file
    :param name: What to call it
    :raises ArchiveError: if it is not ``VERSION``
    """
    if version != VERSION:
        raise ArchiveError(
            f"{name} has format {version!r:.20} of another version of sb3_cure, and this one reads format {VERSION}."
        )


# ---------------------------------------------------------------------- names

#: Types of the numbers in arrays
NUMBERS: tuple[type[np.generic], ...] = (
    *(np.bool_, np.float16, np.float32, np.float64),
    *(np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64),
)


def _of_module(module: Any, base: type) -> list[type]:
    return [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, base)]


def name_of(value: Any) -> str:
    """Get the name by which files call a class or a member of an enumeration.

    :param value: Class or member
    :return: Name
    """
    if value in NUMBERS:
        return f"numpy.{np.dtype(value).name}"  # `bool` or `bool_`, by NumPy's version
    return str(value) if isinstance(value, Enum) else f"{value.__module__}.{value.__qualname__}"


#: Classes and members of enumerations by their names
NAMED: dict[str, Any] = {
    name_of(value): value
    for value in (
        *(FrameStackReplayBuffer, ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer),
        *NUMBERS,
        encoders.PixelEncoder,
        encoders.VectorEncoder,
        encoders.DictEncoder,
        torch_layers.FlattenExtractor,
        torch_layers.NatureCNN,
        torch_layers.CombinedExtractor,
        *SRL_HEADS.values(),
        *INTRINSIC_REWARDS.values(),
        *_of_module(activation, th.nn.Module),
        *_of_module(th.optim, th.optim.Optimizer),
        *GoalSelectionStrategy,
        *TrainFrequencyUnit,
    )
}


def named_by(model_class: type) -> dict[str, Any]:
    """List what the archives of an algorithm may name: ``NAMED``, and the policies that its classes register.

    :param model_class: Algorithm
    :return: Classes by name
    """
    registered = [vars(base).get("policy_aliases", {}).values() for base in model_class.__mro__]
    policies = {base for policies in registered for policy in policies for base in policy.__mro__}
    return NAMED | {name_of(policy): policy for policy in policies if issubclass(policy, BasePolicy)}


# ------------------------------------------------------------------- values


def encode(value: Any, path: str, tensors: dict[str, th.Tensor], named: Mapping[str, Any] = NAMED) -> Any:
    """Describe a value by JSON.

    :param value: None, bool, int, float, str, bytes, list, tuple, dict, set, deque, arrays, tensors, NumPy's numbers
        and generators, paths, spaces, SB3's schedules, noises and running statistics, and classes with a name
    :param path: Where it is, which names its tensors
    :param tensors: Takes the arrays and tensors, contiguous
    :param named: Classes by name
    :return: JSON
    :raises TypeError: for any other value, saying what it is
    """
    kind = type(value)
    inside = partial(encode, tensors=tensors, named=named)
    if value is None or kind in (bool, int, str):
        return value
    if kind is float:
        return value if math.isfinite(value) else {"!float": str(value)}
    if kind is list:
        return [inside(item, f"{path}.{i}") for i, item in enumerate(value)]
    if kind is dict and all(type(key) is str and not key.startswith("!") for key in value):
        return {key: inside(item, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, np.str_):
        return str(value)
    if isinstance(value, np.ndarray) and (dtype := value.dtype.newbyteorder("=")).type in NUMBERS:
        array = np.ascontiguousarray(value, dtype).reshape(value.shape)
        # torch warns of read-only arrays and refuses negative strides, which even single elements may have.
        array = array if array.flags.writeable and min(array.strides, default=0) >= 0 else array.copy()
        return {"!array": _keep(th.from_numpy(array), path, tensors)}
    if isinstance(value, th.Tensor) and value.layout is th.strided and value.dtype in _DTYPES:
        return {"!tensor": _keep(value, path, tensors)}
    if kind in _TAGS:
        return {f"!{_TAGS[kind]}": inside(_KINDS[_TAGS[kind]][1](value), path)}
    name = name_of(value) if isinstance(value, Enum) or hasattr(value, "__qualname__") else ""
    if name and named.get(name) is value:
        return {"!name": name}
    what = "class" if isinstance(value, type) else "function"
    raise TypeError(f"{path} is the {what} {name}" if name else f"{path} is of the type {name_of(kind)}")


def _keep(tensor: th.Tensor, path: str, tensors: dict[str, th.Tensor]) -> str:
    while path in tensors:
        path += "'"
    tensors[path] = tensor.detach().cpu().resolve_conj().resolve_neg().contiguous()
    return path


def decode(node: Any, tensors: Callable[[str], th.Tensor], named: Mapping[str, Any] = NAMED) -> Any:
    """Restore a value.

    :param node: JSON of ``encode``
    :param tensors: Gives a tensor by its name
    :param named: Classes by name
    :return: The value; arrays and tensors are contiguous, on the CPU
    :raises Exception: of many kinds, for what ``encode`` did not write
    """
    if isinstance(node, list):
        return [decode(item, tensors, named) for item in node]
    if not isinstance(node, dict):
        return node
    if not any(key.startswith("!") for key in node):
        return {key: decode(item, tensors, named) for key, item in node.items()}
    ((tag, content),) = node.items()
    if tag == "!float":
        return float(content)
    if tag == "!array":
        return tensors(content).numpy()
    if tag == "!tensor":
        return tensors(content)
    if tag == "!name":
        return named[content]
    return _KINDS[tag[1:]][2](decode(content, tensors, named))


def _revived(kind: type, attributes: dict[str, Any]) -> Any:
    """Make an object of a class that keeps its state in attributes."""
    value: Any = object.__new__(kind)
    vars(value).update(attributes)
    return value


def _space_kwargs(names: str, space: Any) -> dict[str, Any]:
    """Get the arguments that a space was made with."""
    return {"dtype": space.dtype.type} | {name: getattr(space, name) for name in names.split()}


def _generator(state: dict[str, Any]) -> np.random.Generator:
    kinds = (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64)
    generator = np.random.Generator({kind.__name__: kind for kind in kinds}[state["bit_generator"]]())
    generator.bit_generator.state = state
    return generator


def _number(parts: list[Any]) -> np.generic:
    return {name_of(kind): kind for kind in NUMBERS}[parts[0]](parts[1])


def _random_state(state: dict[str, Any]) -> np.random.RandomState:
    random = np.random.RandomState()
    random.set_state(state)
    return random


_BY_ATTRIBUTES = (
    *(RunningMeanStd, GymRunningMeanStd, StackedObservations),
    *(ConstantSchedule, FloatSchedule, LinearSchedule),
    *(NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise),
)
#: By tag: class, function from an object to its parts, and back
_KINDS: dict[str, tuple[type, Callable[[Any], Any], Callable[[Any], Any]]] = {
    "number": (np.generic, lambda value: [name_of(type(value)), value.item()], _number),
    "tuple": (tuple, list, tuple),
    "dict": (dict, lambda value: [list(item) for item in value.items()], dict),
    "OrderedDict": (OrderedDict, lambda value: [list(item) for item in value.items()], OrderedDict),
    "deque": (deque, lambda value: [value.maxlen, list(value)], lambda parts: deque(parts[1], parts[0])),
    "bytes": (bytes, lambda value: np.frombuffer(value, np.uint8), lambda array: array.tobytes()),
    "Path": (type(Path()), str, Path),
    "TrainFreq": (TrainFreq, list, lambda parts: TrainFreq(*parts)),
    "Box": (spaces.Box, partial(_space_kwargs, "low high shape"), lambda given: spaces.Box(**given)),
    "Discrete": (spaces.Discrete, partial(_space_kwargs, "n start"), lambda given: spaces.Discrete(**given)),
    "MultiDiscrete": (
        spaces.MultiDiscrete,
        partial(_space_kwargs, "nvec start"),
        lambda given: spaces.MultiDiscrete(**given),
    ),
    "MultiBinary": (spaces.MultiBinary, lambda space: space.n, spaces.MultiBinary),
    # Its items in this order, where a dict would be sorted
    "Dict": (spaces.Dict, lambda space: OrderedDict(space.spaces), spaces.Dict),
    "Tuple": (spaces.Tuple, lambda space: space.spaces, spaces.Tuple),
    "set": (set, list, set),
    "Counter": (Counter, lambda value: [list(item) for item in value.items()], lambda items: Counter(dict(items))),
    "Generator": (np.random.Generator, lambda generator: generator.bit_generator.state, _generator),
    "RandomState": (np.random.RandomState, lambda random: random.get_state(legacy=False), _random_state),
    **{name_of(kind): (kind, lambda value: dict(vars(value)), partial(_revived, kind)) for kind in _BY_ATTRIBUTES},
}
_TAGS = {kind: tag for tag, (kind, *_) in _KINDS.items()} | dict.fromkeys(NUMBERS, "number")


# -------------------------------------------------------------------- files


#: Most bytes that all values but arrays may take: safetensors reads headers of up to 100 MB
LARGEST_HEADER = 95_000_000


def write_tensors(file: BinaryIO, tensors: dict[str, th.Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file, one tensor after the other.

    The library's own writers need a path, or a second copy of everything in memory.

    :param file: Where to write
    :param tensors: Contiguous tensors on the CPU, by name
    :param metadata: Texts for the header
    """
    header: dict[str, Any] = {} if metadata is None else {"__metadata__": metadata}
    by_alignment = sorted(tensors.items(), key=lambda item: -item[1].itemsize)
    end = 0
    for name, tensor in by_alignment:
        start, end = end, end + tensor.nbytes
        header[name] = {"dtype": _DTYPES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": [start, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write(struct.pack("<Q", len(text)) + text)
    for _, tensor in by_alignment:
        # Not `view(-1)`: that keeps odd strides of single elements, which cannot be viewed as bytes.
        file.write(tensor.as_strided((tensor.numel(),), (1,)).view(th.uint8).numpy().data)


def write_state(file: str | Path | BinaryIO, state: dict[str, Any]) -> None:
    """Write nested values into one safetensors file, whose header holds all that is no array.

    :param file: Path to write to (not atomically: see ``replacing``), or a binary file
    :param state: What ``encode`` knows
    :raises TypeError: for anything else; the file is not touched then
    :raises OSError: if the values that are not arrays are too large to be read back; the file is not touched then
    """
    tensors: dict[str, th.Tensor] = {}
    metadata = {"format": str(VERSION), "state": json.dumps(encode(state, "state", tensors))}
    if len(metadata["state"]) > LARGEST_HEADER:
        raise OSError(f"{len(metadata['state']):,} bytes that are no arrays are more than can be read back")
    with open(file, "wb") if isinstance(file, str | Path) else contextlib.nullcontext(file) as stream:
        write_tensors(stream, tensors, metadata)


def is_state(file: BinaryIO) -> bool:
    """Check whether a file may be one of ``write_state``, rather than a pickle.

    :param file: Binary file at its start, where it is left
    :return: Whether it may
    """
    may_be = file.read(9)[8:] == b"{"
    file.seek(0)
    return may_be


def read_state(file: str | Path | BinaryIO, copy: bool = True) -> dict[str, Any]:
    """Read what ``write_state`` wrote.

    :param file: Path, or a binary file
    :param copy: Whether arrays are copied into memory; else those of a path stay mapped to the file
    :return: The state
    :raises ArchiveError: if the file is anything else
    """
    is_path = isinstance(file, str | Path)
    with refusing(f"'{file}'" if is_path else "the file"):
        if is_path:
            with safe_open(file, "pt") as opened:  # type: ignore[no-untyped-call]
                metadata, get = opened.metadata(), opened.get_tensor
                return _decoded(metadata, (lambda name: get(name).clone()) if copy else get)
        file.seek(0)  # type: ignore[union-attr]
        data = file.read()  # type: ignore[union-attr]
        tensors = load_tensors(data)
        metadata = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
        return _decoded(metadata, tensors.__getitem__)


def _decoded(metadata: dict[str, str], tensors: Callable[[str], th.Tensor]) -> dict[str, Any]:
    check_version(int(metadata["format"]), "the file")
    return decode(json.loads(metadata["state"]), tensors)
