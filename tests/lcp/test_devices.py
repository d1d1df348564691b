"""Accelerators: nothing waits for a value but one question at the end; tested without one, and on one if there is."""

import pytest
import torch
from lcp.oracles import FAMILIES, planted, random_family
from lcp.workers import compile_path
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from lcplearn import Status, solve_lcp
from lcplearn.lcp import interior_point, methods
from lcplearn.lcp.methods import Options, TorchMethod

OPTIONS = Options("auto", 1e-10, None, 0.0)
WAITING = ("item", "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "unique", "bincount")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
# At the lower bound dynamo can't trace NamedTuple._replace, and a fake CUDA tensor asks the driver (NOTES 4.1).
newer_torch = pytest.mark.skipif(torch.__version__ < "2.7", reason="needs a torch newer than 2.6")


class Questions(TorchDispatchMode):
    """Counts the operators for which the CPU has to wait until the device has come to a value."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        mask = name in ("index", "index_put", "index_put_") and any(
            x is not None and x.dtype in (torch.bool, torch.uint8) for x in args[1]
        )
        if name in WAITING or mask or (name == "_to_copy" and (kwargs or {}).get("device") is not None):
            self.asked.append(name)
        return function(*args, **(kwargs or {}))


def problem(family: str = "nonsymmetric definite", batch: int = 8, n: int = 6):
    generator = torch.Generator().manual_seed(0)
    M = random_family(family, batch, n, generator)
    return M, planted(M, generator)[0]


def mixed() -> tuple[torch.Tensor, torch.Tensor]:
    """Solvable ones, NaN, trivial, infeasible, and scales apart that only the CPU kernel solves."""
    M, q = problem()
    M[1, 0, 0] = torch.nan
    q[2] = q[2].abs()
    M[3] = -torch.eye(6)
    q[3] = -1
    scales = 10.0 ** torch.linspace(-6, 6, 6)
    M[4], q[4] = scales[:, None] * M[4] * scales.flip(0), scales * q[4]
    return M, q


@pytest.mark.parametrize("smoothing", [0.0, 1e-3])
@pytest.mark.parametrize("method", [interior_point.follow_path, methods.diagonal])
def test_path_and_judge_ask_nothing(method, smoothing):
    M, q = mixed()
    with Questions() as questions:
        methods._solve_in_torch(TorchMethod(method), M, q, OPTIONS._replace(smoothing=smoothing))
    assert questions.asked == []


def test_a_solved_batch_is_one_question():
    with Questions() as questions:
        solution = methods.solve_without_waiting(*problem(), OPTIONS)
    assert solution.solved.all()
    assert questions.asked == ["nonzero"]


@pytest.mark.parametrize("family", FAMILIES)
def test_what_an_accelerator_computes_is_what_the_cpu_says(family):
    M, q = problem(family, batch=32)
    found = methods.solve_without_waiting(M, q, OPTIONS)
    assert found.solved.all()
    if family in ("positive definite", "nonsymmetric definite", "nonsymmetric P"):  # their solutions are unique
        torch.testing.assert_close(found.z, solve_lcp(M, q).z, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("shape", [(8,), (2, 4), (2, 2, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_the_path_leaves_is_solved_on_the_cpu(shape, dtype):
    M, q = (x.reshape(*shape, *x.shape[1:]).to(dtype) for x in mixed())
    found, expected = methods.solve_without_waiting(M, q, OPTIONS), solve_lcp(M, q)
    assert torch.equal(found.status, expected.status)
    assert {Status(x).name for x in found.status.flatten().tolist()} == {"SOLVED", "NONFINITE_INPUT", "INFEASIBLE"}
    torch.testing.assert_close(found.certificate, expected.certificate)
    assert all(a.shape == b.shape and a.dtype == b.dtype for a, b in zip(found, expected, strict=True))
    torch.testing.assert_close(found.z, expected.z, equal_nan=True, rtol=1e-5, atol=1e-6)


def test_a_shared_matrix_and_a_single_problem_are_finished_on_the_cpu_too():
    M, q = -torch.eye(2), torch.tensor([[1.0, 2.0], [-1.0, 1.0]])
    assert methods.solve_without_waiting(M, q, OPTIONS).status.tolist() == [Status.SOLVED, Status.INFEASIBLE]
    assert methods.solve_without_waiting(M, q[1], OPTIONS).status.item() == Status.INFEASIBLE


@pytest.mark.parametrize("smoothing", [0.0, 1e-3])
@pytest.mark.parametrize("family", ["semidefinite", "nonsymmetric P"])
def test_answers_do_not_depend_on_how_often_the_device_is_asked(family, smoothing, monkeypatch):
    """The CPU asks after each round, `follow_path` never."""
    monkeypatch.setattr(interior_point, "ROUNDS_AT_ONCE", 5)
    M, q = problem(family, batch=32)
    asked = interior_point.interior_point(M, q, max_iter=20, smoothing=smoothing)
    unasked = interior_point.follow_path(M, q, max_iter=20, smoothing=smoothing)
    arrived = ~(asked.exhausted | unasked.exhausted)
    assert arrived.sum() >= 30
    for a, b in zip(asked, unasked, strict=True):
        assert torch.equal(a[arrived], b[arrived])


@newer_torch
@pytest.mark.slow
def test_the_path_compiles_as_one_graph_with_the_same_answers():
    """In a process of its own: checks of shapes, on in tests only, can't be traced."""
    torch.multiprocessing.spawn(compile_path)


@newer_torch
def test_fake_cuda_tensors_run_through_the_path_and_the_judge():
    with FakeTensorMode():
        M, q = (torch.empty(shape, device="cuda", dtype=torch.float64) for shape in ((5, 3, 3), (5, 3)))
        solution = methods._solve_in_torch(TorchMethod(interior_point.follow_path), M, q, OPTIONS)
    assert all(x.device.type == "cuda" for x in solution)
    assert solution.z.shape == (5, 3)


@needs_cuda
def test_on_cuda_nothing_waits():
    M, q = (x.cuda() for x in problem(batch=100))
    methods.solve_without_waiting(M, q, OPTIONS)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        methods._solve_in_torch(TorchMethod(interior_point.follow_path), M, q, OPTIONS)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@needs_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_on_cuda_values_statuses_and_gradients_are_those_of_the_cpu(dtype):
    tolerance = {"rtol": 1e-4, "atol": 1e-4} if dtype == torch.float32 else {"rtol": 1e-8, "atol": 1e-10}
    M, q = (x.to(dtype) for x in mixed())
    found, expected = solve_lcp(M.cuda(), q.cuda()), solve_lcp(M, q)
    assert torch.equal(found.status.cpu(), expected.status)
    torch.testing.assert_close(found.z.cpu(), expected.z, equal_nan=True, **tolerance)
    M, q = (x.to(dtype) for x in problem(batch=100))
    gradients = []
    for device in ("cuda", "cpu"):
        leaves = [x.to(device).requires_grad_() for x in (M, q)]
        solution = solve_lcp(*leaves)
        gradients.append([x.cpu() for x in torch.autograd.grad(solution.z.sum() + solution.w.square().sum(), leaves)])
    torch.testing.assert_close(*gradients, **tolerance)
