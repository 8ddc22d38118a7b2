"""Meshes in GLB files.

Colours of photographs contain the light of their scene, so coloured meshes have KHR_materials_unlit: programs show the
colours as they are. Programs without it light a matt surface. Colours of vertices are linear light, as glTF demands, in
float32, because 8 bits of linear light are too coarse in the dark. Images are sRGB. They are read without smaller
copies (mipmaps), because these would mix the colours of triangles.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.data.glb import glb_bytes
from nerfloom.export.mesh import Mesh
from nerfloom.kernels.color import to_linear

UNLIT = "KHR_materials_unlit"
TRIANGLES, LINEAR, CLAMP_TO_EDGE = 4, 9729, 33071
"""Numbers of the kind of primitive, and of the reading of an image, in glTF."""


def encoded_mesh(mesh: Mesh) -> bytes:
    """Return the content of a GLB file.

    Args:
        mesh: a mesh on the CPU with y up, and with at least one face. With a texture, it has no colours of vertices in
            the file, and separate corners for each face, because each face has its own place in the texture.

    Raises:
        ConfigError: if the file would be larger than 4 GiB.
    """
    texture = mesh.texture
    rows = torch.arange(len(mesh.vertices)) if texture is None else mesh.faces.reshape(-1)
    attributes = {"POSITION": _float(mesh.vertices[rows])}
    if mesh.normals is not None:
        attributes["NORMAL"] = _float(mesh.normals[rows])
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material: dict[str, Any] = {"pbrMetallicRoughness": surface}
    content: dict[str, Any] = {"materials": [material]}
    if texture is not None:
        places = texture.coordinates.reshape(-1, 2)
        attributes["TEXCOORD_0"] = _float(torch.stack([places[:, 0], 1 - places[:, 1]], -1))
        surface["baseColorTexture"] = {"index": 0}
        reading = {"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
        content |= {"textures": [{"source": 0, "sampler": 0}], "samplers": [reading]}
    elif mesh.colors is not None:
        attributes["COLOR_0"] = _float(to_linear(mesh.colors.double().clamp(0, 1)))
    if texture is not None or mesh.colors is not None:
        material["extensions"] = {UNLIT: {}}
        content["extensionsUsed"] = [UNLIT]
    return glb_bytes(
        "mesh",
        attributes,
        {"mode": TRIANGLES, "material": 0},
        content,
        mesh.faces.numpy().astype(np.uint32) if texture is None else None,
        None if texture is None else _png(texture.image),
    )


def _float(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.float().numpy())


def _png(image: Tensor) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image.numpy()).save(stream, format="PNG")
    return stream.getvalue()
