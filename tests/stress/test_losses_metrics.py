"""Losses and metrics: of nothing, of mass at the far end, of planes with different sides, of black images."""

import math
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.data.depths import read_depths
from nerfloom.data.scene import Scene
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.evaluation.lpips import load_lpips
from nerfloom.evaluation.metrics import MAX_PSNR, psnr, ssim
from nerfloom.geometry.rays import Histogram, Samples
from nerfloom.kernels.compositing.density import distortion
from nerfloom.kernels.grids.plane_bands import squared_steps, variation
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.losses.functions import depth_error, mean_squared_error
from nerfloom.methods.kplanes import METHOD, KPlanes, KPlanesConfig, PlaneRegularity
from nerfloom.samplers.proposal import interlevel_loss
from tests.images import parsed
from tests.kernels.compiled import relative_error
from tests.kernels.distortion_by_pairs import distortion_by_pairs
from tests.stress.backends import FEW, backends

# -- distortion ---------------------------------------------------------------------------------------------------


@pytest.mark.entry(21)
@backends()
@pytest.mark.parametrize("width", [2.0**-6, 2.0**-10, 2.0**-16])
def test_distortion_of_mass_at_the_far_end(backend: str, width: float) -> None:
    """Intervals that end at s = 1: differences of products lose 5.8 % there where sums are carelessly taken."""
    rays, bins = 8, 32
    edges = (1 - width * torch.arange(bins, -1, -1, dtype=torch.float64)).expand(rays, -1)
    weights = torch.rand(rays, bins, generator=torch.Generator().manual_seed(0)) ** 3
    weights = (weights / weights.sum(-1, keepdim=True)).reshape(-1).requires_grad_()
    exact = weights.detach().double().requires_grad_()
    truth = distortion_by_pairs(exact, Samples.regular(edges[:, :-1], edges[:, 1:]))
    found = distortion(weights, Samples.regular(edges[:, :-1].float(), edges[:, 1:].float()))
    (slope,) = torch.autograd.grad(found.sum(), weights)
    (true_slope,) = torch.autograd.grad(truth.sum(), exact)
    errors = relative_error(found, truth), relative_error(slope, true_slope)
    print(f"{backend}: distortion in intervals of {width:.1e} before s = 1 off by {errors[0]:.1e}, {errors[1]:.1e}")
    assert all(error < 5e-3 for error in errors)


@pytest.mark.entry(21)
@backends()
@pytest.mark.parametrize("layout", ["alone", "behind empty space", "packed"])
def test_distortion_of_two_intervals_next_to_the_end(backend: str, layout: str) -> None:
    """They are as short as float32 can make them. With w = 2^-23, slopes are 2 sum_j w_j |m_i - m_j| + 2 w_i w / 3."""
    width, weights = 2.0**-23, torch.tensor([0.3, 0.7])
    edges = 1 - width * torch.tensor([[2.0, 1.0, 0.0]])
    if layout == "behind empty space":
        edges, weights = torch.cat([torch.zeros(1, 1), edges], dim=-1), torch.tensor([0.0, 0.3, 0.7])
    samples = Samples.regular(edges[:, :-1], edges[:, 1:])
    if layout == "packed":  # behind a ray that is NaN, and one without samples
        nan = torch.tensor([math.nan])
        starts, ends = torch.cat([nan, samples.t_starts]), torch.cat([nan, samples.t_ends])
        samples, weights = Samples(starts, ends, torch.tensor([0, 1, 1, 3])), torch.cat([nan, weights])
    weights.requires_grad_()
    found = distortion(weights, samples)[-1]
    (slopes,) = torch.autograd.grad(found, weights)
    assert found.item() == pytest.approx((2 * 0.3 * 0.7 + (0.3**2 + 0.7**2) / 3) * width, rel=1e-3)
    truth = [(2 * 0.7 + 2 * 0.3 / 3) * width, (2 * 0.3 + 2 * 0.7 / 3) * width]
    assert slopes[-2:].tolist() == pytest.approx(truth, rel=1e-3)


# -- losses of nothing --------------------------------------------------------------------------------------------


@pytest.mark.entry(4)
def test_losses_of_no_rays_are_zero_and_harmless() -> None:
    nothing = torch.zeros(0, 3, requires_grad=True)
    flat = torch.zeros(0, requires_grad=True)
    edges = torch.zeros(0, 5)
    samples = Samples.regular(edges[:, :-1], edges[:, 1:])
    proposed = Samples(
        samples.t_starts, samples.t_ends, samples.offsets, edges=edges, proposals=(Histogram(edges, flat.view(0, 4)),)
    )
    losses = [
        mean_squared_error(nothing, torch.zeros(0, 3)),
        mean_squared_error(nothing, torch.zeros(0, 3), torch.zeros(0)),
        depth_error(flat, samples, torch.zeros(0)),
        interlevel_loss(proposed, flat),
        distortion(flat, samples).sum(),
    ]
    assert [loss.item() for loss in losses] == [0.0] * 5
    torch.stack(losses).sum().backward()
    assert nothing.grad is not None
    assert nothing.grad.shape == (0, 3)


