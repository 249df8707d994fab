"""The report of results: right numbers, nothing from elsewhere, nothing broken in a browser."""

import html
import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import yaml
from PIL import Image
from programs_for_tests import find_program
from results_for_tests import CURE, RAE, write_cell, write_csv, write_grid

from sb3_cure.evaluation import plots
from sb3_cure.experiments import report, statistics
from sb3_cure.experiments.results import ResultsError, read_results
from sb3_cure.experiments.tables import NONE, conditions_table

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


def curve(*values: float) -> dict[int, float]:
    return {round(100_000 * index / (len(values) - 1)): value for index, value in enumerate(values)}


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
    """One seed of two arms; the paper reports 833 and 846."""
    arms = {"vanilla": 300, "cure_pretraining": 350, "random_pretraining": 0}
    write_grid(folder, kind="pretraining", seeds=1, methods=arms, baseline="vanilla")
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


@pytest.fixture(scope="module", autouse=True)
def few_resamples() -> Iterator[None]:
    """As rliable takes seconds for its two thousand."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(statistics, "RLIABLE_REPS", 50)
        yield


@pytest.fixture(scope="module")
def results(few_resamples: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    # Means of 50 and 100, 100 and 200; sample standard deviations; quartiles of two values are half their distance.
    assert baseline[2:7] == ["2", "75 ± 35", "150 ± 71", "50", "25"]
    assert cure[2:7] == ["2", "150 ± 71", "300 ± 141", "100", "50"]
    assert baseline[7:] == ["not reached"] * 3
    assert cure[7:] == ["> 100,000 (1 of 2)", "not reached", "not reached"]
    assert unfinished[2:5] == ["0", "unfinished: 0; failed: 1", "unfinished: 0; failed: 1"]
    assert not_run[2:5] == ["0", "not run", "not run"]
    (difference,) = rows_of(results / "curves" / "table.md", "Paired difference from sac\\_ae: area")[1:]
    minus = "\N{MINUS SIGN}"
    assert difference[:5] == ["cure_sac_ae", TASK, "2", "2", "75.0"]
    assert difference[5:] == [f"[{minus}242.7, 392.7]", "[50.0, 100.0]", "2", "inconclusive"]
    headlines = (results / "curves" / "table.md").read_text().replace("\\", "")
    assert "cure_sac_ae minus sac_ae: area under the curve 75.0" in headlines
    assert "2 pairs of seeds on cartpole-swingup: inconclusive." in headlines


def test_small_returns_are_not_rounded_away(tmp_path: Path) -> None:
    """Such as rates of success, beside a task of another scale."""
    write_grid(tmp_path, tasks=["mine/Reach-v0", "mine/Push-v0"])
    for seed in (0, 1):
        for task, scale in (("Reach", 1), ("Push", 400)):
            write_cell(tmp_path, task, "sac_ae", seed, curve(0, scale * (0.5 + 0.25 * seed)))
            write_cell(tmp_path, task, "cure_sac_ae", seed, curve(0, scale * (0.75 + 0.25 * seed)), arguments=CURE)
    assert report.main([str(tmp_path), "--thresholds", "0.7,300"]) == 0
    header, reach, _, push, _ = rows_of(tmp_path / "table.md", "Learning curves")
    assert reach[3:7] == ["0.31 ± 0.09", "0.62 ± 0.18", "0.12", "0.06"]
    assert push[3:7] == ["125 ± 35", "250 ± 71", "50", "25"]
    assert header[7:] == ["steps to 0.7", "steps to 300"]
    _, both, alone, _ = rows_of(tmp_path / "table.md", "Paired difference from sac\\_ae: area")
    assert (both[4], alone[4:7]) == ("25.1", ["0.12", "[0.12, 0.12]", "[0.12, 0.12]"])


def test_pairs_with_other_starts_are_told(tmp_path: Path) -> None:
    """Such as those of another implementation, with other initial weights."""
    write_grid(tmp_path)
    for seed in (0, 1):
        write_cell(tmp_path, TASK, "sac_ae", seed, curve(10, 100))
        write_cell(tmp_path, TASK, "cure_sac_ae", seed, curve(10 + seed, 200), arguments=CURE)
    assert report.main([str(tmp_path)]) == 0
    assert "2 pairs of seeds, 1 with the same start, on cartpole-swingup" in (tmp_path / "table.md").read_text()


def test_an_experiment_without_an_update_says_so_first(tmp_path: Path) -> None:
    for budget, says in ((7, True), (100_000, False)):
        folder = tmp_path / str(budget)
        write_grid(folder, budget=budget)
        for method in ("sac_ae", "cure_sac_ae"):
            write_cell(folder, TASK, method, 0, {0: 10, budget: 10}, budget=budget)
        assert report.main([str(folder)]) == 0
        assert (folder / "table.md").read_text().split("\n- ")[1].startswith("No update was made") == says


def test_cells_reached_in_training_are_compared(tmp_path: Path) -> None:
    """Also of arms without a task, which have no returns; a seed that only one arm has done does not count."""
    write_grid(tmp_path, seeds=[0, 1, 2])
    reached = {"sac_ae": {0: (10, 100), 1: (20, 200)}, "cure_sac_ae": {0: (10, 400), 1: (20, 200), 2: (10, 999)}}
    for method, seeds in reached.items():
        for seed, cells in seeds.items():
            cell = write_cell(tmp_path, TASK, method, seed, curve(0, 0))
            rows = [(50_000 * (index + 1), 0, count, 1.0) for index, count in enumerate(cells)]
            write_csv(cell / "coverage.csv", ("environment_steps", "agent_steps", "cells", "entropy_bits"), rows)
    assert report.main([str(tmp_path)]) == 0
    header, baseline, cure, *_ = rows_of(tmp_path / "table.md", "Cells of the true state")
    assert header[3:] == ["at 50,000", "at 100,000", "/ baseline"]
    assert baseline[2:] == ["2", "15 ± 7", "150 ± 71", NONE]
    assert cure[2:5] == ["3", "13 ± 6", "533 ± 416"]
    assert cure[5].startswith("2.00 [")  # of 4 and 1
    assert (tmp_path / "cells_reached.png").exists()
    assert "cure_sac_ae on cartpole-swingup, 2 seeds: it reached 2.00" in (tmp_path / "table.md").read_text().replace(
        "\\", ""
    )


def test_cells_that_were_counted_once_are_compared(tmp_path: Path) -> None:
    """In table and headline; there is no line to draw."""
    write_grid(tmp_path)
    for method, cells in {"sac_ae": 100, "cure_sac_ae": 300}.items():
        cell = write_cell(tmp_path, TASK, method, 0, curve(0, 0))
        columns = ("environment_steps", "agent_steps", "cells", "entropy_bits")
        write_csv(cell / "coverage.csv", columns, [(100_000, 0, cells, 1.0)])
    assert report.main([str(tmp_path)]) == 0
    _, baseline, cure, *_ = rows_of(tmp_path / "table.md", "Cells of the true state")
    assert (baseline[3], cure[3]) == ("100", "300")
    assert "it reached 3.00 (one seed) times the cells" in (tmp_path / "table.md").read_text()
    assert not (tmp_path / "cells_reached.png").exists()


def test_cells_of_other_widths_are_not_compared(tmp_path: Path) -> None:
    write_grid(tmp_path)
    for method, width in {"sac_ae": 0.1, "cure_sac_ae": 0.2}.items():
        write_cell(tmp_path, TASK, method, 0, curve(0, 0), coverage={"widths": {"slider": width}, "at": [100_000]})
    with pytest.raises(ResultsError, match=r"was run with coverage .* cannot be compared"):
        read_results(tmp_path)


def test_coverage_comes_first_where_no_arm_has_a_return(tmp_path: Path) -> None:
    """Of curious agents alone."""
    write_grid(tmp_path)
    for method, cells in {"sac_ae": 100, "cure_sac_ae": 300}.items():
        for seed in (0, 1):
            cell = write_cell(tmp_path, TASK, method, seed, curve(0, 0), arguments={**CURE, "task": False})
            table = (cell / "eval.csv").read_text().splitlines()
            without = [
                ",".join(["" if i in (4, 5) else each for i, each in enumerate(row.split(","))]) for row in table[1:]
            ]
            (cell / "eval.csv").write_text("\n".join([table[0], *without]) + "\n")
            rows = [(steps, 0, cells, 1.0) for steps in (50_000, 100_000)]
            write_csv(cell / "coverage.csv", ("environment_steps", "agent_steps", "cells", "entropy_bits"), rows)
    assert report.main([str(tmp_path)]) == 0
    told = (tmp_path / "table.md").read_text().replace("\\", "")
    assert "- cure_sac_ae on cartpole-swingup, 2 seeds: it reached 3.00 [3.00, 3.00] times the cells of sac_ae." in told


def test_rewards_met_in_training_are_compared(tmp_path: Path) -> None:
    """On logarithms, seed by seed; where the sum can be negative there is no such table."""
    write_grid(tmp_path, seeds=[0, 1, 2])
    for method, sums in {"sac_ae": [0, 9], "cure_sac_ae": [9, 99, 5]}.items():
        for seed, met in enumerate(sums):
            write_cell(tmp_path, TASK, method, seed, curve(0, 0), rewards_met=met)
    assert report.main([str(tmp_path)]) == 0
    _, baseline, cure, *_ = rows_of(tmp_path / "table.md", "Rewards met in training")
    assert baseline[2:] == ["2", "4 ± 6", "1.15", NONE]
    assert cure[2:5] == ["3", "38 ± 53", "2.90"]
    assert cure[5] == "2.30 [2.30, 2.30]"  # log(10) in both pairs
    write_cell(tmp_path, TASK, "cure_sac_ae", 2, curve(0, 0), rewards_met=-1)
    assert report.main([str(tmp_path)]) == 0
    assert "38 ±" not in (tmp_path / "table.md").read_text()


def test_headlines_tell_how_many_seeds(tmp_path: Path) -> None:
    """Common heads judge only some seeds here."""
    write_visitation(tmp_path)
    table = tmp_path / TASK / "cure_only" / "seed2" / "visitation.csv"
    table.write_text("".join(line for line in table.read_text().splitlines(True) if ",common," not in line))
    assert report.main([str(tmp_path)]) == 0
    told = (tmp_path / "table.md").read_text()
    assert re.search(r"4\.00 .* times the SRL error under the own head \(3 seeds\)", told)
    assert re.search(r"4\.00 .* times the SRL error under the common head \(2 seeds\)", told)


def test_overview_comes_first(results: Path) -> None:
    """What was run, and what it says, before any experiment: in the page with links, in the summary as a table."""
    summary = (results / "summary.md").read_text()
    rows = [line.replace("\\", "").split(" | ") for line in summary.split("\n## ")[0].splitlines() if "| " in line][1:]
    assert [(row[0].strip("| "), row[1]) for row in rows] == [
        ("curves", "4 of 8"), ("later", "0 of 4"), ("pretraining", "2 of 3"), ("visitation", "3 of 3"),
    ]  # fmt: skip
    assert rows[0][2].startswith("cure_sac_ae minus sac_ae: area under the curve 75.0")
    assert rows[1][2].startswith("Not run")
    assert rows[3][2].startswith("cure_only on cartpole-swingup, 3 seeds: compared to the random policy")
    page = (results / "report.html").read_text().split("<section>")[0]
    for index, (name, done, *_) in enumerate(rows):
        assert f'<a href="#e{index}">{name.strip("| ")}</a></td><td>{done}</td>' in page


def test_environment_settings_are_told(tmp_path: Path) -> None:
    """Once where all cells share them, else with their tasks: returns from other pixels do not compare."""
    write_grid(tmp_path)
    small = {"image_size": 36, "grayscale": True}
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1), env_kwargs=small)
    write_cell(tmp_path, TASK, "cure_sac_ae", 0, curve(0, 1), env_kwargs={"image_size": 50}, done=False)
    assert report.main([str(tmp_path)]) == 0
    told = (tmp_path / "table.md").read_text().replace("\\", "").splitlines()[2]
    assert told.endswith("; environments: grayscale True, image_size 36")
    write_cell(tmp_path, "finger-spin", "sac_ae", 0, curve(0, 1))
    assert report.main([str(tmp_path)]) == 0
    told = (tmp_path / "table.md").read_text().replace("\\", "").splitlines()[2]
    assert told.endswith(f"grayscale True, image_size 36 ({TASK}); as registered (finger-spin)")


def test_unfinished_cells_enter_nothing(results: Path) -> None:
    for path in (results / "report.html", results / "summary.md"):
        assert "987" not in re.sub(r"data:[^\"]*", "", path.read_text())


def test_returns_beside_published_ones(results: Path) -> None:
    rows = rows_of(results / "summary.md", "Beside published returns")[1:]
    by_arm = {(row[0], row[2]): row[3:10] for row in rows}
    suspected, minus = "suspected bug: below 0.75 x published", "\N{MINUS SIGN}"
    expected = ["100,000", "2", "150 ± 71", "SAC-AE 311 ± 11", f"{minus}161", "0.482", suspected]
    assert by_arm["curves", "sac_ae"] == expected
    assert by_arm["curves", "cure_sac_ae"][-1] == "adds curiosity, or changes settings: not judged"
    assert by_arm["pretraining", "vanilla"] == ["100,000", "1", "300", "SAC-AE 311 ± 11", f"{minus}11", "0.965", "ok"]


def test_pretraining_beside_the_paper(results: Path) -> None:
    rows = rows_of(results / "pretraining" / "table.md", "Final return after pretraining")[1:]
    minus = "\N{MINUS SIGN}"
    assert rows == [
        [TASK, "vanilla", "1", "300", "833 ± 27", f"{minus}533"],
        [TASK, "cure_pretraining", "1", "350", "846 ± 25", f"{minus}496"],
        [TASK, "random_pretraining", "0", "not run", "784 ± 12", "\N{EN DASH}"],
    ]
    (row,) = rows_of(results / "pretraining" / "table.md", "Paired difference between any two arms")[1:]
    assert row[:5] == ["cure_pretraining minus vanilla", TASK, "1", "1", "25.0"]
    assert row[5:] == ["one seed: no interval", "one seed: no interval", "1", "one seed: no interval"]


def test_visitation_tables(results: Path) -> None:
    rows = rows_of(results / "visitation" / "table.md", "SRL error per step")[1:]
    by_key = {(row[2], row[3]): row[4:] for row in rows}
    paper = "0.0531 / 0.0540 / 0.0548"
    assert by_key["own", "curious"] == [
        "3",
        "2.00e-03",
        "4.00e-03",
        "8.00e-03",
        "4.00 [4.00, 4.00]",
        "\N{EN DASH}",
        paper,
    ]
    assert by_key["mean image", "curious"][4] == "1.00 [1.00, 1.00]"
    random, curious = rows_of(results / "visitation" / "table.md", "Coverage of the true state space")[1:]
    assert (random[2], curious[2], random[4], curious[4]) == ("random", "curious", "200", "200")
    assert float(curious[6].split()[0]) > 1.1 and float(curious[8]) > float(random[8])
    assert "4.00 \\[4.00, 4.00\\] times the SRL error under the own head" in (results / "summary.md").read_text()


def test_conditions_and_plots(results: Path) -> None:
    """Seeds that were run alike share a row; a pair whose arms were not is named; pretraining is told."""
    _, row, *_ = rows_of(results / "curves" / "table.md", "Run conditions")
    machine = ["cpu", "bf16", "x86_64, 2 threads, AVX512"]
    none = "\N{EN DASH}"
    assert row[2:] == ["0, 1", "100,000", none, "1.0 h, 1.0 h", *machine, "A", "abc1234", "1"]
    text = (results / "curves" / "table.md").read_text()
    assert "Versions A: sb3\\_cure 0.1.0, torch 2.13.0." in text and "different commits" not in text
    rows = rows_of(results / "pretraining" / "table.md", "Run conditions")[1:]
    assert {row[1]: row[4] for row in rows} == {"vanilla": none, "cure_pretraining": "500,000 (curious)"}
    for name in ("curves/learning_curves", "curves/paired_difference", "curves/aggregates", "visitation/coverage"):
        with Image.open(results / f"{name}.png") as image:
            assert min(image.size) > 100


def test_all_commits_of_cell_are_told(tmp_path: Path) -> None:
    """Of a cell that was resumed with other code the last one alone would be false."""
    write_curves(tmp_path)
    path = tmp_path / TASK / "sac_ae" / "seed1" / "run.json"
    resumed = {"history": [{}, {"commit": "older"}, {"commit": "abc1234"}]}
    path.write_text(json.dumps({**json.loads(path.read_text()), **resumed}))
    table = conditions_table(read_results(tmp_path)[0])
    commits = table.rows.set_index(["arm", "seeds"]).commit
    assert (commits["sac_ae", "0"], commits["sac_ae", "1"]) == ("abc1234", "unknown, older, abc1234")
    assert f"at different commits: {TASK} seed 1." in table.note


def test_page_holds_everything_itself(results: Path) -> None:
    page = (results / "report.html").read_text()
    sources = re.findall(r'(?:src|href|poster|srcset|action)\s*=\s*["\']?([^"\'\s>]*)', page)
    assert len(sources) > 10
    assert {source.split(":")[0] for source in sources if not source.startswith("#")} == {"data"}
    assert not re.search(r"<script|@import|url\(", page)
    images = re.findall(r"<img [^>]*>", page)
    assert images and all(re.search(r'alt="[^"]+"', image) for image in images)
    assert "No aggregates over tasks" in page and "Not run: no cell is done." in page
    assert '"action_repeat": 8' in html.unescape(page) and '"srl": "rae"' in html.unescape(page)


def test_names_are_text_only(tmp_path: Path) -> None:
    """Whatever stands in the files stays text: in HTML, in Markdown, and in matplotlib, which has formulas."""
    arm = HOSTILE.replace("(b)", "")
    folder = tmp_path / "curves"
    write_grid(folder, experiment=HOSTILE, methods={"sac_ae": {}, arm: {}}, evaluation={"every": HOSTILE})
    for seed in (0, 1):
        write_cell(folder, TASK, "sac_ae", seed, curve(0, 1))
        write_cell(folder, TASK, arm, seed, curve(0, 2), arguments={"srl": HOSTILE})
    run = {"versions": {HOSTILE: HOSTILE}, "machine": HOSTILE, "commit": [HOSTILE], "seconds": "x"}
    (folder / TASK / arm / "seed0" / "run.json").write_text(json.dumps(run))
    (folder / TASK / arm / "seed0" / "reconstructions.png").write_bytes(b"no picture")
    (folder / TASK / arm / "seed0" / "task_policy.mp4").write_bytes(b"no video")
    report.write_report(folder, tmp_path / "out" / "page.html")
    page = (tmp_path / "out" / "page.html").read_text()
    assert "<img src=x" not in page and HOSTILE in html.unescape(page)
    assert "reconstructions.png cannot be shown" in page and "task_policy.mp4 cannot be shown" in page
    for path in (folder / "summary.md", folder / "table.md"):
        text = path.read_text()
        assert "<" not in text and not re.search(r"(?<!\\)\]\(b\)", text)
        lines = [line for line in text.splitlines() if line.startswith("|")]
        header = next(line for line in lines if "area under curve" in line)
        rows = [line for line in lines if line.startswith(f"| {TASK} | ") and "not reached" in line]
        assert len(rows) == 2
        assert {len(re.findall(r"(?<!\\)\|", line)) for line in [header, *rows]} == {11}


def test_names_of_arms_are_no_verdicts(tmp_path: Path) -> None:
    """However they begin; and one arm alone is compared with nothing."""
    write_grid(tmp_path, methods={"better_one": {}}, baseline="better_one")
    write_cell(tmp_path, TASK, "better_one", 0, curve(0, 1))
    assert report.main([str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    assert "<td>better_one</td>" in page and 'class="good"' not in page
    assert "One arm: there is nothing to compare it with." in page and "any two arms" not in page


def test_arms_without_returns_are_not_compared(tmp_path: Path) -> None:
    """A curious agent alone has finished the baseline's seed, but there is no return to compare."""
    write_grid(tmp_path, methods={"sac_ae": {}, "cure": {}})
    write_cell(tmp_path, TASK, "sac_ae", 0, curve(0, 1))
    write_cell(tmp_path, TASK, "cure", 0, dict.fromkeys(curve(0, 1), ""), arguments={**RAE, "task": False})
    assert report.main([str(tmp_path)]) == 0
    said = "No arm shares a seed that has returns with the baseline sac_ae: nothing to compare."
    assert said in (tmp_path / "report.html").read_text()


