"""Every notebook runs with a tiny budget, and is committed as it was executed."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
#: What replaces the parameter cell of each notebook: it names all parameters, with values that take seconds.
TINY = {
    "01_quickstart": """
STEPS = 100
# Fifty episodes are evaluated: of 20 steps instead of 125
import gymnasium, sb3_cure
make = sb3_cure.make_dmc_env
sb3_cure.make_dmc_env = lambda *args, **kwargs: gymnasium.wrappers.TimeLimit(make(*args, **kwargs), 20)
""",
    "02_srl_error_visitation": """
STEPS = 100
EPISODES = 1
WARMUP_UPDATES = 20
BATCH_SIZE = 8
NETWORKS = dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4))
PAPERS_PIXELS = dict(image_size=36, renderer="fast")
""",
    "03_learning_curves": """
BUDGET = 320
SEEDS = 2
EVALUATION = dict(every=320, episodes=1)
LEARNING_STARTS = 20
WARMUP_UPDATES = 10
BATCH_SIZE = 8
NETWORKS = dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4))
""",
    "04_pretraining": """
BUDGET = 320
PRETRAINING = 320
SEEDS = 2
EVALUATION = dict(every=320, episodes=1)
LEARNING_STARTS = 20
WARMUP_UPDATES = 10
BATCH_SIZE = 8
NETWORKS = dict(net_arch=[16], features_extractor_kwargs=dict(n_filters=4))
""",
    "05_your_own_srl_head": """
STEPS = 300
EPISODES = 2
""",
    "06_your_own_camera_env": """
STEPS = 60
WARMUP = 40
EPISODES = 1
""",
    "07_camera_and_joints": """
STEPS = 60
WARMUP = 40
EVERY = 30
EPISODES = 1
""",
}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_with_a_tiny_budget(path: Path, tmp_path: Path) -> None:
    """Every cell runs after the parameter cell is replaced by a small one."""
    notebook = nbformat.read(path, as_version=4)
    parameters = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert len(parameters) == 1
    parameters[0].source = TINY[path.stem]
    client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}})
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output.text for output in outputs if output.get("name") == "stderr"]  # no warnings, no progress bars


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_committed_with_its_outputs(path: Path) -> None:
    """Readers see pictures and numbers without running anything, and no error, warning or progress bar."""
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in cells)
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in outputs)
    assert notebook.metadata.kernelspec.name == "python3"
    assert path.stat().st_size < 400_000
