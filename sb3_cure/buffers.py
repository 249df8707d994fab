"""Public names of :mod:`sb3_cure.data.buffers`."""

from sb3_cure.data.buffers import FrameStackReplayBuffer

__all__ = ["FrameStackReplayBuffer"]
