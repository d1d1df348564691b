"""The layer in torch's modes: transforms, forward mode, autocast, inference, unusual memory, no numba."""

import sys
import warnings

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from lcp.oracles import planted, random_family
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

import lcplearn.lcp
from lcplearn import solve_lcp
from lcplearn.lcp.methods import TORCH_METHODS, pivoting_kernel

METHODS = ("pivoting", *(name for name, method in TORCH_METHODS.items() if method.general))


def problem(batch: int = 3, n: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    M = random_family("nonsymmetric definite", batch, n, generator)
    return M, planted(M, generator)[0]


@pytest.mark.parametrize("method", METHODS)
def test_transforms_of_torch_func_agree_with_one_another_and_with_autograd(method):
    M, q = (x[0] for x in problem())

    def z(q):
        return solve_lcp(M, q, method=method).z

    def loss(q):
        return solve_lcp(M + torch.outer(q, q), q, method=method).z.square().sum()

    torch.testing.assert_close(torch.func.jacfwd(z)(q), torch.func.jacrev(z)(q))
    torch.testing.assert_close(torch.func.jacrev(z)(q), torch.autograd.functional.jacobian(z, q))
    torch.testing.assert_close(torch.func.hessian(loss)(q), torch.autograd.functional.hessian(loss, q))
    torch.testing.assert_close(torch.func.jacrev(torch.func.jacrev(loss))(q), torch.func.hessian(loss)(q))
    many = q + 1e-3 * torch.arange(5.0).unsqueeze(-1)
    one_by_one = torch.stack([torch.func.grad(loss)(x) for x in many])
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(loss))(many), one_by_one)
    torch.testing.assert_close(torch.func.vmap(z, in_dims=1)(many.mT), torch.stack([z(x) for x in many]))


@pytest.mark.parametrize("method", METHODS)
def test_backward_can_be_mapped_over_gradients_and_differentiated_forward(method):
    """Neither asks for a graph of the backward, and neither may meet the kernel: it would drop a tangent silently."""
    M, q = (x[0] for x in problem())
    q.requires_grad_()
    z = solve_lcp(M, q, method=method).z
    (jacobian,) = torch.autograd.grad(z, q, torch.eye(4), is_grads_batched=True)
    torch.testing.assert_close(jacobian, torch.autograd.functional.jacobian(lambda q: solve_lcp(M, q).z, q))

    def loss(q):
        return solve_lcp(M + torch.outer(q, q), q, method=method).z.square().sum()

    direction = torch.tensor([1.0, -2.0, 0.5, 3.0])
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(q, direction)
        tangent = forward_ad.unpack_dual(torch.autograd.grad(loss(dual), dual)[0]).tangent
    torch.testing.assert_close(tangent, torch.autograd.functional.hessian(loss, q) @ direction)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_autocast_leaves_values_and_gradients_alone(method, dtype):
    M, q = (x.to(dtype) for x in problem())
    results = []
    for enabled in (False, True):
        leaves = M.clone().requires_grad_(), q.clone().requires_grad_()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            solution = solve_lcp(*leaves, method=method)
            loss = solution.z.square().sum()
            first = torch.autograd.grad(loss, leaves, create_graph=True)
            results.append((solution.z, *first, *torch.autograd.grad(first[1].sum(), leaves)))
    assert results[1][0].dtype == dtype
    for plain, cast in zip(*results, strict=True):
        assert torch.equal(plain, cast)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("method", METHODS)
def test_modes_without_gradients_give_the_same_values(mode, method):
    M, q = problem()
    expected = solve_lcp(M.requires_grad_(), q, method=method)
    assert expected.z.requires_grad
    with mode():
        solution = solve_lcp(M, q, method=method)
        created_inside = solve_lcp(M.clone(), q.clone(), method=method)
    assert not solution.z.requires_grad
    assert torch.equal(solution.z, expected.z)
    assert torch.equal(created_inside.z, expected.z)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("transform", ["transposed", "strided", "expanded", "one shared", "negated lazily"])
