"""Random scenes as data: what is compiled (Structure), and what happens in it (events). Both print as code."""

import inspect
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

import tiverlet as tv

from ..launches import launching
from . import functions


@dataclass(frozen=True)
class Call:
    """A call tv.name(**args)."""

    name: str
    args: dict[str, Any]

    def make(self) -> Any:
        """Make the call and return its result."""
        return getattr(tv, self.name)(**{k: v.make() if isinstance(v, Call) else v for k, v in self.args.items()})

    def __str__(self) -> str:
        return f"tv.{self.name}({', '.join(f'{k}={text(v)}' for k, v in self.args.items())})"


def text(value: Any) -> str:
    """Return a value as code."""
    if isinstance(value, np.ndarray):
        return text(value.tolist())
    if isinstance(value, (np.floating, float)):
        return repr(float(value)) if np.isfinite(value) else f'float("{value}")'
    if isinstance(value, dict):
        return "{" + ", ".join(f"{text(k)}: {text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        inner = ", ".join(map(text, value))
        return f"[{inner}]" if isinstance(value, list) else f"({inner}{',' * (len(value) == 1)})"
    if hasattr(value, "__name__") or getattr(value, "_is_taichi_function", False):
        return plain(value).__name__
    return str(value) if isinstance(value, Call) else repr(value)


def plain(function: Any) -> Any:
    """Return the Python function of a ti.func."""
    return function.func.func if getattr(function, "_is_taichi_function", False) else function


@dataclass(frozen=True)
class Structure:
    """What is compiled: particles, features, settings. path "launched": parallel, as on a GPU."""

    particles: Call
    features: tuple[Call, ...]
    settings: dict[str, Any]

    def build(self) -> tuple[tv.World, list[Any]]:
        """Return a world and its features."""
        features = [f.make() for f in self.features]
        settings = {k: v.make() if isinstance(v, Call) else v for k, v in self.settings.items()}
        if settings.get("path") != "launched":
            return tv.World(self.particles.make(), features, **settings), features
        with launching():
            return tv.World(self.particles.make(), features, **{**settings, "path": "parallel"}), features

    @property
    def periodic(self) -> bool:
        """Whether particles have images."""
        return any(f.name == "Periodic" for f in self.features)

    @property
    def position(self) -> np.ndarray:
        """Return positions at the start."""
        return np.asarray(self.particles.args["position"])

    def lines(self) -> list[str]:
        """Return the structure as code."""
        settings = {k: "parallel" if v == "launched" else v for k, v in self.settings.items()}
        return [
            f"particles = {self.particles}",
            "features = [",
            *(f"    {f}," for f in self.features),
            "]",
            "world = tv.World(" + ", ".join(["particles", "features", *(f"{k}={text(v)}" for k, v in settings.items())]) + ")",
        ]


@dataclass(frozen=True)
class Set:
    """An assignment to the world (`of` = None), or to feature number `of`."""

    of: int | None
    name: str
    value: Any

    def do(self, world: tv.World, features: list[Any]) -> None:
        """Make the assignment."""
        setattr(world if self.of is None else features[self.of], self.name, self.value)

    def line(self) -> str:
        """Return the assignment as code."""
        return f"{'world' if self.of is None else f'features[{self.of}]'}.{self.name} = {text(self.value)}"


@dataclass(frozen=True)
class Step:
    """A frame."""

    dt: float

    def do(self, world: tv.World, features: list[Any]) -> tv.StepReport:
        """Run the frame."""
        return world.step(self.dt)

    def line(self) -> str:
        """Return the frame as code."""
        return f"print(world.step({text(self.dt)}))"


Event = Set | Step


def script(structure: Structure, events: list[Event], says: str = "") -> str:
    """Return a scene as a script that can be pasted."""
    values = [v for call in structure.features for v in call.args.values()]
    used = [plain(v) for v in values if callable(v) or getattr(v, "_is_taichi_function", False)]
    body = structure.lines()
    if structure.settings.get("path") == "launched":
        body = ["from tests.launches import launching", *body[:-1], "with launching():", "    " + body[-1]]
    return "\n".join(
        [
            *(f"# {line}" for line in says.splitlines()), "import taichi as ti", "", "import tiverlet as tv", "",
            *(inspect.getsource(f) for f in dict.fromkeys(used)), *body, *(e.line() for e in events), "",
        ]
    )  # fmt: skip


# What is compiled.


def cloud(n, dim):
    """Return points in general position."""
    return tv.golden(np.arange(n), dim=dim) * 0.35 * max(n, 2) ** (1 / dim)


def line(n, dim):
    """Return points in a row."""
    return 0.3 * np.arange(n)[:, None] * np.eye(dim)[0]


def slope(n, dim):
    """Return points in a row along no axis."""
    return 0.2 * np.arange(n)[:, None] * np.array([1.0, 0.7, -0.4])[:dim]


def lattice(n, dim):
    """Return points of a square lattice."""
    side = int(np.ceil(np.sqrt(n)))
    out = np.zeros((n, dim))
    out[:, 0], out[:, 1] = 0.3 * (np.arange(n) % side), 0.3 * (np.arange(n) // side)
    return out


def ring(n, dim):
    """Return points on a circle."""
    out = np.zeros((n, dim))
    angle = 2 * np.pi * np.arange(n) / n
    out[:, 0], out[:, 1] = np.cos(angle), np.sin(angle)
    return 0.05 * n * out


def point(n, dim):
    """Return points all in one place."""
    return np.zeros((n, dim)) + 0.25


def doubled(n, dim):
    """Return points, two in each place."""
    return cloud(n, dim)[np.arange(n) // 2]


LAYOUTS = (cloud, line, lattice, ring, slope, doubled, point)
COMPLIANCE = (0.0, 0.0, 0.0, 1e-3, 1e-6, 1.0, 1e-12, 1e3)
CLOTHS = {"Jacobi": {"loads": True}, "Direct": {"width": 16}, "Chebyshev": {}, "ConjugateGradient": {"steps": 8}}


def pick(draw, *values):
    """Draw one of the values."""
    return draw(st.sampled_from(values))


@dataclass
class Stage:
    """What features are drawn for: particles, dimension, positions, size, order, held particles, spins."""

    n: int
    dim: int
    x: np.ndarray
    size: float
    order: int
    taken: list[int]
    spins: bool


def chain(n):
    """Return the links of a row."""
    return np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)


def topology(draw, s: Stage) -> np.ndarray:
    """Draw links (m, 2) between n > 1 particles."""
    kind = pick(draw, "chain", "loop", "star", "braced", "complete", "twice", "pair", "tree")
    if kind == "pair" or s.n == 2:
        return np.array([[0, 1]])
    if kind == "chain":
        return chain(s.n)
    if kind == "loop":
        return np.concatenate([chain(s.n), [[s.n - 1, 0]]])
    if kind == "star":
        return np.stack([np.zeros(s.n - 1, dtype=int), np.arange(1, s.n)], axis=1)
    if kind == "braced":
        return np.concatenate([chain(s.n), np.stack([np.arange(s.n - 2), np.arange(2, s.n)], axis=1)])
    if kind == "complete":
        return np.stack(np.triu_indices(min(s.n, 7), 1), axis=1)
    if kind == "twice":
        return np.concatenate([chain(s.n), chain(s.n)[::-1, ::-1]])
    return np.stack([(np.arange(1, s.n) - 1) // 2, np.arange(1, s.n)], axis=1)


def springs(draw, s: Stage, m: int, breaks: bool = True) -> dict[str, Any]:
    """Draw compliance, damping and breaking."""
    alpha = pick(draw, *COMPLIANCE)
    out: dict[str, Any] = {}
    if alpha:
        out["compliance"] = alpha if m < 2 or pick(draw, True, True, False) else np.where(np.arange(m) % 2, alpha, 0.0)
        if s.order == 2 and pick(draw, False, False, True):
            out["damping"] = pick(draw, 0.1, 1e-6, 1e4)
    if breaks and s.order == 2 and pick(draw, False, False, False, False, True):
        out["break_at"] = pick(draw, 1.0, 1e-6, 1e6)
    return out


def links(draw, s: Stage) -> Call | None:
    """Draw Distance, Rope or Spacer."""
    if s.n < 2:
        return None
    kind = pick(draw, "Distance", "Distance", "Distance", "Rope", "Spacer") if s.order == 2 else "Distance"
    pairs = topology(draw, s)
    lengths = np.linalg.norm(s.x[pairs[:, 0]] - s.x[pairs[:, 1]], axis=1)
    rest = pick(draw, None, None, None, "as is", "long", "short", "zero", "one")
    value = {"as is": lengths, "long": 1.1 * lengths, "short": 0.9 * lengths, "zero": 0.0, "one": 0.3 * s.size}.get(rest)
    args: dict[str, Any] = {"pairs": pairs}
    if kind == "Spacer" or value is not None:
        args["rest" if kind == "Distance" else "length"] = lengths if value is None else value
    return Call(kind, args | springs(draw, s, len(pairs)))


def corners(draw, s: Stage) -> Call | None:
    """Draw Bend, AngleLimit, Dihedral, or the user's own constraint."""
    kind = pick(draw, "Bend", "AngleLimit", "Dihedral", "Constraint")
    k = np.arange(s.n)
    if kind == "Dihedral":
        if s.dim == 2 or s.n < 4:
            return None
        quads = np.stack([k[1:-2], k[2:-1], k[:-3], k[3:]], axis=1)
        return Call(kind, {"quads": quads, "rest": pick(draw, None, 0.0, 0.5)} | springs(draw, s, len(quads)))
    if kind == "Constraint" and (s.n < 3 or pick(draw, True, False)):
        if s.n < 2:
            return None
        return Call(kind, {"function": functions.moment, "indices": chain(s.n), "rest": None} | springs(draw, s, s.n - 1))
    if s.n < 3:
        return None
    triples = np.stack([k[:-2], k[1:-1], k[2:]], axis=1)
    more = springs(draw, s, len(triples))
    if kind == "Constraint":
        return Call(kind, {"function": functions.perimeter, "indices": triples, "rest": None} | more)
    if kind == "AngleLimit":
        if s.order > 2:
            return None
        return Call(kind, {"triples": triples, "lower": 0.0, "upper": pick(draw, 0.5, 3.0, 0.0)} | more)
    return Call(kind, {"triples": triples, "rest": pick(draw, None, 0.0, 1.0)} | more)


def drives(draw, s: Stage) -> Call | None:
    """Draw Motor or Winch."""
    k, speed, most = np.arange(s.n), pick(draw, 1.0, -3.0, 0.0, 100.0), pick(draw, 1.0, 1.0, float("inf"), 0.0, 1e-3, 1e4)
    kind = pick(draw, "Motor", "Winch")
    if kind == "Winch":
        if s.n < 2:
            return None
        pairs = chain(s.n)
        return Call(
            kind, {"pairs": pairs, "speed": speed * s.size, "length": 0.3 * s.size, "force": most} | springs(draw, s, len(pairs))
        )
    arity = 4 if s.dim == 3 and pick(draw, True, False) else 3
    if s.n < arity:
        return None
    hinges = np.stack([k[1:-2], k[2:-1], k[:-3], k[3:]] if arity == 4 else [k[:-2], k[1:-1], k[2:]], axis=1)
    args: dict[str, Any] = {"hinges": hinges, "speed": speed, "torque": most}
    if pick(draw, False, True):
        args["angle"] = pick(draw, 0.5, 3.0, 0.0)
    return Call(kind, args | springs(draw, s, len(hinges)))


def bodies(draw, s: Stage) -> Call | None:
    """Draw Area, Volume or ShapeMatch."""
    if s.n < 3:
        return None
    kind, more = pick(draw, "ShapeMatch", "Area", "Volume"), springs(draw, s, 1)
    if kind == "ShapeMatch":
        if "compliance" in more and pick(draw, False, True):
            more |= {"creep": 3.0, "yield_strain": 0.1}
        half = s.n // 2 + 1
        return Call(kind, {"clusters": pick(draw, [list(range(s.n))], [list(range(half)), list(range(half - 1, s.n))])} | more)
    pressure = {"pressure": pick(draw, 1.0, 1.2, 0.5, 0.0)}
    if kind == "Area":
        loop = list(range(s.n if s.dim == 2 and s.order == 2 else 3))
        return Call(kind, {"loops": [loop]} | pressure | more)
    if s.dim == 2 or s.n < 4:
        return None
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    return Call(kind, {"cells": pick(draw, np.array([[0, 1, 2, 3]]), faces)} | pressure | more)


def rails(draw, s: Stage) -> Call | None:
    """Draw Pin, Path or Snap for a particle that no other one holds."""
    free = [i for i in range(s.n) if i not in s.taken]
    if not free:
        return None
    i = pick(draw, free[0], free[-1])
    s.taken.append(i)
    kind = pick(draw, "Pin", "Path", "Snap", "Pin")
    if kind == "Pin":
        return Call(kind, {"indices": [i]} | ({} if pick(draw, True, False) else {"compliance": 1e-3, "damping": 0.1}))
    if kind == "Snap":
        return Call(kind, {"indices": [i], "spacing": 0.2 * s.size, "compliance": pick(draw, 1e-3, 1e-6)})
    track = s.x[i] + s.size * cloud(4, s.dim) - s.size * cloud(4, s.dim)[0]
    more = pick(draw, {}, {}, {"speed": 0.5 * s.size}, {"at": 0.1 * s.size}, {"compliance": 1e-4})
    return Call(
        kind, {"indices": [i], "points": track, "closed": pick(draw, False, True), "smooth": pick(draw, True, False)} | more
    )


def forces(draw, s: Stage) -> Call | None:
    """Draw any force."""
    kind = pick(draw, "Gravity", "Gravity", "Gravity", "Drag", "Wind", "Attractor", "Force", "PairForce")
    if kind == "Gravity":
        down = -9.81 * np.eye(s.dim)[1]
        return Call(kind, {"g": pick(draw, 9.81, 9.81, down + 3.0, 0.0, 1e4) if s.size == 1 else 9.81 * s.size})
    if kind in ("Drag", "Wind"):
        if s.order > 2:
            return None
        wind = {"velocity": s.size * np.array([3.0, 1.0, -2.0])[: s.dim]} if kind == "Wind" else {}
        return Call(kind, wind | {"rate": pick(draw, 0.5, 0.0, 30.0, 1e4)})
    if kind == "Attractor":
        return Call(kind, {"center": s.x[0] + 2 * s.size, "strength": pick(draw, 1.0, 0.0, -1.0, 100.0) * s.size**3})
    if kind == "PairForce":
        return Call(kind, {"function": functions.repel, "radius": pick(draw, None, 0.5 * s.size, 2.0 * s.size)})
    own = [functions.spring] if s.order > 2 else [functions.spring, functions.swirl, functions.waves]
    return Call(kind, {"function": pick(draw, *own)})


def surface(draw, s: Stage) -> dict[str, Any]:
    """Draw friction and restitution."""
    out: dict[str, Any] = {}
    if s.spins or pick(draw, False, True):
        out["friction"] = pick(draw, 0.5, 1e6, (0.6, 0.3), *([(0.5, 0.5, 0.1), (1.0, 0.5, 0.3, 0.2)] if s.spins else []))
    if pick(draw, False, True):
        out["restitution"] = pick(draw, 0.5, 1.0, *([(0.5, 0.5), (1.0, 1.0)] if s.spins else []))
    return out


def walls(draw, s: Stage) -> Call | None:
    """Draw any wall."""
    low, high, mid = s.x.min(axis=0) - 0.5 * s.size, s.x.max(axis=0) + 0.5 * s.size, s.x.mean(axis=0)
    reach, more = float(np.linalg.norm(high - low)), surface(draw, s)
    more |= {"events": True} if "restitution" in more else {}
    kinds = ["Box", "HalfSpace", "Ball", "Capsule", "Polygon" if s.dim == 2 else "Mesh"]
    kind = pick(draw, *kinds, *(["Sdf"] if s.size == 1 else []))
    up = np.eye(s.dim)[1]
    if kind in ("Capsule", "Polygon", "Mesh") and pick(draw, False, False, True):
        more["one_way"] = pick(draw, up, -up, up + 0.3)
    if "friction" in more and pick(draw, False, False, True):
        more["surface_velocity"] = pick(draw, np.zeros(s.dim), 2.0 * s.size * np.eye(s.dim)[0])
    if kind == "Box":
        return Call(kind, {"lower": low, "upper": high} | more)
    if kind == "HalfSpace":
        normal = pick(draw, up, up + 0.3, -up)
        return Call(
            kind, {"normal": normal, "offset": float((s.x @ normal / np.linalg.norm(normal)).min()) - 0.5 * s.size} | more
        )
    if kind == "Ball":
        if pick(draw, True, False):
            return Call(kind, {"center": mid, "radius": reach, "inside": True} | more)
        return Call(kind, {"center": low - up * s.size, "radius": 0.8 * s.size} | more)
    if kind == "Capsule":
        return Call(
            kind, {"a": low - up * s.size, "b": low - up * s.size + np.eye(s.dim)[0] * reach, "radius": 0.3 * s.size} | more
        )
    place = {"position": low - up * s.size}
    if kind == "Polygon":
        star = 0.8 * s.size * np.array([[-1.0, -1], [2, -1], [0.5, 0], [1, 1], [-1, 0.5]])
        if pick(draw, True, False):
            return Call(kind, {"vertices": star} | place | more)
        inside = {"position": mid, "inside": True}
        return Call(kind, {"vertices": reach * np.array([[-1.0, -1], [1.5, -1], [1, 1.2], [0, 0.9], [-1, 1.5]])} | inside | more)
    if kind == "Mesh":
        vertices = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        faces = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
        if pick(draw, True, False):
            return Call(kind, {"vertices": 0.5 * s.size * vertices, "faces": faces} | place | more)
        return Call(kind, {"vertices": 2.5 * reach * vertices, "faces": faces, "position": mid, "inside": True} | more)
    return Call(kind, {"function": pick(draw, functions.ground, functions.pillar)} | more)


def contacts(draw, s: Stage) -> Call | None:
    """Draw Contact or Polygons."""
    more = surface(draw, s)
    if s.dim == 2 and s.n >= 6 and not s.spins and pick(draw, False, False, False, True):
        half = s.n // 2
        return Call("Polygons", {"loops": [list(range(half)), list(range(half, s.n))]} | more)
    if pick(draw, False, False, True):
        more["skin"] = pick(draw, 0.02, 1.0) * s.size
    if pick(draw, False, False, False, True):
        more["groups"] = [(0, 1)]
    if pick(draw, False, False, False, True):
        more["loads"] = True
    return Call("Contact", more | ({"events": True} if "friction" in more else {}))


def boxes(draw, s: Stage, radius: float) -> Call:
    """Draw a periodic box that holds the scene, and that particles leave soon."""
    low, high = s.x.min(axis=0), s.x.max(axis=0)
    spare = 1.3 * float((high - low).max()) + 0.3 * s.size + 2.5 * radius
    axes = pick(draw, None, None, [0], [s.dim - 1])
    return Call("Periodic", {"low": low - 0.1 * spare, "high": high + spare, "axes": axes})


@st.composite
def structures(draw) -> Structure:
    """Draw any structure."""
    dim, n = pick(draw, 2, 3), draw(st.integers(1, 12))
    precision = pick(draw, "f32", "f32", "f64", "f32-compensated")
    order = pick(draw, 2, 4, 6, 8) if precision == "f64" and pick(draw, False, False, True) else 2
    size = pick(draw, 1.0, 1.0, 1.0, 1.0, 1.0, 1e-6, 1e6)
    x = size * pick(draw, *LAYOUTS)(n, dim)
    if pick(draw, False, False, False, False, True):
        x = x + size * pick(draw, 1e3, 1e5, -1e7)
    args: dict[str, Any] = {"position": x}
    mass = pick(draw, "one", "one", "some", "wide", "static")
    if mass != "one":
        spread = {"some": 1.0, "wide": 6.0, "static": 1.0}[mass]
        args["mass"] = 10.0 ** (spread * np.linspace(-1, 1, n)[np.argsort(tv.golden(np.arange(n)))])
        if mass == "static":
            args["mass"][pick(draw, 0, -1)] = np.inf
    radius = pick(draw, "points", "small", "small", "wide", "apart", "big")
    if radius != "points":
        sizes = {
            "small": 0.1,
            "big": 0.3,
            "wide": 10.0 ** np.linspace(-3.5, -0.5, n),
            "apart": np.where(np.arange(n) % 2, 0.1, 0.0),
        }
        args["radius"] = size * sizes[radius]
    pinned = pick(draw, "none", "none", "first", "ends", "all") if n > 1 else "none"
    args |= {"none": {}, "first": {"pinned": [0]}, "ends": {"pinned": [0, n - 1]}, "all": {"pinned": list(range(n))}}[pinned]
    if pick(draw, False, False, True):
        args["group"] = np.arange(n) % 2
    spins = order == 2 and radius not in ("points", "apart") and pick(draw, False, False, True)
    if spins:
        args["spin"] = pick(draw, 0.0, 10.0, 1e4) * np.array([1.0] if dim == 2 else [0.6, -0.48, 0.64])
        args["spin"] = args["spin"] * np.where(np.arange(n) % 3, 1.0, -0.5)[:, None]
        args["spin"] = args["spin"][:, 0] if dim == 2 else args["spin"]
        args |= pick(draw, {}, {"inertia": "ring"}, {"inertia": np.linspace(0.1, 2.0, n)}, {"orientation": 0.0})
    stage = Stage(n, dim, x, size, order, list(args.get("pinned", [])), spins)
    kinds = [forces, links, corners, bodies, rails, forces, links] + ([walls, walls, contacts, drives] if order == 2 else [])
    made = [kind(draw, stage) for kind in draw(st.lists(st.sampled_from(kinds), min_size=1, max_size=5))]
    calls, met = [], False
    for call in made:
        if call and not (met and call.name in ("Contact", "Polygons")):
            met = met or call.name in ("Contact", "Polygons")
            calls.append(call)
    if pick(draw, False, False, False, False, False, True):
        calls.append(boxes(draw, stage, float(np.max(args.get("radius", 0.0)))))
    wide = any(call.name == "PairForce" for call in calls)
    if order == 2 and not wide and pick(draw, False, False, False, False, False, True):
        calls.append(Call("Sleep", {"speed": size * pick(draw, 0.1, 1e-3, 3.0), "time": pick(draw, 1e-6, 0.02, 0.5)}))
    settings: dict[str, Any] = {"precision": precision}
    if order > 2:
        settings |= {"order": order, "solver": Call("Direct", {"width": 16})}
    else:
        solver = pick(draw, None, None, *CLOTHS)
        path = pick(draw, "fused", "fused", "fused", "fused", "fused", "parallel", "launched")
        settings |= {"path": path} | ({"solver": Call(solver, CLOTHS[solver])} if solver else {})
    return Structure(Call("Particles", args), tuple(calls), settings)


# What happens.

KNOBS = {  # a knob, and the values to which it may be set
    "Gravity": ("g", (0.0, 3.0, 100.0)),
    "Drag": ("rate", (0.0, 5.0, 1e5)),
    "Wind": ("rate", (0.0, 5.0, 1e5)),
    "Attractor": ("strength", (0.0, 1.0, -10.0)),
    "Motor": ("torque", (0.0, 1.0, float("inf"))),
    "Winch": ("speed", (0.0, 1.0, -3.0)),
}
MOVES = {"HalfSpace": "offset", "Ball": "center", "Capsule": "a", "Polygon": "position", "Mesh": "position", "Sdf": "position"}
RESTS = ("Distance", "Rope", "Spacer")


def turns(draw, structure: Structure) -> list[Event]:
    """Draw an assignment to a knob of one of the features."""
    size = scale(structure.position)
    some = [k for k, f in enumerate(structure.features) if f.name in {*KNOBS, *MOVES, *RESTS, "Pin", "Path"}]
    if not some:
        return []
    k = pick(draw, *some)
    call = structure.features[k]
    if call.name in KNOBS:
        name, values = KNOBS[call.name]
        return [Set(k, name, pick(draw, *values))]
    if call.name in RESTS:
        return [Set(k, "rest", pick(draw, 0.3, 0.1, 0.0) * size)]
    shift = size * pick(draw, 0.05, 0.0, -0.5, 3.0)
    if call.name == "Pin":
        return [Set(k, "target", structure.position[call.args["indices"]] + shift)]
    if call.name == "Path":
        knob = next((name for name in ("speed", "at") if name in call.args), None)
        return [Set(k, knob, shift)] if knob else []
    name = MOVES[call.name]
    was = call.args.get(name, np.zeros(structure.position.shape[1]))
    return [Set(k, name, np.asarray(was) + shift if np.ndim(was) else was + shift)]


def scale(x: np.ndarray) -> float:
    """Return 1, or the unit in which a structure was made."""
    reach = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    return 1e-6 if 0 < reach < 1e-3 else 1e6 if reach > 1e4 else 1.0


def placed(kind: str, x: np.ndarray, seed: int) -> np.ndarray:
    """Return positions to start from."""
    size, rng = scale(x), np.random.default_rng(seed)
    if kind == "jitter":
        return x + 0.01 * size * rng.standard_normal(x.shape)
    if kind == "random":
        return x.mean(axis=0) + size * rng.standard_normal(x.shape)
    if kind == "point":
        return np.broadcast_to(x[:1], x.shape).copy()
    if kind == "row":
        return x[:1] + 0.3 * size * np.arange(len(x))[:, None] * np.eye(x.shape[1])[seed % x.shape[1]]
    if kind == "flat":
        return x * (np.arange(x.shape[1]) != seed % x.shape[1])
    if kind == "away":
        return x + size * 10.0 ** (seed % 8)
    if kind == "shrunk":
        return x.mean(axis=0) + (x - x.mean(axis=0)) * 10.0 ** -(seed % 8)
    if kind == "swapped":
        return x[rng.permutation(len(x))]
    return x


@st.composite
def happenings(draw, structure: Structure) -> list[Event]:
    """Draw what happens in a world of this structure: settings, positions, velocities, frames, knobs."""
    x, out = structure.position, []
    seeds = st.integers(0, 1000)
    many = structure.settings.get("path", "fused") == "fused"  # where waiting for threads costs nothing
    substeps = pick(draw, 20, 1, 2, 3, 8, 50, 200, "auto", "auto") if many else pick(draw, 4, 1, 2, 7)
    out.append(Set(None, "substeps", substeps))
    out.append(Set(None, "iterations", pick(draw, 1, 1, 2, 4, 8)))
    start = pick(draw, "built", "built", "built", "jitter", "random", "point", "row", "flat", "away", "shrunk", "swapped")
    if start != "built":
        out.append(Set(None, "position", placed(start, x, draw(seeds))))
    speed = pick(draw, 0.0, 0.0, 1.0, 10.0, 100.0, 1e-3)
    if speed:
        rng = np.random.default_rng(draw(seeds))
        out.append(Set(None, "velocity", speed * scale(x) * rng.standard_normal(x.shape)))
    if "spin" in structure.particles.args and pick(draw, False, False, True):
        out.append(Set(None, "spin", -0.5 * structure.particles.args["spin"]))
    dt = pick(draw, 1 / 60, 1 / 60, 1 / 60, 1e-3, 0.1, 1e-6)
    for _ in range(draw(st.integers(1, 4))):
        out.append(Step(dt))
        what = pick(draw, "nothing", "nothing", "nothing", "turn", "turn", "substeps", "dt", "place")
        if what == "turn":
            out += turns(draw, structure)
        elif what == "substeps":
            out.append(Set(None, "substeps", pick(draw, *((1, 7, "auto", 40) if many else (1, 3)))))
        elif what == "dt":
            dt = pick(draw, 1 / 60, 1 / 120, 1 / 30, 0.01)
        elif what == "place":
            out.append(Set(None, "position", placed(pick(draw, "jitter", "swapped", "shrunk"), x, draw(seeds))))
    auto = any(isinstance(e, Set) and e.value == "auto" for e in out if not isinstance(e, Step) and e.name == "substeps")
    return [*out, *[Step(dt)] * pick(draw, 1, 1, 1, 20 if many and not auto else 1)]
