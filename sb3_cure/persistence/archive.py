"""Models as a ``.zip`` of JSON and safetensors, which can be loaded from strangers.

``data`` is the JSON of the settings, in which the tensors of ``tensors.safetensors`` are named. What is no data (a
function, a user's class) is there as a placeholder that tells what it was, and ``load`` asks for it.
"""

import json
import os
import zipfile
from collections.abc import Iterable
from typing import Any, BinaryIO, Protocol, TypeVar, cast

import stable_baselines3
import torch as th
from safetensors.torch import load as load_tensors
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info
from stable_baselines3.common.vec_env import VecEnv

from sb3_cure.persistence.encoding import VERSION, ArchiveError, decode, encode, refusing, write_tensors
from sb3_cure.persistence.files import PathOrFile, reading, writing
from sb3_cure.persistence.names import named_by

Model = TypeVar("Model", bound=OffPolicyAlgorithm)

_DATA = "data"
_TENSORS = "tensors.safetensors"
_SYSTEM_INFO = "system_info.txt"
_PLACEHOLDER = "!not saved"
#: What torch's optimisers keep as one number for each parameter
_COUNTS = ("step", "eta", "mu", "mu_product")


class Stateful(Protocol):
    """A part of a model with a state beside tensors and settings."""

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Its state: values that ``encode`` knows
        """

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: Of ``state_dict``
        """


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


def save_model(
    model: OffPolicyAlgorithm,
    parts: dict[str, Stateful],
    path: PathOrFile,
    exclude: Iterable[str] | None,
    include: Iterable[str] | None,
) -> None:
    """What ``Persistence.save`` does.

    :param model: The model
    :param parts: Its parts with a state
    :param path: Where to write
    :param exclude: Names of settings to leave out
    :param include: As in SB3
    :raises ValueError: if ``include`` names parts of the running model
    """
    excluded = {*model._excluded_save_params()}
    if impossible := sorted(excluded & {*(include or ())}):
        raise ValueError(
            f"save was called with include={impossible}, which an archive does not hold: leave it out (for the replay "
            "buffer there is save_replay_buffer)."
        )
    state_dicts, variables = model._get_torch_save_params()
    left_out = excluded | {*(exclude or ())} | {name.split(".")[0] for name in [*state_dicts, *variables]}
    tensors: dict[str, th.Tensor] = {}
    named = named_by(type(model))
    settings = {}
    for name, value in vars(model).items():
        if name not in left_out:
            try:
                settings[name] = encode(value, name, tensors, named)
            except TypeError as error:
                settings[name] = {_PLACEHOLDER: str(error)}
    states = {name: _plain_dict(state) for name, state in model.get_parameters().items()}
    content = {
        "format": VERSION,
        "settings": settings,
        "parameters": encode(states, "parameters", tensors),
        "variables": encode({name: recursive_getattr(model, name) for name in variables}, "variables", tensors),
        "parts": encode({name: part.state_dict() for name, part in parts.items()}, "parts", tensors),
    }
    with writing(path, "zip") as target, zipfile.ZipFile(target, "w") as archive:
        archive.writestr(_DATA, json.dumps(content, indent=1))
        with archive.open(_TENSORS, "w", force_zip64=True) as member:
            write_tensors(cast(BinaryIO, member), tensors)
        archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
        archive.writestr(_SYSTEM_INFO, get_system_info(print_info=False)[1])


def _plain_dict(state: Any) -> Any:
    """State dict without the versions of modules, which an OrderedDict of torch carries."""
    return dict(state) if isinstance(state, dict) else state


