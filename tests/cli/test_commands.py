"""The command line: its commands, and what is said where one cannot be run."""

import configparser
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_cure
from sb3_cure.cli import doctor, main


def test_unknown_command_fails_and_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["fly", "--env", "CartPole-v1"]) == 2
    error = capsys.readouterr().err
    assert "'fly'" in error and all(command in error for command in main.COMMANDS)


def test_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out.split() == ["sb3-cure", sb3_cure.__version__]


def test_interrupt_ends_in_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(arguments: list[str]) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", interrupted)
    assert main.main(["doctor"]) == 130
    assert "keeps nothing" in capsys.readouterr().out


@pytest.mark.parametrize("command", main.COMMANDS)
def test_every_command_has_a_program(command: str) -> None:
    assert callable(pkgutil.resolve_name(main.COMMANDS[command].program))


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """rl-zoo3 is not installed, as it seems: the sentence says what to install."""
    monkeypatch.delitem(sys.modules, "sb3_cure.cli.zoo", raising=False)
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)  # by which Python knows that there is no such module
    assert main.main(["train", "--help"]) == 2
    error = capsys.readouterr().err
    assert "needs rl_zoo3" in error and "pip install -e '.[zoo]'" in error


def test_installed_command_and_module_are_this_one() -> None:
    config = configparser.ConfigParser()
    config.read(Path(__file__).parents[2] / "setup.cfg")
    name, _, entry = config["options.entry_points"]["console_scripts"].strip().partition(" = ")
    assert name == "sb3-cure" and pkgutil.resolve_name(entry) is main.main
    output = subprocess.run(
        [sys.executable, "-m", "sb3_cure.zoo", "--help"], capture_output=True, text=True, check=True
    )
    assert output.stdout.strip() == main.usage()
