"""Kill a training at every point where it writes a checkpoint, fill its disk, damage its files: and see what is lost.

python -m benchmarks.faults --out results/robustness (an hour; with --points 40, three minutes)

Each fault hits a copy of a folder with two generations while a third is written (or after it was), in a child process.
Then the training is resumed, and must be in exactly the state of the newest generation that can be whole; and the
next checkpoint must be written and read as if nothing had been.
"""

import argparse
import builtins
import errno
import hashlib
import io
import os
import shutil
import signal
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

from sb3_cure import CuReSAC
from sb3_cure.data.buffers import transitions
from sb3_cure.evaluation.result_files import describe_run, write_json
from sb3_cure.persistence import CheckpointError, write_state
from sb3_cure.persistence.checkpoints import CheckpointFolder
from sb3_cure.persistence.resume import load_random_state, random_state

#: Generations to keep, in the folder that the faults hit
KEEP = 2
#: How a write may fail: killed before it, killed half-way through it, refused for want of room
FAILURES = ("kill", "torn", "full disk")
#: How a file may be damaged
DAMAGES = ("emptied", "halved", "lost", "first bit", "middle bit", "last bit", "longer")


class Fault(NamedTuple):
    """What goes wrong.

    :param kind: One of ``FAILURES`` or ``DAMAGES``
    :param point: Number of the write that fails, or None
    :param file: Name of the file that is damaged, inside the folder of checkpoints, or None
    """

    kind: str
    point: int | None = None
    file: str | None = None


class Outcome(NamedTuple):
    """What came of a fault.

    :param fault: What went wrong
    :param resumed: ``"newest"``, ``"former"`` or ``"nothing"`` (if both need the file); else what is wrong with it
    :param expected: Whether that is the best that the fault allows
    """

    fault: Fault
    resumed: str
    expected: bool


