"""The report of results: right numbers, nothing from elsewhere, nothing broken in a browser."""

import html
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from programs_for_tests import find_program
from results_for_tests import CURE, RAE, curve, write_cell, write_csv, write_grid, write_two_arms

from sb3_cure.cli.main import main
from sb3_cure.experiments import report
from sb3_cure.experiments.tables import NONE

TASK = "cartpole-swingup"
HOSTILE = '<img src=x onerror=alert(1)>|$x$ "quoted" [a](b)'
PROBE = """<script>
addEventListener("load", async () => {
  const videos = [...document.querySelectorAll("video")];
  const known = video => new Promise(done => {
    if (video.readyState > 0) done();
    video.onloadedmetadata = video.onerror = done;
    setTimeout(done, 5000);
  });
  await Promise.all(videos.map(known));
  const sizes = {images: [...document.images].map(i => i.naturalWidth), videos: videos.map(v => v.videoWidth)};
  const cut = e => e.scrollWidth > e.clientWidth && getComputedStyle(e).overflowX != "visible";
  sizes.cut = [...document.querySelectorAll("main *")].filter(cut).map(e => e.scrollWidth);
  sizes.captions = [...document.querySelectorAll("figcaption")].map(c => c.offsetHeight);
  document.documentElement.dataset.probe = JSON.stringify(sizes);
});
</script>"""


def write_curves(folder: Path) -> None:
    """Areas 50, 100 and 100, 200; the second task is not run but for an unfinished cell and a failed one."""
    write_grid(folder, tasks=["dmc_pixels/cartpole-swingup-v0", "dmc_pixels/reacher-easy-v0"])
    for seed in (0, 1):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 50 * (seed + 1), 100 * (seed + 1)))
        write_cell(folder, TASK, "cure_sac_ae", seed, curve(0, 100 * (seed + 1), 200 * (seed + 1)), arguments=CURE)
    write_cell(folder, "reacher-easy", "sac_ae", 0, curve(0, 987_654), done=False)
    failed = write_cell(folder, "reacher-easy", "sac_ae", 1, curve(0, 987_654), done=False)
    (failed / "error.txt").write_text("Traceback")


def write_visitation(folder: Path) -> None:
    """Three seeds: the curious policy meets four times the random one's error, in states spread twice as wide."""
    write_grid(folder, kind="visitation", seeds=3, methods={"cure_only": {}}, baseline="cure_only")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rows = [
            (actor, head, 0, error / 2, error, 2 * error, 10)
            for head, scale in (("own", 1e-3), ("common", 2e-3), ("zero", 0.05), ("mean_image", 2e-3))
            for actor, error in (("random", scale), ("curious", 4 * scale if head in ("own", "common") else scale))
        ]
        states = {"random": rng.normal(0, 1, (200, 4)), "curious": rng.normal(0, 2, (200, 4))}
        write_cell(folder, TASK, "cure_only", seed, {}, arguments=CURE, visitation=rows, states=states)


def write_pretraining(folder: Path) -> None:
    """One seed of two arms, and one that is not run."""
    arms = {"vanilla": 300, "cure_pretraining": 350, "random_pretraining": 0}
    write_grid(folder, seeds=1, methods={arm: {} for arm in arms}, baseline="vanilla")
    phase = {"cure_pretraining": {"pretrain": {"collector": "curious", "budget": 500_000}}}
    for arm, final in list(arms.items())[:2]:
        write_cell(folder, TASK, arm, 0, curve(0, final), arguments=RAE, **phase.get(arm, {}))


