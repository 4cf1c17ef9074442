"""The rerun viewer: a window, a page in the browser or below a cell, also while a recording is made, or a picture without any."""

import atexit
import contextlib
import http.server
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
import webbrowser
from collections.abc import Iterator
from typing import Any

import numpy as np

from .layout import SCENE_VIEW

LOCAL = "127.0.0.1"
NUMBER = re.compile(r"%0?\d*d")  # in a file name; any other % stands for itself
PATIENCE = 40.0  # [s] longest wait for a picture, or for a viewer to start
# These settings stop rerun from sending usage statistics (no connection, no file) and from printing messages.
QUIET = {"CI": "true", "RUST_LOG": "error"}
PLACES = (True, "web")  # of a live recording
_scratch: list[tempfile.TemporaryDirectory] = []  # folders of viewers of live recordings, removed when this process ends


def launch(folder: str, *words: str, **options) -> subprocess.Popen:
    """Start rerun, reachable from this machine only. folder: for its temporary files.

    `python -m rerun` is a wrapper, so it gets a process group of its own, by which both processes can be ended.
    """
    command = [sys.executable, "-m", "rerun", "--bind", LOCAL, *words]
    return subprocess.Popen(command, env={**os.environ, **QUIET, "TMPDIR": folder}, start_new_session=True, **options)


def scratch() -> tempfile.TemporaryDirectory:
    """Return a temporary folder for a viewer."""
    return tempfile.TemporaryDirectory(prefix="tiverlet-", ignore_cleanup_errors=True)


@contextlib.contextmanager
def _install_exit_signals() -> Iterator[None]:
    """Within this context, SIGTERM or a closing terminal raises SystemExit, so that processes started in it are ended, too."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number: int, frame: Any) -> None:
        """Raise SystemExit with the status of the signal, so that open resources are closed."""
        raise SystemExit(128 + number)

    before = [(number, signal.signal(number, leave)) for number in (signal.SIGTERM, signal.SIGHUP)]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def _wait(process: subprocess.Popen) -> int:
    try:
        return process.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        stop(process)


def stop(process: subprocess.Popen) -> None:
    """End a viewer that was launched, and its child processes."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5)


def show(path: str) -> int:
    """Open the viewer's window and wait until it is closed. Returns its exit status."""
    with _install_exit_signals(), scratch() as folder:
        return _wait(launch(folder, "--port", str(free_port()), path))


def serve(path: str, port: int) -> int:
    """Serve a recording to browsers on this machine, until interrupted."""
    data = free_port()
    with _install_exit_signals(), scratch() as folder, Pages(port, data) as pages:
        process = launch(folder, *pages.words, path)
        print(f"{pages.url}   (Ctrl-C ends it)", flush=True)
        return _wait(process)


def address(live: bool | str) -> str | None:
    """Return the address of the viewer for a live recording, and start one unless `live` is an address.

    Returns None for a notebook, whose viewer is part of the page. Raises ValueError for any other value, and RuntimeError if the
    viewer does not start.
    """
    if live == "notebook":
        return None
    if isinstance(live, str) and live.startswith("rerun+http"):
        return live
    if live not in PLACES:
        raise ValueError(
            f'Recorder: live = {live!r}, but it is True for a window, "web" for a page in the browser, "notebook" for one below '
            'the cell, or the address of a viewer that runs, such as "rerun+http://127.0.0.1:9876/proxy".'
        )
    port, folder = free_port(), scratch()
    _scratch.append(folder)
    pages = Pages(free_port(), port) if live == "web" else None
    words = pages.words if pages else ("--port", str(port))
    process = launch(folder.name, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if pages:
        atexit.register(stop, process)  # the user can close a window, but not a server
        print(f"Recorder: watch it at {pages.url}", flush=True)
        webbrowser.open(pages.url)
    _wait_for_port(process, port)
    return f"rerun+http://{LOCAL}:{port}/proxy"


def _wait_for_port(process: subprocess.Popen, port: int) -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as s:
            if s.connect_ex((LOCAL, port)) == 0:
                return
        time.sleep(0.05)
    stop(process)
    raise RuntimeError(
        "Recorder: rerun's viewer has not started. A window needs a display and a graphics driver; without them use "
        'live="web", or record first and look later.'
    )


def show_below_the_cell(stream: Any) -> None:
    """Show a rerun stream below the cell of a notebook, from now on.

    Raises ImportError if rerun's part for notebooks is missing.
    """
    import rerun.notebook

    if not rerun.notebook.HAS_NOTEBOOK:
        raise ImportError("live=\"notebook\" needs rerun's part for notebooks: pip install 'tiverlet[notebook]'.")
    rerun.notebook.Viewer(recording=stream).display()


class Pages(http.server.ThreadingHTTPServer):
    """Serves, at a port, the pages that rerun makes when launched with `words`; they show the data from port `data`.

    rerun's page requests news, fonts and examples from other hosts. So it passes through here, with a header by which the browser
    blocks all hosts but this machine.
    """

    daemon_threads = True

    def __init__(self, port: int, data: int):
        super().__init__((LOCAL, port), _Page)
        page = free_port()
        self.words = ("--serve-web", "--port", str(data), "--web-viewer-port", str(page))
        self.url = f"http://{LOCAL}:{port}/?url=rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{data}%2Fproxy"
        self.source = f"http://{LOCAL}:{page}"
        here = "'self' data: blob:"
        self.policy = (
            f"default-src {here} 'unsafe-inline' 'unsafe-eval'; connect-src {here} http://{LOCAL}:{data}; "
            "form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
        )
        threading.Thread(target=self.serve_forever, daemon=True).start()


class _Page(http.server.BaseHTTPRequestHandler):
    server: Pages  # type: ignore[assignment]

    def do_GET(self) -> None:
        """Answer with one page."""
        name = (self.headers.get("Host") or "").rpartition(":")[0]
        if name not in (LOCAL, "localhost"):  # DNS rebinding: a foreign page whose host name resolves to this machine
            self.send_error(403)
            return
        try:
            with urllib.request.urlopen(self.server.source + self.path, timeout=PATIENCE) as answer:
                body, kind = answer.read(), answer.headers.get("Content-Type", "application/octet-stream")
        except OSError:
            self.send_error(502, "rerun does not answer (yet)")
            return
        self.send_response(200)
        for key, value in {
            "Content-Type": kind, "Content-Length": str(len(body)), "Content-Security-Policy": self.server.policy,
            "Referrer-Policy": "no-referrer",
        }.items():  # fmt: skip
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args) -> None:
        """Log nothing."""