class _Dots(gym.Env):
    """A moving dot, seen as two frames."""

    frame_stack = 2
    observation_space = spaces.Box(0, 255, (6, 16, 16), np.uint8)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self) -> None:
        self.position, self.n_steps = 0, 0

    def _observe(self) -> np.ndarray:
        frames = np.zeros((6, 16, 16), np.uint8)
        frames[:3, (self.position - 1) % 16] = frames[3:, self.position % 16] = 255
        frames[:, 0, 0] = self.n_steps
        return frames

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position, self.n_steps = int(self.np_random.integers(16)), 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> Any:
        self.position += 1
        self.n_steps += 1
        return self._observe(), float(action[0]), False, self.n_steps == 20, {}

    def state_dict(self) -> dict[str, Any]:
        return {"position": self.position, "n_steps": self.n_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.position, self.n_steps = state["position"], state["n_steps"]


def _make_model() -> CuReSAC:
    return CuReSAC(
        "CnnPolicy",
        _Dots(),
        buffer_size=60,
        learning_starts=5,
        batch_size=4,
        warmup_updates=0,
        precision="fp32",
        seed=0,
        device="cpu",
        policy_kwargs=dict(net_arch=[4], features_extractor_kwargs=dict(n_filters=2, n_layers=2, features_dim=4)),
    )


def _digest(model: CuReSAC) -> str:
    """Digest of everything that a checkpoint holds."""
    digest = hashlib.sha256()

    def take(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value, key=str):
                digest.update(str(key).encode())
                take(value[key])
        elif isinstance(value, list | tuple):
            for each in value:
                take(each)
        elif isinstance(value, np.ndarray | th.Tensor):
            digest.update(np.ascontiguousarray(value).tobytes())
        else:
            digest.update(repr(value).encode())

    buffer: Any = model.replay_buffer
    resumed: Any = model._run.resumed
    take(model.get_parameters())
    rows = (buffer.pos - 1 - np.arange(buffer.size())) % buffer.buffer_size
    take([np.asarray(each) for each in transitions(buffer, rows, np.zeros(len(rows), int))[:5] if each is not None])
    take([model.num_timesteps, model._n_updates, model._last_obs])
    write_state(file := io.BytesIO(), {name: resumed.state[name] for name in ("random", "environments")})
    digest.update(file.getvalue())
    return digest.hexdigest()


def _resume(folder: Path) -> tuple[str, int, list[str]]:
    """Digest, agent steps and warnings of the training that goes on from a folder."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = CuReSAC.resume(folder, _Dots(), device="cpu")
    told = [str(warning.message) for warning in said if issubclass(warning.category, UserWarning)]
    return _digest(model), model.num_timesteps, told


class Site:
    """A folder of checkpoints as it is before the last one is written, and the training that would write that.

    :param folder: Where to work
    """

    def __init__(self, folder: Path):
        self.before, self.work, self.after = folder / "before", folder / "work", folder / "after"
        model = _make_model()
        self.before.mkdir(parents=True)
        writer = CheckpointFolder(self.before)
        for _ in range(3):
            model.learn(21, reset_num_timesteps=False)
            writer.write(model, model._run, KEEP)
        self.former = _resume(self.before)[0]
        self.model, self.writer = model, writer
        model.learn(21, reset_num_timesteps=False)
        self.random = random_state(model)
        self.points = self._write(self.before, self.after, None, "")
        self.newest = _resume(self.after)[0]

    def _write(self, source: Path, target: Path, point: int | None, kind: str) -> int:
        """Write the last checkpoint into a copy of the folder, in a child process that fails at a point.

        :return: Number of points that the child has passed
        """
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
        self.writer.generations.__init__(target)  # type: ignore[misc]
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            load_random_state(self.model, self.random)  # resuming has changed it meanwhile
            count = 0
            try:
                with _failing(target, point, kind) as counter:
                    self.writer.write(self.model, self.model._run, KEEP)
                count = counter()
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    traceback.print_exc()
            except BaseException:
                traceback.print_exc()
            finally:
                os.write(writing, str(count).encode())
                os._exit(0)
        os.close(writing)
        os.waitpid(child, 0)
        count = int(os.read(reading, 20) or 0)
        os.close(reading)
        return count

    def faults(self) -> Iterator[Fault]:
        """All of them."""
        for point in range(self.points):
            for kind in FAILURES:
                yield Fault(kind, point=point)
        for path in sorted(self.after.rglob("*")):
            if path.is_file() and path.name != ".lock":
                for kind in DAMAGES:
                    yield Fault(kind, file=str(path.relative_to(self.after)))

    def suffer(self, fault: Fault) -> Outcome:
        """Inject a fault and classify its outcome.

        :param fault: What goes wrong
        :return: What came of it
        """
        if fault.point is not None:
            self._write(self.before, self.work, fault.point, fault.kind)
            allowed = {"newest", "former"}
        else:
            shutil.rmtree(self.work, ignore_errors=True)
            shutil.copytree(self.after, self.work)
            file = str(fault.file)
            _damage(self.work / file, fault.kind)
            former, newest = (path.parent.name for path in sorted(self.after.glob("generation-*/SHA256SUMS")))
            users = [name for name in (former, newest) if file.startswith(name) or self._needs(name, file)]
            allowed = {"newest" if newest not in users else "former" if former not in users else "nothing"}
        try:
            resumed = self._what_resumes()
        except CheckpointError as error:
            resumed = "nothing" if "is whole" in str(error) else str(error)
        except Exception as error:
            resumed = f"{type(error).__name__}: {error}"
        return Outcome(fault, resumed, resumed in allowed)

    def _needs(self, generation: str, file: str) -> bool:
        return file.startswith("segments") and Path(file).name in (self.after / generation / "SHA256SUMS").read_text()

    def _what_resumes(self) -> str:
        digest, steps, _ = _resume(self.work)
        names = {self.former: "former", self.newest: "newest"}
        resumed = names.get(digest, "another state")
        # It goes on from there as from any other: the next checkpoint is whole.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = CuReSAC.resume(self.work, _Dots(), device="cpu")
        model.set_logger(Logger(None, []))
        model._run.writers[self.work.resolve()].write(model, model._run, KEEP)
        _, again, later = _resume(self.work)
        if again != steps or later:
            return f"{resumed}, and then {again} instead of {steps} steps, saying {later}"
        return resumed


class _failing:
    """Counts what changes files in a folder, and fails at one of these points.

    :param folder: The folder
    :param point: Where to fail, or None
    :param kind: One of ``FAILURES``
    """

    NAMES = ("rename", "replace", "mkdir", "unlink", "rmdir", "fsync")

    def __init__(self, folder: Path, point: int | None, kind: str):
        self.folder, self.fails_at, self.kind = str(folder), point, kind
        self.count = 0

    def point(self, torn: Callable[[], Any] = lambda: None) -> None:
        """Pass a point, or do not; ``torn`` does half of what was to be done."""
        if self.count == self.fails_at:
            if self.kind == "full disk":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self.kind == "torn":
                torn()
            os.kill(os.getpid(), signal.SIGKILL)
        self.count += 1

    def _call(self, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        self.point()
        return call(*args, **kwargs)

    def __enter__(self) -> Callable[[], int]:
        self.former = {name: getattr(os, name) for name in self.NAMES}
        for name, call in self.former.items():
            setattr(os, name, partial(self._call, call))
        self.open = io.open

        def opened(path: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            file = self.open(path, mode, *args, **kwargs)
            writes = isinstance(path, str | Path) and str(path).startswith(self.folder) and set(mode) & set("wa+")
            if writes:
                self.point()
            if not writes:
                return file
            file.close()
            watched = _Watched(io.FileIO(path, "wb"), self)
            return watched if "b" in mode else io.TextIOWrapper(watched, newline=kwargs.get("newline"))

        io.open = builtins.open = opened  # type: ignore[assignment]
        return lambda: self.count

    def __exit__(self, *_: Any) -> None:
        for name, call in self.former.items():
            setattr(os, name, call)
        io.open = builtins.open = self.open  # type: ignore[assignment]


class _Watched(io.BufferedWriter):
    """A file whose writes are points."""

    def __init__(self, file: io.FileIO, failing: _failing):
        super().__init__(file)
        self._failing = failing

    def write(self, content: Any) -> int:
        def half() -> None:
            super(_Watched, self).write(memoryview(content).cast("B")[: len(content) // 2])
            self.flush()

        self._failing.point(half)
        return super().write(content)


def _damage(path: Path, kind: str) -> None:
    content = bytearray(path.read_bytes())
    if kind == "lost":
        path.unlink()
        return
    if kind == "emptied":
        content.clear()
    elif kind == "halved":
        del content[len(content) // 2 :]
    elif kind == "longer":
        content += b"\0"
    else:
        place = {"first bit": 0, "middle bit": len(content) // 2, "last bit": len(content) - 1}[kind]
        content[place] ^= 1
    path.write_bytes(content)


def campaign(
    folder: Path, points: int | None = None, report: Callable[[int, int], None] = lambda done, of: None
) -> list[Outcome]:
    """Run the fault campaign.

    :param folder: Where to work
    :param points: How many of the failing writes to take, evenly spread; by default all (damages are all taken)
    :param report: Called after each fault with how many are done, and of how many
    :return: What came of the faults
    """
    site = Site(folder)
    taken = set(np.linspace(0, site.points - 1, points or site.points).round().astype(int))
    faults = [fault for fault in site.faults() if fault.point is None or fault.point in taken]
    outcomes = []
    for fault in faults:
        outcomes.append(site.suffer(fault))
        report(len(outcomes), len(faults))
    return outcomes


def _say(done: int, of: int) -> None:
    if done % 100 == 0 or done == of:
        print(f"{done} of {of} faults", flush=True)


def main() -> None:
    """Run the whole campaign and write ``faults.json``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/robustness"), help="folder to write")
    parser.add_argument("--points", type=int, help="failing writes to take, evenly spread (default: all of them)")
    options = parser.parse_args()
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        outcomes = campaign(Path(folder), options.points, _say)
    counts = Counter((outcome.fault.kind, outcome.resumed) for outcome in outcomes)
    losses = [outcome for outcome in outcomes if not outcome.expected]
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(
        options.out / "faults.json",
        {
            "faults": len(outcomes),
            "write_points_taken": options.points or "all",
            "losses": len(losses),
            "resumed": [{"fault": kind, "from": name, "times": n} for (kind, name), n in sorted(counts.items())],
            "lost": [str(loss) for loss in losses],
            **describe_run(),
        },
    )
    print(f"{len(outcomes)} faults, {len(losses)} losses; see {options.out / 'faults.json'}")
    for loss in losses:
        print(loss)


if __name__ == "__main__":
    main()
