"""Train the representation before the task.

It can learn while collecting without task reward (paper, "Effect of Pretraining"), from episodes on disk, or by
transfer from a model of another task (the paper's outlook).
"""

import functools
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from sb3_cure.cure.arguments import choose_intrinsic
from sb3_cure.cure.cure import CuRe
from sb3_cure.data.datasets import fill
from sb3_cure.persistence.archive import archived_networks

Self = TypeVar("Self", bound="Pretraining")


class Pretraining(CuRe):
    """Adds to CuRe: ``pretrain``, ``load_transitions`` and ``fit_representation``, and ``transfer_from``."""

    @functools.wraps(CuRe.__init__)  # type: ignore[misc]  # so that help() shows the arguments
    def __init__(self, *args: Any, **kwargs: Any):
        #: ``task`` and ``curiosity`` as they were before the running pretraining; None: there is none
        self._before_pretraining: dict[str, Any] | None = None
        #: Whether the running pretraining leaves its transitions in the replay buffer
        self._keeps_replay_buffer = False
        #: Whether the next ``learn`` resets all RNGs to their state after construction
        self._restarts_random_streams = False
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        before, self._before_pretraining = self._before_pretraining, None
        collector = "curious" if self._has_curious_agent else "random"
        if before is not None:  # saved during pretraining: build the original networks first
            self.task, self.curiosity = before["task"], before["curiosity"]
        super()._setup_model()
        self._initial_rng_state = th.get_rng_state()
        if before is not None:
            self._begin_pretraining(collector)

    def load_transitions(self, source: str | Path | Iterable[Any]) -> int:
        """Fill the replay buffer from episodes on disk, see ``sb3_cure.datasets``.

        ``learn`` then begins with them and adds what it collects; ``learning_starts=0`` skips the random warm-up.

        :param source: A folder of ``.npz`` files, one such file, or episodes (objects with the attributes of
            ``RecordedEpisode``), such as ``minari.load_dataset(...)``
        :return: Number of transitions that were added
        :raises ValueError: if the episodes have other observations or actions than the model
        """
        if self._vec_normalize_env is not None and self._vec_normalize_env.training:
            raise ValueError(
                "load_transitions stores what is on disk, but VecNormalize has no statistics of it: load saved ones "
                "(VecNormalize.load) and set training=False, or leave VecNormalize out."
            )
        return fill(self.replay_buffer, source, self.policy.scale_action)  # type: ignore[arg-type]

    def fit_representation(self: Self, updates: int, log_interval: int = 1000) -> Self:
        """Train the representation alone, on what the replay buffer holds: ``pretrain`` without collecting.

        Keeps what ``pretrain`` keeps, and the replay buffer as well. A model that was trained before keeps everything
        else, too, and continues its training where it was.

        :param updates: Updates of encoder and head
        :param log_interval: Updates between two dumps of the logger
        :return: self
        :raises ValueError: if there is no SRL head, or nothing in the replay buffer
        """
        self._check_that_srl_learns("fit_representation")
        if self.replay_buffer is None or self.replay_buffer.size() == 0:
            raise ValueError("fit_representation has no transitions to learn from: call load_transitions before it.")
        if not self._custom_logger:
            self._logger = configure_logger(self.verbose, self.tensorboard_log, "fit_representation")
        counted = self._n_updates, self._n_batches, self._current_progress_remaining
        self._begin_pretraining("random")
        try:
            for update in range(updates):
                self._current_progress_remaining = 1 - update / updates  # progress of schedules
                self.train(1, self.batch_size)
                if (update + 1) % log_interval == 0 or update + 1 == updates:
                    self.logger.dump(self._n_updates)
        finally:
            self._restore_settings()
            # Training goes on where it was.
            self._n_updates, self._n_batches, self._current_progress_remaining = counted
            begins = self.num_timesteps == 0 and not self._keeps_replay_buffer
            self._restarts_random_streams = self._restarts_random_streams or begins
        return self

    def transfer_from(self: Self, path: str | Path, freeze: bool = False) -> Self:
        """Start from the encoder, the head and, if both models have one, the curious agent of another task's model.

        The models may have different augmentations: both act on centred views.

        :param path: A model's archive; no code in it is run
        :param freeze: Whether encoder and head stay as they are from then on, with all their statistics, also when the
            model is saved and loaded. The target encoder becomes a copy of the encoder
        :return: self
        :raises ArchiveError: if the file is damaged or pickled
        :raises ValueError: if networks of the two models differ in their shapes, or would mean something else: other
            kinds or another order of observations, latents with and without tanh, another head or intrinsic reward;
            or if there is nothing to transfer
        """
        networks, temperature, their_architecture = archived_networks(path)
        parts = ["encoder.", "encoder_target."] + (["srl."] if self.srl is not None else [])
        curious = self.policy.curious
        transfers_curious = curious is not None and any(name.startswith("curious.") for name in networks)
        if transfers_curious:
            parts += ["curious.", "intrinsic.", "scale."]

        def transferred(tensors: dict[str, Any]) -> dict[str, Any]:
            # The extra state of a reward, such as places in the replay buffer, belongs to its model.
            kept = (name for name in tensors if name.startswith("srl.") or "_extra_state" not in name)
            return {name: tensors[name] for name in kept if name.startswith(tuple(parts))}

        own = self.policy.state_dict()
        here, there = transferred(own), transferred(networks)
        if not here and not there:
            raise ValueError(
                f"{path} and this model have no encoder or head with parameters: there is nothing to transfer."
            )
        for name in here | there:
            ours, theirs = (tuple(getattr(each[name], "shape", ())) if name in each else None for each in (here, there))
            if ours is None or ours != theirs:
                raise ValueError(
                    f"{path} has {name} of shape {theirs}, and this model of shape {ours}: transfer needs equal "
                    "images, encoders and heads, and for a curious agent (not with curiosity=None) equal algorithms, "
                    "actions and rewards."
                )
        ignored = set() if transfers_curious else {"intrinsic", "activation"}
        if self.srl is None:
            ignored.add("srl")
        for name, ours in self.policy.architecture.items():
            theirs = their_architecture.get(name)
            if name not in ignored and ours != theirs:
                raise ValueError(
                    f"{path} has {name}={theirs!r}, and this model {ours!r}: with equal shapes, its networks would "
                    "mean something else here."
                )
        self.policy.load_state_dict({**own, **there})
        if curious is not None and transfers_curious and curious.log_ent_coef is not None and temperature is not None:
            curious.log_ent_coef.data.copy_(temperature)
        self.representation_frozen = self.representation_frozen or freeze
        if self.representation_frozen:
            self.policy.encoder_target.load_state_dict(self.policy.encoder.state_dict())
        return self

    def pretrain(
        self: Self,
        total_timesteps: int,
        collector: str = "curious",
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "pretrain",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        keep_replay_buffer: bool = False,
    ) -> Self:
        """Train the representation alone: a ``learn`` with ``task=False``, after which the settings are as before.

        Keeps encoder, target encoder, head and their optimisers (and the curious agent, if curiosity is on), empties
        the replay buffer and starts counting anew. If the model has a seed, the ``learn`` that follows begins with the
        same seeds of environments and random numbers as without pretraining, so that both have the same random warm-up.
        Pretraining with ``"random"`` therefore begins with the same actions as that warm-up. If the replay buffer is
        kept, it would then hold these transitions twice, so in that case the random numbers continue.

        :param total_timesteps: Agent steps
        :param collector: Who collects: ``"curious"``, a policy trained by the intrinsic reward alone (built for the
            purpose if curiosity is off), or ``"random"``, uniform actions
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: False: continue the pretraining in which a loaded checkpoint was written, with
            the same arguments as before
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :param keep_replay_buffer: Let the task learn from what was collected, too: the environment's rewards are stored
            with it
        :return: self
        :raises ValueError: if there is no SRL head, no such collector, or something in the replay buffer that would be
            lost
        """
        self._check_that_srl_learns("pretrain")
        if collector not in ("curious", "random"):
            raise ValueError(f"collector must be 'curious' or 'random', but is {collector!r}.")
        held = self.replay_buffer.size()  # type: ignore[union-attr]
        if held and not (keep_replay_buffer or self.is_pretraining):
            raise ValueError(
                f"pretrain empties the replay buffer at its end, and {held} transitions are in it: call "
                "load_transitions after it, or set keep_replay_buffer=True."
            )
        self._begin_pretraining(collector)
        self._keeps_replay_buffer = keep_replay_buffer
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
            if self.num_timesteps <= self.learning_starts:
                warnings.warn(
                    f"pretrain trained nothing: it ended after {self.num_timesteps} agent steps, and makes no update "
                    f"before step learning_starts={self.learning_starts}.",
                    stacklevel=2,
                )
        finally:
            self._end_pretraining()
        return self

    @property
    def is_pretraining(self) -> bool:
        """Whether ``pretrain`` is running, or was running when the checkpoint of this resumed model was written."""
        return self._before_pretraining is not None

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        self._end_pretraining()  # a checkpoint taken while pretraining may have been loaded
        built = self.policy.curious is not None, self.policy.intrinsic is not None
        if built != (self._has_curious_agent, self.curiosity in ("separate", "bonus")):
            raise ValueError(
                f"curiosity was set to {self.curiosity!r} after the model was made, with networks of another kind: "
                "make a new model. (With curiosity_prob=0 a separate curious policy learns, but does not act.)"
            )
        for name in ("task", "update", "curiosity_encoder_grad"):
            if getattr(self, name) != (made_with := self.policy._arguments[name]):
                raise ValueError(f"{name} was set after the model was made with {made_with!r}: make a new model.")
        if self._restarts_random_streams:
            self._restart_random_streams()
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _check_that_srl_learns(self, call: str) -> None:
        if self.srl is None:
            raise ValueError(f"{call} trains the representation alone, but srl is None: choose a head.")
        if self.representation_frozen:
            raise ValueError(f"{call} trains the representation, which transfer_from(freeze=True) keeps as it is.")

    def _begin_pretraining(self, collector: str) -> None:
        is_curious = collector == "curious"
        if is_curious and self.policy.curious is None:  # for this pretraining alone; first, as it may fail
            self.policy.add_curious_agent(choose_intrinsic(self), self.intrinsic_kwargs)
            self._set_temperature("curious")
        if self._before_pretraining is None:
            self._before_pretraining = {"task": self.task, "curiosity": self.curiosity}
        self.task, self.curiosity = False, "separate" if is_curious else "random"
        if is_curious:
            self.policy.default_agent = "curious"

    def _restore_settings(self) -> None:
        """Restore what ``_begin_pretraining`` has changed."""
        policy, before = self.policy, self._before_pretraining
        assert before is not None
        self.task, self.curiosity, self._before_pretraining = before["task"], before["curiosity"], None
        if policy.curious is not None and not self._has_curious_agent:
            policy.remove_curious_agent(keep_reward=self.curiosity == "bonus")
        policy.default_agent = "task" if self.task or policy.curious is None else "curious"

    def _end_pretraining(self) -> None:
        """End a pretraining, if there is one: forget what was collected, unless it is kept, and count anew."""
        if self._before_pretraining is None:
            return
        self._restore_settings()
        if not self._keeps_replay_buffer:
            _empty(self.replay_buffer)  # type: ignore[arg-type]
            if self.policy.intrinsic is not None:
                self.policy.intrinsic.forget()
        self.num_timesteps = self._n_updates = self._n_batches = self._n_rl_batches = 0
        self._warmed_up = False
        self._last_obs = None
        self._restarts_random_streams = not self._keeps_replay_buffer

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_initial_rng_state"]

    def _restart_random_streams(self) -> None:
        """Reset all RNGs to their state after construction, not to that of a resumed pretraining."""
        self._restarts_random_streams = False
        self._run.resumed = None  # type: ignore[attr-defined]  # of Persistence
        if self.seed is not None:
            self.set_random_seed(self.seed)
            th.set_rng_state(self._initial_rng_state)


def _empty(buffer: ReplayBuffer) -> None:
    buffer.reset()
    if isinstance(buffer, HerReplayBuffer):  # which also keeps track of its episodes
        for array in (buffer.ep_start, buffer.ep_length, buffer._current_ep_start):
            array[:] = 0