def picture(path: str, png: str, frames: list[int] | None = None, scene: bool = False) -> list[str]:
    """Save pictures of frames (None: the last) without a window; return their paths.

    png: the name of the file; with several frames, it has one %d in it. scene: without curves and text. Needs a Vulkan driver;
    one in software is enough (Debian: apt-get install mesa-vulkan-drivers). Raises RuntimeError if there is none, and ValueError
    for a frame that the file does not have.
    """
    from .replay import replay

    there = replay(path).frames
    frames = [int(k) for k in there[-1:]] if frames is None else frames
    if wrong := [k for k in frames if k not in there]:
        near = f"; the nearest is {there[np.argmin(np.abs(there - wrong[0]))]}" if len(there) else ""
        raise ValueError(f"{path} has no frame {wrong[0]}{near}.")
    out = [os.path.abspath(named(png, k)) for k in frames]
    if len(set(out)) < len(set(frames)):
        raise ValueError(f"{len(frames)} frames need a name with %d in it, such as frame_%d.png.")
    if missing := [name for name in out if not os.path.isdir(os.path.dirname(name))]:
        raise ValueError(f"The folder of {missing[0]} does not exist.")
    port = free_port()
    with _install_exit_signals(), tempfile.TemporaryFile() as said, scratch() as folder:
        words = ("--headless", "--hide-welcome-screen", "--port", str(port), os.path.abspath(path))
        process = launch(folder, *words, stdout=said, stderr=said)
        try:
            for frame, name in zip(frames, out, strict=True):
                _save_when_steady(process, port, frame, name, str(SCENE_VIEW) if scene else None)
        except TimeoutError as e:
            said.seek(0)
            reasons = [line for line in said.read().decode(errors="replace").splitlines() if "adapter" in line]
            raise RuntimeError(
                f"rerun's viewer made no picture: {[*reasons, str(e)][0]}. It needs a Vulkan driver; one in software is "
                "enough (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)."
            ) from None
        finally:
            stop(process)
    return out


def named(path: str, frame: int) -> str:
    """Return a name with the number of a frame for %d."""
    return NUMBER.sub(lambda found: found.group() % frame, path)


def numbered(path: str, frame: int) -> str:
    """Return the name of a frame's file: its number replaces a %d, or precedes the ending with at least four digits."""
    base, kind = os.path.splitext(path)
    return named(path if NUMBER.search(path) else f"{base}_%04d{kind}", frame)


def _save_when_steady(process: subprocess.Popen, port: int, frame: int, name: str, view: str | None) -> None:
    """Save a picture once two successive ones are equal: by then everything is loaded and drawn."""
    from rerun.experimental import ViewerClient

    viewer, last, end = None, None, time.monotonic() + PATIENCE
    with scratch() as folder:
        shot = os.path.join(folder, "shot.png")
        while time.monotonic() < end and process.poll() is None:
            time.sleep(0.5)
            try:
                viewer = viewer or ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
                viewer.set_time("frame", sequence=frame, play_state="paused")
                viewer.save_screenshot(shot, view_id=view)
            except (RuntimeError, OSError):  # the viewer is not running yet, or the file not loaded
                continue
            pixels = pixels_of(shot)
            if last is not None and pixels.shape == last.shape and (pixels == last).all() and (pixels != pixels[0, 0]).any():
                shutil.copyfile(shot, name)
                return
            last = pixels
    raise TimeoutError("it did not start" if process.poll() is not None else f"nothing to be seen after {PATIENCE:.0f} s")


def pixels_of(png: str) -> np.ndarray:
    """Return the colours of a picture, (rows, columns, 3)."""
    from PIL import Image

    with Image.open(png) as image:
        return np.asarray(image.convert("RGB"))


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as s:
        s.bind((LOCAL, 0))
        return s.getsockname()[1]
