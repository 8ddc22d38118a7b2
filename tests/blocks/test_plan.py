"""The plan of a scene in blocks: jobs whose commands are short, however many images a block has."""

import json
from pathlib import Path

from nerfloom.blocks.block import Block
from nerfloom.cameras.poses import Placement
from nerfloom.jobs.job import Job
from nerfloom.training.block_plan import BlockPlan
from nerfloom.training.run import read_run


def recipe_of(job: Job) -> Path:
    (step,) = job.steps
    return Path(step.command[step.command.index("--load-config") + 1])


def test_the_images_of_a_block_are_in_a_file_and_not_in_its_command(tmp_path: Path) -> None:
    """Linux takes commands of 2 MiB, a pointer to each word included; these are 200,000 images."""
    many, few = tuple(range(0, 400_000, 2)), (3, 1, 4)
    blocks = Block((0.0, 0.0, 0.0), 1.0, many), Block((1.0, 0.0, 0.0), 1.0, few)
    plan = BlockPlan("instant-ngp", ("--max-num-iterations", "10"), blocks, (None, None), tmp_path, "10 steps")
    plan.claim_folder(Placement.of(None, 1.0))
    first, second = plan.jobs()
    for job in (first, second):
        assert sum(len(word.encode()) + 9 for step in job.steps for word in step.command) < 8192
    assert json.loads(recipe_of(first).read_text())["train_image_indices"] == list(many)
    run = read_run(recipe_of(second))
    assert (run.method, run.config.train_image_indices) == ("instant-ngp", few)
