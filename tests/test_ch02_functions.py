"""Chapter 2: the functions that decide C2.1, on problems small enough to be solved by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from notebook_functions import judge, load, runs

from lifelong_lib.transfer.ella import ELLA


def test_the_objective_of_a_learner_falls_into_fit_codes_and_size():
    """L = I and Gamma = I: a code is its target, moved by mu / 2 = 0.1 towards zero."""
    learner = SimpleNamespace(basis_=np.eye(2), sparsity=0.2, ridge=0.5)
    solutions = [(np.array([3.0, 0.05]), np.eye(2)), (np.array([0.0, -1.1]), np.eye(2))]
    parts = load(2, "parts_of_objective").parts_of_objective(learner, solutions)
    # Codes (2.9, 0) and (0, -1). Fit: (0.1^2 + 0.05^2 + 0.1^2) / 2. Codes: 0.2 (2.9 + 1) / 2. Size: 0.5 (1 + 1).
    assert parts == pytest.approx((0.01125, 0.39, 1.0))


def test_all_learners_are_looked_at_after_five_ten_and_twenty_tasks_met_so_far():
    rng = np.random.default_rng(5)
    solutions = [(rng.standard_normal(3), np.eye(3)) for _ in range(21)]
    space = load(2, "live", "parts_of_objective")
    found = space.live({"k": 2, "mu": 0.01, "ridge": 1e-3, "rounds": 5}, solutions, np.random.default_rng(0))
    assert {name: parts.shape for name, parts in found.items()} == dict.fromkeys(
        ("ELLA", "random start", "random", "GO-MTL"), (3, 3))
    alone = ELLA(2, 0.01, 1e-3, random_state=0)
    for t, solution in enumerate(solutions[:10]):
        alone.partial_fit(t, *solution)
    assert found["ELLA"][1] == pytest.approx(space.parts_of_objective(alone, solutions[:10]))  # no task after the tenth
    total = {name: parts.sum(axis=1) for name, parts in found.items()}
    assert (total["random"] > total["ELLA"]).all()  # its dictionary does not learn
    assert np.ptp(found["random"][:, 2]) == 0 < np.ptp(found["ELLA"][:, 2])  # size of L


def lifetimes(ella, batch=1.0, random=9.0):
    """Results of three lifetimes at two moments; three equal parts make up each objective."""
    def parts(*objectives):
        return [np.full((2, 3), 1 / 3) * np.array(objectives)[:, None]] * 3
    values = {"ELLA": parts(50.0, ella), "GO-MTL": parts(10.0, batch), "random": parts(80.0, random)}
    return runs(({"ridge": 1e-7}, values), ({"ridge": 1e-3}, values | {"ELLA": parts(99.0, 99.0)}))


def test_ratio_is_of_sums_at_one_moment():
    ratio = load(2, "ratio").ratio(lifetimes(ella=2.5, batch=2.0), "ELLA", ridge=1e-7)
    assert ratio == pytest.approx(np.array([[5.0, 1.25]] * 3))  # 50 / 10 and 2.5 / 2


@pytest.mark.parametrize("ella, random, verdict, control", [
    (1.05, 9.0, "holds", "contradicted"),
    (1.2, 9.0, "contradicted", "contradicted"),
    (0.9, 9.0, "holds", "contradicted"),  # the batch learner is no oracle
    (1.05, 1.05, "undecided", "holds"),  # a dictionary that need not be learned shows nothing
])
def test_c2_1_is_the_excess_after_the_last_task_at_the_lightest_ridge(tmp_path, ella, random, verdict, control):
    space = load(2, "ratio", regressions=lifetimes(ella, random=random), ridges=[1e-7, 1e-3])
    claim = judge(2, "C2.1", space, tmp_path)
    (excess,), (left,) = claim.measured.values(), claim.control.values()
    assert (excess, left) == pytest.approx((ella - 1, random - 1))
    assert (claim.verdict, claim.control_verdict) == (verdict, control)


def test_noiseless_regressions_find_the_hidden_models():
    config = {"tasks": 3, "d": 4, "k": 2, "samples": 30, "noise": 0.0, "penalty": 1e-12}
    models, solutions = load(2, "draw_regressions").draw_regressions(config, np.random.default_rng(0))
    assert np.stack([alpha for alpha, _ in solutions]) == pytest.approx(models, abs=1e-6)
