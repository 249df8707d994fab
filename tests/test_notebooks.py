"""Every notebook runs with a tiny budget, and is committed as it was executed."""

from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
#: Stands before the first cell: tiny networks, a few updates, short episodes
SHRINK = f"""
%reset -f
import os, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
if "snippets_for_tests" not in sys.modules:
    import snippets_for_tests; snippets_for_tests.shrink_models()
"""
#: What replaces the parameter cell of each notebook: it names all parameters, with small values
SETTINGS = "LEARNING_STARTS, WARMUP_UPDATES, BATCH_SIZE, NETWORKS = 10, 5, 8, {}"
TINY = {
    "01_quickstart": "STEPS = 20",
    "02_srl_error_visitation": f"STEPS, EPISODES, PAPERS_PIXELS = 40, 1, dict(image_size=36); {SETTINGS}",
    "03_learning_curves": f"BUDGET, SEEDS, EVALUATION = 160, 2, dict(every=160, episodes=1); {SETTINGS}",
    "04_pretraining": f"BUDGET, PRETRAINING, SEEDS, EVALUATION = 160, 160, 2, dict(every=160, episodes=1); {SETTINGS}",
    "05_your_own_srl_head": "STEPS, EPISODES = 70, 2",
    "06_your_own_camera_env": "STEPS, WARMUP, EPISODES = 20, 10, 1",
    "07_camera_and_joints": "STEPS, WARMUP, EVERY, EPISODES = 20, 10, 10, 1",
}


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One for all notebooks: each begins without the names of the others, but need not import all packages again."""
    manager = KernelManager(kernel_name="python3")
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_with_a_tiny_budget(path: Path, tmp_path: Path, kernel: KernelManager) -> None:
    """Every cell runs, with tiny networks and few steps."""
    notebook = nbformat.read(path, as_version=4)
    parameters = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert len(parameters) == 1
    parameters[0].source = TINY[path.stem]
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"{SHRINK}\nos.chdir({str(tmp_path)!r})"))
    client = NotebookClient(notebook, timeout=600, km=kernel, resources={"metadata": {"path": tmp_path}})
    client.execute(cleanup_kc=False)
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
