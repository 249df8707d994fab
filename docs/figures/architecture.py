"""Draw ``docs/_static/architecture.svg``, the data flow of CuRe: ``python docs/figures/architecture.py``.

Text stays text. Colours are those of the plots (task blue, curious red), and follow the reader's light or dark scheme.
"""

import re
from pathlib import Path
from xml.sax.saxutils import escape

SVG = Path(__file__).parents[1] / "_static" / "architecture.svg"
WIDTH, HEIGHT = 560, 626

STYLE = """
  svg { --paper: #ffffff; --ink: #1f2328; --soft: #57606a; --line: #6e7781; --plain: #f3f4f6;
        --task: #1f77b4; --srl: #2e8b3d; --curious: #d62728;
        --task-fill: #e8f1f9; --srl-fill: #e7f4e9; --curious-fill: #fcebeb }
  @media (prefers-color-scheme: dark) {
    svg { --paper: #16181d; --ink: #e6e8eb; --soft: #a5acb5; --line: #8b949e; --plain: #24272e;
          --task: #6cb2ea; --srl: #6cc77c; --curious: #ff7b78;
          --task-fill: #172a3a; --srl-fill: #17301c; --curious-fill: #3a1d1e }
  }
  text { font-family: system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; fill: var(--ink) }
  .title { font-size: 15px; font-weight: 600 } .note { font-size: 13.5px; fill: var(--soft) }
  .sub { font-size: 76% }
  path { fill: none; stroke-width: 1.8 } .stop { stroke-width: 3.2 }
  .gradient { stroke-dasharray: 5 4 }
"""


def text(x: float, y: float, words: str, kind: str = "note", anchor: str = "middle", turned: bool = False) -> str:
    """Draw a line of text.

    :param x: Where it is anchored, as all lengths in units of the drawing
    :param y: Of its baseline
    :param words: What it says; ``_`` begins a subscript that ends with the word
    :param kind: ``"title"`` or ``"note"``
    :param anchor: ``"start"``, ``"middle"`` or ``"end"``
    :param turned: Whether it runs upwards
    :return: One line of text
    """
    lowered = r'<tspan class="sub" dy="4">\1</tspan><tspan dy="-4">&#8203;</tspan>'
    words = re.sub(r"_(\w+)", lowered, escape(words))
    turn = f' transform="rotate(-90 {x} {y})"' if turned else ""
    return f'<text class="{kind}" x="{x}" y="{y}" text-anchor="{anchor}"{turn}>{words}</text>'


