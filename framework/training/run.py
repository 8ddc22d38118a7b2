"""A run: a method, its settings, a data set, and a folder for all its files.

outputs/{experiment}/{method}/{YYYY-mm-dd_HHMMSS}/
    config.yml                    all settings, plain YAML
    dataparser_transforms.json    from the input's frame to the scene's
    nerfstudio_models/            checkpoints
    scene_profile.json            properties of the scene and the settings chosen from them
    learning_curve.json           seconds, step, PSNR and SSIM of held-out images, and their number
    skip_report.json              skipped work, and the time that it saved
    summary.json                  steps, seconds, rays, memory, parameters, and the machine
    eval.json, pictures/          the final evaluation
    events.out.tfevents.*         TensorBoard
    .lock                         held while a process trains
"""

from __future__ import annotations

import dataclasses
import os
import shlex
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import yaml

from nerfloom.base.atomic import write_atomically
from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.json_files import write_json
from nerfloom.base.plain import from_plain, read_yaml, to_plain
from nerfloom.base.splits import Split
from nerfloom.base.step_limit import limited_as_given
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.cameras.poses import Placement
from nerfloom.data.dataset import Dataset
from nerfloom.data.parsed_scene import DataParser, ParsedScene
from nerfloom.data.training_images import chosen_images
from nerfloom.registry import load_dataparser, load_method
from nerfloom.training.data_folder import find_data
from nerfloom.training.run_path import CONFIG, config_file, data_name

TRANSFORMS = "dataparser_transforms.json"
"""Name of the placement in a run's folder."""
TIMESTAMP = "%Y-%m-%d_%H%M%S"
"""Format of the name of a run's folder."""
PLACEMENT_TOLERANCE = 1e-3
"""Tolerated distance between two placements of a camera, relative to the furthest camera's distance from the origin."""


@dataclass(frozen=True)
class Run:
    """A method, its settings, a data set and a folder."""

    method: str
    """Name of the method."""
    config: TrainConfig
    """Settings of the method."""
    dataparser: str
    """Name of the data format."""
    parser: DataParser
    """Data format, with its flags."""
    folder: Path
    """Folder of the run's files."""

    @property
    def config_path(self) -> Path:
        """Path of the run's config.yml."""
        return self.folder / CONFIG

    def parse(self, split: Split) -> ParsedScene:
        """Read a `split` of the run's data. For training images, the settings may select some.

        Raises:
            DataError: if the data is missing or unreadable, or its placement has changed since training.
            ConfigError: if the settings select training images that the data does not have.
        """
        data = self.config.data
        if data is not None and not os.path.exists(data):
            raise DataError(f"the run's data {data} does not exist; give its new location: --data DIR")
        parsed = self._placed_as_trained(self.parser.parse(data, split), split)
        if split != "train":
            return parsed
        return chosen_images(parsed, self.config.max_train_images, self.config.train_image_indices)

    def _placed_as_trained(self, parsed: ParsedScene, split: Split) -> ParsedScene:
        """Return the data with the placement that the trained run recorded; another one would shift all pictures."""
        file = self.folder / TRANSFORMS
        if not file.is_file():
            return parsed
        try:
            then = read_transforms(file)
        except DataError as error:
            say(f"warning: {error}; the placement of the data is not checked")
            return parsed
        moved = _moved(parsed, then)
        if moved >= PLACEMENT_TOLERANCE and hasattr(self.parser, "placement"):
            say(
                f"{self.config.data}: images or settings have changed since {self.folder} was trained; cameras keep "
                "their placement, but other images may be held out"
            )
            parser = dataclasses.replace(self.parser, placement=file)  # type: ignore[type-var]
            parsed = parser.parse(self.config.data, split)
            moved = _moved(parsed, then)
        if not moved < PLACEMENT_TOLERANCE:
            raise DataError(
                f"{self.config.data}: cameras have moved since {self.folder} was trained, by up to "
                f"{100 * moved:.2g} % of their distance from the origin: images were added or removed, or the "
                "format's settings changed; restore them, or train again"
            )
        return parsed