def write_media(cell: Path, videos: tuple[str, ...] = ("task_policy", "curious_policy")) -> None:
    for name in ("reconstructions", "uncomfortable", "curiosity_map"):
        Image.new("RGB", (60, 40), "teal").save(cell / f"{name}.png")
    for video in videos:
        with imageio.get_writer(cell / f"{video}.mp4", fps=5) as writer:
            for shade in range(5):
                writer.append_data(np.full((64, 64, 3), 40 * shade, np.uint8))  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Experiments of all kinds and their report."""
    folder = tmp_path_factory.mktemp("all") / "results"
    write_curves(folder / "curves")
    write_media(folder / "curves" / TASK / "sac_ae" / "seed0")
    write_visitation(folder / "visitation")
    write_pretraining(folder / "pretraining")
    write_grid(folder / "later")
    assert report.main([str(folder)]) == 0
    return folder


def rows_of(path: Path, heading: str) -> list[list[str]]:
    """Header and rows of a table in a Markdown file."""
    table = path.read_text().split(f"### {heading}", 1)[1].split("\n\n")[1]
    header, _, *rows = [[text.strip() for text in line.split(" | ")] for line in table.splitlines()]
    return [[html.unescape(text.strip("| ").replace("\\", "")) for text in row] for row in (header, *rows)]


def test_tables_of_curves(results: Path) -> None:
    _, baseline, cure, unfinished, not_run = rows_of(results / "curves" / "table.md", "Learning curves")
    # Means of 50 and 100, 100 and 200; sample standard deviations
    assert baseline[2:] == ["2", "75 ± 35", "150 ± 71"]
    assert cure[2:] == ["2", "150 ± 71", "300 ± 141"]
    assert unfinished[2:] == ["0", "unfinished: 0; failed: 1", "unfinished: 0; failed: 1"]
    assert not_run[2:] == ["0", "not run", "not run"]
    # Nobody reaches 500 or 750. Finals are 200 and 400, means of the evaluations after the start 150 and 300.
    reached = rows_of(results / "curves" / "table.md", "Returns reached")[1:]
    assert [row[:5] for row in reached] == [
        [TASK, "250", "sac_ae", "0 of 2", "0 of 2"],
        [TASK, "250", "cure_sac_ae", "1 of 2", "1 of 2"],
    ]
    assert [row[5:] for row in reached] == [["> 100,000", "100,000"]] * 2
    (difference,) = rows_of(results / "curves" / "table.md", "Paired difference from sac\\_ae: area")[1:]
    minus = "\N{MINUS SIGN}"
    assert difference[:5] == ["cure_sac_ae", TASK, "2", "2", "75.0"]
    assert difference[5:] == [f"[{minus}242.7, 392.7]", "2", "0.500", "0.500", "inconclusive"]
    headlines = (results / "curves" / "table.md").read_text().replace("\\", "")
    assert "cure_sac_ae minus sac_ae: area under the curve 75.0" in headlines
    assert "2 pairs of seeds on cartpole-swingup: inconclusive." in headlines


def test_cells_reached_in_training_are_compared(tmp_path: Path) -> None:
    """Also of arms without a task, which have no returns; a seed that only one arm has done does not count."""
    write_grid(tmp_path, seeds=[0, 1, 2])
    reached = {
        "sac_ae": {0: (10, 60, 80, 100), 1: (20, 60, 80, 200)},
        "cure_sac_ae": {0: (10, 60, 80, 400), 1: (20, 60, 80, 200), 2: (10, 60, 80, 999)},
    }
    for method, seeds in reached.items():
        for seed, cells in seeds.items():
            cell = write_cell(tmp_path, TASK, method, seed, curve(0, 0))
            rows = [(25_000 * (index + 1), 0, count) for index, count in enumerate(cells)]
            write_csv(cell / "coverage.csv", ("environment_steps", "agent_steps", "cells"), rows)
    assert report.main([str(tmp_path)]) == 0
    header, baseline, cure, *_ = rows_of(tmp_path / "table.md", "Cells of the true state")
    assert header[4:] == ["at 25,000", "at 50,000", "at 75,000", "at 100,000"]
    assert baseline[3:] == ["2", "15 ± 7", "60 ± 0", "80 ± 0", "150 ± 71"]
    assert cure[3:] == ["3", "13 ± 6", "60 ± 0", "80 ± 0", "533 ± 416"]
    assert (tmp_path / "cells_reached.png").exists()
    text = (tmp_path / "table.md").read_text().replace("\\", "")
    assert "cure_sac_ae on cartpole-swingup, 2 seeds: it reached 2.00 [" in text  # of 4 and 1


@pytest.mark.parametrize("shorter", ["cure", "random"])
def test_arm_that_counted_less_often_keeps_its_columns(shorter: str, tmp_path: Path) -> None:
    """It may have stopped early, and stand first or last; they are compared after 50 000 steps, which both have."""
    write_grid(tmp_path, seeds=1, methods={"cure": {}, "random": {}}, baseline="random")
    for method in ("cure", "random"):
        cell = write_cell(tmp_path, TASK, method, 0, curve(0, 0))
        rows = [(steps, 0, steps // 100) for steps in (25_000, 50_000, 75_000)[: 2 if method == shorter else 3]]
        write_csv(cell / "coverage.csv", ("environment_steps", "agent_steps", "cells"), rows)
    assert report.main([str(tmp_path)]) == 0
    header, *rows = rows_of(tmp_path / "table.md", "Cells of the true state")
    assert header[4:] == ["at 25,000", "at 50,000", "at 75,000"]
    assert "1 seed: it reached 1.00 (one seed) times the cells of random" in (tmp_path / "table.md").read_text()
    found = {row[2]: row[4:] for row in rows}
    assert found.pop(shorter) == ["250", "500", NONE]
    assert list(found.values()) == [["250", "500", "750"]]


def test_arms_without_returns_are_compared_by_cells_alone(tmp_path: Path) -> None:
    """Arms without a task beside one with returns: the report does not say that there is nothing to compare."""
    write_grid(tmp_path, seeds=1, methods={"cure": {}, "other": {}, "oracle": {}}, baseline="cure")
    for method in ("cure", "other", "oracle"):
        returns = curve(0, 100) if method == "oracle" else dict.fromkeys(curve(0, 0), "")
        cell = write_cell(tmp_path, TASK, method, 0, returns, arguments={**CURE, "task": method == "oracle"})
        columns = ("environment_steps", "agent_steps", "cells")
        write_csv(cell / "coverage.csv", columns, [(100_000, 0, 10)])
    assert report.main([str(tmp_path)]) == 0
    text = (tmp_path / "table.md").read_text()
    assert "times the cells of cure" in text and "nothing to compare" not in text
    assert rows_of(tmp_path / "table.md", "Learning curves")[1][2:] == ["0", NONE, NONE]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Arguments of all curves and bars, which are not drawn."""
    calls: list[tuple[Any, ...]] = []
    for name in ("learning_curves", "actor_bars", "visitation_bars"):
        monkeypatch.setattr(report.plots, name, lambda file, *arguments: calls.append(arguments))
    return calls


