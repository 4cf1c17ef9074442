"""The limit on Newton steps where f is so curved that its gradient is valid only near by."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Scene

APPROACH = 1 / 3  # of its size (1 rad for angles), per frame: how fast a violation that no load explains is removed
BORNE = 0.25  # of its size: the largest violation of an angle that a load explains
TRUST = 0.5  # of its trust radius: beyond this move of a corner in a pass, the gradient does not describe f


class StepLimit:
    """The limits on the steps of rigid constraints with a curved f (angles, areas, volumes), on the device.

    A rigid constraint removes its whole violation in one substep. That releases the energy C^2 / (2 W h^2), as a spring with the
    stiffness of one relaxation pass would. Under a load that is right: C = W |lam| bears it. But C may have another origin: a
    rest value that jumped, or a goal that other constraints prevent. Where f is curved, W falls as corners move away (an angle
    between two pins L apart, seen from a distance r, has the gradient L / r^2), and that spring pumps energy. So of the part that
    the multiplier of the last substep does not explain, |C_n| - W |lam|, at most APPROACH of the size is removed per frame; the
    rest is postponed. Where a violation is postponed, or a pass would move a corner by more than TRUST of its trust radius, the
    step only removes motion. With u = sum_j grad_j C . d_j, the motion along the constraint in this substep,

        |u + W dlam| <= max(|u|, pace)

    where `pace` is APPROACH of a frame, and 0 where corners are faster than twice that. With mass-split W, in which every
    constraint has particles of its own, kinetic energy then never grows by more than `pace` allows.

    acts: whether the batch has such constraints; otherwise it costs nothing. scene_sized: whether any constraint without a size
    of its own takes the size of the whole scene.
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
        """Return the part of C at the start that is left for later. borne: bears the load. size: of c. share: of the frame."""
        out = 0 * C
        if ti.static(not self.collapses):
            borne = ti.min(borne, BORNE * size)
        over = ti.abs(C) - borne - APPROACH * share * size
        if over > 0:
            out = ti.select(C > 0, over, -over)
        return out

    @ti.func
    def limit(self, c, lam, new, u, W, longest, fastest, trust_radius, size, share):
        """Return the multiplier `new` of constraint c, or one that only removes motion; and whether it is the latter.

        It only removes motion where a Newton step is not valid. u, W, longest, fastest: see CornerPasses.motion. trust_radius:
        see Quantity. size, share: see postpone().
        """
        far = False
        if W > 0 and (self.postponed[c] != 0 or ti.abs(new - lam) * longest > TRUST * trust_radius):
            pace = APPROACH * share * ti.min(size, W * ti.min(trust_radius, self.span[c]) / longest)
            if fastest * W * W > (2 * pace * longest) ** 2:
                pace *= 0
            most = ti.max(ti.abs(u), pace)
            new, far = lam + ti.max((-u - most) / W, ti.min(new - lam, (most - u) / W)), True
        return new, far

    @ti.func
    def limit_collapse(self, lam, new, rest, extent, move):
        """Return a multiplier by which no pass moves corners further than they are, or are to be, apart.

        f is curved near the shape where it has no direction. rest: the goal of f. extent: squared size of the body. move: squared
        size of the displacement by a multiplier of 1.
        """
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
