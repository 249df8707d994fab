"""Pictures and video of a finished cell."""

from pathlib import Path

from sb3_cure.cure_sac import CuReSAC
from sb3_cure.experiments.grid import Cell


def draw_cell(model: CuReSAC, cell: Cell, folder: Path) -> None:
    """
    :param model: The cell's model, with its replay buffer
    :param cell: The cell
    :param folder: Where to write
    """
