"""Features that are looked up in images, and the field on them, against closed forms and symmetries."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.encodings.pixel_aligned import ImageEncoder, SourceViews
from nerfloom.evaluation.paths import look_at
from nerfloom.fields.pixel_aligned import PixelAlignedField
from nerfloom.geometry.lenses import LENSES
from nerfloom.geometry.points import Points

SIZES = torch.tensor([[24, 16], [24, 16], [24, 16]])


def cameras(model: str = "pinhole", lens: Tensor | None = None) -> Cameras:
    """Three cameras around the origin, in float64, with principal points outside of the middle."""
    up, middle = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    places = torch.tensor([[3.0, 0.5, 1.0], [-1.0, 2.5, 2.0], [0.5, -3.0, -0.5]], dtype=torch.float64)
    poses = torch.stack([look_at(place, middle, up) for place in places])
    fx, fy, cx, cy = torch.tensor([[21.0, 23.0, 11.5, 8.25]] * 3, dtype=torch.float64).T
    return Cameras(poses[:, :3], fx, fy, cx, cy, SIZES[:, 0], SIZES[:, 1], model, lens)


def points(count: int = 200, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.4


def ramps(dtype: torch.dtype = torch.float64) -> Tensor:
    """Columns and rows of the pixels, as features: interpolation between them is linear, so exact."""
    rows, columns = torch.meshgrid(torch.arange(16, dtype=dtype), torch.arange(24, dtype=dtype), indexing="ij")
    return torch.stack([columns, rows])


def test_a_feature_is_that_of_the_pixel_that_shows_the_point() -> None:
    """A pinhole camera in closed form: x = cx + fx X / -Z, y = cy - fy Y / -Z, and pixel centres at + 0.5."""
    views = SourceViews((ramps(),) * 3, cameras())
    found = views.aligned(points())
    for index in range(3):
        pose = torch.cat([cameras().camera_to_worlds[index], torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)])
        local = (torch.linalg.inv(pose) @ torch.cat([points(), torch.ones(200, 1).double()], 1).T).T
        column = 11.5 + 21.0 * local[:, 0] / -local[:, 2] - 0.5
        row = 8.25 - 23.0 * local[:, 1] / -local[:, 2] - 0.5
        expected = torch.stack([column.clamp(0, 23), row.clamp(0, 15)], dim=-1)
        assert int(((column > 0) & (column < 23) & (row > 0) & (row < 15)).sum()) > 150
        torch.testing.assert_close(found[index], expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", ["opencv", "fisheye", "orthographic"])
def test_features_follow_the_lens_of_a_camera(model: str) -> None:
    """A point on the ray of a pixel gets the pixel's features, for every lens."""
    lens = torch.zeros(3, len(LENSES[model]), dtype=torch.float64)
    lens[:, :2] = torch.tensor([0.1, -0.02])[: lens.shape[1]]
    views = SourceViews((ramps(),) * 3, cameras(model, lens))
    flat = torch.tensor([3 * 24 + 5, 8 * 24 + 12, 12 * 24 + 20]) + torch.arange(3) * 24 * 16
    rays = views.cameras.pixel_rays_reference(flat, 1.0, 5.0)
    found = views.aligned(rays.origins + 2.5 * rays.directions)
    expected = torch.tensor([[5.0, 3.0], [12.0, 8.0], [20.0, 12.0]], dtype=torch.float64)
    torch.testing.assert_close(found[range(3), range(3)], expected, rtol=0, atol=1e-6)


