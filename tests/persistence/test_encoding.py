"""States without pickle: every type comes back with its bits, and broken or hostile files are refused."""

import io
import math
import struct
from collections import OrderedDict, deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.torch import load_file

from benchmarks.fuzz import parts_of, safetensors_of, watching
from sb3_cure.persistence import ArchiveError, encoding, read_state, write_state

TENSOR_DTYPES = [th.uint8, th.int16, th.int64, th.bool, th.bfloat16, th.float16, th.float32, th.float64]

numeric_dtypes = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="="),
    hnp.unsigned_integer_dtypes(endianness="="),
    hnp.floating_dtypes(endianness="=", sizes=(16, 32, 64)),
)


@st.composite
def arrays(draw: st.DrawFn) -> np.ndarray:
    """Arrays of any numbers and shape (empty and 0-dimensional ones too), in any order in memory, with gaps or not."""
    array = draw(hnp.arrays(draw(numeric_dtypes), hnp.array_shapes(min_dims=0, min_side=0, max_side=4)))
    order = draw(st.sampled_from(["C", "F", "reversed", "strided"]))
    if order == "reversed" and array.ndim:
        return array[::-1]
    if order == "strided" and array.ndim:
        return np.repeat(array, 2, axis=0)[::2]
    return np.asarray(array, order="F" if order == "F" else "C")


@st.composite
def tensors(draw: st.DrawFn) -> th.Tensor:
    """Tensors of random bits in any dtype, shape and memory layout."""
    dtype = draw(st.sampled_from(TENSOR_DTYPES))
    shape = draw(hnp.array_shapes(min_dims=0, min_side=0, max_side=4))
    data = th.tensor(list(draw(st.binary(min_size=16, max_size=64))) * 300, dtype=th.uint8)
    data = data[: math.prod(shape) * dtype.itemsize]
    tensor = (data % 2 if dtype is th.bool else data).view(dtype).view(shape)
    tensor = tensor.permute(draw(st.permutations(range(tensor.dim()))))
    return tensor[..., ::2] if tensor.dim() and draw(st.booleans()) else tensor


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(allow_nan=False),
    st.text(st.characters()),
    st.binary(),
    arrays(),
    hnp.arrays(numeric_dtypes, ()).map(lambda array: array[()]),
    tensors(),
)
values = st.recursive(
    leaves,
    lambda children: st.one_of(
        st.lists(children),
        st.lists(children).map(tuple),
        st.dictionaries(st.one_of(st.text(), st.integers(), st.just("!tuple")), children),
        st.dictionaries(st.text(), children).map(OrderedDict),
        st.tuples(st.lists(children, max_size=3), st.sampled_from([None, 3, 7])).map(lambda pair: deque(*pair)),
    ),
    max_leaves=8,
)


def same(first: Any, second: Any) -> bool:
    """Whether two states have the same types and the same bits."""
    if type(first) is not type(second):
        return False
    if isinstance(first, th.Tensor):
        bits = [tensor.contiguous().as_strided((tensor.numel(),), (1,)).view(th.uint8) for tensor in (first, second)]
        return first.dtype == second.dtype and first.shape == second.shape and th.equal(*bits)
    if isinstance(first, np.ndarray | np.generic):
        return first.dtype == second.dtype and first.shape == second.shape and np.array_equal(first, second, True)
    if isinstance(first, dict):
        return list(first) == list(second) and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple | deque):
        alike = len(first) == len(second) and all(map(same, first, second))
        return alike and getattr(first, "maxlen", None) == getattr(second, "maxlen", None)
    return bool(first == second)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.dictionaries(st.text(), values))
def test_state_comes_back_to_the_bit(state: dict[str, Any]) -> None:
    write_state(file := io.BytesIO(), state)
    file.seek(0)
    assert same(state, read_state(file))


def test_special_floats_come_back() -> None:
    write_state(file := io.BytesIO(), {"floats": [math.inf, -math.inf, math.nan], "number": np.float32(-math.inf)})
    file.seek(0)
    state = read_state(file)
    assert state["floats"][:2] == [math.inf, -math.inf] and math.isnan(state["floats"][2])
    assert same(state["number"], np.float32(-math.inf))


