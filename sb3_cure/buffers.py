"""Public names of :mod:`sb3_cure.data.buffers`."""

from sb3_cure.data.buffers import (
    DictFrameStackReplayBuffer,
    FrameStackReplayBuffer,
    SkippingReplayBuffer,
)

__all__ = ["DictFrameStackReplayBuffer", "FrameStackReplayBuffer", "SkippingReplayBuffer"]