def box(x: float, y: float, width: float, height: float, color: str, title: str, *notes: str) -> str:
    """Draw a rounded box.

    :param x: Its left edge
    :param y: Its upper edge
    :param width: Its width
    :param height: Its height
    :param color: Name of its colours in ``STYLE``, or ``"plain"``
    :param title: First line
    :param notes: Further lines
    :return: A rounded box with centred lines of text
    """
    fill, stroke = ("plain", "line") if color == "plain" else (f"{color}-fill", color)
    lines = [f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="9" stroke-width="1.6"']
    lines[0] += f' style="fill: var(--{fill}); stroke: var(--{stroke})"/>'
    first = y + height / 2 + 5.5 - 9 * len(notes)
    lines += [
        text(x + width / 2, first + 18 * row, words, "note" if row else "title")
        for row, words in enumerate((title, *notes))
    ]
    return "\n".join(lines)


def arrow(points: str, color: str = "line", gradient: bool = False, stop: tuple[float, float] | None = None) -> str:
    """Draw an arrow.

    :param points: Corners as SVG's path data, such as ``"M0 0 V10"``
    :param color: Name of its colour in ``STYLE``
    :param gradient: Whether it is dashed
    :param stop: Where a bar crosses it (a vertical line), if the gradient stops there
    :return: An arrow that ends at the last point
    """
    kind = ' class="gradient"' if gradient else ""
    line = f'<path{kind} d="{points}" style="stroke: var(--{color})" marker-end="url(#{color})"/>'
    if stop is None:
        return line
    return f'{line}\n<path class="stop" d="M{stop[0] - 8} {stop[1]} h16" style="stroke: var(--{color})"/>'


def head(color: str) -> str:
    """Draw the head of arrows of a colour.

    :param color: Name of a colour in ``STYLE``
    :return: The head of its arrows, whose tip is the end of the line
    """
    return (
        f'<marker id="{color}" viewBox="0 0 10 10" refX="9.5" refY="5" markerWidth="10" markerHeight="10" '
        f'markerUnits="userSpaceOnUse" orient="auto"><path d="M0 1 L10 5 L0 9 z" '
        f'style="fill: var(--{color}); stroke: none"/></marker>'
    )


def draw() -> str:
    """Draw everything.

    :return: The drawing as SVG
    """
    colors = ("line", "task", "srl", "curious")
    parts = [
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="12" style="fill: var(--paper)"/>',
        # What happens: transitions are stored and sampled
        box(44, 20, 150, 58, "plain", "Environment"),
        box(400, 20, 150, 58, "plain", "Replay buffer"),
        arrow("M194 49 H400"),
        text(297, 41, "transition (o, a, r, o')"),
        arrow("M475 78 V134"),
        text(464, 111, "sampled batch, random views", anchor="end"),
        box(44, 134, 506, 64, "plain", "Shared encoder φ", "trunk → features f → projection → latents z"),
        # What learns from latents, and sends its gradient back
        box(76, 280, 118, 62, "task", "Critics", "of reward r"),
        box(222, 280, 150, 62, "srl", "SRL head θ", "loss L, errors e"),
        box(400, 280, 118, 62, "curious", "Critics", "of r_cure"),
        *(
            part
            for x, color in ((136, "task"), (297, "srl"), (458, "curious"))
            for part in (
                arrow(f"M{x - 17} 198 V280", color),
                text(x - 25, 246, "z", anchor="end"),
                arrow(f"M{x + 17} 280 V198", color, gradient=True),
                text(x + 25, 246, "∇", anchor="start"),
            )
        ),
        # Who is rewarded for what
        arrow("M297 342 V398", "srl", stop=(297, 366)),
        text(309, 376, "e", anchor="start"),
        box(222, 398, 150, 80, "srl", "Intrinsic reward", "r_cure, made of e", "for this batch"),
        arrow("M372 438 H386 V311 H400", "curious"),
        # Who acts
        arrow("M60 198 V398", "task", stop=(60, 226)),
        text(54, 300, "f", anchor="end"),
        arrow("M534 198 V398", "curious", stop=(534, 226)),
        text(540, 300, "f", anchor="start"),
        arrow("M136 342 V398", "task"),
        text(144, 376, "Q", anchor="start"),
        arrow("M458 342 V398", "curious"),
        text(466, 376, "Q", anchor="start"),
        box(44, 398, 150, 80, "task", "Task actor", "seeks the reward", "of the task"),
        box(400, 398, 150, 80, "curious", "Curious actor", "seeks what the", "head does badly"),
        arrow("M119 478 V520", "task"),
        arrow("M475 478 V520", "curious"),
        box(44, 520, 506, 50, "plain", "Mixer: curious with probability p_c, else task"),
        arrow("M44 545 H26 V49 H44"),
        text(17, 300, "action a", turned=True),
        # Legend
        arrow("M44 602 H78"),
        text(85, 607, "data", anchor="start"),
        arrow("M134 602 H168", gradient=True),
        text(175, 607, "gradient to the encoder", anchor="start"),
        '<path d="M362 602 h26" style="stroke: var(--line)"/>',
        '<path class="stop" d="M375 594 v16" style="stroke: var(--line)"/>',
        text(395, 607, "no gradient passes", anchor="start"),
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
            f'viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-labelledby="title">',
            '<title id="title">Data flow of CuRe: one encoder, trained by the critics of two agents and by the SRL '
            "head, whose error rewards the curious agent; a mixer decides which of the two acts</title>",
            f"<style>{STYLE}</style>",
            f"<defs>{''.join(map(head, colors))}</defs>",
            *parts,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    SVG.write_text(draw(), encoding="utf-8")
