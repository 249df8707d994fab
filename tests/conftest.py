"""Settings of the whole test run."""

import os

# Tests compare with the CPU's numbers. With CUDA_VISIBLE_DEVICES=0 those that need a GPU run, too.
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")
# Without a display MuJoCo needs to be told to render off-screen, before it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")
# For the processes that tests start; see below.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing

import pytest
import torch as th

# What workers of environments and trainings need is imported once by the server that forks them, not by each of them.
multiprocessing.get_context("forkserver").set_forkserver_preload(
    ["sb3_cure", "stable_baselines3.common.vec_env", "torch._dynamo", "shimmy"]
)

# The networks of the tests are so small that more threads only cost time; and some sums depend on their number.
th.set_num_threads(1)


#: Tests that take longest, by the beginnings of their names. They begin first, so that neither of two processes is
#: left alone with one of them at the end.
LONGEST = ("tests/cure/test_learning.py", "tests/cure/test_determinism.py", "tests/test_notebooks.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest tests first, and skip those marked as long but in ``make test-all``."""
    if not os.environ.get("SB3_CURE_TEST_ALL"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason="takes long: make test-all"))
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


@pytest.fixture(autouse=True, scope="session")
def logs_of_models(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Put the folders that SB3 makes for logs of every model where pytest tidies up."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("logs"))


@pytest.fixture
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no checkpoint wait for the disk: a kill of the process, unlike a loss of power, does not need it."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
