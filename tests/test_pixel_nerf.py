"""pixel-nerf: which images a view is rendered from, that scenes are kept apart, and that it learns to see new ones."""

import dataclasses
import math
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.data.source_views import images_of, nearest_in_direction, other_images
from nerfloom.data.sources import Request, make_source
from nerfloom.dataparsers.procedural import Procedural
from nerfloom.evaluation.evaluator import evaluate, views_to_judge
from nerfloom.evaluation.metrics import psnr
from nerfloom.methods.pixel_nerf import METHOD, PixelNeRF, PixelNeRFConfig
from nerfloom.renderable import RendersFromImages
from nerfloom.stress.faults import spoiled_pose
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trained import load_trained
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY, tiny_trainer

SMALL = dataclasses.replace(PixelNeRFConfig(), machine=MachineConfig(device_type="cpu"), **TINY["pixel-nerf"])
WHITE = torch.ones(3)


@pytest.fixture(scope="session")
def many(_cache: None) -> dict[str, Dataset]:
    """Three scenes to learn from and further ones, with six views each."""
    parser = Procedural(size=16, num_scenes=3, views_per_scene=6)
    return {split: load_dataset(parser.parse(None, split), split) for split in ("train", "val", "test")}


def built(dataset: Dataset, config: PixelNeRFConfig = SMALL) -> PixelNeRF:
    torch.manual_seed(0)
    model = METHOD.build(config, dataset.scene)
    assert isinstance(model, PixelNeRF)
    model.show_images(dataset)
    return model


class Seen(nn.Module):
    """An encoder that returns its images, and keeps them."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[Tensor] = []

    def forward(self, images: Tensor) -> Tensor:
        self.images.append(images)
        return images


def indices_of(images: Tensor, dataset: Dataset) -> list[int]:
    """Which images of a data set these (V, 3, H, W) are, over white."""
    every = torch.stack(
        [composite(dataset.image(i).float() / 255, WHITE).permute(2, 0, 1) for i in range(len(dataset))]
    )
    found = [(every - image).flatten(1).abs().amax(-1) for image in images]
    assert all(float(differences.min()) == 0 for differences in found)
    return [int(differences.argmin()) for differences in found]


# -- which images ------------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_training_image_is_learnt_from_others_of_its_scene(many: dict[str, Dataset]) -> None:
    """Never from itself, never from another scene's, and from each of the others as often as not."""
    train = many["train"]
    model = built(train)
    drawn = []
    for _ in range(60):
        model.encoder = seen = Seen()  # type: ignore[assignment]
        views = model.drawn_views(8)
        numbers = indices_of(seen.images[0], train)
        assert len(set(numbers)) == len(views) == SMALL.num_source_views
        assert torch.equal(views.cameras.camera_to_worlds, train.cameras.camera_to_worlds[numbers])
        drawn += numbers
    assert set(drawn) == {6, 7, 9, 10, 11}  # scene 1 has images 6 to 11
    assert min(drawn.count(number) for number in set(drawn)) > 10


