"""Settings: one flat frozen dataclass a method, to and from plain YAML.

This module imports neither torch nor any method, so that the command line answers at once.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar, Union

import yaml

from framework.base.errors import ConfigError, nearest, shown
from framework.base.from_nerfstudio import config_answer

T = TypeVar("T")
RaysPerPixel = Literal[1, 4, 9, 16]
if TYPE_CHECKING:
    Auto = Annotated[T, "left to the data"]
else:

    class Auto:
        """`Auto[T]`: a setting of type T that may be left to the data, by None, until `Method.decide` fills it in.

        Type checkers take it for T: what is built from settings is built after they were decided.
        """

        def __class_getitem__(cls, kind: Any) -> Any:
            return kind | None


AUTO: Any = None
"""The default of an `Auto` setting."""
Range = tuple[float, float]
"""The least and the largest value of a setting, both allowed."""
AT_LEAST_0: Range = (0, math.inf)
SMALLEST_EPS = 1e-37
"""Least epsilon of Adam: float32, in which it is added, holds little less, and without one a gradient of 0 is 0 / 0."""


@dataclass(frozen=True)
class MachineConfig:
    """Where the run happens."""

    seed: int = 42
    """Random seed. The same seed, processor and thread count give the same bits; a GPU's sums differ in rounding."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to train on; auto takes CUDA where it is present."""
    num_threads: int | None = None
    """Processor threads; all cores if not given."""

    def __post_init__(self) -> None:
        if not -(2**63) <= self.seed < 2**63:
            raise ConfigError(f"--machine.seed is {shown(self.seed)}; it must be a number of 64 bits")


