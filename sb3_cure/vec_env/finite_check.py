"""One look at all that environments return, and at the actions that they are sent."""

import inspect
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_wrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_cure.data.observations import image_spaces, images_of

Observations = np.ndarray | dict[str, np.ndarray]

#: Steps with black images alone after which that is warned of
STEPS_IN_THE_DARK = 100


class BadTransitionError(ValueError):
    """A reward, an observation or an action was not finite; it was neither returned nor executed."""


class FiniteCheck(VecEnvWrapper):
    """Lets only numbers through that are finite in float32, in which networks compute and rewards are stored.

    It looks at the observations of resets and steps, at rewards and terminal observations, with a ``VecNormalize`` in
    ``venv`` also at what that has normalised, and at actions. With ``on_bad_transition="raise"`` a bad number is a
    ``BadTransitionError``; reset the environments to go on after it. With ``"skip"``

    - the transition is marked: ``info["bad_transition"]`` says what was wrong, and ``n_bad`` counts it;
    - in place of the number comes the last good observation (zeros after a reset) or the reward 0;
    - the transition that starts from such a stand-in is marked as well;
    - the first bad number of a kind is warned of;
    - the statistics of an episode whose return is not finite are dropped.

    It also warns, once, of images that stay black: floats in [0, 1] are cast to that for a space of uint8.

    :param venv: Environments; if they are in such a check, it is replaced
    :param on_bad_transition: ``"raise"`` or ``"skip"``; actions are never skipped
    :raises ValueError: if transitions are to be skipped, but ``VecNormalize`` would take them before
    """

    def __init__(self, venv: VecEnv, on_bad_transition: str = "raise"):
        super().__init__(venv.venv if isinstance(venv, FiniteCheck) else venv)
        self.skip = on_bad_transition == "skip"
        #: How many transitions were marked
        self.n_bad = 0
        #: How many steps were made, of all environments together
        self.n_steps = 0
        self._warned: set[str] = set()
        # The latest observations that were returned, and which environments returned a bad one in their place
        self._seen: Observations | None = None
        self._stand_ins: npt.NDArray[np.bool_] = np.zeros(self.num_envs, dtype=bool)
        # Keys of images (`""` where observations are images) of which nothing was brighter than black so far
        self._dark = dict.fromkeys(image_spaces(self.observation_space), 0)
        self._steps_in_the_dark = 0
        self._normalizer = unwrap_vec_wrapper(self.venv, VecNormalize)
        if self.skip and self._normalizer is not None:
            raise ValueError(
                "on_bad_transition='skip' was given with VecNormalize, but its running averages take a bad value "
                "before it can be left out: leave on_bad_transition='raise', or use environments without VecNormalize."
            )

    def reset(self) -> VecEnvObs:
        """
        :return: First observations, with ``"skip"`` zeros where they were bad
        :raises BadTransitionError: unless bad ones are skipped
        """
        observations: Any = self.venv.reset()
        bad = self._find_bad("first observation", observations)
        self._seen, self._stand_ins = _replaced(observations, bad, None) if bad.any() else observations, bad
        return self._seen  # type: ignore[return-value]

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: Actions, [n_envs, ...]
        :raises BadTransitionError: if one is not finite; none is executed then
        """
        for i in np.flatnonzero(_not_finite(np.asarray(actions))):
            raise BadTransitionError(
                f"the agent chose the action {actions[i]} for environment {i} at agent step {self.n_steps}, but "
                "actions must be finite: it was not executed; check action_noise and the policy's parameters, and load "
                "an earlier model if these are not finite."
            )
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: Observations, rewards, dones and infos, without a number that is not finite
        :raises BadTransitionError: unless bad transitions are skipped
        """
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        self.n_steps += self.num_envs
        if rewards.dtype == object:  # of worker processes, one of which returned None
            rewards = rewards.astype(np.float32)
        if self._dark:
            self._look_for_light(observations)
        bad_rewards = self._find_bad("reward", rewards)
        bad_ends = np.zeros(self.num_envs, dtype=bool)
        for i in np.flatnonzero(dones):
            bad_ends[i] = self._is_bad("terminal observation", i, infos[i].get("terminal_observation"))
        bad_obs = self._find_bad("observation", observations)
        if not self.skip:
            return observations, rewards, dones, infos

        # Where an episode ended, a bad observation is the first of the next one, with which another transition starts.
        has_end = np.array(["terminal_observation" in info for info in infos]) & dones
        kinds = {
            "bad reward": bad_rewards,
            "bad terminal observation": bad_ends,
            "bad observation": bad_obs & ~has_end,
            "starts from a stand-in of a bad observation": self._stand_ins,
        }
        bad = np.logical_or.reduce(list(kinds.values()))
        self.n_bad += int(bad.sum())
        infos = [_without_bad_episode(info) for info in infos]
        last = _replaced(observations, np.ones_like(bad), None) if self._seen is None else self._seen
        for i in np.flatnonzero(bad):
            infos[i] = {**infos[i], "bad_transition": ", ".join(kind for kind, where in kinds.items() if where[i])}
            if bad_ends[i]:
                infos[i]["terminal_observation"] = _row(last, i)
        if bad_rewards.any():
            rewards = np.where(bad_rewards, 0, rewards).astype(rewards.dtype)
        if bad_obs.any():
            observations = _replaced(observations, bad_obs, last)
        self._seen, self._stand_ins = observations, bad_obs
        return observations, rewards, dones, infos

    def _find_bad(self, kind: str, values: Observations) -> npt.NDArray[np.bool_]:
        """In which environments a value is bad, [n_envs]; raises, or warns of the first of its kind."""
        if self._normalizer is not None:
            # What is stored; clipped, it may look finite.
            normalizer = self._normalizer
            original: Any = normalizer.get_original_reward() if kind == "reward" else normalizer.get_original_obs()
            for i in np.flatnonzero(_not_finite(original)):
                self._is_bad(kind, i, _row(original, i))
        bad = _not_finite(values)
        for i in np.flatnonzero(bad):
            self._is_bad(kind, i, _row(values, i), is_normalized=self._normalizer is not None)
        return bad

    def _is_bad(self, kind: str, i: Any, value: Any, is_normalized: bool = False) -> bool:
        found = _first_bad(value)
        if found is None:
            return False
        source = "VecNormalize made" if is_normalized else f"environment {i} returned"
        what = f"the {kind} {found}" if kind == "reward" else f"the {kind} with {found} in it"
        reason = f"{source} {what} at agent step {self.n_steps}, but {kind}s must be finite in float32"
        if not self.skip:
            fix = "fix the environment"
            if is_normalized:
                fix = "make a new VecNormalize, or load one: its statistics have taken a value that was not finite"
            elif self._normalizer is None:
                fix += ", or leave such transitions out with on_bad_transition='skip'"
            raise BadTransitionError(f"{reason}: it was not stored; {fix}.")
        if kind not in self._warned:
            self._warned.add(kind)
            warnings.warn(
                f"{reason}: the transition is left out (on_bad_transition='skip'), as will be others of this kind, "
                "without a warning; fix the environment.",
                stacklevel=2,
            )
        return True

    def _look_for_light(self, observations: Any) -> None:
        self._steps_in_the_dark += 1
        images = images_of(observations, self.observation_space)
        brightest = {key: int(np.max(images[key])) for key in self._dark}
        self._dark = {key: value for key, value in brightest.items() if value <= 1}
        if self._dark and self._steps_in_the_dark == STEPS_IN_THE_DARK:
            which = f" {', '.join(map(repr, self._dark))}" if any(self._dark) else ""
            warnings.warn(
                f"no pixel of the images{which} so far is brighter than {max(self._dark.values())} of 255, so that the "
                "policy sees black: if the environment returns floats in [0, 1], return "
                "(255 * image).astype(np.uint8) instead.",
                stacklevel=2,
            )
            self._dark = {}

    def __getstate__(self) -> dict[str, Any]:
        """For copies of models: what SB3's wrapper keeps of its class cannot be copied."""
        return {name: value for name, value in vars(self).items() if name != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, class_attributes=dict(inspect.getmembers(type(self))))

    def state_dict(self) -> dict[str, Any]:
        """For exact resume.

        :return: What the steps to come depend on: plain values and arrays
        """
        return {
            "n_bad": self.n_bad,
            "n_steps": self.n_steps,
            "warned": sorted(self._warned),
            "stand_ins": self._stand_ins.tolist(),
            "seen": self._seen if self.skip else None,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        self.n_bad, self.n_steps = state["n_bad"], state["n_steps"]
        self._warned = set(state["warned"])
        self._stand_ins, self._seen = np.array(state["stand_ins"], dtype=bool), state["seen"]


def _is_finite(numbers: np.ndarray) -> npt.NDArray[np.bool_]:
    """As float32: 1e39 is not."""
    with np.errstate(over="ignore"):
        return np.isfinite(numbers.astype(np.float32, copy=False))


def _not_finite(values: Observations) -> npt.NDArray[np.bool_]:
    """Rows in which a number is not finite, [n]."""
    if isinstance(values, dict):
        return np.logical_or.reduce([_not_finite(value) for value in values.values()])
    if not np.issubdtype(values.dtype, np.floating):
        return np.zeros(len(values), dtype=bool)
    return np.logical_not(_is_finite(values.reshape(len(values), -1)).all(axis=1))


def _first_bad(value: Any) -> float | None:
    """The first number that is not finite in an array, or in a dictionary of them."""
    if isinstance(value, dict):
        return next((bad for bad in map(_first_bad, value.values()) if bad is not None), None)
    numbers = np.ravel([] if value is None else value)
    bad = numbers[~_is_finite(numbers)]
    return float(bad[0]) if len(bad) > 0 else None


def _row(values: Any, i: Any) -> Any:
    return {key: value[i] for key, value in values.items()} if isinstance(values, dict) else values[i]


def _replaced(values: Any, rows: npt.NDArray[np.bool_], by: Any) -> Any:
    """A copy with these rows of others, or with zeros in them."""
    if isinstance(values, dict):
        return {key: _replaced(value, rows, None if by is None else by[key]) for key, value in values.items()}
    values = values.copy()
    values[rows] = 0 if by is None else by[rows]
    return values


def _without_bad_episode(info: dict[str, Any]) -> dict[str, Any]:
    """One return that is not finite would make the mean of the next hundred episodes so, too."""
    if np.isfinite((info.get("episode") or {}).get("r", 0)):
        return info
    return {key: value for key, value in info.items() if key != "episode"}
