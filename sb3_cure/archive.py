"""Model archives that can be loaded from strangers: nothing in them is pickle that is run.

An archive is a zip with the members of SB3's: ``data`` (settings, here JSON with a few tagged types), ``*.pth`` (state
dicts of tensors, which torch reads with ``weights_only=True``) and the version. Whatever is not data (a function, a
user's class) is named in the archive only by a placeholder, and ``load`` asks for it as ``custom_objects``. Classes are
looked up by name in a fixed table; nothing that an archive names is imported.
"""

import contextlib
import zipfile
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import stable_baselines3
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.files import PathOrFile, reading, writing
from sb3_cure.serialization import (
    MODEL_MEMBER,
    STATE_MEMBER,
    Archive,
    ArchiveError,
    dump_json,
    sentences,
    write_arrays,
)
from sb3_cure.settings import (
    DERIVED,
    NEVER_SAVED,
    SCHEMA,
    SettingsDecoder,
    SettingsEncoder,
    check_sizes,
    plain_arguments,
)
from sb3_cure.values import arguments_of, check_keywords
from sb3_cure.weights import Allowance, TensorInfo, TorchFile, check_parameters, check_tensor, expect_keys

if TYPE_CHECKING:
    from sb3_cure.cure_sac import CuReSAC

#: Of the format of ``data``
VERSION = 1

_FORMAT = "sb3_cure"
_CLASS = "class"
_PLACEHOLDER = "placeholder"
_SYSTEM_INFO = "system_info.txt"
_VARIABLES = "pytorch_variables.pth"
_SMALLER = "load it with custom_objects={'buffer_size': ...} to have a smaller replay buffer"


class ObjectsMissing(ArchiveError):
    """What no archive holds, such as a head of the user's own, was not given to ``load``.

    :param name: What to call the file
    :param missing: What each of the settings was
    """

    def __init__(self, name: str, missing: dict[str, str]):
        needed = ", ".join(f"{key!r}: ..." for key in missing)
        super().__init__(
            f"{name} was saved with what no archive holds ({'; '.join(missing.values())}): give it to load with "
            f"custom_objects={{{needed}}}."
        )
        self.name = name
        self.missing = missing


# ------------------------------------------------------------------- writing


def save_model(model: "CuReSAC", path: PathOrFile, exclude: Any = None, include: Any = None) -> None:
    """What ``CuReSAC.save`` does.

    :param model: The model
    :param path: Where to, as in SB3
    :param exclude: Names of settings that are not to be saved
    :param include: Names of settings that are to be saved although they are not by default
    :raises ValueError: if ``include`` names parts of the running model, which no archive holds
    """
    impossible = sorted(NEVER_SAVED & {*(include or ())})
    if impossible:
        raise ValueError(
            f"save was called with include={impossible}, which an archive does not hold: leave it out (for the replay "
            "buffer there is save_replay_buffer)."
        )
    state_dicts, variables = model._get_torch_save_params()
    left_out = ({*model._excluded_save_params(), *(exclude or ())} - {*(include or ())}) | DERIVED
    left_out |= {name.split(".")[0] for name in [*state_dicts, *variables]}
    encoder = SettingsEncoder()
    settings: dict[str, Any] = {}
    for name, value in vars(model).items():
        if name not in left_out:
            settings[name] = _encode_setting(encoder, name, value)
    data = dump_json({_FORMAT: VERSION, _CLASS: _name_of(type(model)), "settings": settings})
    tensors = {f"{name}.pth": state for name, state in model.get_parameters().items()}
    tensors[_VARIABLES] = {name: recursive_getattr(model, name) for name in variables}
    with writing(path, "zip") as target, zipfile.ZipFile(target, "w") as archive:
        archive.writestr(MODEL_MEMBER, data)
        write_arrays(archive, encoder.arrays)
        for name, state in tensors.items():
            with archive.open(name, "w", force_zip64=True) as member:
                th.save(state, member)
        archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
        archive.writestr(_SYSTEM_INFO, get_system_info(print_info=False)[1])


