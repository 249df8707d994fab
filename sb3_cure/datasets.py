"""Public names of :mod:`sb3_cure.data.datasets`."""

from sb3_cure.data.datasets import RecordedEpisode, RecordEpisodes, load_episode, save_episode

__all__ = ["RecordEpisodes", "RecordedEpisode", "load_episode", "save_episode"]
