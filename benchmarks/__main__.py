"""Measure everything and write ``results/benchmarks/<machine>.json`` and ``.md``.

python -m benchmarks --out results/benchmarks
"""

import argparse
import json
import re
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.harness import describe_machine, machine_title
from benchmarks.parts import parts, run_part


def to_markdown(results: Mapping[str, Any], level: int = 1) -> list[str]:
    """Format nested results as Markdown.

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
    title = machine_title(machine)
    name = re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")
    path = options.out / f"{name}.json"
    measured = json.loads(path.read_text()) if options.only and path.exists() else {}
    options.out.mkdir(parents=True, exist_ok=True)
    for part in parts(1, options.disk):
        if options.only is None or part in options.only:
            print(f"{part} ...", flush=True)
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                results, peak = process.submit(run_part, part, options.repeats, options.disk).result()
            version = machine["versions"]["sb3_cure"]  # with --only, other parts may be of another one
            measured[part] = {"sb3_cure": version, "peak_memory_mb": round(peak), **results}
            report = {"machine": machine, **{key: measured[key] for key in names if key in measured}}
            path.write_text(json.dumps(report, indent=2) + "\n")
            path.with_suffix(".md").write_text("\n".join([f"# Benchmarks: {title}", "", *to_markdown(report, 2)]))
    print(f"Wrote {path} and {path.with_suffix('.md').name}")


if __name__ == "__main__":
    main()
