"""A primal-dual interior point, for problems on which pivoting takes exponentially many steps."""

import numpy as np

from lcplearn.lcp.kernel.dense import PARTIAL, factor_call, solve_call
from lcplearn.lcp.kernel.jit import EPS, jit
from lcplearn.lcp.kernel.judging import evaluate


@jit
def interior_point(S, p, A, rows, cols, z, w, omega, r, dz, dw, scratch, cap):
    """Mehrotra predictor-corrector steps from z = w = 1; steps taken. One step length for z and w: S couples them."""
    n = p.size
    z[:] = 1.0
    w[:] = 1.0
    best, since = np.inf, 0
    for iteration in range(cap):
        evaluate(S, p, z, r, omega)
        mu, infeasibility = 0.0, 0.0
        for i in range(n):
            r[i] -= w[i]
            mu += z[i] * w[i] / n
            infeasibility = max(infeasibility, abs(r[i]))
        merit = max(mu, infeasibility)
        if not merit > 50.0 * EPS:
            return iteration
        since += 1
        if merit < 0.5 * best:
            best, since = merit, 0
        if since > 15:  # stalled
            return iteration
        for i in range(n):
            for j in range(n):
                A[i, j] = S[j, i]
            A[i, i] += w[i] / z[i]
        if factor_call(A, n, rows, cols, 0.0, PARTIAL) < n:
            return iteration
        sigma_mu = 0.0
        for corrector in range(2):
            # rows: S dz - dw = -r,  w dz + z dw = sigma mu - z w - dz_aff dw_aff
            for i in range(n):
                scratch[i] = (sigma_mu - (dz[i] * dw[i] if corrector else 0.0)) / z[i] - w[i]
                omega[i] = scratch[i] - r[i]
            solve_call(A, n, n, rows, cols, omega, dz)
            step = np.inf
            for i in range(n):
                dz[i] = omega[i]
                dw[i] = scratch[i] - w[i] / z[i] * dz[i]
                if dz[i] < 0.0:
                    step = min(step, -z[i] / dz[i])
                if dw[i] < 0.0:
                    step = min(step, -w[i] / dw[i])
            if corrector == 0:
                affine = min(1.0, step)
                mu_affine = 0.0
                for i in range(n):
                    mu_affine += (z[i] + affine * dz[i]) * (w[i] + affine * dw[i]) / n
                sigma_mu = (mu_affine / mu) ** 3 * mu
        step = min(1.0, max(0.99, 1.0 - mu) * step)
        if not step > 1e-8:
            return iteration
        for i in range(n):
            z[i] += step * dz[i]
            w[i] += step * dw[i]
    return cap
