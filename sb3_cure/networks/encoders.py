"""Shared encoders: a trunk that every part of the agent reads, and a projection to the latent state.

Architecture, initialisation and sizes follow SAC-AE (Yarats et al., 2019), which the CuRe paper uses (appendix A).
"""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_cure.data.observations import image_spaces
from sb3_cure.networks.layers import (
    Conv2dReLU,
    Convolutions,
    FlattenImage,
    Projection,
    RunningStandardize,
    conv_sizes,
    flatten_vectors,
    init_weights,
    scale_images,
)

#: ``PixelEncoder`` warns if its projection has more parameters; 84x84 pixels give 2 million
MANY_PARAMETERS = 20_000_000


class Encoder(BaseFeaturesExtractor):
    """Base class of encoders: ``latents = projection(trunk(views))``.

    Actors read the trunk's features *detached* and own a projection each; the critics and the SRL head read the latents
    and train both parts. Views are observations as stored, shifted or cropped by the policy's augmentation: images are
    uint8 in 0-255 (or floats in [0, 1]), vectors are neither standardised nor one-hot yet.

    :param observation_space: Space of the views
    :param features_dim: Size of the latent state
    :param trunk_dim: Size of the (flat) trunk features
    """

    trunk: nn.Module
    projection: nn.Module

    def __init__(self, observation_space: spaces.Space, features_dim: int, trunk_dim: int):
        super().__init__(observation_space, features_dim)
        self.trunk_dim = trunk_dim

    @property
    def view_space(self) -> spaces.Space:
        """Space of the views."""
        return self._observation_space

    def make_projection(self) -> nn.Module:
        """Build another projection of the trunk's features, as each actor owns one.

        :return: The projection, with fresh weights
        """
        fresh = copy.deepcopy(self.projection).requires_grad_(True)
        for module in fresh.modules():
            if hasattr(module, "reset_parameters"):
                module.reset_parameters()  # type: ignore[operator]
        return fresh

    def update_statistics(self, views: Any) -> None:
        """Move the running statistics of vectors; encoders of images have none.

        :param views: [B, *view shape]
        """

    def vector_target(self, views: Any) -> th.Tensor:
        """Flatten views of vectors as an autoencoder draws them: in the units in which the trunk reads them.

        :param views: [B, *view shape]
        :return: fp32, [B, n]
        """
        return flatten_vectors(views, self.view_space)

    def forward(self, views: Any) -> th.Tensor:
        """Encode views.

        :param views: [B, *view shape]
        :return: Latents, fp32, [B, features_dim]
        """
        return self.projection(self.trunk(views))