def test_what_could_not_be_read_back_is_not_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """safetensors reads headers up to a size."""
    monkeypatch.setattr(encoding, "LARGEST_HEADER", 1000)
    write_state(io.BytesIO(), {"log": [0.5] * 100})
    with pytest.raises(OSError, match="no arrays"):
        write_state(file := io.BytesIO(), {"log": [0.5] * 1000})
    assert file.getvalue() == b""


def test_shared_tensors_are_written_twice(tmp_path: Path) -> None:
    """Also where one is a part of the other, or transposed; safetensors itself reads the file."""
    whole = th.arange(12.0).reshape(3, 4)
    state = {"whole": whole, "row": whole[1], "turned": whole.T, "again": whole, "number": th.tensor(3.0)}
    write_state(tmp_path / "state", state)
    assert same(state, read_state(tmp_path / "state"))
    assert th.equal(load_file(tmp_path / "state")["state.turned"], whole.T)


class Own(OrderedDict):
    """A user's class."""


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (lambda: 0, r"the function .*lambda"),
        (Own, r"the class .*test_encoding.Own"),
        (Own(), r"of the type .*test_encoding.Own"),
        (np.array([None]), "of the type numpy.ndarray"),
        (np.zeros(2, dtype=[("x", "f4")]), "of the type numpy.ndarray"),
        (th.eye(2).to_sparse(), "of the type torch.Tensor"),
        ({1: object()}, "of the type builtins.object"),
    ],
)
def test_other_types_are_refused(value: Any, what: str, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=rf"state.a.1.* is {what}"):
        write_state(tmp_path / "state", {"a": [0, value]})
    assert not (tmp_path / "state").exists()


# ------------------------------------------------------------------ files that lie

HONEST = {"numbers": np.arange(6, dtype=np.float32).reshape(2, 3), "flags": np.array([True, False])}


def honest() -> bytes:
    write_state(file := io.BytesIO(), HONEST)
    return file.getvalue()


def with_entry(name: str, **changes: Any) -> bytes:
    """The state with another entry in its header."""
    header, body = parts_of(honest())
    header[name] |= changes
    return safetensors_of(header, body)


def with_json(text: str) -> bytes:
    """The state with other JSON."""
    header, body = parts_of(honest())
    header["__metadata__"]["state"] = text
    return safetensors_of(header, body)


LIES = {
    "nothing": lambda: b"",
    "half a file": lambda: honest()[: len(honest()) // 2],
    "a byte missing": lambda: honest()[:-1],
    "a header beyond the file": lambda: struct.pack("<Q", 2**40) + honest()[8:],
    "no header": lambda: struct.pack("<Q", 2) + b"[]",
    "offsets beyond the file": lambda: with_entry("state.numbers", data_offsets=[0, 2**40]),
    "offsets that overlap": lambda: with_entry("state.flags", data_offsets=[0, 2]),
    "a larger shape": lambda: with_entry("state.numbers", shape=[2**40, 3]),
    "a negative shape": lambda: with_entry("state.numbers", shape=[-2, -3]),
    "a larger dtype": lambda: with_entry("state.numbers", dtype="F64"),
    "no dtype": lambda: with_entry("state.numbers", dtype="spam"),
    "numbers as an array of bf16": lambda: with_entry("state.numbers", dtype="BF16", shape=[2, 6]),
    "deep JSON": lambda: with_json("[" * 100_000 + "]" * 100_000),
    "no JSON": lambda: with_json("spam"),
    "a number of 5000 digits": lambda: with_json("9" * 5000),
    "an unknown tag": lambda: with_json('{"a": {"!eval": "1"}}'),
    "an unknown name": lambda: with_json('{"a": {"!name": "os.system"}}'),
    "a class for a number": lambda: with_json('{"a": {"!number": ["torch.optim.adam.Adam", 1]}}'),
    "a generator by name": lambda: with_json('{"a": {"!Generator": {"bit_generator": "os.system"}}}'),
    "two tags": lambda: with_json('{"a": {"!float": "1", "!name": "x"}}'),
    "an array that is not there": lambda: with_json('{"a": {"!array": "spam"}}'),
}


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("is_path", [True, False], ids=["path", "file"])
def test_files_that_lie_are_refused(name: str, is_path: bool, tmp_path: Path) -> None:
    data = LIES[name]()
    (tmp_path / "state").write_bytes(data)
    with watching() as events, pytest.raises(ArchiveError) as error:
        read_state(tmp_path / "state" if is_path else io.BytesIO(data))
    assert events == [] and str(error.value).isprintable()
