"""Environments in worker processes that may fail: faults are noticed and named, and training can survive them."""

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
from multiprocessing.connection import Connection, wait
from multiprocessing.util import Finalize
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvObs
from stable_baselines3.common.vec_env.patch_gym import _patch_env
from stable_baselines3.common.vec_env.subproc_vec_env import _worker as sb3_worker

from sb3_cure.persistence.env_state import ResumableEnv
from sb3_cure.vec_env.frame_watch import EnvFaultError, FrameWatch

#: Seconds in which workers may leave when the environments are closed, and after SIGKILL or the end of their parent
CLOSE_SECONDS, KILL_SECONDS = 10.0, 2.0
# Attributes of a worker that a resumed training needs
_STATE = ("attributes", "seed", "options", "restarts", "faults_in_a_row", "last_obs")


def leave_with_parent() -> None:
    """End this process soon after its parent, even if it hangs in a step."""
    parent: Any = mp.parent_process()
    started_by = os.getppid()  # siblings that were forked hold the parent's pipes open, but change no process id
    while parent.is_alive() and os.getppid() == started_by:
        time.sleep(1.0)
    time.sleep(KILL_SECONDS)
    os._exit(1)


def _work(remote: Connection, parent_remote: Connection, make_env: CloudpickleWrapper, again: bool) -> None:
    """Run SB3's worker, and answer ``EnvFaultError`` where an exception ends it.

    :param remote: This end of the pipe
    :param parent_remote: The other end, to be closed
    :param make_env: Makes the environment
    :param again: Whether this environment had another worker before
    """
    # Ctrl-C reaches all processes of a terminal, and SIGTERM all of a job, but the parent decides what they mean.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=leave_with_parent, daemon=True).start()
    if again:
        # Otherwise its Monitor would empty the file with the episodes before the fault.
        Monitor.__init__ = partialmethod(Monitor.__init__, override_existing=False)  # type: ignore[assignment]
    try:
        sb3_worker(remote, parent_remote, make_env)
    except BaseException as error:
        fault = error
        if not isinstance(error, EnvFaultError):
            fault = EnvFaultError(f"raised {error!r}")
            fault.add_note(f"Traceback of the worker:\n{traceback.format_exc()}")
        with contextlib.suppress(OSError):
            remote.send(fault)


