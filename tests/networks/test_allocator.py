"""The allocator keeps large blocks once there is a model."""

import subprocess
import sys

import pytest

COUNT_FAULTS = """
import resource
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from sb3_cure import CuReSAC
small = dict(net_arch=[8], features_extractor_kwargs=dict(n_filters=2))
env = FakeImageEnv(n_channels=3, screen_height=32, screen_width=32, discrete=False, channel_first=True)
CuReSAC("CnnPolicy", env, buffer_size=10, policy_kwargs=small)
def round():
    [th.ones(4_000_000) for _ in range(12)]
for _ in range(10):
    round()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    round()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only glibc is tuned")
def test_large_blocks_are_kept() -> None:
    """A dozen blocks of 16 MB, made and freed again and again: their pages come from the system once, not each time."""
    result = subprocess.run([sys.executable, "-c", COUNT_FAULTS], capture_output=True, text=True, check=True)
    # 468 750 pages are written to. Untuned, most are new each time (unless a small block happens to lie above them).
    assert int(result.stdout) < 4000
