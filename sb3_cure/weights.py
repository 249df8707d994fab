"""State dicts from files that nobody vouches for: read without running their pickle, checked before they are set."""

import io
import math
import pickletools
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, NamedTuple

import torch as th
from stable_baselines3.common.save_util import recursive_getattr
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_cure.encoder_optimizer import EncoderOptimizer
from sb3_cure.serialization import Archive, ArchiveError, one_line
from sb3_cure.settings import whole
from sb3_cure.values import is_number

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC


class TensorInfo(NamedTuple):
    """What a state dict says of a tensor."""

    dtype: th.dtype
    shape: tuple[int, ...]


class _Storage(NamedTuple):
    dtype: th.dtype
    numel: int


_STORAGES = {
    "FloatStorage": th.float32,
    "DoubleStorage": th.float64,
    "HalfStorage": th.float16,
    "BFloat16Storage": th.bfloat16,
    "LongStorage": th.int64,
    "IntStorage": th.int32,
    "ShortStorage": th.int16,
    "CharStorage": th.int8,
    "ByteStorage": th.uint8,
    "ComplexFloatStorage": th.complex64,
    "ComplexDoubleStorage": th.complex128,
    "BoolStorage": th.bool,
}
_GLOBALS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    *(f"torch {name}" for name in _STORAGES),
}
_MARK = object()
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"}
_MAX_PICKLE_BYTES = 8 * 2**20


class TorchFile:
    """A member that ``torch.save`` wrote, its pickle read without running it: the tensors' shapes and sizes.

    :param data: The member
    :param name: What to call it
    :raises ArchiveError: if it is anything but tensors, numbers and strings in containers
    """

    def __init__(self, data: bytes, name: str):
        self._data = data
        self._archive = archive = Archive(io.BytesIO(data), name)
        self.tensors: list[TensorInfo] = []
        roots = {member.split("/")[0] for member in archive.sizes}
        if len(roots) != 1:
            raise archive.error("is no file of torch")
        (self._root,) = roots
        known = {"data.pkl", "byteorder", "version", ".format_version", ".storage_alignment", ".data/serialization_id"}
        for member in archive.sizes:
            part = member[len(self._root) + 1 :]
            if part not in known and not (part.startswith("data/") and part[5:].isdecimal()):
                raise archive.error(f"has an unknown member {member!r:.100}")
        order = f"{self._root}/byteorder"
        if order in archive.sizes and archive.bytes(order, 10) != b"little":
            raise archive.error("has numbers in another byte order")
        #: The object, with descriptions for tensors
        self.content = self._read(archive.bytes(f"{self._root}/data.pkl", _MAX_PICKLE_BYTES))

    def load(self) -> Any:
        """
        :return: The object, its tensors on the CPU
        """
        try:
            return th.load(io.BytesIO(self._data), map_location="cpu", weights_only=True)
        except Exception as error:  # of torch's readers, which have no common error
            raise self._archive.error(f"cannot be read by torch ({one_line(error)})") from error

    def _read(self, pickle: bytes) -> Any:
        try:
            return self._interpret(pickle)
        except ArchiveError:
            raise
        except Exception as error:  # a stack that is empty, a key that cannot be hashed, ...
            raise self._archive.error(f"has a damaged pickle ({one_line(error)})") from error

    def _interpret(self, pickle: bytes) -> Any:
        stack: list[Any] = []
        memo: dict[int, Any] = {}

        def pop_mark() -> list[Any]:
            start = len(stack) - 1 - stack[::-1].index(_MARK)
            items = stack[start + 1 :]
            del stack[start:]
            return items

        for opcode, argument, _ in pickletools.genops(pickle):
            op = opcode.name
            if op == "STOP":
                (result,) = stack
                return result
            if op in _NUMBERS:
                stack.append(argument)
            elif op in _CONSTANTS:
                stack.append(_CONSTANTS[op])
            elif op == "MARK":
                stack.append(_MARK)
            elif op in ("BINPUT", "LONG_BINPUT"):
                memo[expect(int, argument)] = stack[-1]
            elif op in ("BINGET", "LONG_BINGET"):
                stack.append(self._shared(memo[expect(int, argument)]))
            elif op == "GLOBAL":
                if argument not in _GLOBALS:
                    raise self._archive.error(f"names {argument!r:.100}, which no state dict of tensors needs")
                stack.append(_Global(argument.split()[1]))
            elif op in ("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"):
                n_items = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}.get(op)
                items = pop_mark() if n_items is None else [stack.pop() for _ in range(n_items)][::-1]
                stack.append(tuple(items))
            elif op == "EMPTY_LIST":
                stack.append([])
            elif op == "EMPTY_DICT":
                stack.append({})
            elif op in ("APPEND", "APPENDS"):
                items = pop_mark() if op == "APPENDS" else [stack.pop()]
                expect(list, stack[-1]).extend(items)
            elif op in ("SETITEM", "SETITEMS"):
                items = pop_mark() if op == "SETITEMS" else [stack.pop(), stack.pop()][::-1]
                expect(dict, stack[-1]).update(zip(items[::2], items[1::2], strict=True))
            elif op == "BINPERSID":
                stack.append(self._storage(*stack.pop()))
            elif op == "REDUCE":
                arguments = stack.pop()
                stack.append(self._call(stack.pop(), *arguments))
            elif op == "BUILD":
                stack.pop()  # versions of modules, which are not needed
                expect(dict, stack[-1])
            elif op != "PROTO":
                raise self._archive.error(f"has the pickle instruction {op}, which no state dict of tensors needs")
        raise ValueError("no end")

    def _shared(self, value: Any) -> Any:
        """A value that is used twice: not a container of containers, which could be a tree without end."""
        parts = value if isinstance(value, tuple) and not isinstance(value, TensorInfo | _Storage | _Global) else ()
        if isinstance(value, list | dict) or any(isinstance(part, tuple | list | dict) for part in parts):
            raise self._archive.error("uses one container in two places")
        return value

    def _storage(self, kind: str, storage: "_Global", key: str, location: str, numel: int) -> _Storage:
        dtype = _STORAGES[expect(_Global, storage).name]
        member = f"{self._root}/data/{key}"
        if kind != "storage" or self._archive.sizes.get(member) != expect(int, numel) * dtype.itemsize:
            raise self._archive.error(f"has no {numel!r:.20} numbers of {dtype} in {member!r:.50}")
        return _Storage(dtype, numel)

    def _call(self, function: "_Global", *arguments: Any) -> Any:
        name = expect(_Global, function).name
        if name == "OrderedDict" and not arguments:
            return OrderedDict()
        if name == "_rebuild_parameter":
            return expect(TensorInfo, arguments[0])
        if name != "_rebuild_tensor_v2":
            raise self._archive.error(f"calls {name} with arguments")
        storage, offset, shape, strides = arguments[:4]
        dtype, numel = expect(_Storage, storage)
        if not all(type(number) is int and number >= 0 for number in (offset, *shape, *strides)):
            raise self._archive.error("has a tensor of an impossible shape")
        size = math.prod(shape)
        last = offset + sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
        if size > numel or (size and last >= numel):
            raise self._archive.error(f"has a tensor of shape {shape!s:.50} with {numel} numbers")
        tensor = TensorInfo(dtype, shape)
        self.tensors.append(tensor)
        return tensor


