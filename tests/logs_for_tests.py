"""A logger's output for tests."""

from typing import Any

from stable_baselines3.common.logger import KVWriter


class KeptRows(KVWriter):
    """Keeps all that is written, in ``rows``."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append({**key_values, "step": step})

    def close(self) -> None: ...
