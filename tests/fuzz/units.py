"""Scenes in other units: how lengths and masses enter into each argument."""

import numpy as np

from .scenes import Call, Structure

# Powers of the units of length and mass in each argument; others have none. Times are as before.
WALL = {"push_out": (1, 0), "surface_velocity": (1, 0)}
BODY = WALL | {"vertices": (1, 0), "position": (1, 0), "radius": (1, 0)}
LINK = {"rest": (1, 0), "compliance": (0, -1), "damping": (0, 1), "break_at": (1, 1)}
ANGLE = {"compliance": (-2, -1), "damping": (2, 1), "break_at": (2, 1), "torque": (2, 1)}
ANCHOR = {"compliance": (0, -1), "damping": (0, 1)}
TOUCH = {"skin": (1, 0), "push_out": (1, 0)}
UNITS = {
    "Particles": {"position": (1, 0), "velocity": (1, 0), "mass": (0, 1), "radius": (1, 0)},
    "Gravity": {"g": (1, 0)}, "Drag": {}, "Wind": {"velocity": (1, 0)}, "Hand": {"target": (1, 0)},
    "Attractor": {"center": (1, 0), "strength": (3, 0), "softening": (1, 0)},
    "HalfSpace": WALL | {"offset": (1, 0)}, "Box": WALL | {"lower": (1, 0), "upper": (1, 0)},
    "Ball": WALL | {"center": (1, 0), "radius": (1, 0)}, "Capsule": WALL | {"a": (1, 0), "b": (1, 0), "radius": (1, 0)},
    "Polygon": BODY, "Mesh": BODY, "Contact": TOUCH, "Polygons": TOUCH,
    "Periodic": {"low": (1, 0), "high": (1, 0)}, "Sleep": {"speed": (1, 0)},
    "Pin": ANCHOR | {"target": (1, 0)}, "Snap": ANCHOR | {"spacing": (1, 0), "origin": (1, 0)},
    "Path": ANCHOR | {"points": (1, 0), "speed": (1, 0), "at": (1, 0)},
    "Distance": LINK, "Rope": LINK | {"length": (1, 0)}, "Spacer": LINK | {"length": (1, 0)},
    "Winch": LINK | dict.fromkeys(("speed", "length", "shortest", "longest"), (1, 0)) | {"force": (1, 1)},
    "Bend": ANGLE, "AngleLimit": ANGLE, "Dihedral": ANGLE, "Motor": ANGLE, "ShapeMatch": LINK,
    "Area": {"rest": (2, 0), "compliance": (2, -1), "damping": (-2, 1), "break_at": (0, 1)},
    "Volume": {"rest": (3, 0), "compliance": (4, -1), "damping": (-4, 1), "break_at": (-1, 1)},
}  # fmt: skip


def has_units(structure: Structure) -> bool:
    """Whether UNITS knows all that a structure is made of: not the functions of the user."""
    return all(call.name in UNITS for call in (structure.particles, *structure.features))


def in_units(call: Call, length: float, mass: float) -> Call:
    """Return a call in other units."""
    powers = UNITS[call.name]
    if call.name == "Particles" and not {"mass"} & set(call.args):
        call = Call(call.name, call.args | {"mass": 1.0})
    if call.name == "Gravity" and not call.args:
        call = Call(call.name, {"g": 9.81})
    return Call(
        call.name,
        {k: np.multiply(v, length ** powers[k][0] * mass ** powers[k][1]) if k in powers else v for k, v in call.args.items()},
    )
