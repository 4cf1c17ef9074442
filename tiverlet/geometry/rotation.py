"""Rotations of clusters, in 2D and 3D: the best fit without reflection, and the rotation of a body in a step.

Stored as (cos, sin) in 2D and as a quaternion (w, x, y, z) in 3D. K = sum mu q s^T relates a shape q to positions s.
"""

import numpy as np

from ..device import ti

STEPS = 16  # Newton iterations at most; from the rotation of the last substep it takes two or three
HEAVY = 1024  # masses of its body: that of a particle that cannot move
LINE = 2.0**-46  # least moment of inertia about an axis, relative to the others: less is rounding of S, and the body a line


def identity(dim: int) -> np.ndarray:
    """Return the identity, as it is stored."""
    return np.eye(1, 2 if dim == 2 else 4)[0]


@ti.func
def matrix(r):
    """Return the matrix of a stored rotation."""
    if ti.static(r.n == 2):
        return ti.Matrix([[r[0], -r[1]], [r[1], r[0]]])
    else:
        w, x, y, z = r[0], r[1], r[2], r[3]
        return ti.Matrix([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip


@ti.func
def compose(a, b):
    """Return rotation b followed by a, normalized."""
    c = 0 * a
    if ti.static(a.n == 2):
        c = ti.Vector([a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]])
    else:
        u, v = ti.Vector([a[1], a[2], a[3]]), ti.Vector([b[1], b[2], b[3]])
        w = a[0] * b[0] - u.dot(v)
        t = a[0] * v + b[0] * u + u.cross(v)
        c = ti.Vector([w, t[0], t[1], t[2]])
    return c / c.norm()


@ti.func
def axial(B):
    """Return sum s x y of B = sum y s^T: one number in 2D, three in 3D."""
    if ti.static(B.n == 2):
        return ti.Vector([B[1, 0] - B[0, 1]])
    else:
        return ti.Vector([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])


@ti.func
def quaternion(step):
    """Return the quaternion of a rotation about `step` by about |step|, not normalized."""
    return ti.Vector([1 + 0 * step[0], step[0] / 2, step[1] / 2, step[2] / 2])


@ti.func
def diagonal(value, like):
    """Return `value` times the unit matrix."""
    out = 0 * like
    for k in ti.static(range(like.n)):
        out[k, k] = value
    return out


@ti.func
def solve_3x3(H, r):
    """Return the solution of H x = r by cofactors, and det H."""
    a, b, c = H[0, :], H[1, :], H[2, :]
    det = a.dot(b.cross(c))
    return (b.cross(c) * r[0] + c.cross(a) * r[1] + a.cross(b) * r[2]) / det, det


@ti.func
def turning_compliance(S, r):
    """Return by how much a unit impulse at r moves that point at most by turning, tr((r x)^T I^-1 (r x)) with I = tr S - S."""
    out = 0 * S[0, 0]
    if ti.static(S.n == 2):
        if S.trace() > 0:
            out = r.dot(r) / S.trace()
    else:
        for k in ti.static(range(3)):
            arm = r.cross(ti.Vector([float(k == 0), float(k == 1), float(k == 2)]))
            out += arm.dot(turn_rate(S, arm))
    return out


@ti.func
def rigid_rotation(S, X):
    """Return the rotation, as a matrix, of a body whose parts move by y: S = sum m r r^T, X = sum m r y^T, about its centre."""
    return skew(turn_rate(S, axial(X.transpose())), S)


@ti.func
def turn_rate(S, moment):
    """Return how fast a body turns with an angular momentum about its center: I^-1 L, for S = sum m r r^T and I = tr S - S.

    A line does not turn about itself: I^-1 = (1 - S / tr S) / tr S across it.
    """
    out, size = 0 * moment, S.trace()
    if size > 0:
        out = moment / size
        if ti.static(S.n == 3):
            whole, det = solve_3x3(diagonal(size, S) - S, moment)
            if det > ti.static(LINE) * size * size * size:
                out = whole
            else:
                out -= S @ out / size
    return out


@ti.func
def inverse_inertia(S):
    """Return the matrix I^-1 of a body with S = sum m r r^T: 1 x 1 in 2D."""
    axes = ti.static(1 if S.n == 2 else 3)
    out = ti.Matrix.zero(ti.f64, axes, axes)
    for k in ti.static(range(axes)):
        L = ti.Vector.zero(ti.f64, axes)
        L[k] = 1
        column = turn_rate(S, L)
        for j in ti.static(range(axes)):
            out[j, k] = column[j]
    return out


@ti.func
def skew(x, like):
    """Return the matrix B with B r = x x r: one number x in 2D, three in 3D."""
    out = 0 * like
    if ti.static(like.n == 2):
        out[1, 0] = x[0]
        out[0, 1] = -x[0]
    else:
        out = ti.Matrix([[0 * x[0], -x[2], x[1]], [x[2], 0 * x[0], -x[0]], [-x[1], x[0], 0 * x[0]]])
    return out


@ti.func
def across(n):
    """Return a vector in the plane, turned by a quarter to the left."""
    return ti.Vector([-n[1], n[0]])


@ti.func
def from_rows(v):
    """Return the square matrix whose rows stand one behind another in a vector."""
    dim = ti.static(2 if v.n == 4 else 3)
    return ti.Matrix([[v[dim * j + k] for k in ti.static(range(dim))] for j in ti.static(range(dim))])


@ti.func
def write_rows(field: ti.template(), i, B):  # type: ignore[valid-type]
    """Write a square matrix to element i of a field, as from_rows() reads it."""
    for j in ti.static(range(B.n)):
        for k in ti.static(range(B.n)):
            field[i][ti.static(B.n * j + k)] = B[j, k]


@ti.func
def bend(turn, r, n):
    """Return how far the path of a point at r of a body bends along n, n.(C + C^T - 2) r / 2 for C = cayley(T)."""
    B = skew(turn, n.outer_product(n))
    return n.dot(B @ (B @ r)) / (2 + turn.dot(turn) / 2)


@ti.func
def moved_by(turn, r):
    """Return (C - 1) r for C = cayley(T), (T x r + T x (T x r) / 2) / (1 + T^2 / 4)."""
    B = skew(turn, r.outer_product(r))
    return B @ (r + B @ r / 2) / (1 + turn.dot(turn) / 4)


@ti.func
def cayley(x, like):
    """Return the matrix of the rotation about x by 2 arctan(|x| / 2), which is |x| to second order."""
    out = 0 * like
    if ti.static(like.n == 2):
        q = x[0] / 2
        out = matrix(ti.Vector([1 - q * q, 2 * q]) / (1 + q * q))
    else:
        q = quaternion(x)
        out = matrix(q / q.norm())
    return out


@ti.func
def newton_step(M, gap, least):
    """Return a rotation vector that closes the gap of axial(M), along it where M is no use; and whether it exceeds `least`."""
    size, step = M.norm(), 0 * gap
    if size > 0:
        step = gap / size
        H = diagonal(M.trace(), M) - M
        if H[0, 0] > 0 and H[0, 0] * H[1, 1] > H[0, 1] * H[1, 0]:
            x, det = solve_3x3(H, gap)
            if det > 1e-6 * size * size * size:
                step = x
    length = step.norm()
    if length > 0.5:
        step *= 0.5 / length
    return step, length > least


@ti.func
def fit(K, kept, least):
    """Return the rotation R that fits best, sum mu |s - R q|^2 least, among rotations without reflection.

    In 2D it has a closed form. In 3D Newton's iteration from `kept` maximises tr(R K) over the quaternions, along the gradient
    where it is not concave (Mueller et al. 2016 use the gradient throughout). Where the fit does not determine the rotation
    (points on a line, in one place, or mirrored with equal axes) R stays as near to `kept` as it can.
    least: the relative size below which a number is rounding.
    """
    r = kept
    if ti.static(kept.n == 2):
        best = ti.Vector([K[0, 0] + K[1, 1], K[0, 1] - K[1, 0]])
        size = best.norm()
        if size > least * K.norm():
            r = best / size
    else:
        going = True
        for _ in range(STEPS):
            if going:
                B = matrix(r) @ K
                step, going = newton_step(B, -axial(B), least)
                r = compose(quaternion(step), r)
    return r


@ti.func
def step_rotation(K, X, U, body, stiff, soft, kept, least, deforms: ti.template()):  # type: ignore[valid-type]
    """Return rotations of a body at the start and at the end of a step, at most 90 degrees apart, and the cosine of that angle.

    At the start, with K = sum mu q s^T, it is the fit R. At the end it is D R, with
        axial((stiff + soft D^T) X - (stiff D + soft) R K + U) = 0,   X = sum mu p s^T of the predicted positions p.
    For a stiff body this means that the moves from positions p to D R q have no moment about the positions s at the start. Then
    it is one step of a free rigid body (Moser and Veselov 1991), and nothing is lost. For a soft body, deformations are first
    turned back into the frame at the start, and U is the moment of the other violation terms (body: given in the body frame).
    deforms: whether anything is soft. A body whose shape is a point does not turn: all of its extent would be deformation.
    """
    start, end, cosine, pull = kept, kept, 1 + 0 * stiff, axial(U)
    if K.norm() == 0:
        soft *= 0
    if ti.static(kept.n == 2):
        # sin(angle) a + cos(angle) b = c
        start = fit(K, kept, least)
        S = matrix(start) @ K
        if body:
            pull = axial(matrix(start) @ U)
        a, b = stiff * S.trace() + soft * X.trace(), stiff * axial(S)[0] - soft * axial(X)[0]
        c = stiff * axial(X)[0] - soft * axial(S)[0] + pull[0]
        size = ti.sqrt(a * a + b * b)
        if size > 0:
            sine = ti.min(ti.max(c / size, -1), 1)
            cosine = ti.sqrt(1 - sine * sine)
            D = ti.Vector([(a * cosine + b * sine) / size, (a * sine - b * cosine) / size])
            end, cosine = compose(D, start), D[0]
    else:
        stage, S = 0, K  # 0: the fit; 1: the rotation of the step; 2: done
        for k in range(2 * STEPS):
            if stage < 2:
                B = matrix(end) @ K
                M, gap = B, -axial(B)
                if stage == 1:
                    gap = stiff * (axial(X) + gap)
                    if ti.static(deforms):
                        Y = matrix(compose(start, inverse(end))) @ X
                        gap += soft * (axial(Y) - axial(S)) + pull
                        M = stiff * B + soft * Y
                step, going = newton_step(M, gap, least)
                end = compose(quaternion(step), end)
                if stage == 0 and (not going or k == STEPS - 1):
                    stage, start, S = 1, end, matrix(end) @ K
                    if ti.static(deforms):
                        if body:
                            pull = axial(matrix(end) @ U)
                elif not going:
                    stage = 2
        D = compose(end, inverse(start))
        if D[0] < 0:
            D = -D
        cosine = 2 * D[0] * D[0] - 1
        if cosine < 0:  # more than 90 degrees
            u = ti.Vector([D[1], D[2], D[3]])
            half = ti.sqrt(0.5 + 0 * cosine)
            u *= half / u.norm()
            end = compose(ti.Vector([half, u[0], u[1], u[2]]), start)
    return start, end, cosine


@ti.func
def inverse(r):
    """Return the inverse of a quaternion."""
    return ti.Vector([r[0], -r[1], -r[2], -r[3]])
