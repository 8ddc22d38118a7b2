"""Parameters of images learnt with the Gaussians (colours, poses), and known depths."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom import View
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.refinement import Group, PoseRefinement
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.evaluation.appearance import fit_appearance
from nerfloom.kernels.math import cross_matrix
from nerfloom.kernels.splats.project import Record, project_reference
from nerfloom.methods.gaussian_splatting import METHOD, GaussianSplatting, GaussianSplattingConfig
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.training.datasets import load_split
from nerfloom.training.optim import make_optimizer
from nerfloom.training.step import train_step
from nerfloom.training.trainer import Trainer
from tests.splats.test_method import SCENE, ball, camera
from tests.training.helpers import tiny_run


def model_of(gaussians: Gaussians, cameras: Cameras, **settings: object) -> GaussianSplatting:
    scene = dataclasses.replace(SCENE, num_cameras=len(cameras), camera_to_worlds=cameras.camera_to_worlds)
    config, _ = METHOD.decided(GaussianSplattingConfig(num_gaussians=10, degree=0, **settings), scene)  # type: ignore[arg-type]
    model = GaussianSplatting(config, scene)
    model.set_gaussians(gaussians)
    return model


def scattered(count: int = 60) -> Gaussians:
    """Coloured opaque Gaussians near the origin."""
    torch.manual_seed(2)
    turn = torch.zeros(count, 4)
    turn[:, 0] = 1
    return Gaussians(
        torch.randn(count, 3) * 0.4, torch.full((count, 3), -2.5), turn, torch.full((count,), 3.0),
        torch.randn(count, 3), torch.zeros(count, 3, 0),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("given", "varies", "expected"),
    [("auto", True, "affine"), ("auto", False, "none"), ("none", True, "none"), ("grid", False, "grid")],
)
def test_colours_are_transformed_where_light_differs(given: str, varies: bool, expected: str) -> None:
    scene = dataclasses.replace(SCENE, appearance_varies=varies)
    config, _ = METHOD.decided(GaussianSplattingConfig(appearance=given), scene)  # type: ignore[arg-type]
    assert config.appearance == expected
    assert (GaussianSplatting(config, scene).appearance is None) is (expected == "none")


def test_a_transform_is_learnt_by_the_image_it_is_of() -> None:
    one = camera()
    model = model_of(ball(), Cameras(**{**vars(one), "camera_to_worlds": one.camera_to_worlds.expand(3, 3, 4)}),
                     appearance="affine", mean_appearance_share=0.0)  # fmt: skip
    batch = ViewBatch(1, View(one), torch.rand(33, 33, 3), torch.zeros(3))
    loss = model.loss(batch, 0)
    assert float(loss.terms["appearance"].detach()) == 0
    loss.total.backward()
    assert model.appearance is not None
    gradient = model.appearance.vectors.grad
    assert gradient is not None
    assert gradient[1].any()
    assert not gradient[[0, 2]].any()


def test_pictures_show_the_appearance_that_is_set() -> None:
    """Half as bright, and shifted, where there is something: by the formula. The background keeps its colour."""
    one, behind = camera(), torch.tensor([0.2, 0.9, 0.4])
    model = model_of(ball(), one, appearance="affine")
    assert model.appearance is not None
    plain = model.render_view(View(one), behind)
    assert not plain.rgb.requires_grad  # a file is written of it
    assert not model.render_rgb(View(one), behind).requires_grad
    vector = torch.zeros(3, 4)
    vector[:, :3] = -0.5 * torch.eye(3)
    vector[:, 3] = torch.tensor([0.1, 0.0, -0.2])
    with model.appearance.shown(vector.flatten()):
        shown, quick = model.render_view(View(one), behind).rgb, model.render_rgb(View(one), behind)
    opacity = plain.accumulation[..., None]
    surface = plain.rgb - (1 - opacity) * behind
    torch.testing.assert_close(shown, 0.5 * surface + opacity * vector[:, 3] + (1 - opacity) * behind)
    torch.testing.assert_close(quick, shown, atol=1e-5, rtol=0)


@pytest.mark.medium
def test_the_appearance_of_a_held_out_image_is_found_by_its_half(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("gaussian-splatting", shared_tiny, tmp_path / "run", appearance="affine")
    trainer = Trainer.of(run, load_split(run, "train"))
    for _ in range(20):
        trainer.train_step()
    dataset = load_split(run, "test")
    darker = dataclasses.replace(dataset, pixels=(dataset.pixels.float() * torch.tensor([0.5, 0.5, 0.5, 1])).byte())
    pixels = dataset.cameras.image_pixels(1)
    background = torch.zeros(3)
    found = fit_appearance(trainer.model, darker, pixels, background)
    appearance = trainer.model.appearance
    assert found is not None
    assert appearance is not None
    view, true = darker.view(1), darker.image(1).float() / 255
    errors = []
    for vector in (appearance.of_images().detach().mean(0), found):
        with appearance.shown(vector), torch.no_grad():
            picture = trainer.model.render_view(view, background).rgb
        errors.append(float((picture - true[..., :3] * true[..., 3:]).square().mean()))
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_a_pose_that_is_off_is_found(group: str) -> None:
    """One of two cameras is turned by two degrees and moved; its image leads it back, to a tenth of that."""
    true = camera()
    both = true.camera_to_worlds.repeat(2, 1, 1)
    turn = torch.linalg.matrix_exp(cross_matrix(torch.tensor([0.02, -0.03, 0.01])))
    both[1, :, :3] = turn @ both[1, :, :3]
    both[1, :, 3] += torch.tensor([0.05, -0.04, 0.03])
    wrong = dataclasses.replace(true[torch.tensor([0, 0])], camera_to_worlds=both)
    scene = scattered()
    target = model_of(scene, true).render_view(View(true), torch.zeros(3)).rgb
    model = model_of(scene, wrong, camera_optimizer=group, ssim_weight=0.0)
    assert model.poses is not None
    optimizer = torch.optim.Adam([model.poses.tangents], lr=3e-3)
    batch = ViewBatch(1, View(wrong[torch.tensor([1])]), target, torch.zeros(3))
    for step in range(150):
        if step == 100:
            optimizer.param_groups[0]["lr"] = 3e-4
        optimizer.zero_grad()
        model.loss(batch, step).terms["rgb"].backward()
        optimizer.step()
    found = model.refined_poses(both, training=True)
    before = (both[1] - true.camera_to_worlds[0]).abs().max()
    assert float((found[1] - true.camera_to_worlds[0]).abs().max()) < 0.1 * float(before)
    assert torch.equal(found[0], both[0])


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
@pytest.mark.parametrize("harmonics", [0, 15])
def test_the_gradient_of_a_motion_is_that_of_differences(harmonics: int, group: Group) -> None:
    """The gradient goes through the centres, shapes, distances and colours of 50 Gaussians, in float64."""
    torch.manual_seed(0)
    rows = [
        0.4 * torch.randn(50, 3), torch.randn(50, 3) / 2 - 2.5, torch.randn(50, 4), torch.randn(50) + 1,
        torch.randn(50, 3), torch.randn(50, 3, harmonics) / 5,
    ]  # fmt: skip
    rows = [values.double() for values in rows]
    columns = [Record.X, Record.Y, Record.U_X, Record.U_Y, Record.V_Y, *range(Record.RED, Record.NORMAL_X)]
    weights = torch.randn(50, len(columns)).double()
    one = camera()
    poses = PoseRefinement(1, group).double()
    first = torch.tensor([[0.03, -0.02, 0.05, 0.02, 0.04, -0.03]]).double()
    poses.tangents.data.copy_(first)

    def loss() -> Tensor:
        seen = splat_camera(one, 0.1, pose=poses.pose(0, one.camera_to_worlds[0].double()))
        records, _ = project_reference(*rows, seen, harmonics)
        return (records[:, columns] * weights).sum()

    loss().backward()
    assert poses.tangents.grad is not None
    differences, size = torch.zeros(1, 6).double(), 1e-6
    with torch.no_grad():
        for number in range(6):
            for sign in (1, -1):
                poses.tangents.copy_(first)
                poses.tangents[0, number] += sign * size
                differences[0, number] += sign * loss() / (2 * size)
    torch.testing.assert_close(poses.tangents.grad, differences, rtol=1e-6, atol=1e-5)


def test_a_step_moves_the_camera_of_its_image_alone() -> None:
    """A first step moves by the learning rate, as Adam does; a later step with another image moves it no further."""
    three = camera()[torch.zeros(3, dtype=torch.long)]
    settings = {"camera_optimizer": "SO3xR3", "camera_learning_rate": 1e-3, "rate_factor": 4.0, "noise": 0.0}
    model = model_of(scattered(), three, **settings)
    assert model.poses is not None
    optimizer = make_optimizer(model, model.config)
    view, target = View(three[torch.tensor([0])]), torch.rand(33, 33, 3)
    train_step(model, optimizer, ViewBatch(1, view, target, torch.zeros(3)), 0, 0.0)
    first = model.poses.tangents.detach().clone()
    torch.testing.assert_close(first[1].abs(), torch.full((6,), 4e-3), rtol=1e-3, atol=0)
    assert not first[[0, 2]].any()
    train_step(model, optimizer, ViewBatch(2, view, target, torch.zeros(3)), 1, 0.5)
    second = model.poses.tangents.detach()
    assert torch.equal(second[:2], first[:2])
    torch.testing.assert_close(second[2].abs(), torch.full((6,), 4e-3 * 0.1**0.5), rtol=1e-3, atol=0)


@pytest.mark.medium
def test_steps_of_a_run_find_a_pose_that_is_off() -> None:
    """It is off by half a degree and a hundredth of the distance; images of a camera in its place come between."""
    true = camera()
    both = true.camera_to_worlds.repeat(2, 1, 1)
    turn = torch.linalg.matrix_exp(cross_matrix(torch.tensor([0.005, -0.0075, 0.0025])))
    both[1, :, :3] = turn @ both[1, :, :3]
    both[1, :, 3] += torch.tensor([0.0125, -0.01, 0.0075])
    wrong = dataclasses.replace(true[torch.tensor([0, 0])], camera_to_worlds=both)
    scene = scattered()
    target = model_of(scene, true).render_view(View(true), torch.zeros(3)).rgb
    settings = {"camera_optimizer": "SO3xR3", "rate_factor": 1.0, "ssim_weight": 0.0, "noise": 0.0}
    model = model_of(scene, wrong, steps_per_move=10_000, **settings)
    optimizer, steps = make_optimizer(model, model.config), 300
    for group in optimizer.param_groups:
        group["initial_lr"] *= group["name"] == "poses"  # the Gaussians are right
    batches = [ViewBatch(i, View(wrong[torch.tensor([i])]), target, torch.zeros(3)) for i in range(2)]
    for step in range(steps):
        train_step(model, optimizer, batches[step % 2], step, step / steps)
    found = model.refined_poses(both, training=True)
    before, after = ((poses[1] - true.camera_to_worlds[0]).abs().max() for poses in (both, found))
    print(f"pose off by {float(before):.4f} before and {float(after):.4f} after {steps} steps")
    assert float(after) < 0.25 * float(before)
    assert float((found[0] - both[0]).abs().max()) < 0.25 * float(before)


def test_other_cameras_follow_the_training_cameras() -> None:
    """All training cameras are moved by one similarity; so is a camera that is none of them."""
    generator = torch.Generator().manual_seed(3)
    centers = torch.randn(5, 3, generator=generator)
    poses = torch.cat([torch.eye(3).expand(5, 3, 3), centers[:, :, None]], dim=2)
    given = dataclasses.replace(camera()[torch.zeros(5, dtype=torch.long)], camera_to_worlds=poses)
    model = model_of(ball(), given, camera_optimizer="SE3")
    assert model.poses is not None
    motion = torch.tensor([0.3, -0.2, 0.1, 0.1, 0.2, -0.1])
    model.poses.tangents.data[:] = motion
    generator_matrix = torch.zeros(4, 4)
    generator_matrix[:3] = torch.cat([cross_matrix(motion[3:]), motion[:3, None]], dim=1)
    other = camera().camera_to_worlds
    expected = torch.linalg.matrix_exp(generator_matrix)[:3] @ torch.cat([other[0], torch.tensor([[0.0, 0, 0, 1]])])
    torch.testing.assert_close(model.refined_poses(other, training=False)[0], expected, atol=1e-5, rtol=0)


def test_known_depths_pull_gaussians_there() -> None:
    """One Gaussian at distance 3 has the true distance 2.5: the loss is its relative error, and moves it nearer."""
    one = camera()
    model = model_of(ball(), one, depth_loss_mult=1.0)
    known = torch.zeros(33, 33)
    known[16, 16] = 2.5
    batch = ViewBatch(0, View(one), torch.rand(33, 33, 3), torch.zeros(3), distances=known)
    term = model.loss(batch, 0).terms["depth"]
    assert float(term.detach()) == pytest.approx(0.2, abs=1e-3)
    term.backward()
    assert model.columns["means"].values.grad is not None
    assert float(model.columns["means"].values.grad[0, 2]) < 0  # the camera is at z = 3, and looks down
    nothing = dataclasses.replace(batch, distances=torch.zeros(33, 33))
    assert float(model.loss(nothing, 0).terms["depth"].detach()) == 0


def test_the_background_of_a_capture_cannot_be_learnt() -> None:
    """Each step has another background, so transparent pixels are wrong in the next step."""
    captured = dataclasses.replace(SCENE, has_alpha=False)
    config, _ = METHOD.decided(GaussianSplattingConfig(num_gaussians=10, degree=0), captured)
    model = GaussianSplatting(config, captured)
    batch = ViewBatch(0, View(camera()), torch.zeros(33, 33, 3), torch.zeros(3))
    corners = [model.loss(batch, 0).rgb[0, 0] for _ in range(3)]
    assert len({tuple(corner.tolist()) for corner in corners}) == 3
    config = dataclasses.replace(config, background="black")
    model = GaussianSplatting(config, captured)
    model.set_gaussians(ball())
    assert not model.loss(batch, 0).rgb[0, 0].any()
