"""Values and statuses of `solve_lcp` against enumeration, closed forms and planted solutions."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lcp.oracles import FAMILIES, has_solution, natural_residual, planted, random_family

from lcplearn import Status, solve_lcp
from lcplearn.benchmark.audit.judges import differs_from_planted, off_in_rows
from lcplearn.benchmark.fuzz.cases import contact
from lcplearn.benchmark.problems import families as problems
from lcplearn.lcp.methods import TORCH_METHODS

METHODS = ("pivoting", *(name for name, method in TORCH_METHODS.items() if method.general))
entries = st.integers(-3, 3)


def integer_problem(draw, n: int) -> tuple[np.ndarray, np.ndarray]:
    return draw(arrays(np.float64, (n, n), elements=entries)), draw(arrays(np.float64, n, elements=entries))


@st.composite
def semidefinite_problems(draw):
    """Integer F F' + K - K' of any rank, with any q: degenerate and infeasible problems among them."""
    n = draw(st.integers(1, 6))
    F = draw(arrays(np.float64, (n, draw(st.integers(1, n))), elements=st.integers(-2, 2)))
    K = draw(arrays(np.float64, (n, n), elements=entries)) * draw(st.booleans())
    return F @ F.T + K - K.T, draw(arrays(np.float64, n, elements=entries))


@st.composite
def arbitrary_problems(draw):
    return integer_problem(draw, draw(st.integers(1, 5)))


@pytest.mark.parametrize("method", METHODS)
@settings(deadline=None, max_examples=2 * settings.default.max_examples)
@given(problem=semidefinite_problems())
def test_semidefinite_problem_is_solved_exactly_when_enumeration_finds_a_solution(method, problem):
    M, q = problem
    solution = solve_lcp(torch.tensor(M), torch.tensor(q), method=method)
    assert bool(solution.solved) == has_solution(M, q)
    if solution.solved:
        assert natural_residual(M, q, solution.z.numpy()) <= 1e-9


@pytest.mark.parametrize("method", METHODS)
@settings(deadline=None)
@given(problem=arbitrary_problems())
def test_status_is_true_for_any_matrix(method, problem):
    M, q = problem
    solution = solve_lcp(torch.tensor(M), torch.tensor(q), method=method)
    if solution.solved:
        assert natural_residual(M, q, solution.z.numpy()) <= 1e-8 * max(1, np.abs(q).max())
    if solution.status == Status.INFEASIBLE:
        assert not has_solution(M, q)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("n", [1, 3, 10, 30, 50])
def test_planted_problem_has_a_residual_of_rounding(method, family, n):
    generator = torch.Generator().manual_seed(n)
    M = random_family(family, 32, n, generator)
    q, _ = planted(M, generator)
    solution = solve_lcp(M, q, method=method)
    assert solution.solved.all()
    assert solution.residual.max() <= 1e-10


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("family", ["positive definite", "nonsymmetric definite", "nonsymmetric P", "condition 1e10"])
@pytest.mark.parametrize("n", [3, 20, 50])
def test_row_and_column_scales_of_twelve_decades_do_not_matter(method, family, n):
    generator = torch.Generator().manual_seed(n)
    rows, columns = (10 ** (12 * torch.rand(16, n, generator=generator) - 6) for _ in range(2))
    M = rows.unsqueeze(-1) * random_family(family, 16, n, generator) * columns.unsqueeze(-2)
    q, z = planted(M, generator)
    solution = solve_lcp(M, q, method=method)
    assert solution.solved.all()
    assert not differs_from_planted(*(x.numpy() for x in (M, q, solution.z, z)), 1e-10).any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("decades", [6, 8, 10, 12])
def test_rows_and_columns_in_units_of_their_own_give_the_planted_solution(method, dtype, decades):
    """z has the scales of the columns: judged in one scaling for rows and columns, another basis looks right."""
    M, q, z = problems.scaled_apart(np.random.default_rng(decades), 1000, 6, decades)
    data = [torch.from_numpy(x).to(dtype) for x in (M, q)]
    solution = solve_lcp(*data, method=method)
    answer = [x[solution.solved].double().numpy() for x in (*data, solution.z, torch.from_numpy(z))]
    assert not differs_from_planted(*answer, 4e-6 if dtype is torch.float32 else 1e-10).any()
    if method == "pivoting" and dtype is torch.float64:
        assert solution.solved.all()


def test_sizes_far_apart_in_q_are_solved_in_each_size():
    """Contacts whose velocities are 1, 1e-6 and 1e-14 side by side, and 0: the small rows are decided as well."""
    for seed in range(60):
        M, q, _ = contact(np.random.default_rng([5, seed]))
        solution = solve_lcp(torch.from_numpy(M), torch.from_numpy(q))
        assert solution.solved.all()
        assert not off_in_rows(M, q, solution.z.numpy(), 1e-10).any()


def test_a_large_entry_elsewhere_does_not_hide_a_contact_at_rest():
    """A contact that pushes with 1e-15 beside one that slides at 1, and beside an inert row of any size."""
    friction = [[2.0, 1.0, -1.0, 0.0], [1.0, 3.0, -3.0, 1.0], [-1.0, -3.0, 3.0, 1.0], [0.5, -1.0, -1.0, 0.0]]
    small = torch.tensor([-1e-15, 3e-16, -3e-16, 0.0])
    for inert in (0.0, 1.0, 1e6):
        M = torch.block_diag(torch.tensor(friction), torch.zeros(1, 1))
        solution = solve_lcp(M, torch.cat((small, torch.tensor([inert]))))
        assert solution.solved
        torch.testing.assert_close(solution.z[:4], 1e-15 * solve_lcp(M[:4, :4], 1e15 * small).z, rtol=1e-9, atol=0)


@pytest.mark.parametrize("method", METHODS)
def test_unscaled_semidefinite_problem_stays_solved_under_congruence(method):
    generator = torch.Generator().manual_seed(0)
    scale = 10 ** (12 * torch.rand(32, 20, generator=generator) - 6)
    M = scale.unsqueeze(-1) * random_family("semidefinite", 32, 20, generator) * scale.unsqueeze(-2)
    q, _ = planted(M, generator)
    assert solve_lcp(M, q, method=method).residual.max() <= 1e-10


@pytest.fixture(params=["kernel", "torch"])
def engine(request, monkeypatch):
    """What runs method "diagonal": the CPU kernel, or torch as on other devices."""
    if request.param == "torch":
        monkeypatch.setattr("lcplearn.lcp.methods.pivoting_kernel", lambda: None)
    return request.param


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(1e-6, 1e6), st.floats(-1e6, 1e6).map(lambda q: q if abs(q) > 1e-200 else 0.0)),
        min_size=1,
        max_size=5,
    )
)
def test_diagonal_method_is_the_closed_form(engine, pairs):
    """Where q spans less than the range of doubles: the kernel scales it to 1, and 1e-306 beside 1e3 underflows."""
    d, q = (torch.tensor(values) for values in zip(*pairs, strict=True))
    solution = solve_lcp(torch.diag(d), q, method="diagonal")
    assert solution.solved
    one_rounding = 2.3e-16 if engine == "kernel" else 0.0
    torch.testing.assert_close(solution.z, torch.where(q < 0, -q / d, 0.0), rtol=one_rounding, atol=0)
    assert torch.equal(solution.w, q.clamp_min(0))


@pytest.mark.usefixtures("engine")
def test_diagonal_method_never_calls_a_coupled_problem_wrongly_solved():
    M, q = torch.tensor([[2.0, -1.0], [-1.0, 2.0]]), -torch.ones(2)
    solution = solve_lcp(M, q, method="diagonal")
    assert solution.status == Status.UNSOLVED or natural_residual(M.numpy(), q.numpy(), solution.z.numpy()) <= 1e-15


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.lists(st.tuples(st.sampled_from([-1.0, 0.0, 1e-12, 1.0, 1e300]), st.sampled_from([-1e300, -1.0, 0.0, 1.0]))))
def test_diagonal_problem_is_solved_exactly_when_each_row_is(engine, pairs):
    d, q = torch.tensor(pairs).reshape(-1, 2).unbind(-1)
    solution = solve_lcp(torch.diag(d), q, method="diagonal")
    solvable = ((q >= 0) | ((d > 0) & (q / d).isfinite())).all()  # 1e300 / 1e-12 is out of range
    scaled = (q / torch.where(d == 0, 1.0, d).abs().sqrt()).abs()
    if engine == "kernel" and len(q) and ((scaled < 1e-300 * scaled.max()) & (q != 0)).any():
        assert not solution.solved or solvable  # the kernel may refuse rows that scaling to 1 would lose
    else:
        assert bool(solution.solved) == bool(solvable)


@pytest.mark.parametrize("method", METHODS)
def test_zeros_of_z_and_w_are_exact(method):
    generator = torch.Generator().manual_seed(1)
    M = random_family("nonsymmetric definite", 64, 12, generator)
    q, _ = planted(M, generator)
    solution = solve_lcp(M, q, method=method)
    assert torch.equal(solution.z == 0, ~solution.basis)
    assert torch.equal(solution.w == 0, solution.basis)


@pytest.mark.parametrize("method", METHODS)
def test_batch_equals_its_elements_one_by_one_beside_unsolvable_and_non_finite_members(method):
    generator = torch.Generator().manual_seed(2)
    M = random_family("nonsymmetric definite", 12, 6, generator)
    q, _ = planted(M, generator)
    M[3, 1, 2], q[5, 0] = torch.nan, torch.inf
    M[7], q[7] = -torch.eye(6), -1.0
    batch = solve_lcp(M, q, method=method)
    assert batch.status[3] == batch.status[5] == Status.NONFINITE_INPUT
    assert batch.z[3].isnan().all()
    assert batch.status[7] in (Status.INFEASIBLE, Status.UNSOLVED)
    assert batch.solved.sum() == 9
    for k in range(12):
        alone = solve_lcp(M[k], q[k], method=method)
        assert alone.status == batch.status[k]
        assert torch.equal(alone.basis, batch.basis[k])
        torch.testing.assert_close(alone.z, batch.z[k], rtol=1e-12, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("method", METHODS)
def test_the_solution_chosen_of_several_does_not_depend_on_the_batch(method):
    """Stacked cubes have redundant contacts: another order of summation would end in other contact forces."""
    M, q = (torch.from_numpy(x) for x in problems.stacked_cubes(np.random.default_rng(0), 24)[:2])
    batch = solve_lcp(M, q, method=method)
    for k in range(24):
        alone = solve_lcp(M[k], q[k], method=method)
        torch.testing.assert_close(alone.z, batch.z[k], rtol=1e-12, atol=0)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("M", "q"),
    [
        ([[-1.0]], [-1.0]),  # infeasible
        ([[0.0, 1.0], [-1.0, 0.0]], [-1.0, -1.0]),  # infeasible
        ([[0.0, 1.0], [0.0, 1.0]], [-1.0, 0.0]),  # feasible, no complementary solution
        ([[0.0]], [-1.0]),  # vanishing mass
    ],
)
def test_unsolvable_problem_is_never_called_solved(method, M, q):
    solution = solve_lcp(torch.tensor(M), torch.tensor(q), method=method)
    assert not solution.solved
    assert solution.z.isfinite().all()


def test_large_equal_z_of_a_singular_infeasible_problem_is_not_accepted():
    """Criterion (b) of the residual: z = t (1, 1) has a tiny natural residual relative to z, and solves nothing."""
    M = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
    q = -torch.ones(2)
    for method in METHODS:
        assert not solve_lcp(M, q, method=method).solved


def test_decoupled_tiny_row_counts():
    """Criterion (a) alone would not see the second row; dividing by 1 + |q| would not either."""
    M, q = torch.diag(torch.tensor([1.0, 1e-12])), torch.tensor([1e6, -1e-6])
    for method in METHODS:
        z = solve_lcp(M, q, method=method).z
        assert z[0] == 0
        assert z[1] == pytest.approx(1e6)


@pytest.mark.parametrize("method", METHODS)
def test_scaling_the_data_scales_the_solution(method):
    generator = torch.Generator().manual_seed(3)
    M = random_family("positive definite", 8, 5, generator)
    q, _ = planted(M, generator)
    z = solve_lcp(M, q, method=method).z
    for a, b in ((1e-12, 1.0), (1e12, 1e-8), (1.0, 1e10)):
        scaled = solve_lcp(a * M, b * q, method=method)
        assert scaled.solved.all()
        torch.testing.assert_close(scaled.z * a / b, z, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("method", ["auto", "diagonal", *METHODS])
def test_empty_batches_and_empty_problems_work(method):
    for M_shape, q_shape in (((0, 3, 3), (0, 3)), ((4, 0, 0), (4, 0)), ((2, 0, 5, 5), (0, 5))):
        M, q = torch.zeros(M_shape).requires_grad_(), torch.zeros(q_shape).requires_grad_()
        if method in ("auto", "interior_point"):
            assert solve_lcp(M, q, method=method, smoothing=1e-3).solved.all()
        solution = solve_lcp(M, q, method=method)
        assert solution.z.shape == torch.broadcast_shapes(M_shape[:-1], q_shape)
        assert solution.solved.all()
        solution.summary()
        assert not solution.degenerate.any()
        solution.z.sum().backward()
        assert M.grad.shape == M.shape


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_float32_in_float32_out_with_float64_inside(method):
    generator = torch.Generator().manual_seed(4)
    M = (random_family("condition 1e10", 16, 10, generator) + 1e-5 * torch.eye(10)).float()
    q = planted(M.double(), generator)[0].float()
    solution = solve_lcp(M, q, method=method)
    assert solution.z.dtype == solution.w.dtype == torch.float32
    assert solution.residual.dtype == torch.float64
    assert solution.solved.all()
    assert torch.equal(solution.z, solve_lcp(M.double(), q.double(), method=method).z.float())


def test_batch_dimensions_broadcast():
    M = torch.eye(2).expand(3, 1, 2, 2)
    q = -torch.rand(4, 2)
    solution = solve_lcp(M, q)
    assert solution.z.shape == (3, 4, 2)
    torch.testing.assert_close(solution.z, -q.expand(3, 4, 2))


def test_smoothed_solution_lies_on_the_central_path_and_tends_to_the_solution():
    generator = torch.Generator().manual_seed(5)
    M = random_family("nonsymmetric definite", 16, 6, generator)
    q, z = planted(M, generator)
    for tau in (1e-2, 1e-4, 1e-8):
        smoothed = solve_lcp(M, q, smoothing=tau)
        assert smoothed.solved.all()
        torch.testing.assert_close(smoothed.z * smoothed.w, torch.full_like(z, tau), rtol=1e-8, atol=0)
        torch.testing.assert_close(smoothed.w, (M @ smoothed.z.unsqueeze(-1)).squeeze(-1) + q, rtol=1e-9, atol=1e-12)
        assert (smoothed.z - z).abs().max() < 300 * tau


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1.0])
def test_smoothed_problem_is_solved_however_small_its_q(size):
    tau, m, q = 0.04, torch.tensor([1.0, 4.0, 100.0]), size * torch.tensor([1.0, -1.0, 0.5])
    solution = solve_lcp(torch.diag(m), q, smoothing=tau)
    assert solution.solved
    torch.testing.assert_close(solution.z, (-q + (q.square() + 4 * m * tau).sqrt()) / (2 * m), rtol=1e-12, atol=0)


@pytest.mark.parametrize("method", ["diagonal", *METHODS])
def test_w_is_not_zeroed_with_a_member_that_leaves_the_basis(method):
    """z = (0.59, 0), w = (0, 3.5e-5): the second member is close to basic, and is not."""
    M, q = torch.eye(2) / 1.5, torch.tensor([-0.39243484525647476, 3.48452564746804e-05])
    solution = solve_lcp(M, q, method=method)
    torch.testing.assert_close(solution.w, torch.tensor([0.0, q[1]]), rtol=1e-14, atol=0)
    assert solution.basis.tolist() == [True, False]


@pytest.mark.parametrize("method", ["diagonal", *METHODS])
def test_a_solution_beyond_the_range_of_the_callers_type_is_not_solved(method):
    M, q = torch.tensor([[1e-30], [1.0]]).float().unsqueeze(-1), torch.tensor([[-1e30], [-1.0]]).float()
    solution = solve_lcp(M, q.requires_grad_(), method=method)
    assert solution.solved.tolist() == [False, True]
    assert solution.residual.tolist() == [torch.inf, 0.0]
    solution.z.sum().backward()
    assert q.grad.flatten().tolist() == [0.0, -1.0]
