"""Figures in one style. Each function takes numbers and writes one PNG of 256 colours."""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
import torch as th
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter
from PIL import Image

from sb3_cure.cure.reconstructions import newest_frames
from sb3_cure.envs.physics import coordinate_labels, map_coordinates
from sb3_cure.evaluation.rollouts import HighestErrors, binned_errors

#: Matplotlib style file of all figures: ``plt.style.use(STYLE)``
STYLE = Path(__file__).with_name("plots.mplstyle")
#: Colour of each policy, and of arms that several experiments share
COLORS = {
    "random": "#888888",
    **dict.fromkeys(("task", "sac_ae"), "#1f77b4"),
    **dict.fromkeys(("curious", "cure", "cure_sac_ae", "srl_error"), "#d62728"),
    **{"curl": "#2ca02c", "drq": "#ff7f0e", "per_pixel": "#9467bd", "oracle": "#8c564b"},
}
_BASELINE_COLOR = "#222222"
#: Dashes of horizontal lines, the same in all pictures
_DASHES = {"always drawing grey": "--", "always drawing the mean image": ":"}
#: Colours of other arms
_ARM_COLORS = ["#2ca02c", "#ff7f0e", "#9467bd", "#17becf", "#e377c2", "#8c564b", "#bcbd22"]
_ARM_COLORS += ["#12126b", "#f5b7a5", "#0b4f2a", "#a6cee3"]
#: Markers and dashes by colour, so that policies also differ in black and white
_LOOKS = {COLORS["random"]: {"marker": "s", "linestyle": "--"}, COLORS["curious"]: {"marker": "^"}}

#: By title of a panel: values to compare with, one or several, by name
Lines: TypeAlias = Mapping[str, Mapping[str, np.ndarray | float]]
PathOrFile: TypeAlias = Path | IO[bytes]


class Bar(NamedTuple):
    """A policy in ``actor_bars``.

    :param arm: Its arm
    :param actor: Who acts
    :param values: One number per seed; the bar is their mean
    :param text: Above the bar
    :param ends: Lowest and highest of all steps; None: not measured
    """

    arm: str
    actor: str
    values: np.ndarray
    text: str = ""
    ends: tuple[float, float] | None = None


class Difference(NamedTuple):
    """A line in ``paired_differences``.

    :param arm: Its arm
    :param label: Name of the line
    :param pairs: Difference of each pair of seeds
    :param mean: Their mean
    :param low: Lower end of its interval; None: there is none
    :param high: Upper end
    """

    arm: str
    label: str
    pairs: np.ndarray
    mean: float
    low: float | None
    high: float | None


#: Decorator of functions that draw
in_style = style.context(STYLE)


def save(figure: Figure, path: PathOrFile, dpi: int = 150, tight: bool = False) -> None:
    """Save a figure as PNG of 256 colours, a quarter of the size of all colours.

    :param figure: A figure
    :param path: File to write
    :param dpi: Pixels per inch
    :param tight: Whether to crop the margins
    """
    file = io.BytesIO()
    figure.savefig(file, dpi=dpi, bbox_inches="tight" if tight else None)
    with Image.open(file) as image:
        few = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(path, "PNG", optimize=True)


def _plain(text: str) -> str:
    """Escape a name: matplotlib takes dollar signs for formulas, and hides names that begin with an underscore."""
    return ("\u200b" if text.startswith("_") else "") + text.replace("$", r"\$")


def _look(color: str) -> dict[str, Any]:
    """Colour, marker and dashes of a line."""
    return {"color": color, "marker": "o", **_LOOKS.get(color, {})}


# Curves


def arm_colors(methods: Sequence[str], baseline: str) -> dict[str, str]:
    """Choose a colour for each arm: its own of ``COLORS``, or one that no other arm has.

    :param methods: Arms of an experiment
    :param baseline: The one that the others are compared with: black, unless it has a colour of its own
    :return: Colours by arm; after eleven of the others they repeat
    """
    chosen = {baseline: _BASELINE_COLOR}
    for arm in (baseline, *methods):
        if arm in COLORS and COLORS[arm] not in chosen.values():
            chosen[arm] = COLORS[arm]
    free = [color for color in _ARM_COLORS if color not in chosen.values()]
    others = [arm for arm in methods if arm not in chosen]
    return chosen | {arm: free[index % len(free)] for index, arm in enumerate(others)}