def describe(folder: Path, drawn: list[tuple[Any, ...]]) -> dict[str, tuple[Any, ...]]:
    """Arguments of the figures of an experiment, by their file."""
    (experiment,) = report.read_results(folder)
    parts = report.describe(experiment, [100]).parts
    names = [part.name for part in parts if isinstance(part, report.Figure) and part.name != "paired_difference.png"]
    return dict(zip(names, drawn, strict=True))


def test_errors_of_different_units_do_not_share_an_axis(tmp_path: Path, drawn: list[tuple[Any, ...]]) -> None:
    """A panel for each head, and for errors per pixel, but one of returns; constant images have errors of one unit."""
    others = {"cure_sac_ae": {"srl": "curl"}, "per_pixel": {"intrinsic_kwargs": {"per_pixel": True}}}
    others["drawn"] = {"srl": "curl", "intrinsic": "reconstruction"}  # whose own autoencoder measures
    others["off"] = {"curiosity": None, "intrinsic": "reconstruction"}  # which is not built
    arms: dict[str, dict[str, Any]] = {"sac_ae": {"intrinsic_kwargs": None}, **others}
    write_grid(tmp_path, seeds=1, methods={arm: {} for arm in arms}, baseline="sac_ae")
    for arm, arguments in arms.items():
        write_cell(tmp_path, TASK, arm, 0, curve(0, 1, 2, 3, 4), arguments={**CURE, **arguments})
    figures = describe(tmp_path, drawn)
    panels = [f"{TASK}, {unit}" for unit in ("rae", "curl", "rae, per pixel", "reconstruction")]
    assert list(figures["task_srl_error.png"][0]) == panels
    assert list(figures["task_srl_error.png"][0][panels[0]]) == ["sac_ae", "off"]
    assert list(figures["learning_curves.png"][0]) == [TASK]

    drawn.clear()
    write_grid(tmp_path, kind="visitation", seeds=1, methods={arm: {} for arm in arms}, baseline="sac_ae")
    rows = [("random", head, 0, 1, 2, 3, 10) for head in ("own", "zero", "mean_image")]
    for arm, arguments in arms.items():
        write_cell(tmp_path, TASK, arm, 0, {}, arguments={**CURE, **arguments}, visitation=rows)
    bars, lines = describe(tmp_path, drawn)["visitation_own.png"]
    assert list(bars) == panels
    assert [len(lines.get(panel, ())) for panel in panels] == [2, 0, 0, 0]


