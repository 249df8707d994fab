"""The true state of a DeepMind Control environment, which agents that see pixels never get.

``physics_state`` is for maps and statistics; ``integration_state`` is all that the simulation continues from.
"""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

# What a joint of each type of MuJoCo (free, ball, slide, hinge) adds to the state: names and units of its positions,
# then of its velocities. "" is the joint itself.
_METRES, _RADIANS = ("m", "m/s"), ("rad", "rad/s")
_PLACE = [("_x", _METRES), ("_y", _METRES), ("_z", _METRES)]
_QUATERNION = [("_qw", ("", "")), ("_qx", ("", "")), ("_qy", ("", "")), ("_qz", ("", ""))]
_ROTATION = [("_rx", _RADIANS), ("_ry", _RADIANS), ("_rz", _RADIANS)]
_POSITIONS = [_PLACE + _QUATERNION, _QUATERNION, [("", _METRES)], [("", _RADIANS)]]
_VELOCITIES = [_PLACE + _ROTATION, _ROTATION, [("", _METRES)], [("", _RADIANS)]]
_FREE, _HINGE = 0, 3

# Two coordinates that show what a task is about, for every environment that has both (else the first two), and what
# they are.
_MAP_COORDINATES = {
    ("hinge_1", "hinge_1_velocity"): ("pole angle (0: upright)", "pole velocity"),  # cartpole
    ("proximal", "hinge_velocity"): ("finger angle (proximal)", "body's hinge velocity"),  # finger
    ("ball_x", "ball_z"): ("ball x", "ball z"),  # ball_in_cup, and the balls of manipulator
    ("shoulder", "wrist"): ("shoulder angle", "wrist angle"),  # reacher
    ("joint_0", "joint_1"): ("joint 0", "joint 1"),  # swimmer, lqr
    ("rootz", "rooty"): ("torso height (from the start's)", "torso pitch"),  # walker, hopper, cheetah
}


# What the tasks of the suite change in MuJoCo's model at reset: targets, obstacles, gains, terrain.
_MODEL_ARRAYS = (
    *("body_pos", "body_quat", "dof_damping", "geom_pos", "geom_rgba", "geom_size", "hfield_data", "light_pos"),
    *("site_pos", "site_rgba", "site_size", "wrap_prm"),
)


def _physics(env: gym.Env) -> Any:
    physics = env.get_wrapper_attr("physics") if env.has_wrapper_attr("physics") else None
    if not hasattr(getattr(physics, "model", None), "jnt_type"):
        raise ValueError(
            f"{env} has no physics of dm_control, so its true state is unknown: use an environment of make_dmc_env, or "
            "give state=lambda env: ... and names=[...] where there are such arguments."
        )
    return physics


def _coordinates(env: gym.Env) -> list[tuple[str, str]]:
    """Name and unit of each coordinate of ``physics_state``."""
    model = _physics(env).model
    joints = [
        (model.id2name(joint, "joint") or f"joint{joint}", int(model.jnt_type[joint])) for joint in range(model.njnt)
    ]
    positions = [(name + part, unit) for name, kind in joints for part, (unit, _) in _POSITIONS[kind]]
    velocities = [(f"{name}{part}_velocity", unit) for name, kind in joints for part, (_, unit) in _VELOCITIES[kind]]
    return positions + velocities


def physics_state_names(env: gym.Env) -> list[str]:
    """Name the coordinates of ``physics_state``.

    :param env: A dm_control environment, such as ``make_dmc_env`` makes, in any wrappers
    :return: What ``physics_state`` gives: MuJoCo's names of the joints, then the same with ``_velocity``
    :raises ValueError: if the environment is not one of dm_control
    """
    return [name for name, _ in _coordinates(env)]


def physics_state_units(env: gym.Env) -> list[str]:
    """Give the unit of each coordinate of ``physics_state``.

    :param env: As for ``physics_state_names``
    :return: Unit of each coordinate: ``"m"``, ``"rad"``, ``"m/s"``, ``"rad/s"``, or ``""`` for parts of quaternions
    :raises ValueError: if the environment is not one of dm_control
    """
    return [unit for _, unit in _coordinates(env)]


def physics_state(env: gym.Env) -> np.ndarray:
    """The true state now: positions and velocities of all joints (MuJoCo's qpos and qvel).

    Angles of joints that can turn all around are wrapped to (-pi, pi].

    :param env: As for ``physics_state_names``
    :return: A copy, float64 [d], in the order of ``physics_state_names``
    :raises ValueError: if the environment is not one of dm_control
    """
    physics = _physics(env)
    positions = np.array(physics.data.qpos, dtype=np.float64)
    model = physics.model
    around = model.jnt_qposadr[(model.jnt_type == _HINGE) & (model.jnt_limited == 0)]
    positions[around] = np.pi - (np.pi - positions[around]) % (2 * np.pi)
    return np.concatenate([positions, physics.data.qvel])


