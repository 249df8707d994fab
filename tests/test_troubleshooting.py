"""The page by symptom quotes messages that there are, and names warnings that there are."""

import re
from pathlib import Path

import pytest

from sb3_cure.evaluation.callbacks import DiagnosticsCallback

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
MESSAGES = [message for line in PAGE.splitlines() if line.startswith("### ") for message in re.findall("`(.+?)`", line)]


@pytest.fixture(scope="module")
def source() -> str:
    """All of the package, strings that go on in the next line in one piece, what is filled in as dots."""
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "sb3_cure").rglob("*.py"))
    return re.sub(r"\{[^{}\n]*\}", "...", re.sub(r'"\s*\n\s*f?"', "", code))


def test_there_are_messages() -> None:
    assert len(MESSAGES) > 10


@pytest.mark.parametrize("message", MESSAGES)
def test_message_is_one_of_ours(message: str, source: str) -> None:
    # What the reader sees filled in
    message = re.sub(r"\b(float32|nan|CURL|reward|run)\b", "...", message)
    parts = [part.strip() for part in message.split("...")]
    assert any(len(part) > 7 for part in parts)
    assert all(part in source for part in parts)


def test_warnings_of_diagnostics_exist() -> None:
    named = set(re.findall(r"`diagnostics/(\w+)`", PAGE)) | {"constant_image", "curious_reward"}
    assert all(f"``{name}``" in (DiagnosticsCallback.__doc__ or "") for name in named)