@dataclass(frozen=True)
class TrainConfig:
    """What every method can be told. A method's config derives from this and changes the defaults."""

    RANGES: ClassVar[dict[str, Range]] = {
        "max_num_iterations": (1, math.inf),
        "steps_per_save": (1, math.inf),
        "steps_per_eval_image": (1, math.inf),
        "steps_per_eval_all_images": (1, math.inf),
        "seconds_per_save": AT_LEAST_0,
        "seconds_per_eval_all_images": AT_LEAST_0,
        "max_eval_images": AT_LEAST_0,
        "lr_warmup_steps": AT_LEAST_0,
    }
    """What numbers may be, by name: a method's config names its own, and may change those of others. None, where it is
    allowed, is in every range; of several numbers each must be in it."""
    data: Path | None = None
    """Folder of the data set. The embedded scene if not given."""
    cache_limit: float | None = None
    """MB (1e6 bytes) of a split's decoded pixels that memory may hold; more goes to disk. If None, half of memory."""
    cache_dir: Path | None = None
    """Folder of decoded pixels that memory may not hold; nerfloom in the user's cache folder if not given."""
    output_dir: Path = Path("outputs")
    """Folder under which the run's folder is made."""
    experiment_name: str | None = None
    """First part of the run's folder; the data folder's name if not given."""
    timestamp: str | None = None
    """Last part of the run's folder; date and time if not given."""
    max_num_iterations: int = 30_000
    """Stop after this many steps."""
    max_seconds: float | None = None
    """Stop after this many seconds of training; evaluation and saving do not count."""
    target_psnr: float | None = None
    """Stop once the periodic evaluation over all images reaches this PSNR, dB."""
    steps_per_save: int = 2_000
    """Steps between checkpoints."""
    seconds_per_save: float = 60.0
    """A checkpoint is written at the latest after this many seconds of training."""
    save_only_latest_checkpoint: bool = True
    """Keep the two newest checkpoints, not all."""
    steps_per_eval_image: int = 500
    """Steps between renders of one evaluation image for TensorBoard; fewer where they would slow training by 10 %."""
    steps_per_eval_all_images: int = 10_000
    """Steps between evaluations over all images of the validation split; a few of them are looked at more often."""
    seconds_per_eval_all_images: float | None = None
    """Seconds of training between evaluations over all images; 15 if --target-psnr is given and this is not."""
    max_eval_images: int | None = None
    """Evaluate at most this many images, evenly spread; all if not given, none for 0."""
    vis: Literal["tensorboard", "none"] = "tensorboard"
    """Where curves and pictures go during training."""
    mixed_precision: bool | None = None
    """bfloat16 networks, float32 density and compositing. If not given: where the device multiplies bfloat16 fast."""
    load_dir: Path | None = None
    """Start from the newest checkpoint in this folder."""
    load_checkpoint: Path | None = None
    """Start from this checkpoint."""
    learning_rate: float = 5e-4
    """Adam's learning rate at the start."""
    lr_schedule: Literal["constant", "exponential", "cosine", "hold-exponential"] = "exponential"
    """Learning rate over the budget (steps or seconds, whichever is further spent); hold-: constant for half of it."""
    lr_final: float = 0.1
    """Learning rate at the end of the budget, as a share of the first."""
    lr_warmup_steps: int = 0
    """Steps over which the learning rate rises from zero."""
    adam_beta1: float = 0.9
    """Adam's decay of the mean gradient."""
    adam_beta2: float = 0.999
    """Adam's decay of the squared gradient."""
    adam_eps: float = 1e-8
    """Adam's epsilon."""
    masks: Literal["auto", "ignored", "empty"] = "auto"
    """What masks say in training of pixels that they do not keep: nothing, or that nothing is there, as around an
    object that was cut out. auto: the latter if they take away over half of all pixels, not the same of each image."""
    background: Literal["auto", "random", "white", "black"] = "auto"
    """Behind transparent pixels in training; auto: random if images have alpha. Evaluation is over white, or black."""
    machine: MachineConfig = field(default_factory=MachineConfig)
    """Seed, device and threads."""

    def __init_subclass__(cls, **defaults: Any) -> None:
        """Change defaults of inherited settings without repeating their types.

        As in `class MyConfig(RayConfig, learning_rate=1e-2)`.

        Args:
            defaults: new defaults by name.
        Raises: TypeError for a name that is no setting.
        """
        super().__init_subclass__()
        for name, value in defaults.items():
            owner = next((base for base in cls.__mro__[1:] if name in inspect.get_annotations(base)), None)
            if owner is None:
                raise TypeError(f"{cls.__name__} inherits no setting '{name}', whose default it changes")
            cls.__annotations__[name] = typing.get_type_hints(owner, include_extras=True)[name]
            setattr(cls, name, value)

    def __post_init__(self) -> None:
        ranges: dict[str, Range] = {}
        for kind in reversed(type(self).__mro__):
            ranges |= vars(kind).get("RANGES", {})
        for name, (least, most) in ranges.items():
            _check_range(name, getattr(self, name), least, most)
        if self.cache_limit is not None and not self.cache_limit >= 0:
            raise ConfigError(f"--cache-limit is {self.cache_limit}; it must be at least 0 MB")
        for name in ("adam_beta1", "adam_beta2"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{_flag(name)} is {getattr(self, name)}; it must be at least 0 and less than 1")
        if not self.adam_eps >= SMALLEST_EPS:
            raise ConfigError(f"--adam-eps is {self.adam_eps}; it must be at least {SMALLEST_EPS}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise ConfigError(f"--max-seconds is {self.max_seconds}; it must be more than 0")
        if not self.learning_rate > 0 or not 0 < self.lr_final <= 1:
            raise ConfigError("--learning-rate must be more than 0, and --lr-final in (0, 1]")


@dataclass(frozen=True)
class RayConfig(TrainConfig):
    """What every method that casts rays can be told."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_rays_per_batch": (1, 2**20),
        "eval_num_rays_per_chunk": (1, 2**20),
        "samples_per_batch": (1, 2**24),
        "train_rays_per_pixel_from": (0, 1),
    }
    """What these numbers may be."""
    num_rays_per_batch: int = 4_096
    """Rays in a training step."""
    rays_per_pixel: RaysPerPixel = 1
    """Rays of which a pixel of a picture is the mean, as a camera sees areas, not points. More: closer, and slower."""
    train_rays_per_pixel_from: float = 1.0
    """Share of the budget after which training too averages that many rays; until then it uses one."""
    samples_per_batch: int | None = None
    """Let the number of rays follow, so that a step evaluates about this many samples."""
    draw_by_error: bool = False
    """Draw half of the pixels where the error was large lately, with weights that keep the mean loss as it is."""
    eval_num_rays_per_chunk: int = 8_192
    """Rays rendered at once in evaluation. It changes memory and speed, never the picture."""


@dataclass(frozen=True)
class AppearanceConfig(TrainConfig):
    """What a method can be told that gives each image an appearance of its own."""

    eval_appearance: Literal["mean", "half"] = "mean"
    """Appearance of held-out images: the mean of all, or optimised on the left half, the right half being judged
    (NeRF-W's protocol)."""


def _check_range(name: str, value: Any, least: float, most: float) -> None:
    """Refuse a setting, or one of several numbers in it, that is NaN, less than `least` or more than `most`."""
    for number in value if isinstance(value, tuple) else (value,):
        if number is not None and not least <= number <= most:
            allowed = f"at least {least}" if most == math.inf else f"from {least} to {most}"
            raise ConfigError(f"{_flag(name)} is {shown(number)}; it must be {allowed}")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def to_plain(value: Any) -> Any:
    """A config as numbers, strings, lists and dictionaries, fit for the safe YAML dumper."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    return value


def from_plain(default: T, values: dict[str, Any], where: str) -> T:
    """`default` (a dataclass instance) with the given fields replaced.

    Args:
        values: plain values, as read from YAML.
        where: what to call the source in messages.
    Raises: ConfigError for an unknown key (naming the nearest) or a value of the wrong type.
    """
    hints = typing.get_type_hints(type(default))
    known = {f.name for f in dataclasses.fields(default)}  # type: ignore[arg-type]
    changes = {}
    for key, value in values.items():
        if key not in known:
            name = key if isinstance(key, str) else shown(key)
            raise ConfigError(f"{where}: unknown key {shown(name)}. {nearest(name, known)}")
        current = getattr(default, key)
        if dataclasses.is_dataclass(current) and isinstance(value, dict):
            changes[key] = from_plain(current, value, f"{where}: {key}")
        else:
            changes[key] = _convert(value, hints[key], f"{where}: '{key}'")
    return dataclasses.replace(default, **changes)  # type: ignore[type-var]


def _convert(value: Any, hint: Any, where: str) -> Any:
    """`value` as the type that `hint` asks for."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(value, next(a for a in arguments if a is not type(None)), where)
    if origin is Literal:
        if value in arguments:
            return value
        raise ConfigError(f"{where} is {shown(value)}; it must be one of {', '.join(map(str, arguments))}")
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(inner) == len(value):
            return tuple(_convert(item, kind, where) for item, kind in zip(value, inner, strict=True))
    if hint is Path and isinstance(value, str) and "\0" not in value:
        return Path(value)
    if hint is float and isinstance(value, str):  # YAML 1.1 reads 1e-3 as a string
        try:
            return float(value)
        except ValueError:
            pass
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    if isinstance(hint, type) and (_is_count(value) if hint is int else isinstance(value, hint)):
        return value
    raise ConfigError(f"{where} is {shown(value)}; it must be {getattr(hint, '__name__', hint)}")


def _is_count(value: Any) -> bool:
    """Whether a value is an integer that processors count with; True and False are none, though Python thinks so."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63


class _PlainLoader(yaml.SafeLoader):
    """The safe loader without aliases: a few lines of them can stand for more than memory holds."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name) stands for something else; write it out")
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML file that holds a mapping, read by the safe loader, without aliases.

    Raises: ConfigError where it is missing, not YAML, or not a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
        if (answer := config_answer(text)) is not None:
            raise ConfigError(f"{path} {answer}")
        values = yaml.load(text, _PlainLoader)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except ConfigError:
        raise
    except Exception as error:  # besides YAMLError: bad text, dates and nesting; `!!float ''` is an IndexError
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{path} is not plain YAML: {reason}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} must hold keys and values, such as 'method: instant-ngp'")
    return values
