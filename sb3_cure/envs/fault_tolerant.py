"""Environments in worker processes that may fail: what goes wrong in one is noticed, told, and can be survived."""

import multiprocessing as mp
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partialmethod
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped
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

from sb3_cure.envs.wrappers import action_repeat_of
from sb3_cure.values import is_integer

# Seconds that a worker is given to leave by itself when the environments are closed or the parent is gone, and after
# SIGKILL.
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


class _FrameFault(Exception):
    """A frame that cannot be right."""


@dataclass(frozen=True)
class _Watch:
    """What a worker looks at in its frames; see ``FaultTolerantSubprocVecEnv``."""

    allow_black_frames: bool
    frozen_steps: int | None
    frozen_motion: float
    state: Callable[[gym.Env], np.ndarray] | None


class _FrameWatcher:
    """Looks at the newest frame of each observation, beside the physics."""

    def __init__(self, env: gym.Env, watch: _Watch) -> None:
        self.env, self.watch = env, watch
        space = env.observation_space
        self.sees_images = isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3
        frame_stack = _attribute(env, "frame_stack", 1)
        self.frame_stack = frame_stack if is_integer(frame_stack, 1) else 1  # others may mean something else by it
        # Agent steps
        self.patience = None if watch.frozen_steps is None else watch.frozen_steps / action_repeat_of(env)
        self.state = watch.state
        if self.state is None and hasattr(getattr(_attribute(env, "physics", None), "data", None), "qpos"):
            self.state = _joint_positions
        self._frame: np.ndarray | None = None
        self._position = np.zeros(0)
        self._n_same = self._n_moving = 0

    @property
    def suspect(self) -> int:
        """How many of the latest steps showed the same pixels, if anything moved meanwhile."""
        return self._n_same if self._n_moving else 0

    def check(self, observation: Any, of_step: bool) -> None:
        """
        :param observation: What the environment returned
        :param of_step: Whether that was of a step, and not of a reset
        :raises _FrameFault: If it is of another shape than its space, or its newest frame is black, or does not show
            that the physics moves
        """
        space = self.env.observation_space
        if isinstance(space, spaces.Box) and np.shape(observation) != space.shape:
            shape = np.shape(observation)
            raise _FrameFault(f"returned an observation of shape {shape}, but its space is of shape {space.shape}")
        if not self.sees_images:
            return
        # As in SB3, the smallest of the three dimensions tells where the channels are.
        axis = 2 if observation.shape[2] < min(observation.shape[:2]) else 0
        oldest, left_over = divmod(observation.shape[axis] * (self.frame_stack - 1), self.frame_stack)
        frame = observation if left_over else observation[(slice(None),) * axis + (slice(oldest, None),)]
        if not self.watch.allow_black_frames and not frame.any():
            raise _FrameFault(
                "returned a black frame, so that rendering has failed (pass allow_black_frames=True if it may be dark)"
            )
        if self.patience is None or self.state is None:
            return
        position = np.array(self.state(self.env), dtype=np.float64)
        if self._frame is None or not np.array_equal(frame, self._frame):
            self._frame, self._n_same, self._n_moving = frame.copy(), 0, 0
        else:
            self._n_same += of_step
            self._n_moving += bool(np.abs(position - self._position).max(initial=0.0) > self.watch.frozen_motion)
        self._position = position
        if self._n_moving >= self.patience:
            raise _FrameFault(
                f"returned the same pixels {self._n_same} times in a row while its physics moved, so that rendering is "
                "stuck (raise frozen_steps if its camera sees so little)"
            )


def _attribute(env: gym.Env, name: str, default: Any) -> Any:
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else default


def _joint_positions(env: gym.Env) -> np.ndarray:
    """What of the state of dm_control can be seen, not wrapped to one turn: a jump from pi to -pi would be a motion."""
    return env.get_wrapper_attr("physics").data.qpos


