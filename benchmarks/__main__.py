"""Measure everything and write ``results/benchmarks/<machine>.json`` and ``.md``.

python -m benchmarks --out results/benchmarks
"""

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks import collection, growth, numerics, rendering, replay, update
from benchmarks.harness import describe_machine, peak_memory_mb
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


def main() -> None:
    """Run the benchmarks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder to write")
    parser.add_argument("--repeats", type=int, default=7, help="rounds of each comparison (default: 7)")
    options = parser.parse_args()
    tune_allocator()
    machine = describe_machine()
    parts = {
        "update": lambda: update.measure(options.repeats),
        "update_by_phase": lambda: {"rae": update.breakdown(srl="rae"), "curl": update.breakdown(srl="curl")},
        "replay": replay.measure,
        "rendering": rendering.measure,
        "end_to_end": collection.measure,
        "bfloat16_against_float32": numerics.measure,
        "growth_with_batch": growth.by_batch,
        "growth_with_image": growth.by_image,
        "growth_with_buffer": growth.by_buffer,
    }
    results: dict[str, Any] = {"machine": machine}
    for name, measure in parts.items():
        print(f"{name} ...", flush=True)
        results[name] = measure()
    results["peak_memory"] = {"whole_benchmark_mb": round(peak_memory_mb())}
    options.out.mkdir(parents=True, exist_ok=True)
    name = (
        re.sub(r"[^A-Za-z0-9]+", "-", f"{machine['gpu'] or machine['processor']}-{machine['cores']}-cores")
        .strip("-")
        .lower()
    )
    (options.out / f"{name}.json").write_text(json.dumps(results, indent=2) + "\n")
    (options.out / f"{name}.md").write_text("\n".join(["# Benchmarks", "", *to_markdown(results, 2)]))
    print(f"Wrote {options.out / name}.json and .md")


if __name__ == "__main__":
    main()
