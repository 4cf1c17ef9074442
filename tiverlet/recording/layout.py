"""How a recording opens in the viewer."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

# The viewer's 2D views have y pointing down, with no option. A mirror above the data, and below the
# origin of the view, turns it up without touching the data.
MIRROR = rr.Transform3D(scale=[1.0, -1.0, 1.0])
CURVES = {
    "residual": ("worst constraint violation", [230, 120, 60]),
    "overlap": ("worst overlap [radii]", [90, 160, 230]),
    "energy": ("energy [J]", [120, 200, 120]),
    "milliseconds": ("time per frame [ms]", [190, 140, 220]),
}


def blueprint(low: np.ndarray, high: np.ndarray) -> rrb.Blueprint:
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
        middle, far = (low + high) / 2, 1.4 * float(np.linalg.norm(size))
        eye = rrb.EyeControls3D(position=middle + far * np.array([0.45, 0.35, 0.82]), look_target=middle, eye_up=(0.0, 1.0, 0.0))
        view = rrb.Spatial3DView(origin="world", name="Scene", eye_controls=eye, background=[18, 20, 26])
    curves = [rrb.TimeSeriesView(origin=f"figures/{name}", name=title) for name, (title, _) in CURVES.items()]
    side = rrb.Vertical(*curves, rrb.TextDocumentView(origin="about", name="About"), row_shares=[1, 1, 1, 1, 1.4])
    return rrb.Blueprint(
        rrb.Horizontal(view, side, column_shares=[7, 3]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )
