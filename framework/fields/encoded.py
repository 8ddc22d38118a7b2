"""Fields of an encoding with learnt features and small networks: Instant-NGP (Mueller et al. 2022), section 5.4."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.encodings.coarse_to_fine import OpenLevels
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.appearance import Appearance
from nerfloom.fields.base import MLP, Field
from nerfloom.fields.directional import Light, Reflection
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.math import at_least_float32, safe_normalize
from nerfloom.kernels.traced.colors import GridColor
from nerfloom.kernels.traced.trace import GridDensity

NUM_FEATURES = 16
"""Number of features that the density network passes to the colour network; the first is the log-density."""
TAP_DISTANCE = 1 / 512
"""Distance along each axis from a point to the four positions of `EncodedField.density_normals`, in shortest edges of
the box."""


class BoxField(Field):
    """A field with an encoding of a box, or of all of space contracted around the box.

    Args:
        box: (2, 3) corners of the box, scene units.
        encoding: encoding of positions in [0, 1]^3, or of positions and times in [0, 1]^4.
        unbounded: whether the encoding covers all of space, contracted by `contract_to_unit`.
    """

    box: Tensor
    scale: Tensor
    shift: Tensor
    runs_on_kernels = True

    def __init__(self, box: Tensor, encoding: HashGrid | FeaturePlanes, unbounded: bool = False) -> None:
        super().__init__()
        self.unbounded = unbounded
        self.register_buffer("box", box.clone(memory_format=torch.contiguous_format))
        size = box[1] - box[0]
        self.register_buffer("scale", 1 / size, persistent=False)
        self.register_buffer("shift", -box[0] / size, persistent=False)
        self.encoding = encoding

    def unit(self, positions: Tensor) -> Tensor:
        """Map `positions` (N, 3), scene coordinates, to the [0, 1]^3 of the encoding."""
        if self.unbounded:
            return contract_to_unit(positions, self.box)
        return torch.addcmul(self.shift, positions, self.scale)

    def encode(self, positions: Tensor, times: Tensor | None) -> Tensor:
        """Return the features (N, E) of the encoding.

        Args:
            positions: (N, 3) scene coordinates.
            times: (N,) in [0, 1]; not used if the encoding has no time axis.

        Raises:
            ValueError: if the encoding has a time axis and `times` is None.
        """
        unit = self.unit(positions)
        if self.encoding.dims == 4:
            if times is None:
                raise ValueError("this field changes with time: it needs the times of its positions")
            unit = torch.cat([unit, times[:, None].to(unit)], dim=-1)
        return self.encoding(unit)

    def encoded(self, points: Points) -> Tensor:
        """Return the features (N, E) of the encoding at N `points`; subclasses may use the points' size."""
        return self.encode(points.positions, points.times)

    def _grid_density(self, network: MLP) -> GridDensity | None:
        """Return the density of `network` on the encoding; None if the kernels do not support it."""
        grid = self.encoding
        if type(grid) is not HashGrid or type(network) is not MLP:
            return None
        if network.bias or network.activation != "none":
            return None
        if grid.opening is not None and not grid.opening.complete:
            return None
        if grid.deferred is not None:
            grid.deferred.layout = grid.layout
        weights, _ = network.parameters_by_layer()
        if weights[0].shape[1] != grid.num_features:  # the network has further inputs
            return None
        around = self.box if self.unbounded else None
        return GridDensity(self.scale, self.shift, grid.table, grid.layout, grid.deferred, weights, around)


class DensityField(BoxField):
    """A field of density without colour, for proposals: mip-NeRF 360 (Barron et al. 2022), section 3.

    Args:
        box, encoding, unbounded: as in `BoxField`.
        width: features of the hidden layer.
    """

    def __init__(
        self, box: Tensor, encoding: HashGrid | FeaturePlanes, width: int = 16, unbounded: bool = False
    ) -> None:
        super().__init__(box, encoding, unbounded)
        self.head = MLP(encoding.num_features, width, 1, bias=False)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        features = self.encoded(points)
        return self.head.density(features)[0], features

    def grid_density(self) -> GridDensity | None:
        """Return the density for `proposal_weights`; None for subclasses, which may override the density."""
        return self._grid_density(self.head) if type(self) is DensityField else None

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise NotImplementedError("a density field has no colours")


