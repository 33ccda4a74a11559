"""A local web server that supports range requests, counts bytes and can interrupt responses.

Queries are ignored, as a server of presigned addresses does once it has checked them.
"""

import re
from base64 import b64decode
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread


@dataclass(slots=True)
class Served:
    """Content and log of the server.

    Attributes:
        base: URL of the server.
        files: Contents by name.
        sent: Number of bytes sent in bodies.
        gets: ``Range`` headers of the GET requests.
        failing: Number of further GET requests to interrupt midway.
        requests: Method and path of every request.
        password: Secret that a request must contain, in its query or as basic authorization.
        stalling: ``headers`` to stop before the response, ``body`` to stop halfway through it.
    """

    base: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    sent: int = 0
    gets: list[str] = field(default_factory=list)
    failing: int = 0
    requests: list[str] = field(default_factory=list)
    password: str = ""
    stalling: str = ""


@contextmanager
def serving() -> Iterator[Served]:
    """Serve ``Served.files`` for the duration of the ``with`` block."""
    served = Served()
    ended = Event()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self._answer(with_body=False)

        def do_GET(self) -> None:
            self._answer(with_body=True)

        def log_message(self, *args: object) -> None:
            """Log nothing; tests examine ``Served``."""

        def _answer(self, *, with_body: bool) -> None:
            path, _, query = self.path.partition("?")
            served.requests.append(f"{self.command} {path}")
            if served.stalling == "headers":
                ended.wait(60.0)
                return
            login = b64decode(self.headers.get("Authorization", "").removeprefix("Basic "))
            may_read = served.password in query or served.password in login.decode()
            content = served.files.get(path.lstrip("/"))
            if content is None or not may_read:
                self.send_response(404 if may_read else 403)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            requested = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            begin, end = (
                (int(requested[1]), int(requested[2]) + 1) if requested else (0, len(content))
            )
            body = content[begin:end]
            self.send_response(206 if requested else 200)
            self.send_header("Accept-Ranges", "bytes")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("ETag", f'"{hash(content):x}"')
            if requested:
                content_range = f"bytes {begin}-{begin + len(body) - 1}/{len(content)}"
                self.send_header("Content-Range", content_range)
            self.end_headers()
            if not with_body:
                return
            served.gets.append(self.headers.get("Range", "all"))
            if served.stalling == "body":
                self.wfile.write(body[: len(body) // 2])
                self.wfile.flush()
                ended.wait(60.0)
                return
            if served.failing:
                served.failing -= 1
                self.wfile.write(body[: len(body) // 2])
                self.close_connection = True
                return
            # Before the last byte, after which a client that asks for the count may have gone on.
            served.sent += len(body)
            self.wfile.write(body)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    served.base = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield served
    finally:
        ended.set()
        server.shutdown()
        server.server_close()
        thread.join()