@pytest.mark.entry(8)
@pytest.mark.parametrize("known", [[0.0, 0.0], [0.0, 2.0], [1e-30, 1e30]])
def test_depths_that_are_unknown_or_beyond_all_measure(known: list[float]) -> None:
    """0 is not divided by; both the loss and its gradient are finite."""
    samples = Samples.regular(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), torch.tensor([[1.0, 3.0], [1.0, 3.0]]))
    weights = torch.tensor([0.5, 0.4, 0.3, 0.2], requires_grad=True)
    loss = depth_error(weights, samples, torch.tensor(known))
    loss.backward()
    truth = [
        math.fsum(w * min(abs(t - d) / d, 1.0) for w, t in zip(row, (0.5, 2.0), strict=True))
        for row, d in zip(((0.5, 0.4), (0.3, 0.2)), known, strict=True)
        if d > 0
    ]
    assert loss.item() == pytest.approx(math.fsum(truth) / max(len(truth), 1), rel=1e-6)
    assert weights.grad is not None
    assert bool(weights.grad.isfinite().all())


@pytest.mark.entry(1)
def test_a_depth_image_of_far_things_stays_finite(tmp_path: Path) -> None:
    """An infinite distance would make the depth loss NaN: infinity over infinity."""
    np.save(tmp_path / "depth.npy", np.full((4, 4), 1e5, np.float32))
    cameras = parsed([tmp_path / "photograph.png"], [(4, 4)]).cameras
    assert bool(read_depths([tmp_path / "depth.npy"], cameras, 1.0).isfinite().all())


# -- total variation ----------------------------------------------------------------------------------------------


def steps_by_hand(plane: list[list[list[float]]], dim: int) -> float:
    """Mean squared difference of neighbours along a dimension, one by one; 0 where there are none."""
    squares = []
    for j, row in enumerate(plane):
        for i, values in enumerate(row):
            other = (j + 1, i) if dim == 0 else (j, i + 1)
            if other[0] < len(plane) and other[1] < len(row):
                squares += [(b - a) ** 2 for a, b in zip(values, plane[other[0]][other[1]], strict=True)]
    return math.fsum(squares) / len(squares) if squares else 0.0


@pytest.mark.entry(25)
@FEW
@given(height=st.integers(1, 6), width=st.integers(1, 6), features=st.integers(1, 3))
def test_total_variation_of_planes_of_any_sides(height: int, width: int, features: int) -> None:
    plane = torch.randn(height, width, features, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    along = [steps_by_hand(plane.tolist(), dim) for dim in (0, 1)]
    assert [squared_steps(plane, dim).item() for dim in (0, 1)] == pytest.approx(along, rel=1e-12)
    assert variation([plane]).item() == pytest.approx(sum(along), rel=1e-12)


@pytest.fixture
def moving_planes(monkeypatch: pytest.MonkeyPatch) -> KPlanes:
    """K-Planes in space and time, with different sides, and with whole bands of space planes."""
    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 4.0, 1, True, True, 8, num_times=1)
    config = KPlanesConfig(
        base_resolution=6, num_scales=2, time_resolution=5, features_per_scale=4, grid_resolution=8, num_steps=16
    )
    model = METHOD.build(config, scene)
    assert isinstance(model, KPlanes)

    drawn = FeaturePlanes._drawn
    monkeypatch.setattr(FeaturePlanes, "_drawn", lambda planes, factors, whole: drawn(planes, factors, range(4)))
    return model


def variation_by_torch(table: Tensor, layout: PlanesLayout) -> tuple[Tensor, Tensor, Tensor]:
    """K-Planes' equations 4 to 6 on every plane whole: variation in space, roughness in time, distance from one."""
    variations, roughness, activity = [], [], []
    for group, factors in enumerate(layout.axes):
        for index, axes in enumerate(factors):
            plane = layout.factor(table, group, index)
            across = (plane[:, 1:] - plane[:, :-1]).square().mean()
            if axes[1] < 3:
                variations.append((across + (plane[1:] - plane[:-1]).square().mean()) / 2)
                continue
            variations.append(across)
            roughness.append((plane[2:] - 2 * plane[1:-1] + plane[:-2]).square().mean())
            activity.append((1 - plane).abs().mean())
    return tuple(torch.stack(terms).mean() for terms in (variations, roughness, activity))


