"""Learnt poses against rotations in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.pose_propagation import propagated_poses
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.geometry.alignment import align_cameras
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.math import cross_matrix


def some_rays() -> Rays:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    return Rays(
        torch.randn(6, 3), directions, torch.zeros(6), torch.ones(6), camera_indices=torch.tensor([0, 0, 1, 1, 2, 2])
    )


def some_poses(count: int) -> Tensor:
    """(count, 3, 4) cameras at random places with random rotations."""
    rotations = torch.linalg.qr(torch.randn(count, 3, 3))[0]
    rotations = rotations * torch.linalg.det(rotations)[:, None, None]
    return torch.cat([rotations, torch.randn(count, 3, 1)], -1)


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_nothing_moves_at_first_and_everything_can_learn(group) -> None:
    poses, rays = PoseRefinement(3, group), some_rays()
    found = poses(rays)
    torch.testing.assert_close(found.origins, rays.origins)
    torch.testing.assert_close(found.directions, rays.directions)
    (found.origins.square().sum() + (found.directions * torch.arange(3.0)).sum()).backward()
    assert poses.tangents.grad is not None
    assert bool((poses.tangents.grad != 0).all())
    assert bool(torch.isfinite(poses.tangents.grad).all())


def test_a_quarter_turn_and_a_move() -> None:
    poses, rays = PoseRefinement(3, "SO3xR3"), some_rays()
    with torch.no_grad():
        poses.tangents[1] = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, math.pi / 2])
    found = poses(rays)
    x, y, z = rays.directions[2:4].unbind(-1)
    torch.testing.assert_close(found.directions[2:4], torch.stack([-y, x, z], -1))
    torch.testing.assert_close(found.origins[2:4], rays.origins[2:4] + torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(found.origins[4:], rays.origins[4:])


def test_a_screw_turns_about_the_scenes_origin() -> None:
    """Half a turn about z while moving along z: the helix's end."""
    poses, rays = PoseRefinement(3, "SE3"), some_rays()
    with torch.no_grad():
        poses.tangents[0] = torch.tensor([0.0, 0.0, 0.7, 0.0, 0.0, math.pi])
    found = poses(rays)
    flipped = rays.origins[:2] * torch.tensor([-1.0, -1.0, 1.0]) + torch.tensor([0.0, 0.0, 0.7])
    torch.testing.assert_close(found.origins[:2], flipped, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_refined_cameras_see_along_refined_rays(group) -> None:
    torch.manual_seed(0)
    ones = torch.ones(3)
    cameras = Cameras(
        some_poses(3),
        20 * ones,
        20 * ones,
        8 * ones,
        8 * ones,
        *[16 * ones.long()] * 2,
    )
    poses = PoseRefinement(3, group)
    torch.nn.init.normal_(poses.tangents, std=0.3)
    flat = torch.randint(3 * 256, (40,))
    through = poses(cameras.pixel_rays(flat, 0.0, 1.0))
    moved = replace(cameras, camera_to_worlds=poses.refined(cameras.camera_to_worlds, training=True))
    of_refined = moved.pixel_rays(flat, 0.0, 1.0)
    torch.testing.assert_close(through.origins, of_refined.origins)
    torch.testing.assert_close(through.directions, of_refined.directions)
    assert bool((through.directions.norm(dim=-1) - 1).abs().max() < 1e-5)


def test_held_out_cameras_are_left_alone_where_no_pose_is_given() -> None:
    poses, others = PoseRefinement(3), some_poses(4)
    torch.nn.init.normal_(poses.tangents)
    assert torch.equal(poses.refined(others, training=False), others)
    assert torch.equal(poses.refined(others, training=True), others)  # others, since they are one more


def test_rays_of_no_training_camera_are_not_moved() -> None:
    with pytest.raises(ValueError, match="training cameras"):
        PoseRefinement(3)(replace(some_rays(), camera_indices=None))


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_held_out_cameras_follow_when_all_poses_drift_together(group) -> None:
    """All training cameras are turned, moved and scaled by one similarity: so are the others."""
    torch.manual_seed(0)
    turn, scale, move = torch.tensor([0.2, -0.1, 0.3]), 1.2, torch.tensor([0.5, -0.2, 0.1])
    rotation = torch.linalg.matrix_exp(cross_matrix(turn))
    given = torch.cat([torch.eye(3).expand(5, 3, 3), torch.randn(5, 3, 1)], -1)
    poses, others = PoseRefinement(5, group, given), some_poses(6)
    target = scale * given[:, :, 3] @ rotation.T + move
    with torch.no_grad():
        poses.tangents[:, 3:] = turn
        poses.tangents[:, :3] = target - given[:, :, 3]
        if group == "SE3":  # the same end of a screw motion, by its logarithm
            left_jacobian = sum(
                torch.linalg.matrix_power(cross_matrix(turn), k) / math.factorial(k + 1) for k in range(12)
            )
            poses.tangents[:, :3] = (target - given[:, :, 3] @ rotation.T) @ torch.linalg.inv(left_jacobian).T
    found = poses.refined(others, training=False)
    torch.testing.assert_close(found[:, :, 3], scale * others[:, :, 3] @ rotation.T + move, atol=5e-5, rtol=1e-5)
    torch.testing.assert_close(found[:, :, :3], rotation @ others[:, :, :3], atol=1e-5, rtol=1e-5)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(poses.refined(others, training=False), found)


def test_without_refinement_other_cameras_stay_though_all_are_in_one_place() -> None:
    given = torch.cat([torch.eye(3).expand(3, 3, 3), torch.ones(3, 3, 1)], -1)
    others = some_poses(6)
    torch.testing.assert_close(PoseRefinement(3, "SO3xR3", given).refined(others, training=False), others)


def test_held_out_cameras_follow_those_around_them_where_poses_drift_along_the_way() -> None:
    """Errors that grow along a path, with noise of a single camera: cameras between them follow the path's."""
    torch.manual_seed(0)
    along = torch.linspace(0, 1, 41)
    angles = 0.1 * along.square()  # about z, and a shift along x
    turns = torch.linalg.matrix_exp(cross_matrix(torch.tensor([0.0, 0.0, 1.0])) * angles[:, None, None])
    centers = torch.stack([torch.cos(3 * along), torch.sin(3 * along), along], dim=-1)
    shifts = torch.stack([0.1 * along.square(), 0 * along, 0 * along], dim=-1)
    given = torch.cat([torch.eye(3).expand(41, 3, 3), centers[:, :, None]], -1)
    refined = torch.cat([turns, (centers + shifts)[:, :, None]], -1)
    between = torch.arange(41) % 8 == 4
    found = propagated_poses(given[between], given[~between], refined[~between])
    apart = (found - refined[between]).flatten(1).norm(dim=1)
    scale, rotation, translation = align_cameras(given[~between], refined[~between])
    alike = torch.cat(
        [
            rotation.float().expand(int(between.sum()), 3, 3),
            (scale * centers[between].double() @ rotation.T + translation).float()[:, :, None],
        ],
        -1,
    )
    assert float(apart.mean()) < 0.25 * float((alike - refined[between]).flatten(1).norm(dim=1).mean())


def test_far_from_all_cameras_other_cameras_follow_the_similarity_alone() -> None:
    torch.manual_seed(0)
    given = torch.cat([torch.eye(3).expand(9, 3, 3), torch.randn(9, 3, 1)], -1)
    turns = torch.linalg.matrix_exp(
        cross_matrix(0.1 * torch.randn(3)) + 0.1 * torch.stack([cross_matrix(v) for v in torch.randn(9, 3)])
    )
    refined = torch.cat([turns, given[:, :, 3:] + 0.1 * torch.randn(9, 3, 1)], -1)
    far = torch.cat([torch.eye(3), torch.tensor([[3e4], [2e4], [-1e4]])], -1)[None]
    scale, rotation, translation = align_cameras(given, refined)
    found = propagated_poses(far, given, refined)
    torch.testing.assert_close(found[0, :, :3], rotation.float(), atol=1e-4, rtol=0)
    expected = (scale * rotation @ far[0, :, 3].double() + translation).float()
    torch.testing.assert_close(found[0, :, 3], expected, atol=0.02, rtol=0)


def test_one_camera_and_many_at_one_place_carry_others_too() -> None:
    for count in (1, 3):
        given = torch.cat([torch.eye(3).expand(count, 3, 3), torch.ones(count, 3, 1)], -1)
        refined = given.clone()
        refined[:, 0, 3] += 0.5
        for place in (torch.ones(3), torch.zeros(3)):
            pose = torch.cat([torch.eye(3), place[:, None]], -1)[None]
            found = propagated_poses(pose, given, refined)
            expected = pose.clone()
            expected[:, 0, 3] += 0.5
            torch.testing.assert_close(found, expected)


def test_cameras_are_each_carried_as_alone() -> None:
    torch.manual_seed(1)
    given = torch.cat([torch.eye(3).expand(7, 3, 3), torch.randn(7, 3, 1)], -1)
    poses, others = PoseRefinement(7, "SO3xR3", given), some_poses(6)
    torch.nn.init.normal_(poses.tangents, std=0.1)
    together = poses.refined(others, training=False)
    for index in range(len(others)):
        alone = poses.refined(others[index : index + 1], training=False)
        torch.testing.assert_close(together[index : index + 1], alone)


@pytest.mark.parametrize("group", ["SO3xR3", "SE3"])
def test_many_rays_of_few_cameras_give_the_same_bits_each_time(group: str) -> None:
    """Gradients of looked-up rows that torch adds up by atomics differ from run to run."""
    torch.manual_seed(0)
    count = 40_000
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    indices = torch.randint(3, (count,))
    rays = Rays(torch.randn(count, 3), directions, torch.zeros(count), torch.ones(count), camera_indices=indices)
    weights = torch.randn(2, count, 3)

    def gradient() -> torch.Tensor:
        poses = PoseRefinement(3, group)
        found = poses(rays)
        (weights * torch.stack([found.origins, found.directions])).sum().backward()
        assert poses.tangents.grad is not None
        return poses.tangents.grad

    first = gradient()
    assert all(torch.equal(gradient(), first) for _ in range(5))
    moved = torch.zeros(3, 3, dtype=torch.float64).index_add_(0, indices, weights[0].double())
    torch.testing.assert_close(first[:, :3].double(), moved, rtol=1e-4, atol=1e-3)
