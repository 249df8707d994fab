"""Mutation testing: run the tests against small faults, one at a time, in the files that compute the method.

    python -m benchmarks.mutation --jobs 2

cosmic-ray's operators list the mutants of each file in ``TESTS``. The seed decides which are drawn: equally many of
each file (small files give all they have), in turn from each kind of operator, and one per place before a second one.
Type hints and operators of another type (``+`` by ``|``) are left out. Each mutant runs in a copy of package and tests.
The tests of a file are a fast part of the suite: its other tests may kill mutants that survive here.

``mutation.csv`` has a row for each. Mutants with a row are not run again, so that a killed run continues; delete rows
of survivors to run them against new tests. Lines may move: ``id`` is made of function, code and operator. ``reason`` is
written by hand, why a survivor lives; one that begins with "equivalent" does not count in the score.
"""

import argparse
import ast
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path

import pandas as pd
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.ast.ast_query import ASTQuery
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

from sb3_cure.evaluation.result_files import Row, describe_run, read_rows, write_csv, write_json

ROOT = Path(__file__).resolve().parent.parent
#: Tests of each file or group of files, the likeliest and fastest first (paths below tests/, or options of pytest)
GROUPS = {
    "cure/cure.py": """cure/test_gradients.py cure/test_schedules.py cure/test_actor_critic.py
        cure/test_update_equals_sb3.py cure/test_training.py intrinsic/test_contract.py
        srl/test_contract.py
        -k 'not (one_update_per or vectors or can_be_changed or frame_stack or board)'""",
    "cure/critics.py": "cure/test_critics.py cure/test_gradients.py cure/test_actor_critic.py",
    "cure/encoder_update.py": "cure/test_encoder_update.py cure/test_gradients.py",
    "cure/mixers.py": """cure/test_mixers.py persistence/test_resume.py
        cure/test_training.py::test_schedules_follow_the_progress_of_the_call""",
    "cure/pretraining.py": "cure intrinsic -k 'pretrain or transfer'",
    "srl/*.py": """cure/test_gradients.py srl intrinsic/test_contract.py cure/test_dictionaries.py
        evaluation/test_rollouts.py::test_negatives_are_taken_evenly_from_each_policy""",
    "intrinsic/*.py": "intrinsic cure/test_gradients.py cure/test_dictionaries.py",
    "data/buffers.py": "data/test_buffers.py persistence/test_frame_rows.py",
}
#: The same by file; a pattern that matches no file stays, and is then missed
TESTS = {
    path: tests
    for pattern, tests in GROUPS.items()
    for path in sorted(f"{pattern.partition('/')[0]}/{file.name}" for file in (ROOT / "sb3_cure").glob(pattern))
    or [pattern]
}
#: Operators that replace each other; "Delete" removes a sign or a negation
ALIKE = ("Add Sub Mul Div FloorDiv Mod Pow", "BitOr BitAnd BitXor", "Eq NotEq Lt LtE Gt GtE", "Is IsNot", "UAdd USub")
#: CPU seconds of a mutant, so that other work on the machine changes nothing; twenty times as long if it just waits
LIMIT = 600
_FIELDS = ("file", "function", "operator", "code", "id", "line", "place", "kind", "occurrence")
COLUMNS = ("id", "file", "line", "function", "operator", "code", "mutant", "outcome", "test", "cpu_seconds", "reason")


def _mutants(file: str) -> Iterator[Row]:
    source = (ROOT / "sb3_cure" / file).read_text()
    nodes, lines, seen = list(ast_nodes(get_ast(source))), source.splitlines(), Counter[tuple]()
    hints = [getattr(node, name, None) for node in ast.walk(ast.parse(source)) for name in ("annotation", "returns")]
    spans = [((hint.lineno, hint.col_offset), (hint.end_lineno, hint.end_col_offset)) for hint in hints if hint]
    for operator in operator_names():
        kind, *swap = operator.removeprefix("core/").split("_")
        alike = not swap or swap[0] == "Delete" or any({*swap} <= {*group.split()} for group in ALIKE)
        if not alike or get_operator(operator).arguments():
            continue
        places = ((node, *place) for node in nodes for place in get_operator(operator)().mutation_positions(node))
        for occurrence, (node, start, _) in enumerate(places):
            if any(first <= start < last for first, last in spans) or node.parent.type in ("dictorsetmaker", "atom"):
                continue  # a type hint, or the stars of {**mapping}
            row = {"file": file, "function": ASTQuery(node).get_definition_name() or "", "operator": operator}
            row["code"] = lines[start[0] - 1].strip()
            seen[known := (*row.values(), start[1])] += 1
            number = hashlib.sha256(repr((known, seen[known])).encode()).hexdigest()[:12]
            yield dict(row, id="m" + number, line=start[0], place=start, kind=kind, occurrence=occurrence)


def _draw(file: str, seed: int) -> pd.DataFrame:
    """All mutants of a file, in the order of drawing: by a hash, so that an edit leaves those of other code alone."""
    rows = pd.DataFrame(_mutants(file), columns=_FIELDS)
    rows["turn"] = [hashlib.sha256(f"{seed} {name}".encode()).hexdigest() for name in rows["id"]]
    for group in (["kind", "place"], ["kind"]):  # the first of each group, then the second of each, and so on
        rows = rows.sort_values("turn", kind="stable")
        rows["turn"] = rows.groupby(group).cumcount()
    return rows.sort_values("turn", kind="stable")


