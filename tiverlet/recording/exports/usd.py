"""Export to Universal Scene Description, which Blender, Houdini, Omniverse and usdview read.

Particles may come and go: each stretch of the recording is a part of the stage, visible in its own time.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...shapes import Shape
from .extras import needed
from .geometry import Geometry, flat, linear, turn
from .sketch import extent
from .stretch import Stretch, in_space, stretches
from .walls import Wall, drawn_walls

if TYPE_CHECKING:
    from ..replay import Replay

RATE = 60  # time codes a second: frames of 1/60 s, as World.run() makes them, have whole numbers
THIN = 0.002  # width of lines and of particles without a radius, relative to the size of the scene


def write(recording: "Replay", path: str, *, shape: Shape | None = None, motion: bool = False, color: Any = None) -> list[str]:
    """Write surfaces, links, particles and walls, y up; with motion, particles have velocities, spins and orientations.

    Lengths are in metres, times in seconds times RATE, spins in rad/s, orientations quaternions (x, y, z, w).
    """
    usd, geom = needed("pxr.Usd", path, "usd"), needed("pxr.UsdGeom", path, "usd")
    found = stretches(recording, motion, color)
    if not found:
        raise ValueError(f"replay: {recording.path} has no frame, so there is nothing for {path}.")
    stage = usd.Stage.CreateInMemory()
    stage.SetTimeCodesPerSecond(RATE)
    stage.SetFramesPerSecond(RATE)
    stage.SetStartTimeCode(RATE * recording.times[0].item())
    stage.SetEndTimeCode(RATE * recording.times[-1].item())
    geom.SetStageUpAxis(stage, geom.Tokens.y)
    geom.SetStageMetersPerUnit(stage, 1.0)
    root = geom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    for k, stretch in enumerate(found):
        part = _Part(stage, f"/scene/part_{k}", stretch, shape, path)
        if not k:
            x, y, z, w = turn(part.geometry.up)
            root.AddOrientOp().Set(part.gf.Quatf(w, x, y, z))
        for other in found if len(found) > 1 else ():
            part.show(other.times[0].item(), other is stretch)
        part.write()
    stage.GetRootLayer().Export(path)
    return [path]


class _Part:
    """A stretch of a recording on a stage, below the prim `name`."""

    def __init__(self, stage: Any, name: str, stretch: Stretch, shape: Shape | None, path: str):
        self.geom, self.vt, self.sdf, self.gf = (needed(f"pxr.{n}", path, "usd") for n in ("UsdGeom", "Vt", "Sdf", "Gf"))
        self.stage, self.name, self.stretch = stage, name, stretch
        self.geometries = [*stretch.geometries(shape)]
        self.geometry: Geometry = self.geometries[0]
        self.prim = self.geom.Xform.Define(stage, name)

    def show(self, time: float, visible: bool) -> None:
        """Show or hide it from a time on [s]."""
        tokens = self.geom.Tokens
        self.prim.CreateVisibilityAttr().Set(tokens.inherited if visible else tokens.invisible, RATE * time)

    def write(self) -> None:
        """Write all frames."""
        of = self.geometry
        both = zip(self.stretch, self.stretch.motion, strict=False)
        rows = [(RATE * time, flat(x), in_space(moved)) for (_, time, x), moved in both]
        x = np.array([x for _, x, _ in rows])
        size = THIN * (float(np.ptp(x, axis=(0, 1)).max()) or 1.0) if x.size else THIN  # width of lines [m]
        if len(of.faces):
            at = np.unique(of.around)
            mesh = self._mesh("surfaces", [len(face) for face in of.faces], np.searchsorted(at, of.around))
            self._paint(mesh, at, [code for code, _, _ in rows])
            if len(of.texture):
                self._primvar(mesh, "st", "TexCoord2fArray", of.texture, "faceVarying")
            self._move(mesh, [(code, x[at]) for code, x, _ in rows])
        if len(of.links):
            self._links(rows, size)
        single = np.union1d(of.bare, of.loose)
        if len(single):
            self._particles(rows, single, size)
        for wall in drawn_walls(self.stretch, *extent(self.stretch.parts, x[:, :, : self.stretch.parts.particles.dim])):
            self._wall(wall, [code for code, _, _ in rows], size)

    def _links(self, rows: list[tuple], size: float) -> None:
        """Write links as lines of two points; those that broke are left out."""
        curves = self._curves("links", size)
        before = None
        for (code, x, _), geometry in zip(rows, self.geometries, strict=True):
            if geometry is not before:
                before, ends = geometry, geometry.links.ravel()
                curves.CreateCurveVertexCountsAttr().Set(self._array("IntArray", [2] * len(geometry.links)), code)
                self._primvar(curves, "displayColor", "Color3fArray", linear(geometry.hues)[ends], "vertex", code)
            curves.CreatePointsAttr().Set(self._array("Vec3fArray", x[ends]), code)

    def _particles(self, rows: list[tuple], single: np.ndarray, size: float) -> None:
        """Write particles that no surface hides as points, with their diameters as widths."""
        points = self.geom.Points.Define(self.stage, f"{self.name}/particles")
        radius = self.stretch.column("radius")[single]
        points.CreateWidthsAttr().Set(self._array("FloatArray", np.where(radius > 0, 2 * radius, size)))
        points.SetWidthsInterpolation("vertex")
        points.CreateIdsAttr().Set(self._array("Int64Array", single))
        self._paint(points, single, [code for code, _, _ in rows])
        self._move(points, [(code, x[single]) for code, x, _ in rows])
        for code, _, moved in rows:
            for name, values in moved.items():
                if name == "velocity":
                    points.CreateVelocitiesAttr().Set(self._array("Vec3fArray", values[single]), code)
                else:
                    kind = "Vector3fArray" if name == "spin" else "Float4Array"
                    self._primvar(points, name, kind, values[single], "vertex", code)

    def _wall(self, wall: Wall, codes: list[float], size: float) -> None:
        """Write a wall as triangles or lines."""
        name, hue = wall.name.replace(" ", "_"), linear(wall.hue)
        if wall.solid:
            thing = self._mesh(name, [3] * len(wall.parts), wall.parts.ravel())
            places = wall.corners
        else:
            thing, places = self._curves(name, size), wall.corners[:, wall.parts.ravel()]
            thing.CreateCurveVertexCountsAttr().Set(self._array("IntArray", [2] * len(wall.parts)))
        self._primvar(thing, "displayColor", "Color3fArray", hue, "constant")
        self._move(thing, list(zip(codes, places, strict=True)))

    def _paint(self, thing: Any, at: np.ndarray, codes: list[float]) -> None:
        """Set the colours of the particles `at` at all time codes; once if they do not change."""
        for k, (code, of) in enumerate(zip(codes, self.geometries, strict=True)):
            if not k or of.hues is not self.geometries[k - 1].hues:
                same = of.hues is self.geometries[-1].hues and not k
                self._primvar(thing, "displayColor", "Color3fArray", linear(of.hues)[at], "vertex", None if same else code)

    def _mesh(self, name: str, counts: list[int], around: np.ndarray) -> Any:
        """Return a mesh without points. around: vertices of all faces, one face after the other."""
        mesh = self.geom.Mesh.Define(self.stage, f"{self.name}/{name}")
        mesh.CreateSubdivisionSchemeAttr().Set(self.geom.Tokens.none)
        mesh.CreateDoubleSidedAttr().Set(True)
        mesh.CreateFaceVertexCountsAttr().Set(self._array("IntArray", counts))
        mesh.CreateFaceVertexIndicesAttr().Set(self._array("IntArray", around))
        return mesh

    def _curves(self, name: str, size: float) -> Any:
        """Return straight lines without points. size: their width [m]."""
        curves = self.geom.BasisCurves.Define(self.stage, f"{self.name}/{name}")
        curves.CreateTypeAttr().Set(self.geom.Tokens.linear)
        curves.CreateWidthsAttr().Set(self._array("FloatArray", [size]))
        curves.SetWidthsInterpolation("constant")
        return curves

    def _move(self, thing: Any, places: list[tuple[float, np.ndarray]]) -> None:
        """Set the points of a prim at all time codes; once if it stands still."""
        first = places[0][1]
        if all((x == first).all() for _, x in places):
            thing.CreatePointsAttr().Set(self._array("Vec3fArray", first))
            return
        for code, x in places:
            thing.CreatePointsAttr().Set(self._array("Vec3fArray", x), code)

    def _primvar(self, thing: Any, name: str, kind: str, values: np.ndarray, per: str, code: float | None = None) -> None:
        """Set a value of each vertex, of each corner of faces, or of all. code: from which time code on."""
        types = self.sdf.ValueTypeNames
        made = self.geom.PrimvarsAPI(thing).CreatePrimvar(name, getattr(types, kind), per)
        width = np.shape(values)[-1]
        array = self._array(f"Vec{width}fArray", values)
        made.Set(array) if code is None else made.Set(array, code)

    def _array(self, kind: str, values: Any) -> Any:
        """Return an array of USD."""
        numbers = {"IntArray": np.int32, "Int64Array": np.int64}.get(kind, np.float32)
        return getattr(self.vt, kind).FromNumpy(np.ascontiguousarray(values, dtype=numbers))
