"""Evaluation: rollouts and their errors, callbacks, diagnostics, plots, videos and deployment."""

from sb3_cure.evaluation.rollouts import highest_errors, run_episodes, state_probe

__all__ = ["highest_errors", "run_episodes", "state_probe"]
