"""``learn`` after ``resume``: what was left of the interrupted call, or so many steps more, as it is asked for."""

from pathlib import Path

import pytest
from envs_for_tests import VectorBox, differences, state_of, tiny_model
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cure import CuReSAC
from sb3_cure.persistence import ExactCheckpoint


class Killed(Exception):
    """Stands in for a kill."""


class KillAt(BaseCallback):
    """Raises at an agent step."""

    def __init__(self, step: int):
        super().__init__()
        self._step = step  # not public: no checkpoint keeps it

    def _on_step(self) -> bool:
        if self.num_timesteps == self._step:
            raise Killed
        return True


def interrupted(folder: Path, *earlier: int) -> CuReSAC:
    """A model as resumed after 20 of the 40 steps of a ``learn``, before which others may have come to their end."""
    model = tiny_model("MlpPolicy", VectorBox())
    for total in earlier:
        model.learn(total)
    with pytest.raises(Killed):
        model.learn(40, callback=[ExactCheckpoint(10, folder), KillAt(25)])
    resumed = CuReSAC.resume(folder, VectorBox(), device="cpu")
    assert resumed.num_timesteps == 20
    return resumed


def test_learn_does_what_was_left(tmp_path: Path) -> None:
    model = interrupted(tmp_path)
    model.learn(40)
    assert model.num_timesteps == 40
    whole = tiny_model("MlpPolicy", VectorBox()).learn(40)
    assert differences(state_of(whole), state_of(model)) == []


@pytest.mark.parametrize("earlier", [(), (15,)], ids=["first call", "second call"])
def test_learn_without_reset_does_so_many_more(earlier: tuple[int, ...], tmp_path: Path) -> None:
    """Also where it asks for fewer steps than were made, and where calls before were over."""
    model = interrupted(tmp_path, *earlier)
    model.learn(12, reset_num_timesteps=False)
    assert model.num_timesteps == 32
    model.learn(5, reset_num_timesteps=False)
    assert model.num_timesteps == 37


def test_steps_more_go_on_exactly(tmp_path: Path) -> None:
    """Environments, buffer and random numbers are those of the interrupted call: 20 more end where 40 end."""
    model = interrupted(tmp_path).learn(20, reset_num_timesteps=False)
    whole = tiny_model("MlpPolicy", VectorBox()).learn(40)
    assert differences(state_of(whole), state_of(model)) == []


def test_more_steps_can_be_interrupted_again(tmp_path: Path) -> None:
    """They are a call of their own: what is left of it is counted from its beginning."""
    model = interrupted(tmp_path)
    with pytest.raises(Killed):
        model.learn(30, callback=[ExactCheckpoint(10, tmp_path), KillAt(45)], reset_num_timesteps=False)
    again = CuReSAC.resume(tmp_path, VectorBox(), device="cpu")
    assert again.num_timesteps == 40
    again.learn(30)  # of which 20 were made
    assert again.num_timesteps == 50
