"""The Gymnasium ids of the DeepMind Control tasks."""

import gymnasium as gym

# Every task of ``dm_control.suite.ALL_TASKS``, written out so that registering the ids does not import dm_control.
DMC_TASKS: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "lqr": ("lqr_2_1", "lqr_6_2"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
}

ENTRY_POINT = "sb3_cure.envs.dmc:make_dmc_env"


def dmc_env_id(domain: str, task: str) -> str:
    """Name the Gymnasium id of a task that is seen through pixels.

    :param domain: Domain of the DeepMind Control suite, such as ``"cartpole"``
    :param task: Task of that domain, such as ``"swingup"``
    :return: The id
    """
    return f"dmc_pixels/{domain}-{task}-v0"


def register_dmc_envs() -> None:
    """Register ``dmc_pixels/<domain>-<task>-v0`` for every task of the DeepMind Control suite, unless that is done.

    The keyword arguments of ``gymnasium.make`` are those of :func:`~sb3_cure.envs.make_dmc_env`. Neither a time limit
    nor an order check is registered, because the environment underneath has both.
    """
    for domain, tasks in DMC_TASKS.items():
        for task in tasks:
            env_id = dmc_env_id(domain, task)
            if env_id not in gym.registry:
                gym.register(
                    env_id, entry_point=ENTRY_POINT, order_enforce=False, kwargs={"domain": domain, "task": task}
                )
