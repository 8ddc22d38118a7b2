"""Sources of batches: whole images, and the state that a source carries over to a changed data set."""

from dataclasses import replace

import pytest
import torch

from nerfloom.base.device import seed_step
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.contradicted import ContradictedTiles
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.sources import PixelSource, Request, ViewSource, make_source
from nerfloom.data.sparse_depth import SparseDepth
from nerfloom.registry import load_method
from tests.images import write_noise

SIZES = [(20, 10), (7, 30), (16, 16)]


@pytest.fixture(scope="module", params=[3, 4], ids=["rgb", "rgba"])
def images(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("images")
    return load_dataset(write_noise(folder, SIZES, channels=request.param, suffix=".png"), "train")


def test_a_view_is_a_whole_image_over_its_background(images: Dataset) -> None:
    source = ViewSource(images, "random", 7)
    drawn = []
    for step in range(40):
        seed_step(3, step)
        batch = source.draw(Request(step, 0))
        drawn.append(batch.index)
        width, height = SIZES[batch.index]
        assert batch.rgb.shape == (height, width, 3)
        assert len(batch) == height * width
        assert (batch.view.height, batch.view.width) == (height, width)
        pose = images.cameras.camera_to_worlds[batch.index]
        assert torch.equal(batch.view.camera.camera_to_worlds[0], pose)
        truth = images.image(batch.index).double() / 255
        if truth.shape[-1] == 3:
            assert batch.alpha is None
            expected = truth
        else:
            alpha = truth[..., 3:]
            torch.testing.assert_close(batch.alpha.double(), alpha[..., 0])
            expected = truth[..., :3] * alpha + batch.background.double() * (1 - alpha)
        torch.testing.assert_close(batch.rgb.double(), expected, atol=1e-6, rtol=0)
    assert set(drawn) == {0, 1, 2}


def test_the_seed_and_the_step_decide_which_view_is_drawn(images: Dataset) -> None:
    def drawn(seed: int) -> list[tuple[int, list[float]]]:
        found = []
        for step in range(12):
            seed_step(seed, step)
            batch = ViewSource(images, "random", 7).draw(Request(step, 0))
            found.append((batch.index, batch.background.tolist()))
        return found

    assert drawn(1) == drawn(1)
    assert drawn(1) != drawn(2)
    assert len({tuple(background) for _, background in drawn(1)}) == 12


@pytest.mark.parametrize(("background", "value"), [("white", 1.0), ("black", 0.0)])
def test_a_fixed_background_is_the_same_in_every_view(images: Dataset, background: str, value: float) -> None:
    source = ViewSource(images, background, 7)
    assert all(source.draw(Request(step, 0)).background.tolist() == [value] * 3 for step in range(3))


def test_a_source_is_made_as_the_model_asks(images: Dataset) -> None:
    config = load_method("instant-ngp").config
    views, pixels = (make_source(kind, images, config) for kind in ("views", "pixels"))
    assert isinstance(views, ViewSource)
    assert isinstance(pixels, PixelSource)
    assert images.scene.has_alpha or images.scene.ends_in_box
    assert views.background == pixels.background == "random"


def test_what_was_learnt_of_errors_goes_along_to_a_changed_data_set(images: Dataset) -> None:
    source = PixelSource(images, "black", 0, contradicted=ContradictedTiles(images))
    request = Request(0, 50)
    batch = source.draw(request)
    source.learn(request, batch, batch.rgb + 3)
    learnt = source.state()
    assert learnt is not None
    assert len(learnt.unique()) > 1
    some = PixelSet.of_mask(torch.arange(len(images.pixels)) % 2 == 0)
    changed = source.drawing_from(images.drawing(some))
    assert changed.state() is learnt
    assert bool((changed.draw(Request(1, 200)).pixels % 2 == 0).all())
    other = PixelSource(images, "black", 0, contradicted=ContradictedTiles(images))
    other.restore(learnt)
    assert torch.equal(other.state(), learnt)


def test_a_view_has_the_distances_of_its_sparse_points(images: Dataset) -> None:
    ends = images.cameras.ends
    pixels = torch.tensor([ends[0] + 3, ends[1], ends[1] + 7, ends[2] - 1, ends[2] + 5])
    distances = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])
    known = replace(images, sparse_depth=SparseDepth(pixels, distances, torch.ones(5)))
    source = ViewSource(known, "white", 7)
    found = {batch.index: batch.distances for batch in (source.draw(Request(step, 0)) for step in range(len(images)))}
    for index in range(len(images)):
        expected = torch.zeros(ends[-1])
        expected[pixels] = distances
        shape = images.cameras.sizes[index]
        assert torch.equal(found[index], expected[ends[index] : ends[index + 1]].view(*shape)), index  # type: ignore[arg-type]
    assert ViewSource(images, "white", 7).draw(Request(0, 0)).distances is None
