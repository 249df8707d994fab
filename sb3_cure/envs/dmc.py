"""DeepMind Control tasks as Gymnasium environments that are seen through pixels."""

import difflib
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from sb3_cure.envs.backgrounds import Background, Seed
from sb3_cure.envs.physics import Proprioception
from sb3_cure.envs.registration import DMC_TASKS, ENTRY_POINT, dmc_env_id
from sb3_cure.envs.wrappers import ActionRepeat, NormalizeActions, PixelObservation, StackFrames

# PlaNet's (Hafner et al., 2019), which SAC-AE, CURL and DrQ use too; 4 for all other domains.
ACTION_REPEATS = {"cartpole": 8, "finger": 2, "walker": 2}
# Camera 0 of the quadruped does not follow it; 0 for all other domains.
CAMERAS = {"quadruped": 2}
# All other tasks end by themselves after 1000 steps of physics.
STEP_LIMITS = {"lqr": 1000}
RENDER_FLAGS: dict[str, dict[str, bool]] = {"dmc": {}, "fast": {"shadow": False, "reflection": False}}
VIDEO_SIZE = 256


class DMCPixels(PixelObservation):
    """
    Observes a dm_control environment through one of its cameras.

    ``render()`` is left to the environment, so that videos can have another size than the observations.

    :param env: An environment of shimmy that has not rendered yet
    :param image_size: Height and width of the observation in pixels
    :param grayscale: One channel of luminance instead of three of RGB
    :param camera_id: Index of a camera of the model, -1 for its free camera
    :param renderer: ``"dmc"`` or ``"fast"``, see :func:`make_dmc_env`
    :param background: What is seen in place of sky and floor, see :func:`make_dmc_env`
    :param seed: Of the background
    :raises ValueError: If there is no such background, or, when first reset, if the model has no such camera
    """

    def __init__(
        self,
        env: gym.Env,
        image_size: int = 84,
        grayscale: bool = False,
        camera_id: int = 0,
        renderer: str = "dmc",
        background: str | None = None,
        seed: Seed = None,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(
            self,
            image_size=image_size,
            grayscale=grayscale,
            camera_id=camera_id,
            renderer=renderer,
            background=background,  # but no seed: what was drawn from it is part of the state
        )
        super().__init__(env, image_size, grayscale)
        self.renderer = renderer
        self.camera_id = camera_id
        self._physics = env.get_wrapper_attr("physics")
        self._camera: Any = None
        # These take effect because the rendering context is made with the first frame.
        buffer = self._physics.model.vis.global_
        buffer.offwidth = max(buffer.offwidth, self.image_size)
        buffer.offheight = max(buffer.offheight, self.image_size)
        self.background = None if background is None else Background(background, self._physics, self.image_size, seed)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        if self.background is not None:
            self.background.begin(seed)
        return super().reset(seed=seed, options=options)

    def frame(self) -> np.ndarray:
        if self._camera is None:
            from dm_control.mujoco import Camera

            # The same pixels as `physics.render`, which builds such a camera, and frees it, for every frame.
            self._camera = Camera(self._physics, self.image_size, self.image_size, self.camera_id)
        flags = RENDER_FLAGS[self.renderer]
        if self.background is None:
            return self._camera.render(render_flag_overrides=flags)
        mask = self.background.mask(self._camera)  # before the frame, which lies where the camera draws next
        return self.background.behind(self._camera.render(render_flag_overrides=flags), mask)

    def __getstate__(self) -> dict[str, Any]:
        """Copies make a camera of their own with their first frame."""
        return {**self.__dict__, "_camera": None}

    def close(self) -> None:
        self._camera = None
        super().close()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The background's; all else that frames depend on is the physics'
        """
        return {} if self.background is None else self.background.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        if self.background is not None:
            self.background.load_state_dict(state)


class DMCSensors(gym.ObservationWrapper[dict[str, np.ndarray], Any, Any], gym.utils.RecordConstructorArgs):
    """
    Observes a dm_control environment through cameras, and through the joints of the robot itself.

    :param env: An environment of shimmy that has not rendered yet
    :param cameras: By the key of its images, the index of each camera
    :param proprioception: Whether there is a key ``"proprioception"``: what
        :class:`~sb3_cure.envs.physics.Proprioception` gives
    :param image_size: Height and width of the images in pixels
    :param seed: Of the backgrounds
    :param kwargs: Further arguments of :class:`DMCPixels`
    """

    def __init__(
        self,
        env: gym.Env,
        cameras: dict[str, int],
        proprioception: bool,
        image_size: int = 84,
        seed: int | None = None,
        **kwargs: Any,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(
            self,
            cameras=list(cameras.items()),
            proprioception=proprioception,
            image_size=image_size,
            **kwargs,  # but no seed, as of `DMCPixels`
        )
        super().__init__(env)
        self._cameras = {
            key: DMCPixels(env, image_size, camera_id=index, seed=own, **kwargs)
            for (key, index), own in zip(cameras.items(), _apart(seed, len(cameras)), strict=True)
        }
        self._joints = Proprioception(env) if proprioception else None
        first = next(iter(self._cameras.values()))
        self.image_size, self.renderer = first.image_size, first.renderer
        parts: list[tuple[str, gym.Space]] = [(key, each.observation_space) for key, each in self._cameras.items()]
        if self._joints is not None:
            #: Names of the joints' positions and velocities
            self.proprioception_names = self._joints.names
            parts.append(("proprioception", gym.spaces.Box(-np.inf, np.inf, (len(self._joints.names),), np.float32)))
        self.observation_space = gym.spaces.Dict(parts)  # type: ignore[assignment]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        for camera, own in zip(self._cameras.values(), _apart(seed, len(self._cameras)), strict=True):
            if camera.background is not None:
                camera.background.begin(own)
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Any) -> dict[str, np.ndarray]:
        seen = {key: camera.observation(observation) for key, camera in self._cameras.items()}
        return seen if self._joints is None else {**seen, "proprioception": self._joints()}

    def close(self) -> None:
        for camera in self._cameras.values():
            camera._camera = None
        super().close()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The cameras'; all else that observations depend on is the physics'
        """
        return {key: camera.state_dict() for key, camera in self._cameras.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Result of ``state_dict``
        """
        for key, camera in self._cameras.items():
            camera.load_state_dict(state[key])


def _apart(seed: int | None, n_cameras: int) -> list[Seed]:
    """Seeds of the cameras' backgrounds; that of the first is the seed itself, as if it were the only one."""
    return [seed if position == 0 or seed is None else [seed, position] for position in range(n_cameras)]


def make_dmc_env(
    domain: str,
    task: str,
    *,
    image_size: int = 84,
    frame_stack: int = 3,
    action_repeat: int | None = None,
    camera_id: int | None = None,
    renderer: str = "dmc",
    render_mode: str | None = None,
    seed: int | None = None,
    grayscale: bool = False,
    background: str | None = None,
    cameras: Sequence[int] | None = None,
    proprioception: bool = False,
) -> gym.Env:
    """
    Make a task of the DeepMind Control suite that is seen through pixels.

    Observations are uint8 of shape (3 x frame_stack, image_size, image_size), oldest frame first; the first frame is
    repeated at reset, and one frame is rendered per agent step. Actions are float32 in [-1, 1]. Episodes last 1000
    environment steps and end by truncation. ``unwrapped`` is shimmy's ``DmControlCompatibilityV0``.

    With ``cameras`` or ``proprioception`` observations are dictionaries, for ``"MultiInputPolicy"``: such images under
    ``"image"``, or ``"camera0"``, ``"camera1"``, ... (by their indices), and what the robot tells of itself under
    ``"proprioception"``.

    :param domain: Domain of the suite, such as ``"cartpole"``
    :param task: Task of that domain, such as ``"swingup"``
    :param image_size: Height and width of the observation in pixels
    :param frame_stack: Number of frames in an observation
    :param action_repeat: Environment steps per agent step, whose rewards are summed; by default PlaNet's: 8 for
        cartpole, 2 for finger and walker, 4 for the others
    :param camera_id: Index of a camera of the model, -1 for its free camera; by default 0, and 2 for quadruped
    :param renderer: ``"dmc"`` gives the pixels of ``physics.render``; ``"fast"`` leaves out shadows and reflections,
        which is several times faster without a GPU and shows other pixels: another environment
    :param render_mode: ``"rgb_array"`` lets ``render()`` give RGB frames of 256 x 256 for videos; it does not change
        the observations
    :param seed: Seed of the first ``reset`` that is given none; later ones go on with its random stream
    :param grayscale: One channel of luminance per frame instead of three of RGB
    :param background: What is seen behind the robot in place of sky, floor and walls: ``"noise"``, random pixels that
        are new in each frame, or a folder of images, one of which is drawn for each episode. Drawn by ``seed``, apart
        from the task, and not shown in videos
    :param cameras: Indices of several cameras, each rendered once per agent step; ``camera_id`` (by default the first
        of them) is then that of videos alone
    :param proprioception: Whether positions and velocities of the robot's own joints are observed, too; neither those
        of objects and targets nor where the robot is (see :class:`~sb3_cure.envs.physics.Proprioception`)
    :return: The environment; ``get_wrapper_attr`` finds its ``image_size``, ``frame_stack``, ``action_repeat`` and
        ``renderer``
    :raises ValueError: If there is no such task or an argument is out of range
    :raises GLUnavailableError: If OpenGL is missing
    """
    if task not in DMC_TASKS.get(domain, ()):
        known = [f"{each}-{its_task}" for each, tasks in DMC_TASKS.items() for its_task in tasks]
        close = ", ".join(difflib.get_close_matches(f"{domain}-{task}", known, cutoff=0.0))
        raise ValueError(
            f"'{domain}-{task}' is not a task of the DeepMind Control suite; the closest are {close} "
            "(sb3_cure.envs.DMC_TASKS has all)."
        )
    if renderer not in RENDER_FLAGS:
        raise ValueError(f"renderer={renderer!r} is unknown; use 'dmc', or 'fast' for no shadows and reflections.")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode={render_mode!r} is not supported; use 'rgb_array', or None for no videos.")
    action_repeat = ACTION_REPEATS.get(domain, 4) if action_repeat is None else action_repeat
    if camera_id is None:
        camera_id = cameras[0] if cameras else CAMERAS.get(domain, 0)

    from sb3_cure.envs.rendering import load_gl

    load_gl()
    import shimmy  # noqa: F401  (registers dm_control/... and imports dm_control, hence not before load_gl)

    env = gym.make(
        f"dm_control/{domain}-{task}-v0",
        max_episode_steps=STEP_LIMITS.get(domain),
        disable_env_checker=True,
        # lqr draws the stiffness of its springs when it is built: an id must mean the same physics every time.
        task_kwargs={"random": 0},
        render_mode=render_mode,
        render_kwargs={
            "height": VIDEO_SIZE,
            "width": VIDEO_SIZE,
            "camera_id": camera_id,
            "render_flag_overrides": RENDER_FLAGS[renderer],
        },
    )
    base: Any = env.unwrapped
    base.np_random = np.random.RandomState(seed)
    # What nobody sees would be computed in every step of physics: a tenth of cartpole's time in 36 px.
    base.task.get_observation = _no_observation
    base.observation_space = gym.spaces.Dict()
    # shimmy's own, shared by all of its environments, has other modes and control_timestep x 1000 for its rate.
    base.metadata = {"render_modes": ["rgb_array"], "render_fps": 1 / base.control_timestep()}
    # As gymnasium.make would set it, so that loggers and copies see this environment and not the one underneath.
    base.spec = EnvSpec(
        dmc_env_id(domain, task),
        entry_point=ENTRY_POINT,
        order_enforce=False,
        disable_env_checker=True,
        kwargs=dict(
            domain=domain,
            task=task,
            image_size=image_size,
            frame_stack=frame_stack,
            action_repeat=action_repeat,
            camera_id=camera_id,
            renderer=renderer,
            render_mode=render_mode,
            seed=seed,
            grayscale=grayscale,
            background=background,
            cameras=cameras,
            proprioception=proprioception,
        ),
    )
    env = NormalizeActions(ActionRepeat(env, action_repeat))
    seen: dict[str, Any] = dict(grayscale=grayscale, renderer=renderer, background=background, seed=seed)
    if cameras or proprioception:
        views = {f"camera{index}": index for index in cameras} if cameras else {"image": camera_id}
        env = DMCSensors(env, views, proprioception, image_size, **seen)
    else:
        env = DMCPixels(env, image_size, camera_id=camera_id, **seen)
    return StackFrames(env, frame_stack)


def _no_observation(physics: Any) -> dict[str, Any]:
    """In place of a task's own: observations are what the cameras see."""
    return {}


# With this gymnasium.make shows the frames of "rgb_array" in a window (needs pygame) when it is asked for "human".
make_dmc_env.metadata = {"render_modes": ["rgb_array"]}  # type: ignore[attr-defined]
