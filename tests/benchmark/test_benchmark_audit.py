"""The judges of the audit find what is planted wrong, and nothing in what is right."""

import numpy as np
import pytest

from lcplearn.benchmark.audit import judges
from lcplearn.benchmark.audit import run as audit
from lcplearn.benchmark.audit.cases import FAMILIES
from lcplearn.benchmark.problems import families


def test_a_solution_is_the_planted_one_up_to_its_condition_and_another_is_not():
    M, q, z = families.scaled_apart(np.random.default_rng(0), 20, 6, 10)
    assert z is not None
    assert not judges.differs_from_planted(M, q, z * (1 + 1e-13), z, 1e-10).any()
    assert judges.differs_from_planted(M, q, z * 1.01, z, 1e-10).all()
    largest = np.argmax(z == 0, 1)  # the first member off the basis, made as large as its column allows
    rows, other = np.arange(20), z.copy()
    other[rows, largest] = 1e-3 / np.abs(M[rows, :, largest]).max(1) * (np.abs(M) @ z[..., None]).max((1, 2))
    assert judges.differs_from_planted(M, q, other, z, 1e-10)[(z == 0).any(1)].all()


@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_rows_are_off_where_a_sign_is_wrong_or_two_weigh(size):
    M, q = np.diag([1.0, 1e-12, 3.0])[None], size * np.array([[-1.0, -1e-12, 1.0]])
    for z, off in (([1, 1, 0], False), ([1, 1 + 1e-12, 0], False), ([1, 0.9, 0], True), ([1, 1, 1e-6], True)):
        assert judges.off_in_rows(M, q, size * np.array([z], dtype=float), 1e-10).tolist() == [off]


def test_rational_arithmetic_and_enumeration_decide_integers():
    M, q = np.array([[3.0, 1.0], [1.0, 3.0]]), np.array([-1.0, -1.0])
    exact = judges.exact_solution(M, q, np.array([True, True]))
    assert exact is not None
    assert exact[0] * 4 == 1
    assert judges.exact_solution(M, q, np.array([True, False])) is None
    ones, basis = np.full((2, 2), 0.25), np.ones((2, 2), dtype=bool)
    answers = np.stack((ones[0], ones[0] * (1 + 1e-6)))
    wrong = judges.wrong_for_integers(np.stack((M, M)), np.stack((q, q)), answers, basis)
    assert wrong.tolist() == [False, True]
    assert judges.has_solution(M, q)
    assert not judges.has_solution(np.zeros((1, 1)), np.array([-1.0]))


def test_a_certificate_is_refused_with_a_sign_or_a_column_wrong():
    M, q = np.diag([3.0, 0.0])[None], np.array([[-3.0, -1.0]])
    u = np.array([[0.0, 1.0]])
    assert not judges.false_certificate(M, q, u)[0]
    for false in ([[0.0, -1.0]], [[1e-6, 1.0]], [[0.0, 0.0]]):
        assert judges.false_certificate(M, q, np.array(false))[0]


@pytest.mark.parametrize("family", FAMILIES)
def test_no_answer_of_any_family_is_wrong_and_no_solution_is_missed(family):
    found = audit.audit(FAMILIES[family](np.random.default_rng(3), 100))
    assert not found["wrong"].any()
    assert not found["missed"].any()
    assert not found["unproven"].any()


@pytest.mark.parametrize("family", ["scaled apart", "semidefinite", "any integers"])
def test_a_lie_of_the_solver_is_found(family, monkeypatch):
    truthful = audit.solve_lcp

    def lying(M, q):
        solution = truthful(M, q)
        return solution._replace(z=solution.z * 1.001)

    monkeypatch.setattr(audit, "solve_lcp", lying)
    assert audit.audit(FAMILIES[family](np.random.default_rng(3), 100))["wrong"].any()
