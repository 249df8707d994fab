"""Lines about a training's progress, for a terminal or a log file."""

import time
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback


def time_text(seconds: float) -> str:
    """Round a duration.

    :param seconds: Seconds
    :return: Such as ``"3 h 20 min"``
    """
    hours, minutes = divmod(max(round(seconds / 60), 1), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"


class TimeLeft(BaseCallback):
    """Print once a minute how far training is and how long the rest takes at the speed of that minute.

    :param name: What is trained, at the beginning of each line
    :param seconds: Seconds between two lines
    """

    def __init__(self, name: str, seconds: float = 60):
        super().__init__()
        self.label, self.seconds = name, seconds
        self._last_time, self._last_step = 0.0, 0

    def state_dict(self) -> dict[str, Any]:
        """Get the state of this callback, which is none: a resumed training has another clock.

        :return: An empty dictionary
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back the state, which is none.

        :param state: Result of ``state_dict``
        """

    def _on_training_start(self) -> None:
        self._last_time, self._last_step = time.monotonic(), self.num_timesteps

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._last_time >= self.seconds:
            steps, total = self.num_timesteps, self.model._total_timesteps
            left = (total - steps) * (now - self._last_time) / (steps - self._last_step)
            print(f"{self.label}: step {steps:,} of {total:,}, about {time_text(left)} left", flush=True)
            self._last_time, self._last_step = now, steps
        return True
