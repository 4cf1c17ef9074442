"""How far a Newton step may go where f is so curved that its gradient means little from afar."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Scene

APPROACH = 1 / 3  # of its size (1 rad for angles), in a frame: how fast a constraint gives up a violation that no load explains
BORNE = 0.25  # of its size: an angle that is off by more than this is off by more than a load explains
TRUST = 0.5  # of its reach, by which a pass moves a corner: beyond, f is not what its gradient says


class StepLimit:
    """The limits on the steps of rigid constraints with a curved f (angles, areas, volumes), on the device.

    A rigid constraint takes out its whole violation in one substep, with the energy C^2 / (2 W h^2), as the spring would that one
    pass of relaxation is. Under a load that is right: C = W |lam| bears it. But C may come from elsewhere: a rest value that was
    changed in a jump, or a goal that others keep it from. Where f is curved, W falls as corners go away (from afar an angle
    between two pins L apart has the gradient L / r^2), and that spring is a pump. So what exceeds the multiplier of the last
    substep, |C_n| - W |lam|, is given up by at most APPROACH of its size in a frame: the rest is postponed. And where a violation
    is postponed, or a pass would move a corner by more than TRUST of its reach, the step only takes out motion: with
    u = sum_j grad_j C . d_j, the motion along the constraint in this substep,

        |u + W dlam| <= max(|u|, pace)

    where `pace` is APPROACH of a frame, and 0 where corners are faster than twice that. With mass-split W, in which every
    constraint has particles of its own, kinetic energy then never grows by more than what the pace is.

    acts: whether the batch has such constraints; where not, it costs nothing. scene_sized: whether any of them is as large as the
    whole scene, in want of a size of its own.
    """

    host_only = ("scene_sized",)

    def __init__(self, scene: "Scene", name: str, batch: Any):
        self.acts, self.collapses = batch.limited and scene.order == 2, batch.quantity.collapses
        self.scene_sized = False
        if self.acts:
            self.postponed = scene.memory.field(f"{name}.postponed", batch.count)
            if batch.arity:
                corner = batch.placed(batch.start.position)
                span = np.linalg.norm(corner - corner[:, :1], axis=2).max(axis=1, initial=0.0)
                self.span = scene.memory.field(f"{name}.span", batch.count, values=np.where(span > 0, span, batch.start.size))
                self.scene_sized = not span.all()

    @ti.func
    def postpone(self, c, C, borne, size, share):
        """What of a violation C, at the start of a substep, is left for later ones.

        borne: by how much of it constraint c bears its load. size: of c. share: of the frame, that the substep is.
        """
        out = 0 * C
        if ti.static(not self.collapses):
            borne = ti.min(borne, BORNE * size)
        over = ti.abs(C) - borne - APPROACH * share * size
        if over > 0:
            out = ti.select(C > 0, over, -over)
        return out

    @ti.func
    def limit(self, c, lam, new, u, W, longest, fastest, reach, size, share):
        """The multiplier `new` of constraint c, or where Newton's step means nothing, one that takes out motion; and whether it
        is that. u, W, longest, fastest: see CornerPasses.motion. reach: see Quantity. size, share: see postpone()."""
        far = False
        if W > 0 and (self.postponed[c] != 0 or ti.abs(new - lam) * longest > TRUST * reach):
            pace = APPROACH * share * ti.min(size, W * ti.min(reach, self.span[c]) / longest)
            if fastest * W * W > (2 * pace * longest) ** 2:
                pace *= 0
            most = ti.max(ti.abs(u), pace)
            new, far = lam + ti.max((-u - most) / W, ti.min(new - lam, (most - u) / W)), True
        return new, far

    @ti.func
    def limit_collapse(self, lam, new, rest, extent, move):
        """A multiplier by which no pass moves corners further than they are, or are to be, apart: next to where f has no
        direction it is curved. rest: what f is to be. extent: squared size of the body. move: squared size of what a multiplier
        of 1 moves."""
        size = ti.abs(rest)
        if ti.static(self.collapses == 2):
            size = ti.sqrt(size)
        else:
            size = ti.pow(size, ti.static(1 / self.collapses))
        reach = ti.sqrt(extent) + size
        far = ti.abs(new - lam) * ti.sqrt(move)
        if far > reach:
            new = lam + (new - lam) * (reach / far)
        return new
