"""Shows a recording in rerun's viewer while it is made."""

import atexit
import socket
import subprocess
import tempfile
import threading
import time
import webbrowser
from typing import Any

from . import viewer

PATIENCE = 30.0  # [s] longest wait for a viewer to start
PLACES = (True, "web")
_scratch: list[tempfile.TemporaryDirectory] = []  # folders of launched viewers, removed when this process ends


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
    port, scratch = viewer.free_port(), viewer.scratch()
    _scratch.append(scratch)
    words = ["--port", str(port)]
    if live == "web":
        page, here = viewer.free_port(), viewer.free_port()
        words = ["--serve-web", *words, "--web-viewer-port", str(page)]
    process = viewer.launch(scratch.name, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if live == "web":
        pages = viewer.Pages((viewer.LOCAL, here), page, port)
        threading.Thread(target=pages.serve_forever, daemon=True).start()
        atexit.register(viewer.stop, process)  # the user can close a window, but not a server
        url = viewer.url_of(here, port)
        print(f"Recorder: watch it at {url}", flush=True)
        webbrowser.open(url)
    _wait_for_port(process, port)
    return f"rerun+http://{viewer.LOCAL}:{port}/proxy"


def _wait_for_port(process: subprocess.Popen, port: int) -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as s:
            if s.connect_ex((viewer.LOCAL, port)) == 0:
                return
        time.sleep(0.05)
    viewer.stop(process)
    raise RuntimeError(
        "Recorder: rerun's viewer has not started. A window needs a display and a graphics driver; without them use "
        'live="web", or record first and look later.'
    )


def below_the_cell(stream: Any) -> None:
    """Show a rerun stream below the cell of a notebook, from now on.

    Raises ImportError if rerun's part for notebooks is missing.
    """
    import rerun.notebook

    if not rerun.notebook.HAS_NOTEBOOK:
        raise ImportError("live=\"notebook\" needs rerun's part for notebooks: pip install 'tiverlet[notebook]'.")
    rerun.notebook.Viewer(recording=stream).display()
