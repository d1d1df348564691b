"""The layer in other threads and processes: workers of a DataLoader, data-parallel training, copies of the layer."""

import copy
import io
import pickle
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from lcp.oracles import planted, random_family
from lcp.workers import LearnedProblem, SolvedProblems, inputs, train_step_in_parallel
from torch.utils.data import DataLoader

from lcplearn import LCPLayer, solve_lcp

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # on a machine of one core
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_data_loader_workers_solve_also_after_their_parent_has(start):
    expected = torch.stack([SolvedProblems()[k] for k in range(4)])  # the parent solves first
    workers = 2 if start == "fork" else 1
    loader = DataLoader(SolvedProblems(), batch_size=2, num_workers=workers, multiprocessing_context=start)
    assert torch.equal(torch.cat(list(loader)), expected)


def test_gradients_of_two_data_parallel_processes_average_to_those_of_one(tmp_path):
    model = LearnedProblem()
    model(inputs()).square().mean().backward()
    torch.multiprocessing.spawn(train_step_in_parallel, args=(str(tmp_path),), nprocs=2)
    for rank in range(2):
        for parameter, gradient in zip(model.parameters(), torch.load(tmp_path / f"{rank}.pt"), strict=True):
            torch.testing.assert_close(gradient, parameter.grad, rtol=1e-12, atol=1e-15)


def test_threads_that_solve_at_once_get_what_one_thread_gets():
    generator = torch.Generator().manual_seed(0)
    problems = []
    for _ in range(8):
        M = random_family("nonsymmetric definite", 200, 10, generator)
        problems.append((M, planted(M, generator)[0].requires_grad_()))

    def value_and_gradient(problem):
        solution = solve_lcp(*problem)
        return solution.z.detach(), *torch.autograd.grad(solution.z.square().sum(), problem[1])

    one_by_one = list(map(value_and_gradient, problems))
    with ThreadPoolExecutor(4) as pool:
        at_once = list(pool.map(value_and_gradient, problems))
    for alone, together in zip(one_by_one, at_once, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(alone, together, strict=True))


def test_a_copied_pickled_or_saved_layer_solves_as_the_original():
    layer = LCPLayer(method="pivoting", tol=1e-9)
    file = io.BytesIO()
    torch.save(layer, file)
    file.seek(0)
    M, q = torch.eye(2), torch.tensor([-1.0, 1.0])
    for other in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), torch.load(file, weights_only=False)):
        assert repr(other) == repr(layer)
        assert torch.equal(other(M, q).z, layer(M, q).z)
