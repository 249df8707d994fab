"""The command ``sb3-cure``: a subcommand and its arguments."""

import pkgutil
import sys
from collections.abc import Sequence
from typing import NamedTuple

from sb3_cure import __version__
from sb3_cure.cli.usage import UsageError, install_command, nearest


class Command(NamedTuple):
    """A subcommand.

    :param program: Function of the arguments that returns the exit status, or None for 0
    :param extra: Extra of sb3-cure that it needs, or None
    :param purpose: One line for the overview
    """

    program: str
    extra: str | None
    purpose: str


#: Programs are imported only when they run: importing takes seconds, and their packages may be missing
COMMANDS = {
    "train": Command("sb3_cure.cli.zoo:train", "zoo", "train from a YAML file (rl-zoo3's train)"),
    "enjoy": Command("sb3_cure.cli.enjoy:enjoy", "zoo", "watch a trained agent, or only print its returns"),
    "record": Command("sb3_cure.cli.enjoy:record", "zoo", "write a video of a trained agent"),
    "optimize": Command("sb3_cure.cli.zoo:optimize", "zoo", "search hyper-parameters (rl-zoo3's train -optimize)"),
    "experiment": Command("sb3_cure.experiments.run:main", "experiments", "run a grid of tasks, methods and seeds"),
    "report": Command("sb3_cure.experiments.report:main", "experiments", "show a grid's results as one HTML file"),
    "doctor": Command("sb3_cure.cli.doctor:main", None, "show what this machine has and what is missing"),
}


def usage() -> str:
    """Overview of all commands.

    :return: The text
    """
    lines = [f"  {name:<12} {command.purpose}" for name, command in COMMANDS.items()]
    first = "usage: sb3-cure COMMAND [ARGUMENTS]   (sb3-cure COMMAND --help shows them; sb3-cure --version)"
    return "\n".join([first, "", *lines])


def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand.

    :param argv: Command line without the program's name, ``sys.argv[1:]`` by default
    :return: Exit status: 2 if the command line or a file that it names is wrong, 130 after Ctrl-C
    """
    name, *arguments = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name == "--version":
        print(f"sb3-cure {__version__}")
        return 0
    if name not in COMMANDS:
        known = [*COMMANDS, "--version", "--help"]
        print(f"sb3-cure has no command {name!r} among {', '.join(COMMANDS)}{nearest(name, known)}", file=sys.stderr)
        return 2
    command = COMMANDS[name]
    try:
        program = pkgutil.resolve_name(command.program)
    except ModuleNotFoundError as error:
        if command.extra is None or str(error.name).startswith("sb3_cure"):
            raise
        install = install_command(command.extra)
        print(f"sb3-cure {name} needs {error.name}, which is not installed: {install}.", file=sys.stderr)
        return 2
    if "" not in sys.path:
        sys.path.append("")  # the user may name classes and environments of the working directory
    try:
        return program(arguments) or 0
    except UsageError as error:
        print(f"sb3-cure {name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"sb3-cure {name} was stopped and keeps nothing of this call: give the same command again.")
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
