"""Models as a ``.zip`` of JSON and safetensors, which can be loaded from strangers.

``data`` holds settings and states as JSON, which refers to the tensors in ``tensors.safetensors`` by name. An object
that is not data (a function, a user's class) is replaced by a placeholder with its name, and ``load`` needs it in
``custom_objects``.
"""

import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO, TypeVar, cast

import stable_baselines3
import torch as th
from safetensors.torch import load as load_tensors
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info

from sb3_cure.persistence.encoding import (
    VERSION,
    ArchiveError,
    check_version,
    decode,
    encode,
    named_by,
    refusing,
    write_tensors,
)
from sb3_cure.persistence.files import PathOrFile, reading, writing

Self = TypeVar("Self", bound="SavesModels")

_DATA, _TENSORS, _SYSTEM_INFO = "data", "tensors.safetensors", "system_info.txt"
_PLACEHOLDER = "!not saved"
#: What torch's optimisers keep as one number for each parameter
_COUNTS = ("step", "eta", "mu", "mu_product")

#: Tensors and optimizers of each temperature, by the setting that chooses between fixed and learned
_TEMPERATURES = {
    setting: [prefix + name for name in ("log_ent_coef", "ent_coef_tensor", "ent_coef_optimizer")]
    for setting, prefix in (("ent_coef", ""), ("curiosity_ent_coef", "policy.curious."))
}


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
            self.is_pickled = "format" not in self.content  # SB3's own archives have no format
            if not self.is_pickled:
                check_version(self.content["format"], name)
                self._tensors = load_tensors(archive.read(_TENSORS))
                self.system_info = archive.read(_SYSTEM_INFO).decode(errors="replace")

    def read(self, part: str) -> dict[str, Any]:
        """Read states.

        :param part: ``"parameters"``, ``"variables"``, ``"parts"`` or ``"architecture"``
        :return: States by name
        """
        with refusing(self.name):
            return decode(self.content[part], self._tensors.__getitem__)

    def settings(self, model_class: type, given: dict[str, Any], not_needed: Iterable[str]) -> dict[str, Any]:
        """Read the settings.

        :param model_class: Class that the settings are for
        :param given: Settings in place of the archive's
        :param not_needed: Names of settings that may be missing
        :return: Settings by name
        :raises ArchiveError: if there are placeholders that nothing was given for
        """
        with refusing(self.name):
            nodes = self.content["settings"]
            settings = {key: value for key, value in given.items() if key in nodes}
            missing, named = {}, named_by(model_class)
            for key, node in nodes.items():
                if key not in settings and isinstance(node, dict) and _PLACEHOLDER in node:
                    missing[key] = node[_PLACEHOLDER][:200]
                elif key not in settings:
                    settings[key] = decode(node, self._tensors.__getitem__, named)
            if needed := {key: what for key, what in missing.items() if key not in not_needed}:
                objects = ", ".join(f"{key!r}: ..." for key in needed)
                raise ArchiveError(
                    f"{self.name} was saved with objects that no archive holds ({'; '.join(needed.values())}): pass "
                    f"custom_objects={{{objects}}} to load."
                )
            return settings


def archived_networks(path: PathOrFile) -> tuple[dict[str, th.Tensor], th.Tensor | None, dict[str, Any]]:
    """Read the networks of a model, to transfer them to another one.

    :param path: Model's file
    :return: The tensors of its policy by name; the logarithm of its curious agent's temperature, if it learns that; and
        the ``architecture`` of its policy
    :raises ArchiveError: if it is damaged or pickled
    """
    with reading(path, "zip") as (file, name):
        archive = ModelArchive(file, name)
    if archive.is_pickled:
        raise ArchiveError(f"{name} was pickled by SB3's save: load it with trusted=True, and save it again.")
    temperature = archive.read("variables").get("policy.curious.log_ent_coef")
    return archive.read("parameters")["policy"], temperature, archive.read("architecture")


