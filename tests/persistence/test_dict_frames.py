"""Frames of several images in checkpoints and archives: each is written once, and none is taken for another's."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dictionaries_for_tests import SensorBox, sensor_model
from stable_baselines3.common.env_util import make_vec_env

from sb3_cure import CuReSAC
from sb3_cure.data.buffers import DictFrameStackReplayBuffer, transitions, unmarked
from sb3_cure.persistence import ArchiveError, ExactCheckpoint, read_state
from sb3_cure.persistence.encoding import write_state
from sb3_cure.persistence.generations import Generations


def environment() -> Any:
    return make_vec_env(SensorBox, 1, env_kwargs={"episode_length": 20})


def test_a_checkpoint_adds_the_new_frames_of_each_image(tmp_path: Path) -> None:
    """And no old ones."""
    model = sensor_model(environment()).learn(60, ExactCheckpoint(10, tmp_path, keep=2))
    kept, images = Generations(tmp_path), model.replay_buffer.images
    state = read_state(kept.folder(kept.numbers()[-1]) / "state.safetensors")["buffer"]
    assert state["images"].keys() == images.keys() == {"front", "wrist"}
    sizes = {path.name: path.stat().st_size for path in kept.segments.iterdir()}
    for key, image in images.items():
        spans = state["images"][key]["segments"]
        assert [first for _, first, _ in spans] == [0, *(last for *_, last in spans[:-1])]
        assert spans[-1][2] == image._n_frames and len(spans) >= 6
        frame = int(np.prod(image.frame_shape))
        assert all(sizes.pop(name) == (last - first) * frame for name, first, last in spans)
    assert not sizes


def test_rows_without_one_image_are_given_up(tmp_path: Path) -> None:
    """Where a file of frames is damaged; the other images' are whole, and so is what is left."""
    model = sensor_model(environment(), gradient_steps=0).learn(60, ExactCheckpoint(20, tmp_path, keep=1))
    kept = Generations(tmp_path)
    state = read_state(kept.folder(kept.numbers()[-1]) / "state.safetensors")["buffer"]
    damaged = kept.segments / state["images"]["wrist"]["segments"][1][0]
    damaged.write_bytes(b"x" + damaged.read_bytes()[1:])
    with pytest.warns(UserWarning, match="rows of the replay buffer are lost"):
        resumed = CuReSAC.resume(tmp_path, environment(), device="cpu")
    buffer: Any = resumed.replay_buffer
    assert 10 < buffer.size() < 60 and buffer.images["front"].size() == 60
    rows, env_inds, _ = unmarked(buffer)
    found, expected = (transitions(each, rows, env_inds) for each in (buffer, model.replay_buffer))
    for key in ("front", "joints", "wrist"):
        np.testing.assert_array_equal(found.next_observations[key], expected.next_observations[key])


CHANGES: dict[str, Any] = {
    "an image missing": lambda state: state["images"].pop("wrist"),
    "images of different times": lambda state: state["images"]["wrist"]["counters"].update(pos=3),
    "frames of another image": lambda state: state["images"].update(wrist=state["images"]["front"]),
    "rows missing": lambda state: state["arrays"].pop("rewards"),
    "vectors missing": lambda state: state["arrays"].pop("observations/joints"),
    "rows in an image": lambda state: state["images"]["front"]["arrays"].update(rewards=np.zeros((12, 1), np.float32)),
}


@pytest.mark.parametrize("name", CHANGES)
def test_damaged_buffers_are_refused(name: str) -> None:
    model = sensor_model(buffer_size=12).learn(14)  # full: counters that lie change no shape
    file = io.BytesIO()
    model.save_replay_buffer(file)
    whole = DictFrameStackReplayBuffer
    file.seek(0)
    model.load_replay_buffer(file)
    assert type(model.replay_buffer) is whole and model.replay_buffer.size() == 12
    file.seek(0)
    state = read_state(file)
    CHANGES[name](state)
    changed = io.BytesIO()
    write_state(changed, state)
    changed.seek(0)
    with pytest.raises(ArchiveError):
        model.load_replay_buffer(changed)
