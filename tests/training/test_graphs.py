"""Recorded and repeated steps equal plain steps; a failure is reported, and changes nothing."""

import dataclasses
import functools
import gc
import inspect
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks.operations import trainer_of
from nerfloom.base.errors import ConfigError, DivergenceError
from nerfloom.base.step_kind import StepKind
from nerfloom.losses.terms import ColorError
from nerfloom.model import Loss
from nerfloom.samplers import proposal
from nerfloom.testing.scenes import moving_ball
from nerfloom.training import graphs
from nerfloom.training.batch_size import BatchSize
from nerfloom.training.graphs import WARM_UP, CudaRecorder, StepGraphs, kind_of_step, make_graphs
from nerfloom.training.state import State
from nerfloom.training.trainer import MAX_BAD_STEPS, Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer
from tests.training.recorded import FakeRecorder, ahead

LEARN_UNTIL, STEPS = 6, 14
"""Number of steps while proposals learn in every step here, and number of all steps."""


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Lines that are printed."""
    lines: list[str] = []
    monkeypatch.setattr(graphs, "say", lines.append)
    return lines


def recorded(trainer: Trainer, must: bool = False) -> FakeRecorder:
    """Let a trainer record its steps, by the stand-in for graphs."""
    recorder = FakeRecorder()
    repeat_by(trainer, StepGraphs(recorder, trainer._learnt, must))
    return recorder


def repeat_by(trainer: Trainer, graphs: StepGraphs[Any]) -> None:
    """Let a trainer take its steps by graphs, in sizes that hold for a while."""
    trainer.graphs = graphs
    if trainer.batch_size is not None:
        trainer.batch_size = BatchSize(trainer.batch_size.config, recorded=True)


@functools.cache
def idle(method: str, moving: bool = False) -> Trainer:
    """A trainer of a method, not trained; nerfacto's has an unbounded scene."""
    return trainer_of(method, Path("unused"), moving_ball if moving else None)


def small(folder: Path, method: str = "nerfacto", moving: bool = False, **settings: Any) -> Trainer:
    """A trainer of a method on small batches, by default of a fixed number of rays."""
    found = idle(method, moving)
    sizes = {"num_levels": 4, "num_proposal_samples": (16, 12), "num_nerf_samples": 8, "mixed_precision": False}
    rays = {"num_rays_per_batch": 24, "samples_per_batch": None}
    known: dict[str, Any] = {name: value for name, value in (sizes | rays).items() if hasattr(found.config, name)}
    config = dataclasses.replace(found.config, **(known | settings))
    return Trainer(found.method, config, found.train_set, folder=folder)


VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "mip-nerf": {"method": "mip-nerf", "num_layers": 3, "sampler": "hierarchical"},
    "mip-nerf-360": {"method": "mip-nerf-360", "num_layers": 3, "encoding": "integrated"},
    "zip-nerf": {"method": "zip-nerf", "appearance": "affine"},
    "vanilla-nerf": {"method": "vanilla-nerf", "num_layers": 3, "sampler": "hierarchical"},
    "dnerf": {"method": "dnerf", "num_layers": 3, "sampler": "hierarchical"},
    "nerf-plus-plus": {"method": "nerf-plus-plus", "num_layers": 3},
    "tensorf": {"method": "tensorf", "sampler": "proposal", "samples_per_batch": 24 * 8},
    "captures": {
        "appearance": "vector",
        "appearance_embedding_dim": 4,
        "camera_optimizer": "SO3xR3",
        "lr_warmup_steps": 9,
    },
    "screws": {"camera_optimizer": "SE3", "lr_schedule": "exponential"},
    "normals, four rays": {"predict_normals": True, "rays_per_pixel": 4, "train_rays_per_pixel_from": 0.0},
}


COVERED = ("vanilla-nerf", "mip-nerf")
"""Other methods cover their parts: dnerf and nerf-plus-plus frequencies and two passes, mip-nerf-360 cones."""