class SavesModels(OffPolicyAlgorithm):
    """Mixin for an algorithm of SB3: ``save``, ``load`` and ``set_parameters`` without pickle."""

    def _stateful_parts(self) -> dict[str, Any]:
        """Objects with ``state_dict`` and ``load_state_dict``, such as a generator, by name: saved and resumed."""
        return {}

    def _before_save(self) -> None:
        """Finish what is under way, and refuse to save what is broken."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "lr_schedule"]  # set-up makes it from learning_rate

    def save(
        self, path: PathOrFile, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """Save networks, optimisers and settings, without pickle; an old file is replaced once the new one is complete.

        A function as ``learning_rate`` or a class of your own is saved as a placeholder with its name, and ``load``
        needs it in ``custom_objects``.

        :param path: Path (its folder is made, and ``.zip`` added if it has no suffix), or a binary file
        :param exclude: Names of settings that are not to be saved
        :param include: Names of settings that are saved although they are in ``exclude``
        :raises ValueError: if ``include`` names parts of the running model
        """
        self._before_save()
        included, (state_dicts, variables) = {*(include or ())}, self._get_torch_save_params()
        left_out = {*self._excluded_save_params(), *(name.split(".")[0] for name in [*state_dicts, *variables])}
        if impossible := sorted(left_out & included):
            raise ValueError(f"save got include={impossible}, which an archive does not hold: leave it out.")
        left_out |= {*(exclude or ())} - included
        tensors: dict[str, th.Tensor] = {}
        named = named_by(type(self))
        settings = {}
        for name, value in vars(self).items():
            if name not in left_out:
                found: dict[str, th.Tensor] = {}
                try:
                    settings[name] = encode(value, name, found, named)
                    tensors |= found
                except TypeError as error:
                    settings[name] = {_PLACEHOLDER: str(error)}
        content = {
            # Without the versions of modules, which an OrderedDict of torch carries
            "parameters": {name: dict(state) for name, state in self.get_parameters().items()},
            "variables": {name: recursive_getattr(self, name) for name in variables},
            "parts": {name: part.state_dict() for name, part in self._stateful_parts().items()},
            "architecture": getattr(self.policy, "architecture", {}),  # SB3's own policies have none
        }
        data = {"format": VERSION, "settings": settings}
        data |= {name: encode(part, name, tensors) for name, part in content.items()}
        with writing(path, "zip") as target, zipfile.ZipFile(target, "w") as archive:
            archive.writestr(_DATA, json.dumps(data, indent=1))
            with archive.open(_TENSORS, "w", force_zip64=True) as member:
                write_tensors(cast(BinaryIO, member), tensors)
            archive.writestr("_stable_baselines3_version", stable_baselines3.__version__)
            archive.writestr(_SYSTEM_INFO, get_system_info(print_info=False)[1])

    @classmethod
    def load(  # type: ignore[override]
        cls: type[Self],
        path: PathOrFile,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        trusted: bool = False,
        **kwargs: Any,
    ) -> Self:
        """Load a model, even one from a stranger.

        No code that an archive holds is run, and nothing that it names is imported. (Its settings may still need
        more memory than there is.) A temperature that is given replaces the saved one, whether fixed or learned.

        :param path: Path with or without its suffix ``.zip``, or a binary file
        :param env: Environment, vectorised environment or Gymnasium id to learn in; not needed to predict
        :param device: Device of the networks
        :param custom_objects: Settings to replace by name; needed for what archives do not hold, for example
            ``{"srl": MyHead}``, or ``{"policy_kwargs": {...}}`` where something in it is not data. Names that the
            archive does not have are ignored
        :param print_system_info: Whether to print the system on which the model was saved, and this one
        :param force_reset: Whether to reset the environment before learning
        :param trusted: Also load what SB3's ``save`` has pickled, which runs any code in it
        :param kwargs: Settings to change
        :return: The model
        :raises ArchiveError: (a ``ValueError``) if the file is damaged, hostile or pickled
        """
        env = maybe_make_env(env, kwargs.get("verbose", 0))  # type: ignore[arg-type]
        with reading(path, "zip") as (file, name):
            archive = ModelArchive(file, name)
        if archive.is_pickled:
            if trusted:
                return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
            raise ArchiveError(
                f"{name} holds pickled settings, as SB3 saves them, and unpickling runs any code that is in them: if "
                "you know where it comes from, load it with trusted=True (and save it again, which needs no pickle)."
            )
        if print_system_info:
            get_system_info()
            print("".join(char for char in archive.system_info if char.isprintable() or char == "\n"))
        settings = archive.settings(cls, custom_objects or {}, kwargs)
        for key in ("policy_kwargs", "srl_kwargs"):  # optimisers would keep what they were saved with
            if kwargs.get(key, settings.get(key)) != settings.get(key):
                raise ValueError(f"{key} differ from those that {name} was saved with: leave them out.")
        if env is not None:
            env = cls._wrap_env(env, settings.get("verbose", 0))
            check_for_correct_spaces(env, settings["observation_space"], settings["action_space"])
            settings["n_envs"] = env.num_envs
            if force_reset:
                settings["_last_obs"] = None
        model = cls(settings["policy_class"], env, device=device, _init_setup_model=False)  # type: ignore[arg-type, call-arg]
        for key in settings:
            # A callback, say, may have set further attributes; none may hide a method or a part of the model.
            of_class = getattr(cls, key, None)
            if callable(of_class) or isinstance(of_class, property) or key in model._excluded_save_params():
                raise ArchiveError(f"{name} has {key:.50}, which is no setting: it is damaged, or of another version.")
        vars(model).update(settings)
        if unknown := kwargs.keys() - vars(model).keys() - archive.content["settings"].keys():
            raise TypeError(f"load() got {min(unknown)!r}, which is no setting of {cls.__name__}: correct its name.")
        vars(model).update(kwargs)
        model._setup_model()
        replaced, archived = {**(custom_objects or {}), **kwargs}, archive.content["settings"]
        given = {key for key in _TEMPERATURES if key in replaced and replaced[key] != archived.get(key)}
        model._load_tensors(archive, given)
        if model.use_sde:
            model.policy.reset_noise()  # type: ignore[operator]  # of the loaded deviation, as SB3's load does
        return model

    def _load_tensors(self, archive: ModelArchive, given: set[str]) -> None:
        """Load all but the settings.

        :param archive: Archive of such a model
        :param given: Settings of temperatures that were given; these stay as they were set up
        """
        if "ent_coef" in given and getattr(self, "curiosity_ent_coef", None) is None:
            given = {*given, "curiosity_ent_coef"}
        fresh = {name for key in given for name in _TEMPERATURES[key]}
        parameters = {key: state for key, state in archive.read("parameters").items() if key not in fresh}
        own = self.get_parameters()
        parameters |= {key: state for key, state in own.items() if key in fresh}
        others = sorted({key.split(".")[0] for key in parameters["policy"].keys() ^ own["policy"].keys()})
        if others:
            raise ValueError(
                f"{archive.name} was saved with other networks ({', '.join(others)}): load it with the srl=, "
                "intrinsic= and curiosity= of its training, or begin a new model with its encoder by transfer_from."
            )
        self.set_parameters(parameters, exact_match=True, device=self.device)
        variables, states = archive.read("variables"), archive.read("parts")
        with refusing(archive.name):
            for key in {*self._get_torch_save_params()[1]} - fresh:
                recursive_getattr(self, key).data.copy_(variables[key])
            for key, part in self._stateful_parts().items():
                if key in states:
                    part.load_state_dict(states[key])

    def set_parameters(
        self, load_path_or_dict: Any, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Load parameters into this model.

        Of a file only the tensors are read, so that pickled archives are safe, too.

        :param load_path_or_dict: An archive's path or file, or state dicts by name (see ``get_parameters``)
        :param exact_match: Whether all of the model's parameters have to be there, and no others
        :param device: As in SB3; the parameters stay on the model's device
        """
        if not isinstance(load_path_or_dict, dict):
            with reading(load_path_or_dict, "zip") as (file, name):
                archive = ModelArchive(file, name)
            if not archive.is_pickled:
                load_path_or_dict = archive.read("parameters")
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
        finally:
            for optimizer in self._optimizers():
                _lay_out_moments(optimizer)

    def _optimizers(self) -> Iterator[th.optim.Optimizer]:
        for name in self._get_torch_save_params()[0]:
            owner = recursive_getattr(self, name)
            # What is no optimiser itself may hold some by name.
            held = [owner, *getattr(owner, "optimizers", {}).values()]
            yield from (each for each in held if isinstance(each, th.optim.Optimizer))


def _lay_out_moments(optimizer: th.optim.Optimizer) -> None:
    """Give moments the strides of their parameters: fused Adam steps both in the order of memory."""
    has_moments = isinstance(optimizer, th.optim.Adam) or any(group.get("fused") for group in optimizer.param_groups)
    for parameter, state in optimizer.state.items():
        for key, value in state.items():
            if not isinstance(value, th.Tensor):
                continue
            is_count, fits = key in _COUNTS and value.dim() == 0, value.shape == parameter.shape
            if is_count or not (fits or has_moments):  # such as Adafactor's sums of rows and columns
                state[key] = value.clone()  # steps change it in place, and it may be another model's
                continue
            if not fits:
                optimizer.state.clear()  # a fused step would write beyond them
                raise ArchiveError(
                    f"an optimiser got {key:.20} of shape {tuple(value.shape)!s:.50} for a parameter of shape "
                    f"{tuple(parameter.shape)}: the parameters are of a model with other settings."
                )
            state[key] = th.empty_like(parameter, dtype=value.dtype).copy_(value)