def test_random_policy_is_drawn_once(tmp_path: Path, drawn: list[tuple[Any, ...]]) -> None:
    """A line across, but where each arm judges it by its own head."""
    write_visitation(tmp_path)
    figures = describe(tmp_path, drawn)
    for name in ("coverage.png", "visitation_common.png"):
        bars, *_, lines = figures[name]
        assert [actor for _, actor, *_ in bars[TASK]] == ["curious"]
        assert len(lines[TASK]["random"]) == 3
    bars, lines = figures["visitation_own.png"]
    assert [actor for _, actor, *_ in bars[TASK]] == ["random", "curious"] and "random" not in lines[TASK]


def test_few_evaluations_are_a_table(tmp_path: Path) -> None:
    """Three points are no curve; a column that one arm lacks has a dash."""
    write_grid(tmp_path, seeds=2)
    for seed in (0, 1):
        write_cell(tmp_path, TASK, "sac_ae", seed, curve(0, 50 * (seed + 1), 500), curious=True)
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, curve(0, 1.234))
    assert report.main([str(tmp_path)]) == 0
    assert not list(tmp_path.glob("*.png"))
    header, baseline, cure, *errors = rows_of(tmp_path / "table.md", "Evaluations")
    assert header[3:] == ["seeds", "at 0", "at 50,000", "at 100,000"]
    assert baseline[1:] == [TASK, "sac_ae", "2", "0 ± 0", "75 ± 35", "500 ± 0"]
    assert cure[1:] == [TASK, "cure_sac_ae", "1", "0", NONE, "1.23"]
    assert [row[0] for row in errors] == ["SRL error, task policy"] * 2 + ["SRL error, curious policy"]
    assert errors[2][2:] == ["sac_ae", "2", *["0.00200 ± 0.00000"] * 3]


def test_no_picture_without_anything_to_see(tmp_path: Path) -> None:
    """Errors of zero on a logarithmic axis, one pair of seeds, and a random policy without others to compare with."""
    write_grid(tmp_path / "zero", seeds=1)
    for arm in ("sac_ae", "cure_sac_ae"):
        cell = write_cell(tmp_path / "zero", TASK, arm, 0, curve(0, 1, 2, 3, 4))
        table = pd.read_csv(cell / "eval.csv")
        table.assign(task_srl_error=0.0, curious_srl_error=np.nan).to_csv(cell / "eval.csv", index=False)
    write_grid(tmp_path / "random", kind="visitation", seeds=1, methods={"random": {}}, baseline="random")
    states = {"random": np.random.default_rng(0).normal(0, 1, (200, 4))}
    rows = [("random", "common", 0, 1, 2, 3, 10)]
    write_cell(tmp_path / "random", TASK, "random", 0, {}, visitation=rows, states=states)
    assert report.main([str(tmp_path)]) == 0
    assert [path.name for path in tmp_path.glob("*/*.png")] == ["learning_curves.png"]


