"""Rotations in compiled steps of bodies, forwards and backwards; as `space.py` and `spatial_body.py` have them.

The notation x_ is the gradient with respect to x.
"""

from math import cos, sin, sqrt

from lcplearn.scenes.contact_kernel.compiling import compiled

SMALL = 1e-8  # squared half angle below which series are exact; as in space.py


@compiled
def rotation(q, R):
    """The matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@compiled
def rotation_back(x, R_, x_):
    """Backwards through the rotation matrix; adds to x_[3:7]."""
    w, x0, y, z = x[3], x[4], x[5], x[6]
    x_[3] += 2.0 * (
        z * (R_[1, 0] - R_[0, 1]) + y * (R_[0, 2] - R_[2, 0]) + x0 * (R_[2, 1] - R_[1, 2])
    )  # fmt: skip
    x_[4] += 2.0 * (
        y * (R_[0, 1] + R_[1, 0]) + z * (R_[0, 2] + R_[2, 0]) + w * (R_[2, 1] - R_[1, 2])
        - 2.0 * x0 * (R_[1, 1] + R_[2, 2])
    )  # fmt: skip
    x_[5] += 2.0 * (
        x0 * (R_[0, 1] + R_[1, 0]) + z * (R_[1, 2] + R_[2, 1]) + w * (R_[0, 2] - R_[2, 0])
        - 2.0 * y * (R_[0, 0] + R_[2, 2])
    )  # fmt: skip
    x_[6] += 2.0 * (
        x0 * (R_[0, 2] + R_[2, 0]) + y * (R_[1, 2] + R_[2, 1]) + w * (R_[1, 0] - R_[0, 1])
        - 2.0 * z * (R_[0, 0] + R_[1, 1])
    )  # fmt: skip


@compiled
def turn(q, w, dt):
    """q exp(dt w), of norm 1."""
    a, b, c = dt * w[0], dt * w[1], dt * w[2]
    square = (a * a + b * b + c * c) / 4.0
    half = sqrt(square)
    if square < SMALL:
        cosine, sinc = 1.0 - square / 2.0, 1.0 - square / 6.0
    else:
        cosine, sinc = cos(half), sin(half) / half
    a, b, c = sinc * a / 2.0, sinc * b / 2.0, sinc * c / 2.0
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    q[0] = w0 * cosine - (x0 * a + y0 * b + z0 * c)
    q[1] = w0 * a + cosine * x0 + (y0 * c - z0 * b)
    q[2] = w0 * b + cosine * y0 + (z0 * a - x0 * c)
    q[3] = w0 * c + cosine * z0 + (x0 * b - y0 * a)
    norm = sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= norm


@compiled
def turn_back(x, after, v, dt, after_, v_, x_):
    """Backwards through q' = q exp(dt w) / |q|: adds to v_ [6] and writes x_[3:7]."""
    a, b, c = dt * v[3], dt * v[4], dt * v[5]
    square = (a * a + b * b + c * c) / 4.0
    if square < SMALL:
        cosine, sinc, slope = 1.0 - square / 2.0, 1.0 - square / 6.0, -1.0 / 6.0 + square / 60.0
    else:
        half = sqrt(square)
        cosine, sinc = cos(half), sin(half) / half
        slope = (cosine - sinc) / (2.0 * square)
    a, b, c = sinc * a / 2.0, sinc * b / 2.0, sinc * c / 2.0
    w0, x0, y0, z0 = x[3], x[4], x[5], x[6]
    norm, along = sqrt(w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0), 0.0
    for i in range(4):
        along += after[3 + i] * after_[3 + i]
    u0, u1, u2, u3 = (
        (after_[3] - after[3] * along) / norm, (after_[4] - after[4] * along) / norm,
        (after_[5] - after[5] * along) / norm, (after_[6] - after[6] * along) / norm,
    )  # fmt: skip
    x_[3] = u0 * cosine + u1 * a + u2 * b + u3 * c
    x_[4] = -u0 * a + u1 * cosine - u2 * c + u3 * b
    x_[5] = -u0 * b + u1 * c + u2 * cosine - u3 * a
    x_[6] = -u0 * c - u1 * b + u2 * a + u3 * cosine
    e0 = w0 * u0 + x0 * u1 + y0 * u2 + z0 * u3
    e1 = -x0 * u0 + w0 * u1 + z0 * u2 - y0 * u3
    e2 = -y0 * u0 - z0 * u1 + w0 * u2 + x0 * u3
    e3 = -z0 * u0 + y0 * u1 - x0 * u2 + w0 * u3
    turning = dt * (v[3] * e1 + v[4] * e2 + v[5] * e3)
    radial = (-sinc * e0 + slope * turning) / 4.0
    v_[3] += dt * (sinc * e1 / 2.0 + radial * dt * v[3])
    v_[4] += dt * (sinc * e2 / 2.0 + radial * dt * v[4])
    v_[5] += dt * (sinc * e3 / 2.0 + radial * dt * v[5])


