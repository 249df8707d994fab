"""Settings of the whole test run."""

import os

# Without a display MuJoCo needs a backend that renders off-screen, before it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")
# For the processes that tests start; see below.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import multiprocessing

import pytest
import torch as th

# What workers of vectorised environments need is imported once by the server that forks them, not by each of them.
multiprocessing.get_context("forkserver").set_forkserver_preload(["sb3_cure", "stable_baselines3.common.vec_env"])

# The networks of the tests are so small that more threads only cost time; and some sums depend on their number.
th.set_num_threads(1)


#: Tests that take longest, by the beginnings of their names. They start first: of two processes neither is
#: left alone with one of them at the end.
LONGEST = (
    "tests/cure/test_learning.py",
    "tests/cure/test_determinism.py",
    "tests/cure/test_curious_returns.py",
    "tests/evaluation/test_diagnostics.py::test_real_pixels",
    "tests/experiments/test_run.py::test_killed",
    "tests/experiments/test_cells.py::test_pictures_show_every_policy",
    "tests/test_notebooks.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests go first, the others as they stand; those marked as long only in ``make test-all``."""
    if not os.environ.get("SB3_CURE_TEST_ALL"):
        for item in items:
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.skip(reason="takes long: make test-all"))
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


@pytest.fixture(autouse=True, scope="session")
def logs_of_models(tmp_path_factory: pytest.TempPathFactory) -> None:
    """SB3 makes a folder for the logs of every model; let them lie where pytest tidies up."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("logs"))