def test_rewards_met_in_training_are_compared(tmp_path: Path) -> None:
    """On logarithms, seed by seed; where the sum can be negative there is no such table."""
    write_grid(tmp_path, seeds=[0, 1, 2])
    for method, sums in {"sac_ae": [0, 9], "cure_sac_ae": [9, 99, 5]}.items():
        for seed, met in enumerate(sums):
            write_cell(tmp_path, TASK, method, seed, curve(0, 0), rewards_met=met)
    assert report.main([str(tmp_path)]) == 0
    _, baseline, cure, *_ = rows_of(tmp_path / "table.md", "Rewards met in training")
    # Earlier versions did not record who acted
    assert baseline[2:] == ["2", "4.50 ± 6.36", NONE, NONE, NONE, "1.15", NONE]
    assert cure[2:4] == ["3", "38 ± 53"] and cure[7] == "2.90"
    assert cure[8] == "2.30 [2.30, 2.30]"  # log(10) in both pairs
    write_cell(tmp_path, TASK, "cure_sac_ae", 2, curve(0, 0), rewards_met=-1)
    assert report.main([str(tmp_path)]) == 0
    assert "38 ±" not in (tmp_path / "table.md").read_text()


def test_arm_without_updates_is_named(tmp_path: Path) -> None:
    """Its budget ends within the warm-up: returns of chance are compared."""
    write_two_arms(tmp_path)
    for seed in (0, 1):
        path = tmp_path / TASK / "cure_sac_ae" / f"seed{seed}" / "eval.csv"
        table = pd.read_csv(path)
        table.assign(updates=0).to_csv(path, index=False)
    assert report.main([str(tmp_path)]) == 0
    sentence = "No update was made by cure_sac_ae on cartpole-swingup: the budget ends within"
    assert sentence in (tmp_path / "table.md").read_text().replace("\\_", "_")


def test_overview_comes_first(results: Path) -> None:
    """What was run, and what it says, before any experiment: in the page with links, in the summary as a table."""
    summary = (results / "summary.md").read_text()
    rows = [line.replace("\\", "").split(" | ") for line in summary.splitlines() if "| " in line][1:]
    done = {"curves": "4 of 8", "later": "0 of 4", "pretraining": "2 of 3", "visitation": "3 of 3"}
    assert [(row[0].strip("| "), row[1]) for row in rows] == [
        (f"[{name}]({name}/table.md)", count) for name, count in done.items()
    ]
    assert rows[0][2].startswith("cure_sac_ae minus sac_ae: area under the curve 75.0")
    assert rows[1][2].startswith("Not run")
    assert rows[3][2].startswith("cure_only on cartpole-swingup, 3 seeds: compared to the random policy")
    page = (results / "report.html").read_text().split("<section>")[0]
    for index, (name, count) in enumerate(done.items()):
        assert f'<a href="#e{index}">{name}</a></td><td>{count}</td>' in page


def test_unfinished_cells_enter_nothing(results: Path) -> None:
    for path in (results / "report.html", results / "summary.md"):
        assert "987" not in re.sub(r"data:[^\"]*", "", path.read_text())


def test_arms_that_were_not_run_are_told(results: Path) -> None:
    rows = rows_of(results / "pretraining" / "table.md", "Learning curves")[1:]
    assert rows == [
        [TASK, "vanilla", "1", "150", "300"],
        [TASK, "cure_pretraining", "1", "175", "350"],
        [TASK, "random_pretraining", "0", "not run", "not run"],
    ]