class ModelArchive:
    """A model's file, its tensors read.

    :param file: The file
    :param name: What to call it
    :raises ArchiveError: if it is damaged or hostile
    """

    def __init__(self, file: BinaryIO, name: str):
        self.name = name
        with refusing(name):
            archive = zipfile.ZipFile(file)
            members = archive.infolist()
            if any(member.compress_type != zipfile.ZIP_STORED for member in members):
                raise ArchiveError(f"{name} has compressed members, which may expand without limit: it is not read.")
            if sum(member.file_size for member in members) > file.seek(0, os.SEEK_END):
                raise ArchiveError(f"{name} declares more bytes than it has: it is damaged, or hostile.")
            self.content = json.loads(archive.read(_DATA))
            self.is_pickled = isinstance(self.content, dict) and "format" not in self.content
            if self.is_pickled:
                return
            if self.content["format"] != VERSION:
                raise ArchiveError(f"{name} has the format {self.content['format']!r:.20}, not {VERSION}.")
            self._tensors = load_tensors(archive.read(_TENSORS))
            self.system_info = archive.read(_SYSTEM_INFO).decode(errors="replace")

    def read(self, part: str) -> dict[str, Any]:
        """
        :param part: ``"parameters"``, ``"variables"`` or ``"parts"``
        :return: States by name
        """
        with refusing(self.name):
            return decode(self.content[part], self._tensors.__getitem__)

    def settings(self, model_class: type, given: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
        """
        :param model_class: The class that the settings are for
        :param given: Settings in place of the archive's
        :param names: Further names of settings that need not be read
        :return: Settings by name
        :raises ObjectsMissing: if there are placeholders that nothing was given for
        """
        with refusing(self.name):
            nodes = self.content["settings"]
            missing = {key: node[_PLACEHOLDER] for key, node in nodes.items() if _PLACEHOLDER in _keys(node)}
            settings = {key: value for key, value in given.items() if key in nodes}
            if left := {key: what[:200] for key, what in missing.items() if key not in {*settings, *names}}:
                raise ObjectsMissing(self.name, left)
            named = named_by(model_class)
            for key, node in nodes.items():
                if key not in settings and key not in missing:
                    settings[key] = decode(node, self._tensors.__getitem__, named)
            return settings


def _keys(node: Any) -> Iterable[str]:
    return node if isinstance(node, dict) else ()


def is_pickled_model(path: PathOrFile) -> bool:
    """
    :param path: A model's file
    :return: Whether SB3's own ``save`` wrote it, so that its settings are pickled
    """
    with reading(path, "zip") as (file, name):
        return ModelArchive(file, name).is_pickled


def load_model(
    cls: type[Model],
    path: PathOrFile,
    env: VecEnv | None,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    print_system_info: bool,
    force_reset: bool,
    kwargs: dict[str, Any],
) -> tuple[Model, dict[str, Any]]:
    """What ``Persistence.load`` does; the parameters are those of ``load``.

    :return: The model, and the states of its parts
    """
    with reading(path, "zip") as (file, name):
        archive = ModelArchive(file, name)
    if archive.is_pickled:
        raise ArchiveError(
            f"{name} holds pickled settings, as SB3 saves them, and unpickling runs any code that is in them: if you "
            "know where it comes from, load it with trusted=True (and save it again, which needs no pickle)."
        )
    if print_system_info:
        print("== CURRENT SYSTEM INFO ==")
        get_system_info()
        print("== SAVED MODEL SYSTEM INFO ==")
        print("".join(character for character in archive.system_info if character.isprintable() or character == "\n"))
    settings = archive.settings(cls, custom_objects or {}, kwargs)
    if lacking := {"policy_class", "observation_space", "action_space"} - settings.keys():
        raise ArchiveError(f"{name} has no {min(lacking)}, without which no model can be built: it is damaged.")
    if kwargs.get("policy_kwargs", settings.get("policy_kwargs")) != settings.get("policy_kwargs"):
        raise ValueError(
            f"the policy kwargs do not equal those of {name}: load got {kwargs['policy_kwargs']}, but it was saved "
            f"with {settings.get('policy_kwargs')}: leave them out, as the networks are those of the archive."
        )
    if env is not None:
        env = cls._wrap_env(env, settings.get("verbose", 0))
        check_for_correct_spaces(env, settings["observation_space"], settings["action_space"])
        settings["n_envs"] = env.num_envs
        if force_reset:
            settings["_last_obs"] = None
    model = cls(settings["policy_class"], env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
    for key in sorted(settings):
        # A callback, say, may have set further attributes; none of them may hide a method or a part of the model.
        if hasattr(cls, key) or key in model._excluded_save_params():
            raise ArchiveError(f"{name} has {key:.50}, which is no setting: it is damaged, or of another version.")
    vars(model).update(settings)
    if unknown := kwargs.keys() - vars(model).keys() - archive.content["settings"].keys():
        raise TypeError(f"load has {min(unknown)!r}, but {cls.__name__} has no such setting: correct its name.")
    vars(model).update(kwargs)
    model._setup_model()
    model.set_parameters(archive.read("parameters"), exact_match=True, device=device)
    variables = archive.read("variables")
    with refusing(name):
        for key in model._get_torch_save_params()[1]:
            recursive_getattr(model, key).data.copy_(variables[key])
    if getattr(model, "use_sde", False):
        model.policy.reset_noise()  # type: ignore[operator]
    return model, archive.read("parts")


def read_parameters(path: PathOrFile) -> dict[str, Any] | None:
    """
    :param path: A model's file
    :return: Its state dicts by name; None if SB3's own ``save`` wrote it
    """
    with reading(path, "zip") as (file, name):
        archive = ModelArchive(file, name)
        return None if archive.is_pickled else archive.read("parameters")


def lay_out_moments(model: OffPolicyAlgorithm) -> None:
    """Give the moments of optimisers the strides of their parameters: fused Adam steps both in the order of memory.

    :param model: A model whose optimisers have loaded their states
    :raises ArchiveError: if moments have other shapes than their parameters
    """
    owners = [recursive_getattr(model, name) for name in model._get_torch_save_params()[0]]
    # What is no optimiser itself may hold some by name.
    held = [each for owner in owners for each in getattr(owner, "optimizers", {}).values()]
    for optimizer in [*owners, *held]:
        if not isinstance(optimizer, th.optim.Optimizer):
            continue
        for parameter, state in optimizer.state.items():
            for key, value in state.items():
                if not isinstance(value, th.Tensor) or (key in _COUNTS and value.dim() == 0):
                    continue
                if value.shape != parameter.shape:
                    optimizer.state.clear()  # a fused step would write beyond them
                    raise ArchiveError(
                        f"an optimiser got {key:.20} of shape {tuple(value.shape)!s:.50} for a parameter of shape "
                        f"{tuple(parameter.shape)}: the parameters are of a model with other settings."
                    )
                state[key] = th.empty_like(parameter, dtype=value.dtype).copy_(value)