def _name_of(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def _encode_setting(encoder: SettingsEncoder, name: str, value: Any) -> Any:
    """JSON of a setting, or of a placeholder that tells what could not be saved."""
    n_arrays = len(encoder.arrays)
    try:
        return encoder.encode(value, name)
    except TypeError as error:
        del encoder.arrays[n_arrays:]
        return {_PLACEHOLDER: str(error)}


# ------------------------------------------------------------------- reading


@dataclass
class ModelArchive:
    """What an archive holds, checked, and nothing of it run.

    :param name: What to call the file
    :param saved_by: Name of the class of the model, empty if it was not read or is not known
    :param settings: Value of each setting; None if the settings were not read
    :param placeholders: What each of the settings was that could not be saved
    :param params: State dicts by name
    :param variables: Further tensors by name
    :param tensors: Descriptions of all tensors
    :param system_info: Of the machine that saved it
    """

    name: str
    saved_by: str
    settings: dict[str, Any] | None
    placeholders: dict[str, str]
    params: dict[str, Any]
    variables: dict[str, Any]
    tensors: list[TensorInfo]
    system_info: str


def is_pickled_model(path: PathOrFile) -> bool:
    """
    :param path: A model's file
    :return: Whether SB3's ``save`` (or that of this package, formerly) wrote it, so that its settings are pickled
    :raises ArchiveError: if it is no model of this algorithm
    """
    with reading(path, "zip") as (file, name):
        return _is_pickled(Archive(file, name))


def _is_pickled(archive: Archive) -> bool:
    if MODEL_MEMBER not in archive.sizes:
        if STATE_MEMBER in archive.sizes:
            raise ArchiveError(
                f"{archive.name} holds no model, but a replay buffer or a part of a checkpoint: read it with "
                "load_replay_buffer, or give resume the folder of the checkpoints."
            )
        raise archive.error("holds no model")
    # SB3 pickles what was seen last, which may be large.
    data = archive.bytes(MODEL_MEMBER, 2**28)
    if b'":serialized:"' not in data:
        return False
    if b'"srl":' not in data or b'"curiosity":' not in data:
        raise ArchiveError(
            f"{archive.name} was saved by another algorithm than CuReSAC: load it with the class that saved it."
        )
    return True


def read_model(path: PathOrFile, settings: bool = True) -> ModelArchive:
    """
    :param path: A model's file
    :param settings: Whether to read its settings, too
    :return: All that it holds
    :raises ArchiveError: if it is anything but a whole archive without pickled settings, in one sentence
    """
    with reading(path, "zip") as (file, name):
        archive = Archive(file, name)
        saved_by, found = "", None
        placeholders: dict[str, str] = {}
        if settings:
            saved_by, found, placeholders = _read_settings(archive)
        states: dict[str, Any] = {}
        tensors: list[TensorInfo] = []
        for member in [member for member in archive.sizes if member.endswith(".pth")]:
            states[member], described = _read_tensors(archive, member)
            tensors += described
        info = archive.bytes(_SYSTEM_INFO, 10_000).decode(errors="replace") if _SYSTEM_INFO in archive.sizes else ""
        if settings:
            archive.bytes("_stable_baselines3_version", 100)
            archive.check_all_read()
    variables = states.pop(_VARIABLES, {})
    params = {member.removesuffix(".pth"): state for member, state in states.items()}
    return ModelArchive(name, saved_by, found, placeholders, params, variables, tensors, info)


def _read_settings(archive: Archive) -> tuple[str, dict[str, Any], dict[str, str]]:
    if _is_pickled(archive):
        raise ArchiveError(
            f"{archive.name} holds pickled settings, as SB3 saves them, and unpickling runs any code that is in them: "
            "if you know where it comes from, load it with trusted=True (and save it again, which needs no pickle)."
        )
    data = archive.json(MODEL_MEMBER)
    if not isinstance(data, dict):
        raise archive.error("holds no settings")
    saved_by = data.pop(_CLASS, "")
    is_known = data.keys() == {_FORMAT, "settings"} and data[_FORMAT] == VERSION and isinstance(saved_by, str)
    if not is_known or not isinstance(data["settings"], dict):
        raise archive.error(f"has no settings of version {VERSION}")
    nodes = dict(data["settings"])
    placeholders: dict[str, str] = {}
    for key, node in data["settings"].items():
        if isinstance(node, dict) and isinstance(node.get(_PLACEHOLDER), str):
            placeholders[key] = "".join(filter(str.isprintable, node[_PLACEHOLDER]))[:200]
            del nodes[key]
    return saved_by, SettingsDecoder(archive.arrays()).decode_all({"dict": nodes}), placeholders


def _read_tensors(archive: Archive, member: str) -> tuple[Any, list[TensorInfo]]:
    file = TorchFile(archive.bytes(member, archive.sizes[member]), f"{archive.name}, member {member!r},")
    if not isinstance(file.content, dict) or not all(isinstance(key, str) for key in file.content):
        raise archive.error(f"has a member {member!r} that is no state dict")
    # Without the versions of modules, which an OrderedDict of torch carries.
    return dict(file.load()), file.tensors


def load_model(
    cls: type["CuReSAC"],
    path: PathOrFile,
    env: Any,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    print_system_info: bool,
    force_reset: bool,
    trusted: bool,
    kwargs: dict[str, Any],
) -> "CuReSAC":
    """What ``CuReSAC.load`` does for archives without pickle; the parameters are those of ``load``.

    :return: The model
    :raises ArchiveError: if the archive cannot be loaded as it is, in one sentence
    """
    if custom_objects is not None and not isinstance(custom_objects, dict):
        raise ValueError(f"custom_objects is a {type(custom_objects).__name__}, but it must be a dict or None.")
    custom_objects, kwargs = plain_arguments(custom_objects or {}), plain_arguments(kwargs)
    archive = read_model(path)
    if print_system_info:
        print("== CURRENT SYSTEM INFO ==")
        get_system_info()
        print("== SAVED MODEL SYSTEM INFO ==")
        print("".join(character for character in archive.system_info if character.isprintable() or character == "\n"))
    settings = _complete(archive, custom_objects, kwargs)
    known = arguments_of(cls)
    check_keywords("load", kwargs, known and known | settings.keys() | archive.placeholders.keys(), cls.__name__)
    if env is not None:
        env = cls._wrap_env(env, settings.get("verbose", 0))
        _check_spaces(archive.name, settings, env)
        settings["n_envs"] = env.num_envs
        if force_reset:
            settings["_last_obs"] = None
        noise = settings.get("action_noise")
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != env.num_envs:
            settings["action_noise"] = noise.base_noise  # of which `learn` makes one for each environment
    with sentences(archive.name, _SMALLER):
        _forget_n_step_buffer(settings)
        model = cls(settings["policy_class"], env, device=device, _init_setup_model=False)
        known = vars(model).keys() | SCHEMA.keys()
        vars(model).update({key: value for key, value in settings.items() if key in known or trusted})
        vars(model).update(kwargs)
        with contextlib.nullcontext() if trusted else Allowance(archive.tensors, archive.name):
            model._setup_model()
        is_heir = archive.saved_by in map(_name_of, cls.__mro__)
        for key in [] if trusted else sorted(settings.keys() - known - vars(model).keys()):
            # A callback, say, may have noted it at a model of this class, none of whose own names it may cover.
            if not is_heir or hasattr(cls, key):
                raise ArchiveError(
                    f"{archive.name} has the setting {key!r:.50}, which {cls.__name__} does not have: load it with "
                    "the class that saved it, or with trusted=True if you know where it comes from."
                )
            setattr(model, key, settings[key])
        check_parameters(model, archive.params, archive.name)
        model.set_parameters(archive.params, exact_match=True, device=device)
        _set_variables(model, archive)
        if model.use_sde:
            model.policy.reset_noise()  # type: ignore[operator]
    return model


def _forget_n_step_buffer(settings: dict[str, Any]) -> None:
    """That which SB3 chose for ``n_steps`` and ``gamma``: it chooses anew, as ``load`` may be given others."""
    arguments = settings.get("replay_buffer_kwargs", {})
    chosen = {name: settings.get(name) for name in ("n_steps", "gamma")}
    if settings.get("replay_buffer_class") is NStepReplayBuffer and chosen.items() <= arguments.items():
        settings["replay_buffer_class"] = None
        settings["replay_buffer_kwargs"] = {key: value for key, value in arguments.items() if key not in chosen}


def _complete(archive: ModelArchive, custom_objects: dict[str, Any], kwargs: dict[str, Any]) -> dict[str, Any]:
    """The archive's settings, checked, with the user's objects in their places."""
    settings = dict(archive.settings or {})
    for key in sorted((NEVER_SAVED | DERIVED) & (settings.keys() | archive.placeholders.keys())):
        raise ArchiveError(f"{archive.name} has {key}, which is no setting: it is damaged, or of another version.")
    missing = sorted(archive.placeholders.keys() - custom_objects.keys() - kwargs.keys())
    if missing:
        raise ObjectsMissing(archive.name, {key: archive.placeholders[key] for key in missing})
    with sentences(archive.name, _SMALLER):
        for key, value in settings.items():
            words, check = SCHEMA.get(key, ("", lambda _: True))
            if not check(value):
                raise ArchiveError(
                    f"{archive.name} has {key}={value!r:.100}, but {key} is {words}: it is damaged, or of another "
                    "version."
                )
        check_sizes(settings)
    known = settings.keys() | archive.placeholders.keys()
    settings.update({key: value for key, value in custom_objects.items() if key in known})
    for key in ("policy_class", "observation_space", "action_space"):
        if key not in settings:
            raise ArchiveError(f"{archive.name} has no {key}, without which no model can be built: it is damaged.")
    policy_kwargs = settings.get("policy_kwargs")
    if "policy_kwargs" in kwargs and kwargs["policy_kwargs"] != policy_kwargs:
        raise ValueError(
            f"the policy kwargs do not equal those of {archive.name}: load got {kwargs['policy_kwargs']}, but it was "
            f"saved with {policy_kwargs}: leave them out, as the networks are those of the archive."
        )
    return settings


def _check_spaces(name: str, settings: dict[str, Any], env: VecEnv) -> None:
    trained, given = settings["observation_space"], env.observation_space
    what, fix = "observations", "make it as for that training (images: the same image_size, grayscale, frame_stack)"
    if trained == given:
        trained, given = settings["action_space"], env.action_space
        what, fix = "actions", "give the environment that it was trained on"
    if trained != given:
        raise ArchiveError(
            f"{name} was trained with the {what} {trained}, but the environment has {given}: {fix}, or train anew."
        )


def _set_variables(model: "CuReSAC", archive: ModelArchive) -> None:
    names = model._get_torch_save_params()[1]
    expect_keys(archive.variables, {*names}, f"{archive.name}: {_VARIABLES}")
    for name in names:
        own = recursive_getattr(model, name)
        check_tensor(archive.variables[name], own.shape, archive.name, name, own.dtype)
        own.data = archive.variables[name].data.to(own.device)
