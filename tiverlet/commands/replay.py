"""Open a recording in the viewer, verify it by computing it again, save a picture, or export it for other programs."""

import argparse
import os
import runpy
from typing import Any

from ..device.language import is_kernel_function
from .scripts import as_script, color, port

ABOUT = "view, verify, picture or export a recording"


LOOK = ("size", "camera", "theme", "color")
STATUS = {"intact": 0, "changed": 1, "incomplete": 3}  # 2: unreadable


def add(parser: argparse.ArgumentParser) -> None:
    """Add the file, and options for each action."""
    parser.add_argument("file", help="an .rrd file that a Recorder has written")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--verify", action="store_true", help="compute all again and compare; exit status 1: changed, 3: incomplete"
    )
    what.add_argument("--web", action="store_true", help="serve the viewer to browsers, on 127.0.0.1 only")
    what.add_argument("--png", metavar="OUT.png", help="save a picture, without a window; needs a Vulkan driver, in software too")
    what.add_argument(
        "--export", metavar="KIND",
        help="write for other programs, beside the file or to a name with this ending: npz (arrays, curves), csv, xyz (OVITO); "
        "glb, gltf (an animated mesh, for Blender), obj (a file for each frame), pvd (ParaView), usd; gif, webp, mp4 (a film)",
    )  # fmt: skip
    parser.add_argument("--shape", metavar="BODY.obj", help="of --export: take its faces, quads and texture coordinates")
    parser.add_argument(
        "--motion", action="store_true", help="of --export: velocities, spins and orientations too; computes again"
    )
    parser.add_argument("--size", type=size, metavar="WxH", help="of --export, of films: pixels, or the width alone")
    parser.add_argument("--camera", type=angles, metavar="A,B", help="of --export, of 3D films: angles to the right and up [rad]")
    parser.add_argument("--theme", help="of --export, of films: dark or light")
    parser.add_argument(
        "--color", type=color, metavar="NAME[,LEAST,MOST]", help="of --export: by a quantity such as speed; default as recorded"
    )
    parser.add_argument("--frame", type=int, action="append", help="of --png; several with a %%d in the name; default the last")
    parser.add_argument("--scene", action="store_true", help="of --png: the scene alone, without curves and text")
    parser.add_argument("--port", type=port, default=9090, help="of --web; default 9090")
    parser.add_argument("--given", metavar="SCRIPT.py", help="where the user's own functions in the scene are")


def size(text: str) -> int | tuple[int, int]:
    """Return the size of a film, such as 1280x720 or 1280."""
    wide, _, tall = text.partition("x")
    return (int(wide), int(tall)) if tall else int(wide)


def angles(text: str) -> tuple[float, ...]:
    """Return the angles of a camera, such as 0.5,0.3 [rad]."""
    return tuple(map(float, text.split(",")))


def main(args: argparse.Namespace) -> int:
    """Run the chosen action; return the exit status."""
    from ..recording import replay
    from ..recording.journal import Changed
    from ..shapes import load

    try:
        recording = replay(args.file)
    except Changed as e:
        if not args.verify:
            raise
        print(e)
        return STATUS["changed"]
    print(recording.text)
    if args.given:
        recording = replay(args.file, functions(args.given, recording.scene["needs"]))
    if args.verify:
        verdict = recording.verify()
        print(verdict)
        return STATUS[verdict.kind]
    if args.export:
        out = args.export if "." in args.export else f"{os.path.splitext(args.file)[0]}.{args.export}"
        shape, look = load(args.shape) if args.shape else None, {name: vars(args)[name] for name in LOOK}
        written = recording.export(out, shape, motion=args.motion, **look)
        more = f" and {len(written) - 1} more" if len(written) > 1 else ""
        print(f"{written[0]}{more}: {sum(map(os.path.getsize, written))} bytes")
        return 0
    from ..recording import viewer

    if args.png:
        for out in viewer.picture(args.file, args.png, args.frame, args.scene):
            print(out)
        return 0
    if args.web:
        return viewer.serve(args.file, args.port)
    status = viewer.show(args.file)
    if status:
        print("The viewer needs a display and a graphics driver; --web and --png do without a display.")
    return status


def functions(script: str, names: dict[str, str]) -> dict[str, Any]:
    """Return the functions in a script that have one of these names.

    The script runs up to its `if __name__ == "__main__":`. Only functions for kernels are accepted: a recording must not choose
    other objects of a script.
    """
    from ..recording.scene import plain

    with as_script(script):
        found = runpy.run_path(script, run_name="given")
    out = {name: found[name.partition(" #")[0]] for name in names if name.partition(" #")[0] in found}
    for name, thing in out.items():
        if not is_kernel_function(thing):
            raise ValueError(
                f"--given {script}: {plain(name)} is a {type(thing).__name__}, but only functions with @ti.func are taken from "
                "a script. Give others in Python: tv.replay(path, given=[...])."
            )
    return out