def mark_of(variant: str) -> list[Any]:
    """How long a variant takes; one of them is in the fast set."""
    if variant == "captures":
        return []
    return [pytest.mark.slow if variant in COVERED else pytest.mark.medium]


@pytest.mark.parametrize("variant", [pytest.param(name, marks=mark_of(name)) for name in VARIANTS])
def test_repeated_steps_learn_what_steps_learn(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    """All bits agree, with rates, annealing and draws that differ from step to step."""
    ahead(monkeypatch)
    monkeypatch.setattr(proposal, "ALWAYS_LEARN_UNTIL", LEARN_UNTIL)
    usual, repeating = (small(tmp_path / name, **VARIANTS[variant]) for name in ("usual", "repeating"))
    for trainer in (usual, repeating):
        trainer.steps_per_read = 4
    recorder = recorded(repeating)
    for _ in range(STEPS):
        reports = [trainer.train_step() for trainer in (usual, repeating)]
        assert reports[0].losses == reports[1].losses
    assert_same_bits(tensors(usual), tensors(repeating))
    assert usual.state.train_mse == repeating.state.train_mse
    hierarchical = any(name in variant for name in ("mip", "vanilla", "dnerf", "plus"))
    kinds = 1 if hierarchical else 2  # steps where proposals learn, and others
    assert len(recorder.tapes) == kinds
    assert recorder.repeated == STEPS - kinds * WARM_UP
    assert said == ["training steps are captured as CUDA graphs and replayed"]
    assert (usual.optimizer.entries[0] > 0) == (not hierarchical)


class Unrepeated(StepGraphs[Any]):
    """Takes every step as it is, with the same seeds."""

    def run(self, kind: StepKind, seed: Callable[[], None], step: Callable[[], Any]) -> Any:
        seed()
        return step()


@pytest.mark.medium
@pytest.mark.parametrize(
    ("method", "moving"), [("instant-ngp", False), ("kplanes", False), ("kplanes", True), ("tensorf", False)]
)
def test_repeated_steps_with_an_occupancy_grid_learn_what_steps_learn(
    method: str, moving: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    """Across updates of the grid, which are not recorded, changes of the room that samples are given, and growth."""
    ahead(monkeypatch)
    sizes: dict[str, Any] = {"samples_per_batch": 2**11, "num_steps": 64, "grid_resolution": 32}
    if method == "kplanes":
        sizes |= {"num_scales": 2, "features_per_scale": 8, "grid_resolution": 16 if moving else 32}
    if method == "tensorf":
        sizes |= {"max_num_iterations": 100, "upsample_at": (0.22,), "first_voxels": 8**3, "last_voxels": 16**3}
    usual, repeating = (small(tmp_path / name, method, moving, **sizes) for name in ("usual", "repeating"))
    repeat_by(usual, Unrepeated(FakeRecorder(), usual._learnt))
    recorder = recorded(repeating)
    kinds, steps = set(), 34
    for trainer in (usual, repeating):
        trainer.steps_per_read = 8
    for _ in range(steps):
        reports = [trainer.train_step() for trainer in (usual, repeating)]
        assert reports[0].losses == reports[1].losses
        kinds.add((repeating._request().num_pixels, repeating.model.sampler.capacity.per_ray))
    assert_same_bits(tensors(usual), tensors(repeating))
    assert usual.state.samples_per_ray == repeating.state.samples_per_ray
    assert usual.state.train_mse == repeating.state.train_mse
    assert usual.state.samples_per_ray != State().samples_per_ray  # was read
    assert moving or len(kinds) > 1  # of 16 slices in time, 34 steps empty none
    assert recorder.repeated > steps / 4
    assert len(recorder.tapes) <= len(kinds) + 1  # one more for the first step
    assert said == ["training steps are captured as CUDA graphs and replayed"]
    assert repeating.model.sampler.capacity.left_out == 0


@pytest.mark.medium
def test_the_number_of_rays_holds_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It follows the samples a ray, in steps, so that most steps have the sizes of the one before."""
    ahead(monkeypatch)
    trainer = small(tmp_path, "instant-ngp", samples_per_batch=2**10)
    recorded(trainer)
    numbers = []
    for samples_per_ray in (10.0, 10.9, 11.5, 12.5, 12.0, 11.0, 9.0, 5.0):
        trainer.state.samples_per_ray = samples_per_ray
        numbers.append(trainer._request().num_pixels)
    assert numbers == [102, 102, 102, 82, 82, 82, 114, 205]


@pytest.mark.medium
def test_a_resumed_run_repeats_the_same_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of tensors that a checkpoint has replaced are dropped; draws do not depend on those before."""
    ahead(monkeypatch)
    first, second = (small(tmp_path / name) for name in ("first", "second"))
    for trainer in (first, second):
        recorded(trainer)
        for _ in range(6):
            trainer.train_step()
    content = torch.load(first.save(), weights_only=True)
    for _ in range(7):  # second goes its own way before it is restored
        second.train_step()
    second.restore(content)
    for _ in range(6):
        assert first.train_step().losses == second.train_step().losses
    assert_same_bits(tensors(first), tensors(second))


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.medium), 4])
def test_steps_that_are_not_finite_change_nothing_and_are_counted(
    every: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    """Recorded, and known to Python only some steps later; ten of them in a row end the run."""
    ahead(monkeypatch)
    trainer = small(tmp_path)
    trainer.steps_per_read = every
    recorder = recorded(trainer)
    factor, loss = torch.ones(()), trainer.model.loss

    def spoilt(batch: Any, step: int) -> Loss:
        found = loss(batch, step)
        terms = {**found.terms, "rgb": found.terms["rgb"] * factor}
        return dataclasses.replace(found, terms=terms, rgb=found.rgb * factor)

    monkeypatch.setattr(trainer.model, "loss", spoilt)
    several(trainer, 8)
    assert recorder.repeated > 3
    before = tensors(trainer)
    factor.fill_(torch.nan)
    several(trainer, 4)
    assert_same_bits(tensors(trainer), before)
    assert trainer.state.skipped == 4
    factor.fill_(1)
    trainer.train_step()
    assert any(not torch.equal(value, before[name]) for name, value in tensors(trainer).items())
    factor.fill_(torch.nan)
    with pytest.raises(DivergenceError, match=f"{MAX_BAD_STEPS} steps in a row were not finite, first in the loss"):
        several(trainer, MAX_BAD_STEPS + every)


def several(trainer: Trainer, count: int) -> None:
    """Take some training steps."""
    for _ in range(count):
        trainer.train_step()


class Toy:
    """A weight that moves by its rate times a draw."""

    def __init__(self) -> None:
        self.weight, self.rate, self.steps = torch.zeros(5), torch.ones(()), 0

    def seed(self) -> None:
        torch.manual_seed(self.steps)

    def step(self) -> Tensor:
        self.weight.add_(torch.rand(5) * self.rate)
        return self.weight * 2


def steps_of(
    toy: Toy, count: int, step: Callable[[], Tensor], seed: Callable[[], None], must: bool = False
) -> list[Tensor]:
    """Results of some steps of a toy, with rates that differ."""
    found, recorder = [], FakeRecorder()
    steps = StepGraphs[Tensor](recorder, lambda: [toy.weight], must)
    for toy.steps in range(count):
        toy.rate.fill_(1.0 + toy.steps)
        if steps.take(StepKind()):
            found.append(steps.run(StepKind(), seed, step).clone())
        else:
            seed()
            found.append(step())
    return found


def truth(count: int) -> list[Tensor]:
    """The results of steps of a toy."""
    found, weight = [], torch.zeros(5)
    for number in range(count):
        torch.manual_seed(number)
        weight = weight + torch.rand(5) * (1.0 + number)
        found.append(weight * 2)
    return found


def same(found: Sequence[Tensor], expected: Sequence[Tensor]) -> None:
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)


