"""The horde: hand arithmetic, true returns of other policies from one stream, Baird's example, no transfer."""

import numpy as np
import pytest

from lifelong_lib.learners.horde import Horde

ONE = np.ones(1)


def test_two_steps_by_hand():
    """phi 1 then 2, ratio 2 then 3, reward 1, continuation 0.5, terminal reward 4; step 0.1, correction 0.2, trace 0.5.

    First: e = 2; delta = 1 + 0.5 * 4 + 0.5 * 0 - 0 = 3; weights 0.1 * 3 * 2; second 0.2 * 3 * 2.
    Second, from 2 to 1: e = 3 (0.5 * 0.5 * 2 + 2) = 7.5; delta = 3 + 0.5 * 0.6 - 1.2 = 2.1; e . second = 9;
    weights 0.6 + 0.1 (2.1 * 7.5 - 0.5 * 0.5 * 9 * 1); second 1.2 + 0.2 (2.1 * 7.5 - 2.4 * 2).
    """
    horde = Horde(1, 1, 0.1, 0.2, 0.5)
    horde.learn(np.array([1.0]), np.array([2.0]), 2 * ONE, ONE, 0.5 * ONE, 4 * ONE)
    assert (horde.weights[0, 0], horde.second[0, 0]) == pytest.approx((0.6, 1.2))
    horde.learn(np.array([2.0]), np.array([1.0]), 3 * ONE, ONE, 0.5 * ONE, 4 * ONE)
    assert (horde.weights[0, 0], horde.second[0, 0]) == pytest.approx((1.95, 3.39))


def ring(size, steps, rng, demons, ratios=True, step=0.05, trace=0.3, choose=slice(None)):
    """A walk on a ring, right with 1/2, reward 1 on reaching state 0; demons go right with ``demons`` (D,)."""
    demons = np.array(demons)[choose]
    horde, features, x = Horde(len(demons), size, step, 1e-4, trace), np.eye(size), 0
    for right in rng.random(steps) < 0.5:
        y = (x + (1 if right else -1)) % size
        ratio = 2 * (demons if right else 1 - demons) if ratios else np.ones(len(demons))
        reward = np.full(len(demons), float(y == 0))
        horde.learn(features[x], features[y], ratio, reward, np.full(len(demons), 0.8), np.zeros(len(demons)))
        x = y
    return horde.weights


def true_values(size, right):
    moves = right * np.roll(np.eye(size), 1, axis=1) + (1 - right) * np.roll(np.eye(size), -1, axis=1)
    return np.linalg.solve(np.eye(size) - 0.8 * moves, moves[:, 0])


def test_demons_find_the_true_returns_of_policies_that_are_not_the_behaviours():
    wanted = np.array([true_values(5, right) for right in (0.1, 0.5, 0.9)])
    found = ring(5, 20_000, np.random.default_rng(0), (0.1, 0.5, 0.9))
    assert np.abs(found - wanted).max() < 0.08 < np.ptp(wanted[0])
    assert (np.abs(ring(5, 20_000, np.random.default_rng(0), (0.1, 0.9), ratios=False) - wanted[1]).max() < 0.08)


def test_the_closed_form_is_the_mean_of_roll_outs_of_the_target_policy():
    rng, size = np.random.default_rng(5), 5
    places, total = np.full(20_000, 2), np.zeros(20_000)
    for h in range(60):
        places = (places + np.where(rng.random(20_000) < 0.9, 1, -1)) % size
        total += 0.8**h * (places == 0)
    assert total.mean() == pytest.approx(true_values(size, 0.9)[2], abs=4 * total.std() / np.sqrt(20_000))


def test_a_demons_numbers_do_not_depend_on_the_others_to_the_last_bit():
    rights = np.linspace(0.1, 0.9, 9)
    together = ring(6, 500, np.random.default_rng(1), rights)
    for part in (slice(0, 1), slice(3, 5), slice(8, 9)):
        assert (ring(6, 500, np.random.default_rng(1), rights, choose=part) == together[part]).all()
    assert (together == ring(6, 500, np.random.default_rng(1), rights)).all()


def baird(correction):
    """Baird's star: seven states, all lead to the last under the target policy; the true value is 0 everywhere."""
    features = np.vstack([np.column_stack([2 * np.eye(6), np.zeros(6), np.ones(6)]), [0, 0, 0, 0, 0, 0, 1, 2]])
    rng, x = np.random.default_rng(2), 0
    horde = Horde(1, 8, 0.005, correction)
    horde.weights[0] = [1, 1, 1, 1, 1, 1, 10, 1]
    begin = np.abs(features @ horde.weights[0]).max()
    for _ in range(20_000):
        solid = rng.random() < 1 / 7
        y = 6 if solid else int(rng.integers(6))
        horde.learn(features[x], features[y], 7.0 * solid * ONE, 0 * ONE, 0.99 * ONE, 0 * ONE)
        x = y
    return np.abs(features @ horde.weights[0]).max() / begin


def test_the_correction_keeps_bairds_example_from_diverging():
    assert baird(0.05) < 1.5 and baird(0.0) > 100


def test_with_the_preferred_action_ahead_a_demon_learns_to_act():
    """Five cells, reward 1 on reaching the last, where it ends; actions are drawn. Worth is 0.9 to the steps left."""
    horde, features, rng, x = Horde(1, 10, 0.2, 1e-4), np.eye(10), np.random.default_rng(3), 0
    for action in rng.integers(2, size=6000):
        y = min(max(x + 2 * action - 1, 0), 4)
        ahead = features[2 * y + horde.weights[0, 2 * y:2 * y + 2].argmax()][None]
        horde.learn(features[2 * x + action], ahead, ONE, ONE * (y == 4), ONE * 0.9 * (y < 4), 0 * ONE)
        x = int(rng.integers(4)) if y == 4 else y
    assert horde.weights[0, 1:8:2] == pytest.approx([0.729, 0.81, 0.9, 1.0], abs=0.02)


def test_a_demon_that_does_not_hear_does_not_change():
    horde = Horde(2, 3, 0.1, 0.1)
    horde.learn(np.ones(3), np.ones(3), np.array([0.0, 1.0]), np.ones(2), np.ones(2), np.ones(2))
    assert (horde.weights[0] == 0).all() and (horde.weights[1] != 0).all()


@pytest.mark.parametrize("given", [(0, 0.1, 0), (0.1, -1, 0), (0.1, 0.1, 1.5), (np.nan, 0.1, 0)])
def test_impossible_steps_are_refused(given):
    with pytest.raises(ValueError, match="a horde needs a step > 0"):
        Horde(1, 1, *given)
