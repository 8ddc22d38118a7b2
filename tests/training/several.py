"""One of two processes that train together, for test_processes: `python -m tests.training.several DATA FOLDER PORT`.

It leaves its state in FOLDER/RANK.pt. At the end it runs ns-train, connected through another port.
"""

import math
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from nerfloom import Loss
from nerfloom.base.device import seed_step
from nerfloom.base.processes import joined_processes, processes
from nerfloom.cli import train
from nerfloom.data.pixels.batch import PixelBatch, draw_pixels, gather_batch
from nerfloom.data.sources import PixelSource, Request
from nerfloom.training import mean_gradients as averaging
from nerfloom.training.checkpoint import FOLDER, load_newest
from nerfloom.training.progress import StepReport
from nerfloom.training.step import backward, forward
from nerfloom.training.trainer import Trainer
from tests.cli.helpers import TINY_NGP
from tests.training.helpers import tensors, tiny_trainer

PIXELS, STEPS = 256, 12
"""Pixels of a batch of all processes together, and steps with such batches."""
METHODS = {"instant-ngp": 20, "nerfacto": 8, "gaussian-splatting": 16, "vanilla-nerf": 6}
"""Steps of each method, among them two updates of an occupancy grid, and one of the Gaussians' number."""
SHORT = 8
"""Steps of the other runs."""
WRITING = os.O_WRONLY | os.O_RDWR
Found = dict[str, Any]


class PartSource(PixelSource):
    """Batches; each process takes its part."""

    def draw(self, request: Request) -> PixelBatch:
        seed_step(self.seed, request.step)
        flat, behind = draw_pixels(self.dataset, PIXELS), torch.rand(PIXELS, 3)
        several = processes()
        part = slice(several.rank * PIXELS // several.count, (several.rank + 1) * PIXELS // several.count)
        return gather_batch(self.dataset, flat[part], behind[part])

    def drawing_from(self, dataset: Any) -> PixelSource:
        return PartSource(dataset, self.background, self.seed)


def trainer_of_parts(data: Path, folder: Path) -> Trainer:
    """A trainer with random numbers for batches only; its grid stays as it is."""
    trainer = tiny_trainer("instant-ngp", data, folder, adam_eps=1e-5, mixed_precision=False, thin_gradients=0)
    trainer.source = PartSource(trainer.train_set, "random", 7)
    sampler = trainer.model.sampler
    sample = sampler.sample
    sampler.sample = lambda rays, field, jitter: sample(rays, field, False)
    sampler.update = lambda step, density: None
    trainer.model.plain = False  # else rays are marched in the call that renders them
    trainer.prepare()
    return trainer


def parts(data: Path, folder: Path) -> Found:
    """Gradients of the first batch; losses and weights of a few steps."""
    trainer = trainer_of_parts(data, folder / "gradients")
    batch = trainer.source.draw(Request(0, PIXELS))
    finite = backward(forward(trainer.model, batch, 0, 0.0).total, trainer.optimizer)
    assert averaging.mean_gradients(trainer.optimizer, finite)
    gradients = {name: trainer.optimizer.gradient(p).clone() for name, p in trainer.model.named_parameters()}
    trainer = trainer_of_parts(data, folder / "parts")
    losses = [trainer.train_step().losses["rgb"] for _ in range(STEPS)]
    return {"gradients": gradients, "losses": losses, "tensors": tensors(trainer)}


def of_method(method: str, data: Path, folder: Path) -> Found:
    """The parameters of a method, and its losses on this process's batches."""
    trainer = tiny_trainer(method, data, folder / method, max_num_iterations=METHODS[method])
    losses = [sum(trainer.train_step().losses.values()) for _ in range(METHODS[method])]
    trainer.train()
    return {"losses": losses, "tensors": tensors(trainer)}


def resumed(data: Path, folder: Path) -> Found:
    """A run of one process; only the first process reads its checkpoint."""
    trainer = tiny_trainer("instant-ngp", data, folder / f"resumed-{processes().rank}", max_num_iterations=2 * SHORT)
    if processes().first:
        content = load_newest(folder / "alone" / FOLDER)
        assert content is not None
        trainer.restore(content)
    trainer.prepare()
    before = tensors(trainer)
    trainer.train()
    return {"before": before, "tensors": tensors(trainer), "step": trainer.state.step}


def disturbed(data: Path, folder: Path) -> Found:
    """The second process has a loss that is not finite, then one without a gradient, and is then told to stop."""
    trainer = tiny_trainer("instant-ngp", data, folder / f"disturbed-{processes().rank}", max_num_iterations=1000)
    true_loss = trainer.model.loss

    def loss(batch: PixelBatch, step: int) -> Loss:
        found = true_loss(batch, step)
        if processes().first or step not in (2, 4):
            return found
        return Loss({"rgb": torch.tensor(math.nan if step == 2 else 0.5)}, found.rgb, found.num_samples)

    def stop(report: StepReport, received: Sequence[int]) -> None:
        if report.step == SHORT and not processes().first:
            os.kill(os.getpid(), signal.SIGTERM)

    trainer.model.loss = loss
    outcome = trainer.train(stop)
    state = trainer.state
    return {
        "tensors": tensors(trainer), "step": state.step, "skipped": state.skipped, "stopped_by": outcome.stopped_by
    }  # fmt: skip


def timed(data: Path, folder: Path) -> Found:
    """A run by the clock."""
    trainer = tiny_trainer("instant-ngp", data, folder / f"timed-{processes().rank}", max_seconds=0.2)
    reason = trainer.train().reason
    return {"tensors": tensors(trainer), "step": trainer.state.step, "seconds": trainer.state.seconds, "reason": reason}


def written(folder: Path) -> list[str]:
    """Record, from now on, the files below a folder that this process opens to write."""
    found: list[str] = []

    def note(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and str(arguments[0]).startswith(str(folder)) and (arguments[2] or 0) & WRITING:
            found.append(str(arguments[0]))

    sys.addaudithook(note)
    return found


def main() -> None:
    data, folder, port = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
    torch.set_num_threads(1)
    averaging.LARGE = 1000  # so that some parameters are, and others are not
    found: dict[str, Any] = {}
    with joined_processes() as several:
        mine = folder / str(several.rank)  # the runs' folders must not exist twice
        found["parts"] = parts(data, mine)
        found |= {method: of_method(method, data, mine) for method in METHODS}
        found |= {name.__name__: name(data, folder) for name in (resumed, disturbed, timed)}
    files = written(folder / "outputs")
    os.environ["MASTER_PORT"] = port
    sys.argv = ["ns-train", "instant-ngp", "--data", str(data), "--output-dir", str(folder / "outputs"), *TINY_NGP]
    sys.argv += ["--max-num-iterations", "12", "--steps-per-save", "5", "--max-eval-images", "1"]
    train.main()
    torch.save({**found, "files": files}, folder / f"{several.rank}.pt")


if __name__ == "__main__":
    main()
