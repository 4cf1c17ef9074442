"""Export of films: .gif and .webp by Pillow, .mp4 by ffmpeg, which imageio-ffmpeg provides where it is missing."""

import contextlib
import itertools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shapes import Shape
from ..drawing import view_up
from .extras import needed
from .sketch import Look, Sketch, View, extent
from .stretch import Stretch, stretches

if TYPE_CHECKING:
    from ..replay import Replay

RATE = 25  # pictures a second: 40 ms each, which GIF can store exactly, in hundredths of a second


def write(
    recording: "Replay",
    path: str,
    *,
    shape: Shape | None = None,
    size: Any = None,
    camera: Any = None,
    theme: Any = "dark",
    color: Any = None,
) -> list[str]:
    """Write a film in the scene's own time, RATE pictures a second; each picture shows the nearest frame."""
    look = Look.checked(size, camera, theme, recording.scenes[0].entry.arrays["position"].shape[1])
    kind = os.path.splitext(path)[1].lower()
    video = kind == ".mp4" and (shutil.which("ffmpeg") or needed("imageio_ffmpeg", path).get_ffmpeg_exe())
    if not len(recording.frames):
        raise ValueError(f"replay: {recording.path} has no frame, so there is nothing for {path}.")
    pictures = _pictures(recording, stretches(recording, color=color), shape, look)
    first = next(pictures)
    if not video:
        first.save(path, save_all=True, append_images=pictures, duration=1000 // RATE, loop=0)
        return [path]
    size = "x".join(map(str, first.size))
    words = [video, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(RATE), "-i", "-"]
    with tempfile.TemporaryFile() as said:
        out = os.path.abspath(path)  # ffmpeg would take "-a.mp4" for an option, and "10:00.mp4" for a protocol
        process = subprocess.Popen([*words, "-pix_fmt", "yuv420p", out], stdin=subprocess.PIPE, stderr=said)
        with process, contextlib.suppress(BrokenPipeError):  # if ffmpeg has ended, its output says why
            assert process.stdin
            for picture in itertools.chain([first], pictures):
                process.stdin.write(picture.tobytes())
        said.seek(0)
        if process.returncode:
            raise RuntimeError(f"replay: ffmpeg did not write {path}: {said.read().decode(errors='replace').strip()}")
    return [path]


def _pictures(recording: "Replay", found: list[Stretch], shape: Shape | None, look: Look) -> Iterator[Any]:
    """Yield one picture after the other, all from the same point of view."""
    times = recording.times
    moments = np.arange(times[0], times[-1] + 0.5 / RATE, 1 / RATE)
    after = np.clip(np.searchsorted(times, moments), 1, max(1, len(times) - 1))
    before = after - 1
    nearest = before if len(times) == 1 else np.where(moments - times[before] <= times[after] - moments, before, after)
    wanted = recording.frames[nearest].tolist()
    ends = [extent(s.parts, [x for _, _, x in s]) for s in found]
    low, high = (pick([e[k] for e in ends], axis=0) for k, pick in enumerate((np.min, np.max)))
    if not np.isfinite([low, high]).all():
        raise ValueError(f"replay: {recording.path} has no particles, or positions that are not finite, so there is no picture.")
    view = View(low, high, view_up(found[0].parts, recording.overlays.y_down), look)
    for stretch in found:
        here = set(stretch.frames.tolist())
        yield from _stretch(stretch, shape, [k for k in wanted if k in here], view, (low, high))


def _stretch(stretch: Stretch, shape: Shape | None, wanted: list[int], view: View, ends: tuple) -> Iterator[Any]:
    """Yield the pictures of one stretch, with walls at their places in each frame."""
    geometries = dict(zip(stretch.frames.tolist(), stretch.geometries(shape), strict=True))
    sketch = Sketch(stretch.parts, next(iter(geometries.values())), view, ends)
    turn = stretch.knobs_at()
    for frame in wanted:
        turn(frame)
        yield sketch.frame(stretch.recording.position(frame), geometries[frame])
