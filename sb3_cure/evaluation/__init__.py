"""Evaluation: rollouts and their errors, callbacks, diagnostics, plots, videos and deployment."""

from sb3_cure.evaluation.rollouts import (
    Episode,
    Uncomfortable,
    binned_errors,
    evenly_measured,
    most_uncomfortable,
    run_episodes,
    srl_errors,
    state_probe,
    trained_actors,
)

__all__ = [
    "Episode",
    "Uncomfortable",
    "binned_errors",
    "evenly_measured",
    "most_uncomfortable",
    "run_episodes",
    "srl_errors",
    "state_probe",
    "trained_actors",
]
