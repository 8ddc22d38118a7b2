"""The check of checkpoints; it returns a line for people and raises Fault if it fails."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

from nerfloom.testing.finding import Fault
from nerfloom.testing.learning import require_same
from nerfloom.testing.method_under_test import SEED, Learner, MethodUnderTest
from nerfloom.training.checkpoint import load_checkpoint, save_checkpoint
from nerfloom.training.trained import restore_model


def check_checkpoint(subject: MethodUnderTest) -> str:
    """Check that a model of `subject` loaded from a checkpoint renders and trains like the saved one, to the bit."""
    trained, loaded = subject.trained, subject.learner(seed=SEED + 1)
    _load_saved(trained, loaded)
    before, after = (learner.picture() for learner in (trained, loaded))
    remedy = "all state must be a parameter or a buffer (register_buffer), so that state_dict() includes it"
    for name in ("rgb", "median_depth", "accumulation"):
        if not torch.equal(getattr(before, name), getattr(after, name)):
            raise Fault(f"a new model renders another picture ({name}) after loading the checkpoint; {remedy}")
    for learner in (trained, loaded):
        learner.step()
    require_same(trained, loaded, "a step after a checkpoint was loaded", remedy)
    return "a loaded one gives the same picture and the same next step, bit for bit"


def _load_saved(trained: Learner, fresh: Learner) -> None:
    """Save the trained model and optimiser, and load them into the fresh ones."""
    content = {"model": trained.model.state_dict(), "optimizer": trained.optimizer.state_dict()}
    with tempfile.TemporaryDirectory() as folder:
        content = load_checkpoint(save_checkpoint(Path(folder), trained.done, content, keep_all=True))
    restore_model(fresh.model, content)
    fresh.optimizer.load_state_dict(content["optimizer"])
    fresh.done = trained.done
