"""The command ``sb3-cure``: one word that says what to do, and that program's own arguments."""

import importlib
import sys
from collections.abc import Sequence
from types import ModuleType

USAGE = """\
usage: sb3-cure COMMAND [ARGUMENTS]      (sb3-cure COMMAND --help shows a command's arguments)

  train        train from a YAML file                                      rl-zoo3's train
  enjoy        watch a trained agent, or only print its returns            rl-zoo3's enjoy
  record       write a video of a trained agent                            rl-zoo3's record_video
  optimize     search hyper-parameters with Optuna                         rl-zoo3's train -optimize
  experiment   run a grid of tasks, methods and seeds
  report       statistics and pictures of a grid's results, as one HTML file
  doctor       what this machine has and what is missing
"""
#: Commands and the extra of sb3-cure that they need, if any
COMMANDS: dict[str, str | None] = {
    "train": "zoo",
    "enjoy": "zoo",
    "record": "zoo",
    "optimize": "zoo",
    "experiment": "experiments",
    "report": "experiments",
    "doctor": None,
}


def _import(module: str, command: str) -> ModuleType:
    """The module that does the work; commands are imported when they are called, as each takes seconds."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in ("", "sb3_cure"):
            raise
        raise SystemExit(
            f'sb3-cure {command} needs {missing}, which is not installed: pip install "sb3-cure[{COMMANDS[command]}]"'
        ) from error


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Command line without the program's name, ``sys.argv[1:]`` by default
    :return: Exit status
    """
    command, *arguments = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if command in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0
    if command not in COMMANDS:
        print(f"sb3-cure has no command {command!r}; it has {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    if command == "doctor":
        return importlib.import_module("sb3_cure.doctor").main(arguments)
    if command in ("experiment", "report"):
        program = {"experiment": "run", "report": "report"}[command]
        module = _import(f"sb3_cure.experiments.{program}", command)
        if command == "experiment":
            importlib.import_module("sb3_cure.allocator").tune_allocator()
        return module.main(arguments) or 0
    _import("sb3_cure.zoo", command).run(command, arguments)
    return 0


if __name__ == "__main__":
    sys.exit(main())
