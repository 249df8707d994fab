"""Lines about a training's progress, for a terminal or a log file."""

import time
from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback


def time_text(seconds: float) -> str:
    """Round a duration.

    :param seconds: Seconds
    :return: Such as ``"3 h 20 min"``
    """
    if seconds < 59.5:
        return f"{max(round(seconds), 1)} s"
    hours, minutes = divmod(max(round(seconds / 60), 1), 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"


class TimeLeft(BaseCallback):
    """Print once a minute how far training is, its speed in that minute, and how long the rest takes at that speed.

    :param name: What is trained, at the beginning of each line
    :param seconds: Seconds between two lines
    :param best_return: Returns the best return so far, or None before there is one
    """

    def __init__(self, name: str, seconds: float = 60, best_return: Callable[[], float | None] = lambda: None):
        super().__init__()
        self.label, self.seconds, self.best_return = name, seconds, best_return
        self._last_time, self._last_step = 0.0, 0

    def _on_training_start(self) -> None:
        self._last_time, self._last_step = time.monotonic(), self.num_timesteps

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now - self._last_time >= self.seconds:
            steps, total = self.num_timesteps, self.model._total_timesteps
            speed = (steps - self._last_step) / (now - self._last_time)
            line = f"{self.label}: step {steps:,} of {total:,}, {speed:,.1f} steps/s"
            line += f", about {time_text((total - steps) / speed)} left"
            best = self.best_return()
            print(line if best is None else f"{line}, best return {best:.4g}", flush=True)
            self._last_time, self._last_step = now, steps
        return True
