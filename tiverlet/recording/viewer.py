"""The rerun viewer, from the command line: a window, a page for the browser, or a picture without either."""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

import numpy as np

from .layout import SCENE_VIEW

LOCAL = "127.0.0.1"
NUMBER = re.compile(r"%0?\d*d")  # in a name; any other % is itself
PATIENCE = 40.0  # [s] until a picture has to be there
# rerun sends statistics home unless told otherwise; this is how it is told (no connection, no file), and not to chat.
QUIET = {"CI": "true", "RUST_LOG": "error"}


def _start(folder: str, *words: str, **options) -> subprocess.Popen:
    """rerun, on this machine only. `python -m rerun` is a wrapper, so it gets a group of its own, to end both.

    folder: for what it leaves behind.
    """
    command = [sys.executable, "-m", "rerun", "--bind", LOCAL, *words]
    return subprocess.Popen(command, env={**os.environ, **QUIET, "TMPDIR": folder}, start_new_session=True, **options)


def _folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="tiverlet-", ignore_cleanup_errors=True)


def _wait(process: subprocess.Popen) -> int:
    try:
        return process.wait()
    except KeyboardInterrupt:
        return 0
    finally:
        _end(process)


def _end(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    process.wait()


def show(path: str) -> int:
    """Open the viewer's window, and wait until it is closed; returns its exit status."""
    with _folder() as folder:
        return _wait(_start(folder, "--port", str(_free_port()), path))


def serve(path: str, port: int) -> int:
    """Serve a recording to browsers on this machine, until interrupted."""
    data = _free_port()
    print(f"http://{LOCAL}:{port}/?url=rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{data}%2Fproxy   (Ctrl-C ends it)", flush=True)
    with _folder() as folder:
        return _wait(_start(folder, "--serve-web", "--port", str(data), "--web-viewer-port", str(port), path))


def picture(path: str, png: str, frames: list[int] | None = None, scene: bool = False) -> list[str]:
    """Save pictures of frames (None: the last) without a window; returns their paths. `png` with several frames: one %d in it.

    scene: without curves and text. Needs a Vulkan driver; software will do (Debian: apt-get install mesa-vulkan-drivers). Raises
    RuntimeError where there is none, and ValueError for a frame that the file does not have.
    """
    from .replay import replay

    there = replay(path).frames
    frames = [int(k) for k in there[-1:]] if frames is None else frames
    if wrong := [k for k in frames if k not in there]:
        near = f"; the nearest is {there[np.argmin(np.abs(there - wrong[0]))]}" if len(there) else ""
        raise ValueError(f"{path} has no frame {wrong[0]}{near}.")
    out = [_name(png, k) for k in frames]
    if len(set(out)) < len(set(frames)):
        raise ValueError(f"{len(frames)} frames need a name with %d in it, such as frame_%d.png.")
    if missing := [name for name in out if not os.path.isdir(os.path.dirname(name))]:
        raise ValueError(f"The folder of {missing[0]} does not exist.")
    port = _free_port()
    with tempfile.TemporaryFile() as said, _folder() as folder:
        words = ("--headless", "--hide-welcome-screen", "--port", str(port), os.path.abspath(path))
        process = _start(folder, *words, stdout=said, stderr=said)
        try:
            for frame, name in zip(frames, out, strict=True):
                _settled(process, port, frame, name, str(SCENE_VIEW) if scene else None)
        except TimeoutError as e:
            said.seek(0)
            reasons = [line for line in said.read().decode(errors="replace").splitlines() if "adapter" in line]
            raise RuntimeError(
                f"rerun's viewer made no picture: {[*reasons, str(e)][0]}. It needs a Vulkan driver; one in software is "
                "enough (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)."
            ) from None
        finally:
            _end(process)
    return out


def _name(png: str, frame: int) -> str:
    return os.path.abspath(NUMBER.sub(lambda found: found.group() % frame, png))


def _settled(process: subprocess.Popen, port: int, frame: int, name: str, view: str | None) -> None:
    """Save a picture once two in a row are the same: by then everything is loaded and drawn."""
    from rerun.experimental import ViewerClient

    viewer, last, end = None, None, time.monotonic() + PATIENCE
    with _folder() as folder:
        shot = os.path.join(folder, "shot.png")
        while time.monotonic() < end and process.poll() is None:
            time.sleep(0.5)
            try:
                viewer = viewer or ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
                viewer.set_time("frame", sequence=frame, play_state="paused")
                viewer.save_screenshot(shot, view_id=view)
            except (RuntimeError, OSError):  # not up yet, or not loaded
                continue
            pixels = pixels_of(shot)
            if last is not None and pixels.shape == last.shape and (pixels == last).all() and pixels.std() > 1:
                shutil.copyfile(shot, name)
                return
            last = pixels
    raise TimeoutError("it did not start" if process.poll() is not None else f"nothing to be seen after {PATIENCE:.0f} s")


def pixels_of(png: str) -> np.ndarray:
    """The colours of a picture, (rows, columns, 3)."""
    from PIL import Image

    with Image.open(png) as image:
        return np.asarray(image.convert("RGB"))


def _free_port() -> int:
    with socket.socket() as s:
        s.bind((LOCAL, 0))
        return s.getsockname()[1]
