"""Torch's private names: all there, all in one file, and where one is gone the answers are still right."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from lcp.oracles import planted, random_family
from torch._subclasses.fake_tensor import FakeTensorMode

import lcplearn.lcp
from lcplearn import solve_lcp
from lcplearn.lcp import torch_internals

NAMES = {
    "traced": (torch._C, "_dispatch_tls_is_dispatch_key_included", "_len_torch_dispatch_stack", "_get_dispatch_mode"),
    "transformed": (torch._C, "_are_functorch_transforms_active"),
    "forward_mode": (forward_ad, "_current_level"),
    "mapped_by_autograd": (torch._C._functorch, "is_legacy_batchedtensor"),
}


@pytest.mark.parametrize("question", NAMES)
def test_torch_has_the_private_names(question):
    """Without them all is right but slower; a new version of torch that lacks one wants a new question."""
    module, *names = NAMES[question]
    assert [name for name in names if not hasattr(module, name)] == []
    assert hasattr(torch._C.DispatchKey, "PreDispatch")
    assert hasattr(torch._C._TorchDispatchModeKey, "PROXY")
    assert hasattr(torch._C._TorchDispatchModeKey, "FAKE")


def test_private_names_of_torch_are_in_one_file():
    private = re.compile(r"\btorch(\.\w+)*\._\w|\b(forward_ad|_C)\._\w|from torch[\w.]*\._")
    folder = Path(lcplearn.lcp.__file__).parent
    users = {path.name for path in folder.rglob("*.py") if private.search(path.read_text())}
    assert users == {"torch_internals.py"}


def test_nothing_special_is_no_question():
    with torch.no_grad():
        assert not torch_internals.traced()
        assert not torch_internals.transformed()
        assert not torch_internals.forward_mode()
        assert not torch_internals.mapped_by_autograd(torch.ones(2))


@pytest.mark.parametrize("question", NAMES)
def test_without_a_private_name_value_and_gradient_stay_right(question, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    M = random_family("nonsymmetric definite", 3, 4, generator)
    q = planted(M, generator)[0].requires_grad_()

    def values_and_gradients():
        solution = solve_lcp(M, q)
        (plain,) = torch.autograd.grad(solution.z.square().sum(), q)
        (mapped,) = torch.autograd.grad(solve_lcp(M, q).z, q, torch.ones(2, 3, 4), is_grads_batched=True)
        return solution.z, plain, mapped, torch.func.vmap(lambda q: solve_lcp(M[0], q).z)(q)

    expected = values_and_gradients()
    monkeypatch.setattr(torch_internals, "forward_ad" if question == "forward_mode" else "_C", SimpleNamespace())
    assert getattr(torch_internals, question)(*([q] if question == "mapped_by_autograd" else []))
    torch.testing.assert_close(values_and_gradients(), expected)
    with FakeTensorMode() as mode:
        assert solve_lcp(mode.from_tensor(M), mode.from_tensor(q)).z.shape == q.shape
