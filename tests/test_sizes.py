"""Settings beyond measure: each number of each method makes a model, or one line with the allowed range."""

import dataclasses
import math
import types
import typing
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import ConfigError, NerfloomError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.plain import from_plain
from nerfloom.data.scene import Scene
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.base import MLP
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.grids.hash_grid_layout import MAX_RESOLUTION, HashGridLayout
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.table_memory import table
from nerfloom.registry import load_method, registered
from nerfloom.samplers.occupancy import OccupancySampler
from tests.training.helpers import TINY

SHARED_BY = type(load_method("instant-ngp").config)
METHODS = (
    "dnerf", "instant-ngp", "kilo-nerf", "kplanes", "mip-nerf", "mip-nerf-360", "nerf-plus-plus", "nerf-w", "nerfacto",
    "neus", "pixel-nerf", "ref-nerf", "tensorf", "vanilla-nerf", "volsdf", "voxels", "zip-nerf",
)  # fmt: skip
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
STILL = Scene(BOX, 2.0, 6.0, num_cameras=3, has_alpha=True, moving=False, image_size=20)
KINDS = (STILL, dataclasses.replace(STILL, moving=True, unbounded=True, has_alpha=False))
HUGE = (2**31, 2**40, 2**63 - 1)
WRONG: dict[type, tuple[float, ...]] = {int: (0, -1, *HUGE), float: (0.0, -1.0, 1e30, math.inf, math.nan)}


def numbers(config: TrainConfig) -> Iterator[tuple[str, Any]]:
    """Each numeric setting's name, and values that nobody means; shared settings are tested for one method."""
    shared = {f.name for f in dataclasses.fields(TrainConfig)} if type(config) is not SHARED_BY else set()
    for name, hint in typing.get_type_hints(type(config)).items():
        if name in shared:
            continue
        kinds = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
        for kind in kinds:
            if kind in WRONG:
                yield from ((name, value) for value in WRONG[kind])
            elif typing.get_origin(kind) is tuple:
                inner = typing.get_args(kind)[0]
                yield from ((name, (value,)) for value in WRONG[inner])
                yield name, ()
                yield name, ((*getattr(config, name), inner(1))[0],) * 100


def tiny_config(method: str) -> TrainConfig:
    known = {f.name for f in dataclasses.fields(load_method(method).config)}
    small = {name: value for name, value in TINY.get(method, {}).items() if name in known}
    return dataclasses.replace(load_method(method).config, **small)


def test_all_methods_are_here() -> None:
    assert set(METHODS) <= set(registered("methods"))


@pytest.mark.medium
@pytest.mark.parametrize("method", METHODS)
def test_each_number_makes_a_model_or_one_line(method: str) -> None:
    config, refused, built = tiny_config(method), set(), set()
    for name, value in numbers(config):
        for scene in KINDS:
            try:
                load_method(method).build(dataclasses.replace(config, **{name: value}), scene)
                built.add(name)
            except NerfloomError:  # one line by construction, as tests/test_errors.py shows
                refused.add(name)
    sizes = {name for name in dir(config) if name.endswith(("resolution", "width", "levels", "layers", "samples"))}
    assert sizes & {f.name for f in dataclasses.fields(config)} <= refused
    assert built
    if isinstance(config, SHARED_BY):
        assert {"adam_eps", "num_rays_per_batch"} <= refused
        assert "max_num_iterations" in built