class _Global(NamedTuple):
    """A name that a pickle refers to."""

    name: str


def expect(kind: type, value: Any) -> Any:
    if not isinstance(value, kind) or (kind is int and value is bool):
        raise ValueError(f"{type(value).__name__} instead of {kind.__name__}")
    return value


class Allowance(TorchDispatchMode):
    """Within this context no tensor is made that is far larger than those that an archive brings for it.

    :param tensors: Descriptions of the archive's tensors
    :param name: What to call the archive
    """

    def __init__(self, tensors: list[TensorInfo], name: str):
        super().__init__()
        sizes = [math.prod(tensor.shape) for tensor in tensors]
        self._largest = max([2**20, *sizes])
        # Initial values need some copies of the weights.
        self._left = 2**24 + 4 * sum(sizes)
        self._n_left = 1000 + 20 * len(sizes)
        self._name = name

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        # What makes a tensor from nothing has a shape before any tensor; the rest is no larger than what it is made of.
        shapes = [arg for arg in args if isinstance(arg, list | tuple) and all(isinstance(n, int) for n in arg)]
        from_nothing = not any(isinstance(arg, th.Tensor) for arg in args)
        if shapes and (from_nothing or func.name().startswith("aten::new_")):
            size = math.prod(shapes[0])
            self._left -= size
            self._n_left -= 1
            if size > self._largest or self._left < 0 or self._n_left < 0:
                raise ArchiveError(
                    f"{self._name} describes networks that its weights do not fill (a tensor of shape "
                    f"{tuple(shapes[0])!s:.50}, or too many): it is damaged, or was made to exhaust memory."
                )
        return func(*args, **(kwargs or {}))


# ----------------------------------------------------------- checks