class _Environment:
    """Does in the worker what the commands of SB3's ``SubprocVecEnv`` ask for, one method each."""

    def __init__(self, env_fn: Callable[[], gym.Env], watch: _Watch) -> None:
        self.env = _patch_env(env_fn())
        self.watcher = _FrameWatcher(self.env, watch)
        self.reset_info: dict[str, Any] = {}

    def get_spaces(self, _: None) -> tuple[spaces.Space, spaces.Space]:
        return self.env.observation_space, self.env.action_space

    def reset(self, seed_and_options: tuple[int | None, dict[str, Any] | None]) -> tuple[Any, dict[str, Any]]:
        seed, options = seed_and_options
        observation, self.reset_info = self.env.reset(seed=seed, **({"options": options} if options else {}))
        self.watcher.check(observation, of_step=False)
        return observation, self.reset_info

    def step(self, action: Any) -> tuple[tuple[Any, Any, bool, dict[str, Any], dict[str, Any]], int]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.watcher.check(observation, of_step=True)
        info["TimeLimit.truncated"] = truncated and not terminated
        if terminated or truncated:
            info["terminal_observation"] = observation
            observation, _ = self.reset((None, None))
        return (observation, reward, terminated or truncated, info, self.reset_info), self.watcher.suspect

    def render(self, _: None) -> Any:
        return self.env.render()

    def env_method(self, call: tuple[str, tuple[Any, ...], dict[str, Any]]) -> Any:
        name, arguments, keywords = call
        return self.env.get_wrapper_attr(name)(*arguments, **keywords)

    def get_attr(self, name: str) -> Any:
        return self.env.get_wrapper_attr(name)

    def has_attr(self, name: str) -> bool:
        try:
            self.env.get_wrapper_attr(name)
        except AttributeError:
            return False
        return True

    def set_attr(self, name_and_value: tuple[str, Any]) -> None:
        setattr(self.env, *name_and_value)

    def watcher_state(self, _: None) -> dict[str, Any]:
        """What it remembers of the steps before."""
        return {name: getattr(self.watcher, name) for name in ("_frame", "_position", "_n_same", "_n_moving")}

    def load_watcher_state(self, state: dict[str, Any]) -> None:
        vars(self.watcher).update(state)

    def is_wrapped(self, wrapper_class: type[gym.Wrapper]) -> bool:
        return is_wrapped(self.env, wrapper_class)


def _leave_with_parent() -> None:
    """End this process a while after the parent is gone, as one that hangs in a step sees no end of its pipe."""
    parent = mp.parent_process()
    if parent is not None:
        parent.join()
        time.sleep(CLOSE_SECONDS)
        os._exit(1)