class PixelEncoder(Encoder):
    """3x3 convolutions, the first with stride 2, then a projection (SAC-AE's encoder).

    :param observation_space: Image space, channels first, [C, H, W]
    :param features_dim: Size of the latent state
    :param n_filters: Channels of each convolution
    :param n_layers: Number of convolutions
    :param tanh: Whether latents end in a tanh
    :raises ValueError: if the space is no image or smaller than the convolutions need
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 50,
        n_filters: int = 32,
        n_layers: int = 4,
        tanh: bool = True,
    ):
        shape = observation_space.shape
        if len(shape) != 3:
            raise ValueError(
                f"'CnnPolicy' reads images (channels, height, width), but observations have the shape {shape}: use "
                "'MlpPolicy' for vectors, or make_dmc_env / make_pixel_env for pixels."
            )
        height, width = conv_sizes(shape[1], shape[2], n_layers)[-1]
        super().__init__(observation_space, features_dim, trunk_dim=n_filters * height * width)
        self._warn_if_large()  # before any memory is allocated
        self.n_filters = n_filters
        self.n_layers = n_layers
        first = Conv2dReLU(shape[0], n_filters, 3, stride=2)
        further = (Conv2dReLU(n_filters, n_filters, 3) for _ in range(n_layers - 1))
        self.trunk = Convolutions(first, *further, FlattenImage())
        self.projection = Projection(self.trunk_dim, features_dim, tanh)
        init_weights(self)
        # NHWC kernels are the fast ones for convolutions on CPU and GPU; the values are the same.
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]

    def _warn_if_large(self) -> None:
        n = self.trunk_dim * self.features_dim
        if n > MANY_PARAMETERS:
            height, width = self.view_space.shape[1:]  # type: ignore[index]
            # Five fp32 numbers per parameter: weight, gradient, two moments of Adam, and the target's weight.
            warnings.warn(
                f"images of {height}x{width} pixels give the encoder's projection {n / 1e6:.0f} million parameters, "
                f"{20 * n / 1e9:.1f} GB with gradients, Adam's moments and the target encoder; each actor and pixel "
                "decoder has as many. Resize them: make_pixel_env(..., image_size=84), or the ResizeImages wrapper.",
                stacklevel=3,
            )


class VectorEncoder(Encoder):
    """Encoder of vectors: running standardisation and one hidden layer as the trunk, then a projection.

    :param observation_space: Any space without images that SB3 can flatten (Box, Discrete, ...), or a dictionary
    :param features_dim: Size of the latent state
    :param hidden_dim: Width of the hidden layer
    :param tanh: Whether latents end in a tanh
    """

    def __init__(
        self, observation_space: spaces.Space, features_dim: int = 50, hidden_dim: int = 256, tanh: bool = True
    ):
        super().__init__(observation_space, features_dim, trunk_dim=hidden_dim)
        vectors = RunningStandardize(observation_space)
        self.trunk = nn.Sequential(vectors, nn.Linear(len(vectors.mean), hidden_dim), nn.ReLU())
        self.projection = Projection(hidden_dim, features_dim, tanh)
        init_weights(self)

    def update_statistics(self, views: Any) -> None:
        """Move the running statistics.

        :param views: [B, *shape], or a dictionary of them
        """
        self.trunk[0].update(views)  # type: ignore[index, operator]

    def vector_target(self, views: Any) -> th.Tensor:
        """Flatten and standardise views: in raw units, forces of 100 N would drown joint angles in the error.

        :param views: [B, *shape], or a dictionary of them
        :return: fp32, [B, n]
        """
        return self.trunk[0](views)  # type: ignore[index, operator, no-any-return]


class DictTrunk(nn.Module):
    """Features of each image by its own trunk, and the standardised vectors, side by side.

    :param trunks: Trunks of the images, by key
    :param vectors: Standardises the vectors, or None if there are none
    """

    def __init__(self, trunks: Mapping[str, nn.Module], vectors: RunningStandardize | None):
        super().__init__()
        self.images = list(trunks)
        self.trunks = nn.ModuleList(trunks.values())
        self.vectors = vectors

    def forward(self, views: dict[str, th.Tensor]) -> tuple[th.Tensor, ...]:
        """Compute the features of each part.

        :param views: By key
        :return: Features of each image, [B, its trunk_dim]; then, if there are any, all vectors as one, fp32, [B, n]
        """
        features = [trunk(views[key]) for key, trunk in zip(self.images, self.trunks, strict=True)]
        return tuple(features if self.vectors is None else [*features, self.vectors(views)])


class DictProjection(nn.Module):
    """Joined latents of what ``DictTrunk`` returns: a projection for each image; vectors are joined as they are.

    One linear map of all features would drown the vectors.

    :param projections: Of the images, in their order
    """

    def __init__(self, projections: list[nn.Module]):
        super().__init__()
        self.parts = nn.ModuleList(projections)

    def forward(self, features: tuple[th.Tensor, ...]) -> th.Tensor:
        """Project and join the features.

        :param features: Of each part
        :return: Latents, fp32, [B, features_dim]
        """
        latents = [part(feature) for part, feature in zip(self.parts, features, strict=False)]
        return th.cat([*latents, *features[len(latents) :]], dim=1)


class DictEncoder(Encoder):
    """Encoder of dictionaries of images and vectors: one encoder per image; vectors are joined to their latents.

    Vectors need no network of their own: once standardised, their entries are about as large as those of latents.

    :param observation_space: Dictionary with at least one image
    :param by_key: Further arguments of the encoders of some images, by key
    :param kwargs: Arguments of all encoders, as for ``PixelEncoder``; ``features_dim`` is that of each
    :raises ValueError: If ``by_key`` names something that is no image
    """

    def __init__(
        self, observation_space: spaces.Dict, by_key: Mapping[str, Mapping[str, Any]] | None = None, **kwargs: Any
    ):
        found, own = image_spaces(observation_space), by_key or {}
        if unknown := own.keys() - found.keys():
            raise ValueError(f"by_key names {sorted(unknown)}, but the images are {sorted(found)}.")
        encoders = {key: PixelEncoder(space, **{**kwargs, **own.get(key, {})}) for key, space in found.items()}
        others = spaces.Dict([(key, space) for key, space in observation_space.spaces.items() if key not in found])
        vectors = RunningStandardize(others) if others.spaces else None
        vector_dim = 0 if vectors is None else len(vectors.mean)
        sizes = [encoder.features_dim for encoder in encoders.values()]
        trunk_dim = sum(encoder.trunk_dim for encoder in encoders.values()) + vector_dim
        super().__init__(observation_space, sum(sizes) + vector_dim, trunk_dim)
        #: Size of all vectors together
        self.vector_dim = vector_dim
        #: Encoders of the images by key. Their modules are registered in trunk and projection
        self.images = encoders
        #: Part of the joint latents that belongs to each image, by key
        self.slices = {key: slice(sum(sizes[:i]), sum(sizes[: i + 1])) for i, key in enumerate(encoders)}
        self.trunk = DictTrunk({key: encoder.trunk for key, encoder in encoders.items()}, vectors)
        self.projection = DictProjection([encoder.projection for encoder in encoders.values()])

    def update_statistics(self, views: dict[str, th.Tensor]) -> None:
        """Move the running statistics of the vectors, if there are any.

        :param views: By key
        """
        if self.trunk.vectors is not None:
            self.trunk.vectors.update(views)  # type: ignore[union-attr, operator]


class ExtractorTrunk(nn.Module):
    """An SB3 features extractor. It gets what SB3 would give it, in SB3's memory order and in fp32.

    :param extractor: The features extractor
    """

    def __init__(self, extractor: BaseFeaturesExtractor):
        super().__init__()
        self.extractor = extractor

    def forward(self, views: Any) -> th.Tensor:
        """Run the extractor.

        :param views: [B, *shape], or a dictionary of them
        :return: Features, [B, features_dim]
        """
        space = self.extractor._observation_space
        if isinstance(space, spaces.Dict):
            return self.extractor({key: _as_sb3(views[key], part) for key, part in space.spaces.items()})  # type: ignore[no-any-return]
        return self.extractor(_as_sb3(views, space))  # type: ignore[no-any-return]


def _as_sb3(views: th.Tensor, space: spaces.Space) -> th.Tensor:
    # User code may call `view`, which needs contiguous memory.
    views = views.contiguous()
    return scale_images(views) if is_image_space(space) else preprocess_obs(views, space)  # type: ignore[return-value]


class ExtractorEncoder(Encoder):
    """Any SB3 features extractor as the shared encoder: it is the trunk, and its features are the latents.

    :param extractor: The features extractor
    """

    def __init__(self, extractor: BaseFeaturesExtractor):
        super().__init__(extractor._observation_space, extractor.features_dim, trunk_dim=extractor.features_dim)
        self.trunk = ExtractorTrunk(extractor)
        self.projection = nn.Identity()


def make_encoder(
    extractor_class: type[BaseFeaturesExtractor], observation_space: spaces.Space, **kwargs: object
) -> Encoder:
    """Build the shared encoder from SB3's ``features_extractor_class`` and ``features_extractor_kwargs``.

    :param extractor_class: One of ours, or any ``BaseFeaturesExtractor``
    :param observation_space: Space of the views
    :param kwargs: Passed on to the class
    :return: The encoder
    :raises ValueError: if an ``Encoder`` has a ``forward`` of its own, which not all of its users would call
    """
    extractor = extractor_class(observation_space, **kwargs)  # type: ignore[arg-type]
    if not isinstance(extractor, Encoder):
        return ExtractorEncoder(extractor)
    if type(extractor).forward is not Encoder.forward:
        raise ValueError(
            f"{extractor_class.__name__} overrides forward, but agents call trunk and projection, too: override these."
        )
    return extractor