def test_a_function_of_tensors_alone_is_repeated(said: list[str]) -> None:
    toy = Toy()
    same(steps_of(toy, 9, toy.step, toy.seed), truth(9))
    assert said == ["training steps are captured as CUDA graphs and replayed"]


@pytest.mark.parametrize("fault", ["a number of Python's", "a wait", "an error"])
def test_what_cannot_be_repeated_is_found_and_said(fault: str, said: list[str]) -> None:
    """Nothing is learnt that the steps themselves would not have learnt."""
    toy = Toy()
    broken = [False]

    def step() -> Tensor:
        if fault == "an error" and broken[0]:
            raise RuntimeError("no kernel image is available")
        if fault == "a wait":
            toy.weight.add_(torch.rand(5) * toy.rate.item())
        elif fault == "a number of Python's":
            toy.weight.add_(torch.rand(5) * (1.0 + toy.steps))
        else:
            toy.weight.add_(torch.rand(5) * toy.rate)
        return toy.weight * 2

    record = FakeRecorder.record

    def recording(self: FakeRecorder, function: Any) -> Any:
        broken[0] = True
        try:
            return record(self, function)
        finally:
            broken[0] = False

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeRecorder, "record", recording)
        same(steps_of(toy, 9, step, toy.seed), truth(9))
        (line,) = said
        assert line.startswith("note: steps are not replayed as CUDA graphs, because ")
        words = {
            "a number of Python's": "did not make the same update",
            "a wait": "_local_scalar_dense",
            "an error": "no kernel image",
        }
        assert words[fault] in line
        with pytest.raises(ConfigError, match=f"cuda-graphs on: .*{words[fault]}"):
            steps_of(toy, 9, step, toy.seed, must=True)


