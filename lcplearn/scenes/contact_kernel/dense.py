"""Small linear systems."""

from math import sqrt

from lcplearn.scenes.contact_gradient import RANK
from lcplearn.scenes.contact_kernel.compiling import compiled

SWEEPS = 30  # of Jacobi's rotations; about 8 are needed
SINGULAR = 1e-10  # pivots below this, of rows whose largest entry is 1, are those of redundant contacts


@compiled
def factorise(A, scales, order, n):
    """LU in place with row pivoting, of A with rows of largest entry 1; whether all pivots are well above 0."""
    for i in range(n):
        largest = 0.0
        for j in range(n):
            largest = max(largest, abs(A[i, j]))
        if not largest > 0.0:
            return False
        order[i], scales[i] = i, 1.0 / largest
        for j in range(n):
            A[i, j] *= scales[i]
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(A[i, j]) > abs(A[best, j]):
                best = i
        if not abs(A[best, j]) > SINGULAR:
            return False
        if best != j:
            order[j], order[best] = order[best], order[j]
            for k in range(n):
                A[j, k], A[best, k] = A[best, k], A[j, k]
        inverse = 1.0 / A[j, j]
        for i in range(j + 1, n):
            factor = A[i, j] * inverse
            A[i, j] = factor
            for k in range(j + 1, n):
                A[i, k] -= factor * A[j, k]
    return True


@compiled
def solve(A, scales, order, n, b, x):
    """x of A x = b, with A as `factorise` left it."""
    for i in range(n):
        total = scales[order[i]] * b[order[i]]
        for k in range(i):
            total -= A[i, k] * x[k]
        x[i] = total
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= A[i, k] * x[k]
        x[i] = total / A[i, i]


@compiled
def solve_transposed(A, scales, order, n, b, x):
    """x of A' x = b, with A as `factorise` left it; b is overwritten."""
    for i in range(n):
        for k in range(i):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
    for i in range(n):
        x[order[i]] = b[i] * scales[order[i]]


@compiled
def rotate_apart(A, V, n):
    """One-sided Jacobi rotations V, in place: A' V has orthogonal columns, the rows of A."""
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        turned = False
        for i in range(n - 1):
            for j in range(i + 1, n):
                a = c = d = 0.0
                for k in range(n):
                    a += A[i, k] * A[i, k]
                    c += A[j, k] * A[j, k]
                    d += A[i, k] * A[j, k]
                if not abs(d) > 1e-15 * sqrt(a * c):
                    continue
                turned = True
                zeta = (c - a) / (2.0 * d)
                t = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta))
                cosine = 1.0 / sqrt(1.0 + t * t)
                sine = cosine * t
                for k in range(n):
                    A[i, k], A[j, k] = cosine * A[i, k] - sine * A[j, k], sine * A[i, k] + cosine * A[j, k]
                    V[i, k], V[j, k] = cosine * V[i, k] - sine * V[j, k], sine * V[i, k] + cosine * V[j, k]
        if not turned:
            break


@compiled
def smallest_solution(A, V, n, b, x):
    """The smallest x of least |A' x - b|, with A and V as `rotate_apart` left them."""
    largest = 0.0
    for i in range(n):
        size = 0.0
        for k in range(n):
            size += A[i, k] ** 2
        largest = max(largest, size)
        x[i] = 0.0
    for i in range(n):
        size = along = 0.0
        for k in range(n):
            size += A[i, k] ** 2
            along += A[i, k] * b[k]
        if size > RANK * RANK * largest:
            for k in range(n):
                x[k] += V[i, k] * along / size
