"""A browser's side of viser's protocol, without a browser: messages with zstandard and msgpack over a websocket."""

import io
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count
from typing import Any

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import ClientConnection, connect

LOOK: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -4.0),
    "fov": 0.7,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 60,
    "image_width": 80,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, -1.0, 0.0),
}
"""A camera 4 in front of the origin, x right, y down, z forward."""


class Client:
    """A connection to the viewer.

    Args:
        rests: whether the viewer has drawn all that it was asked for.
    """

    def __init__(self, port: int, rests: Callable[[], bool], origin: Any = None) -> None:
        protocols: Any = [f"viser-v{viser.__version__}"]
        address, self._open = f"ws://127.0.0.1:{port}", ExitStack()
        self.socket: ClientConnection = self._open.enter_context(
            connect(address, subprotocols=protocols, origin=origin, max_size=2**27, compression=None)
        )
        self.controls: dict[str, tuple[str, Any]] = {}
        self.rests = rests

    def send(self, message: Any) -> None:
        self.socket.send(msgspec.msgpack.encode(message))

    def look(self, **changes: Any) -> None:
        self.send({**LOOK, **changes})

    def set(self, label: str, value: Any) -> None:
        """Change a control by the text beside it."""
        uuid = self.controls[label][0]
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def messages(self, seconds: float) -> list[dict[str, Any]]:
        """Messages that the viewer sends in one parcel."""
        raw = self.socket.recv(timeout=seconds)
        assert isinstance(raw, bytes)
        length = int.from_bytes(raw[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + length]))
        offset, buffers = 16 + length, []
        for size in content["binaryBufferLengths"]:
            offset += -offset % 8
            buffers.append(raw[offset : offset + size])
            offset += size
        for message in content["messages"]:
            for name, value in message.items():
                if isinstance(value, dict) and "__binary_index" in value:
                    message[name] = buffers[value["__binary_index"]]
            label = (message.get("props") or {}).get("label") if isinstance(message.get("props"), dict) else None
            if isinstance(label, str) and "uuid" in message:
                self.controls[label] = (message["uuid"], message)
        return content["messages"]

    def message(self, kind: str, **values: Any) -> dict[str, Any]:
        """The next message of a kind that has some values."""
        for _ in count():
            for message in self.messages(30.0):
                if message["type"] == kind and all(message.get(name) == value for name, value in values.items()):
                    return message
        raise AssertionError

    def picture(self, seconds: float = 30.0) -> np.ndarray:
        """The next picture, (H, W, 3) uint8."""
        for _ in count():
            for message in self.messages(seconds):
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                    return np.asarray(Image.open(io.BytesIO(message["rgb_data"])))
        raise AssertionError

    def finished(self, seconds: float = 0.3) -> np.ndarray:
        """The last picture: nothing is left to draw, and no other comes for some time."""
        found = self.picture()
        for _ in range(200):
            rested = self.rests()
            try:
                found = self.picture(seconds)
            except TimeoutError:
                if rested:
                    return found
        raise AssertionError("the picture does not come to rest")

    def close(self) -> None:
        self._open.close()
