"""Where a representation comes from before the task is learned, and what that undoes: collected without task reward
(paper, "Effect of Pretraining"), episodes on disk, or a model of another task (the paper's outlook)."""

import functools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from sb3_cure.cure.cure import CuRe
from sb3_cure.data.datasets import episodes_of, fill
from sb3_cure.persistence.archive import archived_networks

Self = TypeVar("Self", bound="Pretraining")


class Pretraining(CuRe):
    """Adds ``pretrain`` to CuRe: a ``learn`` with ``task=False``, after which the settings are what they were; the same
    from episodes on disk (``load_transitions``, ``fit_representation``), and ``transfer_from`` another model.
    """

    @functools.wraps(CuRe.__init__)  # type: ignore[misc]  # so that help() shows the arguments
    def __init__(self, *args: Any, **kwargs: Any):
        #: What ``task`` and ``curiosity`` were before the pretraining that is under way; None: there is none
        self._before_pretraining: dict[str, Any] | None = None
        #: Whether ``learn`` comes right after ``pretrain``, and begins as without it
        self._is_pretrained = False
        #: Whether encoder and head are kept as they are
        self.representation_frozen = False
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        before, self._before_pretraining = self._before_pretraining, None
        if before is None:
            super()._setup_model()
            if self.representation_frozen:
                self.policy.freeze_representation()
            return
        # Of an archive that was saved while pretraining: its networks are those of before and what came on top of them.
        collector = "curious" if self._has_curious_agent else "random"
        self.task, self.curiosity = before["task"], before["curiosity"]
        super()._setup_model()
        self._begin_pretraining(collector)

    def load_transitions(self, source: str | Path | Iterable[Any]) -> int:
        """Fill the replay buffer from episodes on disk, see ``sb3_cure.data.datasets``.

        ``learn`` then begins with them beside what it collects; ``learning_starts=0`` leaves its random warm-up out.

        :param source: A folder of ``.npz`` files, one such file, or episodes with their attributes, such as
            ``minari.load_dataset(...)``
        :return: Number of transitions that were added
        :raises ValueError: if the episodes are of other observations or actions
        """
        if self._vec_normalize_env is not None and self._vec_normalize_env.training:
            raise ValueError(
                "load_transitions stores what is on disk, but VecNormalize has no statistics of that: load its own "
                "(VecNormalize.load) and set training=False, or leave it out."
            )
        return fill(self.replay_buffer, episodes_of(source), self.policy.scale_action)  # type: ignore[arg-type]

    def fit_representation(self: Self, updates: int, log_interval: int = 1000) -> Self:
        """``pretrain`` without collecting: train the representation alone, on what the replay buffer holds.

        Keeps what ``pretrain`` keeps, and the replay buffer as well.

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
        self._metrics.attach(self.logger)
        self._begin_pretraining("random")
        try:
            for done in range(0, updates, log_interval):
                self._current_progress_remaining = 1 - done / updates  # what schedules follow
                self.train(min(log_interval, updates - done), self.batch_size)
                self.logger.dump(self._n_updates)
                self._guard.report()
        finally:
            self._end_pretraining(keeps_transitions=True)
            self.policy.set_training_mode(False)
        return self

    def transfer_from(self: Self, path: str | Path, freeze: bool = False) -> Self:
        """Begin with encoder, head and, where both models have one, the curious agent of a model of a sibling task.

        Observations may be augmented otherwise than there: to act, either model sees the centred view.

        :param path: A model's archive, of which nothing is executed
        :param freeze: Whether encoder and head then stay as they are, with all their statistics, also when the model is
            saved and loaded. The target encoder becomes the encoder
        :return: self
        :raises ArchiveError: if the file is damaged or pickled
        :raises ValueError: if networks of the two models differ in their shapes, or would mean something else: other
            kinds or another order of observations, latents with and without tanh, another head or intrinsic reward
        """
        networks, temperature, their_traits = archived_networks(path)
        parts = ["encoder.", "encoder_target."] + (["srl."] if self.srl is not None else [])
        curious: Any = getattr(self.policy, "curious", None)
        if curious is not None and any(name.startswith("curious.") for name in networks):
            parts += ["curious.", "intrinsic.", "scale."]
        own = self.policy.state_dict()
        here, there = (
            {n: t for n, t in all_.items() if n.startswith(tuple(parts)) and "_extra_state" not in n}
            for all_ in (own, networks)
        )
        shapes = [{name: tuple(tensor.shape) for name, tensor in each.items()} for each in (here, there)]
        for name in [name for part in parts for name in here | there if name.startswith(part)] or parts:
            ours, theirs = (each.get(name) for each in shapes)
            if ours is None or ours != theirs:
                raise ValueError(
                    f"{path} has {name} of shape {theirs}, and this model of shape {ours}: transfer needs equal "
                    "images, encoders and heads, and for a curious agent equal actions and rewards."
                )
        not_compared = ({"srl"} if self.srl is None else set()) | ({"intrinsic"} if "curious." not in parts else set())
        for name, trait in self.policy.traits.items():
            if name not in not_compared and trait != their_traits.get(name):
                raise ValueError(
                    f"{path} has {name}={their_traits.get(name)!r}, and this model {trait!r}: of equal shapes, its "
                    "networks would mean something else here."
                )
        self.policy.load_state_dict({**own, **there})
        if "curious." in parts and curious.log_ent_coef is not None and temperature is not None:
            curious.log_ent_coef.data.copy_(temperature)
        self.representation_frozen = self.representation_frozen or freeze
        if self.representation_frozen:
            self.policy.freeze_representation()
        return self

    @property
    def is_pretraining(self) -> bool:
        """Whether ``pretrain`` runs, or ran when the checkpoint was written that this model was resumed from."""
        return self._before_pretraining is not None

    def _phase(self) -> tuple[bool, bool]:
        learns_srl, learns_rl = super()._phase()
        return learns_srl and not self.representation_frozen, learns_rl

    def pretrain(
        self: Self,
        total_timesteps: int,
        collector: str = "curious",
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "pretrain",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train the representation alone.

        Keeps encoder, target encoder, head and their optimisers (and the curious agent, if curiosity is on), empties
        the replay buffer and starts counting anew. Of a model with a seed the ``learn`` that follows begins with the
        environments and random numbers that it would begin with without pretraining, so that both have the same random
        warm-up. So pretraining with ``"random"`` begins with the same actions as that warm-up.

        :param total_timesteps: Agent steps
        :param collector: Who collects: ``"curious"``, a policy trained by the intrinsic reward alone (built for the
            purpose if curiosity is off), or ``"random"``, uniform actions
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: False: go on with the pretraining in which a loaded checkpoint was taken
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :return: self
        :raises ValueError: if there is no SRL head, or no such collector
        """
        self._check_that_srl_learns("pretrain")
        if collector not in ("curious", "random"):
            raise ValueError(f"collector is {collector!r}: choose 'curious' or 'random'.")
        self._begin_pretraining(collector)
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        finally:
            self._end_pretraining()
        return self

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        :param total_timesteps: Agent steps to train for (environment steps / action repeat), all environments together
        :param callback: SB3 callback(s)
        :param log_interval: Episodes between two dumps of the logger
        :param tb_log_name: Name of the run in TensorBoard; None: the algorithm's
        :param reset_num_timesteps: Whether to start counting anew
        :param progress_bar: Show a progress bar (needs tqdm and rich)
        :return: self
        """
        self._end_pretraining()  # a checkpoint taken while pretraining may have been loaded
        if self._is_pretrained:
            self._restart_random_streams()
        name = tb_log_name or type(self).__name__
        super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        return self

    def _check_that_srl_learns(self, call: str) -> None:
        if self.srl is None:
            raise ValueError(f"{call} trains the representation alone, but srl is None: choose a head.")
        if self.representation_frozen:
            raise ValueError(f"{call} trains the representation, which transfer_from(freeze=True) keeps as it is.")

    def _begin_pretraining(self, collector: str) -> None:
        if self._before_pretraining is None:
            self._before_pretraining = {"task": self.task, "curiosity": self.curiosity}
        self.task, self.curiosity = False, "separate" if collector == "curious" else "random"
        if self._has_curious_agent:
            if self.policy.curious is None:
                self._add_curious_agent()
            self.policy.default_agent = "curious"

    def _add_curious_agent(self) -> None:
        """For this pretraining alone."""
        policy = self.policy
        choices = self._policy_choices()
        policy.add_curious_agent(choices["intrinsic_class"], choices["intrinsic_kwargs"])
        policy.to(self.device)
        if self._compiles:
            policy.compile_networks()
        update = policy.encoder_update
        for source in choices["encoder_sources"]:
            if source not in update.mean_squares:
                update.add_source(source)
        self._setup_curious_temperature()

    def _end_pretraining(self, keeps_transitions: bool = False) -> None:
        if self._before_pretraining is None:
            return
        policy = self.policy
        self.task, self.curiosity = self._before_pretraining["task"], self._before_pretraining["curiosity"]
        self._before_pretraining = None
        if policy.curious is not None and not self._has_curious_agent:
            policy.curious = None
            if self.curiosity != "bonus":  # which has the reward, too
                policy.intrinsic = None
            for source in policy.encoder_update.mean_squares.keys() - set(self._policy_choices()["encoder_sources"]):
                policy.encoder_update.remove_source(source)
        policy.default_agent = self._policy_choices()["default_agent"]
        if self.curiosity == "bonus":
            policy.scale.forget()  # a bonus is divided by its size, the reward of pretraining by its spread
        if not keeps_transitions:
            _empty(self.replay_buffer)  # type: ignore[arg-type]
            if policy.intrinsic is not None:
                policy.intrinsic.forget()
        self.num_timesteps = self._n_updates = self._n_batches = self._n_rl_batches = 0
        self._warmed_up = False
        self._last_obs = None
        self._is_pretrained = True

    def _restart_random_streams(self) -> None:
        """All of them are to be where they are when a model of this seed has been made."""
        self._is_pretrained = False
        if self.seed is not None:
            self.set_random_seed(self.seed)
            # Draws the initial weights once more; nothing else of it is needed.
            arguments = {**self.policy_kwargs, **self._policy_choices()}
            self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **arguments)


def _empty(buffer: ReplayBuffer) -> None:
    buffer.reset()
    if isinstance(buffer, HerReplayBuffer):  # which knows its episodes beside that
        for array in (buffer.ep_start, buffer.ep_length, buffer._current_ep_start):
            array[:] = 0
