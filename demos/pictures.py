"""The pictures of the gallery: runs the demos, and takes the scene out of a frame of each recording.

    python demos/pictures.py [name ...]

Needs a Vulkan driver; one in software will do (apt-get install mesa-vulkan-drivers).
"""

import pathlib
import sys
import tempfile

import numpy as np
from PIL import Image

from tiverlet.commands import run
from tiverlet.recording import viewer

HERE = pathlib.Path(__file__).parent / "pictures"
# For each demo: the frame to show, and the part of the scene: left, top, right and bottom, as shares of its size.
ALL = (0.0, 0.0, 1.0, 1.0)
PICTURES = {
    "article": (290, ALL),
    "bead": (45, ALL),
    "billiards": (45, (0.05, 0.35, 0.8, 1.0)),
    "buggy": (205, (0.3, 0.0, 0.8, 1.0)),
    "cloth": (150, (0.22, 0.22, 0.82, 0.9)),
    "cradle": (24, ALL),
    "drum": (400, ALL),
    "fit": (68, ALL),
    "flag": (125, (0.1, 0.0, 0.75, 0.85)),
    "galaxy": (400, ALL),
    "hello": (45, (0.22, 0.24, 0.62, 0.56)),
    "hourglass": (90, (0.0, 0.22, 1.0, 0.9)),
    "jelly": (90, ALL),
    "machine": (130, ALL),
    "net": (26, (0.2, 0.28, 0.8, 0.78)),
    "pendulums": (90, ALL),
    "polygons": (400, ALL),
    "ragdoll": (80, (0.0, 0.2, 1.0, 1.0)),
    "silo": (330, (0.05, 0.0, 0.95, 1.0)),
    "soft": (60, (0.0, 0.4, 1.0, 1.0)),
    "stairs": (42, (0.0, 0.1, 1.0, 1.0)),
    "tidy": (300, (0.0, 0.42, 1.0, 1.0)),
    "wrecking": (90, ALL),
}
WIDTH, HEIGHT, COLORS = 800, 480, 256  # the largest values for a picture
MARGIN = 12  # pixels of background kept around a scene


def scene(folder: str, demo: str, frame: int, part: tuple[float, float, float, float]) -> Image.Image:
    """Return a part of one frame of one demo, without the empty background around the scene."""
    out, png = f"{folder}/{demo}.rrd", f"{folder}/{demo}.png"
    with run.recording(out):
        status = run.execute(run.find(demo), [])
    if status:
        raise SystemExit(f"demos/{demo}.py ended with {status}: its check fails, and there is no picture of it.")
    viewer.picture(out, png, [frame], scene=True)
    pixels = viewer.pixels_of(png)
    drawn = (np.abs(pixels.astype(int) - pixels[-1, -1]) > 40).any(axis=2)
    (top, bottom), (left, right) = ((max(int(v.min()) - MARGIN, 0), int(v.max()) + MARGIN) for v in np.nonzero(drawn))
    image = Image.fromarray(pixels).crop((left, top, right, bottom))
    left, top, right, bottom = (round(share * size) for share, size in zip(part, image.size * 2, strict=True))
    return image.crop((left, top, right, bottom))


def main(names: list[str]) -> None:
    """Make the pictures of the named demos, or of all."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names or PICTURES:
            image = scene(folder, name, *PICTURES[name])
            image.thumbnail((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
            image.quantize(COLORS).save(HERE / f"{name}.png", optimize=True)
            print(HERE / f"{name}.png", image.size, (HERE / f"{name}.png").stat().st_size)


if __name__ == "__main__":
    main(sys.argv[1:])
