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
# Each picture: its width, and the demos in it with the frame to show, in rows.
PICTURES = {
    "article": (1200, [[("article", 290)]]),
    "hourglass": (900, [[("hourglass", 200)]]),
    "net": (1020, [[("net", 26)]]),
    "polygons": (800, [[("polygons", 400)]]),
    "bodies": (1200, [[("soft", 60), ("cloth", 150)], [("ragdoll", 150), ("machine", 200)]]),
}
MARGIN = 12  # pixels of background that are left around a scene


def scene(demo: str, frame: int, folder: str) -> Image.Image:
    """One frame of one demo, without the empty background around it."""
    out, png = f"{folder}/{demo}.rrd", f"{folder}/{demo}.png"
    with run.recording(out):
        run.execute(run.find(demo), [])
    viewer.picture(out, png, [frame], scene=True)
    pixels = viewer.pixels_of(png)
    drawn = (np.abs(pixels.astype(int) - pixels[-1, -1]) > 40).any(axis=2)
    drawn[: len(drawn) // 20] = False  # the title of the view
    (top, bottom), (left, right) = ((int(v.min()), int(v.max())) for v in np.nonzero(drawn))
    box = (left - MARGIN, max(top - MARGIN, len(drawn) // 20), right + MARGIN, bottom + MARGIN)
    return Image.fromarray(pixels).crop(box)


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
            out = compose([[scene(demo, frame, folder) for demo, frame in row] for row in rows], width)
            out.quantize(128).save(HERE / f"{name}.png", optimize=True)
            print(HERE / f"{name}.png", out.size)


if __name__ == "__main__":
    main(sys.argv[1:])
