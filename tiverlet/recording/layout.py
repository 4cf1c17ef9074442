"""How a recording opens in the viewer."""

import uuid

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from .curves import CURVES

SCENE_VIEW = uuid.uuid5(uuid.NAMESPACE_DNS, "scene.tiverlet")  # the view of the scene, to be found in any recording
SCENE = "world/scene"  # the view looks at "world", so that a mirror at "world/scene" shows
LEGEND = "legend/strain"
WIDE = 5.0  # steps of the legend are so far apart, with a height of 1

# The viewer's 2D views have y pointing down, with no option. A mirror above the data, and below the
# origin of the view, turns it up without touching the data.
MIRROR = rr.Transform3D(scale=[1.0, -1.0, 1.0])


def blueprint(low: np.ndarray, high: np.ndarray, links: bool) -> rrb.Blueprint:
    """The scene on the left, curves and text on the right, for a scene within the corners low and high [m]."""
    size = np.maximum(high - low, 1e-9)
    if len(low) == 2:
        edge = 0.05 * size.max()
        bounds = rrb.VisualBounds2D(
            x_range=[float(low[0] - edge), float(high[0] + edge)],
            y_range=[float(-high[1] - edge), float(-low[1] + edge)],
        )
        view = rrb.Spatial2DView(origin="world", name="Scene", visual_bounds=bounds, background=[18, 20, 26])
    else:
        middle, far = (low + high) / 2, 1.05 * float(np.linalg.norm(size))
        eye = rrb.EyeControls3D(position=middle + far * np.array([0.45, 0.35, 0.82]), look_target=middle, eye_up=(0.0, 1.0, 0.0))
        view = rrb.Spatial3DView(origin="world", name="Scene", eye_controls=eye, background=[18, 20, 26])
    curves = [
        rrb.TimeSeriesView(
            origin="figures",
            contents=[f"figures/{end}"],
            name=title,
            plot_legend=rrb.PlotLegend(corner="RightTop", visible=len(names) > 1),
        )
        for title, (end, names) in CURVES.items()
    ]
    pages = [rrb.TextDocumentView(origin="about", name="About"), rrb.TextLogView(origin="events", name="Events")]
    scale = rrb.Spatial2DView(
        origin="legend", name="Strain of links", background=[18, 20, 26],
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.6 * WIDE, 6.6 * WIDE], y_range=[-1.3, 1.5]),
    )  # fmt: skip
    side = rrb.Vertical(*curves[:-2], rrb.Horizontal(*curves[-2:]), rrb.Tabs(*pages), row_shares=[1, 1, 1, 1, 1.6])
    left = rrb.Vertical(view, scale, row_shares=[10, 1.2]) if links else view
    whole = rrb.Horizontal(left, side, column_shares=[7, 3])
    _name(whole, "layout")
    view.id = SCENE_VIEW
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(state="collapsed", timeline="frame"),
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
