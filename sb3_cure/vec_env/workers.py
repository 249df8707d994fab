"""Environments in worker processes that may fail: what goes wrong in one is noticed, told, and can be survived."""

import contextlib
import multiprocessing as mp
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from functools import partialmethod
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import (
    CloudpickleWrapper,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)
from stable_baselines3.common.vec_env.patch_gym import _patch_env
from stable_baselines3.common.vec_env.subproc_vec_env import _stack_obs
from stable_baselines3.common.vec_env.subproc_vec_env import _worker as sb3_worker

from sb3_cure.vec_env.frame_watch import FrameFaultError, FrameWatch

# Seconds that workers are given to leave by themselves when the environments are closed; and that one is given when its
# parent is gone, and after SIGKILL.
CLOSE_SECONDS = 10.0
KILL_SECONDS = 2.0
# Commands in which an error leaves no environment to go on with; in all others it is the caller's.
_EPISODE_COMMANDS = ("get_spaces", "reset", "step", "render")


class EnvFaultError(RuntimeError):
    """
    An environment failed. The message is one sentence; the worker's own traceback, if there is one, is a note to it.

    :param index: Which environment
    :param what: What happened to it, as the end of a sentence that begins with "Environment 0"
    :param fix: What to do
    :param details: The worker's traceback, or ""
    """

    def __init__(self, index: int, what: str, fix: str, details: str = "") -> None:
        super().__init__(f"Environment {index} {what}: {fix}")
        self.index, self.what, self.fix, self.details = index, what, fix, details
        if details:
            self.add_note(f"Traceback of the worker:\n{details}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.index, self.what, self.fix, self.details)


class _Failure(NamedTuple):
    """What a worker answers where its environment raised an exception."""

    what: str
    details: str
    is_attribute_error: bool


def _leave_with_parent() -> None:
    """End this process a while after the parent is gone, as one that hangs in a step sees no end of its pipe."""
    parent: Any = mp.parent_process()
    started_by = os.getppid()  # siblings that were forked hold the parent's pipes open, but change no process id
    while parent.is_alive() and os.getppid() == started_by:
        time.sleep(1.0)
    time.sleep(KILL_SECONDS)
    os._exit(1)


def _work(
    remote: Connection, parent_remote: Connection, env_fn: CloudpickleWrapper, watch: CloudpickleWrapper, again: bool
) -> None:
    """
    The worker process: SB3's, which answers ``_Failure`` and goes on where that would end.

    :param remote: Its end of the pipe
    :param parent_remote: The other end, which it closes
    :param env_fn: Makes the environment
    :param watch: Arguments of ``FrameWatch``
    :param again: Whether there was another worker for this environment before
    """
    # Ctrl-C reaches all processes of a terminal, and SIGTERM all of a job, but what they mean is up to the parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    if again:
        # Or its Monitor would empty the file with the episodes before the fault.
        Monitor.__init__ = partialmethod(Monitor.__init__, override_existing=False)  # type: ignore[assignment]
    made: list[gym.Env] = []

    def get_env() -> gym.Env:
        if not made:
            made.append(FrameWatch(_patch_env(env_fn.var()), **watch.var))
        return made[0]

    while True:
        try:
            sb3_worker(remote, parent_remote, CloudpickleWrapper(get_env))
            return
        except BaseException as error:
            is_frame_fault = isinstance(error, FrameFaultError)
            what = str(error) if is_frame_fault else f"raised {error!r}"
            details = "" if is_frame_fault else traceback.format_exc()
            try:
                remote.send(_Failure(what, details, isinstance(error, AttributeError)))
            except OSError:
                return
            if not made:
                return


class _Worker:
    """
    One environment in a process, seen from the parent: what SB3 calls a remote, but ``recv`` always comes back.

    :param owner: The environments that this is one of
    :param index: Which of them
    :param env_fn: Makes the environment
    """

    process: Any  # of multiprocessing; each way of starting processes has its own class
    connection: Connection

    def __init__(self, owner: "FaultTolerantSubprocVecEnv", index: int, env_fn: Callable[[], gym.Env]) -> None:
        self.owner, self.index, self.env_fn = owner, index, env_fn
        self.start(again=False)

    def start(self, again: bool) -> None:
        """
        :param again: Whether there was another process before
        """
        self.connection, remote = self.owner.context.Pipe()
        env_fn, watch = CloudpickleWrapper(self.env_fn), CloudpickleWrapper(self.owner.watch)
        arguments = (remote, self.connection, env_fn, watch, again)
        self.process = self.owner.context.Process(target=_work, args=arguments, daemon=True)
        try:
            self.process.start()
        finally:
            remote.close()
        # At the parent's exit multiprocessing sends SIGTERM to daemons, which they ignore, and waits for them
        self._kill_at_exit = Finalize(self, self.process.kill, exitpriority=0)
        self.fault: EnvFaultError | None = None
        self._starting = True
        # Answers that are not read yet
        self._n_owed = 0

    def stop(self, fault: EnvFaultError, patience: float = 0.0) -> None:
        """
        End the process, by force if need be, and give back all that it held.

        :param fault: What to tell those who ask it later
        :param patience: Seconds in which it may leave by itself
        """
        if self.fault is not None:
            return
        self.fault = fault
        self._kill_at_exit.cancel()
        self.process.join(patience)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(KILL_SECONDS)
        self.connection.close()
        if not self.process.is_alive():
            self.process.close()

    def send(self, request: tuple[str, Any]) -> None:
        """
        :param request: Command and data
        """
        name = "start_timeout" if self._starting else "timeout"
        self._patience = name, getattr(self.owner, name)
        self._deadline = time.monotonic() + self._patience[1]
        while self._n_owed > 0 and self.fault is None:
            self._outcome()  # of a request that was given up (by Ctrl-C, say)
        self._request = request
        if self.fault is None:
            with contextlib.suppress(OSError):  # it is dead, as `_outcome` will find
                self.connection.send(request)
            self._n_owed += 1

    def recv(self) -> Any:
        """
        :return: The answer to the last request; if the worker is lost, of a new one
        :raises EnvFaultError: If the worker is lost and not to be replaced, or the call failed in it
        """
        outcome = self.outcome()
        if not isinstance(outcome, EnvFaultError):
            return outcome
        request = self._request
        self.owner._restart(self, outcome)
        self.send(request)
        return self.answer()

    def answer(self) -> Any:
        """
        :return: The answer to the last request
        :raises EnvFaultError: If there is none
        """
        outcome = self.outcome()
        if isinstance(outcome, EnvFaultError):
            raise outcome
        return outcome

    def outcome(self) -> Any:
        """
        :return: The answer to the last request; or, if the worker is lost and has been stopped, the fault, which is not
            raised because a process that is forked while an exception is handled repeats it in its own tracebacks
        :raises EnvFaultError: If a call failed in a worker that can go on
        :raises AttributeError: If the environment lacks the attribute that was asked for
        """
        outcome = self._outcome()
        if isinstance(outcome, _Failure):
            what = f"{outcome.what} in {self._request[0]}"
            sentence = EnvFaultError(self.index, what, "ask for what the environment has and takes.", outcome.details)
            if outcome.is_attribute_error:
                raise AttributeError(str(sentence)) from sentence
            raise sentence
        return outcome

    def _outcome(self) -> Any:
        if self.fault is not None:
            return self.fault
        command = self._request[0]
        name, seconds = self._patience
        try:
            # Not its sentinel, which with forkserver tells of the server's end too
            if not self.connection.poll(max(0.0, self._deadline - time.monotonic())):
                return self._lost(
                    f"did not answer {command} within {name}={seconds:g} s (rendering or the environment hangs; raise "
                    f"{name} if it is only slow)"
                )
            answer = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(KILL_SECONDS)
            code = self.process.exitcode
            how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else f"ended with status {code}"
            return self._lost(f"is lost, as its process {how} during {command}")
        self._n_owed -= 1
        if isinstance(answer, _Failure) and command in _EPISODE_COMMANDS:
            when = " when it was made" if command == "get_spaces" else f" in {command}"
            return self._lost(answer.what + (when if answer.details else ""), answer.details)
        # Restored environments begin with a step
        self._starting &= command not in ("reset", "step")
        return answer

    def _lost(self, what: str, details: str = "") -> EnvFaultError:
        if self.owner.on_env_fault == "restart":
            fix = "its worker is replaced, and training goes on without this transition."
        else:
            fix = "pass on_env_fault='restart' to replace its worker and go on, or mend the cause."
        fault = EnvFaultError(self.index, what, fix, details)
        self.stop(fault)
        return fault


class FaultTolerantSubprocVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` for environments that may fail. Without faults it returns the same, bit for bit.

    Noticed within ``timeout`` seconds: a worker that raises, dies or hangs. Noticed in its observations, where these
    are uint8 images: a newest frame that is black, and one that stays the same, bit for bit, while the physics moves
    (``FrameWatch``, which each environment is put in). Nothing that is asked of these environments waits longer,
    neither attributes nor pictures nor ``close``.

    ``on_env_fault="raise"`` stops with an ``EnvFaultError``. ``"restart"`` warns, ends the worker, starts another one
    from the same function (with the attributes that were set, the options of the last reset, and a new seed that
    derives from the last one given), and reports one step to the algorithm: the first observation of the new episode,
    reward 0, done, and in ``info``

    - ``env_fault``: the sentence;
    - ``env_fault_steps``: how many of the latest transitions of this environment are spoilt, this one included: more
      than 1 where pixels were the same before it while the physics moved;
    - ``terminal_observation``: the last observation before it, and ``TimeLimit.truncated``: the task did not end;
    - no ``episode``: a ``Monitor`` in the worker forgets the episode.

    ``CuReSAC`` never samples such transitions, and SB3's off-policy algorithms do not either with
    ``replay_buffer_class=sb3_cure.buffers.SkippingReplayBuffer``. On-policy ones see a truncated episode.

    :param env_fns: Functions that make the environments
    :param timeout: Seconds that an answer may take
    :param on_env_fault: ``"raise"`` or ``"restart"``
    :param start_method: As in ``SubprocVecEnv``
    :param start_timeout: Seconds for each answer of a new worker until its first ``reset`` is done (with a state that
        was loaded, its first ``step``)
    :param max_faults: Faults of one environment without a good step in between, after which ``"restart"`` raises too
    :param watch: Further arguments of ``FrameWatch``: ``allow_black_frames``, ``frozen_steps``, ``frozen_motion``,
        ``state``
    :raises ValueError: If ``on_env_fault`` is unknown
    :raises EnvFaultError: If an environment cannot be made
    """

    remotes: list[_Worker]  # type: ignore[assignment]

    def __init__(
        self,
        env_fns: list[Callable[[], gym.Env]],
        timeout: float = 60.0,
        on_env_fault: str = "raise",
        start_method: str | None = None,
        *,
        start_timeout: float = 120.0,
        max_faults: int = 3,
        **watch: Any,
    ) -> None:
        if on_env_fault not in ("raise", "restart"):
            raise ValueError(f"on_env_fault={on_env_fault!r} is unknown: use 'raise', or 'restart' to go on training.")
        if start_method is None:
            start_method = "forkserver" if "forkserver" in mp.get_all_start_methods() else "spawn"
        self.context: Any = mp.get_context(start_method)
        self.timeout, self.start_timeout, self.on_env_fault = timeout, start_timeout, on_env_fault
        self.max_faults, self.watch = max_faults, watch
        self.waiting = self.closed = False
        #: Workers replaced so far, by environment
        self.restarts = [0] * len(env_fns)
        self._faults_in_a_row = [0] * len(env_fns)
        # What a new worker gets: attributes that were set, and seed and options of the last reset that had any
        self._attributes: list[dict[str, Any]] = [{} for _ in env_fns]
        self._last_seeds: list[int | None] = [None] * len(env_fns)
        self._last_options: list[dict[str, Any]] = [{} for _ in env_fns]
        self._last_obs: list[Any] = [None] * len(env_fns)
        # How many of the latest steps of each showed frozen pixels, perhaps: a fault spoils these too
        self._n_frozen = [0] * len(env_fns)
        # The sentences of faults that the next step has to report, with the first observations of the new episodes
        self._unreported: list[list[Any] | None] = [None] * len(env_fns)
        self.remotes = []
        try:
            for index, env_fn in enumerate(env_fns):
                self.remotes.append(_Worker(self, index, env_fn))
            for worker in self.remotes:
                worker.send(("get_spaces", None))
            env_spaces = [worker.answer() for worker in self.remotes]
            VecEnv.__init__(self, len(env_fns), *env_spaces[0])
        except BaseException:
            self.close()
            raise

    @property
    def processes(self) -> list[Any]:  # type: ignore[override]
        """The present worker processes."""
        return [worker.process for worker in self.remotes]

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: One per environment
        """
        for worker, action in zip(self.remotes, actions, strict=True):
            if self._unreported[worker.index] is None:
                worker.send(("step", action))
        self.waiting = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: Observations, rewards, dones and infos
        :raises EnvFaultError: If an environment failed and is not to be replaced, or failed again and again
        """
        results = [self._step_result(worker) for worker in self.remotes]
        self.waiting = False
        observations, rewards, dones, infos, self.reset_infos = zip(*results, strict=True)  # type: ignore[assignment]
        return _stack_obs(observations, self.observation_space), np.stack(rewards), np.stack(dones), infos  # type: ignore[return-value]

    def _step_result(self, worker: _Worker) -> tuple[Any, Any, Any, dict[str, Any], dict[str, Any]]:
        index = worker.index
        if self._unreported[index] is None:
            result = worker.outcome()
            if not isinstance(result, EnvFaultError):
                self._last_obs[index], self._n_frozen[index] = result[0], result[3].get("frozen_frames", 0)
                self._faults_in_a_row[index] = 0
                return result
            self._restart(worker, result)
        sentence, observation = self._unreported[index]  # type: ignore[misc]
        self._unreported[index] = None
        info = {
            "env_fault": sentence,
            "env_fault_steps": 1 + self._n_frozen[index],
            "TimeLimit.truncated": True,
            "terminal_observation": self._last_obs[index],
        }
        self._last_obs[index], self._n_frozen[index] = observation, 0
        return observation, 0.0, True, info, self.reset_infos[index]

    def reset(self) -> VecEnvObs:
        """
        :return: First observations
        :raises EnvFaultError: As ``step_wait``
        """
        for worker, seed, options in zip(self.remotes, self._seeds, self._options, strict=True):
            if seed is not None:
                self._last_seeds[worker.index] = seed
            self._last_options[worker.index] = options
            worker.send(("reset", (seed, options)))
        self.waiting = False
        self.reset_infos = list(self.reset_infos)
        for worker in self.remotes:
            outcome = worker.outcome()
            if isinstance(outcome, EnvFaultError):
                self._restart(worker, outcome)
                _, self._last_obs[worker.index] = self._unreported[worker.index]  # type: ignore[misc]
            else:
                self._last_obs[worker.index], self.reset_infos[worker.index] = outcome
        # Nothing came before the first observation that could be told of
        self._unreported = [None] * self.num_envs
        self._reset_seeds()
        self._reset_options()
        return _stack_obs(self._last_obs, self.observation_space)

    def _restart(self, worker: _Worker, fault: EnvFaultError) -> None:
        """
        Replace a worker that has been stopped; the next step reports it.

        :raises EnvFaultError: If workers are not to be replaced (any more), or this environment fails again and again
        """
        index = worker.index
        if self.on_env_fault == "raise" or self.closed:
            raise fault
        latest, observation = fault, None
        while observation is None:
            worker.stop(latest)
            self._faults_in_a_row[index] += 1
            if (n_faults := self._faults_in_a_row[index]) > self.max_faults:
                what = f"failed {n_faults} times without a good step in between, and at last {latest.what}"
                raise EnvFaultError(index, what, "mend the cause, or raise max_faults.", latest.details) from fault
            self.restarts[index] += 1
            details = f"\n{latest.details}" if latest.details else ""
            warnings.warn(f"{latest} This is restart {self.restarts[index]}.{details}", RuntimeWarning, stacklevel=2)
            try:
                observation = self._begin_again(worker)
            except EnvFaultError as another:
                latest = another
        self._unreported[index] = [str(fault), observation]

    def _begin_again(self, worker: _Worker) -> Any:
        """Start a new worker and its first episode; returns the first observation."""
        index = worker.index
        seed = self._last_seeds[index]
        if seed is not None:
            # Not the same again: it would repeat the episode, and whatever made it fail.
            seed = int(np.random.SeedSequence([seed, self.restarts[index]]).generate_state(1)[0])
        attributes = [("env_method", ("set_env_attr", pair, {})) for pair in self._attributes[index].items()]
        worker.start(again=True)
        for request in (("get_spaces", None), *attributes, ("reset", (seed, self._last_options[index]))):
            worker.send(request)
            answer = worker.answer()
        observation, reset_info = answer
        self.reset_infos = [*self.reset_infos[:index], reset_info, *self.reset_infos[index + 1 :]]
        return observation

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: Name
        :param value: Value, which a worker that replaces another one gets too
        :param indices: Which environments; None: all
        """
        indices = list(self._get_indices(indices))
        self.env_method("set_env_attr", attr_name, value, indices=indices)
        for index in indices:
            self._attributes[index][attr_name] = value

    def state_dict(self) -> dict[str, Any]:
        """For exact resume.

        :return: What is remembered of workers, beside what their environments tell of themselves
        """
        return {name: getattr(self, name) for name in _STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        for index, attributes in enumerate(state["_attributes"]):
            for name, value in attributes.items():
                self.set_attr(name, value, index)
        for name in _STATE:
            setattr(self, name, state[name])

    def close(self) -> None:
        """End all workers, within ten seconds or ``timeout``, whichever is less."""
        if self.closed:
            return
        self.closed = True
        deadline = time.monotonic() + min(CLOSE_SECONDS, self.timeout)
        for worker in self.remotes:
            if worker.fault is None:
                with contextlib.suppress(OSError):  # it is dead
                    worker.connection.send(("close", None))
        for worker in self.remotes:
            fault = EnvFaultError(worker.index, "has been closed", "make the environments anew.")
            worker.stop(fault, max(0.0, deadline - time.monotonic()))


# Attributes of the environments that a resumed training needs.
_STATE = (
    *("_seeds", "_options", "restarts", "_faults_in_a_row", "_attributes", "_last_seeds", "_last_options"),
    *("_last_obs", "_n_frozen", "_unreported"),
)