def test_visitation_tables(results: Path) -> None:
    rows = rows_of(results / "visitation" / "table.md", "SRL error per step")[1:]
    by_key = {(row[2], row[3]): row[4:] for row in rows}
    assert by_key["own", "curious"] == ["3", "2.00e-03", "4.00e-03", "8.00e-03", "4.00 [4.00, 4.00]", NONE]
    assert by_key["mean image", "curious"][4] == "1.00 [1.00, 1.00]"
    random, curious = rows_of(results / "visitation" / "table.md", "Coverage of the true state space")[1:]
    assert (random[2], curious[2], random[4], curious[4]) == ("random", "curious", "200", "200")
    assert float(curious[6].split()[0]) > 1.1
    assert "4.00 \\[4.00, 4.00\\] times the SRL error under the own head" in (results / "summary.md").read_text()


def test_conditions_and_plots(results: Path) -> None:
    """Seeds that were run alike share a row; a pair whose arms were not is named; pretraining is told."""
    _, row, *_ = rows_of(results / "curves" / "table.md", "Run conditions")
    machine = ["cpu", "bf16", "x86_64, 2 threads, AVX512"]
    none, hour = "\N{EN DASH}", "1 h 00 min"
    assert row[2:] == ["0, 1", "100,000", none, f"{hour}, {hour}", f"{none}, {none}", *machine, "A", "abc1234", "1"]
    text = (results / "curves" / "table.md").read_text()
    assert "Versions A: sb3\\_cure 0.1.0, torch 2.13.0." in text and "different commits" not in text
    rows = rows_of(results / "pretraining" / "table.md", "Run conditions")[1:]
    assert {row[1]: row[4] for row in rows} == {"vanilla": none, "cure_pretraining": "500,000 (curious)"}
    for name in ("curves/paired_difference", "visitation/coverage", "visitation/visitation_own"):
        with Image.open(results / f"{name}.png") as image:
            assert min(image.size) > 100


def test_versions_of_all_attempts_are_told(tmp_path: Path) -> None:
    write_grid(tmp_path, seeds=1)
    path = write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1)) / "run.json"
    last = json.loads(path.read_text())
    first = {**last, "versions": {**last["versions"], "torch": "2.12.0"}}
    path.write_text(json.dumps({**last, "history": [{"machine": "without versions"}, first, last]}))
    assert report.main([str(tmp_path)]) == 0
    _, row = rows_of(tmp_path / "table.md", "Run conditions")
    assert row[-3] == "A, B"
    assert "Versions A: sb3\\_cure 0.1.0, torch 2.12.0." in (tmp_path / "table.md").read_text()


def test_page_holds_everything_itself(results: Path) -> None:
    page = (results / "report.html").read_text()
    sources = re.findall(r'(?:src|href|poster|srcset|action)\s*=\s*["\']?([^"\'\s>]*)', page)
    assert len(sources) > 10
    assert {source.split(":")[0] for source in sources if not source.startswith("#")} == {"data"}
    assert not re.search(r"<script|@import|url\(", page)
    images = re.findall(r"<img [^>]*>", page)
    assert images and all(re.search(r'alt="[^"]+"', image) for image in images)
    assert "Not run: no cell is done." in page
    assert '"action_repeat": 8' in html.unescape(page) and '"srl": "rae"' in html.unescape(page)


def test_names_are_text_only(tmp_path: Path) -> None:
    """Whatever stands in the files stays text: in HTML, in Markdown, and in matplotlib, which has formulas."""
    arm = HOSTILE.replace("(b)", "")
    folder = tmp_path / "curves"
    write_grid(
        folder, experiment=HOSTILE, methods={"sac_ae": {}, arm: {}}, evaluation={"every": HOSTILE, "episodes": 1}
    )
    for seed in (0, 1):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 1))
        write_cell(folder, TASK, arm, seed, curve(0, 2), arguments={"srl": HOSTILE})
    run = {"versions": {HOSTILE: HOSTILE}, "machine": HOSTILE, "commit": [HOSTILE]}
    (folder / TASK / arm / "seed0" / "run.json").write_text(json.dumps(run))
    report.write_report(folder, tmp_path / "out" / "page.html")
    page = (tmp_path / "out" / "page.html").read_text()
    assert "<img src=x" not in page and HOSTILE in html.unescape(page)
    for path in (folder / "summary.md", folder / "table.md"):
        text = path.read_text()
        assert "<" not in text and not re.search(r"(?<!\\)\]\(b\)", text)
        lines = [line for line in text.splitlines() if line.startswith("|")]
        if path.name == "summary.md":
            assert len(lines) == 3
            continue
        header = next(line for line in lines if "area under curve" in line)
        first = lines.index(header)
        rows = lines[first : first + 4]
        assert all(row.startswith(f"| {TASK} | ") for row in rows[2:])
        assert {len(re.findall(r"(?<!\\)\|", line)) for line in rows} == {6}


