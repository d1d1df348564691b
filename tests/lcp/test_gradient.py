"""Derivatives of `solve_lcp`: against finite differences, at kinks, in batches, where blocks are singular."""

import numpy as np
import pytest
import torch
from lcp.oracles import planted, random_family
from torch.autograd import gradcheck, gradgradcheck

from lcplearn import solve_lcp
from lcplearn.benchmark.problems.families import stacked_cubes
from lcplearn.lcp.gradient import adjoint, tangent
from lcplearn.lcp.methods import TORCH_METHODS
from lcplearn.lcp.solution import Status

METHODS = ("pivoting", *(name for name, method in TORCH_METHODS.items() if method.general))
FRICTION = [[1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 0.0]]  # notes 2.5 with mass = dt = 1


def problem(family: str, batch: int = 3, n: int = 5, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    M = random_family(family, batch, n, generator)
    return M.requires_grad_(), planted(M.detach(), generator)[0].requires_grad_()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("family", ["positive definite", "nonsymmetric definite", "nonsymmetric P"])
def test_gradient_of_z_and_w_equals_finite_differences_off_kinks(method, family):
    def z_and_w(M, q):
        return solve_lcp(M, q, method=method)[:2]

    assert gradcheck(z_and_w, problem(family, batch=2, n=4))


def test_gradient_of_the_diagonal_method_equals_finite_differences():
    d = torch.tensor([0.5, 2.0, 3.0]).requires_grad_()
    q = torch.tensor([-1.0, 1.0, -0.3]).requires_grad_()
    assert gradcheck(lambda d, q: solve_lcp(torch.diag(d), q, method="diagonal")[:2], (d, q))


@pytest.mark.parametrize("method", METHODS)
def test_second_derivatives_equal_finite_differences_of_first(method):
    M, q = problem("nonsymmetric definite", batch=2, n=3)
    assert gradgradcheck(lambda M, q: solve_lcp(M, q, method=method)[:2], (M, q))


def test_smoothed_gradient_is_the_derivative_of_the_smoothed_value():
    inputs = problem("nonsymmetric definite", batch=2, n=4)
    assert gradcheck(lambda M, q: solve_lcp(M, q, smoothing=1e-3)[:2], inputs, rtol=1e-5)
    assert gradgradcheck(lambda M, q: solve_lcp(M, q, smoothing=1e-2)[:2], inputs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_forward_mode_agrees_with_reverse_mode(method):
    M, q = (x.detach() for x in problem("nonsymmetric definite"))
    dM, dq = torch.randn_like(M), torch.randn_like(q)
    for smoothing in (0.0, 1e-3) if method == "interior_point" else (0.0,):

        def z_and_w(M, q, smoothing=smoothing):
            return solve_lcp(M, q, method=method, smoothing=smoothing)[:2]

        _, tangents = torch.func.jvp(z_and_w, (M, q), (dM, dq))
        _, pullback = torch.func.vjp(z_and_w, M, q)
        cotangents = tuple(torch.randn_like(q) for _ in range(2))
        gM, gq = pullback(cotangents)
        forward = sum((c * t).sum() for c, t in zip(cotangents, tangents, strict=True))
        torch.testing.assert_close(forward, (gM * dM).sum() + (gq * dq).sum(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_vmap_grad_and_jacrev_see_each_element(method):
    M, q = (x.detach() for x in problem("nonsymmetric definite"))

    def loss(M, q):
        return solve_lcp(M, q, method=method).z.square().sum()

    per_element = torch.func.vmap(torch.func.grad(loss, argnums=(0, 1)))(M, q)
    whole = torch.func.grad(loss, argnums=(0, 1))(M, q)
    torch.testing.assert_close(per_element, whole)
    shared = torch.func.vmap(lambda q: solve_lcp(M[0], q, method=method).z)(q)
    torch.testing.assert_close(shared, solve_lcp(M[0], q, method=method).z)
    jacobian = torch.func.jacrev(lambda q: solve_lcp(M[0], q, method=method).z)(q[0])
    basis = solve_lcp(M[0], q[0], method=method).basis
    expected = torch.zeros(5, 5)
    A = basis.nonzero().squeeze(-1)
    expected[A.unsqueeze(-1), A] = -torch.linalg.inv(M[0][A.unsqueeze(-1), A])
    torch.testing.assert_close(jacobian, expected)


@pytest.mark.parametrize("method", METHODS)
def test_shared_matrix_gets_the_sum_of_the_gradients_of_its_copies(method):
    M, q = problem("nonsymmetric definite")
    shared = M[0].detach().clone().requires_grad_()
    copies = shared.detach().expand(3, 5, 5).clone().requires_grad_()
    for matrix in (shared, copies):
        solve_lcp(matrix, q.detach(), method=method).z.square().sum().backward()
    torch.testing.assert_close(shared.grad, copies.grad.sum(0))


@pytest.mark.parametrize("method", METHODS)
def test_elements_that_are_not_solved_give_zero_gradient_and_spoil_no_neighbour(method):
    M, q = problem("positive definite", batch=4)
    with torch.no_grad():
        M[1, 0, 0], q[2, 3] = torch.nan, torch.inf
        M[3], q[3] = -torch.eye(5), -1.0
    solve_lcp(M, q, method=method).z.sum().backward()
    alone_M, alone_q = M[0].detach().requires_grad_(), q[0].detach().requires_grad_()
    solve_lcp(alone_M, alone_q, method=method).z.sum().backward()
    assert not M.grad[1:].any()
    assert not q.grad[1:].any()
    torch.testing.assert_close(M.grad[0], alone_M.grad)
    torch.testing.assert_close(q.grad[0], alone_q.grad)


@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_computed_for_inputs_that_need_no_gradient(method):
    M, q = problem("positive definite")
    solve_lcp(M.detach(), q, method=method).z.sum().backward()
    assert M.grad is None
    assert q.grad is not None
    assert not solve_lcp(M.detach(), q.detach(), method=method).z.requires_grad
    with torch.no_grad():
        assert not solve_lcp(M, q, method=method).z.requires_grad
    with torch.inference_mode():
        assert solve_lcp(M, q, method=method).solved.all()


@pytest.mark.parametrize("method", ["diagonal", *METHODS])
def test_gradient_at_a_kink_is_the_side_that_stays_at_zero(method):
    """At z = w = 0 the one-sided derivatives of z(q) = max(0, -q) are -1 and 0; the member is not basic, so 0."""
    q = torch.zeros(1).requires_grad_()
    solution = solve_lcp(torch.ones(1, 1), q, method=method)
    assert solution.degenerate.all()
    solution.z.sum().backward()
    assert q.grad == 0


@pytest.mark.parametrize("method", METHODS)
def test_gradient_at_a_coupled_kink_is_one_of_the_one_sided_derivatives(method):
    M = torch.tensor([[2.0, 1.0], [1.0, 2.0]])
    q = torch.tensor([-2.0, -1.0]).requires_grad_()  # z = (1, 0), w = (0, 0)
    solution = solve_lcp(M, q, method=method)
    torch.testing.assert_close(solution.degenerate, torch.tensor([False, True]))
    solution.z.sum().backward()
    h = 1e-6
    slopes = []
    for sign in (1, -1):
        step = torch.tensor([0.0, sign * h])
        slopes.append((solve_lcp(M, q.detach() + step).z.sum() - 1) / (sign * h))
    assert min(abs(q.grad[1] - slope) for slope in slopes) < 1e-6


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("p", "expected"), [(0.3, 0.0), (-0.2, 0.0), (0.9, 1.0), (-0.7, 1.0)])
def test_velocity_gradient_of_the_friction_problem_is_exact_although_its_forces_are_not_unique(method, p, expected):
    """NOTES 5.6: at stick the basis block is singular for an interior point; dv/dp = 0 there and 1 in slip."""
    p = torch.tensor(p).requires_grad_()
    z = solve_lcp(torch.tensor(FRICTION), torch.stack([p, -p, torch.tensor(0.4)]), method=method).z
    velocity = p + z[0] - z[1]
    velocity.backward()
    assert p.grad == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("k", [2, 4, 7])
def test_redundant_contacts_have_an_exact_velocity_gradient(method, k):
    """M = ones(k, k), q = -b: sum z = b, whatever its split, so d(sum z)/db = 1."""
    b = torch.tensor(1.0).requires_grad_()
    z = solve_lcp(torch.ones(k, k), -b.expand(k), method=method).z
    assert z.sum().item() == pytest.approx(1.0, abs=1e-14)
    z.sum().backward()
    assert b.grad == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_gradient_does_not_depend_on_the_units_of_rows_and_columns(method):
    M, q = problem("nonsymmetric definite", batch=1, n=4)
    scale = torch.tensor([1e-6, 1.0, 1e3, 1e6])
    z = solve_lcp(M, q, method=method).z
    expected = torch.autograd.grad(z.sum(), q)[0]
    scaled = solve_lcp(scale.unsqueeze(-1) * M * scale, scale * q, method=method).z
    torch.testing.assert_close(torch.autograd.grad((scale * scaled).sum(), q)[0], expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_float32_gradient_has_float32_type_and_accuracy(method):
    M, q = problem("positive definite")
    M32, q32 = M.detach().float().requires_grad_(), q.detach().float().requires_grad_()
    solve_lcp(M, q, method=method).z.square().sum().backward()
    solve_lcp(M32, q32, method=method).z.square().sum().backward()
    assert M32.grad.dtype == torch.float32
    torch.testing.assert_close(M32.grad, M.grad.float(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_gradient_does_not_depend_on_units_where_every_member_is_basic(method):
    """A second pivot of 1e-12 beside a first of 1e12 is no zero."""
    generator = torch.Generator().manual_seed(1)
    M = random_family("positive definite", 16, 6, generator)
    q = -M.sum(-1).requires_grad_()
    scale = 10 ** (12 * torch.rand(16, 6, generator=generator) - 6)
    (expected,) = torch.autograd.grad(solve_lcp(M, q, method=method).z.square().sum(), q)
    z = scale * solve_lcp(scale.unsqueeze(-1) * M * scale.unsqueeze(-2), scale * q, method=method).z
    torch.testing.assert_close(torch.autograd.grad(z.square().sum(), q)[0], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_backward_in_the_kernel_equals_backward_in_torch(shared, dtype):
    """The kernel serves a plain backward, torch's operations one that is differentiated again."""
    M, q = (x.detach() for x in problem("nonsymmetric definite", batch=16, n=7))
    leaves = (M[0] if shared else M).to(dtype).requires_grad_(), q.to(dtype).requires_grad_()
    solution = solve_lcp(*leaves, method="pivoting")
    loss = solution.z.square().sum() + solution.w.sin().sum()
    in_kernel = torch.autograd.grad(loss, leaves, retain_graph=True)
    in_torch = torch.autograd.grad(loss, leaves, create_graph=True)
    torch.testing.assert_close(in_kernel, in_torch)


def cube_on_the_ground(batch: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """M, q of cubes with four contacts, dq of a random change of velocity, and c that weighs contact velocities.

    q and dq lie in the range of the contact Jacobian J, whose rows M_JJ = J W J' spans.
    """
    rng = np.random.default_rng(0)
    M, q = map(torch.from_numpy, stacked_cubes(rng, batch)[:2])
    J = slice(0, 20)
    dq = torch.zeros_like(q)
    dq[:, J] = (M[:, J, J] @ torch.from_numpy(rng.standard_normal((batch, 20, 1)))).squeeze(-1)
    return M, q, dq, torch.from_numpy(rng.standard_normal(20))


@pytest.mark.parametrize("method", METHODS)
def test_gradient_of_the_next_velocity_of_a_cube_on_four_contacts_is_exact_where_it_is_unique(method):
    """Its impulses are not unique: three contacts would carry it. J v' = (M z + q)_J without the slack's columns."""
    M, q, dq, c = cube_on_the_ground(64)

    def velocity(t, method=method):
        z = solve_lcp(M, q + t.unsqueeze(-1) * dq, method=method).z
        return (M[:, :20, :20] @ z[:, :20].unsqueeze(-1)).squeeze(-1) + (q + t.unsqueeze(-1) * dq)[:, :20]

    t = torch.zeros(64).requires_grad_()
    (gradient,) = torch.autograd.grad((velocity(t) @ c).sum(), t)
    with torch.no_grad():
        here, h = velocity(t), 1e-5
        one, other = ((velocity(t + s * h) @ c - here @ c) / (s * h) for s in (1, -1))
        unique = torch.stack(
            [(velocity(t + s * h, m) - velocity(t + s * h)).abs().amax(-1) < 1e-9 for m in METHODS for s in (0, 1, -1)]
        ).all(0)
    smooth = unique & ((one - other).abs() < 1e-6)
    error = ((gradient - (one + other) / 2).abs() / (1 + gradient.abs()))[smooth]
    assert smooth.sum() >= 32
    assert error.max() <= 1e-6
    assert error.median() <= 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_gradient_at_a_kink_is_that_of_one_of_its_two_sides(method):
    """One member with z_i = w_i = 0: along any direction, z follows one linear piece forwards and another backwards."""
    generator = torch.Generator().manual_seed(3)
    M = random_family("nonsymmetric definite", 16, 5, generator)
    q, z = planted(M, generator)
    w = (M @ z.unsqueeze(-1)).squeeze(-1) + q
    z[:, 0], w[:, 0] = 0.0, 0.0
    q = (w - (M @ z.unsqueeze(-1)).squeeze(-1)).requires_grad_()
    solution = solve_lcp(M, q, method=method)
    assert torch.equal(solution.degenerate, torch.arange(5).expand(16, 5) == 0)
    direction, c, h = torch.randn(16, 5, generator=generator), torch.randn(5, generator=generator), 1e-6
    slope = (torch.autograd.grad((solution.z @ c).sum(), q)[0] * direction).sum(-1)
    sides = [((solve_lcp(M, q.detach() + s * h * direction, method=method).z - z) @ c) / (s * h) for s in (1, -1)]
    distance = torch.stack([(slope - side).abs() for side in sides])
    assert distance.amin(0).max() < 1e-6
    assert distance.amax(0).max() > 1e-3  # the sides do differ


@pytest.mark.parametrize("method", METHODS)
def test_a_kink_is_seen_where_every_other_member_is_basic(method):
    """Only the kink's own w is left to compare it with: rounding noise there is zero."""
    generator = torch.Generator().manual_seed(0)
    M = random_family("nonsymmetric definite", 64, 4, generator)
    z = torch.rand(64, 4, generator=generator) + 0.1
    z[:, 0] = 0.0
    solution = solve_lcp(M, -(M @ z.unsqueeze(-1)).squeeze(-1), method=method)
    assert not solution.w.any()
    assert torch.equal(solution.degenerate, torch.arange(4).expand(64, 4) == 0)


def test_smoothed_gradient_is_finite_where_a_member_of_the_central_path_rounds_to_zero():
    """w / z is infinite there: the member counts as nonbasic, as it is in the limit."""
    q = torch.tensor([1e30, -1.0]).float().requires_grad_()
    solution = solve_lcp(torch.eye(2).float(), q, smoothing=1e-30)
    assert solution.z[0] == 0
    (solution.z.sum() + solution.w[0]).backward()
    torch.testing.assert_close(q.grad, torch.tensor([1.0, -1.0]).float())


def test_blocks_that_are_not_finite_spoil_no_neighbour():
    M, q = problem("positive definite", batch=2)
    with torch.no_grad():
        M[0] *= 1e300
    z = solve_lcp(M, q, method="interior_point").z
    (gradient,) = torch.autograd.grad(z.square().sum(), q)
    alone = q[1].detach().requires_grad_()
    (expected,) = torch.autograd.grad(solve_lcp(M[1], alone, method="interior_point").z.square().sum(), alone)
    assert gradient.isfinite().all()
    torch.testing.assert_close(gradient[1], expected)


@pytest.mark.parametrize(("gap", "singular"), [(1e-9, False), (8.9e-16, False), (2.3e-16, True), (0.0, True)])
def test_kernel_and_torch_agree_on_which_blocks_are_singular(gap, singular):
    """The pivots of [[1, 1], [1, 1 + gap]] are 1 and gap; the smaller one shows in what its inverse would blow up."""
    M = torch.tensor([[1.0, 1.0], [1.0, 1.0 + gap]])
    saved = M, torch.ones(2), torch.zeros(2), torch.ones(2, dtype=torch.bool), torch.tensor(0)
    for grad_z, bounded in (([1.0, -1.0], singular), ([1.0, 1.0], True)):
        with torch.no_grad():
            found = [
                adjoint(saved, torch.tensor(grad_z), None, False, 0.0, in_kernel)[1] for in_kernel in (True, False)
            ]
        for grad_q in found:
            assert (grad_q.abs().max() < 3) == bounded


@pytest.mark.parametrize("method", METHODS)
def test_what_is_small_in_a_singular_block_counts(method):
    """Three contacts on two velocities, two of them the same: forces are not unique, velocities A' z are."""
    A = torch.tensor([[1.0, 0.0], [1.0, 0.02], [1.0, 0.0]], dtype=torch.float64)
    M = A @ A.T  # singular values 3, 3e-4, 0
    z, dz = torch.ones(3, dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    _, slope = torch.func.jvp(lambda q: solve_lcp(M, q, method=method).z, (-M @ z,), (-M @ dz,))
    torch.testing.assert_close(A.T @ slope, A.T @ dz, rtol=1e-9, atol=0)


def test_a_block_that_is_regular_by_the_rounding_of_float32_alone_counts_as_singular():
    A = torch.tensor([[1.0, 0.1], [1.0, 0.3], [1.0, 0.7]], dtype=torch.float64)
    M = (A @ A.T).float()
    assert 1e-9 < torch.linalg.svdvals(M.double())[-1] < 1e-6  # 0 but for rounding
    dq = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float32)
    basis, status = torch.ones(3, dtype=torch.bool), torch.tensor(Status.SOLVED)
    dz, _ = tangent((M, torch.ones_like(dq), torch.zeros_like(dq), basis, status), None, dq, 0.0)
    assert dz.any()
    assert dz.abs().max() < 100  # 1e7 and more along the null vector


@pytest.mark.parametrize("method", METHODS)
def test_an_unsolved_element_has_no_slope_in_any_mode(method):
    """Forward mode, and reverse mode made of torch's operations (create_graph)."""
    M = torch.stack(
        (torch.eye(2), torch.tensor([[0.0, 1.0], [0.0, 1.0]]), torch.tensor([[torch.nan, 0.0], [0.0, 1.0]]))
    )
    q = torch.tensor([[-1.0, 1.0], [-1.0, 0.0], [-1.0, 1.0]])  # the second has no solution
    assert solve_lcp(M, q, method=method).solved.tolist() == [True, False, False]
    _, tangents = torch.func.jvp(
        lambda M, q: solve_lcp(M, q, method=method)[:2], (M, q), (torch.ones_like(M), torch.ones_like(q))
    )
    assert all(tangent[0].any() and not tangent[1:].any() for tangent in tangents)
    M, q = M.requires_grad_(), q.requires_grad_()
    solution = solve_lcp(M, q, method=method)
    for gradient in torch.autograd.grad((solution.z + solution.w).sum(), (M, q), create_graph=True):
        assert gradient[0].any()
        assert not gradient[1:].any()