class _Worker:
    """One environment in a process, seen from the parent: SB3's "remote", but ``recv`` returns or raises in time.

    :param owner: The vectorised environment
    :param index: Index of this environment
    :param env_fn: Makes the environment
    """

    process: Any  # of multiprocessing; each start method has its own class
    connection: Connection

    def __init__(self, owner: "FaultTolerantSubprocVecEnv", index: int, env_fn: Callable[[], gym.Env]) -> None:
        self.owner, self.index = owner, index
        watch = owner.watch  # not the owner, which cannot be sent to a process
        self.make_env = CloudpickleWrapper(lambda: ResumableEnv(FrameWatch(_patch_env(env_fn()), **watch)))
        # What a new process gets: attributes that were set, options of the last reset, the last seed that was given
        self.attributes: dict[str, Any] = {}
        self.seed: int | None = None
        self.options: dict[str, Any] = {}
        self.restarts = self.faults_in_a_row = 0
        self.last_obs: Any = None
        self.info_keys: set[str] = set()
        self.start()

    def start(self) -> None:
        """Start a process."""
        self.connection, remote = self.owner.context.Pipe()
        arguments = (remote, self.connection, self.make_env, self.restarts > 0)
        self.process = self.owner.context.Process(target=_work, args=arguments, daemon=True)
        try:
            self.process.start()
        finally:
            remote.close()
        # At exit multiprocessing sends SIGTERM to daemons, which these workers ignore, and waits for them.
        self._kill_at_exit = Finalize(self, self.process.kill, exitpriority=0)
        self.fault: EnvFaultError | None = None
        self._n_unread = 0

    def stop(self, fault: EnvFaultError, patience: float = 0.0) -> None:
        """End the process, if need be by force, and release what it held.

        :param fault: Error of all later requests
        :param patience: Seconds in which it may leave by itself
        """
        if self.fault is not None:
            return
        self.fault = fault
        self._kill_at_exit.cancel()
        self.process.join(patience)
        self.process.kill()
        self.process.join(KILL_SECONDS)
        self.connection.close()
        with contextlib.suppress(ValueError):  # it even survived SIGKILL
            self.process.close()

    @property
    def owes_answer(self) -> bool:
        return self._n_unread > 0

    def send(self, request: tuple[str, Any]) -> None:
        """Send a request.

        :param request: Command and data, as SB3's worker takes them
        """
        while self._n_unread > 0 and self.fault is None:
            with contextlib.suppress(EnvFaultError):
                self.answer()  # to a request that was given up, by Ctrl-C for example
        self._request = request
        self._limit = "start_timeout" if request[0] in ("get_spaces", "reset") else "timeout"
        self._deadline = time.monotonic() + getattr(self.owner, self._limit)
        if self.fault is None:
            with contextlib.suppress(OSError):  # it is dead, as `answer` will find
                self.connection.send(request)
            self._n_unread += 1

    def recv(self) -> Any:
        """Get the answer to the last request; if the worker was lost in an episode, begin another one.

        :return: The answer
        :raises EnvFaultError: If the worker was lost and is not replaced
        """
        command, data = self._request
        if command == "reset":
            self.seed, self.options = self.seed if data[0] is None else data[0], data[1]
        fault = None
        try:
            answer = self.answer()
        except EnvFaultError as error:
            fault = error
        if fault is not None:  # outside `except`: forked processes would show this error in their tracebacks
            if command not in ("step", "reset"):
                raise fault
            first, reset_info = answer = self._restart(fault)
            if command == "step":
                info = dict.fromkeys(self.info_keys) | {"env_fault": str(fault), "TimeLimit.truncated": True}
                answer = first, 0.0, True, info | {"terminal_observation": self.last_obs}, reset_info
        elif command == "step":
            self.faults_in_a_row = 0
            self.info_keys = answer[3].keys() - {"episode"}
        if command == "set_attr":
            self.attributes[data[0]] = data[1]
        elif command in ("step", "reset"):
            self.last_obs = answer[0]
        return answer

    def answer(self) -> Any:
        """Get the answer to the last request, and stop a worker that is lost.

        :return: The answer
        :raises EnvFaultError: If the worker is lost
        """
        if self.fault is not None:
            raise self.fault
        try:
            # Not the process' sentinel, which with forkserver also shows the server's end
            if not self.connection.poll(max(0.0, self._deadline - time.monotonic())):
                seconds = getattr(self.owner, self._limit)
                raise self._lost(f"did not answer within {self._limit}={seconds:g} s")
            answer = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(KILL_SECONDS)
            code = self.process.exitcode
            how = f"was killed by {signal.Signals(-code).name}" if code and code < 0 else f"ended with status {code}"
            raise self._lost(f"is lost, as its process {how}") from None
        self._n_unread -= 1
        if isinstance(answer, EnvFaultError):
            raise self._lost(str(answer), answer)
        return answer

    def _lost(self, what: str, sent: EnvFaultError | None = None) -> EnvFaultError:
        """Stop the worker.

        :param what: What happened to it, the end of a sentence that begins with "Environment 0"
        :param sent: Error that the worker has sent
        :return: Error to raise
        """
        command = self._request[0]
        hint = " (scripts that start workers need `if __name__ == '__main__':`)" if command == "get_spaces" else ""
        fault = EnvFaultError(f"Environment {self.index} {what} in {command}{hint}.")
        if sent is not None:
            vars(fault).update(vars(sent))  # notes, and whether another worker may take its place
        self.stop(fault)
        return fault

    def _restart(self, fault: EnvFaultError) -> Any:
        """Start a new process and its first episode.

        :param fault: What happened
        :return: First observation and its info
        :raises EnvFaultError: If workers are not replaced, or if this environment failed too often
        """
        while True:
            self.faults_in_a_row += 1
            if self.owner.on_env_fault == "raise" or self.owner.closed or not fault.restartable:
                raise fault
            if self.faults_in_a_row > self.owner.max_faults:
                fault.add_note(f"max_faults={self.owner.max_faults}: it failed that often without a good step between.")
                raise fault
            self.restarts += 1
            notes = "\n".join(["", *getattr(fault, "__notes__", [])])
            warnings.warn(f"{fault} Restart {self.restarts} of its worker.{notes}", RuntimeWarning, stacklevel=2)
            try:
                return self._begin_again()
            except EnvFaultError as error:
                fault = error

    def _begin_again(self) -> Any:
        seed = self.seed
        if seed is not None:
            # Not the same seed again: it would repeat the episode and whatever made it fail.
            seed = int(np.random.SeedSequence([seed, self.restarts]).generate_state(1)[0])
        self.start()
        answer = None
        attributes = [("set_attr", attribute) for attribute in self.attributes.items()]
        for request in (("get_spaces", None), *attributes, ("reset", (seed, self.options))):
            self.send(request)
            answer = self.answer()
        return answer