def _moved(parsed: ParsedScene, then: Placement) -> float:
    """Return how far cameras have moved since another placement, relative to the furthest camera's distance."""
    now, origins = parsed.placement, parsed.cameras.camera_to_worlds[:, :, 3].double()
    moved = (then.points(now.original_points(origins)) - origins).norm(dim=-1).max()
    return max(float(moved / origins.norm(dim=-1).max().clamp(min=1e-9)), abs(then.scale / now.scale - 1))


def run_folder(method: str, config: TrainConfig) -> Path:
    """Return the folder of a new run of `method`: outputs/{experiment}/{method}/{timestamp}."""
    experiment = config.experiment_name or data_name(config.data)
    timestamp = config.timestamp or datetime.now().strftime(TIMESTAMP)
    return config.output_dir / experiment / method / timestamp


def with_own_folder(run: Run) -> Run:
    """Create an empty folder for a new `run` without --timestamp, and return the run.

    If the folder exists, it belongs to a run that began in the same second. The name is then of a later second.

    Raises:
        ConfigError: if the folder cannot be created.
    """
    while not run.config.timestamp:
        try:
            run.folder.mkdir(parents=True)
            break
        except OSError as error:
            if not os.path.lexists(run.folder):
                raise ConfigError(f"cannot write the run's folder {run.folder}: {error.strerror or error}") from error
        later = datetime.strptime(run.folder.name, TIMESTAMP) + timedelta(seconds=1)
        run = dataclasses.replace(run, folder=run.folder.with_name(later.strftime(TIMESTAMP)))
    return run


def create_folder(run: Run) -> None:
    """Create the folder of `run` and write its config.yml.

    Raises:
        ConfigError: if the folder already holds a run or cannot be written.
    """
    if run.config_path.exists():
        raise ConfigError(
            f"{run.folder} already holds a run; choose another --timestamp, or continue it: "
            f"ns-train --resume {shlex.quote(str(run.folder))}"
        )
    paths = {name: getattr(run.config, name) for name in ("data", "lpips_weights", "teacher")}
    # Resolved, they are valid from any working folder.
    resolved: dict[str, Any] = {name: path.resolve() for name, path in paths.items() if path is not None}
    config = dataclasses.replace(run.config, **resolved)
    document = {
        "method": run.method,
        "dataparser": {"name": run.dataparser, **to_plain(run.parser)},
        **to_plain(config),
    }
    text = yaml.safe_dump(document, sort_keys=False)
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(run.config_path, lambda file: file.write(text.encode()))
    except OSError as error:
        raise ConfigError(f"cannot write the run's folder {run.folder}: {error.strerror or error}") from error


def read_run(path: Path) -> Run:
    """Read a run, or a recipe for one, from a YAML file.

    Its keys are `method`, optionally `dataparser` (with `name` and the format's flags), and the method's settings.

    Args:
        path: the file, or a folder for `config_file`.

    Raises:
        ConfigError: if a method, format or key is unknown, or a value has the wrong type.
    """
    path = config_file(path)
    values = read_yaml(path)
    method = values.pop("method", None)
    if not isinstance(method, str):
        raise ConfigError(f"{path} does not say which method, as in 'method: instant-ngp'")
    data_flags = values.pop("dataparser", None) or {}
    config = limited_as_given(from_plain(load_method(method).config, values, str(path)), values)
    if not isinstance(data_flags, dict):
        raise ConfigError(f"{path}: 'dataparser' must hold keys and values, such as 'name: blender'")
    data_flags = dict(data_flags)
    name = data_flags.pop("name", None)
    if name is None:
        data, name = find_data(config.data)
        config = dataclasses.replace(config, data=data)
    name = str(name)
    parser = from_plain(load_dataparser(name)(), data_flags, f"{path}: dataparser")
    return Run(method, config, name, parser, path.parent)


def write_report(path: Path, content: Any) -> None:
    """Write finite plain `content` to `path` as `write_json` does, but only warn on failure: training continues."""
    try:
        write_json(path, content)
    except OSError as error:
        say(f"warning: cannot write {path}: {error.strerror or error}; going on without")


def write_transforms(run: Run, dataset: Dataset) -> None:
    """Write dataparser_transforms.json of a run in nerfstudio's format, from the placement of its `dataset`."""
    content = {"transform": dataset.transform.tolist(), "scale": dataset.scale}
    write_report(run.folder / TRANSFORMS, content)
