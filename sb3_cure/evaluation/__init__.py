"""Evaluation: rollouts and their errors, callbacks, diagnostics, plots, videos and deployment."""

from sb3_cure.evaluation.probe import state_probe
from sb3_cure.evaluation.rollouts import (
    Episode,
    HighestErrors,
    balanced_negatives,
    binned_errors,
    highest_errors,
    run_episodes,
    srl_errors,
    trained_actors,
)

__all__ = [
    "Episode",
    "HighestErrors",
    "balanced_negatives",
    "binned_errors",
    "highest_errors",
    "run_episodes",
    "srl_errors",
    "state_probe",
    "trained_actors",
]