def test_report_of_read_only_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page elsewhere is whole; that the tables are missing is said."""
    write_grid(tmp_path / "theirs")
    write_cell(tmp_path / "theirs", TASK, "sac_ae", 0, curve(0, 1))
    write_bytes = Path.write_bytes

    def refuse(self: Path, content: bytes) -> int:
        if "theirs" in self.parts:
            raise PermissionError(13, "Permission denied")
        return write_bytes(self, content)

    monkeypatch.setattr(Path, "write_bytes", refuse)
    assert report.main([str(tmp_path / "theirs"), "--out", str(tmp_path / "mine.html")]) == 0
    assert "theirs cannot be written to (Permission denied): its tables and plots are in" in capsys.readouterr().out
    assert "<h1>theirs</h1>" in (tmp_path / "mine.html").read_text()
    assert report.main([str(tmp_path / "theirs")]) == 1
    assert "report.html cannot be written (Permission denied): choose another --out." in capsys.readouterr().err


def test_full_disk_costs_no_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that are there stay whole; and experiments that can be written to get theirs."""
    folders = [tmp_path / name for name in ("full", "later")]
    for folder in folders:
        write_curves(folder)
    assert report.main([str(tmp_path)]) == 0
    before = (folders[0] / "table.md").read_text()
    (folders[1] / "table.md").unlink()
    write_bytes = Path.write_bytes

    def refuse(self: Path, content: bytes) -> int:
        if "full" in self.parts:
            write_bytes(self, content[:100])
            raise OSError(28, "No space left on device")
        return write_bytes(self, content)

    monkeypatch.setattr(Path, "write_bytes", refuse)
    assert report.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("full cannot be written to (No space left on device): its tables") == 1
    assert (folders[0] / "table.md").read_text() == before
    assert (folders[1] / "table.md").exists()


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


