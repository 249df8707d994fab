"""Programs beside Python that some tests look with."""

import os
import shutil

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
