"""The server of the page and its connections: one port on this machine, which answers only requests with its token."""

import contextlib
import json
import pathlib
import queue
import secrets
import threading
import urllib.parse
from http import HTTPStatus
from typing import Any

LOCAL = "127.0.0.1"
NAMES = (LOCAL, "localhost")
AHEAD = 2  # most frames sent to a page that it has not shown yet
LARGEST = 4096  # most bytes of a message from a page
FILES = {"": ("page.html", "text/html"), "page.js": ("page.js", "text/javascript")}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self' ws:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'self' http://localhost:* http://127.0.0.1:*"
)


class Viewer:
    """One open page."""

    def __init__(self, connection: Any):
        self.connection = connection
        self.waiting = 0  # frames sent that the page has not shown yet
        self.known: dict[str, str] = {}  # the last message of each kind, see Parts
        self._outbox: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()

    def send(self, message: str | bytes) -> None:
        """Send a message to the page, if it is still connected. It does not wait for a page that does not read."""
        self._outbox.put(message)

    def deliver(self) -> None:
        """Pass messages to the connection, in a thread of its own, until leave() is called or the connection ends."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed, OSError):
            while (message := self._outbox.get()) is not None:
                self.connection.send(message)

    def leave(self) -> None:
        """End deliver()."""
        self._outbox.put(None)


class Server:
    """Serves the page at `url`. received: messages from pages, (viewer, message), in order of arrival.

    A request must contain the token, which is part of the address. It must name this machine as Host, which keeps out foreign
    pages whose host name resolves to this machine. A connection must also come from the page served here, by its Origin.
    """

    def __init__(self, port: int = 0):
        try:
            from websockets.sync.server import serve
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "play: a page in the browser needs the package websockets: pip install 'tiverlet[play]'."
            ) from None
        self.token = secrets.token_urlsafe(16)
        self.received: queue.Queue[tuple[Viewer, dict[str, Any]]] = queue.Queue()
        self._viewers: list[Viewer] = []
        self._lock = threading.Lock()
        self._server = serve(self._listen, LOCAL, port, process_request=self._answer, compression=None, max_size=LARGEST)
        self.port = self._server.socket.getsockname()[1]
        self.url = f"http://{LOCAL}:{self.port}/{self.token}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def viewers(self) -> list[Viewer]:
        """The open pages."""
        with self._lock:
            return list(self._viewers)

    def close(self) -> None:
        """End all connections."""
        self._server.shutdown()
        self._thread.join(5)

    def _answer(self, connection: Any, request: Any) -> Any:
        """Answer with a file of the page; return None to accept a connection."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        _, token, name = (urllib.parse.urlsplit(request.path).path + "//").split("/")[:3]
        if host.rpartition(":")[0] not in NAMES or not secrets.compare_digest(token.encode(), self.token.encode()):
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the address that tiverlet play has printed.\n")
        if name == "socket":
            wrong = origin != f"http://{host}"
            return connection.respond(HTTPStatus.FORBIDDEN, "Another page asks.\n") if wrong else None
        if name not in FILES:
            return connection.respond(HTTPStatus.NOT_FOUND, "There is no such file.\n")
        file, kind = FILES[name]
        response = connection.respond(HTTPStatus.OK, (pathlib.Path(__file__).parent / file).read_text(encoding="utf-8"))
        del response.headers["Content-Type"]
        headers = {"Content-Type": f"{kind}; charset=utf-8", "Content-Security-Policy": POLICY, "Cache-Control": "no-store"}
        response.headers.update({**headers, "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"})
        return response

    def _take(self, viewer: Viewer, text: str | bytes) -> None:
        """Process a message from a page."""
        try:
            message = json.loads(text)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            viewer.connection.close(1003, "an object is needed")
        elif message.get("do") == "shown":
            viewer.waiting = max(0, viewer.waiting - 1)
        else:
            self.received.put((viewer, message))

    def _listen(self, connection: Any) -> None:
        """Receive the messages of one page, in a thread of its own."""
        from websockets.exceptions import ConnectionClosed

        viewer = Viewer(connection)
        threading.Thread(target=viewer.deliver, daemon=True).start()
        with self._lock:
            self._viewers.append(viewer)
        self.received.put((viewer, {"do": "came"}))
        try:
            with contextlib.suppress(ConnectionClosed):
                for text in connection:
                    self._take(viewer, text)
        finally:
            viewer.leave()
            with self._lock:
                self._viewers.remove(viewer)
            self.received.put((viewer, {"do": "went"}))