def _run(row: Row) -> Row:
    """Run a file's tests on a copy with this mutant; without an operator, on the code as it is."""
    with tempfile.TemporaryDirectory(prefix="mutation-", ignore_cleanup_errors=True) as folder:
        for name in ("sb3_cure", "tests", "benchmarks"):
            shutil.copytree(ROOT / name, Path(folder, name), ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", folder)
        path, mutant = Path(folder, "sb3_cure", row["file"]), ""
        if row["operator"]:
            before = path.read_text()
            path.write_text(mutate_code(before, get_operator(row["operator"])(), row["occurrence"]))
            after = path.read_text().splitlines()
            mutant = after[row["line"] - 1].strip() if len(after) == len(before.splitlines()) else "(line removed)"
        words = shlex.split(TESTS[row["file"]])
        tests = [f"tests/{word}" if Path(folder, "tests", word.partition("::")[0]).exists() else word for word in words]
        command = f"{sys.executable} -m pytest -x -q -p no:cacheprovider --hypothesis-seed=0 --basetemp=tmp".split()
        limited = [
            "timeout",
            "-sKILL",
            str(20 * LIMIT),
            "bash",
            "-c",
            f'ulimit -t {LIMIT}; TIMEFORMAT="CPU %U"; time "$@"',
        ]
        environment = {**os.environ, "PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        with Path(folder, "output").open("w") as file:
            run = [*limited, "", *command, *tests]
            code = subprocess.run(run, cwd=folder, env=environment, stdout=file, stderr=file).returncode
        text = Path(folder, "output").read_text()
    outcome = "survived" if code == 0 else "timeout" if code in (-9, 137, 152) else "killed"  # SIGKILL, SIGXCPU
    test = (re.findall(r"^(?:FAILED|ERROR) tests/(\S+)", text, re.MULTILINE) or [f"exit {code}"])[0] if code else ""
    if not row["operator"] and code:
        raise SystemExit(f"The tests of {row['file']} fail without a mutant: {test}\n{text[-2000:]}")
    seconds = sum(map(float, re.findall(r"^CPU (\S+)$", text, re.MULTILINE)))
    return {**row, "mutant": mutant, "outcome": outcome, "test": test, "cpu_seconds": seconds, "reason": ""}


def _total(rows: list[Row]) -> Row:
    """Mutants by outcome, the share that died of those that are not equivalent, and what it took."""
    outcomes = Counter(row["outcome"] for row in rows)
    equivalent = sum(row["reason"].startswith("equivalent") for row in rows)
    died, counted = outcomes["killed"] + outcomes["timeout"], len(rows) - equivalent
    score = round(died / counted, 3) if counted else None
    seconds = sum(row["cpu_seconds"] for row in rows)
    return dict(run=len(rows), **outcomes, equivalent=equivalent, score=score, cpu_seconds=round(seconds))


def main() -> None:
    """Run the drawn mutants that have no row yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "results/robustness", help="folder to write")
    parser.add_argument("--only", nargs="+", choices=list(TESTS), default=list(TESTS), help="files (default: all)")
    parser.add_argument("--sample", type=int, default=480, help="mutants of all files together (default: 480)")
    parser.add_argument("--seed", type=int, default=0, help="decides which are drawn (default: 0)")
    parser.add_argument("--jobs", type=int, default=2, help="how many run at the same time (default: 2)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table, drawn = options.out / "mutation.csv", {file: _draw(file, options.seed) for file in TESTS}
    lines = dict(pair for rows in drawn.values() for pair in zip(rows["id"], rows["line"], strict=True))
    old = {row["id"]: row for row in (read_rows(table) if table.exists() else [])}
    done = {name: {**row, "line": lines[name]} for name, row in old.items() if name in lines}  # the code is still there
    share = 1
    while sum(len(rows[:share]) for rows in drawn.values()) < min(options.sample, len(lines)):
        share += 1
    sample = [row for file in options.only for row in drawn[file][:share].to_dict("records")]
    todo = [row for row in sample if row["id"] not in done]
    pool = ThreadPoolExecutor(options.jobs)
    try:
        groups = {TESTS[row["file"]]: row["file"] for row in todo}  # one file of each group
        for row in pool.map(_run, [{"file": name, "operator": ""} for name in groups.values()]):
            print(f"{row['file']}: its tests take {row['cpu_seconds']} s of CPU time", flush=True)
        for future in as_completed([pool.submit(_run, row) for row in todo]):
            done[future.result()["id"]] = row = future.result()
            print("{outcome} {file}:{line} {operator} {test}\n- {code}\n+ {mutant}".format(**row), flush=True)
            write_csv(table, COLUMNS, sorted(done.values(), key=lambda row: (row["file"], row["line"], row["id"])))
    finally:
        pool.shutdown(cancel_futures=True)
    conditions = dict(seed=options.seed, sample=options.sample, cosmic_ray=version("cosmic-ray"), **describe_run())
    total, by_file = _total(list(done.values())), {f: [r for r in done.values() if r["file"] == f] for f in TESTS}
    files = {file: {"mutants": len(drawn[file]), **_total(rows)} for file, rows in by_file.items()}
    write_json(options.out / "mutation.json", {**conditions, "all": total, "files": files})
    print(total)


if __name__ == "__main__":
    main()
