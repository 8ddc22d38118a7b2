"""Cameras of Agisoft Metashape: the XML of File > Export > Export Cameras.

A camera's transform leads from its own axes (x right, y down, z forward) to the frame of its component, or of its
chunk. Rotation, translation t and scale s of that component or chunk lead to the world: x -> t + s R x. The world is
geocentric if the chunk has the coordinate system of a map or of the globe, and local otherwise (Metashape's user manual
and its Python reference, `Chunk.transform` and `Camera.transform`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from nerfloom.base.console import say
from nerfloom.base.errors import DataError, shown
from nerfloom.base.xml_files import read_xml
from nerfloom.processing.capture import Capture, PosedCamera, for_size_of, near_origin, relative_name, spread_of
from nerfloom.processing.finite_numbers import finite_array, nearest_rotation
from nerfloom.processing.geocentric import east_north_up, is_near_surface
from nerfloom.processing.metashape_lens import UnsupportedSensor, lens_of
from nerfloom.processing.transforms import Lens, camera_pose

PROGRAM = "Metashape"
"""Name for messages."""
OTHER = "of another component"
"""Reason for leaving out a camera."""


@dataclass(frozen=True)
class Similarity:
    """The map from a component or a chunk to the world: x -> translation + scale * rotation @ x."""

    rotation: np.ndarray
    """(3, 3)."""
    translation: np.ndarray
    """(3,)."""
    scale: float
    """Units of the world per unit of the chunk."""


@dataclass(frozen=True)
class _Aligned:
    """A camera with a pose, and the component that it belongs to."""

    camera: PosedCamera
    component: str


def read_capture(file: Path) -> Capture:
    """Read the cameras of a chunk.

    If there are several components, which are not aligned with each other, the one with the most cameras is taken,
    unless all are georeferenced.

    Args:
        file: cameras.xml.

    Raises:
        DataError: if the file is not one of Metashape's cameras, or a number in it is invalid.
    """
    chunks = list(read_xml(file).iter("chunk"))
    if not chunks or chunks[0].find("cameras") is None or chunks[0].find("sensors") is None:
        raise DataError(f"{file} has no cameras of Metashape; export them with File > Export > Export Cameras as XML")
    if len(chunks) > 1:
        say(f"{file} has {len(chunks)} chunks; the first is read")
    left_out: Counter[str] = Counter()
    aligned = list(_aligned(chunks[0], file, left_out))
    if aligned and not _is_geocentric(chunks[0], aligned):
        largest, _ = Counter(each.component for each in aligned).most_common(1)[0]
        left_out[OTHER] += sum(each.component != largest for each in aligned)
        aligned = [each for each in aligned if each.component == largest]
    geocentric = _is_geocentric(chunks[0], aligned)
    cameras = [each.camera for each in aligned]
    frame = _east_north_up(cameras) if geocentric else near_origin(cameras)
    return Capture(PROGRAM, cameras, left_out, z_is_up=geocentric, frame=frame)


def similarity_of(transform: Element | None, where: str) -> Similarity:
    """Return the map that a `transform` element describes, `where` in messages; missing parts are the identity.

    Raises:
        DataError: if a number is invalid.
    """
    parts = {name: None if transform is None else transform.findtext(name) for name in PARTS}
    rotation, translation, scale = (
        default if (text := parts[name]) is None else finite_array(text.split(), default.shape, f"{where}: {name}")
        for name, default in PARTS.items()
    )
    if not scale > 0:
        raise DataError(f"{where}: the scale is {scale:g}; it must be above zero")
    return Similarity(nearest_rotation(rotation, f"{where}: the rotation"), translation, float(scale))


PARTS = {"rotation": np.eye(3), "translation": np.zeros(3), "scale": np.ones(())}
"""Elements of a transform, and their values if they are missing."""


def _aligned(chunk: Element, file: Path, left_out: Counter[str]) -> Iterator[_Aligned]:
    """Yield the usable cameras of a chunk, and count the others."""
    lenses = {
        sensor.get("id"): _lens_or_reason(sensor, f"{file}: sensor {shown(sensor.get('label', sensor.get('id')))}")
        for sensor in chunk.iterfind("sensors/sensor")
    }
    whole = similarity_of(chunk.find("transform"), f"{file}: the transform of the chunk")
    own = {
        component.get("id", ""): similarity_of(found, f"{file}: the transform of component {component.get('id')}")
        for component in chunk.iterfind("components/component")
        if (found := component.find("transform")) is not None
    }
    labels = Counter(camera.get("label", "") for _, camera in _listed(chunk))
    for group, camera in _listed(chunk):
        label, component = camera.get("label", ""), camera.get("component_id", "")
        lens = lenses.get(camera.get("sensor_id"), "without sensor")
        if reason := _reason(camera, lens):
            left_out[reason] += 1
            continue
        assert isinstance(lens, Lens)
        pose = _pose(camera, own.get(component, whole), f"{file}: camera {shown(label)}")
        name = relative_name(f"{group}/{label}" if labels[label] > 1 and group else label)
        yield _Aligned(PosedCamera(name, pose, for_size_of(lens)), component)


def _listed(chunk: Element) -> Iterator[tuple[str, Element]]:
    """Yield the cameras of a chunk with the label of their group, "" for none."""
    for element in chunk.iterfind("cameras/*"):
        if element.tag == "camera":
            yield "", element
        elif element.tag == "group":
            yield from ((element.get("label", ""), camera) for camera in element.iterfind("camera"))


def _lens_or_reason(sensor: Element, where: str) -> Lens | str:
    """Return the lens of a sensor, or why its cameras cannot be used."""
    try:
        return lens_of(sensor, where)
    except UnsupportedSensor as reason:
        return str(reason)


def _reason(camera: Element, lens: Lens | str) -> str:
    """Return why a camera cannot be used; "" if it can."""
    if camera.get("enabled") in ("false", "0"):
        return "disabled"
    if not (camera.findtext("transform") or "").strip():
        return "in a rig without transforms" if camera.get("master_id") else "not aligned"
    return lens if isinstance(lens, str) else ""


def _pose(camera: Element, world: Similarity, where: str) -> np.ndarray:
    matrix = finite_array((camera.findtext("transform") or "").split(), (4, 4), f"{where}: its transform")
    rotation = nearest_rotation(matrix[:3, :3], f"{where}: its rotation")
    position = world.translation + world.scale * (world.rotation @ matrix[:3, 3])
    return camera_pose(world.rotation @ rotation, position)


def _is_geocentric(chunk: Element, aligned: list[_Aligned]) -> bool:
    """Return whether the world's frame is geocentric: not declared as local, and each component is near the surface."""
    if (chunk.findtext("reference") or "").strip().upper().startswith("LOCAL"):
        return False
    by_component: dict[str, list[PosedCamera]] = {}
    for each in aligned:
        by_component.setdefault(each.component, []).append(each.camera)
    # Not their common mean: a component that is not georeferenced is near the centre of the Earth.
    return bool(aligned) and all(is_near_surface(spread_of(cameras)[0]) for cameras in by_component.values())


def _east_north_up(cameras: list[PosedCamera]) -> np.ndarray:
    """Return the transform (3, 4) from geocentric coordinates to metres east, north and up of the cameras."""
    centre, _ = spread_of(cameras)
    rotation = east_north_up(centre)
    return np.concatenate([rotation, -(rotation @ centre)[:, None]], axis=1)
