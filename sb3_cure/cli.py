"""The command ``sb3-cure``: one word that says what to do, and that program's own arguments."""

import importlib
import sys
from collections.abc import Sequence

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
#: Commands, and the extra of sb3-cure that they need
COMMANDS: dict[str, str | None] = {
    "train": "zoo",
    "enjoy": "zoo",
    "record": "zoo",
    "optimize": "zoo",
    "experiment": "experiments",
    "report": "experiments",
    "doctor": None,
}


#: What the extras bring, as far as it is imported by name
OPTIONAL = ("rl_zoo3", "optuna", "yaml", "huggingface_sb3", "matplotlib", "imageio", "rich", "pandas", "rliable", "ray")


def _run(command: str, arguments: Sequence[str]) -> int:
    # Imported here, because each command's imports take seconds and may be missing.
    if command == "doctor":
        return importlib.import_module("sb3_cure.doctor").main(arguments)
    if command == "experiment":
        importlib.import_module("sb3_cure.allocator").tune_allocator()
        return importlib.import_module("sb3_cure.experiments.run").main(arguments) or 0
    if command == "report":
        return importlib.import_module("sb3_cure.experiments.report").main(arguments) or 0
    zoo = importlib.import_module("sb3_cure.zoo")
    try:
        zoo.run(command, arguments)
    except zoo.SettingsError as error:
        print(f"sb3-cure {command}: {error}", file=sys.stderr)
        return 2
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: Command line without the program's name, ``sys.argv[1:]`` by default
    :return: Exit status, 2 for what cannot work as it was written
    """
    command, *arguments = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if command in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0
    if command not in COMMANDS:
        print(f"sb3-cure has no command {command!r}; it has {', '.join(COMMANDS)}.", file=sys.stderr)
        return 2
    try:
        return _run(command, arguments)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in OPTIONAL:
            raise
        extra = "cluster" if missing == "ray" else COMMANDS[command]
        raise SystemExit(
            f'sb3-cure {command} needs {missing}, which is not installed: pip install "sb3-cure[{extra}]"'
        ) from error


if __name__ == "__main__":
    sys.exit(main())