def test_srl_errors_of_both_policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line for each arm and policy that was measured, with that policy's numbers; the legend tells them apart."""
    write_grid(tmp_path / "curves", seeds=1)
    write_cell(tmp_path / "curves", TASK, "sac_ae", 0, curve(0, 50, 100))
    write_cell(tmp_path / "curves", TASK, "cure_sac_ae", 0, curve(0, 50, 100), arguments=CURE, curious=True)
    (experiment,) = read_results(tmp_path)
    drawn: list[Any] = []
    legends: list[list[str]] = []
    draw, legend = plots.policy_curves, plots.Figure.legend
    monkeypatch.setattr(plots, "policy_curves", lambda *args: (drawn.append(args[1]), draw(*args)))
    monkeypatch.setattr(
        plots.Figure,
        "legend",
        lambda self, handles, labels, **how: (legends.append(list(labels)), legend(self, handles, labels, **how)),
    )
    colors = plots.arm_colors(experiment.methods, "sac_ae")
    figures = {figure.name: figure for figure in report.curve_figures(experiment, colors)}
    assert list(figures) == ["learning_curves.png", "srl_loss.png", "srl_error.png"]
    means = {key: values.mean() for key, (_, values) in drawn[-1][TASK].items()}
    # What `write_cell` writes for each policy
    task = {(arm, "task"): pytest.approx(1e-3) for arm in ("sac_ae", "cure_sac_ae")}
    assert means == {**task, ("cure_sac_ae", "curious"): pytest.approx(2e-3)}
    assert legends[-1] == ["sac_ae (1 seed)", "cure_sac_ae (1 seed)", "task policy", "curious policy"]
    assert legends[0] == ["sac_ae (1 seed)", "cure_sac_ae (1 seed)"], "returns are the task policy's alone"
    assert "deterministic" in figures["learning_curves.png"].caption
    assert "the task policy (solid lines) and the curious policy (dashed lines)" in figures["srl_error.png"].caption


