"""Mutate models, replay buffers and states, load them, and count what happens; write ``results/robustness/fuzz.json``.

python -m benchmarks.fuzz --inputs 10000

Every input has to be loaded (where the mutation left something valid) or refused by an error; none may unpickle by
class, start a process or write a file. Settings may ask for more memory or time than there is, which is counted apart.
"""

import argparse
import contextlib
import io
import json
import random
import resource
import signal
import struct
import sys
import time
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cure import CuReSAC
from sb3_cure.evaluation.result_files import describe_run
from sb3_cure.persistence import read_state, write_state

#: Limits of a load: memory beyond what the process had before, bytes, and time, seconds
MEMORY, SECONDS = 2**29, 10
#: What no load of an untrusted file may do (Python's audit events); writing files is found out by the mode
FORBIDDEN = ("pickle.find_class", "os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork")

_events: list[str] | None = None
_hooked = False


class Dots(gym.Env):
    """Random images, small and stacked, to fill a replay buffer with."""

    frame_stack = 2
    observation_space = spaces.Box(0, 255, (2, 12, 12), np.uint8)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return self._observe(), float(self.np_random.random()), self.np_random.random() < 0.2, False, {}

    def _observe(self) -> np.ndarray:
        return self.np_random.integers(0, 256, (2, 12, 12), dtype=np.uint8)


@cache
def example_model() -> CuReSAC:
    """Small model whose archive is mutated.

    :return: The smallest model that has everything: a head with buffers, a curious agent, a replay buffer
    """
    encoder = dict(n_filters=2, n_layers=2, features_dim=4)
    model = CuReSAC(
        "CnnPolicy",
        Dots(),
        srl="curl",
        srl_kwargs=dict(bank_size=3),
        augmentation_kwargs=dict(pad=1),
        policy_kwargs=dict(net_arch=[4], features_extractor_kwargs=encoder),
        learning_starts=10,
        batch_size=4,
        buffer_size=30,
        precision="fp32",
        seed=0,
        device="cpu",
    )
    return model.learn(25)


@cache
def examples() -> dict[str, bytes]:
    """Files to mutate.

    :return: The files to mutate, by what they are
    """
    model, files = example_model(), {kind: io.BytesIO() for kind in ("model", "buffer", "state")}
    model.save(files["model"])
    model.save_replay_buffer(files["buffer"])
    state = {"numbers": np.arange(12.0).reshape(3, 4), "flags": [True, None, float("nan")], "weights": th.zeros(2, 3)}
    write_state(files["state"], {**state, "bytes": b"abc", "pair": (1, 2**70), "scalar": np.float32(1)})
    return {kind: file.getvalue() for kind, file in files.items()}


def load(kind: str, data: bytes) -> None:
    """Load a mutated file as users do.

    :param kind: ``"model"``, ``"buffer"`` or ``"state"``
    :param data: The file's bytes
    """
    file = io.BytesIO(data)
    if kind == "model":
        CuReSAC.load(file, device="cpu")
    elif kind == "buffer":
        model = example_model()
        own = model.replay_buffer
        try:
            model.load_replay_buffer(file)
        finally:
            model.replay_buffer = own
    else:
        read_state(file)


# ------------------------------------------------------------------ outcomes


def _hook(event: str, arguments: tuple) -> None:
    if _events is None:
        return
    writes = event == "open" and isinstance(arguments[1], str) and any(mode in arguments[1] for mode in "wax+")
    if event in FORBIDDEN or writes:
        _events.append(f"{event}{arguments!s:.200}")


@contextlib.contextmanager
def watching() -> Iterator[list[str]]:
    """Watch for side effects of loading.

    :return: What was done within this context that no load of an untrusted file may do
    """
    global _events, _hooked
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked = True
    events: list[str] = []
    _events = events
    try:
        yield events
    finally:
        _events = None


