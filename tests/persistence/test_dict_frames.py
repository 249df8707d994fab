"""Frames in exact checkpoints: each frame of each image is written once."""

from pathlib import Path
from typing import Any

import numpy as np
from dictionaries_for_tests import SensorBox, sensor_model
from stable_baselines3.common.env_util import make_vec_env

from sb3_cure import CuReSAC
from sb3_cure.data.buffers import stored_places, transitions
from sb3_cure.persistence import ExactCheckpoint, read_state
from sb3_cure.persistence.generations import Generations


def environment() -> Any:
    return make_vec_env(SensorBox, 1, env_kwargs={"episode_length": 20})


def test_checkpoint_adds_the_new_frames_of_each_image(tmp_path: Path) -> None:
    """Of a buffer that is emptied while it is written, the new ones alone; all come back."""
    model: Any = sensor_model(environment(), gradient_steps=0, buffer_size=50)
    model.learn(60, ExactCheckpoint(10, tmp_path, keep=2))
    kept, buffer = Generations(tmp_path), model.replay_buffer
    state = read_state(kept.folder(kept.numbers()[-1]) / "state.safetensors")
    sizes = {path.name: path.stat().st_size for path in kept.segments.iterdir()}
    assert state["segments"].keys() == buffer.rings.keys() == {"front", "wrist"}
    for key, ring in buffer.rings.items():
        spans = state["segments"][key]
        assert [first for _, first, _ in spans][1:] == [last for *_, last in spans[:-1]]
        assert spans[-1][2] == buffer.counts[key] and len(spans) >= 5
        frame = int(np.prod(ring.frame_shape))
        assert all(sizes[name] == (last - first) * frame for name, first, last in spans)
    resumed: Any = CuReSAC.resume(tmp_path, environment(), device="cpu")
    rows, env_inds, _ = stored_places(buffer)
    found: Any
    expected: Any
    found, expected = (transitions(each, rows, env_inds) for each in (resumed.replay_buffer, buffer))
    for key in ("front", "joints", "wrist"):
        np.testing.assert_array_equal(found.next_observations[key], expected.next_observations[key])