def check_parameters(model: "CuReSAC", params: dict[str, Any], name: str, exact_match: bool = True) -> None:
    """Names, shapes, types and finiteness of parameters, before any of them is set.

    :param model: The model that they are for
    :param params: State dicts by name
    :param name: What to call their origin
    :param exact_match: Whether all of the model's parameters have to be there, and of its types
    :raises ArchiveError: for the first that does not fit, in one sentence
    """
    expected = {*model._get_torch_save_params()[0]}
    different = expected ^ params.keys() if exact_match else params.keys() - expected
    if different:
        some = sorted(different)[0]
        what = "lacks" if some in expected else "has unknown"
        raise ArchiveError(f"{name} {what} parameters {some!r:.100}: it belongs to a model with other settings.")
    for key, state in params.items():
        owner = recursive_getattr(model, key)
        path = f"{name}: {key}"
        if isinstance(owner, th.optim.Optimizer):
            _check_optimizer(owner, state, path)
        elif isinstance(owner, EncoderOptimizer):
            if expect_keys(state, {"optimizers", "mean_squares", "weights", "n_steps"}, path)["optimizers"].keys() == (
                owner.optimizers.keys()
            ):  # else its own refusal says more
                for part, optimizer in owner.optimizers.items():
                    _check_optimizer(optimizer, state["optimizers"][part], f"{path}[{part!r}]")
            for part in ("mean_squares", "weights"):
                for source, value in state[part].items():
                    check_tensor(th.as_tensor(value), (), path, source)
            whole(state["n_steps"])
        else:
            own = getattr(owner, "_orig_mod", owner).state_dict()
            if exact_match:
                expect_keys(state, own.keys(), path)
            for part in own.keys() & state.keys():
                check_tensor(state[part], own[part].shape, path, part, own[part].dtype if exact_match else None)


def expect_keys(state: Any, keys: Any, path: str) -> dict[str, Any]:
    if not isinstance(state, dict) or state.keys() != keys:
        different = sorted(map(str, state.keys() ^ keys)) if isinstance(state, dict) else [type(state).__name__]
        raise ArchiveError(
            f"{path} differs in {len(different)} names from this model's, the first of them {different[0]!r:.100}: it "
            "belongs to a model with other settings."
        )
    return state


def check_tensor(value: Any, shape: tuple[int, ...], path: str, part: object, dtype: th.dtype | None = None) -> None:
    if not isinstance(value, th.Tensor) or value.shape != shape or dtype not in (None, value.dtype):
        kind = f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, th.Tensor) else type(value).__name__
        raise ArchiveError(
            f"{path} has {part!s:.100} as {kind}, but {dtype or 'numbers'} of shape {tuple(shape)} are expected: it "
            "belongs to a model with other settings."
        )
    if not bool(th.isfinite(value).all()):
        raise ArchiveError(
            f"{path} has {part!s:.100} with values that are not finite: what it was saved from is broken."
        )


def _check_optimizer(optimizer: th.optim.Optimizer, state: Any, path: str) -> None:
    expect_keys(state, {"state", "param_groups"}, path)
    own_groups, groups = optimizer.state_dict()["param_groups"], state["param_groups"]
    if not isinstance(groups, list) or len(groups) != len(own_groups):
        raise ArchiveError(f"{path} has other groups of parameters than this model: it belongs to other settings.")
    for own, group in zip(own_groups, groups, strict=True):
        expect_keys(group, own.keys(), path)
        for key, value in own.items():
            given = group[key]
            switch = isinstance(value, bool) == isinstance(given, bool) or None in (value, given)
            if given != value if key == "params" else not (switch and _is_option(given)):
                raise ArchiveError(f"{path} has the option {key}={given!s:.50}: it is damaged.")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    needed = {"step", "exp_avg", "exp_avg_sq"} if isinstance(optimizer, th.optim.Adam) else set()
    for index, moments in expect(dict, state["state"]).items():
        if type(index) is not int or not 0 <= index < len(parameters) or not isinstance(moments, dict):
            raise ArchiveError(
                f"{path} has a state for the parameter {index!s:.50}, which does not exist: it is damaged."
            )
        if not needed <= moments.keys():
            raise ArchiveError(
                f"{path} lacks {sorted(needed - moments.keys())[0]!r} of parameter {index}: it is damaged."
            )
        for part, value in moments.items():
            if part in ("exp_avg", "exp_avg_sq") or (isinstance(value, th.Tensor) and value.numel() != 1):
                check_tensor(value, parameters[index].shape, path, part)
            elif isinstance(value, th.Tensor):
                check_tensor(value, value.shape, path, part)
            elif not _is_option(value):
                raise ArchiveError(f"{path} has {part!s:.50}={value!s:.50}: it is damaged.")


def _is_option(value: Any) -> bool:
    """What an optimiser's groups hold: numbers, switches, and pairs of numbers."""
    if isinstance(value, tuple | list):
        return len(value) < 10 and all(is_number(item) for item in value)
    return value is None or isinstance(value, bool | str) or is_number(value)
