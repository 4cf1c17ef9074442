"""The passes over constraints on one number, of a few corners each."""

from typing import Any

import numpy as np

from ...device import always, at, inline, ti
from ...features.feature import FAR, Scene
from .equation import Equation
from .passes import Passes
from .spring import FIRM, stiff
from .step_limit import TRUST

RESOLVED = 4.0  # alpha' / W: from this ratio on the substep resolves a spring
HELD = 1 / 64  # of its weight: if walls leave less to a constraint in an impact, it does not take into account that they hold it
LOST = 0.015  # relative violation at the start of a substep, beyond which its direction there would add energy


class CornerPasses(Passes):
    """The passes of a Scalar whose constraints have a few corners; see Equation for the law.

    The constraint direction is that at the start of the step, x_n (SHAKE, Ryckaert 1977): second order and no loss of energy.
    When a constraint turns by more than 41 degrees in a step, or has no direction at x_n, the current direction is used instead.
    Springs that the step resolves, alpha' >= RESOLVED W, keep the direction of x_n, and act as Verlet kicks. With the current
    direction, a spring that passes through length 0 would push to the other side a step too early, each time, and gain energy.

    `row` is the row of each constraint in a system of constraints that are solved together, -1 for none. Constraints without a
    row are relaxed alone.
    """

    def __init__(self, scene: Scene, batch: Any, start: np.ndarray):
        self.name = name = repr(batch)
        m, add = batch.count, scene.memory.field
        self.state, self.slots, self.w, self.real, self.arity = scene.state, scene.slots, scene.state.w, scene.real, batch.arity
        self.corners = batch.members.bind(scene, batch, batch.quantity.origin)
        self.equation = Equation(scene, batch, self.corners, start)
        self.spring, self.strength, self.limit = self.equation.spring, self.equation.strength, self.equation.limit
        self.quantity, self.drive, self.side = self.equation.quantity, self.equation.drive, batch.side
        rows = scene.slots.rows(batch)
        self.in_system, self.has_outside = bool((rows >= 0).any()), bool((rows < 0).any())
        if self.in_system:
            self.row = add(f"{name}.row", m, kind=ti.i32, values=rows)
        self.answers_in_system = self.in_system and scene.slots.system.answers
        if self.answers_in_system:
            self.before = add(f"{name}.before", m)  # f - rest before places
        self.converges = batch.solvable_together and (self.in_system or bool(scene.slots.semi_iteration))
        if self.converges:
            self.inverse_size = add(f"{name}.close", m, values=batch.inverse_size(batch.start.position))
        alone = self.converges and scene.slots.semi_iteration and self.has_outside
        self.semi_iterates = bool(alone and not (self.side or batch.driven))
        if self.semi_iterates:
            self.step = add(f"{name}.step", m)
        self.impacts: Any = scene.impacts
        self.stores_left = bool(self.impacts) and self.impacts.leaves  # extra passes leave what the regular ones left
        if self.stores_left:
            self.left = add(f"{name}.left", m)  # the violation that the regular passes of the substep left

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Move each corner by w_j dlam grad_j C. In a system, fill in the row: dlam comes from there."""
        if ti.static(self.equation.ramp.is_allocated):
            if first != 0:
                self.equation.ramp.update_rest(c, frame_fraction)
        share = frame_fraction[2]
        violation, A, alpha, lam, W, n, g, turn, moved = self.linearise(c, h, h2_effective, share, first, fresh)
        step = ti.cast(1, self.real)
        if ti.static(bool(self.impacts)):
            if self.impacts.is_extra_pass():
                violation -= self.violation_left(c, violation, lam, g, h)
                W, g = self.held_by_walls(c, W, n, g)
        if ti.static(self.in_system):
            if self.row[c] >= 0:
                self.fill_row(c, violation, A, alpha, lam, W, n, g, turn, moved, share)
        if ti.static(self.has_outside):
            if self.is_outside_systems(c):
                step = self.relax_alone(c, violation, A, alpha, lam, W, n, turn, share, first)
        for k in ti.static(range(self.arity)):
            self.corners.write_move(c, k, self.w[self.corners.member(c, k)] * step * n[k, :])

    @ti.func
    def linearise(self, c, h, h2_effective, share, first, fresh):
        """Compute what every solver needs of constraint c in a pass. It writes no state but the memory of soft constraints.

        Returns the violation A C + B + alpha' lam, A, alpha', lam, the mass-split weight W (0: no corner can move), directions n
        and gradients g, both (arity, dim), how far it turned, see Slots.record_turn (n is g where too far), and C_(n+1) - C_n.
        """
        now, start = self.corners.now_and_start(c)
        if first != 0:
            self.quantity.start_substep(c, now, start, fresh)
        f, g = self.quantity.measure(c, now)
        f0, n = self.quantity.measure(c, start)
        f0 = self.quantity.unwrap(f0, self.equation.rest[c])
        f = self.quantity.unwrap(f, f0)
        w = ti.cast(0, self.real)  # sum of w |grad|^2; the next three with split masses, of g . n, g . g, n . n
        both, here, there = ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real)
        for k in ti.static(range(self.arity)):
            i = self.corners.member(c, k)
            gg, split = g[k, :].dot(g[k, :]), self.slots.split[i]
            w += self.w[i] * gg
            both += split * g[k, :].dot(n[k, :])
            here += split * gg
            there += split * n[k, :].dot(n[k, :])
        turn = self.slots.classify_turn(both, ti.sqrt(here) * ti.sqrt(there))  # here * there may be out of the range of f32
        lost = turn == FAR
        if self.equation.has_cusp(c):
            lost, turn = True, 0
        if ti.static(self.converges):
            tight = self.spring.is_rigid(c)
            if ti.static(self.in_system):
                tight = tight and self.row[c] >= 0
            if tight:
                lost = lost or ti.abs(self.equation.clip_to_side(f0 - self.equation.rest[c])) * self.inverse_size[c] > LOST
        if lost:
            resolved = False
            if ti.static(self.spring.soft):
                resolved = self.spring.alpha[c] >= RESOLVED * here * h2_effective
            if resolved:
                both = ti.max(both, here / RESOLVED)  # positive, and small compared with alpha'
                if self.quantity.is_radial(c):
                    turn = 0
            else:
                n, both = g, here
        if ti.static(self.equation.driven):
            if first != 0:
                alpha = ti.cast(0, self.real)
                if ti.static(self.spring.soft):
                    alpha = self.spring.alpha[c]
                self.equation.rest[c] = self.drive.advance(
                    c, f0, self.side, ti.max(here, both), alpha, self.equation.lam[c], h, h2_effective,
                    self.equation.residual_scale(c),
                )  # fmt: skip
            f0 = self.quantity.unwrap(f0, self.equation.rest[c])
            f = self.quantity.unwrap(f, f0)
        if ti.static(self.equation.answers):
            if first != 0 and self.is_row(c):
                self.equation.remember(c, f0)
        violation, A, alpha, lam, W = self.equation.terms(c, f, f0, w, both, h, h2_effective, first, fresh)
        if ti.static(self.limit.acts):
            violation -= A * self.equation.postpone(c, f0, W, share, first)
        return violation, A, alpha, lam, W, n, g, turn * ti.cast(self.quantity.direction_reliable(f, f0), ti.i32), f - f0

    @inline
    def is_row(self, c):
        """Whether contacts relax constraint c as a row of theirs."""
        return at(self.row, c) < 0 if self.answers_in_system else always()

    @ti.func
    def note_bend(self, c, bodies: ti.template()):  # type: ignore[valid-type]
        """Tell the system how far impulses of contacts turn constraint c; too far if they act for a part of the substep only."""
        row = self.row[c]
        if row >= 0:
            most = ti.cast(0, self.real)
            for k in ti.static(range(self.arity)):
                i = self.corners.member(c, k)
                most = ti.max(most, self.answered_move(c, k, bodies).norm_sqr())
                most = ti.select(bodies.rows.when_of(i) > 0, ti.math.inf + most, most)
            self.slots.system.note_bend(row, most * self.inverse_size[c] * self.inverse_size[c])

    @ti.func
    def bend_answer(self, c, bodies: ti.template()):  # type: ignore[valid-type]
        """Give the system the violation of constraint c where impulses of contacts move its corners."""
        row = self.row[c]
        if row >= 0:
            if self.slots.system.bends(row):
                q, moves = self.corners.relative_positions(c, 0), False
                for k in ti.static(range(self.corners.first, self.arity)):
                    move = self.answered_move(c, k, bodies)
                    moves = moves or (move != 0).any()
                    for a in ti.static(range(self.state.dim)):
                        q[k, a] += move[a]
                if moves:
                    f, _g = self.quantity.remeasure(c, q)
                    excess = self.quantity.excess(c, self.quantity.unwrap(f, self.equation.rest[c]))
                    self.slots.system.gap[row] = excess - self.equation.left[c]

    @ti.func
    def answered_move(self, c, k, bodies: ti.template()):  # type: ignore[valid-type]
        """Return how far impulses of contacts move corner k of constraint c [m], relative to its first one if positions are."""
        j = self.corners.member(c, k)
        move = bodies.new[j] - self.state.d[j]
        if ti.static(self.corners.first > 0):
            i = self.corners.member(c, 0)
            move -= bodies.new[i] - self.state.d[i]
        return move

    @ti.func
    def excess_now(self, c):
        """Return f - rest of constraint c at the present positions."""
        f, _g = self.measured(c, 0)
        return self.quantity.excess(c, self.quantity.unwrap(f, self.equation.rest[c]))

    @ti.func
    def begin_places(self, c):
        """Before places move anything, note where impulses have left constraint c."""
        if self.row[c] >= 0:
            self.before[c] = self.excess_now(c)

    @ti.func
    def end_places(self, c):
        """After a pass of places, note by how much they have left constraint c violated, beyond rounding."""
        row = self.row[c]
        if row >= 0:
            left = ti.cast(self.slots.system.left[row], self.real) + (self.excess_now(c) - self.before[c])
            extent = self.corners.relative_positions(c, 0)[self.corners.first, :].norm()
            digits = self.state.digits_of_difference(self.corners.member(c, 0), extent)
            if ti.abs(left) * self.inverse_size[c] * extent <= digits or not self.slots.system.bears(row):
                left = 0 * left
            self.equation.left[c] = left

    @ti.func
    def end_answer(self, c, rows: ti.template()):  # type: ignore[valid-type]
        """Add what the system answered to the impulses of contacts to the multiplier."""
        if self.row[c] >= 0:
            weight, slight = ti.cast(0, self.real), ti.cast(0, self.real)
            for k in ti.static(range(self.arity)):
                i, place = self.corners.member(c, k), self.corners.places[c][k]
                if place >= 0:
                    g = self.slots.system.gradient[place]
                    weight += self.w[i] * g.dot(g)
                    slight += g.norm() * rows.kick(i).norm()
            mu = ti.cast(self.slots.system.answer[self.row[c]], self.real)
            self.equation.take_answer(c, mu, rows.scale[None] * self.equation.answered[c], weight, slight, rows)

    @ti.func
    def motion(self, c, n, together):
        """Return, for constraint c along n, the motion u, the weight W, the largest move of a corner, and its largest motion.

        u: in this substep, relative to the rest value where that moves. W: mass-split. Largest move: by a multiplier of 1.
        Largest motion of a corner: squared. Motions are relative to the first corner.
        together: 1 where masses are split among all constraints, though some are solved together.
        """
        u, W, longest, fastest = ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real)
        for k in ti.static(range(self.arity)):
            i = self.corners.member(c, k)
            j, split = self.corners.member(c, 0), self.slots.split[i]
            move = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
            if together != 0:
                split = self.w[i] * (self.slots.begin[i + 1] - self.slots.begin[i])
            u += n[k, :].dot(move)
            W += split * n[k, :].dot(n[k, :])
            longest = ti.max(longest, self.w[i] * n[k, :].norm())
            fastest = ti.max(fastest, move.norm_sqr())
        if ti.static(self.equation.driven):
            u -= self.drive.step[c]
        return u, W, longest, fastest

    @ti.func
    def limit_step(self, c, lam, new, n, share, together):
        """Return the multiplier `new`, or one that only removes motion where StepLimit requires it; and whether it is limited."""
        far = False
        if self.spring.is_rigid(c):
            u, W, longest, fastest = self.motion(c, n, together)
            size = self.equation.residual_scale(c)
            trust_radius = self.quantity.trust_radius(self.corners.relative_positions(c, 0))
            new, far = self.limit.limit(c, lam, new, u, W, longest, fastest, trust_radius, size, share)
        return new, far

    @ti.func
    def fill_row(self, c, violation, A, alpha, lam, W, n, g, turn, moved, share):
        """Fill in the row of constraint c, from what linearise() returns. share: of the frame, of the substep."""
        row, start, weight, new = self.row[c], lam, W, lam
        if ti.static(self.limit.acts):
            if W > 0:
                new = self.equation.multiplier_of(c, violation, A, alpha, lam, W)
                new, far = self.limit_step(c, lam, new, n, share, 1)
                new = self.equation.within_bounds(c, new)
                if far:  # its step is fixed, and the others follow: a row without a weight has the step -start
                    start, weight = lam - new, 0 * W
        if ti.static(self.equation.capped):
            low, high = self.equation.bounds(c)
            self.slots.system.bound_row(row, low, high)
        self.slots.system.set_row(row, violation, A, alpha, start, weight, self.geometric_stiffness(c, weight))
        if ti.static(self.answers_in_system):
            self.slots.system.left[row] = self.equation.left[c]
            self.slots.system.at_start[row] = ti.select(self.spring.is_rigid(c), violation - moved, 0 * violation)
        if ti.static(self.slots.system.limits_steps):
            u, split, longest, _ = self.motion(c, n, 0)
            spare, most = ti.math.inf + 0 * u, ti.math.inf + 0 * u
            if split > 0 and self.spring.is_rigid(c):
                spare = 2 * (violation - moved) ** 2 / split
                if ti.static(self.limit.acts):
                    most = TRUST * self.quantity.trust_radius(self.corners.relative_positions(c, 0)) / longest
            self.slots.system.limit_row(row, u, spare, most, lam - new)
        for k in ti.static(range(self.arity)):
            self.slots.system.set_gradient(self.corners.places[c][k], self.corners.member(c, k), g[k, :])
        acts = violation != 0 and W > 0  # False where it is broken
        if ti.static(self.side != 0):  # a slack constraint has a direction, but exerts no force
            acts = W > 0 and (self.side * violation > 0 or lam != 0)
        if acts:
            self.slots.record_turn(turn)

    @ti.func
    def relax_alone(self, c, violation, A, alpha, lam, W, n, turn, share, first):
        """Update the multiplier of constraint c, which belongs to no system. Returns the change."""
        new = self.equation.jacobi_update(c, violation, A, alpha, lam, W, turn)
        if ti.static(self.quantity.collapses > 0):
            move = ti.cast(0, self.real)
            for k in ti.static(range(self.arity)):
                w = self.w[self.corners.member(c, k)]
                move += w * w * n[k, :].dot(n[k, :])
            extent = self.corners.relative_positions(c, 0).norm_sqr()
            new = self.limit.limit_collapse(lam, new, self.equation.rest[c], extent, move)
        step = new - lam
        if ti.static(self.semi_iterates):
            last, wanted = self.step[c], new
            if first != 0:
                last = 0
            if not self.equation.has_cusp(c):  # the last step there had another direction
                wanted = lam + self.slots.semi_iteration.step(last, step)
            step = self.slots.limit_multiplier(wanted, self.geometric_stiffness(c, W / 2)) - lam  # masses in W are split by two
            new = lam + step
        if ti.static(self.limit.acts):
            if W > 0:
                new, _ = self.limit_step(c, lam, new, n, share, 0)
                new = self.equation.within_bounds(c, new)
                step = new - lam
        if ti.static(self.semi_iterates):
            self.step[c] = step
        self.equation.lam[c] = new
        return step

    @ti.func
    def is_firm(self, c, h):
        """Whether a substep h sees constraint c as rigid, or as a spring that vibrates much faster."""
        out = self.spring.is_rigid(c)
        if ti.static(self.spring.soft):
            if not out:
                _, g = self.quantity.measure(c, self.corners.now_and_start(c)[1])
                w, _ = self.weights(c, g)
                out = w > 0 and stiff(self.spring.alpha[c], h, w) > FIRM
        return out

    @ti.func
    def violation_left(self, c, violation, lam, g, h):
        """Return what an extra pass leaves: what regular passes left and walls did not change, and all of it for a spring."""
        out = violation
        if self.is_firm(c, h):
            out = 0 * violation
            if ti.static(self.stores_left):
                if self.impacts.is_first_extra_pass():
                    if ti.static(self.side == 0) or self.side * violation > 0 or lam != 0:
                        out = violation
                        for k in ti.static(range(self.arity)):
                            out -= g[k, :].dot(self.impacts.wall_change(self.corners.member(c, k)))
                    self.left[c] = out
                out = self.left[c]
            if ti.static(self.impacts.exact):
                for k in ti.static(range(self.arity)):  # walls that pull are about to let go
                    out -= g[k, :].dot(self.impacts.release(self.corners.member(c, k)))
        return out

    @ti.func
    def held_by_walls(self, c, W, n, g):
        """Return W and the gradients without the directions in which walls hold corners, unless nothing else can move."""
        free, held, all_of_it = g, 0 * W, 0 * W
        for k in ti.static(range(self.arity)):
            i = self.corners.member(c, k)
            part = self.impacts.held_part(i, g[k, :])
            held += self.slots.split[i] * part.dot(n[k, :])
            all_of_it += self.slots.split[i] * g[k, :].dot(n[k, :])
            for a in ti.static(range(self.state.dim)):
                free[k, a] -= part[a]
        if all_of_it - held > ti.static(HELD) * all_of_it:
            W *= 1 - held / all_of_it
        else:
            free = g
        return W, free

    @ti.func
    def geometric_stiffness(self, c, W):
        """Return (omega h)^2 of the fastest transverse vibration per multiplier: 4 w / l in a chain of links l, where W = 2 w.

        0 for springs of angles in the plane: there an angle is linear in the directions of its links, so its torque makes nothing
        vibrate.
        """
        out = 2 * W * self.inverse_size[c]
        if ti.static(self.quantity.is_angle and self.state.dim == 2):
            if not self.spring.is_rigid(c):
                out *= 0
        if ti.static(self.slots.converges and self.slots.can_soften):  # W contains it
            out /= self.slots.softness[None]
        return out

    @inline
    def is_outside_systems(self, c):
        """Whether constraint c belongs to no system."""
        return at(self.row, c) < 0 if self.in_system else always()

    @ti.func
    def unmet(self, c):
        """Whether constraint c belongs to a system that takes another Newton step."""
        return self.row[c] >= 0 and self.slots.system.is_unmet(self.row[c])

    @ti.func
    def update_multiplier(self, c, first):
        """Add the step that the system found to the multiplier."""
        if ti.static(self.in_system):
            row = self.row[c]
            if row >= 0:
                step = ti.cast(self.slots.system.step[row], self.real)
                if first != 0:
                    self.equation.lam[c] = step
                else:
                    self.equation.lam[c] = self.equation.lam[c] + step
                if ti.static(self.answers_in_system):
                    self.equation.left[c] = ti.cast(self.slots.system.left[row], self.real)

    @ti.func
    def push_spring_force(self, c, h, soft, alone):
        """Push h^2 w_j F grad_j C, F of Equation.spring_force(); for rigid links, F is the load that they know."""
        f, g = self.measured(c, 0)
        f = self.quantity.unwrap(f, self.equation.rest[c])
        w, W = self.weights(c, g)
        f0 = f
        if ti.static(self.spring.damped):
            f0, _ = self.measured(c, 1)
        if alone == 0 or not self.is_outside_systems(c):
            W = w
        force = self.equation.spring_force(c, f, self.quantity.unwrap(f0, f), w, W, h, soft)
        for k in ti.static(range(self.arity)):
            self.corners.write_move(c, k, h * h * self.w[self.corners.member(c, k)] * force * g[k, :])

    @ti.func
    def note_spring_turn(self, c):
        """Record how far a spring turned. A spring that passes through 0 is left out: one without rest length, or is_radial()."""
        passes = self.quantity.is_radial(c)
        if ti.static(self.equation.cusp):
            passes = passes or self.equation.rest[c] == 0
        if not (self.spring.is_rigid(c) or passes):
            f, g = self.measured(c, 0)
            f0, n = self.measured(c, 1)
            if self.quantity.direction_reliable(f, f0):
                self.slots.record_turn(self.slots.classify_turn((g * n).sum(), g.norm() * n.norm()))

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push h^2 w_j F grad_j C, with F of Equation.reaction(); nothing if the multiplier contains an impact, which is over."""
        f, g = self.measured(c, 0)
        w, W = ti.cast(0, self.real), ti.cast(0, self.real)
        if ti.static(self.spring.soft):
            f = self.quantity.unwrap(f, self.equation.rest[c])
            w, W = self.weights(c, g)
        pull = self.equation.reaction(c, f, w, W, h, firm, soft)
        if ti.static(bool(self.impacts)):
            if self.spring.is_rigid(c):
                for k in ti.static(range(self.arity)):
                    pull *= ti.select(self.impacts.reached[self.corners.member(c, k)] != 0, 0 * pull, 1 + 0 * pull)
        for k in ti.static(range(self.arity)):
            self.corners.write_move(c, k, self.w[self.corners.member(c, k)] * pull * g[k, :])

    @ti.func
    def overload(self, c, h2_rigid, h2_effective):
        """Return by how much the load, summed over substeps, is too large, see Strength."""
        lam, w, out = self.equation.lam[c], ti.cast(0, self.real), ti.cast(0, self.real)
        if ti.static(self.spring.soft):
            if h2_rigid > h2_effective:
                w, _ = self.weights(c, self.measured(c, 0)[1])
        per_newton = self.spring.multiplier_per_newton(c, w, h2_rigid, h2_effective)
        if self.strength.is_intact(c):
            past, unsure = self.strength.add_excess(c, c, lam, per_newton), 0 * lam
            if past > 0:
                _, g = self.measured(c, 0)
                for k in ti.static(range(self.arity)):
                    if g[k, :].norm() > 0:
                        rounding = self.strength.rounding(c, self.corners.member(c, k), self.corners.member(c, 0))
                        unsure = ti.max(unsure, rounding / g[k, :].norm())
                if past > unsure:
                    out = self.strength.overload_by(c, past, per_newton)
        return out

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """Return the violation that is left, relative to the rest value (to the batch's mean f where that is 0).

        W is computed from the current gradients alone: it cancels, unless the multiplier is bounded. Without gradients no pass
        reduces the violation, so all of it is left; a spring correctly exerts no force there.
        """
        f, g = self.measured(c, 0)
        f = self.quantity.unwrap(f, self.equation.rest[c])
        w, W = self.weights(c, g)
        free = ti.cast(0, self.real)
        for k in ti.static(range(self.arity)):
            free += self.w[self.corners.member(c, k)]
        left = self.equation.left_violation(c, f, w, W, h, h2_effective, fresh)
        if g.norm_sqr() == 0 and free > 0 and self.strength.is_intact(c):
            if ti.static(self.quantity.collapses > 0) or self.spring.is_rigid(c):
                left = ti.abs(self.equation.clip_to_side(f - self.equation.rest[c]))
        return left / self.equation.residual_scale(c)

    @ti.func
    def softening(self, c, h2_effective, residual):
        """Return the work of the load on what is left of the violation, and on what compliance gives."""
        return self.equation.softening(c, h2_effective, residual)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Return the energy of the constraint's spring."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.spring.soft):
            if self.equation.stores_energy(c):
                f, _ = self.measured(c, back)
                w, _ = self.weights(c, self.measured(c, 0)[1])
                out = self.equation.energy(c, f, w, h2_effective, residual)
        return out

    @ti.func
    def measured(self, c, back):
        """Return f of constraint c and its gradients at x - back d."""
        return self.quantity.remeasure(c, self.corners.relative_positions(c, back))

    @ti.func
    def weights(self, c, g):
        """Return sum_j w_j |g_j|^2 of constraint c with gradients g, and the same with split masses."""
        w, W = ti.cast(0, self.real), ti.cast(0, self.real)
        for k in ti.static(range(self.arity)):
            i, gg = self.corners.member(c, k), g[k, :].dot(g[k, :])
            w += self.w[i] * gg
            W += self.slots.split[i] * gg
        return w, W
