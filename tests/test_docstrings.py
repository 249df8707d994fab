"""Docstrings begin with a sentence; that it is one, ruff checks (D205, D400, D415)."""

import ast
from pathlib import Path


def test_docstrings_begin_with_a_sentence() -> None:
    for path in (Path(__file__).parents[1] / "sb3_cure").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                assert not (ast.get_docstring(node) or "").startswith(":"), f"{path.name}: {node.name}"