def test_captions_name_what_is_drawn(results: Path, tmp_path: Path) -> None:
    """No curious policy where none was measured, nor the paper's error beside other pixels."""
    write_grid(tmp_path / "curves", seeds=1)
    write_cell(tmp_path / "curves", TASK, "sac_ae", 0, curve(0, 50, 100))
    write_visitation(tmp_path / "visitation")
    for config in (tmp_path / "visitation").rglob("config.json"):
        config.write_text(json.dumps({**json.loads(config.read_text()), "env_kwargs": {"image_size": 36}}))
    report.write_report(tmp_path, tmp_path / "report.html")
    curves, visitation = ((tmp_path / name / "table.md").read_text() for name in ("curves", "visitation"))
    assert "met by the task policy (solid lines), acting" in curves and "(dashed" not in curves
    zero_and_mean = "the mean error of always predicting zero, always predicting the mean image"
    assert visitation.count(f"{zero_and_mean}.]") == 2
    papers = f"{zero_and_mean}, the paper's curious policy.]"
    assert (results / "visitation" / "table.md").read_text().count(papers) == 2


def test_titles_tell_other_baselines(tmp_path: Path) -> None:
    """The difference of "two minus one" is none from the experiment's baseline."""
    write_grid(
        tmp_path / "curves", seeds=1, methods={"base": {}, "one": {}, "two": {"baseline": "one"}}, baseline="base"
    )
    for method in ("base", "one", "two"):
        write_cell(tmp_path / "curves", TASK, method, 0, curve(0, 50, 100))
    report.write_report(tmp_path, tmp_path / "report.html")
    text = (tmp_path / "curves" / "table.md").read_text()
    assert "| two minus one |" in text
    assert text.count('Paired difference from base, or the arm after "minus": ') == 2
    assert 'minus that of base, or the arm after "minus": mean' in text


