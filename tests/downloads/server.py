"""A server of files on the loopback, with the faults that real ones have."""

import hashlib
import http.server
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Served:
    """A file and how it is served; requests are recorded."""

    content: bytes
    etag: str | None = None
    """Sent with the file, and compared with If-Range; the content's sum if None."""
    breaks_after: list[int] = field(default_factory=list)
    """Numbers of bytes sent before the first answers are cut off, one for each."""
    status: list[int] = field(default_factory=list)
    """Statuses of the first answers, in place of the file."""
    headers: dict[str, str] = field(default_factory=dict)
    ranges: bool = True
    """Whether parts can be asked for."""
    asked: list[str] = field(default_factory=list)
    """Range of each request; empty for the whole file."""

    @property
    def tag(self) -> str:
        return f'"{hashlib.md5(self.content).hexdigest()}"' if self.etag is None else self.etag


class Handler(http.server.BaseHTTPRequestHandler):
    files: dict[str, Served]

    def do_GET(self) -> None:
        served = self.files.get(self.path.partition("?")[0])
        if served is None:
            self.send_error(404)
            return
        served.asked.append(self.headers.get("Range", ""))
        if served.status:
            self.send_error(served.status.pop(0))
            return
        start, total = 0, len(served.content)
        match = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        if match and served.ranges and self.headers.get("If-Range") in (None, served.tag):
            start = int(match[1])
        if start >= total > 0:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{total}")
            self.end_headers()
            return
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(total - start))
        if start:
            self.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        if served.tag:
            self.send_header("ETag", served.tag)
        for name, value in {"Content-Type": "application/zip", **served.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        end = start + served.breaks_after.pop(0) if served.breaks_after else total
        self.wfile.write(served.content[start:end])

    def log_message(self, *arguments: object) -> None:
        pass


@contextmanager
def serving(files: dict[str, Served]) -> Iterator[str]:
    """Serve `files` by path, until the end of the `with` block; yields the server's address."""
    handler = type("Files", (Handler,), {"files": files})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
