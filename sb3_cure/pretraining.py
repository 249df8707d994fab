"""Pretraining of the representation without task reward (paper, "Effect of Pretraining"), and what it undoes."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_cure.cure import CuRe

Self = TypeVar("Self", bound="Pretraining")


class Pretraining(CuRe):
    """Adds ``pretrain`` to CuRe: a ``learn`` with ``task=False``, after which the settings are what they were."""

    #: Of ``Persistence``: whether a script that is run again has nothing to do in this call
    _was_over: Callable[[str, bool], bool]

    @functools.wraps(CuRe.__init__)  # type: ignore[misc]  # so that help() shows the arguments
    def __init__(self, *args: Any, **kwargs: Any):
        #: What ``task`` and ``curiosity`` were before the pretraining that is under way; None: there is none
        self._before_pretraining: dict[str, Any] | None = None
        #: Whether ``learn`` comes right after ``pretrain``, and begins as without it
        self._is_pretrained = False
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        before, self._before_pretraining = self._before_pretraining, None
        if before is None:
            super()._setup_model()
            return
        # Of an archive that was saved while pretraining: its networks are those of before and what came on top of them.
        collector = "curious" if self._has_curious_agent else "random"
        self.task, self.curiosity = before["task"], before["curiosity"]
        super()._setup_model()
        self._begin_pretraining(collector)

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
        if self.srl is None:
            raise ValueError("pretrain trains the representation alone, but srl is None: choose a head.")
        if collector not in ("curious", "random"):
            raise ValueError(f"collector is {collector!r}: choose 'curious' or 'random'.")
        if self._was_over("pretrain", reset_num_timesteps):
            return self
        self._begin_pretraining(collector)
        self._call_name = "pretrain"
        try:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        finally:
            del self._call_name
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
        if self._was_over("learn", reset_num_timesteps):
            return self
        self._end_pretraining()  # a checkpoint taken while pretraining may have been loaded
        if self._is_pretrained:
            self._restart_random_streams()
        name = tb_log_name or type(self).__name__
        super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)
        return self

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

    def _end_pretraining(self) -> None:
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
        self.replay_buffer.reset()  # type: ignore[union-attr]
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