def test_return_just_below_bar_is_suspected(tmp_path: Path) -> None:
    """0.749 of the published mean is below 0.75, which 0.75 is not."""
    write_grid(tmp_path / "curves", seeds=1)
    write_cell(tmp_path / "curves", TASK, "sac_ae", 0, curve(0, 50, 233))
    report.write_report(tmp_path, tmp_path / "report.html")
    (row,) = rows_of(tmp_path / "summary.md", "Beside published returns")[1:]
    assert row[8:10] == ["0.749", "suspected bug: below 0.75 x published"]


def test_all_arms_of_our_grids_differ_in_colour(tmp_path: Path) -> None:
    """By colours of their own, in panels that the legend leaves as they are."""
    grids = Path(__file__).parents[2] / "zoo_configs" / "experiments"
    arms = max((list(yaml.safe_load(path.read_text())["methods"]) for path in grids.rglob("*.yml")), key=len)
    colors = plots.arm_colors(arms, arms[0])
    assert len(set(colors.values())) == len(arms) > 10
    heights = []
    for some in (arms[:2], arms):
        line = np.linspace(0, 100, 5), np.full((1, 5), 0.5)
        plots.learning_curves(tmp_path / "lines.png", {TASK: dict.fromkeys(some, line)}, colors, "return")
        pixels = np.asarray(Image.open(tmp_path / "lines.png").convert("L"))
        heights.append((pixels < 50).sum(axis=0).max())  # of the axis on the left
    assert heights[1] > 0.9 * heights[0]