@in_style
def learning_curves(
    path: PathOrFile,
    curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    colors: Mapping[str, str],
    ylabel: str,
    logarithmic: bool = False,
) -> None:
    """One panel per task: mean over seeds, with a band of one standard deviation on each side (paper, Figures 3 and 4).

    :param path: File to write
    :param curves: By task and arm: environment steps [n] and values [seeds, n]
    :param colors: By arm
    :param ylabel: What the values are
    :param logarithmic: Whether the values have a logarithmic axis
    """
    figure, panels = _panels(len(curves), height=2.9, ylabel=ylabel)
    seeds: dict[str, set[int]] = {}
    for axes, (task, lines) in zip(panels, curves.items(), strict=True):
        for arm, (steps, values) in lines.items():
            seeds.setdefault(arm, set()).add(len(values))
            mean = values.mean(axis=0)
            axes.plot(steps, mean, **_look(colors[arm]))
            if len(values) > 1:
                std = values.std(axis=0, ddof=1)
                low = np.maximum(mean - std, mean / 10) if logarithmic else mean - std
                where = mean > 0 if logarithmic else None
                axes.fill_between(steps, low, mean + std, where, color=colors[arm], alpha=0.18, linewidth=0)
        axes.set(title=_plain(task), xlabel="environment steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if logarithmic:
            _use_logarithms(axes)
    handles = {}
    for arm, counts in seeds.items():
        n = " to ".join(map(str, sorted({min(counts), max(counts)})))
        handles[f"{_plain(arm)} ({n} seed{'' if n == '1' else 's'})"] = Line2D([], [], **_look(colors[arm]))
    several = any(max(counts) > 1 for counts in seeds.values())
    _legend(figure, handles, "lines: means over seeds; bands: one standard deviation on each side" if several else "")
    save(figure, path)


@in_style
def paired_differences(
    path: PathOrFile,
    rows: Sequence[Difference],
    colors: Mapping[str, str],
    xlabel: str,
) -> None:
    """Differences from the baseline, one line each, with every pair of seeds as a dot.

    :param path: File to write
    :param rows: The lines
    :param colors: By arm
    :param xlabel: What the differences are of
    """
    figure = Figure(figsize=(8.5, 1.5 + 0.34 * len(rows)))
    axes = figure.subplots()
    axes.axvline(0, color="#333333", linewidth=1)
    for place, (arm, _, pairs, mean, low, high) in enumerate(rows):
        axes.plot(pairs, np.full(len(pairs), place + 0.24), "o", color=colors[arm], alpha=0.5)
        if low is not None and high is not None:
            axes.plot([low, high], [place, place], color=colors[arm], linewidth=2.5, solid_capstyle="butt")
        axes.plot([mean], [place], "D", color=colors[arm], markersize=6.5, zorder=4, markeredgecolor="white")
    axes.set_yticks(range(len(rows)), [_plain(row.label) for row in rows])
    axes.set(xlabel=_plain(xlabel), ylim=(len(rows) - 0.5, -0.5))
    # Intervals of two seeds can be a hundred times as wide as the differences: they may leave the picture.
    reach = 4 * max((float(np.abs(row.pairs).max(initial=0)) for row in rows), default=0) or 1
    axes.set_xlim(*np.clip(axes.get_xlim(), -reach, reach))
    marks = {
        "a pair of seeds": Line2D([], [], color="#555555", marker="o", linestyle=""),
        "their mean with its 95 % interval": Line2D([], [], color="#555555", marker="D", markersize=6.5, linewidth=2.5),
    }
    _legend(figure, marks)
    save(figure, path)


# Bars


def visitation_bars(path: PathOrFile, panels: Mapping[str, Sequence[Bar]], lines: Lines) -> None:
    """SRL error per step met by each policy: mean, with minimum and maximum as error bars (paper, Figure 2).

    :param path: File to write
    :param panels: By title: its bars
    :param lines: By title: values to compare with, by name
    """
    actor_bars(path, panels, "SRL error per step\n(\N{MULTIPLICATION SIGN}: times the random policy's)", lines, True)


@in_style
def actor_bars(
    path: PathOrFile,
    panels: Mapping[str, Sequence[Bar]],
    ylabel: str,
    lines: Lines | None = None,
    logarithmic: bool = False,
) -> None:
    """Policies in groups of arms, coloured by actor.

    Bars show means; on a logarithmic axis, without a zero for bars to begin at, marks do.

    :param path: File to write
    :param panels: By title: its bars
    :param ylabel: What is measured
    :param lines: By title: values to compare with, by name; their mean is a line across, their range a band
    :param logarithmic: Whether the axis is logarithmic
    """
    figure, places = _panels(len(panels), height=3.3, ylabel=ylabel)
    for axes, (title, rows) in zip(places, panels.items(), strict=True):
        ticks, position = {}, 0.0
        for arm in dict.fromkeys(row.arm for row in rows):
            group = [row for row in rows if row.arm == arm]
            ticks[_plain(arm)] = position + (len(group) - 1) / 2
            for bar in group:
                _draw_bar(axes, position, bar, logarithmic)
                position += 1
            position += 0.7
        axes.set_xticks(list(ticks.values()), list(ticks), rotation=15 if len(ticks) > 3 else 0)
        axes.set(title=_plain(title), xlim=(-0.7, position - 1))
        for label, compared in (lines or {}).get(title, {}).items():
            color, known = COLORS.get(label, _BASELINE_COLOR), np.atleast_1d(compared)
            name = f"{label} policy" if label in COLORS else _plain(label)
            axes.axhline(known.mean(), color=color, linewidth=1.2, linestyle=_DASHES.get(label, "-."), label=name)
            axes.axhspan(known.min(), known.max(), color=color, alpha=0.15, linewidth=0)
        means = [float(row.values.mean()) for row in rows]
        if logarithmic and max(means) > 0:
            _use_logarithms(axes)
            # The lowest contrastive error is often zero: keep the means in sight.
            least = min(mean for mean in means if mean > 0)
            axes.set_ylim(bottom=np.clip(axes.get_ylim()[0], least / 30, least / 3))
        (bottom, top), is_log = axes.get_ylim(), axes.get_yscale() == "log"
        axes.set_ylim(top=top * (top / bottom) ** 0.15 if is_log else bottom + 1.15 * (top - bottom))  # for the texts
    if lines or any(row.arm != row.actor for rows in panels.values() for row in rows):
        marks = "thick marks: their means (thin lines: least to greatest step)" if logarithmic else "bars: their means"
        legends = [axes.get_legend_handles_labels() for axes in places]
        handles = {label: handle for legend in legends for handle, label in zip(*legend, strict=True)}
        _legend(figure, handles, f"dots: seeds; {marks}; in brackets: 95 % interval")
    save(figure, path)


def _draw_bar(axes: Axes, position: float, bar: Bar, logarithmic: bool) -> None:
    _, actor, values, text, ends = bar
    color, label, mean = COLORS.get(actor, _ARM_COLORS[0]), _plain(f"{actor} policy"), float(values.mean())
    low, high = ends or (mean, float(values.max()))
    if logarithmic:
        axes.plot([position, position], [low, high], color=color, linewidth=1.2)
        axes.plot(position, mean, "_", color=color, markersize=16, markeredgewidth=4, label=label)
    else:
        axes.bar(position, mean, 0.85, color=color, alpha=0.8, label=label)
    axes.plot(np.full(len(values), position), values, "o", color="#222222", markersize=2.5)
    note = axes.annotate(text, (position, high), (0, 3), textcoords="offset points", fontsize=7)
    note.set(ha="center", va="bottom", bbox={"color": "white", "alpha": 0.8, "pad": 0.5})


def _panels(count: int, height: float, ylabel: str) -> tuple[Figure, list[Axes]]:
    """Make a figure with a number of axes, at most three in a row, as wide as a page."""
    columns = min(count, 3)
    rows = -(-count // columns)
    figure = Figure(figsize=({1: 6.5, 2: 9.0, 3: 11.0}[columns], height * rows + 0.5))
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid[::columns]:
        axes.set_ylabel(ylabel)
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, grid[:count]


def _use_logarithms(axes: Axes) -> None:
    """Make an axis logarithmic, with plain numbers at its ticks; zeros lie below its bottom."""
    axes.set_yscale("log", nonpositive="clip")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, handles: Mapping[str, Artist], note: str = "") -> None:
    """Draw a legend below all panels, with a note on the marks above it."""
    rows = max(1, math.ceil(len(handles) / (figure.get_figwidth() // 2.4)))
    columns = max(1, math.ceil(len(handles) / rows))
    figure.set_figheight(figure.get_figheight() + 0.21 * max(rows + bool(note) - 2, 0))  # two have room
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, title=note or None)


# Images


def _show(axes: Axes, images: Iterable[np.ndarray]) -> None:
    """Show images [C, H, W] of one or three channels in a row, with a white line between them."""
    gap = ((0, 0), (0, 0), (0, 1))
    strip = np.concatenate([np.moveaxis(np.pad(each, gap, constant_values=255), 0, -1) for each in images], axis=1)
    axes.imshow(
        strip.squeeze(-1) if strip.shape[-1] == 1 else strip, cmap="gray", vmin=0, vmax=255, interpolation="nearest"
    )
    axes.tick_params(bottom=False, labelbottom=False)
    axes.grid(False)
    axes.spines[:].set_visible(False)


@in_style
def reconstructions_over_training(
    path: Path, observed: np.ndarray, rows: Sequence[tuple[int, np.ndarray]], title: str
) -> None:
    """Reconstructions of the same observations at several times of training, one row each, below the observations.

    :param path: File to write
    :param observed: One frame of each observation, uint8 [n, C, H, W] with C = 1 or 3
    :param rows: Agent steps of training, and the reconstructions then, of the same shape
    :param title: Title of the figure
    """
    strips = {"what the camera shows": observed}
    for steps, drawn in rows:
        error = np.square((drawn.astype(np.float32) - observed) / 255).mean()
        strips[f"drawn from the latents\nafter {steps:,} agent steps\n(MSE {error:.2g})"] = drawn
    (n, _, height, width), inches = observed.shape, 10.0
    figure = Figure(figsize=(inches, 0.4 + len(strips) * (inches - 1.2) * height / (n * width)))
    figure.get_layout_engine().set(h_pad=0.02, hspace=0)  # type: ignore[union-attr, call-arg]
    for axes, (label, images) in zip(figure.subplots(len(strips), squeeze=False).flat, strips.items(), strict=True):
        _show(axes, images)
        axes.set_yticks([height / 2], [label])
    figure.suptitle(title)
    save(figure, path, 120, tight=True)


@in_style
def highest_error_frames(
    path: Path, found: HighestErrors, frame_stack: int, title: str, drawn: np.ndarray | None = None
) -> None:
    """The observations with the highest SRL error, highest first, each with its error and age.

    :param path: File to write
    :param found: Result of ``sb3_cure.evaluation.highest_errors`` for images
    :param frame_stack: Frames per observation, of which the newest is shown
    :param title: Title of the figure
    :param drawn: Their reconstructions, shown on the right of each, uint8 like ``found.observations``, or None
    """
    shown = [found.observations] if drawn is None else [found.observations, drawn]
    pairs = [newest_frames(th.as_tensor(images), frame_stack).numpy() for images in shown]
    columns = min(len(found.errors), 8 if drawn is None else 4)
    n_rows = -(-len(found.errors) // columns)
    figure = Figure(figsize=(1.5 * columns * len(pairs) + 0.2, 1.9 * n_rows + 0.5))
    grid = figure.subplots(n_rows, columns, squeeze=False).flat
    for axes in grid:
        axes.set_axis_off()
    for index, (error, age) in enumerate(zip(found.errors, found.ages, strict=True)):
        _show(grid[index], [images[index] for images in pairs])
        grid[index].set_title(f"{error:.3g} ({error / found.mean_error:.1f}x mean)\n{age:,} steps ago", fontsize=8)
    note = "SRL error" if drawn is None else "left: observed, right: reconstructed; SRL error"
    note += f", and its multiple of the buffer's mean of {found.mean_error:.3g}; ages in agent steps"
    figure.suptitle(f"{title}\n{note}", fontsize=10, wrap=True)
    save(figure, path, 120)


@in_style
def curiosity_map(
    path: Path,
    visits: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: Sequence[str],
    title: str,
    coordinates: tuple[str, str] | None = None,
    units: Sequence[str] | None = None,
    bins: int = 24,
) -> None:
    """Where each policy goes and its SRL error there, over two coordinates of the true state.

    One row per policy: on the left the number of steps in each bin, on the right their mean SRL error (left out if no
    policy has errors). Axes and colours are the same for all policies.

    :param path: File to write
    :param visits: By policy, the states of all steps, [n, d], and their SRL errors, [n] or empty
    :param names: Names of the coordinates of a state, [d]
    :param title: Title of the figure
    :param coordinates: Names of the two to show; by default ``map_coordinates``
    :param units: Units of the coordinates, [d]; angles ("rad") are shown from -pi to pi
    :param bins: Bins along each axis
    :raises ValueError: if ``coordinates`` are not two of the names
    """
    coordinates = map_coordinates(names, coordinates)
    columns = [list(names).index(name) for name in coordinates]
    both = [None if units is None else units[column] for column in columns]
    seen = np.concatenate([states[:, columns] for states, _ in visits.values()])
    x_edges, y_edges = (np.linspace(*_span(seen[:, axis], both[axis]), bins + 1) for axis in (0, 1))
    edges = x_edges, y_edges
    binned = {actor: binned_errors(states[:, columns], errors, edges) for actor, (states, errors) in visits.items()}

    means = np.concatenate([mean[np.isfinite(mean)] for _, mean in binned.values()])
    kinds = ["steps in the cell"] + (["mean SRL error in the cell"] if len(means) else [])
    most = max(2, max(counts.max() for counts, _ in binned.values()))
    norms: list[Normalize] = [LogNorm(1, most)]
    if len(means):
        norms.append(PowerNorm(0.5, means.min(), means.max()))  # most errors are far below the highest
    figure = Figure(figsize=(4.6 * len(kinds), 3.6 * len(visits) + 0.4))
    grid = figure.subplots(len(visits), len(kinds), squeeze=False, sharex=True, sharey=True)
    meshes = []
    for row, (actor, (counts, mean)) in zip(grid, binned.items(), strict=True):
        for place, values, norm, map_name in zip(row, (counts, mean), norms, ("viridis", "plasma"), strict=False):
            shown = np.ma.masked_where(counts == 0, values).T
            meshes.append(place.pcolormesh(*edges, shown, norm=norm, cmap=map_name))
            place.set_facecolor("0.92")
            what = "where it goes" if values is counts else "error there"
            place.set_title(f"{actor} policy: {what}", color=COLORS[actor])
            place.grid(False)
            _name_axes(place, coordinates, both, edges)
    for kind, column, mesh in zip(kinds, grid.T, meshes, strict=False):  # the meshes of the first row
        bar = figure.colorbar(mesh, ax=list(column), label=kind, aspect=20 * len(column), pad=0.02)
        if kind == kinds[0]:
            ticks = [count * 10**power for power in range(9) for count in (1, 2, 5) if count * 10**power <= most]
            bar.set_ticks(ticks, labels=[f"{tick:,}" for tick in ticks])
            bar.ax.minorticks_off()
    n_steps = ", ".join(f"{actor} {len(states):,}" for actor, (states, _) in visits.items())
    figure.suptitle(f"{title}\nsteps: {n_steps}; grey: never visited", wrap=True)
    save(figure, path, 120, tight=True)


def _span(values: np.ndarray, unit: str | None) -> tuple[float, float]:
    """Ends of an axis: the full circle for angles, else the least and the greatest value."""
    low, high = float(values.min()), float(values.max())
    if unit == "rad" and max(-low, high) <= np.float32(np.pi):
        return -np.pi, np.pi
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _name_axes(
    axes: Axes, coordinates: tuple[str, str], units: Sequence[str | None], edges: Sequence[np.ndarray]
) -> None:
    """Label axes with units, and angles at multiples of pi / 2."""
    labels = coordinate_labels(coordinates)
    for axis, label, unit, ends in zip((axes.xaxis, axes.yaxis), labels, units, edges, strict=True):
        axis.set_label_text(f"{label} [{unit}]" if unit else label)
        axis.set_tick_params(labelbottom=True, labelleft=True)
        if ends[-1] == np.pi:
            axis.set_ticks([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi], ["-π", "-π/2", "0", "π/2", "π"])
