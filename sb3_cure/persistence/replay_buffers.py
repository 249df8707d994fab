"""Save and load replay buffers without pickle: the used part alone, and without a copy in memory.

This applies to ``FrameStackReplayBuffer``, which all models of this package have and any algorithm of SB3 can use; all
other replay buffers are pickled, as in SB3.
"""

from pathlib import Path
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cure.data.buffers import FrameStackReplayBuffer
from sb3_cure.persistence.encoding import ArchiveError, is_state, read_state, refusing, write_state
from sb3_cure.persistence.files import PathOrFile, reading, writing


def buffer_from_state(model: OffPolicyAlgorithm, state: dict[str, Any], name: str) -> FrameStackReplayBuffer:
    """Make a replay buffer of a model with the state of another one.

    :param model: The model that the replay buffer is for
    :param state: Of ``FrameStackReplayBuffer.state_dict``, with frames or without
    :param name: Name of its file in messages
    :return: A replay buffer of the size that was saved; frames that the state lacks have to be read into it
    :raises ArchiveError: If it does not fit the model or is damaged
    """
    with refusing(name):
        if model.replay_buffer_class is not FrameStackReplayBuffer or state["n_envs"] != model.n_envs:
            own = "no replay buffer" if model.replay_buffer_class is None else model.replay_buffer_class.__name__
            raise ArchiveError(
                f"{name} holds a FrameStackReplayBuffer for {state['n_envs']} environments, but this model has {own} "
                f"for {model.n_envs}: load the replay buffer of a model with the same settings."
            )
        buffer = FrameStackReplayBuffer(
            state["size"] * model.n_envs,
            model.observation_space,
            model.action_space,
            device=model.device,
            n_envs=model.n_envs,
            **model.replay_buffer_kwargs,
        )
        try:
            buffer.load_state_dict(state)
        except ValueError as error:
            fix = "load the replay buffer of a model with the same settings and environment"
            raise ArchiveError(f"{name} does not fit this model ({error}): {fix}.") from error
        return buffer


class SavesReplayBuffers(OffPolicyAlgorithm):
    """Mixin for an algorithm of SB3: replay buffers in files without pickle."""

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """Save the used part of the replay buffer, without pickle and without a copy in memory.

        Buffers of other classes than ``FrameStackReplayBuffer`` are pickled, as SB3 does.

        :param path: Path (its folder is made, and ``.pkl`` added if it has no suffix), or a binary file
        """
        buffer = self.replay_buffer
        if type(buffer) is not FrameStackReplayBuffer:
            super().save_replay_buffer(path)
            return
        with writing(path, "pkl") as file:
            write_state(file, buffer.state_dict())

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True, *, trusted: bool = False) -> None:
        """Load a replay buffer, even one from a stranger.

        :param path: Path with or without its suffix ``.pkl``, or a binary file
        :param truncate_last_traj: For ``HerReplayBuffer``, as in SB3
        :param trusted: Also load what is pickled, which runs any code in it
        :raises ArchiveError: (a ``ValueError``) if the file is damaged, hostile, pickled, or does not fit the model
        """
        with reading(path, "pkl") as (file, name):
            if is_state(file):
                # Given a path, arrays stay in the file until they are copied.
                source = Path(file.name) if isinstance(path, str | Path) else file
                self.replay_buffer = buffer_from_state(self, read_state(source, copy=False), name)
            elif trusted:
                super().load_replay_buffer(path, truncate_last_traj)
            else:
                raise ArchiveError(
                    f"{name} is no replay buffer that was saved without pickle, and unpickling runs any code that is "
                    "in a file: if you know where it comes from, load it with trusted=True."
                )
