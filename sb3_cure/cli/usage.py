"""Sentences for those who typed a command: an unknown name, a setting that is refused, how to install an extra."""

import argparse
import contextlib
import difflib
import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym


class UsageError(ValueError):
    """A command line, or a file or folder that it names, that cannot be used; the message is one sentence."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Suggest known names.

    :param name: What was typed
    :param known: Names that there are
    :return: ``"; did you mean a or b?"``, or ``"."`` where nothing is near
    """
    by_lower_case = {each.lower(): each for each in known}
    found = [by_lower_case[each] for each in difflib.get_close_matches(name.lower(), by_lower_case)]
    return f"; did you mean {' or '.join(found)}?" if found else "."


def missing_file(path: Path, names: Iterable[str] = ()) -> str:
    """Say that there is no such file or folder, and what in its folder has a similar name.

    :param path: Where nothing is
    :param names: Other names that might have been meant
    :return: One sentence
    """
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    return f"there is no {path}{nearest(str(path), [*map(str, beside), *names])}"


def one_sentence(error: Exception, *functions: Any) -> str:
    """Message of an error in one line, with the nearest names if it is about an unknown argument.

    :param error: The error
    :param functions: Functions and classes that may have got the argument
    :return: The line
    """
    text = " ".join(str(error).split())
    wrong = re.search(r"unexpected keyword argument '(\w+)'", text)
    if wrong is None:
        return text
    classes = [base for each in functions for base in (each.mro() if isinstance(each, type) else [each])]
    known = {name: each for each in classes for name in inspect.signature(each).parameters}
    if wrong[1] in known:
        return f"there is no argument {wrong[1]!r} here, but in {known[wrong[1]].__name__}."
    return f"there is no argument {wrong[1]!r}{nearest(wrong[1], known.keys() - {'self', 'args', 'kwargs'})}"


@contextlib.contextmanager
def refusals_in_one_sentence(*functions: Any) -> Iterator[None]:
    """Report refused settings and unknown arguments, which are the user's to fix, in one sentence without traceback.

    :param functions: As for ``one_sentence``
    :raises UsageError: Instead of them
    """
    try:
        yield
    except UsageError:
        raise
    except (TypeError, ValueError, gym.error.Error) as error:
        if isinstance(error, TypeError) and "unexpected keyword argument" not in str(error):
            raise
        raise UsageError(one_sentence(error, *functions)) from error


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Parse a command line with rl-zoo3's ``name:value`` settings, whose values are evaluated.

    :param parser: The parser
    :param arguments: The command line
    :return: What it knows, and the rest
    :raises UsageError: If a value is not Python's
    """
    try:
        return parser.parse_known_args(arguments)
    except (NameError, SyntaxError) as error:
        raise UsageError(
            f"{error.args[0]}: -params and --env-kwargs take name:value with values as in Python, and text in quotes "
            "for the shell, too ('srl:\"curl\"')."
        ) from None


def install_command(extra: str) -> str:
    """Command that installs an extra of this package.

    :param extra: Its name
    :return: The command, and where to give it
    """
    return f"pip install -e '.[{extra}]' -c constraints.txt, in the checkout of sb3_cure"
