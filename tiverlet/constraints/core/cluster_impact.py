"""Impacts of rigid clusters on walls: the cluster leaves as a rigid body, by Newton's law, see BodyImpacts."""

from typing import Any

from ...device import ti
from ...features.material import limit_length
from ...geometry import rotation

SWEEPS = 64  # over the particles that were struck, at most
FIXED = 2.0**20  # mass of a particle that cannot move, in masses of its cluster: such a cluster turns about it
TURNS = 1 / 4  # of a push: the radius of gyration that it sees at least; a thinner body would turn by more than 2 rad
MET = 2.0**-12  # of the first push: a smaller change ends the sweeps


class ClusterImpact:
    """In extra passes: moves a cluster as a rigid body, by the pushes on its particles that struck walls.

    A push p along n [m] of a particle of mass m at r from the center moves the body by V += m p n / M, and turns it by
    W += I^-1 (r x m p n). So it adds k p to the normal displacement there, k = m (1 / M + (r x n) . I^-1 (r x n)). Particles take
    turns, p' = max(p + miss / k, 0), and their friction likewise across n, until all have what they are to have. The cluster
    keeps the deformation that loads have left in it.

    The path of a particle bends as the body turns by T in a substep, and d is a chord: with b = n.(T x (T x r)) / 2 the particle
    came at d.n + b before the substep and leaves at d.n - b after it. Newton's law holds for these velocities, along tangents,
    and so energy is conserved to second order at e = 1; with chords it would grow.

    cluster: the ClusterPasses. impacts: the BodyImpacts.
    """

    def __init__(self, cluster: Any, impacts: Any):
        self.cluster, self.corners, self.impacts = cluster, cluster.corners, impacts
        self.state, self.real = cluster.state, cluster.real

    @ti.func
    def strike(self, c):
        """Write the moves of the corners of cluster c."""
        begin, end, hit = self.corners.starts[c], self.corners.starts[c + 1], False
        for e in range(begin, end):
            i = self.corners.members[e]
            hit = hit or (self.impacts.in_cluster(i) and self.impacts.struck[i] != 0)
        if hit:
            self.move_as_body(c, begin, end)
        else:
            self.corners.rest(c)

    @ti.func
    def move_as_body(self, c, begin, end):
        """Push the particles of cluster c that struck, and write the moves of all of its corners."""
        i0, M, center = self.corners.reference_particle(c), ti.cast(0, ti.f64), self.cluster.zero_vector()
        start, far = self.cluster.zero_vector(), ti.cast(0, ti.f64)
        S = center.outer_product(center)
        for e in range(begin, end):
            m, r = self.cluster.mass_of(e, c, FIXED), self.cluster.relative_position(e, i0, 1)
            M += m
            start += m * r
            center += m * self.cluster.relative_position(e, i0, 0)
            S += m * r.outer_product(r)
            if self.impacts.struck[self.corners.members[e]] != 0:
                far = ti.max(far, ti.static(TURNS) * self.impacts.first_push[self.corners.members[e]])
            self.count_push(e, -1)
        start, center = start / M, center / M
        S -= M * start.outer_product(start)
        V = 0 * center
        W, off = 0 * rotation.axial(S), True
        turn = self.turn_so_far(c, begin, end, i0, start, S)
        self.aim_along_tangents(begin, end, i0, start, turn)
        for k in ti.static(range(self.state.dim)):
            S[k, k] += M * far * far
        J = rotation.inverse_inertia(S)
        if ti.static(self.impacts.rubs):
            for e in range(begin, end):  # begin with the pushes of the last substep
                i = self.corners.members[e]
                if self.impacts.is_struck_now(i):
                    s = self.cluster.relative_position(e, i0, 1) - start
                    self.impacts.pushed[i], self.impacts.held[i] = self.impacts.pushed_before[i], self.impacts.braked[i]
                    change = ti.cast(self.impacts.pushed[i] * self.impacts.normal[i] - self.impacts.held[i], ti.f64)
                    push = self.cluster.mass_of(e, c, FIXED) * change
                    V += push / M
                    W += J @ rotation.axial(push.outer_product(s))
        for _ in range(SWEEPS):
            if off:
                off = False
                for e in range(begin, end):
                    i = self.corners.members[e]
                    if self.impacts.struck[i] != 0:
                        r, s = self.cluster.relative_position(e, i0, 0) - center, self.cluster.relative_position(e, i0, 1) - start
                        push, change = self.corrected_push(i, r, s, V, W, turn, M, J, self.cluster.mass_of(e, c, FIXED))
                        V += push / M
                        W += J @ rotation.axial(push.outer_product(s))
                        off = off or change > ti.static(MET) * self.impacts.first_push[i]
        T = rotation.cayley(W, S)
        for e in range(begin, end):
            i, r = self.corners.members[e], self.cluster.relative_position(e, i0, 0) - center
            move = ti.cast(V + T @ r - r, self.real)
            self.cluster.pull[e] = self.cluster.pull[e] + move
            self.count_push(e, 1)
            if self.impacts.struck[i] != 0:
                s = self.cluster.relative_position(e, i0, 1) - start
                self.impacts.bend[i] = ti.cast(rotation.bend(turn + W, s, ti.cast(self.impacts.normal[i], ti.f64)), self.real)
                self.impacts.note_slip(i, self.state.d[i] + move)
            self.impacts.mark_struck_in_cluster(i)
            self.corners.write_move(e, move)
        rotation.write_rows(self.cluster.pose, c, T @ rotation.from_rows(self.cluster.pose[c]))

    @ti.func
    def turn_so_far(self, c, begin, end, i0, start, S):
        """Return how far cluster c has turned in this substep."""
        X = 0 * S
        for e in range(begin, end):
            s = self.cluster.relative_position(e, i0, 1)
            d = self.cluster.relative_position(e, i0, 0) - s
            X += self.cluster.mass_of(e, c, FIXED) * d.outer_product(s - start)
        return rotation.turn_rate(S, rotation.axial(X))

    @ti.func
    def aim_along_tangents(self, begin, end, i0, start, turn):
        """Make the targets of particles that strike walls in this pass those of tangents, where the body turns by `turn`."""
        for e in range(begin, end):
            i = self.corners.members[e]
            if self.impacts.is_struck_now(i):
                target, r = ti.cast(self.impacts.target[i], ti.f64), self.cluster.relative_position(e, i0, 1) - start
                b = rotation.bend(turn, r, ti.cast(self.impacts.normal[i], ti.f64))
                before = target - ti.cast(self.impacts.first_push[i], ti.f64) - 2 * b  # d.n before the substep, -target / e
                if target > 0 and before < 0:
                    self.impacts.target[i] = ti.cast(target * ti.max(1 + b / before, 0), self.real)

    @ti.func
    def corrected_push(self, i, r, s, V, W, turn, M, J, m):
        """Correct the push of particle i. Returns the change of its impulse, times the substep, and how much the push changed."""
        n, p = ti.cast(self.impacts.normal[i], ti.f64), self.impacts.pushed[i]
        d = ti.cast(self.state.d[i] - self.impacts.moved[i], ti.f64) + V + rotation.moved_by(W, r)
        miss = ti.cast(self.impacts.target[i], ti.f64) + rotation.bend(turn + W, s, n) - d.dot(n)
        self.impacts.pushed[i] = ti.max(p + ti.cast(miss / (m * self.give(s, n, M, J)), self.real), 0)
        push = ti.cast(self.impacts.pushed[i] - p, ti.f64) * n
        if ti.static(self.impacts.rubs):
            across = d - d.dot(n) * n
            slip = across.norm()
            if self.impacts.coefficients[i][0] > 0 and slip > 0:
                last = ti.cast(self.impacts.held[i], ti.f64)
                held = last + across / (m * self.give(s, across / slip, M, J))
                most = self.impacts.friction_bound(i, ti.cast(held, self.real)) * self.impacts.pushed[i]
                held = limit_length(held, ti.cast(most, ti.f64), ti.cast(most, ti.f64))
                self.impacts.held[i] = ti.cast(held, self.real)
                push -= held - last
        return m * push, ti.abs(self.impacts.pushed[i] - p)

    @ti.func
    def give(self, r, n, M, J):
        """Return the displacement along n, at r from the center, for an impulse times the substep of 1 there: k / m. J: I^-1."""
        arm = rotation.axial(n.outer_product(r))
        return 1 / M + arm.dot(J @ arm)

    @ti.func
    def count_push(self, e, sign):
        """Add `sign` times the push on corner e where pushes of walls are summed up; it is no load of the cluster."""
        i = self.corners.members[e]
        if self.impacts.struck[i] != 0:
            push = sign * (self.impacts.pushed[i] * self.impacts.normal[i] - self.impacts.held[i])
            self.cluster.pull[e] = self.cluster.pull[e] - push
            self.impacts.log_push(i, push)
