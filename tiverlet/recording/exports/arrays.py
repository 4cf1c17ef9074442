"""Export of arrays for numpy."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..quantities import is_name
from ..scene import plain
from .stretch import only

if TYPE_CHECKING:
    from ..replay import Replay


def write(recording: "Replay", path: str, *, motion: bool = False) -> list[str]:
    """Write positions, times, masses, radii, motion, curves and the user's quantities to an .npz file."""
    stretch = only(recording, path, "array", ".csv", motion)
    more: dict[str, Any] = {name: stretch.column(name) for name in ("mass", "radius")}
    for name, (frames, values) in (recording.curves | recording.quantities).items():
        if not is_name(name):  # the name becomes that of a file in the archive
            raise ValueError(f"replay: {recording.path} has a curve with the name {plain(name)!r}; see .verify().")
        more |= {f"{name} frame": frames, f"{name} value": values}
    both = [(x, moved) for (_, _, x), moved in zip(stretch, stretch.motion, strict=False)]
    x = np.array([x for x, _ in both])
    more |= {name: np.array([moved[name] for _, moved in both]) for name in both[0][1]}
    with open(path, "wb") as file:  # given a name, numpy would append its own ending to .NPZ
        np.savez_compressed(file, position=x, frame=stretch.frames, time=stretch.times, **more)
    return [path]