def test_line_styles_tell_policies_apart(tmp_path: Path) -> None:
    """The same numbers take less ink, and the same colour, as those of the curious policy: a dashed line."""
    line = np.linspace(0, 100, 5), np.full((1, 5), 0.5)
    ink = {}
    for actor in ("task", "curious"):
        plots.policy_curves(tmp_path / "lines.png", {TASK: {("arm", actor): line}}, {"arm": "#d62728"}, "error", True)
        pixels = np.asarray(Image.open(tmp_path / "lines.png").convert("RGB")).astype(int)
        ink[actor] = (np.abs(pixels - (0xD6, 0x27, 0x28)).max(axis=2) < 60).sum()
    assert 0.3 * ink["task"] < ink["curious"] < 0.9 * ink["task"]


def test_means_stay_in_sight_below_high_maxima(tmp_path: Path) -> None:
    """Contrastive errors of mean .1 and .3, from 0 to 6: the marks of the means lie well apart."""
    errors = {"random": np.array([0.0] * 59 + [6.0]), "curious": np.array([0.0] * 19 + [6.0])}
    bars = [(actor, actor, (each.min(), each.max()), each.mean(keepdims=True), "") for actor, each in errors.items()]
    plots.visitation_bars(tmp_path / "bars.png", {"title": bars}, {})
    pixels = np.asarray(Image.open(tmp_path / "bars.png").convert("RGB")).astype(int)
    heights = []
    for red, green, blue in ((0x88, 0x88, 0x88), (0xD6, 0x27, 0x28)):
        ink = np.abs(pixels - (red, green, blue)).max(axis=2) < 25
        heights.append(next(row for row in range(len(ink)) if 20 < ink[row].sum()))  # the mark is wider than the line
    assert heights[0] - heights[1] > 0.1 * len(pixels)


