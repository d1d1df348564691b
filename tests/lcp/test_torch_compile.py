"""The layer in code that torch.compile traces (whole graphs), and its operators by torch's own check of operators."""

import pytest
import torch
from lcp.oracles import planted, random_family
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx

from lcplearn import LCPLayer, solve_lcp

pytestmark = pytest.mark.slow

OPTIONS = [{}, {"method": "interior_point", "tol": 1e-9}, {"smoothing": 1e-3}, {"method": "diagonal"}]


@pytest.fixture(autouse=True)
def _forget_what_was_compiled():
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def compiled(function):
    return torch.compile(function, backend="aot_eager", fullgraph=True)


def problem(shared: bool = False, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    M = random_family("nonsymmetric definite", 3, 4, generator)
    q = planted(M[:1] if shared else M, generator)[0].expand(3, 4)
    return (M[0] if shared else M).to(dtype).requires_grad_(), q.to(dtype).clone().requires_grad_()


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("shared", [False, True])
def test_compiled_solution_and_gradient_equal_eager_ones(options, shared):
    def loss(M, q):
        M = torch.diag_embed(M.diagonal(dim1=-2, dim2=-1)) if options.get("method") == "diagonal" else M
        solution = LCPLayer(**options)(M, q)
        return solution.z.square().sum() + solution.w.sum(), solution

    M, q = problem(shared)
    (value, solution), (expected, eager) = compiled(loss)(M, q), loss(M, q)
    assert torch.equal(value, expected)
    for field, expected_field in zip(solution, eager, strict=True):
        assert torch.equal(field, expected_field)
    gradients, expected_gradients = (torch.autograd.grad(x, (M, q)) for x in (value, expected))
    torch.testing.assert_close(gradients, expected_gradients)


def test_compiled_code_takes_float32_an_initial_basis_and_inputs_without_gradient():
    M, q = (x.detach() for x in problem(dtype=torch.float32))
    expected = solve_lcp(M, q)
    solution = compiled(lambda M, q, basis: solve_lcp(M, q, initial_basis=basis))(M, q, expected.basis)
    assert torch.equal(solution.z, expected.z)
    assert solution.residual.dtype == torch.float64
    q.requires_grad_()
    compiled(lambda M, q: solve_lcp(M, q).z.sum())(M, q).backward()
    torch.testing.assert_close(q.grad, torch.autograd.grad(solve_lcp(M, q).z.sum(), q)[0])


def test_one_compilation_serves_all_batch_sizes():
    M, q = (x.detach() for x in problem())
    solve = torch.compile(lambda M, q: solve_lcp(M, q).z, backend="aot_eager", fullgraph=True, dynamic=True)
    with torch._dynamo.config.patch(error_on_recompile=True):
        for batch in (3, 2, 7):
            many = M.repeat(3, 1, 1)[:batch], q.repeat(3, 1)[:batch]
            assert torch.equal(solve(*many), solve_lcp(*many).z)


def test_compiled_vmap_equals_the_batch():
    M, q = (x.detach() for x in problem())
    z = compiled(torch.func.vmap(lambda M, q: solve_lcp(M, q).z))(M, q)
    assert torch.equal(z, solve_lcp(M, q).z)


@pytest.mark.parametrize(
    "derivative",
    [
        lambda f, q: torch.func.jvp(f, (q,), (q,))[1],
        lambda f, q: torch.func.jacfwd(f)(q),
        lambda f, q: torch.func.jvp(torch.func.vmap(lambda q: f(q)[0]), (q,), (q,))[1],
    ],
)
def test_forward_mode_in_compiled_code_raises_instead_of_returning_zero(derivative):
    M, q = (x.detach() for x in problem(shared=True))
    with pytest.raises(Exception, match=r"forward mode|Unsupported|functorch|setup_context"):
        compiled(lambda q: derivative(lambda q: solve_lcp(M, q).z, q))(q)


def test_second_derivatives_in_compiled_code_raise():
    M, q = problem()
    for inputs in ((M, q), (M.detach(), q), (M, q.detach())):
        leaf = next(x for x in inputs if x.requires_grad)
        z = compiled(lambda M, q: solve_lcp(M, q).z.square().sum())(*inputs)
        (first,) = torch.autograd.grad(z, leaf, create_graph=True)
        with pytest.raises(RuntimeError, match="double backward"):
            torch.autograd.grad((first * leaf).sum(), leaf)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # opcheck's own, of its copies
@pytest.mark.parametrize("shared", [False, True])
def test_operators_pass_the_operator_check_of_torch(shared):
    M, q = problem(shared)
    for in_kernel, options in ((True, ("auto", 1e-10, None, 0.0)), (False, ("interior_point", 1e-10, 50, 1e-3))):
        torch.library.opcheck(torch.ops.lcplearn.solve.default, (M, q, None, *options))
        saved = [x.detach() for x in (M, *solve_lcp(M, q)[:4])]
        saved.insert(1, q.detach())
        for need_M in (True, False):
            arguments = (*saved, torch.ones_like(q).detach(), None, need_M, options[-1], in_kernel)
            torch.library.opcheck(torch.ops.lcplearn.adjoint.default, arguments)


@pytest.mark.parametrize("pre_dispatch", [False, True])
def test_symbolic_tracers_see_one_operator_and_no_constant(pre_dispatch):
    """A solve that a tracer recorded as a constant would answer every later problem with the first one's solution."""
    M, q = 2 * torch.eye(2, dtype=torch.float64), -torch.ones(2, dtype=torch.float64)
    traced = make_fx(lambda M, q: solve_lcp(M, q).z, pre_dispatch=pre_dispatch)(M, q)
    torch.testing.assert_close(traced(M, 3 * q), solve_lcp(M, 3 * q).z)


def test_fake_tensors_get_fake_solutions_of_the_right_shapes():
    M, q = 2 * torch.eye(2, dtype=torch.float64), -torch.ones(2, dtype=torch.float64)
    with FakeTensorMode() as mode:
        fake = solve_lcp(mode.from_tensor(M), mode.from_tensor(q))
    assert [x.shape for x in fake] == [x.shape for x in solve_lcp(M, q)]
