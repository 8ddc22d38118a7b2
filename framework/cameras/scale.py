"""The scale of a run: the unit of its lengths, once a true length in the scene has been given.

Photographs do not tell a scene's size. The scale is a number and a name: lengths of the input times `factor` are in
`unit`. It is kept in the file scale.json of a run's folder. An exported file NAME of Gaussians has coordinates in that
unit and the scale in NAME.scale.json. Without such a file, lengths are in the input's own unit.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from nerfloom.base.errors import DataError, FlagError, shown
from nerfloom.base.json_files import read_object, write_json
from nerfloom.cameras.poses import Placement

NAME = "scale.json"
"""Name of the file in a run's folder, and the end of its name beside a file."""
MAX_NAME = 20
"""Maximum number of characters of a unit's name."""


@dataclass(frozen=True)
class Scale:
    """The unit of a run's lengths."""

    factor: float = 1.0
    """Lengths in `unit` per length of the input."""
    unit: str = ""
    """Name of the unit; empty for the input's own."""
    relative_error: float | None = 0.0
    """Standard deviation of `factor`, as a fraction of it; None if it is not known."""

    @property
    def is_known(self) -> bool:
        """True if a true length has been given."""
        return bool(self.unit)

    def placed(self, placement: Placement) -> Placement:
        """Return the `placement` of the input, in its own unit, in this scale."""
        return placement.after(torch.eye(4), self.factor)

    def unplaced(self, placement: Placement) -> Placement:
        """Return the `placement` of the input, in this scale, in its own unit; the inverse of `placed`."""
        return placement.before(torch.eye(4), self.factor)

    def words(self) -> str:
        """Return a sentence that says the unit and where it comes from."""
        if not self.is_known:
            return "lengths are in the unit of the input; a true length sets another: --scale-points"
        error = f" ± {100 * self.relative_error:.2g} %" if self.relative_error else ""
        if self.relative_error is None:
            error = ", with an unknown error"
        return f"lengths are in {self.unit}; a unit of the input is {self.factor:.6g} {self.unit}{error}"


def checked(scale: Scale, where: str) -> Scale:
    """Return a `scale` with usable numbers and name; the message says `where` it comes from.

    Raises:
        FlagError: if the factor is not positive and finite, or the name is not a short word.
    """
    name = scale.unit
    if not name or len(name) > MAX_NAME or not name.isprintable() or set(name) & set("<>&\"'"):
        raise FlagError(f"{where}: the unit is {shown(name)}; it must be a short name, such as m, cm or inch")
    if not 1e-12 < scale.factor < 1e12 or not 0 <= (scale.relative_error or 0.0) < math.inf:
        raise FlagError(f"{where}: a unit of the input would be {scale.factor:g} {name}; give another length")
    return scale


def scale_file(path: Path) -> Path:
    """Return the path of the scale of a run's folder or of a file."""
    return path / NAME if path.is_dir() else path.with_name(f"{path.name}.{NAME}")


def read_scale(path: Path) -> Scale:
    """Read the scale kept for `path`, a run's folder or a file; the input's scale if there is none.

    Raises:
        DataError: if the scale cannot be read or used.
    """
    file = scale_file(path)
    if not file.exists():
        return Scale()
    content = read_object(file)
    factor, unit, error = content.get("factor"), content.get("unit"), content.get("relative_error", 0.0)
    numbers = (factor,) if error is None else (factor, error)
    if not isinstance(unit, str) or not all(type(value) in (int, float) for value in numbers):
        raise DataError(f"{file} needs a number 'factor' and a name 'unit'; set the scale again, or remove the file")
    try:
        return checked(Scale(float(factor), unit, None if error is None else float(error)), str(file))  # type: ignore[arg-type]
    except (FlagError, OverflowError) as problem:
        raise DataError(f"{file} cannot be used: {problem}; set the scale again, or remove the file") from problem


def write_scale(path: Path, scale: Scale) -> None:
    """Write the `scale` of `path`, a run's folder or a file; remove an earlier one if it is the input's own.

    Raises:
        OSError: if the scale cannot be written or removed.
    """
    file = scale_file(path)
    if not scale.is_known:
        file.unlink(missing_ok=True)
        return
    write_json(file, asdict(scale))
