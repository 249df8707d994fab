"""DeepMind Control tasks as Gymnasium environments that are seen through pixels."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs

from sb3_cure.envs.backgrounds import Background, Seed
from sb3_cure.envs.physics import Proprioception
from sb3_cure.envs.registration import ENTRY_POINT, dmc_env_id
from sb3_cure.envs.wrappers import ActionRepeat, NormalizeActions, StackFrames, at_least_one, to_image

# PlaNet's (Hafner et al., 2019), which SAC-AE, CURL and DrQ use too; 4 for all other domains.
ACTION_REPEATS = {"cartpole": 8, "finger": 2, "walker": 2}
# Camera 0 of the quadruped does not follow it; 0 for all other domains.
CAMERAS = {"quadruped": 2}
# All other tasks end by themselves after 1000 environment steps.
STEP_LIMITS = {"lqr": 1000}
RENDER_FLAGS: dict[str, dict[str, bool]] = {"dmc": {}, "fast": {"shadow": False, "reflection": False}}
VIDEO_SIZE = 256


class DMCPixels(gym.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Observes a dm_control environment through cameras, and through the joints of the robot.

    ``render()`` is left to the environment, so that videos can have another size than the observations.

    :param env: An environment of shimmy that has not rendered yet
    :param cameras: Index of each camera of the model by the key of its images, -1 for the free camera. The key ``""``,
        alone, stands for observations that are one image and no dictionary
    :param image_size: Height and width of the images in pixels
    :param grayscale: One channel of luminance instead of three of RGB
    :param renderer: ``"dmc"`` or ``"fast"``, see :func:`make_dmc_env`
    :param background: What is seen in place of sky and floor, see :func:`make_dmc_env`
    :param proprioception: Whether there is a key ``"proprioception"`` with the values of
        :class:`~sb3_cure.envs.physics.Proprioception`
    :param seed: Seed of the backgrounds
    :raises ValueError: If there is no such background, or, when first reset, no such camera
    """

    def __init__(
        self,
        env: gym.Env,
        cameras: dict[str, int],
        image_size: int = 84,
        grayscale: bool = False,
        renderer: str = "dmc",
        background: str | None = None,
        proprioception: bool = False,
        seed: int | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(  # without the seed: what was drawn from it is part of the state
            self,
            cameras=list(cameras.items()),
            image_size=image_size,
            grayscale=grayscale,
            renderer=renderer,
            background=background,
            proprioception=proprioception,
        )
        super().__init__(env)
        self.image_size = size = at_least_one("image_size", image_size)
        self.grayscale, self.renderer, self._indices = grayscale, renderer, cameras
        self._physics = env.get_wrapper_attr("physics")
        # These take effect because the rendering context is made with the first frame.
        buffer = self._physics.model.vis.global_
        buffer.offwidth, buffer.offheight = max(buffer.offwidth, size), max(buffer.offheight, size)
        self._cameras: dict[str, Any] = {}
        self._backgrounds: dict[str, Background] = {}
        if background is not None:
            for key, own in zip(cameras, self._background_seeds(seed), strict=True):
                self._backgrounds[key] = Background(background, self._physics, size, own)
        image = spaces.Box(0, 255, (1 if grayscale else 3, size, size), np.uint8)
        parts: list[tuple[str, gym.Space]] = [(key, image) for key in cameras]
        self._joints = Proprioception(env) if proprioception else None
        if self._joints is not None:
            #: Names of the joints' positions and velocities
            self.proprioception_names = self._joints.names
            parts.append(("proprioception", spaces.Box(-np.inf, np.inf, (len(self._joints.names),), np.float32)))
        self.observation_space = image if "" in cameras else spaces.Dict(parts)

    def _background_seeds(self, seed: int | None) -> list[Seed]:
        """Derive a seed for each camera; that of the first is the seed itself, as if it were the only one."""
        return [seed if seed is None or position == 0 else [seed, position] for position in range(len(self._indices))]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and draw the backgrounds of an episode.

        :param seed: Seed of both; None: continue their random streams
        :param options: Options of the environment
        :return: First observation and info
        """
        for background, own in zip(self._backgrounds.values(), self._background_seeds(seed), strict=False):
            background.begin(own)
        return super().reset(seed=seed, options=options)

    def frame(self, key: str = "") -> np.ndarray:
        """Render through one camera.

        :param key: Key of its images
        :return: uint8 [image_size, image_size, 3]
        """
        if key not in self._cameras:
            from dm_control.mujoco import Camera

            # The same pixels as `physics.render`, which makes such a camera, and frees it, for every frame.
            self._cameras[key] = Camera(self._physics, self.image_size, self.image_size, self._indices[key])
        camera, flags, background = self._cameras[key], RENDER_FLAGS[self.renderer], self._backgrounds.get(key)
        if background is None:
            return camera.render(render_flag_overrides=flags)
        mask = background.mask(camera)  # before the frame, which is in the array that the camera draws into next
        return background.behind(camera.render(render_flag_overrides=flags), mask)

    def observation(self, observation: Any) -> Any:
        """Render through all cameras, and measure the joints.

        :param observation: The environment's own, unused
        :return: An image, uint8 [channels, image_size, image_size], or a dictionary
        """
        seen = {key: to_image(self.frame(key), self.image_size, self.grayscale) for key in self._indices}
        if "" in seen:
            return seen[""]
        return seen if self._joints is None else {**seen, "proprioception": self._joints()}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the cameras: a copy makes its own with its first frame."""
        return {**self.__dict__, "_cameras": {}}

    def close(self) -> None:
        """Free the cameras, and close the environment."""
        self._cameras = {}
        super().close()

    def state_dict(self) -> dict[str, Any]:
        """Get the backgrounds' state; all else that frames depend on is the physics'.

        :return: Plain data
        """
        return {key: background.state_dict() for key, background in self._backgrounds.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the backgrounds' state.

        :param state: Result of ``state_dict``
        """
        for key, background in self._backgrounds.items():
            background.load_state_dict(state[key])


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
    """Make a task of the DeepMind Control suite that is seen through pixels.

    Observations are uint8 of shape (channels x frame_stack, image_size, image_size), 3 channels or 1, oldest frame
    first; the first frame is repeated at reset, and one frame is rendered per agent step. Actions are float32 in
    [-1, 1]. Episodes last 1000 environment steps and end by truncation. ``unwrapped`` is shimmy's
    ``DmControlCompatibilityV0``.

    With ``cameras`` or ``proprioception`` observations are dictionaries, for ``"MultiInputPolicy"``: these images under
    ``"image"``, or ``"camera0"``, ``"camera1"``, ... (by their indices), and the robot's own joints under
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
    :param seed: Seed of the first ``reset`` that is given none; later ones continue its random stream
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
    :raises ValueError: If an argument is out of range
    :raises gymnasium.error.UnregisteredEnv: If there is no such task (``sb3_cure.envs.DMC_TASKS`` has all)
    :raises GLUnavailableError: If OpenGL is missing
    """
    arguments = dict(locals())
    if renderer not in RENDER_FLAGS:
        raise ValueError(f"renderer must be 'dmc', or 'fast' for no shadows and reflections, not {renderer!r}.")
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be 'rgb_array', or None for no videos, not {render_mode!r}.")
    if camera_id is None:
        camera_id = cameras[0] if cameras else CAMERAS.get(domain, 0)
    video = dict(height=VIDEO_SIZE, width=VIDEO_SIZE, camera_id=camera_id, render_flag_overrides=RENDER_FLAGS[renderer])
    env = _make_shimmy_env(domain, task, seed, render_mode=render_mode, render_kwargs=video)
    # As gymnasium.make would set it, so that loggers and copies see this environment and not the one inside.
    env.unwrapped.spec = EnvSpec(
        dmc_env_id(domain, task),
        entry_point=ENTRY_POINT,
        order_enforce=False,
        disable_env_checker=True,
        kwargs=arguments,
    )
    env = NormalizeActions(ActionRepeat(env, ACTION_REPEATS.get(domain, 4) if action_repeat is None else action_repeat))
    views = {"image": camera_id} if proprioception else {"": camera_id}
    if cameras:
        views = {f"camera{index}": index for index in cameras}
    env = DMCPixels(env, views, image_size, grayscale, renderer, background, proprioception, seed)
    return StackFrames(env, frame_stack)


# With this gymnasium.make shows the frames of "rgb_array" in a window (needs pygame) for render_mode="human".
make_dmc_env.metadata = {"render_modes": ["rgb_array"]}  # type: ignore[attr-defined]


def _make_shimmy_env(domain: str, task: str, seed: int | None, **kwargs: Any) -> gym.Env:
    """Make shimmy's environment of a task, without observations of its own."""
    from sb3_cure.envs.rendering import load_gl

    load_gl()
    import shimmy  # noqa: F401  (registers dm_control/... and imports dm_control, hence not before load_gl)

    env = gym.make(
        f"dm_control/{domain}-{task}-v0",
        max_episode_steps=STEP_LIMITS.get(domain),
        disable_env_checker=True,
        # lqr draws the stiffness of its springs when it is built: an id must mean the same physics every time.
        task_kwargs={"random": 0},
        **kwargs,
    )
    base: Any = env.unwrapped
    base.np_random = np.random.RandomState(seed)
    # Otherwise the task's own observations, which nobody sees, cost a tenth of cartpole's time at 36 px.
    base.task.get_observation = _no_observation
    base.observation_space = spaces.Dict()
    # shimmy's metadata, shared by all its environments, has other modes, and control_timestep x 1000 as the rate.
    base.metadata = {"render_modes": ["rgb_array"], "render_fps": 1 / base.control_timestep()}
    return env


def _no_observation(physics: Any) -> dict[str, Any]:
    return {}
