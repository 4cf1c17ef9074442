"""The pictures of the README: runs the demos, and takes the scene out of frames of their recordings.

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

HERE = pathlib.Path(__file__).parent
# Each picture: its width, and in rows the demos in it, with the frame to show and from where to where of the scene's height.
PICTURES = {
    "article": (1200, [[("article", 290, 0.0, 1.0)]]),
    "hourglass": (900, [[("hourglass", 90, 0.22, 0.9)]]),
    "net": (1020, [[("net", 26, 0.0, 1.0)]]),
    "polygons": (800, [[("polygons", 400, 0.0, 1.0)]]),
    "bodies": (
        1200,
        [[("soft", 60, 0.4, 1.0), ("cloth", 150, 0.0, 1.0)], [("ragdoll", 150, 0.3, 1.0), ("machine", 180, 0.0, 1.0)]],
    ),
    "rails": (1200, [[("bead", 45, 0.0, 1.0), ("tidy", 300, 0.42, 1.0)]]),
}
MARGIN = 12  # pixels of background that are left around a scene


def scene(folder: str, demo: str, frame: int, begin: float, end: float) -> Image.Image:
    """One frame of one demo, without the empty background around it, from one part of its height to another."""
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
    return image.crop((0, round(begin * image.height), image.width, round(end * image.height)))


def compose(rows: list[list[Image.Image]], width: int) -> Image.Image:
    """Scenes in rows of equal height, each as wide as the picture."""
    made = []
    for row in rows:
        height = width / sum(image.width / image.height for image in row)
        sizes = [(round(height * image.width / image.height), round(height)) for image in row]
        made.append([image.resize(size, Image.Resampling.LANCZOS) for image, size in zip(row, sizes, strict=True)])
    out = Image.new("RGB", (width, sum(row[0].height for row in made)), (18, 20, 26))
    y = 0
    for row in made:
        x = 0
        for image in row:
            out.paste(image, (x, y))
            x += image.width
        y += row[0].height
    return out


def main(names: list[str]) -> None:
    """Make the pictures of these names, or all."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names or PICTURES:
            width, rows = PICTURES[name]
            out = compose([[scene(folder, *what) for what in row] for row in rows], width)
            out.quantize(128).save(HERE / f"{name}.png", optimize=True)
            print(HERE / f"{name}.png", out.size)


if __name__ == "__main__":
    main(sys.argv[1:])
