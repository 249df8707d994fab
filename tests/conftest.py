"""Settings of the whole test run."""

import os

# Without a display MuJoCo needs to be told to render off-screen, before it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")
# For the processes that tests start; see below.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch as th

# The networks of the tests are so small that more threads only cost time; and some sums depend on their number.
th.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def logs_of_models(tmp_path_factory: pytest.TempPathFactory) -> None:
    """SB3 makes a folder for the logs of every model; let them lie where pytest tidies up."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("logs"))