def test_unusual_memory_is_read_right_and_never_written(method, transform):
    M, q = problem()
    if transform == "transposed":
        M, q = M.mT, q.mT.contiguous().mT
    elif transform == "strided":
        M, q = torch.stack([M, -M], -1)[..., 0], torch.stack([q, -q], -1)[..., 0]
    elif transform == "expanded":
        M, q = M[0].expand(3, 4, 4), q[0].expand(3, 4)
    elif transform == "negated lazily":
        M, q = (torch.complex(x, -x).conj().imag for x in (M, q))
        assert M.is_neg()
    else:
        M = M[:1]
    M, q = M.requires_grad_(), q.requires_grad_()
    plain = M.detach().clone().contiguous().requires_grad_(), q.detach().clone().contiguous().requires_grad_()
    before = M.detach().clone(), q.detach().clone()
    solution, expected = solve_lcp(M, q, method=method), solve_lcp(*plain, method=method)
    gradients = [
        torch.autograd.grad(s.z.square().sum() + s.w.sum(), x) for s, x in ((solution, (M, q)), (expected, plain))
    ]
    torch.testing.assert_close(solution.z, expected.z)
    torch.testing.assert_close(*gradients)
    assert torch.equal(M, before[0])
    assert torch.equal(q, before[1])


def test_modes_that_only_watch_leave_all_derivatives():
    M, q = problem()
    with FlopCounterMode(display=False):
        watched = torch.func.jacrev(lambda q: solve_lcp(M, q).z)(q)
    torch.testing.assert_close(watched, torch.func.jacrev(lambda q: solve_lcp(M, q).z)(q))


def test_memory_that_a_mode_takes_away_is_an_error_and_no_crash():
    class Meta(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            result = function(*args, **(kwargs or {}))
            return result.to("meta") if "lift_fresh" in str(function) else result

    M, q = problem()
    z = solve_lcp(M, q.requires_grad_()).z
    with Meta(), pytest.raises(RuntimeError, match="without memory"):
        torch.autograd.grad(z.sum(), q)


@pytest.mark.parametrize(
    "pack",
    [
        lambda x: x.to(torch.int8) if x.dtype == torch.int64 else x,
        lambda x: x.transpose(0, 1).contiguous().transpose(0, 1) if x.dim() > 1 else x[:, None].expand(-1, 2)[:, 0],
    ],
)
def test_hooks_on_saved_tensors_may_change_type_and_layout(pack):
    M, q = problem()
    q.requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        z = solve_lcp(M, q).z
    torch.testing.assert_close(torch.autograd.grad(z.sum(), q), torch.autograd.grad(solve_lcp(M, q).z.sum(), q))


def test_changing_the_matrix_between_forward_and_backward_is_an_error():
    M, q = problem()
    z = solve_lcp(M, q.requires_grad_()).z
    M += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        z.sum().backward()


def test_without_numba_auto_warns_once_and_solves_by_interior_point(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [name for name in sys.modules if name.startswith(("lcplearn.lcp.pivoting", "lcplearn.lcp.kernel"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(lcplearn.lcp, "pivoting", raising=False)
    monkeypatch.delattr(lcplearn.lcp, "kernel", raising=False)
    M, q = problem()
    pivoting_kernel.cache_clear()
    try:
        with warnings.catch_warnings(record=True) as record:
            warnings.simplefilter("always")
            solution = solve_lcp(M, q.requires_grad_())
            solve_lcp(M, q).z.sum().backward()
        assert ["interior point, many times slower" in str(warning.message) for warning in record] == [True]
        assert torch.equal(solution.z, solve_lcp(M, q, method="interior_point").z)
        with pytest.raises(ValueError, match="numba is missing; got 'pivoting'"):
            solve_lcp(M, q, method="pivoting")
    finally:
        pivoting_kernel.cache_clear()


def test_pivoting_refuses_other_devices():
    with pytest.raises(ValueError, match="M, q: expected the CPU, where method 'pivoting' runs; got meta"):
        solve_lcp(torch.eye(2, device="meta"), torch.ones(2, device="meta"), method="pivoting")


@pytest.mark.parametrize("method", ["auto", "diagonal", "interior_point"])
def test_devices_without_float64_are_refused(method):
    """The meta device stands in for Apple's."""
    with pytest.raises(ValueError, match="expected the CPU or a CUDA device, which have float64; got meta"):
        solve_lcp(torch.eye(2, device="meta"), torch.ones(2, device="meta"), method=method)