class Proprioception:
    """What a robot of the DeepMind Control suite can sense of itself: positions and velocities of its own joints.

    Encoders in its joints measure neither objects and targets nor the robot's place in the world: the joints of other
    bodies (balls, pegs, boxes, the spinner of finger) and those with which a robot floats (free joints, ``rootx``,
    ``rooty``, ``rootz``) are left out. Slides are in metres, hinges in radians, or as cosine and sine where
    they turn all around; velocities are in metres or radians per second.

    :param env: As for ``physics_state_names``
    :raises ValueError: if the environment is not one of dm_control
    """

    def __init__(self, env: gym.Env):
        self._physics = _physics(env)
        model = self._physics.model
        own = [joint for joint in range(model.njnt) if _is_own(model, joint)]
        around = [joint for joint in own if model.jnt_type[joint] == _HINGE and not model.jnt_limited[joint]]
        bounded = [joint for joint in own if joint not in around]
        self._bounded, self._around = model.jnt_qposadr[bounded], model.jnt_qposadr[around]
        self._dofs = model.jnt_dofadr[own]
        names = {joint: model.id2name(joint, "joint") for joint in own}
        #: Names of what it gives, in that order
        self.names = [names[joint] for joint in bounded]
        self.names += [f"{names[joint]}_{part}" for part in ("cos", "sin") for joint in around]
        self.names += [f"{names[joint]}_velocity" for joint in own]

    def __call__(self) -> np.ndarray:
        """Measure the joints.

        :return: Positions, then velocities, float32 [d], in the order of ``names``
        """
        data = self._physics.data
        angles = data.qpos[self._around]
        parts = data.qpos[self._bounded], np.cos(angles), np.sin(angles), data.qvel[self._dofs]
        return np.concatenate(parts).astype(np.float32)


def _is_own(model: Any, joint: int) -> bool:
    name, body = model.id2name(joint, "joint"), model.id2name(model.jnt_bodyid[joint], "body")
    floats = model.jnt_type[joint] == _FREE or name in ("rootx", "rooty", "rootz")
    return not floats and not body.startswith(("ball", "peg", "box", "spinner"))


def map_coordinates(names: Sequence[str], chosen: Sequence[str] | None = None) -> tuple[str, str]:
    """Return the two coordinates of a map.

    :param names: Names of the state's coordinates, as for ``physics_state_names``
    :param chosen: The two to show; by default those that show best what a task is about, else the first two
    :return: Their names
    :raises ValueError: unless they are two of the names
    """
    pair = chosen or next((pair for pair in _MAP_COORDINATES if set(pair) <= set(names)), names[:2])
    if isinstance(pair, str) or len(pair) != 2 or not set(pair) <= set(names):
        raise ValueError(f"a map needs two coordinates of {', '.join(names)}, not {pair!r}.")
    return pair[0], pair[1]


def coordinate_labels(coordinates: tuple[str, str]) -> tuple[str, str]:
    """Label the axes of a map.

    :param coordinates: Two coordinates of the state, by name
    :return: What to call them on the axes of a map
    """
    return _MAP_COORDINATES.get(coordinates) or (coordinates[0].replace("_", " "), coordinates[1].replace("_", " "))


def is_of_the_suite(control: Any) -> bool:
    """Check whether ``integration_state`` knows all that a task may change.

    :param control: An environment of dm_control, without Gymnasium
    :return: Whether it does
    """
    from dm_control.rl.control import Environment

    return type(control) is Environment and type(control.task).__module__.startswith("dm_control.suite.")


def integration_state(control: Any) -> dict[str, Any]:
    """Get all that the future of an environment depends on.

    :param control: An environment of the DeepMind Control suite, without Gymnasium
    :return: Numbers, arrays and dictionaries of these
    """
    import mujoco

    physics, task = control.physics, control.task
    numbers = (bool, int, float, np.generic, np.ndarray)
    return {
        "physics": physics.get_state(int(mujoco.mjtState.mjSTATE_INTEGRATION)),
        "sensors": np.array(physics.data.sensordata),
        "model": {name: np.array(getattr(physics.model, name)) for name in _MODEL_ARRAYS},
        # Such as heights and weights that it measured at reset.
        "task": {name: copy.copy(value) for name, value in vars(task).items() if isinstance(value, numbers)},
        "random": task.random.get_state(legacy=False),
        "step_count": control._step_count,
        "reset_next_step": control._reset_next_step,
    }


def load_integration_state(control: Any, state: dict[str, Any]) -> None:
    """Restore all that the future of an environment depends on.

    :param control: An environment of the DeepMind Control suite, without Gymnasium
    :param state: Result of ``integration_state`` for the same task
    """
    import mujoco

    physics, task = control.physics, control.task
    for name in _MODEL_ARRAYS:
        getattr(physics.model, name)[:] = state["model"][name]
    for hfield in range(physics.model.nhfield):
        with physics.contexts.gl.make_current() as context:
            context.call(mujoco.mjr_uploadHField, physics.model.ptr, physics.contexts.mujoco.ptr, hfield)
    physics.set_state(state["physics"], int(mujoco.mjtState.mjSTATE_INTEGRATION))
    # dm_control ends a step with this, and the next begins in the middle of one; it leaves the warm start alone.
    mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
    physics.data.sensordata[:] = state["sensors"]  # mj_step1 leaves out the sensors of forces
    vars(task).update(copy.deepcopy(state["task"]))
    task.random.set_state(state["random"])
    control._step_count = state["step_count"]
    control._reset_next_step = state["reset_next_step"]
