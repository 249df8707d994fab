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
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper, VecEnvObs
from stable_baselines3.common.vec_env.patch_gym import _patch_env
from stable_baselines3.common.vec_env.subproc_vec_env import _worker as sb3_worker

from sb3_cure.persistence.env_state import ResumableEnv
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
            made.append(ResumableEnv(FrameWatch(_patch_env(env_fn.var()), **watch.var)))
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
                remote.send(_Failure(what, details))
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
        # What a new process gets: attributes that were set, options of the last reset, the last seed that was given
        self.attributes: dict[str, Any] = {}
        self.seed: int | None = None
        self.options: dict[str, Any] = {}
        self.restarts = self.faults_in_a_row = 0
        self.last_obs: Any = None
        # How many of the latest steps showed frozen pixels, perhaps: a fault spoils these too
        self.n_frozen = 0
        # A fault that the next step has to report, with what the reset after it returned
        self.unreported: list[Any] | None = None
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
        self._is_starting = True
        self._n_unread = 0

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
        :param request: Command and data, as SB3's worker takes them
        """
        while self._n_unread > 0 and self.fault is None:
            self._answer()  # to a request that was given up (by Ctrl-C, say)
        command, data = self._request = request
        self._time_out = "start_timeout" if self._is_starting else "timeout"
        self._deadline = time.monotonic() + getattr(self.owner, self._time_out)
        if self.fault is not None or self._is_over():
            return
        if command == "set_attr":
            request = ("env_method", ("set_env_attr", data, {}))  # beneath the frame watch
        with contextlib.suppress(OSError):  # it is dead, as `_answer` will find
            self.connection.send(request)
        self._n_unread += 1

    def recv(self) -> Any:
        """
        :return: The answer to the last request; if the worker is lost, of a new one
        :raises EnvFaultError: If the worker is lost and not to be replaced, or the call failed in it
        """
        command, data = self._request
        if command == "reset":
            self.seed, self.options = self.seed if data[0] is None else data[0], data[1]
        answer: Any = None if self._is_over() else self._answer()
        if isinstance(answer, EnvFaultError):
            if self.fault is None:
                raise answer
            begun = self._restart(answer)
            if command not in ("step", "reset"):
                return self._ask((command, data))
            answer = begun if command == "reset" else None
        if command == "set_attr":
            self.attributes[data[0]] = data[1]
        elif command == "reset":
            # Nothing came before the first observation that could be told of
            self.last_obs, self.n_frozen, self.unreported = answer[0], 0, None
        elif command == "step" and answer is None:
            answer = self._report()
        elif command == "step":
            self.last_obs, self.n_frozen = answer[0], answer[3].get("frozen_frames", 0)
            self.faults_in_a_row = 0
        return answer

    def expect(self) -> Any:
        """
        :return: The answer to the last request
        :raises EnvFaultError: If there is none
        """
        answer = self._answer()
        if isinstance(answer, EnvFaultError):
            raise answer
        return answer

    def _ask(self, request: tuple[str, Any]) -> Any:
        self.send(request)
        return self.expect()

    def _is_over(self) -> bool:
        """Whether the episode in which a step is to be made was lost."""
        return self._request[0] == "step" and self.unreported is not None

    def _report(self) -> tuple[Any, float, bool, dict[str, Any], dict[str, Any]]:
        """What the step returns in which an environment was lost."""
        sentence, (observation, reset_info) = self.unreported  # type: ignore[misc]
        info = {
            "env_fault": sentence,
            "env_fault_steps": 1 + self.n_frozen,
            "TimeLimit.truncated": True,
            "terminal_observation": self.last_obs,
        }
        self.last_obs, self.n_frozen, self.unreported = observation, 0, None
        return observation, 0.0, True, info, reset_info

    def _answer(self) -> Any:
        """
        :return: The answer to the last request; or what went wrong in it, after which the worker has been stopped if it
            is lost. Not raised, because a process that is forked while an exception is handled repeats it in its own
            tracebacks
        """
        if self.fault is not None:
            return self.fault
        command = self._request[0]
        try:
            # Not its sentinel, which with forkserver tells of the server's end too
            if not self.connection.poll(max(0.0, self._deadline - time.monotonic())):
                name, seconds = self._time_out, getattr(self.owner, self._time_out)
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
        self._n_unread -= 1
        if isinstance(answer, _Failure):
            when = " when it was made" if command == "get_spaces" else f" in {command}"
            what = answer.what + (when if answer.details else "")
            if command in _EPISODE_COMMANDS:
                return self._lost(what, answer.details)
            return EnvFaultError(self.index, what, "ask for what the environment has and takes.", answer.details)
        # Restored environments begin with a step
        self._is_starting &= command not in ("reset", "step")
        return answer

    def _lost(self, what: str, details: str = "") -> EnvFaultError:
        if self._request[0] == "get_spaces" and self.restarts == 0:
            fix = "mend what makes it; a script that starts workers needs `if __name__ == '__main__':`."
        elif self.owner.on_env_fault == "restart":
            fix = "its worker is replaced, and training goes on without this transition."
        else:
            fix = "pass on_env_fault='restart' to replace its worker and go on, or mend the cause."
        fault = EnvFaultError(self.index, what, fix, details)
        self.stop(fault)
        return fault

    def _restart(self, fault: EnvFaultError) -> list[Any]:
        """
        Start a new process and its first episode; the next step reports it.

        :return: First observation and its info
        :raises EnvFaultError: If workers are not to be replaced (any more), or this environment fails again and again
        """
        if self.owner.on_env_fault == "raise" or self.owner.closed:
            raise fault
        latest = fault
        begun: list[Any] = []
        while not begun:
            self.stop(latest)
            self.faults_in_a_row += 1
            if self.faults_in_a_row > self.owner.max_faults:
                what = f"failed {self.faults_in_a_row} times without a good step in between, and at last {latest.what}"
                raise EnvFaultError(self.index, what, "mend the cause, or raise max_faults.", latest.details) from fault
            self.restarts += 1
            details = f"\n{latest.details}" if latest.details else ""
            warnings.warn(f"{latest} This is restart {self.restarts}.{details}", RuntimeWarning, stacklevel=2)
            try:
                begun = self._begin_again()
            except EnvFaultError as another:
                latest = another
        self.unreported = [str(fault), begun]
        return begun

    def _begin_again(self) -> list[Any]:
        seed = self.seed
        if seed is not None:
            # Not the same again: it would repeat the episode, and whatever made it fail.
            seed = int(np.random.SeedSequence([seed, self.restarts]).generate_state(1)[0])
        self.start(again=True)
        self._ask(("get_spaces", None))
        for attribute in self.attributes.items():
            self._ask(("set_attr", attribute))
        return list(self._ask(("reset", (seed, self.options))))


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
    ``replay_buffer_class=sb3_cure.data.buffers.SkippingReplayBuffer``. On-policy ones see a truncated episode.

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
        self.remotes = []
        try:
            for index, env_fn in enumerate(env_fns):
                self.remotes.append(_Worker(self, index, env_fn))
            for worker in self.remotes:
                worker.send(("get_spaces", None))
            env_spaces = [worker.expect() for worker in self.remotes]
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
        """
        :return: First observations
        :raises EnvFaultError: If an environment failed and is not to be replaced, or failed again and again
        """
        self.waiting = False
        return super().reset()

    def state_dict(self) -> dict[str, Any]:
        """For exact resume.

        :return: What is remembered of workers, beside what their environments tell of themselves
        """
        workers = [{name: getattr(worker, name) for name in _STATE} for worker in self.remotes]
        return {"seeds": self._seeds, "options": self._options, "workers": workers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        self._seeds, self._options = state["seeds"], state["options"]
        for worker, own in zip(self.remotes, state["workers"], strict=True):
            for attribute in own["attributes"].items():
                worker.send(("set_attr", attribute))
                worker.recv()
            vars(worker).update(own)

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


# Attributes of a worker that a resumed training needs
_STATE = ("attributes", "seed", "options", "restarts", "faults_in_a_row", "last_obs", "n_frozen", "unreported")
