"""A web server on the loopback address, whose connections can be made to break."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Server(ThreadingHTTPServer):
    """Serves files from memory and remembers what it was asked for."""

    files: dict[str, bytes]
    asked: list[tuple[str, str | None]]  # path and Range of every request
    breaks_after: list[int]  # bytes of the next answers after which the connection is cut
    knows_ranges: bool


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        wanted = self.headers.get("Range")
        self.server.asked.append((self.path, wanted))
        content = self.server.files.get(self.path)
        if content is None:
            self.send_error(404)
            return
        start = 0
        if wanted and self.server.knows_ranges:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= len(content):
                self.send_error(416)
                return
        self.send_response(206 if start else 200)
        rest = content[start:]
        self.send_header("Content-Length", str(len(rest)))
        self.end_headers()
        sent = self.server.breaks_after.pop(0) if self.server.breaks_after else len(rest)
        self.wfile.write(rest[:sent])

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@contextmanager
def serve(files: dict[str, bytes]) -> Iterator[tuple[Server, str]]:
    """Serve files by their paths while the block runs; return the server and its address."""
    server = Server(("127.0.0.1", 0), _Handler)
    server.files, server.asked, server.breaks_after, server.knows_ranges = files, [], [], True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server, f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