def test_another_loss_is_found(said: list[str]) -> None:
    """Another loss is found even if its gradient is the same."""
    toy = Toy()

    def step() -> Tensor:
        return toy.step() + 0.1 * toy.steps  # a number of Python's

    def taken(loss: Callable[[Tensor], Tensor] | None) -> int:
        toy.weight.zero_()
        steps = StepGraphs[Tensor](recorder := FakeRecorder(), lambda: [toy.weight], loss=loss)
        for toy.steps in range(9):
            toy.rate.fill_(1.0 + toy.steps)
            steps.run(StepKind(), toy.seed, step) if steps.take(StepKind()) else step()
        return recorder.repeated

    assert taken(None) > 3
    assert taken(torch.sum) == 1
    assert said[-1].endswith("because a replayed step did not have the same loss as an ordinary one")


def test_what_moves_later_is_found(said: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A tensor that is replaced after the first test: a recording still reads the old one."""
    monkeypatch.setattr(graphs, "REPLAYS_BEFORE_TESTS", (0, 3))
    toy, held = Toy(), [torch.ones(5)]

    def step() -> Tensor:
        toy.weight.add_(held[0] * toy.rate)
        return toy.weight * 2

    steps = StepGraphs[Tensor](FakeRecorder(), lambda: [toy.weight])
    for toy.steps in range(12):
        if toy.steps == WARM_UP + 2:
            held[0] = torch.full((5,), 7.0)
        if steps.take(StepKind()):
            steps.run(StepKind(), toy.seed, step)
    assert steps.repeated == 3
    assert "did not make the same update as an ordinary one" in said[-1]


def test_what_stays_infinite_is_alike(said: list[str]) -> None:
    """The density of cells that no step has looked at is infinite."""
    toy = Toy()
    toy.weight[0] = torch.inf
    steps_of(toy, 9, toy.step, toy.seed)
    assert said == ["training steps are captured as CUDA graphs and replayed"]


def test_few_kinds_are_kept(said: list[str]) -> None:
    """The last ones used are kept, because each holds memory."""
    toy = Toy()
    steps = StepGraphs[Tensor](recorder := FakeRecorder(), lambda: [toy.weight])
    for turn in range(2):
        for number in range(graphs.MAX_KINDS):
            for _ in range(WARM_UP + 1):
                steps.run(StepKind((number,)), toy.seed, toy.step)
        assert len(recorder.tapes) == graphs.MAX_KINDS, turn
    steps.run(StepKind((99,)), toy.seed, toy.step)
    assert set(steps._kinds) == {(number,) for number in range(1, graphs.MAX_KINDS)} | {(99,)}


def test_draws_of_another_step_are_found(said: list[str]) -> None:
    toy, seeded = Toy(), [0]

    def seed() -> None:
        seeded[0] += 1
        torch.manual_seed(seeded[0])  # as if a repeated step drew from where the generator stood

    steps_of(toy, 6, toy.step, seed)
    assert "did not make the same update as an ordinary one" in said[0]


def test_reasons_are_said_once_each(said: list[str]) -> None:
    steps = StepGraphs[None](FakeRecorder(), list)
    levels, draws = StepKind(varies="levels are still opening"), StepKind(varies="batches are made on the host")
    assert not any(steps.take(kind) for kind in (levels, draws, levels))
    assert [line.split("because ")[1] for line in said] == [levels.varies, draws.varies]
    assert steps.take(StepKind())
    with pytest.raises(ConfigError, match="levels are still opening"):
        StepGraphs[None](FakeRecorder(), list, must=True).take(levels)


@pytest.mark.parametrize(
    ("method", "settings", "words"),
    [
        ("nerfacto", {}, None),
        ("nerfacto", {"sampler": "occupancy"}, "the number of samples on a ray varies"),
        ("nerfacto", {"few_images": True, "open_levels_until": 0.5}, "levels are still opening"),
        ("instant-ngp", {}, "the number of samples on a ray varies"),  # on the CPU
        ("kplanes", {}, "the number of samples on a ray varies"),
        ("gaussian-splatting", {}, "batches are made on the host"),
    ],
)
def test_methods_say_whether_their_steps_repeat(
    method: str, settings: dict[str, Any], words: str | None, shared_tiny: Path, tmp_path: Path
) -> None:
    trainer = tiny_trainer(method, shared_tiny, tmp_path, **settings)
    kind = kind_of_step(trainer.model, trainer.source, 0, (256, 1))
    if words is None:
        assert kind.varies is None
        assert kind == kind_of_step(trainer.model, trainer.source, 9, (256, 1))
        assert kind != kind_of_step(trainer.model, trainer.source, 301, (256, 1))  # proposals rest
        assert kind != kind_of_step(trainer.model, trainer.source, 0, (255, 1))
    else:
        assert words in str(kind.varies)


def test_a_term_says_that_its_steps_do_not_repeat(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ramp(ColorError):
        def varies(self, config: Any) -> str:
            return "the weight of a term changes"

    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path)
    monkeypatch.setattr(trainer.model, "losses", (Ramp(),))
    assert kind_of_step(trainer.model, trainer.source, 0, (256, 1)).varies == "the weight of a term changes"


def test_the_flag(shared_tiny: Path, tmp_path: Path) -> None:
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert make_graphs("auto", cpu, list) is make_graphs("off", gpu, list) is None
    with pytest.raises(ConfigError, match=r"--machine\.cuda-graphs on: .* this run is on cpu"):
        make_graphs("on", cpu, list)
    assert tiny_trainer("nerfacto", shared_tiny, tmp_path).graphs is None


def test_graphs_are_recorded_on_the_stream_on_which_steps_warmed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The calls of torch.cuda, in their order, without a GPU."""
    calls: list[str] = []

    class Block:
        def __init__(self, *words: object) -> None:
            self.words = " ".join(map(str, words))

        def __enter__(self) -> None:
            calls.append(f"begin {self.words}")

        def __exit__(self, *error: object) -> None:
            calls.append(f"end {self.words}")

    class Stream:
        def __init__(self, name: object) -> None:
            self.name = f"stream of {name}"

        def __str__(self) -> str:
            return self.name

        def wait_stream(self, other: object) -> None:
            calls.append(f"{self} waits for {other}")

    class Graph:
        def __str__(self) -> str:
            return "graph"

        def replay(self) -> None:
            calls.append("replay")

    main = Stream("main")
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: main)
    monkeypatch.setattr(torch.cuda, "stream", Block)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream: Block(graph, stream))
    recorder = CudaRecorder(torch.device("cuda", 0))
    assert recorder.run(lambda: calls.append("step") or 3) == 3  # type: ignore[func-returns-value]
    own = "stream of cuda:0"
    assert calls == [
        f"{own} waits for stream of main", f"begin {own}", "step", f"end {own}", f"stream of main waits for {own}",
    ]  # fmt: skip
    calls.clear()
    result, repeat = recorder.record(lambda: calls.append("step") or 4)  # type: ignore[func-returns-value]
    repeat()
    assert result == 4
    assert calls == [f"begin graph {own}", "step", f"end graph {own}", "replay"]
    assert recorder.record(gc.isenabled)[0] is False  # memory freed meanwhile would spoil the recording
    assert gc.isenabled()


