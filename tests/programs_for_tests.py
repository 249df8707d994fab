"""Programs beside Python that some tests look with."""

import os
import shutil
import sys
from multiprocessing import get_context
from multiprocessing.process import BaseProcess

import pytest


def find_program(*names: str, package: str) -> str:
    """Path of the first that is installed; without any the test is skipped, or fails where all are asked for.

    :param names: Of the program
    :param package: Debian's package that has it
    """
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        reason = f"{names[0]} is not installed (Debian: apt-get install {package})"
        if os.environ.get("SB3_CURE_REQUIRE_SCREENS") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return found


def _run(code: str, arguments: list[str]) -> None:
    sys.argv = ["-c", *arguments]
    exec(compile(code, "script", "exec"), {"__name__": "__main__"})


def start_script(code: str, *arguments: str) -> BaseProcess:
    """Run a script in a process of its own, forked from one that has imported the packages."""
    process = get_context("forkserver").Process(target=_run, args=(code, list(arguments)))
    process.start()
    return process