@contextlib.contextmanager
def limited_memory() -> Iterator[None]:
    """Within this context the process has ``MEMORY`` more bytes of addresses than it has now, and no more."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@contextlib.contextmanager
def limited_time() -> Iterator[None]:
    """Raises a TimeoutError in this context after ``SECONDS``."""

    def late(*_: Any) -> None:
        raise TimeoutError

    former = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


def outcome(loads: Callable[[], None]) -> str:
    """Classify the result of loading a mutated file.

    :param loads: Loads something
    :return: ``"loaded"``, ``"refused"``, ``"asked for too much"``, or what it did that it may not
    """
    result = "loaded"
    with watching() as events, limited_memory(), limited_time(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            loads()
        except Exception as error:
            causes = [error, error.__cause__, error.__context__]
            is_large = any(isinstance(each, MemoryError | TimeoutError) for each in causes) or "allocate" in str(error)
            result = "asked for too much" if is_large else "refused"
    return f"did {events}" if events else result


# ----------------------------------------------------------------- mutations


def members_of(data: bytes) -> dict[str, bytes]:
    """Members of an archive.

    :param data: A zip file
    :return: Its members
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zip_of(members: dict[str, bytes]) -> bytes:
    """Build an archive from its members.

    :param members: Contents by name
    :return: A zip file that stores them
    """
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def mutate(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Mutate bytes.

    :param data: A file of ``examples``
    :param rng: Source of randomness
    :return: Kind of the mutation, and the mutated file
    """
    if data[:2] != b"PK":  # a safetensors file, whose header holds the JSON of the state
        header, body = parts_of(data)
        kind = rng.choice(["bytes", "header", "json", "json"])
        if kind == "json":
            header["__metadata__"]["state"] = json.dumps(_changed(json.loads(header["__metadata__"]["state"]), rng))
        elif kind == "header":
            header = _changed(header, rng)
        return kind, _damaged(data, rng) if kind == "bytes" else safetensors_of(header, body)
    kind = rng.choice(["bytes", "directory", "members", "content", "json", "json", "json", "header", "header"])
    members = members_of(data)
    if kind == "bytes":
        return kind, _damaged(data, rng)
    if kind == "directory":
        start = data.rindex(b"PK\1\2", 0, -22) if rng.random() < 0.5 else data.index(b"PK\1\2")
        return kind, data[:start] + _damaged(data[start:], rng)
    if kind == "members":
        names = list(members)
        first, second = rng.choice(names), rng.choice(names)
        action = rng.choice(["drop", "rename", "swap"])
        if action == "swap":
            members[first], members[second] = members[second], members[first]
        else:
            content = members.pop(first)
            if action == "rename":
                members[rng.choice([first + "x", "../" + first, "/" + first, first.upper()])] = content
        return kind, zip_of(members)
    if kind == "json":
        members["data"] = json.dumps(_changed(json.loads(members["data"]), rng)).encode()
    elif kind == "header":
        header, body = parts_of(members["tensors.safetensors"])
        members["tensors.safetensors"] = safetensors_of(_changed(header, rng), body)
    else:
        name = rng.choice(list(members))
        members[name] = _damaged(members[name], rng)
    return kind, zip_of(members)


def parts_of(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and data of a safetensors file.

    :param data: A safetensors file
    :return: Its header and the bytes of its tensors
    """
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def safetensors_of(header: Any, body: bytes) -> bytes:
    """Build a safetensors file from header and data.

    :param header: Header, or anything else
    :param body: Bytes of the tensors
    :return: A safetensors file
    """
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def _damaged(data: bytes, rng: random.Random) -> bytes:
    damaged = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5])):
        at, length = rng.randrange(len(damaged) + 1), rng.choice([1, 2, 4, 8, 100])
        action = rng.choice(["flip", "number", "cut", "remove", "repeat", "insert"])
        if action == "flip" and at < len(damaged):
            damaged[at] ^= 1 << rng.randrange(8)
        elif action == "number":
            damaged[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1]))
        elif action == "cut" and rng.random() < 0.3:
            del damaged[at:]
        elif action == "remove":
            del damaged[at : at + length]
        elif action == "repeat":
            damaged[at:at] = damaged[at : at + length]
        elif action == "insert":
            damaged[at:at] = rng.randbytes(length)
    return bytes(damaged)


_ODD: list[Any] = [
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**15, 10**400, 1.5, -0.0, 1e308, "", "x", "../x", "\x1b[2J", [], {},
    [0], {"!name": "os.system"}, {"!name": "torch.nn.modules.activation.ReLU"}, {"!array": "x"}, {"!tensor": "x"},
    {"!tuple": [1, 2]}, {"!float": "nan"}, {"!Path": "/"}, {"!not saved": "anything"}, {"!dict": []},
    {"!number": ["numpy.float32", 1]}, {"!deque": [None, []]},
]  # fmt: skip


def _changed(node: Any, rng: random.Random) -> Any:
    """Return JSON with one part changed, removed, renamed, repeated or nested."""
    if isinstance(node, dict | list) and node and rng.random() < 0.93:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = rng.choice(keys)
        changed: Any = dict(node) if isinstance(node, dict) else list(node)
        action = rng.random()
        if action < 0.06:
            del changed[key]
        elif action < 0.1 and isinstance(node, dict):
            changed[rng.choice(["policy", "__class__", "train", "!Box", "!tuple", key + "_"])] = changed.pop(key)
        elif action < 0.13 and isinstance(node, list):
            changed += [changed[key]] * rng.choice([1, 1000])
        else:
            changed[key] = _changed(node[key], rng)
        return changed
    if type(node) is int and rng.random() < 0.5:
        return rng.choice([node + 1, -node, node * 10**6, node + 0.5, 10**15])
    odd = rng.choice(_ODD)
    for _ in range(rng.choice([0, 0, 0, 50])):
        odd = [odd]
    return odd


def fuzz(n_inputs: int, seed: int = 0) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Mutate files and load them.

    :param n_inputs: How many files to make and load
    :param seed: Of the mutations
    :return: Counts by kind of file and outcome, and what went wrong
    """
    rng = random.Random(seed)
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in examples()}
    failures = []
    for number in range(n_inputs):
        kind = rng.choice(list(counts))
        mutation, data = mutate(examples()[kind], rng)
        result = outcome(lambda kind=kind, data=data: load(kind, data))  # type: ignore[misc]
        if result not in ("loaded", "refused", "asked for too much"):
            failures.append(f"input {number} (seed {seed}, {kind}, {mutation}): {result}")
            result = "failed"
        counts[kind][f"{mutation}: {result}"] += 1
    return {kind: dict(sorted(count.items())) for kind, count in counts.items()}, failures


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/robustness"))
    arguments = parser.parse_args()
    th.set_num_threads(1)
    start = time.time()
    counts, failures = fuzz(arguments.inputs, arguments.seed)
    totals: Counter[str] = Counter()
    for count in counts.values():
        for name, number in count.items():
            totals[name.split(": ")[1]] += number
    report = {
        "inputs": arguments.inputs,
        "seed": arguments.seed,
        "totals": dict(totals),
        "by_file_and_mutation": counts,
        **describe_run(),
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "fuzz.json").write_text(json.dumps({**report, "failures": failures}, indent=2) + "\n")
    print(f"{arguments.inputs} inputs in {time.time() - start:.0f} s: {dict(totals)}")
    print("\n".join(failures[:20]))
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