def test_media_of_first_seed_or_all(tmp_path: Path) -> None:
    """Of each arm the first seed that has some, which is named; all or none on demand."""
    write_curves(tmp_path / "curves")
    of_task = tmp_path / "curves" / TASK
    write_media(of_task / "sac_ae" / "seed1")
    write_media(of_task / "cure_sac_ae" / "seed0")
    write_media(of_task / "cure_sac_ae" / "seed1", videos=("curious_policy",))
    pages = {}
    for which in ("none", "first", "all"):
        assert report.main([str(tmp_path), "--media", which]) == 0
        pages[which] = (tmp_path / "report.html").read_text()
    assert {which: page.count("<video") for which, page in pages.items()} == {"none": 0, "first": 4, "all": 5}
    named = {which: re.findall(r"<summary>(.*?, seed \d)</summary>", page) for which, page in pages.items()}
    first = [f"{TASK}, sac_ae, seed 1", f"{TASK}, cure_sac_ae, seed 0"]
    assert named == {"none": [], "first": first, "all": [*first, f"{TASK}, cure_sac_ae, seed 1"]}
    videos = re.findall("<video.*?<figcaption>(.*?):", pages["first"])
    assert videos == ["the task policy", "the curious policy"] * 2


def test_errors_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    write_curves(tmp_path / "curves")
    (tmp_path / "curves" / TASK / "sac_ae" / "seed0" / "run.json").write_text("nonsense")
    assert main(["report", str(tmp_path)]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "there is no" in first and "run.json cannot be read" in second
    with pytest.raises(SystemExit):
        report.main([str(tmp_path), "--thresholds", "many"])
    assert "--thresholds: invalid returns value: 'many'" in capsys.readouterr().err


# In a browser


@pytest.fixture(scope="module")
def chromium() -> str:
    return find_program("chromium", "chromium-browser", package="chromium")


def look(chromium: str, page: str, folder: Path) -> tuple[dict[str, list[int]], list[str]]:
    """Open a page from disk: widths of its images and videos (0: broken), widths of what has to be scrolled to be
    seen, heights of its captions (0: hidden), and what the console says.

    A script that measures is added, and the page's policy allows scripts for it; what else it forbids stays forbidden.
    """
    allowed = page.replace("default-src", "script-src 'unsafe-inline'; default-src", 1)
    assert allowed != page
    (folder / "probed.html").write_text(allowed.replace("</body>", PROBE + "</body>"))
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--enable-logging=stderr"]
    options += ["--window-size=718,1000"]  # as wide as a sheet of A4
    options += ["--virtual-time-budget=10000", f"--user-data-dir={folder / 'profile'}", "--dump-dom"]
    command = [chromium, *options, (folder / "probed.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    probe = re.search(r'data-probe="([^"]*)"', done.stdout)
    assert probe, done.stderr[-2000:]
    return json.loads(html.unescape(probe[1])), [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


def test_nothing_is_broken_in_a_browser(chromium: str, results: Path, tmp_path: Path) -> None:
    page = (results / "report.html").read_text()
    sizes, console = look(chromium, page, tmp_path)
    assert console == []
    assert len(sizes["images"]) == page.count("<img ") > 6 and min(sizes["images"]) > 0
    assert sizes["videos"] == [64, 64]