def test_a_view_of_an_unseen_scene_is_rendered_from_its_nearest_source_images(many: dict[str, Dataset]) -> None:
    test = many["test"]
    model = built(many["train"])
    model.show_images(test)
    assert test.source_images is not None
    for index in views_to_judge(test):
        model.encoder = seen = Seen()  # type: ignore[assignment]
        model.nearest_views(test.view(index))
        chosen = indices_of(seen.images[0], test)
        possible = [i for i in range(6 * (index // 6), 6 * (index // 6) + 6) if bool(test.source_images[i])]
        axes = -test.cameras.camera_to_worlds[:, :, 2].double()
        angles = {i: math.acos(min(float(axes[i] @ axes[index]), 1.0)) for i in possible}
        assert chosen == sorted(possible, key=angles.__getitem__)[: SMALL.num_source_views]


def test_an_image_is_never_rendered_from_itself(many: dict[str, Dataset]) -> None:
    train = many["train"]
    model = built(train, dataclasses.replace(SMALL, num_source_views=64))
    model.encoder = seen = Seen()  # type: ignore[assignment]
    model.nearest_views(train.view(14))
    assert sorted(indices_of(seen.images[0], train)) == [12, 13, 15, 16, 17]


def test_images_at_several_sizes_are_the_same_view_if_they_have_the_same_pose(many: dict[str, Dataset]) -> None:
    parser = Procedural(size=16, num_scenes=3, views_per_scene=6)
    twice = load_dataset(dataclasses.replace(parser.parse(None, "train"), num_scales=2), "train")
    others = other_images(twice, images_of(twice, 1), twice.cameras.camera_to_worlds[8])
    assert others.tolist() == [6, 7, 9, 10, 11, 24, 25, 27, 28, 29]
    nearest = nearest_in_direction(twice, others, twice.cameras.camera_to_worlds[8], 2)
    assert twice.names[int(nearest[0])] == twice.names[int(nearest[1])]
    views = built(twice).drawn_views(30)  # of both sizes, each encoded at its own
    assert {features.shape[1:] for features in views.features} <= {(16, 16), (8, 8)}


def test_data_of_one_scene_is_rendered_from_the_training_images() -> None:
    ball = ball_in_a_box()
    model = built(ball)
    model.encoder = seen = Seen()  # type: ignore[assignment]
    view = dataclasses.replace(ball.view(2), camera=ball.cameras[torch.tensor([2])])
    model.nearest_views(view)
    assert 2 not in indices_of(seen.images[0], ball)
    assert images_of(ball, None).tolist() == list(range(len(ball)))


def test_nothing_is_rendered_from_an_image_whose_pose_is_not_finite() -> None:
    ball = spoiled_pose(ball_in_a_box(), math.nan)
    assert images_of(ball, None).tolist() == list(range(1, len(ball)))
    model = built(ball, dataclasses.replace(SMALL, num_source_views=64))
    assert all(features.isfinite().all() for features in model.nearest_views(ball.view(2)).features)


def test_what_cannot_be_rendered_says_why(many: dict[str, Dataset]) -> None:
    model = METHOD.build(SMALL, many["train"].scene)
    assert isinstance(model, PixelNeRF)
    with pytest.raises(ConfigError, match="has none"):
        model.render_view(many["train"].view(0), WHITE)
    with pytest.raises(ConfigError, match="has none"):
        model.render(many["train"].cameras.pixel_rays(torch.arange(4), 2.0, 6.0), WHITE)
    model.show_images(many["train"])
    with pytest.raises(DataError, match="no images of scene 99"):
        model.render_view(dataclasses.replace(many["train"].view(0), scene=99), WHITE)
    few = dataclasses.replace(many["train"], scene_indices=torch.tensor([0] * 17 + [1]))
    with pytest.raises(DataError, match="at least 2 images"):
        model.show_images(few)
    with pytest.raises(ConfigError, match="--ndc False"):
        METHOD.build(SMALL, dataclasses.replace(many["train"].scene, warped=True))


@pytest.mark.parametrize("method", ["vanilla-nerf", "instant-ngp", "gaussian-splatting"])
def test_methods_that_learn_one_scene_refuse_several(method: str, many: dict[str, Dataset]) -> None:
    from nerfloom.registry import load_method

    with pytest.raises(ConfigError, match=f"shows 3 scenes, and {method} learns one") as raised:
        load_method(method).build(load_method(method).config, many["train"].scene)
    assert "\n" not in str(raised.value)
    assert isinstance(built(many["train"]), RendersFromImages)


# -- learning ----------------------------------------------------------------------------------------------------------


def test_the_loss_is_that_of_each_image_from_its_own_views(many: dict[str, Dataset]) -> None:
    """The mean over images, each rendered by itself from views of its own scene, in the order of the batch."""
    train = many["train"]
    model = built(train)
    fixed = {image: model.encoded(train, torch.tensor([image // 6 * 6, image // 6 * 6 + 1])) for image in range(18)}
    model.drawn_views = fixed.__getitem__  # type: ignore[method-assign, assignment]
    torch.manual_seed(0)
    batch = make_source("pixels", train, SMALL).draw(Request(0, 64))
    images = batch.rays.camera_indices
    assert 2 <= len(images.unique()) <= SMALL.images_per_batch
    model.eval()  # samples at fixed positions
    loss = model.loss(batch, 0)
    alone = torch.empty(64, 3)
    for image in images.unique().tolist():
        with model.looking_at(fixed[image]):
            alone[images == image] = model.render(batch.rays[images == image], batch.background[images == image]).rgb
    torch.testing.assert_close(loss.rgb, alone.detach(), rtol=0, atol=1e-6)
    torch.testing.assert_close(loss.terms["rgb"], (alone - batch.rgb).square().mean())
    assert loss.num_samples == 64 * (SMALL.num_coarse_samples + SMALL.num_fine_samples)
    assert model.field.views is None


def test_a_step_teaches_the_encoder_and_looks_at_few_images(many: dict[str, Dataset]) -> None:
    model = built(many["train"])
    batch = make_source("pixels", many["train"], SMALL).draw(Request(0, 64))
    model.loss(batch, 0).total.backward()
    assert all(p.grad is not None for p in model.parameters())
    first = model.encoder.first[0].get_parameter("weight").grad
    assert first is not None
    assert float(first.abs().max()) > 0


def trained_on_many(folder: Path, parser: Procedural, config: PixelNeRFConfig) -> tuple[Trainer, Dataset]:
    """A trainer of many scenes, and the test images."""
    run = Run("pixel-nerf", dataclasses.replace(config, vis="none"), "procedural", parser, folder)
    create_folder(run)
    sets = {split: load_dataset(run.parse(split), split) for split in ("train", "val", "test")}
    return Trainer.of(run, sets["train"], sets["val"]), sets["test"]


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The method by its name, also where the package was installed before it had this one."""
    from nerfloom import registry

    monkeypatch.setenv("NERFLOOM_METHODS", "pixel-nerf=nerfloom.methods.pixel_nerf:METHOD")
    registry.registered.cache_clear()


@pytest.mark.medium
@pytest.mark.usefixtures("registered")
def test_a_run_learns_is_loaded_and_renders_unseen_scenes(tmp_path: Path) -> None:
    parser = Procedural(size=16, num_scenes=3, views_per_scene=6)
    config = dataclasses.replace(SMALL, max_num_iterations=60, steps_per_eval_all_images=30, learning_rate=1e-2)
    trainer, test = trained_on_many(tmp_path / "run", parser, config)
    errors = [float(trainer.train_step().terms["rgb"]) for _ in range(60)]
    assert fmean(errors[-20:]) < 0.75 * fmean(errors[:10])
    trainer.save()
    loaded = load_trained(tmp_path / "run", device_type="cpu")
    before, after = (evaluate(model, test, max_images=2).results["psnr"] for model in (trainer.model, loaded.model))
    assert before == after
    assert len(evaluate(loaded.model, test).per_image) == 8  # one of six views is judged of each scene


@pytest.mark.medium
@pytest.mark.usefixtures("registered")
def test_learnt_weights_render_other_data(tmp_path: Path, shared_tiny: Path) -> None:
    """A checkpoint of many scenes fits data of one; its training images are then the source views."""
    trainer, _ = trained_on_many(tmp_path / "many", Procedural(size=16, num_scenes=2, views_per_scene=6), SMALL)
    trainer.train_step()
    one = tiny_trainer(
        "pixel-nerf", shared_tiny, tmp_path / "one", load_checkpoint=trainer.save(), max_num_iterations=1
    )
    one.restore_as_configured()
    assert one.train().reason == "1 step done"
    for name, value in trainer.model.state_dict().items():
        assert torch.equal(one.model.state_dict()[name], value)
    shown = one.model.render_view(one.train_set.view(3), WHITE).rgb
    assert shown.shape == (20, 20, 3)
    assert bool(shown.isfinite().all())


class Blind(nn.Module):
    """An encoder that sees nothing."""

    def __init__(self, num_features: int) -> None:
        super().__init__()
        self.num_features = num_features

    def forward(self, images: Tensor) -> Tensor:
        return images.new_zeros(len(images), self.num_features, *images.shape[-2:])


def baselines(dataset: Dataset) -> tuple[float, float]:
    """PSNR of the source images' mean colour, and of the source image nearest in direction."""
    mean, nearest = [], []
    for index in views_to_judge(dataset):
        truth = composite(dataset.image(index).float() / 255, WHITE)
        sources = images_of(dataset, dataset.view(index).scene)
        rgb = torch.stack([composite(dataset.image(i).float() / 255, WHITE) for i in sources.tolist()])
        chosen = nearest_in_direction(dataset, sources, dataset.cameras.camera_to_worlds[index], 1)
        mean.append(psnr(rgb.mean((0, 1, 2)).expand_as(truth), truth))
        nearest.append(psnr(rgb[sources == chosen][0], truth))
    return fmean(mean), fmean(nearest)


@pytest.mark.slow
@pytest.mark.usefixtures("registered")
def test_unseen_scenes_are_rendered_better_than_without_their_images(tmp_path: Path) -> None:
    """Above the mean colour, above the nearest image, and above the same network that does not see the images."""
    parser = Procedural(size=32, num_scenes=200, views_per_scene=12)
    steps: dict[str, Any] = {"max_num_iterations": 400, "num_rays_per_batch": 256, "images_per_batch": 4}
    samples: dict[str, Any] = {"num_coarse_samples": 20, "num_fine_samples": 20, "max_eval_images": 0}
    sizes: dict[str, Any] = {"num_source_views": 2, "hidden_width": 48, "encoder_widths": (24, 24, 48)}
    config = dataclasses.replace(SMALL, **steps, **samples, **sizes, learning_rate=2e-3)
    found = {}
    for name in ("seeing", "blind"):
        trainer, test = trained_on_many(tmp_path / name, parser, config)
        if name == "blind":
            trainer.model.encoder = Blind(96)
        for _ in range(config.max_num_iterations):
            trainer.train_step()
        found[name] = evaluate(trainer.model, test).results["psnr"]
    mean, nearest = baselines(test)
    print(f"unseen scenes: {found}, mean {mean:.2f}, nearest {nearest:.2f}")
    assert found["seeing"] > max(mean, nearest) + 1
    assert found["seeing"] > found["blind"] + 2