def _work(
    remote: Connection,
    inherited: Sequence[Connection],
    env_fn: CloudpickleWrapper,
    watch: CloudpickleWrapper,
    again: bool,
) -> None:
    """
    The worker process: answers (number, answer, None), or (number, None, what is told of an error).

    :param remote: Its end of the pipe
    :param inherited: Ends that belong to the parent, which a forked process holds too; then it would not see it die
    :param env_fn: Makes the environment
    :param watch: A ``_Watch``
    :param again: Whether there was another worker for this environment before
    """
    for connection in inherited:
        connection.close()
    # Ctrl-C reaches all processes of a terminal, and SIGTERM all of a job, but what they mean is up to the parent.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    if again:
        # Or its Monitor would empty the file with the episodes before the fault.
        Monitor.__init__ = partialmethod(Monitor.__init__, override_existing=False)  # type: ignore[assignment]
    environment: _Environment | None = None
    while True:
        try:
            number, command, data = remote.recv()
        except (EOFError, OSError):
            break
        if command == "close":
            break
        try:
            if environment is None:
                environment = _Environment(env_fn.var, watch.var)
            remote.send((number, getattr(environment, command)(data), None))
        except BaseException as error:
            is_frame_fault = isinstance(error, _FrameFault)
            what = str(error) if is_frame_fault else f"raised {error!r}"
            details = "" if is_frame_fault else traceback.format_exc()
            try:
                remote.send((number, None, (what, details, isinstance(error, AttributeError))))
            except OSError:
                break
    if environment is not None:
        environment.env.close()


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
        self.fault: EnvFaultError | None = None
        self._number = 0
        self.start(again=False)

    def start(self, again: bool) -> None:
        """
        :param again: Whether there was another process before
        """
        context = self.owner.context
        others = [worker.connection for worker in self.owner.remotes if worker is not self and worker.fault is None]
        self.connection, remote = context.Pipe()
        inherited = [self.connection, *others] if context.get_start_method() == "fork" else []
        arguments = (remote, inherited, CloudpickleWrapper(self.env_fn), CloudpickleWrapper(self.owner.watch), again)
        try:
            self.process = context.Process(target=_work, args=arguments, daemon=True)
            self.process.start()
            # At the parent's exit multiprocessing sends SIGTERM to daemons, which they ignore, and waits for them
            self._kill_at_exit = Finalize(self, self.process.kill, exitpriority=0)
        finally:
            remote.close()
        self.fault = None
        self._starting = True

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
        self._number += 1
        self._request = request
        self._deadline = time.monotonic() + self._patience[1]
        if self.fault is None:
            try:
                self.connection.send((self._number, *request))
            except OSError:
                pass  # it is dead, as `answer` will find

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
        if self.fault is not None:
            return self.fault
        reply = self._read()
        if isinstance(reply, str):
            return self._lost(reply)
        answer, error = reply
        command = self._request[0]
        if error is not None:
            what, details, is_attribute = error
            if details:
                what += " when it was made" if command == "get_spaces" else f" in {command}"
            if command in _EPISODE_COMMANDS:
                return self._lost(what, details)
            sentence = EnvFaultError(self.index, what, "ask for what the environment has and takes.", details)
            if is_attribute:
                raise AttributeError(str(sentence)) from sentence
            raise sentence
        # Restored environments begin with a step
        self._starting &= command not in ("reset", "step")
        return answer

    def _read(self) -> tuple[Any, Any] | str:
        """Answer and error that belong to the last request, or what happened to the process."""
        command = self._request[0]
        number = 0
        while number < self._number:  # answers to requests that were given up (by Ctrl-C, say) are dropped
            try:
                # Not its sentinel, which with forkserver tells of the server's end too
                if not self.connection.poll(max(0.0, self._deadline - time.monotonic())):
                    name, seconds = self._patience
                    return (
                        f"did not answer {command} within {name}={seconds:g} s (rendering or the environment hangs; "
                        f"raise {name} if it is only slow)"
                    )
                number, answer, error = self.connection.recv()
            except (EOFError, OSError):
                self.process.join(KILL_SECONDS)
                code = self.process.exitcode
                how = (
                    f"was killed by {signal.Signals(-code).name}" if code and code < 0 else f"ended with status {code}"
                )
                return f"is lost, as its process {how} during {command}"
        return answer, error

    @property
    def _patience(self) -> tuple[str, float]:
        """The time-out that holds now, and its seconds."""
        name = "start_timeout" if self._starting else "timeout"
        return name, getattr(self.owner, name)

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
    are uint8 images: a newest frame that is black, and one that stays the same, bit for bit, while the physics moves.
    Nothing that is asked of these environments waits longer, neither attributes nor pictures nor ``close``.

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
    :param allow_black_frames: Whether a frame of zeros is all right
    :param frozen_steps: Environment steps (agent steps times ``action_repeat``) with the same pixels during which the
        physics moves in each agent step that make a fault; None: not looked at. In the DeepMind Control suite a
        cartpole that leaves the view of its camera shows the same pixels for up to 100 environment steps
    :param frozen_motion: What a motion is: the greatest change of a coordinate in one agent step, metres or radians
    :param state: What can be seen of an environment's state: by default the positions of dm_control's joints, and
        nothing for other environments, whose frames are then never taken to be stuck
    :raises ValueError: If an argument is out of range
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
        allow_black_frames: bool = False,
        frozen_steps: int | None = 200,
        frozen_motion: float = 0.01,
        state: Callable[[gym.Env], np.ndarray] | None = None,
    ) -> None:
        if not isinstance(env_fns, Sequence) or not all(map(callable, env_fns)):
            raise ValueError(
                f"env_fns is {env_fns!r:.200}, but each worker makes its own environment: pass a list of functions, "
                "say [lambda: make_dmc_env('cartpole', 'swingup')] * 4."
            )
        if not env_fns:
            raise ValueError("env_fns is empty, but there must be an environment: pass one function for each.")
        _check_positive(
            timeout=timeout, start_timeout=start_timeout, max_faults=max_faults, frozen_motion=frozen_motion
        )
        if frozen_steps is not None:
            _check_positive(frozen_steps=frozen_steps)
        if on_env_fault not in ("raise", "restart"):
            raise ValueError(f"on_env_fault={on_env_fault!r} is unknown: use 'raise', or 'restart' to go on training.")
        known = mp.get_all_start_methods()
        if start_method is None:
            start_method = "forkserver" if "forkserver" in known else "spawn"
        if start_method not in known:
            raise ValueError(f"start_method={start_method!r} is unknown: use one of {', '.join(known)}, or None.")
        self.context: Any = mp.get_context(start_method)
        self.timeout, self.start_timeout, self.on_env_fault = timeout, start_timeout, on_env_fault
        self.max_faults = max_faults
        self.watch = _Watch(allow_black_frames, frozen_steps, frozen_motion, state)
        self.waiting = self.closed = False
        #: Workers replaced so far, by environment
        self.restarts = [0] * len(env_fns)
        self._faults_in_a_row = [0] * len(env_fns)
        # What a new worker gets: attributes that were set, and seed and options of the last reset that had any
        self._attributes: list[dict[str, Any]] = [{} for _ in env_fns]
        self._last_seeds: list[int | None] = [None] * len(env_fns)
        self._last_options: list[dict[str, Any]] = [{} for _ in env_fns]
        self._last_obs: list[Any] = [None] * len(env_fns)
        # How many of the latest steps of each showed stuck pixels, perhaps: a fault spoils these too
        self._suspect = [0] * len(env_fns)
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
                result, self._suspect[index] = result
                self._faults_in_a_row[index] = 0
                self._last_obs[index] = result[0]
                return result
            self._restart(worker, result)
        sentence, observation = self._unreported[index]  # type: ignore[misc]
        self._unreported[index] = None
        info = {
            "env_fault": sentence,
            "env_fault_steps": 1 + self._suspect[index],
            "TimeLimit.truncated": True,
            "terminal_observation": self._last_obs[index],
        }
        self._last_obs[index], self._suspect[index] = observation, 0
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
        worker.start(again=True)
        for attribute in self._attributes[index].items():
            worker.send(("set_attr", attribute))
            worker.answer()
        seed = self._last_seeds[index]
        if seed is not None:
            # Not the same again: it would repeat the episode, and whatever made it fail.
            seed = int(np.random.SeedSequence([seed, self.restarts[index]]).generate_state(1)[0])
        worker.send(("reset", (seed, self._last_options[index])))
        observation, reset_info = worker.answer()
        self.reset_infos = [*self.reset_infos[:index], reset_info, *self.reset_infos[index + 1 :]]
        return observation

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: Name
        :param value: Value, which a worker that replaces another one gets too
        :param indices: Which environments; None: all
        """
        indices = list(self._get_indices(indices))
        super().set_attr(attr_name, value, indices)
        for index in indices:
            self._attributes[index][attr_name] = value

    def state_dict(self) -> dict[str, Any]:
        """For exact resume.

        :return: What is remembered of workers, beside what their environments tell of themselves
        """
        # First, as it may find a worker dead
        watchers = self._ask("watcher_state", [None] * self.num_envs)
        return {"attributes": self._attributes, "watchers": watchers, **{name: getattr(self, name) for name in _OWN}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        for index, attributes in enumerate(state["attributes"]):
            for name, value in attributes.items():
                self.set_attr(name, value, index)
        self._ask("load_watcher_state", state["watchers"])
        for name in _OWN:
            setattr(self, name, state[name])

    def _ask(self, command: str, data: Sequence[Any]) -> list[Any]:
        for worker, own in zip(self.remotes, data, strict=True):
            worker.send((command, own))
        return [worker.recv() for worker in self.remotes]

    def close(self) -> None:
        """End all workers, within ten seconds or ``timeout``, whichever is less."""
        if self.closed:
            return
        self.closed = True
        deadline = time.monotonic() + min(CLOSE_SECONDS, self.timeout)
        for worker in self.remotes:
            worker.send(("close", None))
        for worker in self.remotes:
            fault = EnvFaultError(worker.index, "has been closed", "make the environments anew.")
            worker.stop(fault, max(0.0, deadline - time.monotonic()))


def _check_positive(**values: Any) -> None:
    """
    :raises ValueError: If one of them is not a number greater than 0, with an integer as the example
    """
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not value > 0:
            usual = _USUAL[name]
            raise ValueError(f"{name}={value!r} is not a number greater than 0: use {name}={usual}, for example.")


# Attributes of the environments that a resumed training needs.
_OWN = (
    *("_seeds", "_options", "restarts", "_faults_in_a_row", "_last_seeds", "_last_options", "_last_obs", "_suspect"),
    "_unreported",
)
_USUAL: Mapping[str, float] = {
    "timeout": 60,
    "start_timeout": 120,
    "max_faults": 3,
    "frozen_steps": 200,
    "frozen_motion": 0.01,
}
