"""Drawings of the documentation are what their scripts make."""

import runpy
from pathlib import Path
from xml.etree import ElementTree

import pytest

DOCS = Path(__file__).parents[1] / "docs"
SCRIPTS = sorted((DOCS / "figures").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_committed_drawing_is_its_script_s(script: Path) -> None:
    module = runpy.run_path(str(script))
    assert module["SVG"].read_text(encoding="utf-8") == module["draw"](), f"run python docs/figures/{script.name}"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_drawing_is_well_formed_and_keeps_to_its_paper(script: Path) -> None:
    svg = ElementTree.parse(runpy.run_path(str(script))["SVG"]).getroot()
    _, _, width, height = map(float, svg.attrib["viewBox"].split())
    boxes = [
        {name: float(rect.get(name, 0)) for name in ("x", "y", "width", "height")} for rect in svg.iter(_tag("rect"))
    ]
    assert len(boxes) > 1
    assert all(box["x"] + box["width"] <= width and box["y"] + box["height"] <= height for box in boxes)
    heads = {marker.attrib["id"] for marker in svg.iter(_tag("marker"))}
    used = {path.attrib["marker-end"][5:-1] for path in svg.iter(_tag("path")) if "marker-end" in path.attrib}
    assert used and used <= heads


def test_agents_have_the_colours_of_the_plots() -> None:
    colors = pytest.importorskip("sb3_cure.evaluation.plots", exc_type=ImportError).COLORS
    drawn = (DOCS / "_static" / "architecture.svg").read_text(encoding="utf-8")
    assert f"--task: {colors['task']}" in drawn and f"--curious: {colors['curious']}" in drawn


def _tag(name: str) -> str:
    return f"{{http://www.w3.org/2000/svg}}{name}"