class EncodedField(BoxField):
    """A field with a density network on an encoding, and a colour network on its output and the viewing direction.

    Args:
        box, encoding, unbounded: as in `BoxField`.
        width: features of a hidden layer (64 in the paper).
        num_features: features that the density network passes to the colour network, the first being the log-density
            (16 in the paper).
        direction_levels: bands of the spherical harmonics of the viewing direction (4 in the paper); 0 for colours that
            do not depend on the direction.
        appearance: the images' appearance vectors, an input of the colour network; None without.
        opening: bands of the viewing direction open one after the other (`OpenLevels`) during this fraction of the
            training budget; 0: all are open.
        ambient: number of further coordinates (`Points.ambient`) that the density network takes.
        reflection: colours by the reflected direction. The density network then passes predicted normals and the
            properties of surfaces instead of `num_features`, and direction levels do not apply. None for colours by the
            viewing direction.
    """

    taps: Tensor

    def __init__(
        self,
        box: Tensor,
        encoding: HashGrid | FeaturePlanes,
        width: int = 64,
        num_features: int = NUM_FEATURES,
        direction_levels: int = 4,
        unbounded: bool = False,
        appearance: Appearance | None = None,
        opening: float = 0.0,
        ambient: int = 0,
        reflection: Reflection | None = None,
    ) -> None:
        super().__init__(box, encoding, unbounded)
        self.direction_levels, self.num_features = direction_levels, num_features
        if reflection is not None:
            self.direction_levels, self.num_features = 0, reflection.num_features
            corners = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])  # of a tetrahedron
            self.register_buffer("taps", TAP_DISTANCE * (box[1] - box[0]).min() * corners.to(box), persistent=False)
        self.density_head = MLP(encoding.num_features + ambient, width, self.num_features, bias=False)
        levels = self.direction_levels
        self.direction_opening = OpenLevels(levels, 1, opening) if opening and levels else None
        self.appearance, self.reflection = appearance, reflection
        self.color_head: MLP | None = None
        if reflection is None:
            inputs = num_features + levels**2 + (0 if appearance is None else appearance.size)
            self.color_head = MLP(inputs, width, width, 3, bias=False, activation="sigmoid")

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        encoded = self.encoded(points)
        if points.ambient is None:
            return self.density_head.density(encoded)
        return self.density_head.density(encoded, points.ambient.to(encoded.dtype))

    def grid_density(self) -> GridDensity | None:
        """Return the density for `trace`; None for subclasses, which may override the density."""
        return self._grid_density(self.density_head) if type(self) is EncodedField else None

    def grid_color(self) -> GridColor | None:
        """Return the colour for `traced_colors`; None for subclasses, which may override the colour."""
        head, opening = self.color_head, self.direction_opening
        if type(self) is not EncodedField or self.appearance is not None:
            return None
        if head is None or type(head) is not MLP:
            return None
        if opening is not None and not opening.complete:
            return None
        weights, _ = head.parameters_by_layer()
        fits = (weights[0].shape[1], weights[-1].shape[0]) == (self.num_features + self.direction_levels**2, 3)
        if head.bias or head.activation != "sigmoid" or not fits:
            return None
        return GridColor(self.direction_levels, weights)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        if self.color_head is None:
            return self.light(features, directions, camera_indices).rgb
        inputs = [features]
        if self.direction_levels:
            inputs.append(self._harmonics(directions).to(features.dtype))
        if self.appearance is not None:
            inputs.append(self.appearance(camera_indices, len(features)).to(features.dtype))
        return self.color_head(*inputs).float()

    def light(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Light:
        """Return the light of points, as `HasLight` does; an appearance changes the reflected light alone.

        `features`, `directions` and `camera_indices` are as there; the field has a `Reflection`.
        """
        assert self.reflection is not None
        vectors = () if self.appearance is None else (self.appearance(camera_indices, len(features)),)
        return self.reflection.of_density(features, directions, *vectors)

    def density_normals(self, points: Points) -> Tensor:
        """Return the normals of the density, as `HasDensityNormals` does; the field has a `Reflection`.

        They are differences of the log-density at four positions around a point, similar to Neuralangelo (Li et al.
        2023, section 3.2). Their gradients need first derivatives only, and the noise of single cells averages out.
        """
        around = (points.positions.detach()[:, None] + self.taps).view(-1, 3)
        logs = at_least_float32(self.density_head.first(self.encoded(Points(around)))).view(-1, len(self.taps), 1)
        return -safe_normalize((logs * self.taps.sign()).sum(1))

    def _harmonics(self, directions: Tensor) -> Tensor:
        opening, levels = self.direction_opening, self.direction_levels
        if opening is None or opening.complete:
            return spherical_harmonics(directions, levels)
        open_bands = spherical_harmonics(directions, opening.count)
        return opening.completed(open_bands, levels**2, 2 * opening.count - 1)