def test_colours_of_the_pixels_are_recovered() -> None:
    """The encoder returns its image, so a point on a pixel's ray has the pixel's own colour, in every view."""
    images = torch.rand(3, 3, 16, 24, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    views = SourceViews(tuple(images), cameras())
    rays = views.cameras.pixel_rays_reference(torch.arange(3 * 24 * 16), 1.0, 5.0)
    distances = 0.5 + 4 * torch.rand(len(rays), 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = views.aligned(rays.origins + distances * rays.directions)
    of_own = found.view(3, 3, 16, 24, 3)[range(3), range(3)]
    torch.testing.assert_close(of_own, images.permute(0, 2, 3, 1), rtol=0, atol=1e-9)


def test_a_coarser_map_covers_the_same_image() -> None:
    """Each value of a map of half the size belongs to the middle of four pixels."""
    coarse = ramps().unfold(1, 2, 2).unfold(2, 2, 2).mean((-1, -2))
    whole, halved = (SourceViews((features,) * 3, cameras()).aligned(points()) for features in (ramps(), coarse))
    inner = ((whole[..., 0] > 1) & (whole[..., 0] < 22) & (whole[..., 1] > 1) & (whole[..., 1] < 14))[..., None]
    assert int(inner.sum()) > 400
    torch.testing.assert_close(halved[inner.expand_as(halved)], whole[inner.expand_as(whole)], rtol=0, atol=1e-10)


def test_what_is_behind_a_camera_has_no_features() -> None:
    at = cameras()
    behind = at.camera_to_worlds[0, :, 3] + 2 * at.camera_to_worlds[0, :, 2]
    found = SourceViews((ramps() + 1,) * 3, at).aligned(behind[None])
    assert found[0].abs().max() == 0
    assert bool((found[2] >= 1).all())


def test_features_have_the_gradient_of_interpolation() -> None:
    features = ramps().requires_grad_()
    at = points(12)
    looked_up = lambda maps: SourceViews((maps,) * 3, cameras()).aligned(at)  # noqa: E731
    assert torch.autograd.gradcheck(looked_up, features, fast_mode=True)


@pytest.mark.parametrize("size", [(16, 24), (13, 19)])
def test_features_stay_in_the_middle_of_what_they_are_of(size: tuple[int, int]) -> None:
    """An encoder with convolutions that copy their middle returns colours, or at coarser levels means, in place."""
    encoder = ImageEncoder((3, 3, 3))
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            parameter.zero_()
            if name.startswith("first") and name.endswith("weight"):
                parameter[:, :, 1, 1] = torch.eye(3)
    rows, columns = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    image = 0.5 + 0.01 * torch.stack([rows + columns, rows, columns])[None].float()  # so that ReLU keeps it
    found = encoder(image).view(3, 3, *size)
    inner = (slice(None), slice(4, size[0] - 5), slice(4, size[1] - 5))
    for level in found:
        torch.testing.assert_close(level[inner], (2 * image[0] - 1)[inner], rtol=0, atol=1e-5)


def test_an_encoder_has_levels() -> None:
    for widths in ((), (8, 0), (8,) * 9):
        with pytest.raises(ConfigError, match="1 to 8 levels"):
            ImageEncoder(widths)


# -- the field ---------------------------------------------------------------------------------------------------------


def field_on(views: SourceViews | None) -> PixelAlignedField:
    """A field with all parameters at work, in float64."""
    torch.manual_seed(3)
    field = PixelAlignedField(2, 1.5, width=16, position_frequencies=3).double()
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    field.views = views
    return field


def asked(field: PixelAlignedField, at: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    sigma, features = field.density(Points(at))
    return sigma, field.color(features, directions)


def test_neither_the_scenes_frame_nor_the_order_of_views_matters() -> None:
    """Cameras, points and directions moved together see the same: the network works in the cameras' frames."""
    maps = tuple(torch.rand(3, 2, 16, 24, generator=torch.Generator().manual_seed(5), dtype=torch.float64))
    at, directions = points(), torch.nn.functional.normalize(points(seed=4), dim=-1)
    views = SourceViews(maps, cameras())
    expected = asked(field_on(views), at, directions)
    assert float(expected[0].detach().std()) > 1e-3
    assert float(expected[1].detach().std()) > 1e-3
    angle = torch.tensor(0.7, dtype=torch.float64)
    turn = torch.tensor([[1.0, 0, 0], [0, angle.cos(), -angle.sin()], [0, angle.sin(), angle.cos()]])
    turn, shift = turn.double(), torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64)
    poses = turn @ cameras().camera_to_worlds
    poses[:, :, 3] += shift
    moved = Cameras(poses, *(getattr(cameras(), name) for name in ("fx", "fy", "cx", "cy", "widths", "heights")))
    found = asked(field_on(SourceViews(maps, moved)), at @ turn.T + shift, directions @ turn.T)
    order = torch.tensor([2, 0, 1])
    mixed = SourceViews(tuple(maps[i] for i in order), cameras()[order])
    for one in (found, asked(field_on(mixed), at, directions)):
        for value, truth in zip(one, expected, strict=True):
            torch.testing.assert_close(value, truth, rtol=1e-9, atol=1e-10)


def test_the_mean_of_equal_views_is_a_view() -> None:
    one, many = cameras()[torch.tensor([1])], cameras()[torch.tensor([1, 1, 1])]
    at, directions = points(), torch.nn.functional.normalize(points(seed=4), dim=-1)
    results = [asked(field_on(SourceViews((ramps(),) * len(c), c)), at, directions) for c in (one, many)]
    for first, second in zip(*results, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-12, atol=1e-12)


def test_density_has_the_unit_of_an_inverse_length() -> None:
    """Everything twice as large is as opaque: half the density on twice the length."""
    at, poses = points(), cameras().camera_to_worlds
    doubled = poses.clone()
    doubled[:, :, 3] *= 2
    larger = Cameras(doubled, *(getattr(cameras(), name) for name in ("fx", "fy", "cx", "cy", "widths", "heights")))
    small, large = (field_on(SourceViews((ramps(),) * 3, c)) for c in (cameras(), larger))
    large.unit = 3.0
    torch.testing.assert_close(large.density(Points(2 * at))[0], small.density(Points(at))[0] / 2)


def test_a_field_without_views_says_so() -> None:
    with pytest.raises(ValueError, match="set its views first"):
        field_on(None).density(Points(points()))


def test_features_reach_the_images_gradient() -> None:
    """The loss of a point teaches the pixels that show it, and no others."""
    maps = torch.rand(3, 2, 16, 24, dtype=torch.float64, requires_grad=True)
    field_on(SourceViews(tuple(maps), cameras())).density(Points(points(1)))[0].sum().backward()
    assert maps.grad is not None
    taught = (maps.grad != 0).flatten(2).any(1).sum(-1).tolist()
    assert taught == [4, 4, 4]
    assert math.isfinite(float(maps.grad.sum()))
