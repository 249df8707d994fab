"""Measure everything and write ``results/benchmarks/<machine>.json`` and ``.md``.

python -m benchmarks --out results/benchmarks
"""

import argparse
import json
import re
import resource
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import collection, growth, numerics, rendering, replay, update
from benchmarks.harness import describe_machine
from sb3_cure.allocator import tune_allocator


def to_markdown(results: Mapping[str, Any], level: int = 1) -> list[str]:
    """
    :param results: Nested dictionaries of numbers
    :param level: Level of the headings
    :return: Lines of a report: a table wherever all values are dictionaries of numbers
    """
    lines: list[str] = []
    plain = {key: value for key, value in results.items() if not isinstance(value, Mapping)}
    nested = {key: value for key, value in results.items() if isinstance(value, Mapping)}
    if plain:
        lines += ["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in plain.items()), ""]
    rows = list(nested.values())
    if rows and all(
        row.keys() == rows[0].keys() and not any(isinstance(v, Mapping) for v in row.values()) for row in rows
    ):
        lines += ["| | " + " | ".join(rows[0]) + " |", "|---|" + "---|" * len(rows[0])]
        lines += [
            f"| {name} | " + " | ".join(str(value) for value in row.values()) + " |" for name, row in nested.items()
        ]
        return [*lines, ""]
    for name, value in nested.items():
        lines += [f"{'#' * level} {name.replace('_', ' ')}", "", *to_markdown(value, level + 1)]
    return lines


def parts(repeats: int, disk: str | None) -> dict[str, Callable[[], dict[str, Any]]]:
    """
    :param repeats: Rounds of the comparisons
    :param disk: Directory for the buffer of a million transitions (22 GB), or None
    :return: What can be measured, by name, in the order of the report
    """
    return {
        "update": partial(update.measure, repeats),
        "update_by_phase": update.breakdowns,
        "replay": replay.measure,
        "rendering": rendering.measure,
        "end_to_end": collection.measure,
        "growth_with_batch": growth.by_batch,
        "growth_with_image": growth.by_image,
        "growth_with_buffer": growth.by_buffer,
        "bfloat16_against_float32": numerics.measure,
        **({"buffer_on_disk": partial(growth.on_disk, 1_000_000, disk)} if disk is not None else {}),
    }


def _run(part: str, repeats: int, disk: str | None) -> tuple[dict[str, Any], float]:
    """A part's results and the peak of the process's memory, MiB."""
    tune_allocator()
    results = parts(repeats, disk)[part]()
    return results, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Run the benchmarks, each part in a process of its own."""
    names = list(parts(1, "."))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder to write")
    parser.add_argument("--repeats", type=int, default=7, help="rounds of each comparison (default: 7)")
    parser.add_argument("--only", nargs="+", choices=names, help="measure these anew and keep the rest of the report")
    parser.add_argument(
        "--disk", help="directory with 22 GB of room: also measure a buffer of a million transitions there"
    )
    options = parser.parse_args()
    machine = describe_machine()
    processor = machine["gpu"] or machine["processor"]
    name = re.sub(r"[^a-z0-9]+", "-", f"{processor}-{machine['cores']}-cores".lower()).strip("-")
    path = options.out / f"{name}.json"
    measured = json.loads(path.read_text()) if options.only and path.exists() else {}
    options.out.mkdir(parents=True, exist_ok=True)
    for part in parts(1, options.disk):
        if options.only is None or part in options.only:
            print(f"{part} ...", flush=True)
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                results, peak = process.submit(_run, part, options.repeats, options.disk).result()
            measured[part] = {"peak_memory_mb": round(peak), **results}
            report = {"machine": machine, **{key: measured[key] for key in names if key in measured}}
            path.write_text(json.dumps(report, indent=2) + "\n")
            path.with_suffix(".md").write_text("\n".join(["# Benchmarks", "", *to_markdown(report, 2)]))
    print(f"Wrote {path} and {path.with_suffix('.md').name}")


if __name__ == "__main__":
    main()