def test_pictures_have_few_colours(results: Path) -> None:
    """Those of cells, too, which are the largest files of results."""
    frames = np.random.default_rng(0).integers(0, 255, (2, 3, 40, 40), dtype=np.uint8)
    plots.reconstructions_over_training(results / "rows.png", frames, [(10, frames)], "title")
    for path in (results / "rows.png", results / "curves" / "learning_curves.png"):
        with Image.open(path) as image:
            assert image.mode == "P" and len(image.getcolors() or ()) <= 256


def test_errors_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main([str(tmp_path / "nowhere")]) == 1
    write_curves(tmp_path / "curves")
    (tmp_path / "curves" / TASK / "sac_ae" / "seed0" / "eval.csv").write_text("nonsense")
    assert report.main([str(tmp_path)]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "nowhere is no folder" in first and "eval.csv cannot be read (has no column" in second
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
    assert len(sizes["images"]) == page.count("<img ") > 8 and min(sizes["images"]) > 0
    assert sizes["videos"] == [64, 64]


def test_browser_check_finds_what_is_broken(chromium: str, results: Path, tmp_path: Path) -> None:
    """A damaged picture and video, a picture from the network, and an error on the console."""
    page = (results / "report.html").read_text()
    broken = '<img src="data:image/png;base64,AAAA"><video src="data:video/mp4;base64,AAAA"></video>'
    broken += '<img src="http://127.0.0.1:9/x.png"><script>nowhere()</script></body>'
    sizes, console = look(chromium, page.replace("</body>", broken), tmp_path)
    assert sizes["images"].count(0) == 2 and sizes["videos"].count(0) == 1
    assert len(console) == 2 and "Content Security Policy" in console[0] and "nowhere is not defined" in console[1]


def test_print_shows_whole_tables(chromium: str, results: Path, tmp_path: Path) -> None:
    """Paper cannot be scrolled. Videos, which it has not, leave no captions behind."""
    page = (results / "report.html").read_text()
    on_screen, _ = look(chromium, page, tmp_path)
    printed, _ = look(chromium, page.replace("@media print", "@media all"), tmp_path)
    assert on_screen["cut"] and printed["cut"] == []
    assert 0 not in on_screen["captions"] and printed["captions"].count(0) == len(printed["videos"]) == 2
