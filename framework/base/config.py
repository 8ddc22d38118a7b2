"""Configs of methods: flat frozen dataclasses, read from and written to plain YAML.

This module imports neither PyTorch nor any method, so that commands start quickly.
"""

from __future__ import annotations

import inspect
import math
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from nerfloom.base.errors import ConfigError, shown
from nerfloom.base.machine_config import MachineConfig, ViewerConfig

T = TypeVar("T")
RaysPerPixel = Literal[1, 4, 9, 16]
LEFT_TO_DATA = "left to the data"
"""Marks the types of settings that may be left to the data."""
if TYPE_CHECKING:
    Auto = Annotated[T, LEFT_TO_DATA]
else:

    class Auto:
        """`Auto[T]`: a setting of type T, or `AUTO` until `Method.decide` fills it in.

        Type checkers see T: models are built only after all settings are decided.
        """

        def __class_getitem__(cls, kind: Any) -> Any:
            return Annotated[kind | Literal["auto"], LEFT_TO_DATA]


AUTO: Any = "auto"
"""Value of an `Auto` setting that is left to the data."""
Range = tuple[float, float]
"""Minimum and maximum of a setting, inclusive."""
AT_LEAST_0: Range = (0, math.inf)
MIN_EPS = 1e-37
"""Minimum epsilon of Adam, close to the smallest normal float32. Without epsilon, a gradient of 0 gives 0 / 0."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of every method. A method's config derives from this class and changes defaults."""

    RANGES: ClassVar[dict[str, Range]] = {
        "max_num_iterations": (1, math.inf),
        "steps_per_save": (1, math.inf),
        "steps_per_eval_image": (1, math.inf),
        "steps_per_eval_all_images": (1, math.inf),
        "seconds_per_save": AT_LEAST_0,
        "seconds_per_eval_all_images": AT_LEAST_0,
        "max_eval_images": AT_LEAST_0,
        "max_train_images": (1, math.inf),
        "train_image_indices": AT_LEAST_0,
        "lr_warmup_steps": AT_LEAST_0,
        "viewer_share": (0.001, 1),
        "teacher_share": (0, 1),
        "teacher_until": (0, 1),
    }
    """Allowed ranges; a method's config adds or overrides some. Every range allows None; each number of a tuple is
    checked."""
    GONE: ClassVar[dict[str, Any]] = {}
    """Settings of earlier versions, each with the value that is used now, or with a function of the settings that
    returns this value. A method's config adds some. Files with this value are read, so that old runs open; files with
    another are refused."""
    data: Path | None = None
    """Folder of the data set. Default: the embedded scene."""
    max_train_images: int | None = None
    """Maximum number of training images, evenly spaced. Default: all."""
    train_image_indices: tuple[int, ...] = ()
    """Indices of the training images to use, from 0, as in 26 86 2. Default: all."""
    cache_limit: float | None = None
    """Maximum memory for decoded pixels of a split, MB (1e6 bytes); the rest goes to disk. Default: half of memory."""
    cache_dir: Path | None = None
    """Folder for decoded pixels on disk. Default: nerfloom in the user's cache folder."""
    output_dir: Path = Path("outputs")
    """Folder that receives the run's folder."""
    experiment_name: str | None = None
    """First part of the run folder's path. Default: the data folder's name."""
    timestamp: str | None = None
    """Last part of the run folder's path. Default: date and time."""
    max_num_iterations: int | None = 30_000
    """Stop after this many steps; no limit if only --max-seconds is given."""
    max_seconds: float | None = None
    """Stop after this many seconds of training, not counting evaluation and saving."""
    target_psnr: float | None = None
    """Stop when a periodic evaluation of all validation images reaches this PSNR, dB."""
    steps_per_save: int = 2_000
    """Steps between checkpoints."""
    seconds_per_save: float = 60.0
    """Maximum seconds of training between checkpoints."""
    save_only_latest_checkpoint: bool = True
    """Keep only the two newest checkpoints."""
    steps_per_eval_image: int = 500
    """Steps between renders of one held-out image for TensorBoard; more if they would slow training by 10 %."""
    steps_per_eval_all_images: int = 10_000
    """Steps between evaluations of all validation images; a few images are evaluated more often."""
    seconds_per_eval_all_images: float | None = None
    """Seconds of training between evaluations of all images. Default: 15 with --target-psnr, else off."""
    max_eval_images: int | None = None
    """Maximum number of evaluated images, evenly spaced; 0: none. Default: all."""
    eval: Literal["in-time", "all"] = "in-time"
    """Evaluated images. in-time: evenly spaced images that take at most half of the training time; all: all."""
    lpips_weights: Path | None = None
    """File of LPIPS weights with AlexNet (.npz), for evaluations. Default: the weights of the lpips package."""
    vis: Literal["tensorboard", "viewer", "viewer+tensorboard", "none"] = "tensorboard"
    """Where to show training curves and rendered images: TensorBoard files, a browser, or both."""
    viewer_share: float = 0.1
    """Maximum fraction of the total time for the viewer's pictures; it does not count as training time."""
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    """Address of the viewer."""
    mixed_precision: bool | None = None
    """Run networks in bfloat16, density and compositing in float32. Default: if the device multiplies bfloat16 fast."""
    teacher: Path | None = None
    """Trained run, file of Gaussians or octree, which renders views between the training cameras to learn from."""
    teacher_share: float = 0.5
    """Fraction of the steps that learn from --teacher, at the start; it falls linearly to 0 at --teacher-until."""
    teacher_until: float = 0.8
    """Fraction of the budget after which training uses photographs alone (--teacher)."""
    load_dir: Path | None = None
    """Start from the newest checkpoint in this folder."""
    load_checkpoint: Path | None = None
    """Start from this checkpoint."""
    learning_rate: Auto[float] = 5e-4
    """Initial learning rate of Adam."""
    lr_schedule: Auto[Literal["constant", "exponential", "cosine", "hold-exponential"]] = "exponential"
    """Learning rate over the budget (steps or seconds, whichever is further spent); hold-: constant for half of it."""
    lr_final: Auto[float] = 0.1
    """Learning rate at the end of the budget, as a fraction of the initial one."""
    lr_warmup_steps: int = 0
    """Steps over which the learning rate rises from zero."""
    adam_beta1: float = 0.9
    """Adam's decay rate of the mean gradient."""
    adam_beta2: float = 0.999
    """Adam's decay rate of the mean squared gradient."""
    adam_eps: float = 1e-8
    """Adam's epsilon."""
    masks: Literal["auto", "ignored", "empty", "off"] = "auto"
    """Meaning of masked-out pixels in training. ignored: unknown content; empty: empty space, as around a cut-out
    object; off: none, masks are not read; auto: empty in formats with masks of an object, and if masks remove over
    half of all pixels and differ between images, else ignored."""
    background: Literal["auto", "random", "white", "black"] = "auto"
    """Colour behind transparent pixels in training. auto: random if images have alpha, or if images are opaque and
    cameras stand in the box, so that every ray ends there. Evaluation: white or black."""
    machine: MachineConfig = field(default_factory=MachineConfig)
    """Seed, device and threads."""

    # Values of settings that a method lacks, so that shared code need not know the class of its settings. They have no
    # annotations, so they are neither fields nor flags.
    sampler, bounded_sampler, time_slices, robust = "", "occupancy", 1, "off"
    appearance = changing_light = "none"
    background_model, directional = "contraction", "view"
    learns_motion = smallest_box = silhouette_cells = seen_cells = False
    rays_shared_by = images_per_batch = num_coarse_samples = num_fine_samples = appearance_embedding_dim = 0
    depth_loss_mult = free_space_loss_mult = 0.0

    def __init_subclass__(cls, **defaults: Any) -> None:
        """Change defaults of inherited settings, as in `class MyConfig(RayConfig, learning_rate=1e-2)`.

        Args:
            defaults: new defaults by name.
        Raises: TypeError if a name is not a setting.
        """
        super().__init_subclass__()
        for name, value in defaults.items():
            owner = next((base for base in cls.__mro__[1:] if name in inspect.get_annotations(base)), None)
            if owner is None:
                raise TypeError(f"{cls.__name__} inherits no setting '{name}', but changes its default")
            cls.__annotations__[name] = typing.get_type_hints(owner, include_extras=True)[name]
            setattr(cls, name, value)

    def __post_init__(self) -> None:
        for name, (least, most) in in_all_bases(type(self), "RANGES").items():
            _check_range(name, getattr(self, name), least, most)
        if self.cache_limit is not None and not self.cache_limit >= 0:
            raise ConfigError(f"--cache-limit is {self.cache_limit}; it must be at least 0 MB")
        for name in ("adam_beta1", "adam_beta2"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{_flag(name)} is {getattr(self, name)}; it must be at least 0 and less than 1")
        if not self.adam_eps >= MIN_EPS:
            raise ConfigError(f"--adam-eps is {self.adam_eps}; it must be at least {MIN_EPS}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise ConfigError(f"--max-seconds is {self.max_seconds}; it must be more than 0")
        rates = [rate for rate in (self.learning_rate, self.lr_final) if rate != AUTO]
        if not all(rate > 0 for rate in rates) or (self.lr_final != AUTO and self.lr_final > 1):
            raise ConfigError("--learning-rate must be more than 0, and --lr-final in (0, 1]")


AppearanceKind = Literal["none", "vector", "affine", "tone", "grid"]
"""How images of one scene differ in light, exposure and white balance."""
HeldOutAppearance = Literal["mean", "half", "nearest"]
"""Appearance used to evaluate held-out images."""


@dataclass(frozen=True)
class RobustConfig(TrainConfig):
    """Settings of a method with a colour loss that uses the weights of pixels."""

    robust: Auto[Literal["off", "errors", "scout"]] = AUTO
    """How to leave out regions that other images contradict, such as people who walk through. errors: by errors in
    training. scout: by a field that is trained first, in a part of the budget; then they are masked out. auto: scout if
    images around it clearly contradict a part of most images, else off."""


@dataclass(frozen=True)
class AppearanceConfig(TrainConfig):
    """Settings of every method that learns colours.

    `changing_light` is the kind of appearance that `auto` chooses if light differs between the images.
    """

    RANGES: ClassVar[dict[str, Range]] = {"mean_appearance_share": (0, 1)}
    appearance: Auto[AppearanceKind] = AUTO
    """How images differ. none: not at all; vector: by an input of the colour network; affine: by an affine function of
    colours; tone: by exposure and white balance, through a tone curve of each camera; grid: by affine functions that
    vary with position and brightness. auto: vector or affine if light or exposure differ and the method has it by
    default, else none."""
    eval_appearance: HeldOutAppearance = "mean"
    """Appearance of held-out images. mean: the mean of the training images'; half: optimised on the left half of each
    image, with metrics of the right half (NeRF-W's protocol); nearest: the training image's with the nearest camera."""
    mean_appearance_share: float = 0.25
    """Probability of training an image with the mean appearance, so that the model learns to render it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.appearance == "vector" and not self.appearance_embedding_dim:
            raise ConfigError("--appearance vector: no network of this method takes vectors; take affine, tone or grid")


@dataclass(frozen=True)
class VectorConfig(AppearanceConfig):
    """Settings of a method with a colour network that can take a vector of each image."""

    RANGES: ClassVar[dict[str, Range]] = {"appearance_embedding_dim": (1, 2**10)}
    appearance_embedding_dim: int = 16
    """Length of each image's vector (--appearance vector)."""
    changing_light = "vector"


@dataclass(frozen=True)
class RayConfig(RobustConfig, AppearanceConfig):
    """Settings of every method that casts rays."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_rays_per_batch": (1, 2**20),
        "steps_per_ray": (0, 1e6),
        "eval_num_rays_per_chunk": (1, 2**20),
        "samples_per_batch": (1, 2**24),
        "train_rays_per_pixel_from": (0, 1),
        "depth_loss_mult": AT_LEAST_0,
        "free_space_loss_mult": AT_LEAST_0,
        "rays_shared_by": (0, 100),
        "thin_gradients": (0, 16),
    }
    num_rays_per_batch: int = 4_096
    """Rays per training step; the maximum with --max-seconds, see --steps-per-ray."""
    steps_per_ray: float = 1.0
    """With --max-seconds: rays per step are at most the number of steps that fit into the time, divided by this. 0:
    always --num-rays-per-batch. No effect with --samples-per-batch."""
    rays_per_pixel: RaysPerPixel = 1
    """Rays averaged per pixel. More rays are more accurate and slower."""
    train_rays_per_pixel_from: Auto[float] = 1.0
    """Fraction of the budget after which training uses --rays-per-pixel; before, it uses one ray per pixel."""
    samples_per_batch: Auto[int | None] = AUTO
    """Samples per training step; the number of rays is adjusted to reach about this many."""
    depth_loss_mult: Auto[float] = AUTO
    """Weight of the depth loss; 0: none. auto: 0.1 with depth images, 0.001 with points of a reconstruction, else 0."""
    free_space_loss_mult: float = 0.0
    """Weight of the penalty on matter close to a camera: nearer than most points that this camera sees, or nearer than
    the first position that another camera sees. 0: none."""
    rays_shared_by: Auto[int] = AUTO
    """Start rays at the first position that this many training images see; 0: at the near plane. auto: 2 in unbounded
    scenes, if that cuts off no reconstructed points and nothing that cameras look at, else 0. No effect in boxes
    (--seen-cells)."""
    thin_gradients: Auto[float] = 0.0
    """Drop samples at random if their gradient is below this multiple of the mean, and weight the rest so that the
    expected gradient stays the same. 0: keep all. CPU only."""
    gradient_scaling: bool = False
    """Scale gradients near cameras down by squared distance, up to half of the box's edge, against floaters."""
    eval_num_rays_per_chunk: int = 8_192
    """Rays rendered at once in evaluation. Affects memory and speed, not the result."""


@dataclass(frozen=True)
class SourceViewsConfig(RayConfig):
    """Settings of a method that renders from images of the scene."""

    RANGES: ClassVar[dict[str, Range]] = {"num_source_views": (1, 64), "images_per_batch": (1, 1024)}
    num_source_views: int = 3
    """Number of images that a view is rendered from."""
    images_per_batch: int = 4
    """Number of images that a training step draws pixels from; each is rendered from other images of its scene."""


def in_all_bases(kind: type, name: str) -> dict[str, Any]:
    """Return the dictionaries of one name in a class and its bases as one. A class overrides its bases.

    Args:
        kind: the class.
        name: name of the attributes, such as RANGES.
    """
    merged: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        merged |= vars(base).get(name, {})
    return merged


def _check_range(name: str, value: Any, least: float, most: float) -> None:
    """Refuse a setting, or a tuple of settings, with a number that is NaN, below `least` or above `most`."""
    for number in value if isinstance(value, tuple) else (value,):
        if number not in (None, AUTO) and not least <= number <= most:
            allowed = f"at least {least}" if most == math.inf else f"from {least} to {most}"
            raise ConfigError(f"{_flag(name)} is {shown(number)}; it must be {allowed}")


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