@compiled
def midpoint_spin(w, inertia, dt):
    """As in spatial_body.py, in place; the 3 x 3 systems by Cramer's rule."""
    i0, i1, i2 = inertia[0], inertia[1], inertia[2]
    h = dt / 2.0
    x, y, z = w[0], w[1], w[2]
    for _ in range(4):
        e0 = i0 * (x - w[0]) + h * (i2 - i1) * y * z
        e1 = i1 * (y - w[1]) + h * (i0 - i2) * z * x
        e2 = i2 * (z - w[2]) + h * (i1 - i0) * x * y
        a, b, c = i0, h * (i2 - i1) * z, h * (i2 - i1) * y
        d, e, f = h * (i0 - i2) * z, i1, h * (i0 - i2) * x
        g, k, m = h * (i1 - i0) * y, h * (i1 - i0) * x, i2
        determinant = a * (e * m - f * k) - b * (d * m - f * g) + c * (d * k - e * g)
        x -= (e0 * (e * m - f * k) - b * (e1 * m - f * e2) + c * (e1 * k - e * e2)) / determinant
        y -= (a * (e1 * m - f * e2) - e0 * (d * m - f * g) + c * (d * e2 - e1 * g)) / determinant
        z -= (a * (e * e2 - e1 * k) - b * (d * e2 - e1 * g) + e0 * (d * k - e * g)) / determinant
    w[0], w[1], w[2] = 2.0 * x - w[0], 2.0 * y - w[1], 2.0 * z - w[2]


@compiled
def spin_back(spin, free_spin, inertia, dt, torque, free_, x_, inertia_):
    """Backwards through the implicit midpoint step: writes x_[10:13], adds to inertia_."""
    h = dt / 2.0
    m0, m1, m2 = (
        (spin[0] + free_spin[0] - dt * torque[0] / inertia[0]) / 2.0,
        (spin[1] + free_spin[1] - dt * torque[1] / inertia[1]) / 2.0,
        (spin[2] + free_spin[2] - dt * torque[2] / inertia[2]) / 2.0,
    )
    i0, i1, i2 = inertia[0], inertia[1], inertia[2]
    # the transposed matrix of the residual's derivative
    a, d, g = i0, h * (i2 - i1) * m2, h * (i2 - i1) * m1
    b, e, k = h * (i0 - i2) * m2, i1, h * (i0 - i2) * m0
    c, f, m = h * (i1 - i0) * m1, h * (i1 - i0) * m0, i2
    e0, e1, e2 = 2.0 * free_[3], 2.0 * free_[4], 2.0 * free_[5]
    determinant = a * (e * m - f * k) - b * (d * m - f * g) + c * (d * k - e * g)
    s0 = (e0 * (e * m - f * k) - b * (e1 * m - f * e2) + c * (e1 * k - e * e2)) / determinant
    s1 = (a * (e1 * m - f * e2) - e0 * (d * m - f * g) + c * (d * e2 - e1 * g)) / determinant
    s2 = (a * (e * e2 - e1 * k) - b * (d * e2 - e1 * g) + e0 * (d * k - e * g)) / determinant
    x_[10], x_[11], x_[12] = i0 * s0 - free_[3], i1 * s1 - free_[4], i2 * s2 - free_[5]
    inertia_[0] -= s0 * (m0 - spin[0]) + h * m0 * (s1 * m2 - s2 * m1)
    inertia_[1] -= s1 * (m1 - spin[1]) + h * m1 * (s2 * m0 - s0 * m2)
    inertia_[2] -= s2 * (m2 - spin[2]) + h * m2 * (s0 * m1 - s1 * m0)
