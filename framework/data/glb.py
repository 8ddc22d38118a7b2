"""GLB files: one mesh or set of points of glTF 2.0 in a binary file.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html specifies the format. In glTF, y is up, colours of vertices
are linear light, and places on an image are measured from its upper left corner.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfloom.base.errors import ConfigError

MAX_BYTES = 2**32 - 1
"""Maximum size of a GLB file: the header states it in 32 bits."""
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 2: "VEC2"}
"""Names of shapes, by the number of values."""
COMPONENTS = {"float32": 5126, "uint16": 5123, "uint32": 5125}
"""Numbers of the types in glTF."""
ATTRIBUTES, INDICES = 34962, 34963
"""Numbers of the uses of a part of the buffer in glTF."""


def glb_bytes(
    name: str,
    attributes: Mapping[str, np.ndarray],
    primitive: Mapping[str, Any],
    content: Mapping[str, Any],
    indices: np.ndarray | None = None,
    image: bytes | None = None,
) -> bytes:
    """Return the content of a GLB file with one primitive.

    Args:
        name: name of the node.
        attributes: (N, C) values by their names in glTF, float32, or uint16 from 0 to 65535 for numbers from 0 to 1; a
            row has a multiple of four bytes, N is at least 1, and POSITION is one of them.
        primitive: other properties of the primitive, such as its mode.
        content: other parts of the JSON, such as materials.
        indices: (F, 3) uint32 rows of the attributes that are corners of a triangle; None if rows are used in a row.
        image: a PNG file, which becomes image 0.

    Raises:
        ConfigError: if the file would be larger than 4 GiB.
    """
    arrays = list(attributes.values())
    accessors = [_accessor(number, values) for number, values in enumerate(arrays)]
    positions = attributes["POSITION"]
    accessors[list(attributes).index("POSITION")] |= {
        "min": positions.min(0).tolist(),
        "max": positions.max(0).tolist(),
    }
    whole: dict[str, Any] = {"attributes": {key: number for number, key in enumerate(attributes)}, **primitive}
    uses = [{"target": ATTRIBUTES} for _ in arrays]
    if indices is not None:
        whole["indices"] = len(arrays)
        accessors.append(_accessor(len(arrays), indices.reshape(-1, 1)))
        arrays.append(indices)
        uses.append({"target": INDICES})
    images: dict[str, Any] = {}
    if image is not None:
        images = {"images": [{"bufferView": len(arrays), "mimeType": "image/png"}]}
        arrays.append(np.frombuffer(image, np.uint8))
        uses.append({})
    views, end = list[dict[str, Any]](), 0
    for values, use in zip(arrays, uses, strict=True):
        views.append({"buffer": 0, "byteOffset": end, "byteLength": values.nbytes, **use})
        end += values.nbytes + -values.nbytes % 4
    described = {
        "asset": {"version": "2.0", "generator": "Nerfloom"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"primitives": [whole]}],
        "buffers": [{"byteLength": end}],
        "bufferViews": views,
        "accessors": accessors,
        **images,
        **content,
    }
    return _joined(described, arrays, end)


def _accessor(view: int, values: np.ndarray) -> dict[str, Any]:
    kind = values.dtype.name
    found = {
        "bufferView": view,
        "count": len(values),
        "type": TYPES[values.shape[1]],
        "componentType": COMPONENTS[kind],
    }
    return {**found, "normalized": True} if kind == "uint16" else found


def _joined(described: dict[str, Any], arrays: list[np.ndarray], size: int) -> bytes:
    """Return header, JSON and binary chunk (section 4.4), each a multiple of four bytes."""
    text = json.dumps(described, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + size
    if total > MAX_BYTES:
        raise ConfigError(f"a glTF file holds 4 GiB, and this one needs {total / 2**30:.1f}: write a PLY file")
    parts = [struct.pack("<4sII", b"glTF", 2, total), struct.pack("<I4s", len(text), b"JSON"), text]
    parts += [struct.pack("<I4s", size, b"BIN\0")]
    for values in arrays:
        parts += [values.tobytes(), bytes(-values.nbytes % 4)]
    return b"".join(parts)
