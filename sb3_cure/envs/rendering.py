"""The OpenGL that MuJoCo renders with: which backend is used, whether it works, and whose context is current."""

import importlib
import os
import sys
import threading
import warnings
import weakref
from typing import Any

import gymnasium as gym


class GLUnavailableError(RuntimeError):
    """OpenGL cannot be loaded or cannot render; the message says what to do."""


def _gl_error(cause: object) -> GLUnavailableError:
    backend = os.environ.get("MUJOCO_GL", "unset")
    first_line = str(cause).partition("\n")[0].rstrip(".")
    return GLUnavailableError(
        f"OpenGL cannot render here (MUJOCO_GL={backend}: {first_line}): install the libraries with "
        "`apt-get install libegl1 libopengl0 libgl1-mesa-dri` (Debian, Ubuntu) and leave MUJOCO_GL unset, "
        "or set it to a backend that works here (egl, glfw or osmesa)."
    )


def is_headless() -> bool:
    """Check whether no display is named on which a window could be opened.

    :return: Whether there is none
    """
    return sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _glfw_has_a_display() -> bool:
    """Whether GLFW can open the named display, which may be that of an ended ``ssh -X`` or of another node."""
    if is_headless():
        return False
    try:
        glfw = importlib.import_module("glfw")
    except ImportError:  # then dm_control does not choose it
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return bool(glfw.init())


def choose_backend() -> None:
    """Set ``MUJOCO_GL=egl``, which MuJoCo reads when imported, if it is not set and GLFW finds no display.

    Mesa's software renderer gets no extra threads, unless ``LP_NUM_THREADS`` is set.
    """
    # Mesa would start a thread per core for each environment, which only slows small images down.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    if not os.environ.get("MUJOCO_GL") and not _glfw_has_a_display():
        os.environ["MUJOCO_GL"] = "egl"


def load_gl() -> None:
    """Load the OpenGL backend of dm_control: EGL if ``MUJOCO_GL`` is not set and GLFW finds no display.

    Mesa's software renderer gets no extra threads, as in ``choose_backend``, and SDL's windows do without
    OpenGL, unless ``SDL_FRAMEBUFFER_ACCELERATION`` is set. No rendering context is made, so a process that has only
    called this can still be forked.

    :raises GLUnavailableError: If the libraries or their drivers are missing
    """
    choose_backend()
    # pygame, which opens windows for render_mode="human", would draw with OpenGL, too: that ends the process (EGL), or
    # the window shows the first frame for ever (GLFW).
    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
    importlib.import_module("dm_control")  # outside of the try: its absence is no matter of OpenGL
    try:
        backend = importlib.import_module("dm_control._render").BACKEND
    # PyOpenGL fails in many ways when a library is missing, most often with an AttributeError of None.
    except Exception as error:
        raise _gl_error(error) from error
    if backend in (None, "off"):
        raise _gl_error("no rendering backend")
    # dm_control prefers GLFW when it is imported without MUJOCO_GL, even here, where that aborts the process.
    if backend == "glfw" and not _glfw_has_a_display():
        raise GLUnavailableError(
            "dm_control was imported with its GLFW backend, which needs a display, and none can be opened; set "
            "MUJOCO_GL=egl before starting Python."
        )


def check_gl() -> str:
    """Render an empty scene.

    :return: The name that OpenGL gives its renderer, such as ``"llvmpipe (LLVM 15.0.6, 256 bits)"``
    :raises GLUnavailableError: If that fails
    """
    load_gl()
    from dm_control import mujoco

    try:
        gl = importlib.import_module("OpenGL.GL")
        physics = mujoco.Physics.from_xml_string("<mujoco><worldbody/></mujoco>")
        try:
            physics.render(height=16, width=16)
            with physics.contexts.gl.make_current() as context:
                return context.call(gl.glGetString, gl.GL_RENDERER).decode()
        finally:
            physics.free()
    except Exception as error:
        raise _gl_error(error) from error


def mujoco_renderer_of(env: gym.Env) -> Any:
    """Look for what draws Gymnasium's MuJoCo environments.

    :param env: Any environment
    :return: Its ``MujocoRenderer``, or None. In the mazes of Gymnasium-Robotics it belongs to an environment inside
    """
    base: Any = env.unwrapped
    inner = getattr(base, "point_env", None) or getattr(base, "ant_env", base)
    return getattr(inner.unwrapped, "mujoco_renderer", None)


#: Renderers of environments that were dropped without being closed, which may happen in the middle of a frame
_dropped: list[Any] = []
#: Viewers that only another thread could free
_lost: list[Any] = []


def free_when_dropped(env: gym.Env) -> None:
    """Once an environment is dropped, free what its ``MujocoRenderer`` draws with before the next frame.

    :param env: Any environment
    """
    if (renderer := mujoco_renderer_of(env)) is not None:
        weakref.finalize(env, _dropped.append, renderer).atexit = False


def free_mujoco_contexts(renderer: Any) -> None:
    """Free what a ``MujocoRenderer`` draws with; its next frame makes it anew.

    MuJoCo frees textures and meshes by number, in whichever OpenGL context is current: Gymnasium, which frees the
    context first, would destroy those of another environment, whose frames are black from then on. It also ends GLFW
    for all.

    :param renderer: The ``MujocoRenderer`` of an environment
    """
    for viewer in renderer._viewers.values():
        try:
            viewer.make_context_current()
        except Exception:  # each backend has its own
            _lost.append(viewer)
            continue
        viewer.con.free()
        viewer.free()
    renderer._viewers.clear()
    renderer.viewer = None
    _forget_context_of_dm_control()


def render_in_own_context(env: gym.Env) -> Any:
    """Render an environment, in its own OpenGL context if it is one of Gymnasium's MuJoCo environments.

    :param env: Any environment
    :return: What ``env.render()`` returns
    """
    while _dropped:
        free_mujoco_contexts(_dropped.pop())
    if (renderer := mujoco_renderer_of(env)) is None:
        return env.render()
    if renderer.viewer is not None:
        renderer.viewer.make_context_current()
    try:
        return env.render()
    finally:
        _forget_context_of_dm_control()


def _forget_context_of_dm_control() -> None:
    """Let dm_control make its context current again: it does not notice when another library makes its own current."""
    if (dm_control := sys.modules.get("dm_control._render.base")) is not None:
        last = dm_control._CURRENT_CONTEXT_FOR_THREAD.pop(threading.current_thread(), None)
        dm_control._CURRENT_THREAD_FOR_CONTEXT.pop(last, None)
