"""What pages have to know beside the frames: the scene, where walls are, and which links have broken."""

from typing import TYPE_CHECKING

import numpy as np

from ..colliders.collider import Collider
from ..constraints import Path
from ..neighbours import Periodic
from ..recording.drawing import bounds, links
from ..recording.hues import BY_BODY, Coloring
from ..recording.images import InBox
from . import scene

if TYPE_CHECKING:
    from ..step.step_report import StepReport
    from ..world import World

DRAWN = (Collider, Path, Periodic)


class Parts:
    """Messages for pages about what rarely changes, by kind. It observes the world and makes those anew that have changed.

    A page is sent each message once, together with the next frame that it takes. So it misses none, however slow it is.
    """

    def __init__(self, world: "World", title: str, y_down: bool = False, coloring: Coloring = BY_BODY):
        self.world, self._title, self._y_down, self.coloring = world, title, y_down, coloring.following(world)
        self._messages: dict[str, str] = {}
        self._extent = bounds(world)  # walls are drawn between these corners, also when particles come and go
        self.regrouped()
        world._watchers.append(self)

    def current(self) -> dict[str, str]:
        """Return the messages, by kind."""
        world = self.world
        if "scene" in self._stale:
            self._messages["scene"] = scene.scene(world, self._title, self._extent, self._y_down, self.coloring)
        if "walls" in self._stale:
            self._messages["walls"] = scene.walls(world, self._extent)
        if "broken" in self._stale and any(f.breaks for _, f in links(world)):
            self._messages["broken"] = scene.broken(world)
        self._stale.clear()
        return self._messages

    def drawn_positions(self) -> np.ndarray:
        """Return where particles are drawn, (n, dim) [m]."""
        return self._in_box.drawn_positions(self.world, self.world.position)

    def regrouped(self) -> None:
        """After particles or features were added or removed, or the world was put back: all messages are stale."""
        self._stale, self._in_box = {"scene", "walls", "broken"}, InBox()

    def before(self) -> None:
        """Before a step: see which walls the user has changed."""
        if any(f.changed for f in self.world.features if isinstance(f, DRAWN)):
            self._stale.add("walls")

    def after(self, dt: float, report: "StepReport") -> None:
        """After a step: see what has moved or broken."""
        if any(f.moving for f in self.world.features if isinstance(f, DRAWN)):
            self._stale.add("walls")
        if report.broken:
            self._stale.add("broken")

    def assigned(self, name: str, value: np.ndarray) -> None:
        """After positions or velocities were assigned: do nothing."""

    def broken_off(self) -> None:
        """After a failed step: do nothing."""

    def close(self) -> None:
        """Stop observing the world."""
        if self in self.world._watchers:
            self.world._watchers.remove(self)