class FaultTolerantSubprocVecEnv(SubprocVecEnv):
    """SB3's ``SubprocVecEnv`` for environments that may fail. Without faults it returns the same, bit for bit.

    It notices a worker that raises, dies or does not answer in time (because it hangs in a driver, for example). Each
    environment is wrapped in a ``FrameWatch``, which notices black and frozen frames of uint8 images.

    ``on_env_fault="raise"`` stops with an ``EnvFaultError``. ``"restart"`` warns and replaces the worker by one from
    the same function (with the attributes that were set, the options of the last reset, and a new seed that derives
    from the last one given; what ``env_method`` has changed in it is lost). The step then returns the first observation
    of the new episode, reward 0, done, and in ``info``

    - ``env_fault``: what happened, one sentence;
    - ``terminal_observation``: the last good observation, and ``TimeLimit.truncated``: the task did not end;
    - no ``episode``: a ``Monitor`` in the worker forgets the episode (``VecMonitor`` counts it, as far as it went);
    - None for what else was in the ``info`` of the step before.

    ``CuReSAC`` stores nothing of such a step. SB3's own off-policy algorithms store one transition from the last
    observation to itself. Frozen frames always raise, since transitions before the error are wrong, too; and so does a
    worker that is lost between two steps, when an attribute or a method is read.

    :param env_fns: Functions that make the environments
    :param timeout: Seconds that a step, or any other answer, may take
    :param on_env_fault: ``"raise"`` or ``"restart"``
    :param start_method: As in ``SubprocVecEnv``
    :param start_timeout: Seconds that making an environment, or a reset, may take
    :param max_faults: Faults of one environment without a good step in between, after which ``"restart"`` raises, too
    :param watch: Further arguments of ``FrameWatch``: ``allow_black_frames``, ``frozen_steps``, ``state``
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
            raise ValueError(f"on_env_fault must be 'raise' or 'restart', not {on_env_fault!r}.")
        if start_method is None:
            start_method = "forkserver" if "forkserver" in mp.get_all_start_methods() else "spawn"
        self.context: Any = mp.get_context(start_method)
        self.timeout, self.start_timeout, self.on_env_fault = timeout, start_timeout, on_env_fault
        self.max_faults, self.watch = max_faults, watch
        self.waiting = self.closed = False
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

    @property
    def restarts(self) -> list[int]:
        """Workers replaced so far, by environment."""
        return [worker.restarts for worker in self.remotes]

    def reset(self) -> VecEnvObs:
        """Reset all environments.

        :return: First observations
        :raises EnvFaultError: If an environment failed and is not replaced
        """
        self.waiting = False  # a step that raised left it on
        return super().reset()

    def state_dict(self) -> dict[str, Any]:
        """Get what workers remember, for exact resume; environments save their own states.

        :return: Plain data
        """
        workers = [{name: getattr(worker, name) for name in _STATE} for worker in self.remotes]
        return {"seeds": self._seeds, "options": self._options, "workers": workers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what workers remember.

        :param state: Result of ``state_dict``
        """
        self._seeds, self._options = state["seeds"], state["options"]
        for worker, own in zip(self.remotes, state["workers"], strict=True):
            vars(worker).update(own)
            for attribute in own["attributes"].items():
                worker.send(("set_attr", attribute))
                worker.recv()

    def close(self) -> None:
        """End all workers, within ten seconds or ``timeout``, whichever is less."""
        if self.closed:
            return
        self.closed = True
        deadline = time.monotonic() + min(CLOSE_SECONDS, self.timeout)
        owing = {worker.connection: worker for worker in self.remotes if worker.fault is None and worker.owes_answer}
        for worker in self.remotes:
            if worker.connection not in owing:
                worker.send(("close", None))
        # Workers still in a step that Ctrl-C interrupted here are asked to close once they have answered.
        while owing and (answering := wait(list(owing), max(0.0, deadline - time.monotonic()))):
            for connection in answering:
                owing.pop(connection).send(("close", None))  # type: ignore[call-overload]
        for worker in self.remotes:
            fault = EnvFaultError(f"Environment {worker.index} has been closed: make the environments again.")
            worker.stop(fault, max(0.0, deadline - time.monotonic()))
