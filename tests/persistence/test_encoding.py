"""States without pickle: every type comes back with its bits, and broken or hostile files get one sentence."""

import io
import math
import struct
import tracemalloc
from collections import OrderedDict, deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sb3_cure.persistence import read_state, write_state

# ------------------------------------------------------------------ round trip

TENSOR_DTYPES = [
    th.uint8, th.int8, th.int16, th.int32, th.int64, th.bool, th.bfloat16, th.float16, th.float32, th.float64,
    th.complex64, th.float8_e4m3fn,
]  # fmt: skip

numeric_dtypes = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="?"),
    hnp.unsigned_integer_dtypes(endianness="?"),
    hnp.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    hnp.complex_number_dtypes(endianness="?", sizes=(64, 128)),
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
    st.sampled_from([2**64, -(2**64), 10**4000]),
    st.floats(),
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
        st.dictionaries(st.text(), children),
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
        return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    if isinstance(first, float):
        return struct.pack("d", first) == struct.pack("d", second)
    if isinstance(first, dict):
        return list(first) == list(second) and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple | deque):
        alike = len(first) == len(second) and all(map(same, first, second))
        return alike and getattr(first, "maxlen", None) == getattr(second, "maxlen", None)
    return bool(first == second)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.dictionaries(st.text(), values))
def test_round_trip(state: dict[str, Any]) -> None:
    """What is read is what was written, to the type and the bit, and writing that gives the same bytes."""
    file, again = io.BytesIO(), io.BytesIO()
    write_state(file, state)
    read = read_state(file)
    assert same(state, read)
    write_state(again, read)
    assert len(again.getvalue()) == len(file.getvalue())


def test_memory_order_survives() -> None:
    """Convolutions sum in another order when their weights lie otherwise in memory: channels last stays so."""
    weights = th.randn(4, 3, 3, 3).to(memory_format=th.channels_last)
    array = np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4)))
    file = io.BytesIO()
    write_state(file, {"weights": weights, "array": array})
    read = read_state(file)
    assert read["weights"].stride() == weights.stride() and th.equal(read["weights"], weights)
    assert read["array"].flags.f_contiguous and np.array_equal(read["array"], array)


def test_no_second_copy(tmp_path: Path) -> None:
    """Writing an array, also a part of a mapped file, needs next to no memory; reading needs the array alone."""
    mapped = np.memmap(tmp_path / "frames", dtype=np.uint8, mode="w+", shape=(64, 2**20))
    mapped[:] = np.arange(64, dtype=np.uint8)[:, None]
    tracemalloc.start()
    try:
        write_state(tmp_path / "state", {"frames": mapped[:60], "strided": mapped[::2]})
        assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
        tracemalloc.reset_peak()
        read = read_state(tmp_path / "state")
        assert tracemalloc.get_traced_memory()[1] < (60 + 32 + 8) * 2**20
    finally:
        tracemalloc.stop()
    assert type(read["frames"]) is np.ndarray
    assert np.array_equal(read["frames"], mapped[:60]) and np.array_equal(read["strided"], mapped[::2])


@pytest.mark.parametrize(
    "value, sentence",
    [
        (object(), r"state\['a'\]\[1\] is a builtins.object, which cannot"),
        (lambda: 0, r"state\['a'\]\[1\] is a builtins.function, which cannot"),
        (np.array([None]), r"state\['a'\]\[1\] is a numpy.ndarray of dtype object, which cannot"),
        (np.zeros(2, dtype=[("x", "f4")]), r"of dtype \[\('x', '<f4'\)\], which cannot"),
        (np.array(["text"]), r"of dtype <U4, which cannot"),
        (np.datetime64("2020-01-01"), r"of dtype datetime64\[D\], which cannot"),
        (th.eye(2).to_sparse(), r"torch.Tensor of layout torch.sparse_coo, which cannot"),
        (th.nn.Parameter(th.zeros(1)), r"torch.nn.parameter.Parameter"),
        (OrderedDict(), r"state\['a'\]\[1\] is a collections.OrderedDict, which cannot"),
        ({1: 2}, r"state\['a'\]\[1\] has the key 1 \(int\), but only str keys"),
        ({"b": {1, 2}}, r"state\['a'\]\[1\]\['b'\] is a builtins.set, which cannot"),
    ],
)
def test_other_types_are_refused(value: Any, sentence: str, tmp_path: Path) -> None:
    """What cannot be saved is named with its place, and no file is made."""
    with pytest.raises(TypeError, match=sentence):
        write_state(tmp_path / "state", {"a": [0, value]})
    assert not (tmp_path / "state").exists()


def test_a_state_that_contains_itself_is_refused(tmp_path: Path) -> None:
    """No endless recursion."""
    state: dict[str, Any] = {}
    state["self"] = state
    with pytest.raises(TypeError, match="nested deeper than 32"):
        write_state(tmp_path / "state", state)
    deep: Any = 1
    for i in range(32):
        deep = [deque([deep]), (deep,)][i % 2]
    file = io.BytesIO()
    write_state(file, {"deep": deep[0]})
    assert same(read_state(file)["deep"], deep[0])