@pytest.mark.parametrize(
    ("method", "settings", "words"),
    [
        ("instant-ngp", {"max_resolution": 2_097_151}, "--max-resolution is 2097151; it must be from 1 to 1048576"),
        ("instant-ngp", {"log2_table_size": 60}, "--log2-table-size is 60; it must be from 1 to 28"),
        ("instant-ngp", {"num_steps": -3}, "--num-steps is -3; it must be from 1 to 1048576"),
        ("instant-ngp", {"grid_resolution": 100_000}, "--grid-resolution is 100000; it must be from 1 to 512"),
        ("kplanes", {"base_resolution": 2**19}, "GiB for a table; this machine has"),
        ("kplanes", {"num_scales": 17}, "--num-scales is 17; it must be from 1 to 16"),
        ("tensorf", {"last_voxels": 2**40}, "--last-voxels is 1099511627776; it must be from 8 to 1073741824"),
        ("vanilla-nerf", {"hidden_width": 10**7}, "--hidden-width is 10000000; it must be from 2 to 16384"),
        ("nerfacto", {"num_proposal_samples": [8] * 30}, "takes 1 to 8 numbers"),
        ("nerfacto", {"machine": {"seed": 2**64}}, "seed"),
    ],
)
def test_a_recipe_is_told_what_it_may_say(method: str, settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_method(method).build(from_plain(tiny_config(method), settings, "recipe.yml"), STILL)
    assert words in str(error.value)


def test_a_seed_of_more_than_64_bits() -> None:
    with pytest.raises(ConfigError, match="seed"):
        MachineConfig(seed=2**63)


# -- layouts and parts that a plugin or a checkpoint builds by itself ------------------------------------------------


@pytest.mark.parametrize(
    ("resolutions", "offsets"),
    [
        ((), (0,)),
        ((4,), (0,)),
        ((4, 8), (0, 128)),
        ((0,), (0, 8)),
        ((-4,), (0, 8)),
        ((2**20 + 1,), (0, 8)),
        ((2**31,), (0, 8)),
        ((4.0,), (0, 128)),
        ((4,), (8, 136)),
        ((4,), (0, 0)),
        ((4, 4), (0, 128, 64)),
        ((4,), (0, 2**33)),
        ((64,), (0, 100)),  # hashed, but 100 is not a power of two
        ((4,) * 65, tuple(range(0, 66 * 128, 128))),
    ],
)
def test_a_hash_grid_of_impossible_levels_is_refused(resolutions: Any, offsets: Any) -> None:
    with pytest.raises(ConfigError, match="hash grid"):
        HashGridLayout(resolutions, offsets)


@pytest.mark.parametrize("levels", [0, -1, 65, 2**40])
@pytest.mark.parametrize("resolution", [16, 0, 2**21])
def test_a_hash_grid_cannot_be_built_of_them(levels: int, resolution: int) -> None:
    with pytest.raises(ConfigError):
        HashGridLayout.build(levels, 16, resolution, 10)
    with pytest.raises(ConfigError):
        HashGridLayout.build(4, resolution, 32, 29 if resolution == 16 else 10)


def test_the_finest_level_there_may_be_stays_inside_its_table() -> None:
    grid = HashGrid(2, 2, 16, MAX_RESOLUTION, 8)
    positions = torch.cat([torch.rand(100, 3), torch.ones(1, 3), torch.tensor([[1 - 2**-24] * 3])])
    assert grid(positions).abs().max() <= grid.table.abs().max() * (1 + 1e-5)


@pytest.mark.parametrize(
    ("resolutions", "axes", "offsets", "entries"),
    [
        (((4, 4),), (((0, 1),),), ((0,),), 15),
        (((4, 4),), (((0, 1),),), ((-1,),), 16),
        (((4, 4),), (((0, 2),),), ((0,),), 16),
        (((1, 4),), (((0, 1),),), ((0,),), 16),
        (((2**20 + 1, 4),), (((0, 1),),), ((0,),), 2**40),
        (((4.0, 4.0),), (((0, 1),),), ((0,),), 16),
        (((4, 4),) * 65, (((0, 1),),) * 65, ((0,),) * 65, 16),
        ((), (), (), 0),
    ],
)
def test_planes_of_impossible_factors_are_refused(resolutions: Any, axes: Any, offsets: Any, entries: int) -> None:
    with pytest.raises(ConfigError, match="planes"):
        PlanesLayout(resolutions, axes, offsets, entries)


def test_a_checkpoint_cannot_ask_for_more_vertices_than_there_is_memory() -> None:
    planes = FeaturePlanes(((4, 4, 4),), 8, resizable=True)
    for sizes in ([[2**20] * 3], [[2**40] * 3], [[0, 4, 4]], [[-4] * 3]):
        state = planes.state_dict() | {"resolutions": torch.tensor(sizes)}
        with pytest.raises(ConfigError):
            planes.load_state_dict(state)


@pytest.mark.parametrize("make", [
    lambda: OccupancySampler(BOX, 0),
    lambda: OccupancySampler(BOX, 2**20),
    lambda: OccupancySampler(BOX, 8, 0),
    lambda: MLP(8, 0, 3),
    lambda: MLP(2**31, 2**31),
    lambda: table(2**31, 2**20),
])  # fmt: skip
def test_other_parts(make: Any) -> None:
    with pytest.raises(ConfigError):
        make()


def test_too_many_frequencies() -> None:
    with pytest.raises(ValueError, match="0 to 32 frequencies, not 200"):
        frequency_encoding(torch.rand(2, 3), 200)
