"""The layout in which the viewer opens a recording."""

import uuid

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

SCENE_VIEW = uuid.uuid5(uuid.NAMESPACE_DNS, "scene.tiverlet")  # id of the view of the scene in any recording
SCENE = "world/scene"  # the view shows "world", so that a mirror transform at "world/scene" applies
LEGEND = "legend/strain"
WIDE = 5.0  # distance of the steps of the legend, relative to its height

HALF, ASPECT = 0.52, 1.5  # tangent of half the viewer's vertical angle of 55 degrees; width over height
CAMERA = float(np.radians(30)), float(np.radians(20))  # angles of the eye, see eye_axes()
MARGIN = 1.06  # factor on the distance of the eye
SEEN = 1e-2, 1e4  # least and most size of scenes [m] that the viewer shows unscaled


def unit(low: np.ndarray, high: np.ndarray) -> float:
    """Return the factor by which a scene between two corners [m] is scaled for the viewer, a power of ten.

    It is 1 unless the scene is so small or large that the viewer would show nothing of it.
    """
    size = min(float((high - low).max()), 1e30)
    return 1.0 if size < 1e-30 or SEEN[0] <= size <= SEEN[1] else 10.0 ** -np.floor(np.log10(size))


def transform(up: np.ndarray, unit: float) -> rr.Transform3D:
    """Return the transform between the data and the origin of the view. up: see view_up().

    The y axis of the viewer's 2D views points down and cannot be changed; a mirror turns it up without touching the data.
    """
    return rr.Transform3D(scale=[unit, -unit * up[1] if len(up) == 2 else unit, unit])


def upright(up: np.ndarray) -> rr.components.ViewCoordinates:
    """Return which axis of a 3D scene points up, and its sign."""
    axis = "XYZ"[int(np.argmax(np.abs(up)))]
    return getattr(rr.ViewCoordinates, f"RIGHT_HAND_{axis}_{'UP' if up.max() > -up.min() else 'DOWN'}")


def eye_axes(up: np.ndarray, camera: tuple[float, float] = CAMERA) -> np.ndarray:
    """Return the axes of an eye in 3D: unit vectors to the right, up and out of the scene, (3, 3).

    camera: how far it stands to the right of the front, from where x points to the right, and above the horizon [rad].
    """
    aside, above = camera
    front = np.array([0.0, -1, 0] if abs(up[2]) > 0.5 else [0.0, 0, 1])
    front -= front @ up * up
    front /= np.linalg.norm(front)
    eye = np.cos(aside) * front + np.sin(aside) * np.cross(up, front)
    right = np.cross(up, eye)
    eye = np.cos(above) * eye + np.sin(above) * up
    return np.array([right, np.cross(eye, right), eye])


def distance(size: np.ndarray, axes: np.ndarray) -> float:
    """Return how far from its centre [m] an eye sees the whole of a box of this size [m]. axes: see eye_axes()."""
    corners = np.stack(np.meshgrid(*np.stack([-size, size], axis=1) / 2), axis=-1).reshape(-1, 3)
    right, above, back = axes @ corners.T
    return MARGIN * float((np.maximum(np.abs(right) / ASPECT, np.abs(above)) / HALF + back).max())


def scene_view(low: np.ndarray, high: np.ndarray, up: np.ndarray, origin: str = "world", name: str = "Scene") -> rrb.View:
    """Return the view of a scene within the corners low and high [m].

    up: see view_up(). origin: the entity above the scene.
    """
    size = np.maximum(high - low, 1e-9)
    if len(low) == 2:
        edge = 0.05 * size.max()
        ends = sorted([-up[1] * low[1], -up[1] * high[1]])  # the viewer's y points down
        bounds = rrb.VisualBounds2D(
            x_range=[float(low[0] - edge), float(high[0] + edge)],
            y_range=[float(ends[0] - edge), float(ends[1] + edge)],
        )
        return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds)
    else:
        middle = (low + high) / 2
        axes = eye_axes(up)
        eye = rrb.EyeControls3D(position=middle + distance(size, axes) * axes[2], look_target=middle, eye_up=up)
        return rrb.Spatial3DView(origin=origin, name=name, eye_controls=eye, line_grid=rrb.LineGrid3D(visible=False))


def legend_view(title: str, origin: str = "legend") -> rrb.View:
    """Return the view of the colour scale."""
    bounds = rrb.VisualBounds2D(x_range=[-0.6 * WIDE, 6.6 * WIDE], y_range=[-1.3, 1.5])
    return rrb.Spatial2DView(origin=origin, name=title, visual_bounds=bounds)


def blueprint(
    low: np.ndarray, high: np.ndarray, legend: str | None, figures: dict[str, tuple[str, list[bool]]], up: np.ndarray
) -> rrb.Blueprint:
    """Return the layout of a scene within the corners low and high [m]: the scene on the left, curves and text on the right.

    figures: see informative_views() in curves.py. legend: the title of the colour scale, or None. up: see view_up().
    """
    view = scene_view(low, high, up)
    curves = [
        rrb.TimeSeriesView(
            origin="figures",
            contents=[f"figures/{end}"],
            name=title,
            plot_legend=rrb.PlotLegend(corner="RightTop", visible=sum(those) > 1),
        )
        for title, (end, those) in figures.items()
    ]
    pages = [rrb.TextDocumentView(origin="about", name="About"), rrb.TextLogView(origin="events", name="Events")]
    side = rrb.Vertical(*curves, rrb.Tabs(*pages), row_shares=[*(1 for _ in curves), 1.6])
    left = rrb.Vertical(view, legend_view(legend), row_shares=[11, 1.3]) if legend else view
    whole = rrb.Horizontal(left, side, column_shares=[4, 1])
    _name(whole, "layout")
    view.id = SCENE_VIEW
    return opened(whole)


def grid(views: list[rrb.View], legend: rrb.View | None) -> rrb.Blueprint:
    """Return a layout with views side by side, above a colour scale."""
    side = rrb.Grid(*views)
    whole = rrb.Vertical(side, legend, row_shares=[11, 1.0]) if legend else side
    _name(whole, "grid")
    return opened(whole)


def opened(whole: rrb.Container) -> rrb.Blueprint:
    """Return a layout without the viewer's panels, except for the time."""
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(state="collapsed", timeline="time"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _name(part: rrb.Container | rrb.View, name: str) -> None:
    """Give all parts ids that are the same in every recording, so that layouts can be compared."""
    part.id = uuid.uuid5(SCENE_VIEW, name)
    for k, inner in enumerate(part.contents if isinstance(part, rrb.Container) else ()):
        _name(inner, f"{name}/{k}")