@pytest.mark.entry(25)
@backends()
def test_regularisers_of_planes_in_space_and_time(backend: str, moving_planes: KPlanes) -> None:
    """Value and gradient, deferred or not, against float64: planes of 6 x 6, 12 x 12, 6 x 5 and 12 x 5.

    A step uses one plane of time, so the mean over all of them is compared; on a GPU it uses all.
    """
    planes = moving_planes.field.encoding
    assert planes.layout.resolutions == ((6, 6, 6, 5), (12, 12, 12, 5))
    with torch.no_grad():
        planes.table.copy_(torch.rand(planes.table.shape, generator=torch.Generator().manual_seed(0)) * 2)
    exact = planes.table.detach().double().requires_grad_()
    truth = variation_by_torch(exact, planes.layout)
    turns = [PlaneRegularity("planes").of(moving_planes.field, torch.zeros(()), turn) for turn in range(6)]
    found = [torch.stack(values).mean() for values in zip(*turns, strict=True)]
    at_once = PlaneRegularity("planes").of(moving_planes.field, torch.zeros(()), None)
    for value, all_planes, expected in zip(found, at_once, truth, strict=True):
        assert value.item() == pytest.approx(expected.item(), rel=1e-5)
        assert all_planes.item() == pytest.approx(expected.item(), rel=1e-5)
    sum(found).backward()
    sum(truth).backward()
    slope = torch.zeros_like(planes.table) if planes.table.grad is None else planes.table.grad.clone()
    if planes.deferred.pending:
        slope += planes.deferred.summed(planes.table.detach())
    assert exact.grad is not None
    assert relative_error(slope, exact.grad) < 1e-5


# -- metrics ------------------------------------------------------------------------------------------------------


@pytest.mark.entry(22)
@FEW
@given(a=st.floats(0, 1), b=st.floats(0, 1))
def test_ssim_of_plain_images_shows_its_data_range(a: float, b: float) -> None:
    """(2 a b + c1) / (a^2 + b^2 + c1), c1 = (0.01 * 1)^2: with a range of 2 or 255 it would be another number."""
    first, second = (torch.full((12, 15, 3), value, dtype=torch.float64) for value in (a, b))
    assert ssim(first, second) == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-9)


@pytest.mark.entry(22)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_identical_images_of_any_type(dtype: torch.dtype, value: float) -> None:
    image = torch.full((11, 11, 3), value, dtype=dtype)
    assert psnr(image, image) == MAX_PSNR
    assert ssim(image, image) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.entry(22)
def test_almost_identical_and_opposite_images_stay_in_range() -> None:
    black, white = torch.zeros(11, 11, 3), torch.ones(11, 11, 3)
    assert psnr(black + 1e-30, black) == MAX_PSNR
    assert psnr(black + 1e-4, black) == pytest.approx(80, abs=1e-3)
    assert psnr(white, black) == 0
    assert 0 < ssim(white, black) < 1e-3


@pytest.mark.entry(3, 22)
def test_a_nan_in_a_picture_is_seen_in_the_metrics() -> None:
    """And not taken for an identical image, or left out of the mean."""
    target = torch.full((12, 12, 3), 0.5)
    broken = target.clone()
    broken[3, 4, 1] = math.nan
    assert math.isnan(psnr(broken, target))
    assert math.isnan(ssim(broken, target))


@pytest.mark.entry(22)
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_lpips_is_shown_images_from_minus_one_to_one(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Images in [0, 1] go to the network, here a double of it, as float32 in [-1, 1]."""
    shown: list[Tensor] = []

    class Network:
        def __init__(self, net: str, verbose: bool) -> None:
            assert net == "alex"

        def eval(self) -> "Network":
            return self

        def to(self, device: torch.device) -> "Network":
            return self

        def __call__(self, *pair: Tensor) -> Tensor:
            shown.extend(pair)
            return torch.tensor([[[[0.25]]]])

    for name in ("lpips", "torchvision"):
        module = ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)
        module.LPIPS = Network  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-double.pth").touch()
    measure, note = load_lpips(None, torch.device("cpu"))
    assert note == "alex, version 0.1, of the lpips package"
    assert measure is not None
    prediction = torch.zeros(12, 16, 3, dtype=dtype)
    prediction[0] = 0.5
    assert measure(prediction, torch.ones(12, 16, 3, dtype=dtype), None) == 0.25
    assert [image.dtype for image in shown] == [torch.float32] * 2
    assert [tuple(image.shape) for image in shown] == [(1, 3, 12, 16)] * 2
    assert shown[0][:, :, 0].unique().tolist() == [0]
    assert shown[0][:, :, 1:].unique().tolist() == [-1]
    assert shown[1].unique().tolist() == [1]