@pytest.mark.parametrize("usable", [True, False])
def test_a_recording_that_breaks_the_gpu_ends_the_run_in_a_line(
    usable: bool, monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    def draw(*size: object, device: object) -> None:
        if not usable:
            raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(torch.cuda, "Stream", lambda device: None)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: None)
    monkeypatch.setattr(torch.cuda, "graph", lambda graph, stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(CudaRecorder, "run", lambda self, function: function())
    monkeypatch.setattr(CudaRecorder, "watched", lambda self, function: (function(), None))
    steps = StepGraphs[None](CudaRecorder(torch.device("cuda", 0)), list)
    taken: list[int] = []

    def step() -> None:
        taken.append(1)
        if len(taken) == WARM_UP + 1:  # while it is recorded
            raise RuntimeError("invalidated\nby a wait")

    monkeypatch.setattr(torch, "rand", draw)
    with nullcontext() if usable else pytest.raises(ConfigError, match=r"invalidated by a wait.*cuda-graphs off"):
        for _ in range(WARM_UP):
            steps.run(StepKind(), lambda: None, step)
    assert [line.split("because ")[1] for line in said] == ["capturing one failed (invalidated by a wait)"] * usable


def test_a_step_that_waits_for_the_gpu_is_not_recorded(monkeypatch: pytest.MonkeyPatch, said: list[str]) -> None:
    """A recording of it would break later steps; torch's warning names the line of the program."""
    modes = ["default"]

    def set_mode(mode: str) -> None:
        warnings.warn("Synchronization debug mode is a prototype feature", stacklevel=2)
        modes.append(mode)

    monkeypatch.setattr(torch.cuda, "Stream", lambda device: None)
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: "default")
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", set_mode)
    monkeypatch.setattr(CudaRecorder, "run", lambda self, function: function())
    monkeypatch.setattr(CudaRecorder, "record", lambda self, function: pytest.fail("it was recorded"))
    steps = StepGraphs[int](CudaRecorder(torch.device("cuda", 0)), list)

    def step() -> int:
        if modes[-1] == "warn":
            warnings.warn("called a synchronizing CUDA operation (Triggered internally)", stacklevel=1)
        return 7

    assert [steps.run(StepKind(), lambda: None, step) for _ in range(WARM_UP)] == [7] * WARM_UP
    assert modes == ["default", "warn", "default"]
    line = inspect.getsourcelines(step)[1] + 2
    assert [each.split("because ")[1] for each in said] == [f"a step waits for the GPU (test_graphs.py:{line})"]
    assert not steps.take(StepKind())
